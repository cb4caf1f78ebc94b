"""How soon pixels can follow one event by another, and what that says of their refractory period."""

from __future__ import annotations

from typing import Final

import numba as nb
import numpy as np

from kalux.events import NEVER
from kalux.recording import Recording

_EDGE: Final = 0.02  # of the most frequent inter-event interval: what is rarer and shorter is noise
_MOST_OF_PIXEL: Final = 200  # intervals: some hot pixels are then a few percent of a recording's
_EDGE_BINS: Final = np.logspace(1, 6, 51)  # us

_TRIED: Final = (0.35, 0.6, 0.85, 1.1)
"""Refractory periods that are tried, as shares of the shortest interval, between which the best is interpolated. None
is longer than that, but it is only known to lie in a bin of a quarter of its size."""

LATE: Final = 5.0
"""Events later than so many shortest intervals after their predecessors say little of the refractory period: at most a
quarter of their step is lost. And they are as often noise, or the rest of a change that was not finished."""


def shortest_interval(recording: Recording, most_events: int = 3_000_000) -> int:
    """Lower edge of the times between two events of a pixel, us: no refractory period is longer.

    Where their histogram over log time first reaches 2 % of its peak; below that are noise events, which follow the
    others at any time. Of the first ``most_events``, and the first 200 of each pixel, so that hot pixels, which keep no
    period that others have, do not decide; 0 without events that follow one another.
    """
    last = np.full(recording.sensor_size, NEVER, np.int64)
    seen = np.zeros(recording.sensor_size, np.int32)
    histogram = np.zeros(len(_EDGE_BINS) - 1, np.int64)
    count = 0
    for chunk in recording.events():
        part = chunk[: most_events - count]
        histogram += np.histogram(_intervals_of(part["t"], part["x"], part["y"], last, seen), _EDGE_BINS)[0]
        count += len(part)
        if count >= most_events:
            break
    if not histogram.any():
        return 0
    return round(float(_EDGE_BINS[int(np.argmax(histogram >= _EDGE * histogram.max()))]))


def possible_periods(shortest: int) -> tuple[int, ...]:
    """Refractory periods, us, of pixels whose shortest interval is ``shortest``; first 0, nothing is lost."""
    return (0, *sorted({round(share * shortest) for share in _TRIED} - {0}))


@nb.njit(cache=True, nogil=True)
def _intervals_of(t, x, y, last, seen):  # type: ignore[no-untyped-def]
    found = np.empty(len(t), np.int64)
    n = 0
    for i in range(len(t)):
        before = last[y[i], x[i]]
        if before != NEVER and seen[y[i], x[i]] < _MOST_OF_PIXEL:
            found[n] = t[i] - before
            n += 1
            seen[y[i], x[i]] += 1
        last[y[i], x[i]] = t[i]
    return found[:n]
