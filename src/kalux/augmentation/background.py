"""Which share of a pixel's events is signal: what its neighbours' events say (docs/equations.md, K5).

Background noise adds to the events of a pixel a number that is Poisson distributed and independent of all else. If p(a)
is the distribution of a pixel's events of one polarity in an interval, among pixels whose neighbours have as many as
its own have, then of a events the share

    (m / a) p(a - 1) / p(a)

is noise, where m is expected of it (Robbins 1956: nothing is assumed of the signal). p is counted in the image itself:
where neighbours are silent, most pixels with one event have it from noise; where they are not, few have none. Pixels
that no frame around measures are counted by themselves: nothing else says of a clipped sky that nothing moves there.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba.core import types
from numpy.typing import NDArray

from kalux import memory
from kalux.compiled import apart, larger, loop, smaller, zeros
from kalux.formulas import Number, formula

Floats = NDArray[np.floating[Any]]

_MOST: Final = 6
"""Events of a pixel from which on one more or less is as likely, so that m / a is left."""

_EXACT: Final = 4
"""Events of the neighbours up to which every number is a class of its own; then half octaves are."""

_LARGEST: Final = 4096
"""Of the neighbours' events: more are taken for as many."""

_CLASSES: Final = 25
"""Of the neighbours' events."""

_CELLS: Final = _CLASSES * (_MOST + 1)
"""Of pixels with like events of their own and of their neighbours; there are as many of hidden pixels."""

_PRIOR_PIXELS: Final = 4.0
"""Pixels by which every number is as likely as the next, beside those counted: a class with few says little."""

_PRIOR_OF_HIDDEN: Final = 200.0
"""Pixels as which the distribution of all pixels counts in every class of hidden ones. With 20, noisy skies just above
white gain 3 to 5 % more, but others lose up to 4 (docs/equations.md, K5)."""


