"""The asynchronous Kalman filter along a bridge (`kalux.augmentation.bridge`), in float32: the default's filter.

The state takes the same calibrated steps and the same slope as L^A, and R changes only at events, so that J D is
constant in between (`akf`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux import memory
from kalux.augmentation.bridge import UNMEASURED, BridgedSegment, lower_to_ceiling, raise_to_bound
from kalux.augmentation.trail import NO_HEIGHTS, ahead_of_event, no_trail, surety_of, trail_by_clock
from kalux.compiled import (
    AHEAD,
    FUSED,
    MICROSECOND32,
    ONE,
    WEIGHT_UNIT,
    ZERO,
    apart,
    empty,
    event_column,
    event_is_on,
    event_row,
    event_weight,
    event_words,
    flat,
    larger,
    loop,
    pack,
    prefetch,
    smaller,
    unpack,
    zeros,
)
from kalux.event_slices import words_until
from kalux.events import EventArray
from kalux.filters.akf import State, information_kept, measurement_rate, predicted_information
from kalux.filters.common import EPOCH, Clock, moved_clock, newest_around_inside
from kalux.filters.surfaces import Unmeasured
from kalux.models.events import signal_probability, threshold_noise

FloatArray = NDArray[np.float32]

STATE_PIXEL: Final = np.dtype(
    [
        ("information", "f4"),  # J = 1/P after the pixel's latest event, or at the origin of the clock
        ("weighted", "f4"),  # J D, constant between events
        ("augmented", "f4"),  # L^A without the part of its slope, less the trail at the start (K14)
        ("rate", "f4"),  # 1/R until the pixel's next event
    ],
    align=True,
)
"""A pixel's state as far as images need it: 16 bytes, which every image reads."""

STEP_PIXEL: Final = np.dtype(
    {
        "names": [
            "step_on",
            "step_off",
            "forward",  # variance of L^A from the frame before; where that measures nothing, -`BridgedSegment.wrong`
            "backward",  # the same from the frame after, without the events still to come
            "doubt_on",  # variance of an on event's step beyond that of a sure one
            "doubt_off",
            "coming",  # sum of their weights; exact, where subtracting their variances would leave rounding errors
            "surety",  # of an on event and, `_BITS` further up, that of an off event (K14)
        ],
        "formats": ["f4"] * 8,
        "itemsize": 32,
    }
)
"""What events need in addition: 32 bytes, so that no pixel lies in two lines of the cache."""

_BLOCK: Final = 128
"""Pixels that are read together: few enough that their fields stay in the first-level cache."""

_BEGIN_BLOCK: Final = 64
"""The same where a segment begins, which needs more fields."""

_STATE_FIELDS: Final = STATE_PIXEL.itemsize // 4
_STEP_FIELDS: Final = STEP_PIXEL.itemsize // 4
_INFORMATION, _WEIGHTED, _AUGMENTED, _RATE = range(_STATE_FIELDS)
_STEP_ON, _STEP_OFF, _FORWARD, _BACKWARD, _DOUBT_ON, _DOUBT_OFF, _COMING, _SURETY = range(_STEP_FIELDS)
_BITS: Final = np.int32(8)
"""Of a surety. Two are one whole number, which float32 holds exactly."""

_FIRST_BITS: Final = np.int32(255)


class _Drifting(NamedTuple):
    """(N,) each: places in the flattened image and in the flattened `Cursor.steps`, drift (K10), and events."""

    pixels: NDArray[np.int64]
    steps: NDArray[np.int64]
    growth: NDArray[np.floating[Any]]
    events: NDArray[np.floating[Any]]


