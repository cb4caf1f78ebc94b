"""Read-out of highlights that the frames around do not show (docs/equations.md, K15, K17)."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.highlights import Unshown, of_both
from kalux.compiled import ONE, empty, exponential, larger, loop, smaller
from kalux.filters.readout import HighlightPrior, read_levels
from kalux.filters.surfaces import Unmeasured

Floats = NDArray[np.floating[Any]]

_LIKELY: Final = np.float32(2.0)
"""Standard deviations of its events by which a bound may be too high."""

_ABOUT_WHITE: Final = np.float32(0.1)
"""How far below white, log intensity, a pixel lies that averaging may take down by as much again: the least threshold
of sensors. Pixels that frames have raised lie up to 0.05 below white until the next frame."""

_LEAST_HEARD: Final = np.float32(0.3)
"""Least standard deviation of the excess, where hardly any is expected, as far as neighbours are heard (K12)."""

_LEAST_GIVEN: Final = np.float32(0.05)
"""The same of what is given out: with 0.3, these pixels of 50 scenes have rms z of 0.42, with this 0.51 (K15)."""

_LEAST: Final = np.float32(1e-6)
"""Least scale of the excess, since it is divided by."""

_PEAK: Final = np.float32(8.4)
"""By how much a point of light is brighter than the mean of the four pixels diagonally beside it, over how much that of
the four straight beside it is: (1 - e^-4) / (e^-2 - e^-4), of a Gaussian of half a pixel on the middle of one. Lens and
the pixels' own aperture make no less than that of it (docs/equations.md, K17)."""


def tempered(unshown: Unshown, bound: Floats, prior: HighlightPrior) -> Unshown:
    """``unshown`` with less expected above bounds that lie beyond white themselves, by the prior on highlights (K6).

    Above the bound the exponential distribution of `Unshown` and the normal one of the prior fall at the rates 1 / e
    and d / s^2, d the bound's distance from white: together, e becomes 1 / (1 / e + d / s^2). Without the prior nothing
    changes.

    Parameters
    ----------
    bound
        (H, W) L.
    """
    if prior.scale2 == 0:
        return unshown
    beyond = np.maximum(bound.reshape(-1)[unshown.pixels] - np.float32(prior.white), np.float32(0.0))
    steeper = np.float32(1.0) + unshown.excess * (np.float32(prior.gain) * beyond) / np.float32(prior.scale2)
    return unshown._replace(excess=unshown.excess / steeper)


def lifted(log_intensity: Floats, variance: Floats, unshown: Unshown) -> tuple[Floats, Floats]:
    """L and P, (H, W), with unshown pixels raised to their expected levels, with the variances of these for K12."""
    level = log_intensity.copy()
    level.reshape(-1)[unshown.pixels] += unshown.excess
    return level, _spread(variance, unshown, _LEAST_HEARD)


def given_spread(variance: Floats, unshown: Unshown) -> Floats:
    """P, (H, W), with the variances of unshown pixels that are given out where their mean excess is known."""
    return _spread(variance, unshown, _LEAST_GIVEN)


def _spread(variance: Floats, unshown: Unshown, least: np.float32) -> Floats:
    """``variance`` with that of unshown pixels: of an exponential distribution, and of the noise of its bound."""
    spread = variance.copy()
    spread.reshape(-1)[unshown.pixels] = np.maximum(unshown.excess, least) ** 2 + unshown.noise
    return spread


def read_unshown(
    image: NDArray[np.float32],
    level: Floats,
    bound: Floats,
    unshown: Unshown,
    log_offset: float,
    prior: HighlightPrior,
) -> None:
    """Read out pixels that no frame has shown: the mean of their intensity, into ``image``. In place.

    Parameters
    ----------
    image
        (H, W) I.
    level
        (N,) L of these pixels of `lifted`, after averaging with their neighbours (K12).
    bound
        (H, W) L: averaging takes a pixel no farther below than its noise makes likely, nor below white.
    log_offset, prior
        I_0, and the prior on highlights (K6), applied to the events' part of their levels only.
    """
    least = bound.reshape(-1)[unshown.pixels]
    likely = np.maximum(least - _LIKELY * np.sqrt(unshown.noise), np.float32(prior.white))
    mean = np.maximum(level, np.minimum(least, likely)).astype(np.float32)
    # Of the intensity, not of its logarithm.
    mean += np.float32(0.5) * np.minimum(np.square(unshown.excess), unshown.excess)
    read_levels(mean, unshown.noise, tuple(np.float32(value) for value in prior), np.float32(log_offset))
    image.reshape(-1)[unshown.pixels] = mean


def keep_white(
    image: NDArray[np.float32],
    log_intensity: Floats,
    unmeasured: NDArray[np.int64],
    log_offset: float,
    prior: HighlightPrior,
) -> None:
    """Keep averaging (K12) from darkening pixels that the frames around clip: these stay about white. In place.

    Of the ``unmeasured`` pixels they are those with L about white or more: no event has taken them down since. The
    farther L is below white, the farther below it they may be.
    """
    scalars = np.float32(prior.white), np.float32(log_offset)
    _keep(log_intensity.reshape(-1), unmeasured, *scalars, image.reshape(-1))


@loop
def _keep(log_intensity, unmeasured, white, log_offset, image):  # type: ignore[no-untyped-def]
    of_white = exponential(white) - log_offset
    for pixel in unmeasured:
        i = np.uint64(pixel)
        level = np.float32(log_intensity[i])
        if level >= white:  # most of them
            image[i] = larger(image[i], of_white)
        elif level > white - ONE:
            below = white - level
            least = exponential(white - below - below * below / _ABOUT_WHITE) - log_offset
            image[i] = larger(image[i], least)


