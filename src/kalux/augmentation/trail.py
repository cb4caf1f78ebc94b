"""By how much events trail the light: what a pixel that has just had an event has gone on since.

Between two events nothing is told, but a brightness that moves seldom stops at a threshold: a time a after its newest
event a pixel is on average

    f(a) = h c 2 x / (1 + x^2),   x = a / s,

beyond the level of that event, in its direction (c: on or off threshold; docs/equations.md, K14). The time s follows
the recording: 1.1 times the mean interval between two events of one polarity at a pixel.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.compiled import (
    MICROSECOND32,
    WEIGHT_UNIT,
    apart,
    event_column,
    event_is_on,
    event_row,
    event_weight,
    event_words,
)
from kalux.events import EventArray

FloatArray = NDArray[np.float32]

NO_EVENT: Final = -(1 << 62)
"""Code of a pixel that has had no event."""

SCALE: Final = 1.1
"""s over the mean interval. Of eleven simulated and three real recordings, whose means are 6 to 24 ms, the s that
explains the changes between frames best is 0.5 to 1.3 of the mean."""

LONGEST: Final = 100_000
"""us: two events further apart are a pause rather than an interval."""

USUAL: Final = 10_000
"""us: mean interval that is taken before there are any; the middle of those recordings."""

_USUAL_WEIGHT: Final = 100.0  # intervals
_KEPT: Final = 0.5  # of the intervals, from frame to frame: speeds change within some frames


class Followed(NamedTuple):
    """What is known of every pixel's newest event at some moment, and of the intervals up to it.

    Attributes
    ----------
    newest
        (H, W) int64: 2 t + p of the newest event (t in us), `NO_EVENT` before the first.
    span, intervals
        Sum (us) and number of the intervals that count.
    """

    newest: NDArray[np.int64]
    span: float
    intervals: float

    @property
    def scale(self) -> float:
        """s, in seconds."""
        mean = (self.span + USUAL * _USUAL_WEIGHT) / (self.intervals + _USUAL_WEIGHT)
        return SCALE * mean * 1e-6


class Trail(NamedTuple):
    """f of one segment.

    Attributes
    ----------
    start
        (H, W) f at the start of the segment, where L^A is a frame's; in the lead-in to the first frame, at its end.
    polarity
        (H, W) int8: that of the newest event there, 1 or -1; 0: none so far.
    scale
        s, seconds.
    on, off
        h c of either polarity; 0 turns it off.
    end
        Backward in time, where ``on`` and ``off`` are 0: f at the end of the segment, which only its last state holds;
        at other times f is added later. None: forward.
    """

    start: FloatArray
    polarity: NDArray[np.int8]
    scale: float
    on: float
    off: float
    end: FloatArray | None = None

    @property
    def heights(self) -> tuple[np.float32, np.float32, np.float32]:
        """s and h c of either polarity, as the compiled loops take them."""
        return np.float32(self.scale), np.float32(self.on), np.float32(self.off)


class FrameTrail(NamedTuple):
    """f at a frame's middle, (H, W) each, forward in time, for the backward filter.

    Attributes
    ----------
    before, after
        With the s of the interval before the frame, and with that of the interval after it.
    """

    before: FloatArray
    after: FloatArray


def nothing_followed(shape: tuple[int, int]) -> Followed:
    """Before the first event."""
    return Followed(np.full(shape, NO_EVENT, np.int64), 0.0, 0.0)


def follow(
    chunks: Iterable[EventArray], before: Followed, start: int, end: int
) -> tuple[FloatArray, FloatArray, Followed]:
    """Sums of the weights of on and of off events of every pixel, (H, W) each, and what is known after them.

    ``chunks`` are the events with ``start`` < t <= ``end`` (us) in time order, and ``before`` is what was known before.
    Intervals are taken from the last quarter of that time: fewer would do, and all of them cost.
    """
    shape = before.newest.shape
    counts, newest = apart(2, (before.newest.size,)), before.newest.copy()
    counts[:] = 0
    planes = counts, newest.reshape(-1), np.uint64(shape[1])
    span, intervals = _KEPT * before.span, _KEPT * before.intervals
    late = end - (end - start) // 4
    for chunk in chunks:
        more, number = _follow(event_words(chunk), *planes, late)
        span, intervals = span + more, intervals + number
    off, on = counts.reshape(2, *shape)
    return on, off, Followed(newest, span, intervals)


@nb.njit(cache=True, nogil=True)
def _follow(words, counts, newest, width, late):  # type: ignore[no-untyped-def]
    span, count = np.int64(0), np.int64(0)
    for i in range(len(words)):
        word = words[i, 1]
        at = event_row(word) * width + event_column(word)
        is_on = np.uint64(event_is_on(word))
        code = 2 * words[i, 0] + np.int64(is_on)
        if words[i, 0] > late:
            difference = code - newest[at]  # even where the polarities are the same
            counted = np.int64((difference & 1 == 0) & (difference < 2 * LONGEST))
            span += (difference >> 1) * counted
            count += counted
        counts[is_on, at] += event_weight(word, WEIGHT_UNIT)
        newest[at] = code
    return span, count


def trail_at(newest: NDArray[np.int64], t: int, trail: tuple[float, float, float]) -> FloatArray:
    """f at ``t`` (us), (H, W) log intensity, given the newest events there; ``trail`` is s and h c_on, h c_off."""
    out = np.empty(newest.shape, np.float32)
    scale, on, off = (np.float32(value) for value in trail)
    _trail_at(newest.reshape(-1), t, scale, on, off, out.reshape(-1))
    return out


def polarity_of(newest: NDArray[np.int64]) -> NDArray[np.int8]:
    """1 and -1 of the newest event; 0 where there was none."""
    polarity = np.empty(newest.shape, np.int8)
    _polarity_of(newest.reshape(-1), polarity.reshape(-1))
    return polarity


@nb.njit(cache=True, nogil=True)
def _polarity_of(newest, polarity):  # type: ignore[no-untyped-def]
    for i in range(len(newest)):
        sign = np.int8(newest[i] & 1) * np.int8(2) - np.int8(1)
        polarity[i] = np.int8(0) if newest[i] == NO_EVENT else sign


@nb.njit(cache=True, inline="always")
def beyond(age: Any, scale: Any) -> Any:
    """2 x / (1 + x^2) of x = age / scale, in one division."""
    return (age + age) * scale / (scale * scale + age * age)


@nb.njit(cache=True, inline="always")
def ahead_of_event(sign: Any, age: Any, heights: Any) -> Any:
    """f of a pixel whose newest event, of polarity ``sign`` (0: not known), is ``age`` seconds old; float32."""
    scale, on, off = heights
    high = on if sign > 0 else np.float32(0.0)
    high = -off if sign < 0 else high
    return high * beyond(age, scale)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _trail_at(newest, t, scale, on, off, out):  # type: ignore[no-untyped-def]
    for i in range(len(out)):
        age = np.float32(t - (newest[i] >> 1)) * MICROSECOND32
        height = on if newest[i] & 1 else -off
        out[i] = height * beyond(age, scale)


def given_trail(start: FloatArray, end: FloatArray) -> Trail:
    """The trail of a segment that is filtered backward in time: f at the times where it starts and ends."""
    return Trail(start, np.zeros(start.shape, np.int8), 1.0, 0.0, 0.0, end)


def no_trail(shape: tuple[int, int]) -> Trail:
    """The trail of a segment in which the light is never ahead of its events."""
    nothing = np.zeros(shape, np.float32)
    return given_trail(nothing, nothing)


def add_trail(
    trail: Trail,
    polarity: NDArray[np.int8],
    clock: NDArray[np.int32],
    now: int,
    log_intensity: FloatArray,
) -> None:
    """Add what f has grown by since the start of the segment, in place.

    ``polarity`` and ``clock`` are those of the newest events at ``now`` (us after the clock's origin), with a frame of
    one pixel around the sensor.
    """
    _add_trail(trail.start, polarity, clock, np.int32(now), trail.heights, log_intensity)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _add_trail(start, polarity, clock, now, heights, log_intensity):  # type: ignore[no-untyped-def]
    height, width = start.shape
    for row in range(height):
        signs, times = polarity[row + 1, 1 : width + 1], clock[row + 1, 1 : width + 1]
        first, out = start[row], log_intensity[row]
        for column in range(width):
            age = np.float32(np.int32(now - times[column])) * MICROSECOND32
            out[column] += ahead_of_event(signs[column], age, heights) - first[column]