@dataclass
class Cursor:
    """Working arrays of the bridged form; changed in place by `advance`.

    Attributes
    ----------
    pixels, steps
        (H + 2, W + 2) of `STATE_PIXEL` and `STEP_PIXEL`, laid out as the clock is.
    clock
        Newest event of every pixel, us after ``origin``. The pixel's state holds from there, or from ``origin``
        if that is later.
    signed
        Surety of the newest event of every pixel, negative if it is off (`Trail.signed`), laid out as the clock is.
    origin
        us: the segment's start, then a whole number of epochs later.
    moving
        `moving_pixels`, once it has been asked for, where it is the same throughout the segment.
    unmeasured
        `unmeasured_pixels`, once it has been asked for.
    drifting
        Pixels with events and no frame at the end that measures them, once they have been asked for.
    """

    pixels: NDArray[np.void]
    steps: NDArray[np.void]
    clock: Clock
    signed: NDArray[np.int8]
    origin: int
    moving: NDArray[np.bool_] | None = None
    unmeasured: Unmeasured | None = None
    drifting: _Drifting | None = None


class Noise(NamedTuple):
    """Scalars of the event noise: Hz per pixel, units of c^2, and c^2 itself."""

    noise_rate: float
    step_variance: float
    threshold2: float


class _Scalars(NamedTuple):
    """Of the segment and the noise, float32."""

    rate: np.float32
    step_variance: np.float32
    noise_rate: np.float32
    event_variance: np.float32
    threshold2: np.float32


def begin(segment: BridgedSegment, state: State) -> Cursor:
    """The cursor at the start of a segment: L stays, L^A is the segment's. The clock's origin is the start."""
    clock: Clock = memory.empty(state.newest.shape, np.int32)
    clock[:] = state.newest
    pixels, steps = memory.empty(clock.shape, STATE_PIXEL), memory.empty(clock.shape, STEP_PIXEL)
    signed = memory.empty(clock.shape, np.int8)
    signed[:] = 0
    floor = state.log_intensity if segment.floor is None else segment.floor
    scalars = np.float32(segment.rate), np.float32(segment.step_variance)
    variances = segment.forward_variance, segment.backward_variance
    coming = np.zeros_like(segment.augmented) if segment.events is None else segment.events
    trail = no_trail(coming.shape) if segment.trail is None else segment.trail
    doubts = (np.zeros_like(segment.augmented),) * 2 if segment.doubt is None else segment.doubt
    signal = (np.ones_like(segment.augmented),) * 2 if segment.signal is None else segment.signal
    of_steps = segment.step_on, segment.step_off, *variances, coming, *doubts, *signal
    wrong = np.zeros_like(segment.augmented) if segment.wrong is None else segment.wrong
    given = segment.augmented, trail.start, of_steps, wrong
    before = state.log_intensity, floor, state.variance
    _begin_bridged(given, scalars, before, pixels.reshape(-1), steps.reshape(-1))
    if segment.untied is not None:  # K10
        places = _places(segment.untied.pixels, clock.shape)
        for doubt, more in (("doubt_on", segment.untied.on), ("doubt_off", segment.untied.off)):
            steps.reshape(-1)[doubt][places] += more
    signed[1:-1, 1:-1] = trail.signed
    return Cursor(pixels, steps, clock, signed, segment.start)


def advance(segment: BridgedSegment, cursor: Cursor, events: EventArray, noise: Noise) -> None:
    """Take the cursor over events of the segment, which carry weights (`kalux.augmentation.refractory`), in place."""
    words = event_words(events)
    while len(words):
        within = words
        if words[-1, 0] > cursor.origin + EPOCH:
            within = words[: words_until(words, cursor.origin + EPOCH)]
        if len(within):
            arrays = cursor.pixels, cursor.steps, cursor.clock, cursor.signed
            told = noise if segment.doubt is None else noise._replace(noise_rate=0.0)
            _advance_bridged(within, *arrays, cursor.origin, segment.rate, segment.step_variance, told)
        words = words[len(within) :]
        if len(words):
            if segment.events is not None:  # while the clock still tells what came just before the segment
                moving_pixels(segment, cursor)
            epochs = (int(words[0, 0]) - 1 - segment.start) // EPOCH
            _move_origin(cursor, segment.start + epochs * EPOCH)


