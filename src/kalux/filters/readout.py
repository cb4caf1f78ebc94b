"""From the state to an intensity: I = exp(L) - I_0, with what is known of highlights and of neighbours."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.compiled import FUSED, ONE, exponential, logarithm

Array = NDArray[np.floating[Any]]


_NOTHING: Final = np.float32(1e9)
"""Variance of a pixel that knows nothing; its square is still a float32."""

_BLOCK: Final = 32
"""Pixels of a row that are looked at together: those of a block without highlights are not searched for them."""

_MARGIN: Final = 16
"""Pixels that know nothing on both sides of a row, at least three times the pitch: the border needs no special case."""

SHARED: Final = np.float32(0.7)
"""Part of the variance that neighbours do not lessen, since their errors are alike: correlations are 0.1 to 0.5 on
eleven simulated scenes, whose relative MSE is 1 % less at 0.5; real sensors, whose thresholds and bandwidth are wrong
for all pixels alike, ask for more (docs/equations.md, K12)."""

_SLACK: Final = np.float32(1 / 8)
"""Of the variance by which neighbours differ, the part by which alike patches differ beyond their noise."""

_HALF_OF_PATCH: Final = np.float32(1 / 18)
"""From the sum over a patch of nine to half its mean."""

_DIRECTIONS: Final = ((0, 1), (1, -1), (1, 0), (1, 1))
"""Rows and columns to four neighbours; the other four are those to whom a pixel is one of these."""


class _Ring(NamedTuple):
    """Rows around the one that is read out, each in the place of its number modulo theirs, between margins.

    Attributes
    ----------
    levels, doubts
        (R, W) L and its variance.
    hears, spans
        (R, W) whether pixels hear their neighbours, and (R, 2) between which columns any of a row do.
    unlike
        (4, R, W): how unlike pixels are to those in `_DIRECTIONS`, the sum of three in a row.
    alike
        (4, R, W): `likeness` to them.
    near, far
        (R, W): information that a neighbour has about a pixel beside it, and about one diagonally away.
    scratch
        (4, W).
    """

    levels: NDArray[np.float32]
    doubts: NDArray[np.float32]
    hears: NDArray[np.uint8]
    spans: NDArray[np.int64]
    unlike: NDArray[np.float32]
    alike: NDArray[np.float32]
    near: NDArray[np.float32]
    far: NDArray[np.float32]
    scratch: NDArray[np.float32]


class HighlightPrior(NamedTuple):
    """How far beyond white an estimate is believed (docs/equations.md, K6).

    Attributes
    ----------
    white
        log(1 + I_0) of the brightest level that a frame can show.
    scale2
        Variance of the log of highlights over white; 0 turns the prior off.
    stretch
        Variance of the log of the scale that events have there, over the scale.
    """

    white: float
    scale2: float
    stretch: float


@nb.njit(cache=True, inline="always", error_model="numpy")
def believed_highlight(excess, variance, scale2, stretch):  # type: ignore[no-untyped-def]
    """Posterior of L - white > 0, given its estimate ``excess`` and the filter's ``variance``; float32.

    Additive noise: a normal prior of variance ``scale2`` shrinks the excess. Unknown scale of the events: with
    a log-normal scale and an exponential prior the mode solves d exp(stretch d) = excess, i.e.
    d = W(stretch excess) / stretch with Lambert's W. What is returned is the log of the mean intensity, half the
    variance that is left above the mean of the log, but no more than a part of d: at white nothing is added.
    """
    scale2, stretch = np.float32(scale2), np.float32(stretch)
    trust = scale2 / (scale2 + np.float32(variance))
    believed = np.float32(excess) * trust
    left = np.float32(variance) * trust
    if stretch != np.float32(0.0):
        w = lambert_w(stretch * believed)
        believed = w / stretch
        slope = exponential(-w) / (ONE + w)  # of d in the shrunk excess
        left *= slope * slope
    return believed + np.float32(0.5) * min(left, believed * np.sqrt(left))


@nb.njit(cache=True, inline="always", error_model="numpy")
def lambert_w(x):  # type: ignore[no-untyped-def]
    """Lambert's W of a float32 x >= 0, to 4e-7 of itself, without branches.

    A guess that is everywhere within 2 % (Iacono and Boyd 2017, eq. 17, in other words), and one step of
    Fritsch's iteration, which takes the error to its fourth power.
    """
    two = np.float32(2.0)
    x = max(x, np.float32(1e-30))
    log = logarithm(ONE + x)
    guess = log * (ONE - logarithm(ONE + log) / (two + log))
    # The logarithm of 1 + x cannot tell a small x; there W = x - x^2.
    w = guess if x > np.float32(1e-3) else x * (ONE - x)
    z = logarithm(x / w) - w
    q = two * (ONE + w) * (ONE + w + two / np.float32(3.0) * z)
    return w * (ONE + z / (ONE + w) * (q - z) / (q - two * z))


class Hidden(NamedTuple):
    """Variance of what no event has told yet (docs/equations.md, K11).

    Of a still pixel ``changing`` times the mean square change of silent pixels around it; of one with an event of late,
    or about to have one, ``moving``.
    """

    changing: float
    moving: float


_NOTHING_HIDDEN: Final = Hidden(0.0, 0.0)


@nb.njit(cache=True, inline="always")
def total_variance(variance, moving, change, hidden):  # type: ignore[no-untyped-def]
    """P and the variance of what no event has told yet (docs/equations.md, K11)."""
    changing, of_moving = hidden
    return variance + (of_moving if moving else changing * change)


@nb.njit(cache=True, inline="always", error_model="numpy")
def likeness(unlikeness):  # type: ignore[no-untyped-def]
    """How far two pixels are of one surface, 0 to 1, of the sum over a patch of e^2 / (P + P' + slack)."""
    edge = ONE + unlikeness * _HALF_OF_PATCH
    return ONE / (edge * edge)


def read_out(
    log_intensity: Array,
    variance: Array,
    log_offset: float,
    prior: HighlightPrior,
    moving: NDArray[np.bool_] | None = None,
    hidden: Hidden = _NOTHING_HIDDEN,
    silent_change: Array | None = None,
    difference: float = 0.0,
    pitch: int = 1,
    unshown: NDArray[np.int64] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """I of a state, and the variance of its logarithm; in one pass over the rows, none of which is stored in between.

    Neighbours (docs/equations.md, K12): L of a moving pixel becomes the mean of itself and its eight neighbours,
    weighted by the information that each has about it. A neighbour at distance d differs by a normal amount of variance
    ``difference``^2 d^2, unless there is an edge between, which patches around both tell that differ by more than their
    variances explain.

    Parameters
    ----------
    log_intensity, variance
        (H, W) L = log(I + I_0) and P.
    log_offset
        I_0.
    prior
        Of highlights.
    moving
        (H, W): pixels with an event of late; None: not told, so that neither K11 nor K12 is done.
    hidden
        What is added to P.
    silent_change
        (H, W): mean square change of silent pixels around each, from one frame to the next, needed where ``hidden``
        asks for it; None: 0.
    difference
        Standard deviation of the difference of L between pixels one apart where there is no edge; 0: neighbours say
        nothing.
    pitch
        Distance of the neighbours: 2 in a Bayer mosaic, whose pixels repeat their colours.
    unshown
        (N,) pixels in the flattened image, ascending, that no frame has shown: their L is wanted as well, and
        neighbours do not lessen their variance, since what they hide (K15) all of them hide alike.

    Returns
    -------
    intensity : ndarray
        (H, W) float32: linear, 1 = a saturated frame pixel at the reference exposure, never negative.
    variance : ndarray
        (H, W) float32.
    levels : ndarray
        (N,) float32: L of the ``unshown`` pixels, after their neighbours are heard.
    """
    unshown = np.empty(0, np.int64) if unshown is None else unshown
    heard = np.empty(len(unshown), np.float32)
    known = variance.astype(np.float32, copy=False)
    out = np.empty(log_intensity.shape, np.float32)
    total = known if moving is None else np.empty_like(out)
    _read_out(
        log_intensity.astype(np.float32, copy=False),
        known,
        np.empty((0, 0), np.bool_) if moving is None else moving,
        known[:0, :0] if moving is None else _plane(silent_change, out.shape),
        tuple(np.float32(value) for value in hidden),
        np.float32(difference * difference),
        pitch,
        tuple(np.float32(value) for value in prior),
        np.float32(log_offset),
        unshown,
        out,
        total,
        heard,
    )
    return out, total, heard


def _plane(values: Array | None, shape: tuple[int, ...]) -> NDArray[np.float32]:
    return np.zeros(shape, np.float32) if values is None else np.ascontiguousarray(values, np.float32)


# The loops below take whole arrays and a row's number: a view of a row costs more than a part of what is done with it.


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath=FUSED)
def _read_out(  # type: ignore[no-untyped-def]
    log_intensity,
    variance,
    moving,
    change,
    hidden,
    allowed,
    pitch,
    prior,
    log_offset,
    unshown,
    out,
    total,
    heard,
):
    white, scale2, _ = prior
    height, width = log_intensity.shape
    size = (width + _BLOCK - 1) // _BLOCK * _BLOCK
    told = moving.size > 0
    hear = told and allowed > np.float32(0.0)
    # A row's neighbours and the patches around them lie in rows to three times the pitch ahead and one behind.
    count = 4 * pitch + 1
    spans = np.zeros((count, 2), np.int64)
    spans[:, 0] = size
    ring = _Ring(
        np.zeros((count, size + 2 * _MARGIN), np.float32),
        np.full((count, size + 2 * _MARGIN), _NOTHING),
        np.zeros((count, size), np.uint8),
        spans,
        np.zeros((4, count, size + 2 * _MARGIN), np.float32),
        np.zeros((4, count, size + 2 * _MARGIN), np.float32),
        np.zeros((count, size + 2 * _MARGIN), np.float32),
        np.zeros((count, size + 2 * _MARGIN), np.float32),
        np.zeros((4, size + 2 * _MARGIN), np.float32),
    )
    level, marks = np.empty(size, np.float32), np.zeros(size, np.uint8)
    words = marks.view(np.uint64)
    places, excess, doubt = np.empty(size, np.uint64), np.empty(size, np.float32), np.empty(size, np.float32)
    met = 0
    for row in range(-3 * pitch if told else 0, height):
        following = row + 3 * pitch
        if told and following < height:
            _take_row(log_intensity, variance, moving, change, hidden, np.uint64(following), total, ring)
        elif told:
            ring.doubts[following % count] = _NOTHING
        first, last = size, 0
        if hear:
            _mark_hearing(moving, following, ring)
            for place in range(count):
                first, last = min(first, ring.spans[place, 0]), max(last, ring.spans[place, 1])
        if first < last and row + pitch >= 0:
            _compare(row + pitch, first, last, allowed, pitch, ring)
        if row < 0:
            continue
        at = np.uint64(row)
        for column in range(np.uint64(width)):
            level[column] = log_intensity[at, column]
        if first < last:
            _hear_neighbours(row, first, min(last, width), allowed, pitch, ring, level, total)
        while met < len(unshown) and unshown[met] < (row + 1) * width:
            place = unshown[met] - row * width
            heard[met] = level[place]
            if told:
                total[row, place] = ring.doubts[row % count, place + _MARGIN]
            met += 1
        for column in range(np.uint64(width)):
            marks[column] = level[column] > white
            out[at, column] = max(exponential(level[column]) - log_offset, np.float32(0.0))
        if scale2 > np.float32(0.0) and _any(words, 0, size):
            _believe(level, total, at, marks, words, prior, log_offset, places, excess, doubt, out)


@nb.njit(cache=True, inline="always")
def _any(words, first, count):  # type: ignore[no-untyped-def]
    """Whether any of ``count`` bytes from ``first`` on is not 0: multiples of 8, with the bytes as ``words`` of 8."""
    found = np.uint64(0)
    for k in range(count // 8):
        found |= words[np.uint64(first // 8) + np.uint64(k)]
    return found != np.uint64(0)


@nb.njit(cache=True, inline="always")
def _take_row(  # type: ignore[no-untyped-def]
    log_intensity, variance, moving, change, hidden, row, total, ring
):
    """K11 of a row, and what its neighbours need to know of it."""
    place = row % np.uint64(len(ring.levels))
    for column in range(np.uint64(total.shape[1])):
        at = column + np.uint64(_MARGIN)
        known = total_variance(variance[row, column], moving[row, column], change[row, column], hidden)
        total[row, column] = known
        ring.doubts[place, at] = known if known < _NOTHING else _NOTHING
        ring.levels[place, at] = log_intensity[row, column]


@nb.njit(cache=True)
def _mark_hearing(moving, row, ring):  # type: ignore[no-untyped-def]
    """Which pixels of a row hear their neighbours, and from which block of columns to which; none outside the image."""
    place = np.uint64(row % len(ring.levels))
    first, last = ring.hears.shape[1], 0
    words = ring.hears[place].view(np.uint64)
    if row < len(moving):
        at = np.uint64(row)
        for column in range(np.uint64(moving.shape[1])):
            ring.hears[place, column] = moving[at, column]
        for block in range(0, ring.hears.shape[1], _BLOCK):
            if _any(words, block, _BLOCK):
                first, last = min(first, block), block + _BLOCK
    ring.spans[place, 0], ring.spans[place, 1] = first, last


# Positions are counted from the first of a loop, so that none is below another: unsigned numbers that wrap around keep
# a loop from becoming vector code.


@nb.njit(cache=True, error_model="numpy", fastmath=FUSED)
def _compare(row, first, last, allowed, pitch, ring):  # type: ignore[no-untyped-def]
    """How unlike a row's pixels are to those in `_DIRECTIONS`, where columns ``first`` to ``last`` need it."""
    count = len(ring.levels)
    here, below = np.uint64(row % count), np.uint64((row + pitch) % count)
    levels, doubts, single, unlike = ring.levels, ring.doubts, ring.scratch, ring.unlike
    start, size = _MARGIN + first - 2 * pitch, np.uint64(last - first + 4 * pitch)
    own, left, right = np.uint64(start), np.uint64(pitch), np.uint64(2 * pitch)
    for k in range(np.uint64(4)):
        down, across = _DIRECTIONS[k]
        there, other = below if down == 1 else here, np.uint64(start + across * pitch)
        slack = allowed * np.float32(pitch * pitch * (down + across * across)) * _SLACK
        for i in range(size):
            excess = levels[there, other + i] - levels[here, own + i]
            single[k, i] = excess * excess / (doubts[here, own + i] + doubts[there, other + i] + slack)
        for i in range(size - np.uint64(2 * pitch)):
            unlike[k, here, own + left + i] = single[k, i] + single[k, left + i] + single[k, right + i]
    near, far = allowed * np.float32(pitch * pitch), allowed * np.float32(2 * pitch * pitch)
    for i in range(size):
        ring.near[here, own + i] = ONE / (doubts[here, own + i] + near)
    for i in range(size):
        ring.far[here, own + i] = ONE / (doubts[here, own + i] + far)


@nb.njit(cache=True, error_model="numpy", fastmath=FUSED)
def _hear_neighbours(row, first, last, allowed, pitch, ring, level, total):  # type: ignore[no-untyped-def]
    """K12 of a row: L of the pixels that hear their neighbours in ``level``, their variances in ``total``."""
    count = len(ring.levels)
    here, above = np.uint64(row % count), np.uint64((row - pitch) % count)
    below = np.uint64((row + pitch) % count)
    levels, doubts, alike, unlike = ring.levels, ring.doubts, ring.alike, ring.unlike
    information, deviation = ring.scratch[0], ring.scratch[1]
    column, own, size = np.uint64(first), np.uint64(_MARGIN + first), np.uint64(last - first)
    for i in range(size):
        information[i] = ONE / doubts[here, own + i]
        deviation[i] = np.float32(0.0)
    for k in range(np.uint64(4)):
        down, across = _DIRECTIONS[k]
        start = np.uint64(_MARGIN + first - pitch)
        for i in range(size + np.uint64(2 * pitch)):
            at = start + i
            alike[k, here, at] = likeness(unlike[k, above, at] + unlike[k, here, at] + unlike[k, below, at])
        least = ring.far if down * across != 0 else ring.near
        onward, back = (below, above) if down == 1 else (here, here)
        after = np.uint64(_MARGIN + first + across * pitch)
        before = np.uint64(_MARGIN + first - across * pitch)
        for i in range(size):
            weight = alike[k, here, own + i] * least[onward, after + i]
            other = alike[k, back, before + i] * least[back, before + i]
            level_here = levels[here, own + i]
            information[i] += weight + other
            deviation[i] += weight * (levels[onward, after + i] - level_here) + other * (
                levels[back, before + i] - level_here
            )
    for i in range(size):
        heard = levels[here, own + i] + deviation[i] / information[i]
        level[column + i] = heard if ring.hears[here, column + i] else level[column + i]
    at = np.uint64(row)
    for i in range(size):
        left = SHARED * doubts[here, own + i] + (ONE - SHARED) / information[i]
        total[at, column + i] = left if ring.hears[here, column + i] else total[at, column + i]


@nb.njit(cache=True, inline="always", error_model="numpy")
def _believe(  # type: ignore[no-untyped-def]
    level, variance, row, marks, words, prior, log_offset, places, excess, doubt, out
):
    """K6 of the marked pixels of a row, brought together so that they go through vector code and others do not pay."""
    white, scale2, stretch = prior
    count = np.uint64(0)
    for first in range(0, len(level), _BLOCK):
        if _any(words, first, _BLOCK):
            for column in range(np.uint64(first), np.uint64(first + _BLOCK)):
                places[count] = column
                count += np.uint64(marks[column])
    for k in range(count):
        excess[k] = level[places[k]] - white
        doubt[k] = variance[row, places[k]]
    for k in range(count):
        believed = believed_highlight(excess[k], doubt[k], scale2, stretch)
        excess[k] = max(exponential(white + believed) - log_offset, np.float32(0.0))
    for k in range(count):
        out[row, places[k]] = excess[k]
