"""The complementary filter (Scheerlinck, Barnes and Mahony, ACCV 2018; the paper's reference [43]).

dL/dt = e(t) - alpha (L - L^F(t)) with one gain alpha = 2 pi f for all pixels and L^F the newest frame. Between
events L - L^F decays exponentially, so the solution is exact. It has no covariance.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.events import EventArray
from kalux.filters.common import MICROSECOND

Array = NDArray[np.float64]
Times = NDArray[np.int64]


class HeldSegment(NamedTuple):
    """A frame that is held: times in us, (H, W) log(I + I_0) and gain in 1/s (0: no frame), nominal thresholds."""

    start: int
    end: int
    log_frame: Array
    gain: Array
    step_on: float
    step_off: float


class Cursor(NamedTuple):
    """Working arrays, (H, W): L at the time ``since`` (us); changed in place by `advance`."""

    log_intensity: Array
    since: Times


def begin(segment: HeldSegment, log_intensity: Array) -> Cursor:
    """The cursor at the start of a segment."""
    return Cursor(log_intensity.copy(), np.full(log_intensity.shape, segment.start, np.int64))


def advance(segment: HeldSegment, cursor: Cursor, events: EventArray) -> None:
    """Take the cursor over events of the segment, in place."""
    _advance(segment, cursor, events["t"], events["x"], events["y"], events["p"])


def read(segment: HeldSegment, cursor: Cursor, t: int) -> Array:
    """L at ``t`` (us), which must not lie before an event the cursor has taken. Changes nothing."""
    seconds = (t - cursor.since) * MICROSECOND
    decay: Array = np.exp(-segment.gain * seconds)
    return segment.log_frame + (cursor.log_intensity - segment.log_frame) * decay


@nb.njit(cache=True, nogil=True)
def _advance(segment, cursor, t, x, y, p):  # type: ignore[no-untyped-def]
    for i in range(len(t)):
        row, column = y[i], x[i]
        frame = segment.log_frame[row, column]
        decay = np.exp(-segment.gain[row, column] * (t[i] - cursor.since[row, column]) * MICROSECOND)
        value = frame + (cursor.log_intensity[row, column] - frame) * decay
        cursor.log_intensity[row, column] = value + (segment.step_on if p[i] else -segment.step_off)
        cursor.since[row, column] = t[i]