def read(segment: BridgedSegment, cursor: Cursor, t: int) -> tuple[FloatArray, FloatArray]:
    """L and P at ``t`` (us), which must not lie before an event the cursor has taken. Changes nothing.

    Backward in time L is without the trail (K14): the forward filter adds it (`kalux.smoothing.combine`).
    """
    log_intensity, variance = _read(segment, cursor, t)
    if t == segment.end and segment.trail is not None and segment.trail.end is not None:
        log_intensity -= segment.trail.end
    return log_intensity, variance


def trail_ahead(segment: BridgedSegment, cursor: Cursor, t: int) -> FloatArray | None:
    """(H, W) how far the light is ahead of its events at ``t`` (us), K14; None where that is not followed."""
    if segment.trail is None:
        return None
    return trail_by_clock(segment.trail, cursor.signed, cursor.clock, *_on_clock(cursor, t))


def _on_clock(cursor: Cursor, t: int) -> tuple[int, np.float32]:
    """A time ``t`` (us) as the clock has it, us, and what is beyond its span, s."""
    within = min(t - cursor.origin, EPOCH)
    return within, np.float32((t - cursor.origin - within) * 1e-6)


def _read(segment: BridgedSegment, cursor: Cursor, t: int) -> tuple[FloatArray, FloatArray]:
    """The same, with the drift of K10, and at the end of the segment with the trail and bounds (K7) there."""
    shape = segment.augmented.shape
    log_intensity, variance = apart(2, shape)
    within, beyond = _on_clock(cursor, t)
    since_start = np.float32((t - segment.start) * 1e-6)
    arrays = cursor.pixels, cursor.clock, cursor.signed, segment.slope
    heights = NO_HEIGHTS if segment.trail is None else segment.trail.heights
    _read_bridged(*arrays, heights, (within, beyond, since_start), log_intensity, variance)
    if t == segment.end:
        if segment.trail is not None and segment.trail.end is not None:
            log_intensity += segment.trail.end
        if segment.bound is not None:
            raise_to_bound(log_intensity, segment.bound)  # K7
            lower_to_ceiling(log_intensity, segment.bound)
        if segment.drift is not None:
            variance += segment.drift  # K10
    elif segment.drift is not None and segment.events is not None:
        _add_drift(segment, cursor, segment.drift, segment.events, variance)
    return log_intensity, variance


def _add_drift(
    segment: BridgedSegment,
    cursor: Cursor,
    drift: NDArray[np.floating[Any]],
    events: NDArray[np.floating[Any]],
    variance: FloatArray,
) -> None:
    """Add as much of ``drift`` to P as ``events`` have come, of pixels that no frame measures at the end. In place."""
    if cursor.drifting is None:
        pixels = np.flatnonzero((segment.backward_variance >= UNMEASURED) & (events > 0))
        steps = _places(pixels, cursor.steps.shape)
        cursor.drifting = _Drifting(pixels, steps, drift.reshape(-1)[pixels], events.reshape(-1)[pixels])
    _add_drift_so_far(*cursor.drifting, cursor.steps.reshape(-1), variance.reshape(-1))


@loop
def _add_drift_so_far(pixels, places, growth, events, steps, variance):  # type: ignore[no-untyped-def]
    for i in range(len(pixels)):
        coming = steps[places[i]].coming / events[i]
        variance[pixels[i]] += growth[i] * (ONE - coming)


def _places(pixels: NDArray[np.int64], padded: tuple[int, ...]) -> NDArray[np.int64]:
    """Where pixels of the flattened image lie in a flattened plane with a border, of the shape ``padded``."""
    row, column = np.divmod(pixels, padded[1] - 2)
    return (row + 1) * padded[1] + column + 1


