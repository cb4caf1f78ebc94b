"""From the state to an intensity: I = exp(L) - I_0, with what is known of highlights and of neighbours."""

from __future__ import annotations

import itertools
from typing import Any, Final, NamedTuple

import numba as nb
import numpy as np
from numba.core import types
from numpy.typing import NDArray

from kalux.compiled import (
    FUSED,
    ONE,
    empty,
    exponential,
    inner,
    larger,
    logarithm,
    loop,
    packed,
    smaller,
    word_at,
    zeros,
)
from kalux.formulas import Number, Row, choose, formula

Array = NDArray[np.floating[Any]]


_NOTHING: Final = np.float32(1e9)
"""Variance of a pixel that knows nothing; the product of four sums of two is still a float32."""

_SURE: Final = np.float32(1e-9)
"""What is added to a variance is no less, so that the inverse of such a product is a float32 as well."""

_BLOCK: Final = 32
"""Pixels of a row that are looked at together: those of a block without highlights are not searched for them."""

_STRIP: Final = 640
"""Columns that are read out together, a multiple of `_BLOCK`: all of many sensors. A number that is known to the
compiler makes vector code of loops over several rows at once; what is kept of these rows stays in the second cache."""

_MARGIN: Final = 32
"""Pixels on both sides of a row of a strip, a whole number of vectors: those of the strip beside, or, outside the
image, such that know nothing. The border needs no special case."""

_VECTOR: Final = 16
"""float32 in a line of the cache, and in the widest vector."""

_ASIDE: Final = _VECTOR
"""So many of these are compared, at least three times the pitch: a vector, so that all begin where the cache's lines
do."""

_ROW: Final = _STRIP + 2 * _MARGIN

SHARED: Final = np.float32(0.7)
"""Part of the variance that neighbours do not lessen, since their errors are alike: correlations are 0.1 to 0.5 on
eleven simulated scenes, whose relative MSE is 1 % less at 0.5; real sensors, whose thresholds and bandwidth are wrong
for all pixels alike, ask for more (docs/equations.md, K12)."""

_SLACK: Final = np.float32(1 / 8)
"""Of the variance by which neighbours differ, the part by which alike patches differ beyond their noise."""

_HALF_OF_PATCH: Final = np.float32(1 / 18)
"""From the sum over a patch of nine to half its mean."""

_ZERO, _ONE, _TWO, _THREE, _FOUR = (np.uint64(k * _ROW) for k in range(5))
_LEVEL, _DOUBT = np.uint64(0), np.uint64(_ROW)
_NEAR, _FAR = np.uint64(0), np.uint64(_ROW)


class _Ring(NamedTuple):
    """Rows of a strip around the one that is read out, each in the place of its number modulo theirs.

    Attributes
    ----------
    known
        (R 2 _ROW,): of every row L and its variance.
    least
        (R 2 _ROW,): information that a neighbour has about a pixel beside it, and about one diagonally away.
    unlike
        (R 4 _ROW,): how unlike pixels are to four neighbours, (0, 1), (1, -1), (1, 0) and (1, 1) rows and columns away,
        the sum of three in a row. To its other four neighbours a pixel is itself one of these.
    alike
        (R 4 _ROW,): how far they are of one surface with these four (`edge`).
    hears, spans
        (R, _STRIP) whether pixels hear their neighbours, and (R, 2) between which columns any of a row do.
    single
        (4 _ROW,): how unlike the pixels of a row are, one by one.
    heard
        (2 _ROW,): L of a row and its variance, after its neighbours are heard.
    """

    known: NDArray[np.float32]
    least: NDArray[np.float32]
    unlike: NDArray[np.float32]
    alike: NDArray[np.float32]
    hears: NDArray[np.uint8]
    spans: NDArray[np.int64]
    single: NDArray[np.float32]
    heard: NDArray[np.float32]


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
    return believed + np.float32(0.5) * smaller(left, believed * np.sqrt(left))


