"""How far the light is ahead of a pixel's newest event (docs/equations.md, K14).

Between two events a pixel reports nothing, but a brightness that moves seldom stops at a threshold: a time a after its
newest event a pixel is on average

    f(a) = h c 2 x / (1 + x^2),   x = a / s,

beyond the level of that event, in its direction (c: on or off threshold; docs/equations.md, K14), times the square root
of the probability that the event is signal. The time s follows the recording: 1.1 times the mean interval between two
events of one polarity at a pixel.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux import memory
from kalux.compiled import (
    AHEAD,
    MICROSECOND32,
    WEIGHT_UNIT,
    apart,
    event_column,
    event_is_on,
    event_row,
    event_weight,
    event_words,
    flat,
    inner,
    loop,
    prefetch,
    smaller,
)
from kalux.events import EventArray

FloatArray = NDArray[np.float32]

NO_EVENT: Final = -(1 << 62)
"""Code of a pixel that has had no event."""

SURE: Final = 127
"""Surety of an event that is signal for sure."""

FOLLOWED_PIXEL: Final = np.dtype([("newest", "i8"), ("off", "f4"), ("on", "f4")], align=True)
"""What is counted of a pixel, in one line of memory: code of its newest event, weights of off and of on events."""

SCALE: Final = 1.1
"""s over the mean interval. Of eleven simulated and three real recordings, whose means are 6 to 24 ms, the s that
explains the changes between frames best is 0.5 to 1.3 of the mean."""

LONGEST: Final = 100_000
"""us: two events further apart are a pause rather than an interval."""

USUAL: Final = 10_000
"""us: mean interval that is taken before there are any; the middle of those recordings."""

_OF_SURE: Final = np.float32(1.0 / SURE)

_USUAL_WEIGHT: Final = 100.0  # intervals
_KEPT: Final = 0.5  # of the intervals, from frame to frame: speeds change within some frames


Newest = tuple[NDArray[np.int64], NDArray[np.int8]]
"""`Followed.newest` and `Followed.surety`."""


class Followed(NamedTuple):
    """What is known of every pixel's newest event at some moment, and of the intervals up to it.

    Attributes
    ----------
    newest
        (H, W) int64: 2 t + p of the newest event (t in us), `NO_EVENT` before the first.
    surety
        (H, W) int8: `SURE` times the square root of the probability that it is signal (K5), rounded; `SURE` where it is
        not asked for. The root, since an event of noise does not end the way that the light was on before it.
    span, intervals
        Sum (us) and number of the intervals that count.
    """

    newest: NDArray[np.int64]
    surety: NDArray[np.int8]
    span: float
    intervals: float

    @property
    def events(self) -> Newest:
        """The pixels' newest events, as f depends on them."""
        return self.newest, self.surety

    @property
    def scale(self) -> float:
        """s, in seconds."""
        mean = (self.span + USUAL * _USUAL_WEIGHT) / (self.intervals + _USUAL_WEIGHT)
        return SCALE * mean * 1e-6


class Trail(NamedTuple):
    """How far the light is ahead of its events in one segment: f of the module's text.

    Attributes
    ----------
    start
        (H, W) f at the start of the segment, where L^A is a frame's; in the lead-in to the first frame, at its end.
    signed
        (H, W) int8: surety of the newest event there, negative if it is off; 0: none so far.
    scale
        s, seconds.
    on, off
        h c of either polarity; 0 turns it off.
    end
        Backward in time, where ``on`` and ``off`` are 0: f at the end of the segment, which only its last state holds;
        at other times f is added later. None: forward.
    """

    start: FloatArray
    signed: NDArray[np.int8]
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
    """`Followed` before the first event."""
    return Followed(np.full(shape, NO_EVENT, np.int64), np.full(shape, SURE, np.int8), 0.0, 0.0)


