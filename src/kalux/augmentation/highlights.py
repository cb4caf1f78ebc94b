"""Highlights that no frame has shown yet: clipped in every frame since the start (docs/equations.md, K15).

Of such a pixel the frames and its events give a bound. How far it is above white, the pixels around tell: light is
continuous, so that beside many pixels just below white little is far above it. And pixels tell that were like it and
have left saturation: where a frame first measures one, its distance from its bound is known. That is learned as the
recording goes on, and for every part of the image, since a window is brighter than the floor that it lights.
"""

from __future__ import annotations

import functools
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.bridge import UNMEASURED, UNSEEN, BridgedSegment, Latent, Told, UnshownMemory
from kalux.compiled import larger, loop, smaller

Floats = NDArray[np.floating[Any]]

_PART: Final = 8
"""Side of the parts of the image for which it is learned, pixels."""

_RANGE: Final = 8.0
"""Distance over which parts tell of each other, standard deviation of a normal curve, pixels. Of 4, 8 and 12 the excess
of clipped pixels of 48 simulated scenes is explained alike."""

_NEAR: Final = 0.2
"""Pixels that are darker than white by less, log intensity, are just below it: levels of 0.8 to 0.98."""

_WHOLE: Final = 0.1
"""Share of a neighbourhood that the whole image stands in for: where nothing else is near, its pixels count."""

_LEAST: Final = 1e-4
"""Share of a neighbourhood that is just below white at least: a division."""

_SOFT: Final = 0.05
"""Where the darkest pixel at a border is darker than white by so much, log intensity, the border is half hard."""

_PRIOR_PIXELS: Final = 10.0
"""Pixels that the prior counts for, beside those that tell: little beside the tens of a part that leave saturation."""

_PRIOR_TOLD: Final = 5.0
"""What these tell together, log intensity: 0.5 each, which is what clipped pixels of these scenes are above white."""

_PRIOR_OF_ALL: Final = 100.0
"""What is expected of pixels, log intensity, by whom half of the scale of the whole image is told. Many of them are one
object's: on 32 simulated scenes those that leave saturation were expected to tell 100 to 1400 altogether."""

_UNKNOWN_SCALE: Final = 3.0
"""Standard deviation of the mean excess, in units of it, where nobody has told: by the errors of 32 simulated scenes,
whose mean excess is half to ten times what frames make expect (docs/equations.md, K15)."""

_NOISE: Final = 3.0
"""Standard deviations of a frame's noise below its bound from which a pixel has left saturation by more than noise."""

_RAISED: Final = np.float32(1e-4)
"""By more than this, log intensity, and not by rounding, a frame raises a bound."""

_AROUND: Final = np.ones((3, 3), np.uint8)


class Shown(NamedTuple):
    """What a frame shows of highlights.

    Attributes
    ----------
    clipped
        (H, W) bool.
    darker
        (H, W) float32: how far below what is clipped a pixel is, log intensity; 0 where it is clipped, or masked.
    measured
        (H, W) bool: neither clipped nor masked.
    pitch
        Distance of pixels of one colour: 2 in a Bayer mosaic.
    """

    clipped: NDArray[np.bool_]
    darker: NDArray[np.float32]
    measured: NDArray[np.bool_]
    pitch: int = 1

    @property
    def just_below(self) -> NDArray[np.bool_]:
        """(H, W) pixels just below white."""
        return self.measured & (self.darker < _NEAR)


class Tail(NamedTuple):
    """How far highlights go on beyond white: ``share`` of what pixels just below it say, ``most`` at most (K15)."""

    share: float
    most: float


class Unshown(NamedTuple):
    """Pixels that no frame has measured yet.

    Attributes
    ----------
    pixels
        (N,) their places in the flattened image, ascending.
    excess
        (N,) float32: how far above their bounds they are expected, log intensity; the mean, and the standard deviation
        too, of an exponential distribution.
    noise
        (N,) float32: variance of the bounds, that of the events.
    doubt
        (N,) float32: variance of that mean, which is an expectation itself.
    """

    pixels: NDArray[np.int64]
    excess: NDArray[np.float32]
    noise: NDArray[np.float32]
    doubt: NDArray[np.float32]