def moving_pixels(segment: BridgedSegment, cursor: Cursor) -> NDArray[np.bool_]:
    """(H, W): pixels with an event since ``segment.still_since`` or later in the segment, and unmeasured ones.

    The others are still: many frames have measured their texture, so that neighbours are of no use (K12). Not to be
    changed.
    """
    if cursor.moving is not None:
        return cursor.moving
    still_since = np.int32(max(segment.still_since - cursor.origin, -EPOCH))
    variances = segment.forward_variance, segment.backward_variance
    moving: NDArray[np.bool_] = np.empty(segment.augmented.shape, np.bool_)
    coming = segment.augmented if segment.events is None else segment.events
    _moving(cursor.clock, still_since, *variances, coming, segment.events is not None, moving)
    if segment.events is not None:  # all events of the segment are among them, whenever this is asked for
        cursor.moving = moving
    return moving


def unmeasured_pixels(segment: BridgedSegment, cursor: Cursor) -> Unmeasured:
    """Pixels that neither frame around measures."""
    if cursor.unmeasured is None:
        first, second = segment.forward_variance, segment.backward_variance
        pixels = np.flatnonzero((first >= UNMEASURED) & (second >= UNMEASURED))
        cursor.unmeasured = Unmeasured(pixels, first.shape)
    return cursor.unmeasured


@loop
def _moving(clock, still_since, forward, backward, coming, knows_coming, moving):  # type: ignore[no-untyped-def]
    height, width = moving.shape
    for row in range(height):
        times, out = clock[row + 1, 1 : width + 1], moving[row]
        first, last, events = forward[row], backward[row], coming[row]
        for i in range(np.uint64(width)):
            unmeasured = (first[i] >= UNMEASURED) & (last[i] >= UNMEASURED)
            out[i] = (times[i] > still_since) | unmeasured
        if knows_coming:
            for i in range(np.uint64(width)):
                out[i] |= events[i] > 0


def end(segment: BridgedSegment, cursor: Cursor) -> State:
    """The state at the end of the segment."""
    log_intensity, variance = _read(segment, cursor, segment.end)
    return State(log_intensity, variance, moved_clock(cursor.clock, segment.end - cursor.origin))


def _move_origin(cursor: Cursor, origin: int) -> None:
    """Predict every pixel at a later origin of the clock, so that its times do not overflow."""
    _predict_bridged(cursor.pixels, cursor.clock, origin - cursor.origin)
    cursor.clock = moved_clock(cursor.clock, origin - cursor.origin)
    cursor.origin = origin


@nb.njit(cache=True, inline="always")
def _since(clock, now):  # type: ignore[no-untyped-def]
    """us from the time at which a pixel's state holds until ``now``; both us after the origin."""
    return np.int32(now - larger(clock, np.int32(0)))


@loop
def _begin_bridged(given, scalars, before, pixels, steps):  # type: ignore[no-untyped-def]
    rate, step_variance = scalars
    log_intensity, floor, variance = before
    augmented, trail, of_steps, wrong = given
    step_on, step_off, forward, backward, events, doubt_on, doubt_off, on, off = of_steps
    height, width = log_intensity.shape
    states = empty((_STATE_FIELDS, _BEGIN_BLOCK), np.float32)
    known = zeros((_STEP_FIELDS, _BEGIN_BLOCK), np.float32)
    information, weighted, level, rates = (
        states[_INFORMATION],
        states[_WEIGHTED],
        states[_AUGMENTED],
        states[_RATE],
    )
    first_variance, last_variance, coming = known[_FORWARD], known[_BACKWARD], known[_COMING]
    surety = known[_SURETY]
    for row in range(np.uint64(height)):
        at = (row + np.uint64(1)) * np.uint64(width + 2) + np.uint64(1)
        for first in range(np.uint64(0), np.uint64(width), np.uint64(_BEGIN_BLOCK)):
            count = smaller(np.uint64(width) - first, np.uint64(_BEGIN_BLOCK))
            _copy(step_on, row, first, count, known[_STEP_ON])
            _copy(step_off, row, first, count, known[_STEP_OFF])
            _copy(forward, row, first, count, first_variance)
            _copy(backward, row, first, count, last_variance)
            _copy(events, row, first, count, coming)
            _copy(doubt_on, row, first, count, known[_DOUBT_ON])
            _copy(doubt_off, row, first, count, known[_DOUBT_OFF])
            _copy(augmented, row, first, count, level)
            for i in range(count):
                of_off = surety_of(np.float32(off[row, first + i])) << _BITS
                surety[i] = np.float32(surety_of(np.float32(on[row, first + i])) + of_off)
            for i in range(count):
                information[i] = ONE / np.float32(variance[row, first + i])
            for i in range(count):
                known_before = larger(
                    np.float32(log_intensity[row, first + i]), np.float32(floor[row, first + i])
                )  # K7
                weighted[i] = information[i] * (known_before - level[i])
            for i in range(count):
                way_back = np.float32(wrong[row, first + i])
                first_variance[i] = -way_back if way_back > 0 else first_variance[i]
            for i in range(count):
                rates[i] = _rate(rate, first_variance[i], last_variance[i], coming[i], step_variance)
            for i in range(count):
                level[i] -= np.float32(trail[row, first + i])
            pack(states, pixels, np.int64(at + first), np.int64(count))
            pack(known, steps, np.int64(at + first), np.int64(count))