def signal_shares(
    on: Floats, off: Floats, expected: float, hidden: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """Probability that an event of a pixel is signal, of on and of off events: (H, W) float32 each.

    Parameters
    ----------
    on, off
        (H, W) events of each polarity in an interval (sums of their weights, K13).
    expected
        Noise events of a pixel in that time, of both polarities.
    hidden
        (H, W): pixels that neither frame around measures.
    """
    counts = tuple(np.ascontiguousarray(np.rint(events), np.float32) for events in (on, off))
    cells = tuple(np.empty(on.size, np.uint16) for _ in counts)
    found = np.zeros((2, 2 * _CELLS), np.int64)
    for own, cell in zip(counts, cells, strict=True):
        _classify(own.reshape(-1), _around(own).reshape(-1), hidden.reshape(-1), cell)
        _count(cell, found)
    shown, of_hidden = found.sum(axis=0).reshape(2, _CLASSES, _MOST + 1)[..., :_MOST]
    of_all = shown + of_hidden + _PRIOR_PIXELS
    usual = of_all / of_all.sum(axis=1, keepdims=True)
    pixels = np.concatenate([shown + _PRIOR_PIXELS, of_hidden + _PRIOR_OF_HIDDEN * usual])
    own_events = np.arange(1, _MOST)
    noise = np.minimum(expected / 2.0 / own_events * pixels[:, :-1] / pixels[:, 1:], 1.0)
    signal = np.ones((2 * _CLASSES, _MOST + 1), np.float32)  # also of no event
    signal[:, 1:-1] = 1.0 - np.minimum.accumulate(noise, axis=1)  # no less for more events
    shares = apart(2, on.shape)
    for own, cell, share in zip(counts, cells, shares, strict=True):
        _look_up(own.reshape(-1), cell, signal.reshape(-1), np.float32(expected / 2.0), share.reshape(-1))
    return shares[0], shares[1]


def doubt(
    shares: tuple[Floats, Floats], step_variance: float, threshold2: float, dark: Floats | None = None
) -> tuple[Floats, Floats]:
    """Of on and of off events, by how much the variance of a step is more than a sure event's, q c^2 (K5): (H, W) each.

    An event that is signal with probability f has f (q + 1 - f) c^2. ``step_variance`` is q c^2, ``threshold2`` c^2,
    and ``dark`` (H, W) what the step of a dark pixel has in addition (K20).
    """
    c2, q = np.float32(threshold2), np.float32(step_variance / threshold2)
    found = apart(2, shares[0].shape)
    of_dark = np.zeros(1, np.float32) if dark is None else dark.reshape(-1)
    for share, more in zip(shares, found, strict=True):
        _doubt(share.reshape(-1), q, c2, of_dark, more.reshape(-1))
    return found[0], found[1]


@loop
def _doubt(shares, q, c2, dark, more):  # type: ignore[no-untyped-def]
    every = len(dark) > 1
    for i in range(np.uint64(len(more))):
        f = shares[i]
        more[i] = c2 * (np.float32(1.0) - f) * (f - q) + f * (dark[i] if every else dark[0])


def _around(counts: NDArray[np.float32]) -> NDArray[np.float32]:
    """Events of the 24 pixels around each, those of the 8 nearest twice."""
    near = memory.empty(counts.shape)
    _sum_around(counts, near)
    return near


@loop
def _sum_around(counts, near):  # type: ignore[no-untyped-def]
    """Row by row: the sums of 3 and of 5 pixels of each column, with two empty ones on either side, then of these."""
    height, width = counts.shape
    of_3, of_5 = zeros(width + 4, np.float32), zeros(width + 4, np.float32)
    two = np.uint64(2)
    for row in range(height):
        of_3[:], of_5[:] = np.float32(0.0), np.float32(0.0)
        for other in range(larger(row - 2, 0), smaller(row + 3, height)):
            for i in range(np.uint64(width)):
                of_5[two + i] += counts[other, i]
        for other in range(larger(row - 1, 0), smaller(row + 2, height)):
            for i in range(np.uint64(width)):
                of_3[two + i] += counts[other, i]
        for i in range(np.uint64(width)):
            one, three, four = i + np.uint64(1), i + np.uint64(3), i + np.uint64(4)
            nearest = of_3[one] + of_3[i + two] + of_3[three]
            all_near = of_5[i] + of_5[one] + of_5[i + two] + of_5[three] + of_5[four]
            near[row, i] = nearest + all_near - np.float32(2.0) * counts[row, i]


@loop
def _classify(own, near, hidden, cells):  # type: ignore[no-untyped-def]
    """The cell of every pixel: the class of its neighbours' events n, and its own, up to `_MOST`; hidden ones after.

    Half octaves are the exponent of n^2, which is exact in float32.
    """
    most, largest = np.float32(_MOST), np.float32(_LARGEST)
    for i in range(np.uint64(len(cells))):
        n = smaller(near[i], largest)
        half_octave = np.int32(_exponent(n * n))
        of_near = np.int32(n) if n < np.float32(_EXACT) else half_octave
        shown = of_near * np.int32(_MOST + 1) + np.int32(smaller(own[i], most))
        cells[i] = np.uint16(shown + np.int32(hidden[i]) * np.int32(_CELLS))


@formula(types.int32)
def _exponent(x: Number) -> Number:
    """floor(log2(x)) of a float32 from 1."""
    return (x.bits_as(types.int32) >> np.int32(23)) - np.int32(127)


@loop
def _count(cells, found):  # type: ignore[no-untyped-def]
    """Add pixels to their cells, by turns to either of two sums: most pixels' cell is that of the one before."""
    for i in range(np.uint64(len(cells))):
        found[i & np.uint64(1), cells[i]] += 1


@loop
def _look_up(own, cells, signal, expected, shares):  # type: ignore[no-untyped-def]
    one, most = np.float32(1.0), np.float32(_MOST)
    for i in range(np.uint64(len(shares))):
        many = one - smaller(expected / larger(own[i], one), one)
        shares[i] = signal[cells[i]] if own[i] < most else many
