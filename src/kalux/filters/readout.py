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
"""Pixels of a row that are looked at together: those of a block where nothing moves are not compared with their
neighbours, and those of one without highlights are not searched for them."""

_MARGIN: Final = 16
"""Pixels that know nothing on both sides of a row, at least as many as the pitch: the border needs no special case."""


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


@nb.njit(cache=True, inline="always")
def neighbour_weight(excess, variance, neighbour_variance, allowed):  # type: ignore[no-untyped-def]
    """Information that a neighbour has about a pixel; ``excess`` is the difference of their L.

    1 / (P' + s^2) (1 + excess^2 / (4 v))^-2 with v = P + P' + s^2: near exp(-excess^2 / (2 v)), with one division.
    """
    own = neighbour_variance + allowed
    both = variance + own
    edge = both + np.float32(0.25) * excess * excess
    return both * both / (own * edge * edge)


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
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """I of a state, and the variance of its logarithm; in one pass over the rows, none of which is stored in between.

    Neighbours (docs/equations.md, K12): L of a moving pixel becomes the mean of itself and its eight neighbours,
    weighted by the information that each has about it. A neighbour at distance d differs by a normal amount of variance
    ``difference``^2 d^2, unless there is an edge between, which a difference beyond what both variances explain tells.

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

    Returns
    -------
    intensity : ndarray
        (H, W) float32: linear, 1 = a saturated frame pixel at the reference exposure, never negative.
    variance : ndarray
        (H, W) float32.
    """
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
        out,
        total,
    )
    return out, total


def _plane(values: Array | None, shape: tuple[int, ...]) -> NDArray[np.float32]:
    return np.zeros(shape, np.float32) if values is None else np.ascontiguousarray(values, np.float32)


# The loops below take whole arrays and a row's number: a view of a row costs more than a part of what is done with it.


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath=FUSED)
def _read_out(  # type: ignore[no-untyped-def]
    log_intensity, variance, moving, change, hidden, allowed, pitch, prior, log_offset, out, total
):
    white, scale2, _ = prior
    height, width = log_intensity.shape
    size = (width + _BLOCK - 1) // _BLOCK * _BLOCK
    # The rows that neighbours of one row lie in, each in the place of its number modulo theirs, between margins.
    count = 2 * pitch + 1
    levels = np.zeros((count, size + 2 * _MARGIN), np.float32)
    doubts = np.full(levels.shape, _NOTHING)
    level, marks = np.empty(size, np.float32), np.zeros(size, np.uint8)
    words = marks.view(np.uint64)
    places, excess, doubt = np.empty(size, np.uint64), np.empty(size, np.float32), np.empty(size, np.float32)
    told = moving.size > 0
    for row in range(-pitch if told else 0, height):
        following, below = np.uint64(row + pitch), np.uint64((row + pitch) % count)
        if told and following < np.uint64(height):
            _take_row(
                log_intensity, variance, moving, change, hidden, following, total, levels, doubts, below
            )
        elif told:
            for column in range(np.uint64(size + 2 * _MARGIN)):
                doubts[below, column] = _NOTHING
        if row < 0:
            continue
        at, above, here = np.uint64(row), np.uint64((row - pitch) % count), np.uint64(row % count)
        for column in range(np.uint64(width)):
            level[column] = log_intensity[at, column]
        if told:
            for column in range(np.uint64(width)):
                marks[column] = moving[at, column]
        if told and allowed > np.float32(0.0) and _any(words, 0, size):
            _regularise(levels, doubts, above, here, below, marks, words, allowed, pitch, level)
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
    log_intensity, variance, moving, change, hidden, row, total, levels, doubts, place
):
    """K11 of a row, and what its neighbours need to know of it."""
    for column in range(np.uint64(total.shape[1])):
        at = column + np.uint64(_MARGIN)
        known = total_variance(variance[row, column], moving[row, column], change[row, column], hidden)
        total[row, column] = known
        doubts[place, at] = known if known < _NOTHING else _NOTHING
        levels[place, at] = log_intensity[row, column]


@nb.njit(cache=True, inline="always", error_model="numpy")
def _regularise(  # type: ignore[no-untyped-def]
    levels, doubts, above, here, below, moves, words, allowed, pitch, level
):
    """K12 of a row: its L in ``level``, where the pixel moves."""
    near, far = allowed * np.float32(pitch * pitch), allowed * np.float32(2 * pitch * pitch)
    for first in range(0, len(level), _BLOCK):
        if not _any(words, first, _BLOCK):
            continue
        for i in range(_BLOCK):
            column = np.uint64(first) + np.uint64(i)
            at = column + np.uint64(_MARGIN)
            left, right = at - np.uint64(pitch), at + np.uint64(pitch)
            own = levels[here, at], doubts[here, at]
            mean = ONE / own[1], np.float32(0.0)
            mean = _with_neighbour(mean, own, levels[above, left], doubts[above, left], far)
            mean = _with_neighbour(mean, own, levels[above, at], doubts[above, at], near)
            mean = _with_neighbour(mean, own, levels[above, right], doubts[above, right], far)
            mean = _with_neighbour(mean, own, levels[here, left], doubts[here, left], near)
            mean = _with_neighbour(mean, own, levels[here, right], doubts[here, right], near)
            mean = _with_neighbour(mean, own, levels[below, left], doubts[below, left], far)
            mean = _with_neighbour(mean, own, levels[below, at], doubts[below, at], near)
            mean = _with_neighbour(mean, own, levels[below, right], doubts[below, right], far)
            information, deviation = mean
            level[column] = own[0] + deviation / information if moves[column] else own[0]


@nb.njit(cache=True, inline="always", error_model="numpy")
def _with_neighbour(mean, own, level, doubt, allowed):  # type: ignore[no-untyped-def]
    """(information, sum of weighted differences) of a mean, with one more neighbour."""
    excess = level - own[0]
    weight = neighbour_weight(excess, own[1], doubt, allowed)
    return mean[0] + weight, mean[1] + weight * excess


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