def calm_specks(
    image: NDArray[np.float32], variance: Floats, log_offset: float, unmeasured: Unmeasured
) -> None:
    """Keep pixels from shining brighter above those around them than a lens lets a point of light (K17). In place.

    Of the ``unmeasured`` pixels these are those whose four neighbours are such as well: all of them lie within a white
    of the frames, and each is known by its own events alone. They are never taken below the brightest of the four.

    Parameters
    ----------
    image
        (H, W) I.
    variance
        (H, W) P, the variance of log(I + I_0), by which neighbours may be too dark.
    log_offset
        I_0.
    unmeasured
        Pixels that no frame around measures.
    """
    if len(unmeasured.pixels) == 0:
        return
    planes = (
        plane.reshape(-1) for plane in (image, variance.astype(np.float32, copy=False), unmeasured.mask)
    )
    _calm(*planes, np.float32(log_offset), unmeasured.pixels, image.shape)


@loop
def _calm(image, variance, inside, log_offset, unmeasured, shape):  # type: ignore[no-untyped-def]
    """Take those of the ``unmeasured`` pixels of ``image`` down that are too bright."""
    height, width = shape
    calmed = empty(len(unmeasured), np.float32)
    for k in range(len(unmeasured)):
        pixel = unmeasured[k]
        calmed[k] = image[pixel]
        if pixel < width or pixel >= (height - 1) * width:
            continue
        brightest = larger(
            larger(image[pixel - width], image[pixel - 1]), larger(image[pixel + 1], image[pixel + width])
        )
        if image[pixel] <= brightest or not (
            inside[pixel - width] and inside[pixel - 1] and inside[pixel + 1] and inside[pixel + width]
        ):
            continue
        if pixel % width == 0 or pixel % width == width - 1:
            continue
        beside, doubt = np.float32(0.0), np.float32(0.0)
        for step in (-width, -1, 1, width):
            value = image[pixel + step]
            noise = (value + log_offset) * (value + log_offset) * variance[pixel + step]
            beside, doubt = beside + value, doubt + noise
        apart = np.float32(0.0)
        for step in (-width - 1, -width + 1, width - 1, width + 1):
            apart += image[pixel + step]
        quarter = np.float32(0.25)
        beside, ground = quarter * beside, quarter * smaller(apart, beside)
        most = ground + _PEAK * (beside - ground + quarter * np.sqrt(doubt))
        calmed[k] = smaller(image[pixel], larger(most, brightest))
    for k in range(len(unmeasured)):
        image[unmeasured[k]] = calmed[k]


def smoothed_unshown(
    smoothed: Floats,
    forward: tuple[Floats, Floats, Unshown | None],
    backward: tuple[Floats, Floats, Unshown | None],
) -> Unshown | None:
    """Pixels that no frame of the recording measures: both bounds hold. Raises ``smoothed``, (H, W) L, in place.

    ``forward`` and ``backward`` are L, P and the pixels that no frame has measured in that direction. The expected
    excess is by what both know (`of_both`). The level is the mean of both, but no less than either bound, lowered by
    its noise over the scale of the excess: that is the mean of a normal variable times an exponential density. By what
    the level rises, less is expected above it.
    """
    if forward[2] is None or backward[2] is None:
        return None
    memory = of_both(forward[2].memory, backward[2].memory)
    excess, doubt = memory.expected, memory.doubt
    scale = np.maximum(np.sqrt(excess**2 + doubt), _LEAST)
    noises = [
        unshown.noise[np.searchsorted(unshown.pixels, memory.pixels)] for unshown in (forward[2], backward[2])
    ]
    bounds = [
        level.reshape(-1)[memory.pixels] - noise / scale
        for (level, *_), noise in zip((forward, backward), noises, strict=True)
    ]
    mean = smoothed.reshape(-1)[memory.pixels]
    rise = np.maximum(np.maximum(*bounds) - mean, np.float32(0.0)).astype(np.float32)
    smoothed.reshape(-1)[memory.pixels] = mean + rise
    noise = np.where(rise > 0, np.where(bounds[0] > bounds[1], *noises), np.minimum(*noises))
    left = np.asarray(excess / (np.float32(1.0) + rise / scale), np.float32)
    return Unshown(memory.pixels, left, noise, doubt, memory)


def obey_bounds(
    smoothed: tuple[Floats, ...],
    bound: tuple[Floats, Floats, Unshown | None],
    known: tuple[Floats, Floats, Unshown | None],
) -> None:
    """Smoothed L, and variances of it, (H, W), where one direction of time knows no more than a ``bound``. In place.

    ``bound`` and ``known`` are L, P and the pixels that no frame has measured in that direction. A bound is no
    measurement: L and P are those of the direction that has one. Where its level lies below the bound, both are wrong:
    the level is raised towards the bound by its share of the sum of both variances.
    """
    bounds, _, unshown = bound
    level, variance, other = known
    if unshown is None:
        return
    only = np.ones(len(unshown.pixels), np.bool_)
    if other is not None:
        only = np.isin(unshown.pixels, other.pixels, assume_unique=True, invert=True)
    pixels, noise = unshown.pixels[only], unshown.noise[only]
    least, likely, doubt = (values.reshape(-1)[pixels] for values in (bounds, level, variance))
    raised = likely + np.maximum(least - likely, np.float32(0.0)) * doubt / (doubt + noise)
    for plane, value in zip(smoothed, (raised, doubt, doubt), strict=False):
        plane.reshape(-1)[pixels] = value
