"""Event pixels that are hot: they fire alone, always, and mostly in one direction, whatever the light does.

A leaking reset switch lets the reference fall, so that a pixel has ON events at a constant rate (Nozaki, Delbruck,
"Temperature and Parasitic Photocurrent Effects in Dynamic Vision Sensors", 2017). Where frames are clipped nothing
contradicts them, and its light would grow without bound.

Light is never on one pixel alone for long. So time is cut into bins, and of every pixel those count in which at most
one of its eight neighbours fires: how often it then fires itself is a rate of its own. Short bins find the pixel alone
between the edges that pass by, long ones see a slower rate sooner, so that three lengths are looked at. A pixel whose
neighbours are hardly ever silent is hot if it goes on in one direction, and farther than these.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.compiled import empty, event_column, event_is_on, event_row, event_words, loop, zeros
from kalux.event_slices import count_chunks, first_events
from kalux.events import EVENT_DTYPE, EventArray
from kalux.models.frame_pixels import around
from kalux.recording import Recording

Counts = NDArray[np.int32]

BINS: Final = (4_700, 9_300, 18_700)
"""us. In the shortest a pixel between moving textures (a million events in 0.3 s of 160 x 120 pixels) is alone often
enough; in the longest a pixel of 50 Hz fires nearly every time. None goes evenly into the periods of lamps, which would
show one half of each to a pixel at the border of the light."""

MOST_EVENTS: Final = 1 << 21
"""Looked at from the start, 32 MB: as many as a plan keeps in memory."""

_COMPANIONS: Final = 1
"""Neighbours that may fire as well: two hot pixels side by side are alone, too."""

_ONE: Final = np.uint64(1)
_OFF, _ON = np.int32(1), np.int32(1 << 16)
"""An event as it is counted in a bin: no pixel has as many as a half of the bits can count, one a microsecond."""

_LEAST_RATE: Final = 30.0
"""Hz, from which a pixel is hot. At 20 Hz frames and the noise model (K5) suffice."""

_ONE_SIGN: Final = 0.85
"""Share of a pixel's events while it is alone that have the more frequent sign; of a leak of 30 Hz and noise of 5 Hz it
is 0.93. Where lamps flicker, pixels of small thresholds see it alone, at 200 Hz and with both signs (a recording of a
still bench has hundreds)."""

_LEAST_FIRING: Final = 24
"""Bins in which a pixel fires alone, from which they tell. With 16, eleven pixels of 25 recordings without hot ones
would be found, with 20 two, with 24 and 32 none."""

_FEW: Final = 8
_NEARLY_ALL: Final = 0.8
"""So few of the longest bins tell where a pixel fires in so many of them: light does it in at most half."""

_MANY: Final = 25
_MOST: Final = 107
"""Bins, of the longest, in which pixels are compared with neighbours that fire as well: half a second at least, two at
most."""

_STEADY: Final = 0.75
"""Share of these bins in which the net count of a hot pixel has one sign: up to 0.74 in 60 recordings without any, 0.78
and more in pixels that leak at 200 Hz under fine texture that moves."""

_TIMES: Final = 2.5
"""How many times that of its neighbours its net count is, at least: light changes alike beside. The second largest of
the eight, so that one of them may be hot, too."""

_PARTS: Final = 4
_LASTING: Final = 0.5
"""Share of the least rate that a pixel has in every quarter of the time, but for one bin: leak does not pause."""


def find_hot_pixels(recording: Recording, most_events: int = MOST_EVENTS) -> NDArray[np.bool_]:
    """Pixels that fire often while their neighbours are silent, all the time, and nearly always with one sign.

    Looks at the first ``most_events``. Rates from 30 Hz on are found.

    Returns
    -------
    (H, W) bool; none where too few bins tell.
    """
    events = np.concatenate([np.empty(0, EVENT_DTYPE), *first_events(recording.events(), most_events)])
    hot = np.zeros(recording.sensor_size, np.bool_)
    for length in BINS:
        alone = _counted_alone(events, recording.sensor_size, length)
        one_sign = np.maximum(alone.on, alone.off) >= _ONE_SIGN * (alone.on + alone.off)
        fires = _fires_often(alone, length)
        if length == BINS[-1]:
            fires |= _fires_nearly_always(alone)
        hot |= one_sign & fires
    return hot | _outruns_neighbours(events, recording.sensor_size)


def _bins_of(events: EventArray, length: int) -> NDArray[np.int64]:
    """Where the whole bins of ``length`` us, from the first event on, begin and end in the events."""
    count = 0 if len(events) == 0 else int(events["t"][-1] - events["t"][0]) // length
    return np.searchsorted(events["t"], events["t"][:1] + length * np.arange(count + 1))


class _Alone(NamedTuple):
    """What pixels do while at most one neighbour fires.

    Attributes
    ----------
    bins, firing
        (4, H, W) bins in which a pixel is alone, and those of them in which it fires, in every quarter of the time.
    on, off
        (H, W) its events in the latter.
    """

    bins: Counts
    firing: Counts
    on: Counts
    off: Counts


def _counted_alone(events: EventArray, shape: tuple[int, int], length: int) -> _Alone:
    """Of the whole bins of ``length`` us, from the first event on."""
    edges = _bins_of(events, length)
    count = max(len(edges) - 1, 0)
    bordered = shape[0] + 2, shape[1] + 2
    crowded, firing = np.zeros((2, _PARTS, *bordered), np.int32)
    off, on = counts = np.zeros((2, *bordered), np.int32)
    planes = (plane.reshape(len(plane), -1) for plane in (crowded, firing, counts))
    _count_alone(event_words(events), edges, np.uint64(bordered[1]), *planes)
    crowded, firing, on, off = (plane[..., 1:-1, 1:-1] for plane in (crowded, firing, on, off))
    parts = np.diff(-(-np.arange(_PARTS + 1) * count // _PARTS))
    return _Alone(parts[:, None, None].astype(np.int32) - crowded, firing, on, off)


@loop
def _count_alone(words, edges, stride, crowded, firing, counts):  # type: ignore[no-untyped-def]
    """Bins in which a pixel is not alone, in which it fires alone, and its events in those.

    Planes are flat, with a border of a pixel and rows of ``stride``. Only pixels that fire and their neighbours are
    visited: most bins are short, and hold few events.
    """
    cells = counts.shape[1]
    here = zeros(cells, np.int32)  # events in this bin: those on in the upper half of the bits
    beside = zeros(cells, np.uint8)  # neighbours that fire in it
    fired, company = empty(cells, np.uint32), empty(cells + 1, np.uint32)
    bins = len(edges) - 1
    for index in range(bins):
        part = np.uint64(index * _PARTS // bins)
        firing_pixels, crowded_pixels = np.uint64(0), np.uint64(0)
        for i in range(edges[index], edges[index + 1]):
            word = words[i, 1]
            cell = (event_row(word) + _ONE) * stride + event_column(word) + _ONE
            before = here[cell]
            here[cell] = before + (_ON if event_is_on(word) else _OFF)
            if before == 0:
                fired[firing_pixels] = cell
                firing_pixels += _ONE
                for place in (cell - stride, cell + stride):
                    crowded_pixels = _join(place - _ONE, beside, company, crowded_pixels)
                    crowded_pixels = _join(place, beside, company, crowded_pixels)
                    crowded_pixels = _join(place + _ONE, beside, company, crowded_pixels)
                crowded_pixels = _join(cell - _ONE, beside, company, crowded_pixels)
                crowded_pixels = _join(cell + _ONE, beside, company, crowded_pixels)
        for k in range(crowded_pixels):
            crowded[part, company[k]] += 1
        for k in range(firing_pixels):
            cell = fired[k]
            if beside[cell] <= _COMPANIONS:
                firing[part, cell] += 1
                counts[0, cell] += here[cell] % _ON
                counts[1, cell] += here[cell] // _ON
            here[cell] = 0
        for k in range(firing_pixels):
            for place in (fired[k] - stride, np.uint64(fired[k]), fired[k] + stride):
                beside[place - _ONE] = beside[place] = beside[place + _ONE] = 0


@nb.njit(cache=True, inline="always", error_model="numpy")
def _join(cell, beside, company, count):  # type: ignore[no-untyped-def]
    """A neighbour of a pixel fires; ``company`` are the ``count`` pixels that have too many for being alone."""
    beside[cell] += np.uint8(1)
    company[count] = cell  # without a branch: the next one takes its place
    return count + np.uint64(beside[cell] == _COMPANIONS + 1)


def _fires_often(alone: _Alone, length: int) -> NDArray[np.bool_]:
    """Whether a pixel fires alone in as many bins, of ``length`` us, as random events of the least rate would."""
    share = 1.0 - np.exp(-_LEAST_RATE * length * 1e-6)
    bins, firing = alone.bins.sum(axis=0), alone.firing.sum(axis=0)
    lasting = (alone.firing >= _LASTING * share * alone.bins - 1.0).all(axis=0)
    return np.asarray((firing >= _LEAST_FIRING) & (firing >= share * bins) & lasting, np.bool_)


def _fires_nearly_always(alone: _Alone) -> NDArray[np.bool_]:
    bins, firing = alone.bins.sum(axis=0), alone.firing.sum(axis=0)
    return np.asarray((bins >= _FEW) & (firing >= _NEARLY_ALL * bins), np.bool_)


def _outruns_neighbours(events: EventArray, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Whether a pixel goes on in one direction nearly all of the time, and farther than those around it."""
    edges = _bins_of(events, BINS[-1])[: _MOST + 1]
    rising, falling, net = np.zeros((3, *shape), np.int32)
    for first, last in pairwise(edges):
        on, off = (
            counts.astype(np.int32) for counts in count_chunks([events[first:last]], shape, weighed=False)
        )
        rising += on > off
        falling += on < off
        net += on - off
    bins = len(edges) - 1
    steady = (np.maximum(rising, falling) >= _STEADY * bins) & (bins >= _MANY)
    second_largest = np.partition(around(np.abs(net), 1, 0), -2, axis=0)[-2]
    return np.asarray(steady & (np.abs(net) >= _TIMES * (second_largest + 1)), np.bool_)