@nb.njit(cache=True, inline="always")
def _rate(rate, forward, backward, coming, step_variance):  # type: ignore[no-untyped-def]
    """1/R (K4) by the fields of `STEP_PIXEL`; without a branch, as the loop over events must be."""
    wrong, measured = larger(-forward, ZERO), forward >= ZERO
    backward += coming * (step_variance + wrong * coming)
    return measurement_rate(rate, forward if measured else np.float32(UNMEASURED), backward)


@nb.njit(cache=True, inline="always")
def _copy(plane, row, first, count, out):  # type: ignore[no-untyped-def]
    """A part of a row as float32; vector code, as loops over many arrays at once are not."""
    for i in range(count):
        out[i] = np.float32(plane[row, first + i])


@loop(fastmath=FUSED)
def _advance_bridged(words, pixels, steps, clock, signed, origin, rate, step_variance, noise):  # type: ignore[no-untyped-def]
    scalars = _Scalars(
        np.float32(rate),
        np.float32(step_variance),
        np.float32(noise.noise_rate),
        np.float32(noise.step_variance),
        np.float32(noise.threshold2),
    )
    stride, one, two = np.uint64(clock.shape[1]), np.uint64(1), np.uint64(2)
    words, pixels, steps, clock, signed = (
        flat(words),
        flat(pixels),
        flat(steps),
        flat(clock),
        flat(signed),
    )
    last = np.uint64(len(words)) - two
    # A software pipeline: while an event is filtered, the noise of the next one is computed, and the clock is read for
    # the one after. None of these depends on another, so that the processor executes them at the same time.
    event = _with_noise(_looked_up(words, np.uint64(0), clock, stride, origin), scalars)
    following = _looked_up(words, smaller(two, last), clock, stride, origin)
    for i in range(np.uint64(0), last + one, two):
        ahead = words[smaller(i + two * np.uint64(AHEAD), last) + one]
        place = event_row(ahead) * stride + event_column(ahead) + stride + one
        prefetch(pixels, place)
        prefetch(steps, place)
        at, seconds, weight, is_on, p_noise, q = event
        pixel, known = pixels[at], steps[at]
        information = predicted_information(pixel.information, pixel.rate, seconds)
        step_on, step_off = known.step_on, known.step_off
        step = weight * (step_on if is_on else -step_off)
        q += weight * (known.doubt_on if is_on else known.doubt_off)
        kept = information_kept(information, q)
        # The state moves by the expected step, L^A by the whole one: the bridge has calibrated it by the frames.
        pixel.weighted = (pixel.weighted - information * p_noise * step) * kept
        pixel.information = information * kept
        pixel.augmented += step
        forward, coming = known.forward, known.coming - weight
        forward += weight * scalars.step_variance if forward >= ZERO else ZERO
        pixel.rate = _rate(scalars.rate, forward, known.backward, coming, scalars.step_variance)
        known.forward, known.coming = forward, coming
        surety = np.int32(known.surety)
        signed[at] = np.int8(surety & _FIRST_BITS if is_on else -(surety >> _BITS))
        event = _with_noise(following, scalars)
        following = _looked_up(words, smaller(i + two + two, last), clock, stride, origin)


