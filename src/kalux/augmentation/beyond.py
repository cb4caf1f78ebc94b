"""How far clipped pixels lie beyond their bounds, of those that a frame has measured before (docs/equations.md, K7).

A pixel that rises past white between two frames without an event, or with fewer than its light asks for, is not at
white but some way above it: by less than a threshold, and the less, the less the pixels around it change unheard, and
the less is expected beyond white at all. From frame to frame it may rise on, as long as no event comes. One that does
come tells of a part of what has been added before.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.bridge import MASKED, UNMEASURED, BridgedSegment, Latent

Floats = NDArray[np.floating[Any]]

_LEAST_CHANGE: Final = np.float32(1e-6)
"""Least variance of an unheard change, log intensity^2, since it is divided by its root."""

_LEAST_SCALE: Final = np.float32(1e-3)
"""Least scale of what is expected beyond white, log intensity, since it is divided by."""

_TOLD: Final = np.float32(0.5)
"""Share of what was unheard that the next event replaces; the other half is what the last one had left untold, and
stays (docs/equations.md, K7)."""


class Beyond(NamedTuple):
    """At a frame: the pixels that it clips and that one before has measured.

    Attributes
    ----------
    pixels
        (N,) their places in the flattened image.
    level
        (N,) float32: where events have led L, as far as later ones do not tell it again.
    unheard
        (N,) float32: how far above that it is, by the bounds.
    variance
        (N,) float32: of the change that no event has told since a frame measured the pixel, log intensity^2.
    bound
        (N,) float32: of L; the highest since the pixel's last event, as exposures may differ.
    """

    pixels: NDArray[np.int64]
    level: NDArray[np.float32]
    unheard: NDArray[np.float32]
    variance: NDArray[np.float32]
    bound: NDArray[np.float32]

    def where(self, kept: NDArray[np.bool_]) -> Beyond:
        """Those of ``kept``, (N,)."""
        level, unheard, variance, bound = (plane[kept] for plane in self[1:])
        return Beyond(self.pixels[kept], level, unheard, variance, bound)

    def and_of(self, others: Beyond) -> Beyond:
        """These and others."""
        return Beyond(
            np.concatenate((self.pixels, others.pixels)),
            np.concatenate((self.level, others.level)),
            np.concatenate((self.unheard, others.unheard)),
            np.concatenate((self.variance, others.variance)),
            np.concatenate((self.bound, others.bound)),
        )


def nothing_beyond() -> Beyond:
    """No pixel is clipped that has been measured."""
    nothing = np.empty(0, np.float32)
    return Beyond(np.empty(0, np.int64), nothing, nothing, nothing, nothing)


def mean_beyond(short: Floats, variance: Floats, scale: Floats) -> Floats:
    """By how much L is above a bound on average, log intensity (docs/equations.md, K7).

    Parameters
    ----------
    short
        By how much the bound is above the level to which events lead.
    variance
        Of the change that no event has told.
    scale
        Of the exponential distribution that L has above the bound, by what else is known.

    Returns
    -------
    The mean of a normal distribution about that level times the exponential one, cut off at the bound, less the bound.
    float64.
    """
    from scipy.special import erfcx  # a tenth of a second, which what never clips need not wait for

    deviation = np.sqrt(np.asarray(variance, np.float64))
    cut = short / deviation + deviation / scale
    hazard = np.sqrt(2.0 / np.pi) / erfcx(cut / np.sqrt(2.0))
    return np.asarray(deviation * (hazard - cut))


def follow_beyond(
    before: Beyond,
    segment: BridgedSegment,
    first: Latent,
    second: Latent,
    change: Floats,
    quantisation_variance: float,
    expected: Callable[[NDArray[np.int64]], Floats],
) -> tuple[BridgedSegment, Beyond]:
    """The segment in which L goes on beyond the bounds at its end, and the pixels of which later frames say more.

    Parameters
    ----------
    before
        Of the frame at the segment's start.
    segment
        From `bridge`: it leads L to the bounds, or beyond them where events do.
    first, second
        The frames at its start and its end.
    change
        (H, W) mean square change of silent pixels around each (`subthreshold.silent_change`).
    quantisation_variance
        q_0, log intensity^2: no more is unheard.
    expected
        Of pixels, (N,), how far above white they are expected (`highlights.expected_of_shown`); called once, if at all.
    """
    bounded = ((second.variance >= UNMEASURED) & (second.variance < MASKED)).reshape(-1)
    rising = np.flatnonzero((first.variance.reshape(-1) < UNMEASURED) & bounded)
    kept = bounded[before.pixels]
    if quantisation_variance == 0 or (len(rising) == 0 and not kept.any()):
        return segment, nothing_beyond()

    assert segment.net is not None
    assert segment.events is not None
    staying = before.where(kept)
    scale = np.maximum(expected(np.concatenate((rising, staying.pixels))), _LEAST_SCALE)
    seconds = np.float32((segment.end - segment.start) * 1e-6)
    slope = segment.slope.copy()
    flat = slope.reshape(-1)
    planes = segment.augmented, segment.net, segment.events, second.value, change
    augmented, net, events, bound, changes = (plane.reshape(-1) for plane in planes)

    def unheard_at(pixels: NDArray[np.int64]) -> NDArray[np.float32]:
        return np.clip(changes[pixels], _LEAST_CHANGE, quantisation_variance).astype(np.float32)

    # What rises has been led to its bound, and no further, where events fall short of it.
    told, short = augmented[rising] + net[rising], flat[rising] * seconds
    variance = unheard_at(rising)
    more = np.where(short > 0, mean_beyond(short, variance, scale[: len(rising)]), 0.0)
    flat[rising] += (more / seconds).astype(np.float32)
    untold = np.where(short > 0, short + more, 0.0)
    risen = Beyond(
        rising,
        told.astype(np.float32),
        untold.astype(np.float32),
        variance,
        bound[rising].astype(np.float32),
    )

    stayed, grown = _follow_staying(
        staying,
        net[staying.pixels],
        events[staying.pixels] > 0,
        bound[staying.pixels],
        np.minimum(staying.variance + unheard_at(staying.pixels), np.float32(quantisation_variance)),
        scale[len(rising) :],
    )
    flat[staying.pixels] += grown / seconds
    return segment._replace(slope=slope), risen.and_of(stayed)


def _follow_staying(
    before: Beyond, net: Floats, heard: NDArray[np.bool_], bound: Floats, variance: Floats, scale: Floats
) -> tuple[Beyond, NDArray[np.float32]]:
    """Pixels that the frames at both ends clip, and by how much what is unheard of them has grown.

    Parameters
    ----------
    before
        Of the segment's start.
    net
        (N,) what events add to L.
    heard
        (N,) which pixels have an event.
    bound
        (N,) of L, at the end.
    variance
        (N,) of the change that no event has told, at the end.
    scale
        (N,) as of `mean_beyond`.
    """
    # The floor at the segment's start (K7) raises what events lead below the bound.
    raised = np.maximum(bound - net - before.level - before.unheard, 0.0)
    kept = np.where(heard, _TOLD * before.unheard, before.unheard)
    highest = np.where(heard, bound, np.maximum(bound, before.bound))
    level = before.level + (before.unheard - kept) + raised + net
    unheard = np.maximum(highest + mean_beyond(highest - level, variance, scale) - level, 0.0)
    unheard = np.where(heard, np.minimum(unheard, kept), unheard)
    after = Beyond(
        before.pixels, *(plane.astype(np.float32) for plane in (level, unheard, variance, highest))
    )
    return after, (unheard - kept).astype(np.float32)
