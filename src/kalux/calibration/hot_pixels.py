"""Event pixels that leak: they fire alone, always, and in one direction, whatever the light does.

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


def find_hot_pixels(recording: Recording, most_events: int) -> NDArray[np.bool_]:
    """Pixels that fire in nearly all of the time in which their neighbours are silent, nearly always with one sign.

    Looks at the first ``most_events``, and at most at 2 s.

    Returns
    -------
    (H, W) bool; none where fewer than 8 bins of 20 ms tell.
    """
    shape = recording.sensor_size
    alone, firing, ups, downs = (np.zeros(shape, np.int32) for _ in range(4))
    for binned in _bins(recording, most_events):
        on, off = count_chunks([binned], shape, weighed=False)
        fires = on + off > 0
        quiet = sum_of_neighbours(fires.view(np.uint8)) <= _COMPANIONS
        alone += quiet
        firing += quiet & fires
        ups += np.where(quiet, on, 0).astype(np.int32)
        downs += np.where(quiet, off, 0).astype(np.int32)
    enough = (alone >= _LEAST_ALONE) & (firing >= _FIRING * alone)
    return np.asarray(enough & (np.maximum(ups, downs) >= _ONE_SIGN * (ups + downs)), np.bool_)


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