def follow(
    chunks: Iterable[EventArray], before: Followed, start: int, end: int
) -> tuple[FloatArray, FloatArray, Followed]:
    """Sums of the weights of on and of off events of every pixel, (H, W) each, and what is known after them.

    Intervals are taken from the last quarter of the time: fewer would do, and all of them cost.

    Parameters
    ----------
    chunks
        The events with ``start`` < t <= ``end`` (us), in time order.
    before
        What was known before them.
    """
    pixels = memory.empty((before.newest.size,), FOLLOWED_PIXEL)
    _begin_following(before.newest.reshape(-1), pixels)
    codes, counts, width = pixels.view(np.int64), pixels.view(np.float32), np.uint64(before.newest.shape[1])
    span, intervals = _KEPT * before.span, _KEPT * before.intervals
    late = end - (end - start) // 4
    for chunk in chunks:
        more, number = _follow(event_words(chunk), codes, counts, width, late)
        span, intervals = span + more, intervals + number
    off, on = apart(2, before.newest.shape)
    newest = memory.empty(before.newest.shape, np.int64)
    _end_following(pixels, newest.reshape(-1), off.reshape(-1), on.reshape(-1))
    return on, off, Followed(newest, before.surety, span, intervals)


def with_surety(before: Followed, after: Followed, shares: tuple[FloatArray, FloatArray]) -> Followed:
    """``after``, with the surety of the events since ``before``, as `follow` does not know it.

    ``shares`` are the probabilities that an on and that an off event of each pixel is signal, (H, W) each.
    """
    surety = memory.empty(after.newest.shape, np.int8)
    planes = before.newest, after.newest, before.surety, *shares, surety
    _with_surety(*(plane.reshape(-1) for plane in planes))
    return after._replace(surety=surety)


@inner
def surety_of(share):  # type: ignore[no-untyped-def]
    """Of an event that is signal with the probability ``share``, float32."""
    return np.int32(np.sqrt(share) * np.float32(SURE) + np.float32(0.5))


@loop
def _with_surety(first, last, before, on, off, surety):  # type: ignore[no-untyped-def]
    for i in range(np.uint64(len(surety))):
        of_newest = surety_of(on[i] if last[i] & 1 else off[i])
        surety[i] = before[i] if last[i] == first[i] else np.int8(of_newest)


@loop
def _begin_following(newest, pixels):  # type: ignore[no-untyped-def]
    for i in range(len(pixels)):
        pixels[i].newest = newest[i]
        pixels[i].off = pixels[i].on = np.float32(0.0)


@loop
def _end_following(pixels, newest, off, on):  # type: ignore[no-untyped-def]
    for i in range(len(pixels)):
        newest[i], off[i], on[i] = pixels[i].newest, pixels[i].off, pixels[i].on


@loop
def _follow(words, codes, counts, width, late):  # type: ignore[no-untyped-def]
    """``codes`` and ``counts`` are the memory of `FOLLOWED_PIXEL`, as int64 and as float32."""
    span, count = np.int64(0), np.int64(0)
    words, one, two = flat(words), np.uint64(1), np.uint64(2)
    last = np.uint64(len(words)) - two
    for i in range(np.uint64(0), last + one, two):
        ahead = words[smaller(i + two * np.uint64(AHEAD), last) + one]
        prefetch(codes, (event_row(ahead) * width + event_column(ahead)) * two)
        t, word = words[i], words[i + one]
        at = (event_row(word) * width + event_column(word)) * two
        is_on = np.uint64(event_is_on(word))
        code = 2 * t + np.int64(is_on)
        if t > late:
            difference = code - codes[at]  # even where the polarities are the same
            counted = np.int64((difference & 1 == 0) & (difference < 2 * LONGEST))
            span += (difference >> 1) * counted
            count += counted
        codes[at] = code
        counts[at * two + two + is_on] += event_weight(word, WEIGHT_UNIT)
    return span, count


def trail_at(newest: Newest, t: int, trail: tuple[float, float, float]) -> FloatArray:
    """f at ``t`` (us), (H, W) log intensity, given the newest events there; ``trail`` is s and h c_on, h c_off."""
    out = memory.empty(newest[0].shape)
    _trail_at(_flat(newest), t, tuple(np.float32(value) for value in trail), out.reshape(-1))
    return out


def trail_between(
    first: Newest,
    last: Newest,
    span: tuple[int, int],
    trail: tuple[float, float, float],
) -> tuple[FloatArray, FloatArray]:
    """f at the first of two times ``span`` (us), and what it has grown by at the second, as `trail_at`, in one pass.

    ``first`` and ``last`` are the newest events at these times.
    """
    start, grown = apart(2, first[0].shape)
    scalars = tuple(np.float32(value) for value in trail)
    _trail_between(_flat(first), _flat(last), *span, scalars, start.reshape(-1), grown.reshape(-1))
    return start, grown