@formula(types.float32)
def lambert_w(x: Number) -> Number:
    """Lambert's W of a float32 x >= 0, to 4e-7 of itself.

    A guess that is everywhere within 2 % (Iacono and Boyd 2017, eq. 17, in other words), and one step of
    Fritsch's iteration, which takes the error to its fourth power.
    """
    two = np.float32(2.0)
    least = x.like(np.float32(1e-30))
    x = choose(x < least, least, x)
    log = logarithm.of(ONE + x)
    guess = log * (ONE - logarithm.of(ONE + log) / (two + log))
    # The logarithm of 1 + x cannot tell a small x; there W = x - x^2.
    w = choose(x > np.float32(1e-3), guess, x * (ONE - x))
    z = logarithm.of(x / w) - w
    q = two * (ONE + w) * (ONE + w + two / np.float32(3.0) * z)
    return w * (ONE + z / (ONE + w) * (q - z) / (q - two * z))  # type: ignore[no-any-return]


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


def edge(unlikeness: Number) -> Number:
    """Between two pixels, of the sum over a patch of e^2 / (P + P' + slack): 1 where there is none.

    They are of one surface as far as 1 / edge^2, 0 to 1, says.
    """
    return ONE + unlikeness * _HALF_OF_PATCH


def _squared(value: Number) -> Number:
    return value * value


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
    *,
    with_variance: bool = True,
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
    with_variance
        Whether the variance is wanted: else it is empty.

    Returns
    -------
    intensity : ndarray
        (H, W) float32: linear, 1 = a saturated frame pixel at the reference exposure, never negative.
    variance : ndarray
        (H, W) float32.
    levels : ndarray
        (N,) float32: L of the ``unshown`` pixels, after their neighbours are heard.
    """
    height, width = log_intensity.shape
    unshown = np.empty(0, np.int64) if unshown is None else unshown
    heard = np.empty(len(unshown), np.float32)
    known = variance.astype(np.float32, copy=False)
    out = np.empty(log_intensity.shape, np.float32)
    total = np.empty(out.shape if with_variance and moving is not None else (0, 0), np.float32)
    ends = np.searchsorted(unshown, np.arange(height + 1) * width)
    next_unshown = ends[:-1].copy()  # of every row, in strips from left to right
    given = (
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
        ends,
    )
    for begin in range(0, width, _STRIP):
        ring = _ring(0 if moving is None else pitch)
        _read_out(*given, next_unshown, begin, ring, out, total, heard)
    return out, known if with_variance and moving is None else total, heard


def _ring(pitch: int) -> _Ring:
    """Before the first row of a strip: nothing is known, nothing is alike, nobody hears."""
    # A row's neighbours, and the patches around them, lie in rows to twice the pitch ahead and one behind; the rows
    # that need what is made of them, in one more ahead.
    count = 4 * pitch + 1
    rows = 0, 2 * count, 4 * count, 8 * count, 12 * count, 12 * count + 4, 12 * count + 6
    memory = packed((rows[-1] * _ROW,), np.dtype(np.float32))  # all rows begin where lines of the cache do
    memory[:] = 0.0
    known, least, unlike, alike, single, heard = (
        memory[begin * _ROW : end * _ROW] for begin, end in itertools.pairwise(rows)
    )
    known.reshape(count, 2, _ROW)[:, 1] = _NOTHING
    spans = np.empty((count, 2), np.int64)
    spans[:] = _STRIP, 0
    return _Ring(known, least, unlike, alike, np.zeros((count, _STRIP), np.uint8), spans, single, heard)


def _plane(values: Array | None, shape: tuple[int, ...]) -> NDArray[np.float32]:
    return np.zeros(shape, np.float32) if values is None else np.ascontiguousarray(values, np.float32)


# The loops below take whole arrays and places in them: a view of a row costs more than a part of what is done with it.
# Positions are counted from the first of a loop, so that none is below another: unsigned numbers that wrap around keep
# a loop from becoming vector code. So do many arrays, and loops that write to an array of which they read another row.
# Arrays are given one by one: taking one out of a tuple counts a reference, in an atomic operation; for every row,
# these are 4 % of an image. Long functions are put in their place by numba, since LLVM would also compile them alone.


@loop(fastmath=FUSED)
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
    ends,
    next_unshown,
    begin,
    ring,
    out,
    total,
    heard,
):
    """Fill ``out``, ``total`` and ``heard`` in the columns of the strip that begins with ``begin``.

    ``ends`` is how many of the ``unshown`` pixels lie before each row, ``next_unshown`` how many before the strip's.

    Of rows, what is known is taken two pitches before they are read out, since the patches around neighbours reach so
    far, and who hears three pitches before. From rows before the first one only looks ahead.
    """
    white, scale2, _ = prior
    height, width = log_intensity.shape
    told = moving.size > 0
    hear = told and allowed > np.float32(0.0)
    known, least, unlike, alike, single = ring.known, ring.least, ring.unlike, ring.alike, ring.single
    hears, spans, changed = ring.hears, ring.spans, ring.heard
    count = len(spans)
    level, left = zeros(_STRIP, np.float32), zeros(_STRIP, np.float32)
    marks = zeros(_STRIP, np.uint8)
    places, excess, doubt = (
        empty(_STRIP, np.uint64),
        empty(_STRIP, np.float32),
        empty(_STRIP, np.float32),
    )
    end = smaller(begin + _STRIP, width)
    start, size = np.uint64(begin), np.uint64(end - begin)
    for row in range(-3 * pitch if told else 0, height):
        at = np.uint64(row)
        # The columns in which anybody hears. As literals, all that takes them would be compiled twice.
        first, last = np.int64(_STRIP), np.int64(0)
        if told:
            _take_row(log_intensity, variance, moving, change, hidden, row + 2 * pitch, begin, count, known)
        if hear:
            _mark_hearing(moving, row + 3 * pitch, begin, hears, spans)
            for place in range(count):
                first, last = smaller(first, spans[place, 0]), larger(last, spans[place, 1])
        if first < last and row + pitch >= 0:
            _compare(row, first, last, allowed, pitch, known, least, unlike, alike, single)
        if row < 0:
            continue
        # L, and I.
        for i in range(size):
            level[i] = log_intensity[at, start + i]
        if first < last:
            _hear_neighbours(row, first, last, pitch, known, least, alike, hears, changed, level)
        before, behind = next_unshown[row], next_unshown[row]  # those of this strip
        while behind < ends[row + 1] and unshown[behind] < row * width + end:
            heard[behind] = level[unshown[behind] - row * width - begin]
            behind += 1
        next_unshown[row] = behind
        for i in range(size):
            out[at, start + i] = larger(exponential(level[i]) - log_offset, np.float32(0.0))
        # The variance, where it is wanted or highlights are doubted by it.
        for i in range(size):
            marks[i] = level[i] > white
        bright = scale2 > np.float32(0.0) and _any(marks, 0, _STRIP)
        if not bright and len(total) == 0:
            continue
        here = np.uint64(row % count) * np.uint64(2 * _ROW) + np.uint64(_MARGIN)
        if told:
            for i in range(size):
                left[i] = known[here + _DOUBT + i]
        else:
            for i in range(size):
                left[i] = variance[at, start + i]
        if first < last:
            _lessen(row, first, last, ring, left)
            for k in range(before, behind):
                column = np.uint64(unshown[k] - row * width - begin)
                left[column] = known[here + _DOUBT + column]
        if len(total) > 0:
            for i in range(size):
                total[at, start + i] = left[i]
        if bright:
            _believe(level, left, at, start, marks, prior, log_offset, places, excess, doubt, out)


@nb.njit(cache=True, inline="always")
def _any(octets, first, count):  # type: ignore[no-untyped-def]
    """Whether any of ``count`` bytes from ``first`` on is not 0: ``count`` is a multiple of 8."""
    found = np.uint64(0)
    for k in range(np.uint64(first), np.uint64(first + count), np.uint64(8)):
        found |= word_at(octets, k)
    return found != np.uint64(0)


@nb.njit(cache=True, inline="always")
def _take_row(  # type: ignore[no-untyped-def]
    log_intensity, variance, moving, change, hidden, row, begin, count, known
):
    """K11 of a row, and what its neighbours need to know of it."""
    height, width = log_intensity.shape
    if row < 0:
        return
    place = np.uint64(row % count) * np.uint64(2 * _ROW)
    if row >= height:
        for i in range(np.uint64(_ROW)):
            known[place + _DOUBT + i] = _NOTHING
        return
    first = larger(begin - _MARGIN, 0)
    size = np.uint64(smaller(begin + _STRIP + _MARGIN, width) - first)
    at, start, into = np.uint64(row), np.uint64(first), place + np.uint64(first - begin + _MARGIN)
    for i in range(size):
        known[into + _LEVEL + i] = log_intensity[at, start + i]
    for i in range(size):
        doubt = total_variance(variance[at, start + i], moving[at, start + i], change[at, start + i], hidden)
        known[into + _DOUBT + i] = doubt if doubt < _NOTHING else _NOTHING


@inner
def _mark_hearing(moving, row, begin, hears, spans):  # type: ignore[no-untyped-def]
    """Which pixels of a row hear their neighbours, and from which block of columns to which; none outside the image."""
    place = np.uint64(row % len(spans))
    first, last = _STRIP, 0
    if row < len(moving):
        at, start = np.uint64(row), np.uint64(begin)
        for i in range(np.uint64(smaller(moving.shape[1] - begin, _STRIP))):
            hears[place, i] = moving[at, start + i]
        own = hears[place]
        for block in range(0, _STRIP, _BLOCK):
            if _any(own, block, _BLOCK):
                first, last = smaller(first, block), block + _BLOCK
    spans[place, 0], spans[place, 1] = first, last


# Of four numbers a to d, quotients by them share a division: (b, a) c d / a b c d and a b (d, c) / a b c d.


@formula()
def _tell_unlike(
    known: Row,
    own: Number,
    other: Number,
    step: Number,
    near_slack: Number,
    far_slack: Number,
    single: Row,
    into: Number,
) -> None:
    """How unlike a pixel at ``own`` and its four neighbours are, of which three are in the row of ``other``."""
    level, doubt = known[own + _LEVEL], known[own + _DOUBT]
    right = known[own + _LEVEL + step] - level
    left_under = known[other + _LEVEL - step] - level
    straight_under = known[other + _LEVEL] - level
    right_under = known[other + _LEVEL + step] - level
    a = doubt + known[own + _DOUBT + step] + near_slack
    b = doubt + known[other + _DOUBT - step] + far_slack
    c = doubt + known[other + _DOUBT] + near_slack
    d = doubt + known[other + _DOUBT + step] + far_slack
    ab, cd = a * b, c * d
    inverse = ONE / (ab * cd)
    of_ab, of_cd = inverse * cd, inverse * ab
    single[into] = right * right * (of_ab * b)
    single[into + _ONE] = left_under * left_under * (of_ab * a)
    single[into + _TWO] = straight_under * straight_under * (of_cd * d)
    single[into + _THREE] = right_under * right_under * (of_cd * c)


@formula()
def _tell_least(known: Row, own: Number, near: Number, far: Number, least: Row) -> None:
    a, b = known[own + _DOUBT] + near, known[own + _DOUBT] + far
    inverse = ONE / (a * b)
    least[own + _NEAR] = b * inverse
    least[own + _FAR] = a * inverse


@formula()
def _tell_alike(unlike: Row, before: Number, own: Number, after: Number, alike: Row) -> None:
    """How far a pixel is of one surface with its four neighbours, from three rows around both."""
    a, b, c, d = (
        edge(unlike[before + k] + unlike[own + k] + unlike[after + k]) for k in (_ZERO, _ONE, _TWO, _THREE)
    )
    ab, cd = a * b, c * d
    inverse = ONE / (ab * cd)
    of_ab, of_cd = inverse * cd, inverse * ab
    alike[own] = _squared(of_ab * b)
    alike[own + _ONE] = _squared(of_ab * a)
    alike[own + _TWO] = _squared(of_cd * d)
    alike[own + _THREE] = _squared(of_cd * c)


@nb.njit(cache=True, inline="always")
def _compare(  # type: ignore[no-untyped-def]
    row, first, last, allowed, pitch, known, least, unlike, alike, single
):
    """How alike a row's pixels are to their four neighbours in `_Ring`, where columns ``first`` to ``last`` need it.

    Patches reach into the next row: that is compared first.
    """
    count = 4 * pitch + 1
    above, here, below, under = (
        np.uint64((row - pitch) % count),
        np.uint64(row % count),
        np.uint64((row + pitch) % count),
        np.uint64((row + 2 * pitch) % count),
    )
    size, step = np.uint64(last - first + 2 * _ASIDE), np.uint64(pitch)
    begin = np.uint64(_MARGIN - _ASIDE + first)
    near, far = allowed * np.float32(pitch * pitch), allowed * np.float32(2 * pitch * pitch)
    near_slack, far_slack = larger(near * _SLACK, _SURE), larger(far * _SLACK, _SURE)
    near, far = larger(near, _SURE), larger(far, _SURE)
    own, other = below * _TWO + begin, under * _TWO + begin
    for i in range(size):
        _tell_unlike(known, own + i, other + i, step, near_slack, far_slack, single, begin + i)
    for i in range(size):
        _tell_least(known, own + i, near, far, least)
    into = below * _FOUR + begin
    for k in range(np.uint64(4)):
        start = begin + k * _ONE
        for i in range(size):
            unlike[into + k * _ONE + i] = (
                single[start - step + i] + single[start + i] + single[start + step + i]
            )
    before, own = above * _FOUR + begin, here * _FOUR + begin
    for i in range(size):
        _tell_alike(unlike, before + i, own + i, into + i, alike)


@formula()
def _hear(
    known: Row,
    least: Row,
    alike: Row,
    up: Number,
    own: Number,
    down: Number,
    of_up: Number,
    of_own: Number,
    step: Number,
    heard: Row,
    into: Number,
) -> None:
    """K12 of a pixel: the mean of itself and its eight neighbours, and its variance."""
    value, doubt = known[own + _LEVEL], known[own + _DOUBT]
    information, deviation = None, None
    for onward, back, ahead, behind, distance in (
        (of_own, of_own - step, own + step, own - step, _NEAR),
        (of_own + _ONE, of_up + _ONE + step, down - step, up + step, _FAR),
        (of_own + _TWO, of_up + _TWO, down, up, _NEAR),
        (of_own + _THREE, of_up + _THREE - step, down + step, up - step, _FAR),
    ):
        there, back_there = alike[onward] * least[ahead + distance], alike[back] * least[behind + distance]
        more = there * (known[ahead + _LEVEL] - value) + back_there * (known[behind + _LEVEL] - value)
        deviation = more if deviation is None else deviation + more
        information = there + back_there if information is None else information + (there + back_there)
    independent = doubt / (ONE + doubt * information)  # 1 / (1 / doubt + information)
    heard[into] = value + deviation * independent
    heard[into + _ONE] = SHARED * doubt + (ONE - SHARED) * independent


@nb.njit(cache=True, inline="always")
def _hear_neighbours(  # type: ignore[no-untyped-def]
    row, first, last, pitch, known, least, alike, hears, heard, level
):
    """K12 of a row: L of the pixels that hear their neighbours in ``level``; ``ring.heard`` of all."""
    count = 4 * pitch + 1
    above, here, below = (
        np.uint64((row - pitch) % count),
        np.uint64(row % count),
        np.uint64((row + pitch) % count),
    )
    size, step = np.uint64(last - first), np.uint64(pitch)
    begin, column = np.uint64(_MARGIN + first), np.uint64(first)
    up, own, down = above * _TWO + begin, here * _TWO + begin, below * _TWO + begin
    of_up, of_own = above * _FOUR + begin, here * _FOUR + begin
    for i in range(size):
        _hear(known, least, alike, up + i, own + i, down + i, of_up + i, of_own + i, step, heard, begin + i)
    for i in range(size):
        alone, together = level[column + i], heard[begin + i]
        level[column + i] = together if hears[here, column + i] else alone


@inner
def _lessen(row, first, last, ring, left):  # type: ignore[no-untyped-def]
    """The variances of a row, ``left``, where pixels have heard their neighbours."""
    here, column, two = np.uint64(row % len(ring.spans)), np.uint64(first), np.uint64(_ROW + _MARGIN + first)
    for i in range(np.uint64(last - first)):
        alone, together = left[column + i], ring.heard[two + i]
        left[column + i] = together if ring.hears[here, column + i] else alone


@nb.njit(cache=True, inline="always", error_model="numpy")
def _believe(  # type: ignore[no-untyped-def]
    level, variance, row, start, marks, prior, log_offset, places, excess, doubt, out
):
    """K6 of the marked pixels of a row, brought together so that they go through vector code and others do not pay."""
    white, scale2, stretch = prior
    count = np.uint64(0)
    for first in range(0, len(level), _BLOCK):
        if _any(marks, first, _BLOCK):
            for column in range(np.uint64(first), np.uint64(first + _BLOCK)):
                places[count] = column
                count += np.uint64(marks[column])
    for k in range(count):
        excess[k] = level[places[k]] - white
        doubt[k] = variance[places[k]]
    for k in range(count):
        believed = believed_highlight(excess[k], doubt[k], scale2, stretch)
        excess[k] = larger(exponential(white + believed) - log_offset, np.float32(0.0))
    for k in range(count):
        out[row, start + places[k]] = excess[k]
