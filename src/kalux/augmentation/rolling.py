"""Frames of a rolling shutter: each row is exposed later than the one above (docs/equations.md, K19).

Events say what the light did between the exposure of a row and the moment for which the whole frame is to stand, as
they say what it did within an exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kalux.compiled import event_column, event_is_on, event_row, event_weight, event_words, loop, weight_unit
from kalux.event_slices import all_between, in_order, with_delay_of_rows
from kalux.events import EventArray

Floats = NDArray[np.floating[Any]]


def in_time_of_rows(
    chunks: Sequence[EventArray], delays: NDArray[np.int64], start: int, end: int
) -> list[EventArray]:
    """The events of an exposure as if all rows were exposed at once: earlier by the delay of their row.

    Parameters
    ----------
    chunks
        In time order.
    delays
        From `kalux.event_slices.whole_row_delays`.
    start, end
        Exposure of the middle of the frame, us. Events are those with start < t <= end after that.
    """
    reach = int(np.abs(delays).max())
    moved = [with_delay_of_rows(events, delays) for events in all_between(chunks, start - reach, end + reach)]
    return all_between([in_order(events) for events in moved], start, end)


def carried(
    chunks: Sequence[EventArray], delays: NDArray[np.int64], middle: int, width: int, *, weighed: bool
) -> tuple[Floats, Floats, Floats]:
    """Events from the middle of each row's exposure to that of the frame, and of all the time that rows take.

    Parameters
    ----------
    chunks, delays
        As of `in_time_of_rows`.
    middle
        Of the frame's exposure, us.
    width
        Of the sensor, pixels.
    weighed
        Whether the events carry weights (`kalux.augmentation.refractory`).

    Returns
    -------
    (H, W) float32 each: on and off events, negative where the row is exposed later than the frame's middle, so that
    they are taken back; and the number of all events from the first row's exposure to the last one's.
    """
    reach = int(np.abs(delays).max())
    counts = np.zeros((3, len(delays) * width), np.float32)
    for events in all_between(chunks, middle - reach, middle + reach):
        _carry(event_words(events), middle, middle + delays, counts, np.uint64(width), weight_unit(weighed))
    off, on, all_events = counts.reshape(3, len(delays), width)
    return on, off, all_events


@loop
def _carry(words, middle, middles, counts, width, unit):  # type: ignore[no-untyped-def]
    """Add the events to sums of off and on events with their sign, and of all without."""
    for i in range(len(words)):
        t, word = words[i, 0], words[i, 1]
        row = event_row(word)
        at, weight = row * width + event_column(word), event_weight(word, unit)
        counts[2, at] += weight
        if middles[row] < t <= middle:
            counts[np.uint64(event_is_on(word)), at] += weight
        elif middle < t <= middles[row]:
            counts[np.uint64(event_is_on(word)), at] -= weight
