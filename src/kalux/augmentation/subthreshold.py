"""Changes below the threshold: how much silent pixels, those without events, change from frame to frame.

For the variance of images (docs/equations.md, K11).
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux import memory
from kalux.augmentation.bridge import UNMEASURED, BridgedSegment, Latent
from kalux.compiled import empty, larger, loop, smaller

Array = NDArray[np.floating[Any]]

UNKNOWN_CHANGE: Final = 0.1
"""Mean square change of a silent pixel, in c^2, where it is not estimated: that of eleven simulated scenes under a
moving camera."""

BLACK_CHANGE: Final = 0.4
"""The same where a frame is black and does not measure the pixel, so that the change may be large: the variance
half-way to such a frame is then that of a moving pixel, as on the same scenes."""

_ACTIVE: Final = 0.62
"""Mean square change of a silent pixel, in c^2, where all pixels around have events: by the share that has, those of 87
simulated scenes lie on a straight line (docs/equations.md, K11)."""

_STILL: Final = 0.03
"""In addition, also where none has, if `_MOVING` of the whole image has; of smooth surfaces that move."""

_MOVING: Final = 0.25
"""Share of the pixels of an image of which more have events in most of these scenes. Where fewer have, `_STILL` counts
as much less."""

_LEAST_MOVING: Final = 0.1
"""The least that counts of `_STILL`: light may change slowly where nothing moves."""

_AROUND: Final = 9
"""Side of the window in which pixels with events are counted, pixels."""

_LEAST_INFORMATION: Final = 25.0
"""Information from which a correlation is estimated, in pixels without noise."""

_LATEST: Final = 8
"""Intervals over which is averaged how silent pixels change: two of them, at 10 or 20 frames/s of a camera that shakes,
may be unlike the next ones."""

_TURNING: Final = 4.0
"""Units of `half_way` by which less of this interval's change counts, and more of that of the latest: a random walk, at
1/4, is the first whose middle does not depend on where it ends."""

_BLOCK: Final = 64
"""Pixels in a block: few enough that intermediate values stay in the first-level cache."""

_WINDOW: Final = 5
"""Side of the window of the mean, pixels. 3 to 9 predict the errors of these scenes about equally well."""


def usual_change(active: Array, threshold2: float) -> Array:
    """Mean square change of silent pixels by how many around them have events: (H, W) float32, log intensity^2.

    Parameters
    ----------
    active
        (H, W) probability that a pixel has an event that is signal.
    threshold2
        c^2.
    """
    active = np.asarray(active, np.float32)
    moving = min(max(float(active.mean(dtype=np.float64)) / _MOVING, _LEAST_MOVING), 1.0)
    share = mean_around(active)
    share *= np.float32(_ACTIVE * threshold2)
    share += np.float32(moving * _STILL * threshold2)
    return share


def silent_change(
    segment: BridgedSegment, active: Array, quantisation_variance: float, threshold2: float
) -> Array:
    """Mean square change of silent pixels from one frame to the next, around every pixel: (H, W), log intensity^2.

    The mean is over the pixels of 5 x 5 that have no event in the segment and are measured by both frames, of their
    squared changes by the frames (``segment.slope``), at most c^2, since larger changes cause events, less the variance
    of the frames' noise. As far as noise hides a pixel's change, and where no such pixel is near, what is usual among
    so many events takes its place.

    Parameters
    ----------
    segment
        From `bridge`.
    active
        As of `usual_change`.
    quantisation_variance
        As in `BridgeNoise`.
    threshold2
        c^2.
    """
    assert segment.events is not None
    shape = segment.slope.shape
    change = memory.empty(shape)
    mean, silent = memory.empty(shape), memory.empty(shape, np.uint8)
    seconds = np.float32((segment.end - segment.start) * 1e-6)
    q0, most = np.float32(quantisation_variance), np.float32(threshold2)
    variances = segment.forward_variance, segment.backward_variance
    usual = usual_change(active, threshold2)
    given = tuple(plane.reshape(-1) for plane in (segment.slope, *variances, segment.events, usual))
    _squared_changes(given, seconds, q0, most, change.reshape(-1), silent.reshape(-1))
    _mean(_sum_around(change), _sum_around(silent), usual, mean)
    return mean


def follow_silent(
    segment: BridgedSegment, first: Latent, change: Array, quantisation_variance: float, threshold2: float
) -> BridgedSegment:
    """The segment in which silent pixels follow the frames by as much as they change, where `bridge` takes q_0 (K1).

    Parameters
    ----------
    segment, quantisation_variance
        As of `silent_change`.
    first
        The frame at the segment's start.
    change
        From `silent_change`.
    threshold2
        c^2.

    Returns
    -------
    It has ``untold``, q_0 of pixels with events and of those that a frame does not measure. The segment itself where
    q_0 is 0, so that nothing follows the frames.
    """
    assert segment.events is not None
    if quantisation_variance == 0:
        return segment
    shape = segment.slope.shape
    untold, slope, augmented = memory.empty(shape), memory.empty(shape), memory.empty(shape)
    least = np.float32(_LEAST_MOVING * _STILL * threshold2)
    scalars = np.float32(quantisation_variance), least, np.float32((segment.end - segment.start) * 1e-6)
    planes = segment.slope, segment.augmented, first.value, first.variance, segment.backward_variance
    given = tuple(plane.reshape(-1) for plane in (*planes, segment.events, change))
    _follow_silent(given, *scalars, untold.reshape(-1), slope.reshape(-1), augmented.reshape(-1))
    return segment._replace(slope=slope, augmented=augmented, untold=untold)


def told_by_none(untold: Array | None, quantisation_variance: float, shape: tuple[int, ...]) -> Array:
    """Variance of what no event has told of the change between two frames: ``untold`` if it is known, else q_0 (K1)."""
    return np.full(shape, quantisation_variance, np.float32) if untold is None else untold


@loop
def _follow_silent(given, q0, least, seconds, untold, new_slope, new_augmented):  # type: ignore[no-untyped-def]
    """`follow_silent` in blocks and with few arrays in a loop: vector code."""
    slope, augmented, value, forward, backward, events, change = given
    zero, unmeasured = np.float32(0.0), np.float32(UNMEASURED)
    noise, gain, silent = empty(_BLOCK, np.float32), empty(_BLOCK, np.float32), empty(_BLOCK, np.bool_)
    for first in range(np.uint64(0), np.uint64(len(untold)), np.uint64(_BLOCK)):
        pixels = range(smaller(np.uint64(len(untold)) - first, np.uint64(_BLOCK)))
        for k in pixels:
            noise[k] = np.float32(forward[first + k]) + np.float32(backward[first + k])
        for k in pixels:
            silent[k] = (events[first + k] == zero) & (noise[k] < unmeasured)
        for k in pixels:
            untold[first + k] = larger(change[first + k], least) if silent[k] else q0
        for k in pixels:
            mismatch = np.float32(slope[first + k]) * seconds / q0
            gain[k] = mismatch * ((noise[k] + q0) / (noise[k] + untold[first + k]))
        for k in pixels:
            followed = gain[k] * untold[first + k] / seconds
            new_slope[first + k] = followed if silent[k] else np.float32(slope[first + k])
        for k in pixels:
            gain[k] *= np.float32(forward[first + k])
        for k in pixels:
            level = np.float32(value[first + k]) + gain[k]
            new_augmented[first + k] = level if silent[k] else np.float32(augmented[first + k])


def turns(on: Array, off: Array) -> float:
    """How often the intensity of a pixel with events reverses between two frames: twice for every pair of on and off.

    Parameters
    ----------
    on, off
        (H, W) events between them.
    """
    pairs, events = _pairs(on.reshape(-1), off.reshape(-1))
    return float(2.0 * pairs / max(events, 1))


@loop
def _pairs(on, off):  # type: ignore[no-untyped-def]
    pairs, active = 0.0, 0
    for i in range(np.uint64(len(on))):
        pairs += smaller(on[i], off[i])
        active += on[i] + off[i] > 0
    return pairs, active


class Correlation(NamedTuple):
    """Sums over pixels that are silent in two successive intervals (docs/equations.md, K11).

    Attributes
    ----------
    products, squares
        Of their changes by the frames, both less what the frames' noise makes of them.
    noise
        What the frames' noise makes of the squares.
    """

    products: float
    squares: float
    noise: float


def correlation(
    before: Array, segment: BridgedSegment, quantisation_variance: float, threshold2: float
) -> tuple[Correlation, Array]:
    """How the changes of silent pixels go together in this interval and the last.

    Parameters
    ----------
    before
        From the interval before: (H, W) change of its silent pixels, NaN of others.
    segment
        From `bridge`.
    quantisation_variance
        As in `BridgeNoise`.
    threshold2
        c^2.

    Returns
    -------
    The sums; and (H, W) the changes, as ``before`` is for the interval after.
    """
    assert segment.events is not None
    change = np.empty_like(before)
    seconds, q0 = np.float32((segment.end - segment.start) * 1e-6), np.float32(quantisation_variance)
    planes = (
        before,
        segment.slope,
        segment.forward_variance,
        segment.backward_variance,
        segment.events,
        change,
    )
    sums = _correlation_sums(
        seconds, q0, np.float32(threshold2**0.5), *(plane.reshape(-1) for plane in planes)
    )
    return Correlation(*sums), change


def half_way(told: Correlation, threshold2: float) -> float:
    """Variance of silent pixels half-way between two frames about the mean of both, 0 to 3/4.

    It is in units of the mean square change from one frame to the next. If the changes of successive intervals are
    correlated, intensities move along straight lines; if they are anti-correlated, they have reversed within the
    intervals, too. One correlation is taken for the whole image.

    Parameters
    ----------
    told
        From `correlation`.
    threshold2
        c^2.
    """
    both, squares, noise = told
    usual = _LEAST_INFORMATION * UNKNOWN_CHANGE * threshold2
    # Shrunk towards 0 where changes are less than the noise, whose variance is an estimate.
    goes_on = both * max(squares, 0.0) / (squares**2 + noise**2 + usual**2)
    return 0.5 / (1.0 + min(max(goes_on, -0.5), 1.0)) - 0.25


class Usual(NamedTuple):
    """What the latest intervals tell of silent pixels: means over up to `_LATEST`, then with as much of each new one.

    Attributes
    ----------
    intervals
        How many there were.
    change
        (H, W): `silent_change`.
    told
        `correlation`.
    """

    intervals: int
    change: Array
    told: Correlation

    def with_interval(self, change: Array, told: Correlation) -> Usual:
        """With one more interval. The first is no pair: ``told`` says nothing then."""
        if self.intervals == 0:
            return Usual(1, change, self.told)
        pairs = self.intervals
        mean = self.change + (change - self.change) * np.float32(1.0 / min(pairs + 1, _LATEST))
        sums = (old + (new - old) / min(pairs, _LATEST) for old, new in zip(self.told, told, strict=True))
        return Usual(pairs + 1, mean, Correlation(*sums))

    def mixed(self, change: Array, half_way: float) -> Array:
        """(H, W) the mean square change that `half_way` is in units of, given that of this interval.

        How far a light that goes straight on is off the middle depends on how far it goes now. How far one is off that
        turns back does not depend on where the two frames happen to find it.
        """
        share = np.float32(min(_TURNING * half_way, 1.0))
        return change + share * (self.change - change)


def nothing_usual(shape: tuple[int, int]) -> Usual:
    """What is told by no interval."""
    return Usual(0, np.zeros(shape, np.float32), Correlation(0.0, 0.0, 0.0))


@loop
def _correlation_sums(seconds, q0, most, before, slope, forward, backward, events, change):  # type: ignore[no-untyped-def]
    """Sums over pixels silent in two intervals: products of their changes, squares, both less noise, and the noise."""
    both, squares, of_noise = 0.0, 0.0, 0.0
    for i in range(np.uint64(len(change))):
        noise = np.float32(forward[i]) + np.float32(backward[i])
        share = q0 / (noise + q0)
        moved = smaller(larger(np.float32(slope[i]) * seconds / share, -most), most)
        silent = noise < np.float32(UNMEASURED) and events[i] == np.float32(0.0)
        change[i] = moved if silent else np.float32(np.nan)
        if silent and before[i] == before[i]:
            weight = share * share
            both += weight * (before[i] * moved + np.float32(forward[i]))  # the frame between is in both
            squares += weight * ((before[i] * before[i] + moved * moved) / np.float32(2.0) - noise)
            of_noise += weight * noise
    return both, squares, of_noise


def add_missed_change(
    grown: Array,
    segment: BridgedSegment,
    second: Latent,
    counts: tuple[Array, Array],
    change: Array,
    quantisation_variance: float,
) -> None:
    """Add to ``grown``, (H, W), the part of silent pixels' changes that the bridge does not follow. In place.

    Its slope follows the share m / V of the mismatch (`follow_silent`). P grows by the mean square change times the
    square of the other share (docs/equations.md, K11).

    Parameters
    ----------
    second
        The frame after. Pixels that it or the one before does not measure have P of their own (K10).
    counts
        (H, W) on and off events between the frames.
    change
        From `silent_change`.
    quantisation_variance
        As in `BridgeNoise`; counts where the segment has no ``untold``.
    """
    untold = told_by_none(segment.untold, quantisation_variance, grown.shape)
    planes = (
        segment.forward_variance,
        segment.backward_variance,
        second.variance,
        *counts,
        change,
        untold,
        grown,
    )
    _add_missed_change(*(plane.reshape(-1) for plane in planes))


@loop
def _add_missed_change(forward, backward, after, on, off, change, untold, grown):  # type: ignore[no-untyped-def]
    zero, unmeasured = np.float32(0.0), np.float32(UNMEASURED)
    for i in range(np.uint64(len(grown))):
        noise = np.float32(forward[i]) + np.float32(backward[i])
        missed = noise / (noise + untold[i])
        measured = larger(np.float32(forward[i]), np.float32(after[i])) < unmeasured
        lost = np.float32(change[i]) * missed * missed
        grown[i] += lost if measured and on[i] + off[i] == zero else zero


@loop
def _squared_changes(given, seconds, q0, most, change, silent):  # type: ignore[no-untyped-def]
    """Of silent pixels (0 of others): squared change less noise, and what is usual of the share that noise hides.

    Blocks of flat planes and few arrays in a loop: vector code.
    """
    slope, forward, backward, events, usual = given
    zero, one, unmeasured = np.float32(0.0), np.float32(1.0), np.float32(UNMEASURED)
    noise, share, is_silent = (
        empty(_BLOCK, np.float32),
        empty(_BLOCK, np.float32),
        empty(_BLOCK, np.float32),
    )
    for first in range(np.uint64(0), np.uint64(len(slope)), np.uint64(_BLOCK)):
        pixels = range(smaller(np.uint64(len(slope)) - first, np.uint64(_BLOCK)))
        for k in pixels:
            noise[k] = np.float32(forward[first + k]) + np.float32(backward[first + k])
        for k in pixels:
            is_silent[k] = one if noise[k] < unmeasured and events[first + k] == zero else zero
        for k in pixels:
            # The slope takes the share q0 / V of the mismatch (K1), and so of the frames' noise in it.
            taken = q0 / (noise[k] + q0)
            share[k] = taken * taken
        for k in pixels:
            moved = np.float32(slope[first + k]) * seconds
            of_noise = smaller(noise[k], unmeasured) * share[k]
            change[first + k] = is_silent[k] * (smaller(moved * moved, most) - of_noise)
        for k in pixels:
            change[first + k] += is_silent[k] * (one - share[k]) * usual[first + k]
        for k in pixels:
            silent[first + k] = np.uint8(is_silent[k])


@loop
def _mean(total, count, usual, mean):  # type: ignore[no-untyped-def]
    zero, one = np.float32(0.0), np.float32(1.0)
    for row in range(total.shape[0]):
        for column in range(total.shape[1]):
            i = row, column
            told = larger(total[i], zero) / larger(np.float32(count[i]), one)
            mean[i] = told if count[i] > 0 else usual[i]


def mean_around(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means over 9 x 9 pixels, of those that there are."""
    size = (_AROUND, _AROUND)
    sums = memory.empty(values.shape)
    cv2.boxFilter(values, -1, size, sums, normalize=False, borderType=cv2.BORDER_CONSTANT)
    height, width = (_within(length) for length in values.shape)
    sums /= height[:, np.newaxis] * width
    return np.asarray(sums)


def _within(length: int) -> NDArray[np.float32]:
    """Of every pixel of a row, how many of those around it lie within the image."""
    place, reach = np.arange(length), _AROUND // 2
    return (np.minimum(place, reach) + np.minimum(length - 1 - place, reach) + 1).astype(np.float32)


def _sum_around(values: NDArray[Any]) -> NDArray[Any]:
    """Sums over 5 x 5 pixels, in the same type; 0 beyond the border."""
    size = (_WINDOW, _WINDOW)
    sums = memory.empty(values.shape, values.dtype)
    return np.asarray(cv2.boxFilter(values, -1, size, sums, normalize=False, borderType=cv2.BORDER_CONSTANT))
