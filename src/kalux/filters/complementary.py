"""The complementary filter (Scheerlinck, Barnes and Mahony, ACCV 2018; the paper's reference [43]).

dL/dt = e(t) - alpha (L - L^F(t)) with one gain alpha = 2 pi f for all pixels and L^F the newest frame. Between
events L - L^F decays exponentially, so the solution is exact. It has no covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.compiled import (
    AHEAD,
    FUSED,
    MICROSECOND32,
    event_column,
    event_is_on,
    event_row,
    event_words,
    exponential,
    loop,
    prefetch,
    smaller,
)
from kalux.event_slices import events_until
from kalux.events import EventArray
from kalux.filters.common import EPOCH

Array = NDArray[np.float32]

HELD_PIXEL: Final = np.dtype(
    [
        ("deviation", "f4"),  # L - L^F after the pixel's latest event, or at the origin
        ("since", "i4"),  # time of that event, us after the origin, or 0
        ("gain", "f4"),  # 1/s
    ],
    align=True,
)
"""What the filter knows of a pixel."""


class HeldSegment(NamedTuple):
    """A frame that is held: times in us, (H, W) log(I + I_0) and gain in 1/s (0: no frame), nominal thresholds."""

    start: int
    end: int
    log_frame: Array
    gain: Array
    step_on: float
    step_off: float


@dataclass
class Cursor:
    """Working arrays, changed in place by `advance`: (H, W) of `HELD_PIXEL`, and the origin of their times, us."""

    pixels: NDArray[np.void]
    origin: int


class _Scalars(NamedTuple):
    """Of the segment, float32."""

    step_on: np.float32
    step_off: np.float32


def begin(segment: HeldSegment, log_intensity: Array) -> Cursor:
    """The cursor at the start of a segment."""
    pixels = np.zeros(log_intensity.shape, HELD_PIXEL)
    pixels["deviation"] = log_intensity - segment.log_frame
    pixels["gain"] = segment.gain
    return Cursor(pixels, segment.start)


def advance(segment: HeldSegment, cursor: Cursor, events: EventArray) -> None:
    """Take the cursor over events of the segment, in place."""
    scalars = _scalars(segment)
    pixels, width = cursor.pixels.reshape(-1), np.uint64(cursor.pixels.shape[1])
    while len(events):
        count = events_until(events, cursor.origin + EPOCH)
        _advance(event_words(events[:count]), pixels, width, cursor.origin, scalars)
        events = events[count:]
        if len(events):
            epochs = (int(events["t"][0]) - 1 - segment.start) // EPOCH
            _move_origin(pixels, segment.start + epochs * EPOCH - cursor.origin)
            cursor.origin = segment.start + epochs * EPOCH


def read(segment: HeldSegment, cursor: Cursor, t: int) -> Array:
    """L at ``t`` (us), which must not lie before an event the cursor has taken. Changes nothing."""
    log_intensity = np.empty(cursor.pixels.shape, np.float32)
    within = min(t - cursor.origin, EPOCH)
    beyond = np.float32((t - cursor.origin - within) * 1e-6)
    frame = segment.log_frame.reshape(-1)
    _read(frame, cursor.pixels.reshape(-1), within, beyond, log_intensity.reshape(-1))
    return log_intensity


def _scalars(segment: HeldSegment) -> _Scalars:
    return _Scalars(np.float32(segment.step_on), np.float32(segment.step_off))


@nb.njit(cache=True, inline="always")
def decayed(deviation, gain, seconds):  # type: ignore[no-untyped-def]
    """L - L^F after ``seconds`` without an event."""
    return deviation * exponential(-gain * seconds)


@loop(fastmath=FUSED)
def _advance(words, pixels, width, origin, scalars):  # type: ignore[no-untyped-def]
    last = len(words) - 1
    for i in range(len(words)):
        ahead = words[smaller(i + AHEAD, last), 1]
        prefetch(pixels, event_row(ahead) * width + event_column(ahead))
        word = words[i, 1]
        pixel = pixels[event_row(word) * width + event_column(word)]
        now = np.int32(words[i, 0] - origin)
        seconds = np.float32(np.int32(now - pixel.since)) * MICROSECOND32
        step = scalars.step_on if event_is_on(word) else -scalars.step_off
        pixel.deviation = decayed(pixel.deviation, pixel.gain, seconds) + step
        pixel.since = now


@loop
def _read(log_frame, pixels, now, beyond, log_intensity):  # type: ignore[no-untyped-def]
    for i in range(len(pixels)):
        seconds = np.float32(np.int32(now - pixels[i].since)) * MICROSECOND32 + beyond
        log_intensity[i] = log_frame[i] + decayed(pixels[i].deviation, pixels[i].gain, seconds)


@loop
def _move_origin(pixels, span):  # type: ignore[no-untyped-def]
    """Predict every pixel at an origin ``span`` us later, so that times do not overflow."""
    for i in range(len(pixels)):
        pixel = pixels[i]
        pixel.deviation = decayed(pixel.deviation, pixel.gain, np.float32(span - pixel.since) * MICROSECOND32)
        pixel.since = np.int32(0)