def begin_unshown(first: Latent, shown: Shown, tail: Tail) -> UnshownMemory:
    """What the first frame does not show."""
    pixels = np.flatnonzero((first.variance >= UNMEASURED) & (first.variance < UNSEEN))
    bound = first.value.reshape(-1)[pixels].astype(np.float32)
    parts = tuple(-(-side // _PART) for side in first.value.shape)
    told = Told(np.zeros(parts), np.zeros(parts), np.zeros(parts), 0.0, 0.0)
    near, clipped = _counts(shown)
    excess = beyond_rims(shown, pixels, near / max(clipped, 1), tail)
    doubt = (np.float32(_UNKNOWN_SCALE) * excess) ** 2
    return UnshownMemory(pixels, bound, first.value.shape, excess, excess, doubt, told, near, clipped)


def follow_unshown(
    memory: UnshownMemory,
    following: Latent,
    shown: Shown,
    noise: Floats,
    net: Floats,
    moved: float,
    tail: Tail,
) -> UnshownMemory:
    """After the next frame.

    A pixel that is measured below its bound was at it: events are not exact.

    Parameters
    ----------
    following, shown
        The next frame.
    noise
        (N,) variance of what it shows of the pixels, by its own noise. Noise is what takes a pixel that does not move
        out of saturation; what deblurring adds is of pixels that do.
    net
        (H, W) what events add to L between the two.
    moved
        By so much, log intensity, a pixel gets darker if it is by more than a wrong event.
    """
    pixels = memory.pixels
    predicted = memory.bound + net.reshape(-1)[pixels].astype(np.float32)
    value, variance = following.value.reshape(-1)[pixels], following.variance.reshape(-1)[pixels]
    measured = variance < UNMEASURED
    bounded = np.where(variance < UNSEEN, np.maximum(predicted, value), predicted)
    left = measured & (value < memory.bound - _NOISE * np.sqrt(noise))
    gone = measured & (predicted < memory.bound - moved)
    distance = np.maximum(value - predicted, np.float32(0.0))
    told = _with_told(memory, left, gone, distance)
    near, clipped = (
        old + new for old, new in zip((memory.near, memory.clipped), _counts(shown), strict=True)
    )
    unknown, excess = pixels[~measured], memory.excess[~measured]
    raised = (bounded > predicted + _RAISED)[~measured]
    if raised.any():
        around = beyond_rims(shown, unknown[raised], near / max(clipped, 1), tail)
        excess[raised] = np.minimum(excess[raised], around)
    expected, doubt = _as_told(excess, unknown, memory.shape[1], told)
    return memory._replace(
        pixels=unknown,
        bound=bounded[~measured],
        excess=excess,
        expected=expected,
        doubt=doubt,
        told=told,
        near=near,
        clipped=clipped,
    )


def beyond_rims(shown: Shown, pixels: NDArray[np.int64], near: float, tail: Tail) -> NDArray[np.float32]:
    """How far above white clipped pixels are, from the pixels around them.

    If the density of log intensities goes on beyond white as it is below, and falls off exponentially, its scale is
    `_NEAR` times the clipped pixels over those just below white. Both are counted around every part of the image. That
    holds as far as borders of the clipped areas are hard, and one pixel from them: where the frame goes up to white
    slowly, it goes on slowly.

    Parameters
    ----------
    pixels
        (N,) which pixels, in the flattened image, ascending.
    near
        Pixels just below white over clipped ones, of the whole recording until now.
    """
    distance, rim, hardness = _rims(shown)
    of_parts = (_around(_sums(plane)) for plane in (shown.clipped, shown.just_below, rim, hardness))
    clipped, below, rims, hard = of_parts
    area = _area(shown.darker.shape)
    scale = _NEAR * (clipped + _WHOLE * area) / (below + (_WHOLE * near + _LEAST) * area)
    hard = np.where(rims > 0.0, hard / np.maximum(rims, 1e-300), 1.0)
    level = tail.most * -np.expm1(-tail.share * scale / tail.most) * hard
    inside = -np.expm1(-distance.reshape(-1)[pixels])
    excess: NDArray[np.float32] = _between(level.astype(np.float32), pixels, shown.darker.shape[1]) * inside
    return excess


def _counts(shown: Shown) -> tuple[int, int]:
    """Pixels just below white, and clipped ones."""
    return int(np.count_nonzero(shown.just_below)), int(np.count_nonzero(shown.clipped))


def _rims(shown: Shown) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
    """(H, W) each: distances to the nearest pixels that are not clipped, which pixels border on clipped ones, how hard.

    Distances are right to 2 %, hardness is 0 to 1.
    """
    shape, pitch = shown.clipped.shape, shown.pitch
    distance, hardness = np.empty(shape, np.float32), np.zeros(shape, np.float32)
    rim = np.zeros(shape, np.bool_)
    for row, column in np.ndindex(pitch, pitch):
        of_colour = np.s_[row::pitch, column::pitch]
        clipped = np.ascontiguousarray(shown.clipped[of_colour], np.uint8)
        steps = cv2.distanceTransform(clipped, cv2.DIST_L2, cv2.DIST_MASK_5)
        distance[of_colour] = pitch * np.minimum(
            steps, np.float32(sum(shape))
        )  # where all is clipped, it is anything
        beside = cv2.dilate(clipped, _AROUND).view(np.bool_) & shown.measured[of_colour]
        darkest = cv2.dilate(np.ascontiguousarray(shown.darker[of_colour]), _AROUND)[beside]
        rim[of_colour] = beside
        hardness[of_colour][beside] = darkest / (darkest + np.float32(_SOFT))
    return distance, rim, hardness


def _with_told(
    memory: UnshownMemory, left: NDArray[np.bool_], gone: NDArray[np.bool_], distance: Floats
) -> Told:
    """With what pixels tell: those that have ``left`` saturation, and those that events say are ``gone``."""
    told, shape = memory.told, memory.told.told.shape
    row, column = np.divmod(memory.pixels[left], memory.shape[1])
    part = row // _PART * shape[1] + column // _PART

    def more(weights: Floats | None) -> Floats:
        sums: Floats = np.bincount(part, weights, told.told.size).reshape(shape).astype(np.float64)
        return sums

    return Told(
        told.told + more(distance[left]),
        told.foretold + more(memory.excess[left]),
        told.tellers + more(None),
        told.gone + float(distance[gone].sum(dtype=np.float64)),
        told.gone_foretold + float(memory.excess[gone].sum(dtype=np.float64)),
    )


def _as_told(
    excess: NDArray[np.float32], pixels: NDArray[np.int64], width: int, told: Told
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """``excess``, (N,), as far as what pixels have told confirms it, and the variance of what nobody has told.

    First all is scaled by what the whole image tells, then by what those around tell of what is expected then.
    """
    known = told.gone_foretold / (told.gone_foretold + _PRIOR_OF_ALL)
    of_all = ((told.gone + _PRIOR_TOLD) / (told.gone_foretold + _PRIOR_TOLD)) ** known
    here, foretold, tellers = (_around(values) for values in told[:3])
    foretold *= of_all
    factor = (here + _PRIOR_TOLD) / (foretold + _PRIOR_TOLD)
    more = np.maximum(here - foretold, 0.0) / (tellers + _PRIOR_PIXELS)
    untold = _UNKNOWN_SCALE**2 * _PRIOR_TOLD / (foretold + _PRIOR_TOLD)
    times, plus, left = (
        _between(values.astype(np.float32), pixels, width) for values in (factor, more, untold)
    )
    scaled = np.float32(of_all) * excess
    return np.minimum(times * scaled, scaled + plus), left * scaled**2


def expected_excess(memory: UnshownMemory, variance: Floats, initial_variance: float) -> Unshown | None:
    """How far pixels are expected above their bounds; None: there are none.

    Parameters
    ----------
    memory
        Which pixels, and what is expected of them.
    variance, initial_variance
        (H, W) P, and what it began as: what has come to it is noise of the events.
    """
    if len(memory.pixels) == 0:
        return None
    noise = np.empty(len(memory.pixels), np.float32)
    _grown(memory.pixels, variance.reshape(-1), np.float32(initial_variance), noise)
    return Unshown(memory.pixels, memory.expected, noise, memory.doubt)


@loop
def _grown(pixels, variance, initial_variance, noise):  # type: ignore[no-untyped-def]
    """What has come to the variance."""
    for i in range(len(pixels)):
        noise[i] = larger(np.float32(variance[pixels[i]]) - initial_variance, np.float32(0.0))


def above_frames(segment: BridgedSegment, pixels: NDArray[np.int64], bound: Floats) -> Floats:
    """(N,) by how much ``bound``, of ``pixels`` at the segment's start, is more than the frames around say themselves.

    That is how far it can be too high: what the frame at the start says needs no events, what the one at the end says
    (`BridgedSegment.floor`) none from before. Infinite where one of them is masked.
    """
    variances = segment.forward_variance, segment.backward_variance
    seen = np.maximum(*(plane.reshape(-1)[pixels] for plane in variances)) < UNSEEN
    least = np.where(seen, segment.augmented.reshape(-1)[pixels], -np.inf)
    if segment.floor is not None:
        least = np.maximum(least, segment.floor.reshape(-1)[pixels])
    return np.maximum(bound - least, 0.0)


def _between(parts: NDArray[np.float32], pixels: NDArray[np.int64], width: int) -> NDArray[np.float32]:
    """(N,) values of the ``parts`` at pixels, linear between their middles."""
    values = np.empty(len(pixels), np.float32)
    _at_pixels(pixels, width, parts, values)
    return values


@loop
def _at_pixels(pixels, width, parts, values):  # type: ignore[no-untyped-def]
    one, zero = np.float32(1.0), np.float32(0.0)
    last_row, last_column = parts.shape[0] - 1, parts.shape[1] - 1
    for i in range(len(pixels)):
        row, column = divmod(pixels[i], width)
        y = larger((np.float32(row) + np.float32(0.5)) / np.float32(_PART) - np.float32(0.5), zero)
        x = larger((np.float32(column) + np.float32(0.5)) / np.float32(_PART) - np.float32(0.5), zero)
        top, left = smaller(np.int64(y), last_row), smaller(np.int64(x), last_column)
        below, beside = smaller(top + 1, last_row), smaller(left + 1, last_column)
        down, right = y - np.float32(top), x - np.float32(left)
        upper = parts[top, left] * (one - right) + parts[top, beside] * right
        lower = parts[below, left] * (one - right) + parts[below, beside] * right
        values[i] = upper * (one - down) + lower * down


def _sums(values: NDArray[Any]) -> Floats:
    """Over the pixels of every part."""
    height, width = values.shape
    below, right = -height % _PART, -width % _PART
    plane: NDArray[Any] = values.astype(np.float32, copy=False)
    if below or right:
        plane = cv2.copyMakeBorder(plane, 0, below, 0, right, cv2.BORDER_CONSTANT, value=0.0)
    size = (plane.shape[1] // _PART, plane.shape[0] // _PART)
    means = cv2.resize(plane, size, interpolation=cv2.INTER_AREA)
    return np.asarray(means, np.float64) * (_PART * _PART)


@functools.cache
def _area(shape: tuple[int, int]) -> Floats:
    """Of every part, the pixels around. Not to be changed."""
    return _around(_sums(np.ones(shape, np.float32)))


def _around(parts: Floats) -> Floats:
    """Of every part, the sum of those around, weighted by their nearness.

    Not as a product of matrices: of large images BLAS has other last bits on another number of threads.
    """
    below, beside = (_nearness(n) for n in parts.shape)
    near = cv2.sepFilter2D(parts, cv2.CV_64F, beside, below, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(near, np.float64)


@functools.cache
def _nearness(parts: int) -> Floats:
    """Weights of parts to both sides of one, where there are so many: all that double precision tells from 0."""
    reach = min(parts, 39)
    distance = _PART * np.arange(1 - reach, reach)
    nearness: Floats = np.exp(-0.5 * (distance / _RANGE) ** 2)
    return nearness