def _flat(newest: Newest) -> Newest:
    code, surety = newest
    return code.reshape(-1), surety.reshape(-1)


def signed_surety(newest: Newest) -> NDArray[np.int8]:
    """`Trail.signed` of the newest events."""
    signed = memory.empty(newest[0].shape, np.int8)
    _signed_surety(_flat(newest), signed.reshape(-1))
    return signed


@loop
def _signed_surety(newest, signed):  # type: ignore[no-untyped-def]
    code, surety = newest
    for i in range(len(signed)):
        signed[i] = np.int8(0) if code[i] == NO_EVENT else np.int8(_signed(code[i], surety[i]))


@nb.njit(cache=True, inline="always")
def beyond(age: Any, scale: Any) -> Any:
    """2 x / (1 + x^2) of x = age / scale, in one division."""
    return (age + age) * scale / (scale * scale + age * age)


@nb.njit(cache=True, inline="always")
def ahead_of_event(signed: Any, age: Any, heights: Any) -> Any:
    """f of a pixel whose newest event, of the surety ``signed`` as in `Trail`, is ``age`` seconds old; float32."""
    scale, on, off = heights
    return (on if signed > 0 else off) * (np.float32(signed) * _OF_SURE) * beyond(age, scale)


@nb.njit(cache=True, inline="always", error_model="numpy")
def _ahead_of_newest(newest, surety, t, heights):  # type: ignore[no-untyped-def]
    age = np.float32(t - (newest >> 1)) * MICROSECOND32
    return ahead_of_event(_signed(newest, surety), age, heights)


@nb.njit(cache=True, inline="always")
def _signed(newest: Any, surety: Any) -> Any:
    return surety if newest & 1 else -surety


@loop
def _trail_at(newest, t, heights, out):  # type: ignore[no-untyped-def]
    code, surety = newest
    for i in range(len(out)):
        out[i] = _ahead_of_newest(code[i], surety[i], t, heights)


@loop
def _trail_between(first, last, begin, end, heights, start, grown):  # type: ignore[no-untyped-def]
    (first_code, first_surety), (last_code, last_surety) = first, last
    for i in range(len(start)):
        start[i] = _ahead_of_newest(first_code[i], first_surety[i], begin, heights)
        grown[i] = _ahead_of_newest(last_code[i], last_surety[i], end, heights) - start[i]


def given_trail(start: FloatArray, end: FloatArray) -> Trail:
    """The trail of a segment that is filtered backward in time: f at the times where it starts and ends."""
    return Trail(start, np.zeros(start.shape, np.int8), 1.0, 0.0, 0.0, end)


NO_HEIGHTS: Final = np.float32(1.0), np.float32(0.0), np.float32(0.0)
"""`Trail.heights` of a segment in which the light is never ahead of its events."""


def no_trail(shape: tuple[int, int]) -> Trail:
    """The trail of a segment in which the light is never ahead of its events."""
    nothing = np.zeros(shape, np.float32)
    return given_trail(nothing, nothing)


def trail_by_clock(
    trail: Trail, signed: NDArray[np.int8], clock: NDArray[np.int32], now: int, beyond: np.float32
) -> FloatArray:
    """f at ``beyond`` seconds after ``now`` (us after the clock's origin), (H, W) log intensity.

    ``signed`` (as in `Trail`) and ``clock`` are of the newest events, with a frame of one pixel around the sensor.
    """
    out = memory.empty(trail.start.shape)
    _trail_by_clock(signed, clock, (np.int32(now), beyond), trail.heights, out)
    return out


@loop
def _trail_by_clock(signed, clock, moment, heights, out):  # type: ignore[no-untyped-def]
    height, width = out.shape
    now, beyond = moment
    for row in range(height):
        signs, times, ahead = signed[row + 1, 1 : width + 1], clock[row + 1, 1 : width + 1], out[row]
        for column in range(width):
            age = np.float32(np.int32(now - times[column])) * MICROSECOND32 + beyond
            ahead[column] = ahead_of_event(signs[column], age, heights)
