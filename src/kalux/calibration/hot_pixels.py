"""Event pixels that leak: they fire alone, or more than others, always, and in one direction, whatever the light does.

A leaking reset switch lets the reference fall, so that a pixel has ON events at a constant rate (Nozaki, Delbruck,
"Temperature and Parasitic Photocurrent Effects in Dynamic Vision Sensors", 2017). Where frames are clipped nothing
contradicts them, and its light would grow without bound.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.neighbours import sum_of_neighbours
from kalux.event_slices import count_chunks
from kalux.events import EventArray
from kalux.recording import Recording

BIN: Final = 20_000
"""us: a pixel that fires in nearly every one has 50 Hz and more. At 20 Hz frames and the noise model (K5) suffice."""

_MOST_BINS: Final = 100

_LEAST_ALONE: Final = 8
"""Bins in which a pixel is alone, from which they tell."""

_FIRING: Final = 0.8
"""Share of these in which a leaking pixel fires: what light does to a pixel alone it does in at most half of them."""

_ONE_SIGN: Final = 0.9
"""Share of its events there that have one sign: flicker has as many of the other."""

_COMPANIONS: Final = 1
"""Neighbours that may fire as well: two leaking pixels side by side are alone, too."""

_LEAST_BINS: Final = 25
"""Bins in which other pixels fire as well, from which they tell."""

_STEADY: Final = 0.75
"""Share of all bins in which the net count of a leaking pixel has one sign: in 60 recordings without any it is up to
0.74, 0.78 and more in leaking ones of 200 Hz over fine texture that moves."""

_TIMES: Final = 2.5
"""How many times that of its neighbours its net count over all bins is, at least: light changes alike beside. The
second largest of the eight counts, so that one of them may leak, too."""


def find_hot_pixels(recording: Recording, most_events: int) -> NDArray[np.bool_]:
    """Pixels that fire with one sign nearly all of the time: while their neighbours are silent, or far more than these.

    Looks at the first ``most_events``, and at most at 2 s.

    Returns
    -------
    (H, W) bool; none where fewer than 8 bins of 20 ms tell.
    """
    shape = recording.sensor_size
    alone, firing, ups, downs, rising, falling, net = (np.zeros(shape, np.int32) for _ in range(7))
    bins = 0
    for binned in _bins(recording, most_events):
        bins += 1
        on, off = (counts.astype(np.int32) for counts in count_chunks([binned], shape, weighed=False))
        fires = on + off > 0
        quiet = sum_of_neighbours(fires.view(np.uint8)) <= _COMPANIONS
        alone += quiet
        firing += quiet & fires
        ups += np.where(quiet, on, 0)
        downs += np.where(quiet, off, 0)
        rising += on > off
        falling += on < off
        net += on - off
    enough = (alone >= _LEAST_ALONE) & (firing >= _FIRING * alone)
    leaks = enough & (np.maximum(ups, downs) >= _ONE_SIGN * (ups + downs))
    if bins >= _LEAST_BINS:
        steady = np.maximum(rising, falling) >= _STEADY * bins
        leaks |= steady & (np.abs(net) >= _TIMES * (_second_largest_around(np.abs(net), steady) + 1))
    return np.asarray(leaks, np.bool_)


def _second_largest_around(counts: NDArray[np.int32], pixels: NDArray[np.bool_]) -> NDArray[np.int32]:
    """(H, W) the second largest of the eight neighbours' counts, of ``pixels``; 0 of others."""
    second = np.zeros_like(counts)
    padded = np.pad(counts, 1)
    rows, columns = np.nonzero(pixels)
    beside = [padded[rows + y, columns + x] for y in range(3) for x in range(3) if (y, x) != (1, 1)]
    second[rows, columns] = np.sort(beside, axis=0)[-2] if len(rows) else 0
    return second


def _bins(recording: Recording, most_events: int) -> Iterator[EventArray]:
    """The events of every whole bin of the first ``most_events``."""
    chunks: list[EventArray] = []
    seen, since = 0, None
    for chunk in recording.events():
        if seen >= most_events:
            break
        if len(chunk):
            since = int(chunk["t"][0]) if since is None else since
            chunks.append(chunk[: most_events - seen])
            seen += len(chunks[-1])
            if int(chunks[-1]["t"][-1]) - since >= _MOST_BINS * BIN:
                break
    if since is None:
        return
    events = np.concatenate(chunks)
    whole = min(int(events["t"][-1] - since) // BIN, _MOST_BINS)
    edges = np.searchsorted(events["t"], since + BIN * np.arange(whole + 1))
    for first, last in pairwise(edges.tolist()):
        yield events[first:last]
