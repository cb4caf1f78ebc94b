"""How soon pixels can follow one event by another, and what that says of their refractory period."""

from __future__ import annotations

from typing import Final

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.refractory import step_weight
from kalux.events import EventArray
from kalux.recording import Recording

_EDGE: Final = 0.02  # of the most frequent inter-event interval: what is rarer and shorter is noise
_EDGE_BINS: Final = np.logspace(1, 6, 51)  # us

_TRIED: Final = (0.3, 0.5, 0.7, 0.9, 1.0)
"""Refractory periods that are tried, as shares of the shortest interval, than which none is longer. Of one that is a
fifth too short, a fifth of what was lost is still missing."""

LATE: Final = 5.0
"""Events later than so many shortest intervals after their predecessors say little of the refractory period: at most a
quarter of their step is lost. And they are as often noise, or the rest of a change that was not finished."""

_NEVER: Final = -(1 << 60)


def shortest_interval(recording: Recording, most_events: int = 3_000_000) -> int:
    """Lower edge of the times between two events of a pixel, us: no refractory period is longer.

    Where their histogram over log time first reaches 2 % of its peak; below that are noise events, which follow the
    others at any time. Of the first ``most_events``; 0 without events that follow one another.
    """
    last = np.full(recording.sensor_size, -1, np.int64)
    histogram = np.zeros(len(_EDGE_BINS) - 1, np.int64)
    count = 0
    for chunk in recording.events():
        part = chunk[: most_events - count]
        histogram += np.histogram(_intervals_of(part["t"], part["x"], part["y"], last), _EDGE_BINS)[0]
        count += len(part)
        if count >= most_events:
            break
    if not histogram.any():
        return 0
    return round(float(_EDGE_BINS[int(np.argmax(histogram >= _EDGE * histogram.max()))]))


def possible_periods(shortest: int) -> tuple[int, ...]:
    """Refractory periods, us, of pixels whose shortest interval is ``shortest``; first 0, nothing is lost."""
    return (0, *sorted({round(share * shortest) for share in _TRIED} - {0}))


class Counts:
    """Weighted counts of events under several refractory periods at once, as a stream of events passes.

    Parameters
    ----------
    sensor_size
        (height, width), pixels.
    periods
        (R,) refractory periods, us.
    late
        us after its predecessor from which on an event is counted apart as well; inf: none is.
    """

    def __init__(self, sensor_size: tuple[int, int], periods: tuple[int, ...], late: float) -> None:
        self._latest = np.full(sensor_size, _NEVER, np.int64)
        self._periods = np.array(periods, np.float32)
        self._late = late

    def add(self, events: EventArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(R, 2, H, W) sums of the weights (K13) of the next events, on and off; the same of the late ones alone."""
        shape = len(self._periods), 2, *self._latest.shape
        every, late = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        t, x, y, p = (events[name] for name in ("t", "x", "y", "p"))
        _add(t, x, y, p, self._latest, self._periods, self._late, every, late)
        return every, late


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _add(t, x, y, p, latest, periods, late_from, every, late):  # type: ignore[no-untyped-def]
    for i in range(len(t)):
        row, column, kind = y[i], x[i], 0 if p[i] else 1
        since = np.float32(t[i] - latest[row, column])
        latest[row, column] = t[i]
        for k in range(len(periods)):
            weight = step_weight(since, periods[k])
            every[k, kind, row, column] += weight
            if since >= late_from:
                late[k, kind, row, column] += weight


@nb.njit(cache=True, nogil=True)
def _intervals_of(t, x, y, last):  # type: ignore[no-untyped-def]
    found = np.empty(len(t), np.int64)
    n = 0
    for i in range(len(t)):
        before = last[y[i], x[i]]
        if before >= 0:
            found[n] = t[i] - before
            n += 1
        last[y[i], x[i]] = t[i]
    return found[:n]