@nb.njit(cache=True, inline="always")
def _looked_up(words, i, clock, stride, origin):  # type: ignore[no-untyped-def]
    """An event, by the index of its first word: its pixel's index, us since the time of the pixel's state, us since the
    newest event around it, and the second word. Sets the clock; a second look-up does not change it."""
    now, word = np.int32(words[i] - origin), words[i + np.uint64(1)]
    at = event_row(word) * stride + event_column(word) + stride + np.uint64(1)
    since, age = _since(clock[at], now), np.int32(now - newest_around_inside(clock, at, stride))
    clock[at] = now
    return at, since, age, word


@nb.njit(cache=True, inline="always", error_model="numpy")
def _with_noise(event, scalars):  # type: ignore[no-untyped-def]
    """An event after `_looked_up`, with its noise: the index of its pixel, seconds since the time of the pixel's state,
    weight, whether it is on, the probability that it is noise, and Q."""
    at, since, age, word = event
    signal = signal_probability(scalars.noise_rate, np.float32(age) * MICROSECOND32)
    weight, is_on = event_weight(word, WEIGHT_UNIT), event_is_on(word)
    noise = weight * threshold_noise(scalars.event_variance, scalars.threshold2, signal)
    return at, np.float32(since) * MICROSECOND32, weight, is_on, ONE - signal, noise


@loop
def _read_bridged(  # type: ignore[no-untyped-def]
    pixels, clock, signed, slope, heights, moment, log_intensity, variance
):
    height, width = variance.shape
    pixels, clock, signed = flat(pixels), flat(clock), flat(signed)
    size = smaller(width, _BLOCK)
    planes, ahead = empty((_STATE_FIELDS, size), np.float32), empty(size, np.float32)
    for row in range(height):
        at = (row + 1) * (width + 2) + 1
        newest = clock[at : at + width], signed[at : at + width]
        rows = slope[row], log_intensity[row], variance[row]
        for first in range(0, width, size):  # the last block begins where it ends with the row
            first = smaller(first, width - size)
            unpack(pixels, at + first, size, planes)
            _read_block(planes, first, size, newest, heights, moment, rows, ahead)


@nb.njit(cache=True, inline="always", error_model="numpy")
def _read_block(planes, first, count, newest, heights, moment, rows, ahead):  # type: ignore[no-untyped-def]
    """L and P of ``count`` pixels of a row from ``first`` on; vector code."""
    times, signs = newest
    now, beyond, since_start = moment
    slope, log_intensity, variance = rows
    information, weighted, augmented, rate = (
        planes[_INFORMATION],
        planes[_WEIGHTED],
        planes[_AUGMENTED],
        planes[_RATE],
    )
    for i in range(count):
        column = np.uint64(first) + np.uint64(i)
        age = np.float32(np.int32(now - times[column])) * MICROSECOND32 + beyond
        ahead[i] = ahead_of_event(signs[column], age, heights)  # K14
    for i in range(count):
        column = np.uint64(first) + np.uint64(i)
        seconds = np.float32(_since(times[column], now)) * MICROSECOND32 + beyond
        inverse = ONE / predicted_information(information[i], rate[i], seconds)
        moved = augmented[i] + np.float32(slope[column]) * since_start
        log_intensity[column] = moved + weighted[i] * inverse + ahead[i]
        variance[column] = inverse


@loop
def _predict_bridged(pixels, clock, span):  # type: ignore[no-untyped-def]
    height, width = clock.shape
    for row in range(1, height - 1):
        for column in range(1, width - 1):
            pixel = pixels[row, column]
            seconds = np.float32(span - larger(clock[row, column], 0)) * MICROSECOND32
            pixel.information = predicted_information(pixel.information, pixel.rate, seconds)
