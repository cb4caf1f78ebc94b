"""Read-out of the filter's state as an intensity, I = exp(L) - I_0.

With the prior on highlights (docs/equations.md, K6) and the weighted mean over neighbouring pixels (K12).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numba as nb
import numpy as np
from numba.core import types
from numpy.typing import NDArray

from kalux import memory
from kalux.compiled import (
    FUSED,
    ONE,
    empty,
    exponential,
    inner,
    larger,
    logarithm,
    loop,
    smaller,
    word_at,
    zeros,
)
from kalux.filters.surfaces import (
    BLOCK,
    Surface,
    Unmeasured,
    next_run,
    rougher_where_bright,
    surface_variance,
)
from kalux.formulas import Number, Row, choose, formula, squared

Array = NDArray[np.floating[Any]]

_UNKNOWN: Final = np.float32(1e9)
"""Variance of a pixel without information. The product of four sums of two such variances is finite in float32."""

_LEAST_ALLOWED: Final = np.float32(8e-9)
"""Least variance by which neighbours differ, so that the inverse of such a product is finite as well."""

_STRIP: Final = 640
"""Columns that are read out together, a multiple of `BLOCK`; many sensors have no more. Since the compiler knows the
number, loops over several rows become vector code; the buffers of these rows fit the second-level cache."""

_MARGIN: Final = 32
"""Pixels on both sides of a strip's rows, a whole number of vectors: those of the strip beside, or, outside the image,
pixels without information, so that borders need no special case."""

_VECTOR: Final = 16
"""float32 in a line of the cache, and in the widest vector."""

_ASIDE: Final = _VECTOR
"""Pixels of the margin that are compared with their neighbours: at least three times the pitch, and a whole vector, so
that rows stay aligned to lines of the cache."""

_ROW: Final = _STRIP + 2 * _MARGIN

CORRELATED: Final = np.float32(0.7)
"""Part of the variance that averaging does not reduce, since errors of neighbours are correlated. Correlations are 0.1
to 0.5 on eleven simulated scenes, whose relative MSE is 1 % less at 0.5; real sensors, with errors of thresholds and
bandwidth that are common to all pixels, need more (docs/equations.md, K12)."""

_SLACK: Final = np.float32(1 / 8)
"""Part of the variance of neighbours' differences by which patches of one surface differ beyond their noise."""

_FARTHER: Final = np.float32(20.0)
"""By how much more neighbours on one surface differ twice as far away than in proportion to their squared distance: it
bends. 10 is better for skies and worse for textures (docs/equations.md, K12)."""

BRIGHTEST: Final = np.float32(np.log(1e5))
"""Log of the brightest light over white that is believed. The sun, 1.6e9 cd/m^2, is 5e4 times as bright as white in its
light (100,000 lx over pi); the flame of a candle in the dark, the brightest of 465 simulated scenes, has 1.5e5."""

_HALF_OF_PATCH: Final = np.float32(1 / 18)
"""Factor from the sum over a patch of nine pixels to half its mean."""

_ZERO, _ONE, _TWO, _THREE, _FOUR = (np.uint64(k * _ROW) for k in range(5))
_LEVEL, _VARIANCE = np.uint64(0), np.uint64(_ROW)
_STRAIGHT, _DIAGONAL = np.uint64(0), np.uint64(_ROW)
"""Places of rows in the buffers of `_Ring`."""


class _Ring(NamedTuple):
    """Ring buffers of R rows of a strip, around the one that is read out: each row at its number modulo R.

    Attributes
    ----------
    states
        (R 2 _ROW,): L and its variance of every row.
    allowed
        (R 2 _ROW,): variance by which a pixel differs from one straight beside it, and from one diagonally, on one
        surface.
    weights
        (R 2 _ROW,): weight of a pixel in the mean of one straight beside it, and of one diagonally, without an edge.
    distances
        (R 4 _ROW,): squared normalised differences to four neighbours, (0, 1), (1, -1), (1, 0) and (1, 1) rows and
        columns away, the sum over three pixels of a row. To its other four neighbours a pixel is itself one of these.
    similarities
        (R 4 _ROW,): factors of the weights of these four, 1 without an edge between, 0 across one (`edge`).
    moving
        (R, _STRIP) pixels that are averaged with their neighbours.
    spans
        (R, 2) first and last column, by blocks, with such pixels in a row.
    differences
        (4 _ROW,): the squared normalised differences of one row, pixel by pixel.
    averaged
        (2 _ROW,): L of a row and its variance, after averaging.
    """

    states: NDArray[np.float32]
    allowed: NDArray[np.float32]
    weights: NDArray[np.float32]
    distances: NDArray[np.float32]
    similarities: NDArray[np.float32]
    moving: NDArray[np.uint8]
    spans: NDArray[np.int64]
    differences: NDArray[np.float32]
    averaged: NDArray[np.float32]


class HighlightPrior(NamedTuple):
    """Prior on the log intensity of highlights beyond white (docs/equations.md, K6).

    Attributes
    ----------
    white
        log(1 + I_0) of the brightest level that a frame can show.
    scale2
        Variance of the log of highlights over white; 0 turns the prior off.
    unknown_scale
        Variance of the log of the events' scale there, as far as that is not known.
    gain
        Share of the change by events that is believed there.
    growth
        By how much the variance of the prior of a highlight grows with its squared distance from white, as far as that
        is more than its noise: 0 for a normal prior, 1 where each highlight tells how far highlights like it go.
    """

    white: float
    scale2: float
    unknown_scale: float
    gain: float
    growth: float


@nb.njit(cache=True, inline="always", error_model="numpy")
def believed_highlight(excess, variance, scale2, unknown_scale, gain, growth):  # type: ignore[no-untyped-def]
    """Posterior of L - white > 0, given its estimate ``excess`` and the filter's ``variance``; float32.

    Of the excess the share ``gain`` is taken. Additive noise: a normal prior shrinks it, of variance ``scale2`` and
    ``growth`` times by how much the square of what is taken exceeds its noise. Unknown scale of the events: with a
    log-normal scale and an exponential prior as wide as that one the mode solves d exp(k d) = excess, i.e. d = W(k
    excess) / k with Lambert's W, k being ``unknown_scale`` over that width. Returned is the log of the posterior mean
    intensity, half the posterior variance above the mean of the log; that half is bounded by a part of d, so that it is
    0 at white, and it counts as far as the prior is the normal one: of a highlight that makes its own, the median is
    returned. No more than `BRIGHTEST` is.
    """
    noise = np.float32(variance)
    believed = np.float32(gain) * np.float32(excess)
    square = larger(believed * believed - noise, np.float32(0.0))
    spread = np.float32(scale2) + np.float32(growth) * square
    trust = spread / (spread + noise)
    believed *= trust
    left = noise * trust
    if unknown_scale != np.float32(0.0):
        stretch = np.float32(unknown_scale) / np.sqrt(spread)
        w = lambert_w(stretch * believed)
        believed = w / stretch
        slope = exponential(-w) / (ONE + w)  # of d in the shrunk excess
        left *= slope * slope
    normal = np.float32(scale2) / spread
    return smaller(believed + np.float32(0.5) * normal * smaller(left, believed * np.sqrt(left)), BRIGHTEST)


@formula(types.float32)
def lambert_w(x: Number) -> Number:
    """Lambert's W of a float32 x >= 0, to 4e-7 of itself.

    A first guess with errors of up to 2 % (Iacono and Boyd 2017, eq. 17, rearranged), and one step of Fritsch's
    iteration, after which the error is its fourth power.
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


class Subthreshold(NamedTuple):
    """Variance of subthreshold changes, which no event has signalled yet (docs/equations.md, K11).

    Attributes
    ----------
    silent
        Of a pixel without recent or imminent events, in units of the mean square change, from one frame to the next, of
        the silent pixels around it.
    moving
        Of a pixel with such events, log intensity^2.
    untied
        Of a pixel that neither frame around measures, log intensity^2.
    """

    silent: float
    moving: float
    untied: float = 0.0

    @property
    def above_moving(self) -> float:
        """By how much more an untied pixel has than one that moves and is measured."""
        return max(self.untied - self.moving, 0.0)


_NO_SUBTHRESHOLD: Final = Subthreshold(0.0, 0.0)


def edge(distance: Number) -> Number:
    """How much of an edge lies between two pixels, 1 for none, from the distance of their patches.

    The distance is the sum of e^2 / (P + P' + slack) over the nine differences e. Weights are divided by edge^2.
    """
    return ONE + distance * _HALF_OF_PATCH


def read_out(
    log_intensity: Array,
    variance: Array,
    log_offset: float,
    prior: HighlightPrior,
    *,
    moving: NDArray[np.bool_] | None = None,
    subthreshold: Subthreshold = _NO_SUBTHRESHOLD,
    silent_change: Array | None = None,
    difference: float = 0.0,
    pitch: int = 1,
    unshown: NDArray[np.int64] | None = None,
    unmeasured: Unmeasured | None = None,
    texture: NDArray[np.float32] | None = None,
    with_variance: bool = True,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """I of a state, and the variance of its logarithm, in one pass over the rows.

    Neighbours (docs/equations.md, K12): L of a moving pixel becomes the mean of itself and its eight neighbours,
    weighted by the information that each has about it. A neighbour at distance d differs by a normal amount of variance
    ``difference``^2 d^2, unless there is an edge between: where the patches around both differ by more than their
    variances explain, its weight falls.

    Parameters
    ----------
    log_intensity, variance
        (H, W) L = log(I + I_0) and P.
    log_offset
        I_0.
    prior
        Of highlights.
    moving
        (H, W): pixels with recent or imminent events, which are averaged; None: not known, so that neither K11 nor K12
        is applied.
    subthreshold
        Variance that is added to P; that of untied pixels is in it.
    silent_change
        (H, W): mean square change of silent pixels around each, from one frame to the next, the unit of
        ``subthreshold.silent``; None: 0.
    difference
        Standard deviation of the difference of L between pixels one apart where there is no edge; 0: no averaging.
    pitch
        Distance of the neighbours: 2 in a Bayer mosaic, whose pixels repeat their colours.
    texture
        (H, W): the square of ``difference`` at each pixel; None: the same everywhere.
    unshown
        (N,) indices in the flattened image, ascending, of pixels that no frame has measured: their L is returned as
        well, and averaging does not reduce their variance, since their errors (K15) are the same.
    unmeasured
        Pixels that no frame around measures: those that another one has shown, and that make up a surface, are averaged
        by how rough it is (`_smooth_surfaces`), whether they move or not.
    with_variance
        Whether to compute the variance; else it is empty.

    Returns
    -------
    intensity : ndarray
        (H, W) float32: linear, 1 = a saturated frame pixel at the reference exposure, never negative.
    variance : ndarray
        (H, W) float32.
    levels : ndarray
        (N,) float32: L of the ``unshown`` pixels, after averaging.
    """
    height, width = log_intensity.shape
    raised = np.empty(0, np.int64) if unshown is None else unshown
    levels = np.empty(len(raised), np.float32)
    known, level = (plane.astype(np.float32, copy=False) for plane in (variance, log_intensity))
    out = np.empty(log_intensity.shape, np.float32)
    total = np.empty(out.shape if with_variance and moving is not None else (0, 0), np.float32)
    ends = np.searchsorted(raised, np.arange(height + 1) * width)
    next_unshown = ends[:-1].copy()  # of every row, in strips from left to right
    difference2 = np.float32(difference * difference)
    of_silent, of_moving = np.float32(subthreshold.silent), np.float32(subthreshold.moving)
    change = known[:0, :0] if moving is None else _plane(silent_change, out.shape)
    scalars = tuple(np.float32(value) for value in prior), np.float32(log_offset)
    given = (
        level,
        known,
        np.empty((0, 0), np.bool_) if moving is None else moving,
        change,
        (of_silent, of_moving),
        np.empty((0, 0), np.float32) if texture is None else texture,
        difference > 0,
        pitch,
        *scalars,
        raised,
        ends,
    )
    for begin in range(0, width, _STRIP):
        ring = _ring(0 if moving is None else pitch, difference2)
        _read_out(*given, next_unshown, begin, ring, out, total, levels)
    if moving is not None and difference > 0 and unmeasured is not None:
        surface = unmeasured.surface(unshown, pitch)
        if len(surface.pixels):
            state = level, known, moving, change
            white = np.float32(prior.white)
            smooth, left = _smooth_surfaces(state, (of_silent, of_moving), surface, difference2, white, pitch)
            read_levels(smooth, left, *scalars)
            _put(smooth, surface.pixels, out.reshape(-1))
            if total.size:
                _put(left, surface.pixels, total.reshape(-1))
    return out, known if with_variance and moving is None else total, levels


def _smooth_surfaces(
    state: tuple[NDArray[Any], ...],
    subthreshold: tuple[np.float32, np.float32],
    surface: Surface,
    usual: np.float32,
    white: np.float32,
    pitch: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(N,) L of the pixels of a surface and its variance, averaged by how rough the surface around them is.

    They are averaged with their eight neighbours, and then with those twice as far away. ``state`` holds L, P, what
    moves, and the change of silent pixels; ``usual`` is the variance by which neighbours differ, ``white`` L of white.
    """
    level = state[0]
    # Filled in the blocks that are seen, or, the last three, at the pixels of the surface.
    variance, rough, near, left, more, far, independent = memory.empty((7, *level.shape))
    filled = (plane.reshape(-1) for plane in (variance, near, left))
    _hear(*(plane.reshape(-1) for plane in state), *subthreshold, level.shape[1], surface.seen, *filled)
    surface_variance(level, variance, surface, usual, pitch, rough)
    rougher_where_bright(level, surface.own, white, pitch, more)
    _average_surface((level, variance, rough, ONE, more), surface, pitch, pitch, near, left)
    _average_surface((near, left, rough, _FARTHER, more), surface, 2 * pitch, pitch, far, independent)
    averaged, remaining = np.empty((2, len(surface.pixels)), np.float32)
    flat = (plane.reshape(-1) for plane in (far, variance, independent))
    _take_averaged(surface.pixels, *flat, averaged, remaining)
    return averaged, remaining


def _average_surface(
    planes: tuple[Any, ...],
    surface: Surface,
    pitch: int,
    patch: int,
    out: NDArray[np.float32],
    left: NDArray[np.float32],
) -> None:
    """Fill L and its variance, if errors were independent, after averaging, at the pixels of the surface.

    ``planes`` are L, its variance, by which variance pixels one apart differ on a surface around each, a factor of
    these, and by how many times that a pixel's neighbours differ from itself. Neighbours are ``pitch`` apart, the
    pixels of the patches around them ``patch``.
    """
    blocks = surface.own, surface.compared, surface.seen
    for begin in range(0, out.shape[1], _STRIP):
        ring = _ring(pitch, ONE)
        _average_planes(*planes, surface.mask, *blocks, pitch, patch, begin, ring, out, left)


def _ring(pitch: int, difference2: np.float32) -> _Ring:
    """Empty buffers, as before the first row of a strip."""
    # A row's neighbours, and the patches around them, reach two pitches ahead and one behind; moving pixels are marked
    # one pitch further ahead.
    count = 4 * pitch + 1
    rows = 0, 2 * count, 4 * count, 6 * count, 10 * count, 14 * count, 14 * count + 4, 14 * count + 6
    buffer = memory.empty((rows[-1] * _ROW,))  # aligned, so that all rows begin with a cache line
    buffer[:] = 0.0
    states, allowed, weights, distances, similarities, differences, averaged = (
        buffer[begin * _ROW : end * _ROW] for begin, end in itertools.pairwise(rows)
    )
    states.reshape(count, 2, _ROW)[:, 1] = _UNKNOWN
    near = np.float32(difference2) * np.float32(pitch * pitch)
    allowed.reshape(count, 2, _ROW)[:] = np.maximum([[near], [2 * near]], _LEAST_ALLOWED)
    spans = np.empty((count, 2), np.int64)
    spans[:] = _STRIP, 0
    moving = np.zeros((count, _STRIP), np.uint8)
    return _Ring(states, allowed, weights, distances, similarities, moving, spans, differences, averaged)


def _plane(values: Array | None, shape: tuple[int, ...]) -> NDArray[np.float32]:
    return np.zeros(shape, np.float32) if values is None else np.ascontiguousarray(values, np.float32)


# The loops below take whole arrays and offsets into them, since making a view of a row costs more than some of the work
# on it. Three things keep a loop from becoming vector code: unsigned offsets that wrap around (so they count from the
# first pixel of a loop), many arrays, and writing to an array of which another row is read. Arrays are passed one by
# one: taking one out of a tuple counts a reference, an atomic operation, which for every row is 4 % of an image. Long
# functions are inlined by numba, since LLVM would also compile them separately.


@loop(fastmath=FUSED)
def _read_out(  # type: ignore[no-untyped-def]
    log_intensity,
    variance,
    moving,
    change,
    subthreshold,
    texture,
    averages,
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
    levels,
):
    """Fill ``out``, ``total`` and ``levels`` in the columns of the strip that begins with ``begin``.

    ``averages`` tells whether moving pixels are averaged, ``ends`` how many of the ``unshown`` pixels lie before each
    row, ``next_unshown`` how many before the strip's.

    The state of a row is loaded two pitches before it is read out, since the patches around neighbours reach so far,
    and its moving pixels are marked three pitches before. Rows before the first one only load what is ahead.
    """
    white, scale2 = prior[:2]
    height, width = log_intensity.shape
    knows_moving = moving.size > 0
    averages = knows_moving and averages
    states, allowed, weights = ring.states, ring.allowed, ring.weights
    distances, similarities = ring.distances, ring.similarities
    differences, averaged, marked, spans = ring.differences, ring.averaged, ring.moving, ring.spans
    count = len(spans)
    level, left = zeros(_STRIP, np.float32), zeros(_STRIP, np.float32)
    bright = zeros(_STRIP, np.uint8)
    places, excess, doubt = (
        empty(_STRIP, np.uint64),
        empty(_STRIP, np.float32),
        empty(_STRIP, np.float32),
    )
    end = smaller(begin + _STRIP, width)
    start, size = np.uint64(begin), np.uint64(end - begin)
    for row in range(-3 * pitch if knows_moving else 0, height):
        at = np.uint64(row)
        # The columns with moving pixels. Typed, since for literals all functions that take them are compiled once more.
        first, last = np.int64(_STRIP), np.int64(0)
        if knows_moving:
            _load_row(
                log_intensity, variance, moving, change, subthreshold, row + 2 * pitch, begin, count, states
            )
        if averages:
            if texture.size > 0:
                ahead, column, into, there = _part_of_row(texture, row + 2 * pitch, begin, count, states)
                _load_rough(texture, ahead, column, there, ONE, pitch, allowed, into)
            _mark_moving(moving, row + 3 * pitch, begin, marked, spans)
            for place in range(count):
                first, last = smaller(first, spans[place, 0]), larger(last, spans[place, 1])
        if first < last and row + pitch >= 0:
            _compare_row(
                row, first, last, pitch, pitch, states, allowed, distances, similarities, differences
            )
            _weigh_row(row + pitch, first, last, pitch, states, allowed, weights)
        if row < 0:
            continue
        # L, and I.
        for i in range(size):
            level[i] = log_intensity[at, start + i]
        if first < last:
            _average_row(row, first, last, pitch, states, weights, similarities, marked, averaged, level)
        before, behind = next_unshown[row], next_unshown[row]  # those of this strip
        while behind < ends[row + 1] and unshown[behind] < row * width + end:
            levels[behind] = level[unshown[behind] - row * width - begin]
            behind += 1
        next_unshown[row] = behind
        for i in range(size):
            out[at, start + i] = larger(exponential(level[i]) - log_offset, np.float32(0.0))
        # The variance, where it is wanted or highlights need it.
        for i in range(size):
            bright[i] = level[i] > white
        has_highlights = scale2 > np.float32(0.0) and _any(bright, 0, _STRIP)
        if not has_highlights and len(total) == 0:
            continue
        here = np.uint64(row % count) * np.uint64(2 * _ROW) + np.uint64(_MARGIN)
        if knows_moving:
            for i in range(size):
                left[i] = states[here + _VARIANCE + i]
        else:
            for i in range(size):
                left[i] = variance[at, start + i]
        if first < last:
            _take_averaged_variance(row, first, last, ring, left)
            for k in range(before, behind):
                column = np.uint64(unshown[k] - row * width - begin)
                left[column] = states[here + _VARIANCE + column]
        if len(total) > 0:
            for i in range(size):
                total[at, start + i] = left[i]
        if has_highlights:
            _shrink_highlights(level, left, at, start, bright, prior, log_offset, places, excess, doubt, out)


@loop(fastmath=FUSED)
def _average_planes(  # type: ignore[no-untyped-def]
    level,
    variance,
    allowed,
    factor,
    more,
    averages,
    own,
    compared,
    seen,
    pitch,
    patch,
    begin,
    ring,
    out,
    left,
):
    """K12 of the pixels of ``averages`` in the columns of the strip that begins with ``begin``: `_average_surface`."""
    states, rough, distances, similarities = ring.states, ring.allowed, ring.distances, ring.similarities
    differences, averaged = ring.differences, ring.averaged
    (height, width), count = level.shape, len(ring.spans)
    end = smaller(begin + _STRIP, width)
    times = zeros(_ROW, np.float32)
    for row in range(-2 * pitch, height):
        _load_surface(
            level, variance, allowed, factor, seen, row + 2 * pitch, begin, pitch, count, states, rough
        )
        if row + pitch < 0:
            continue
        first, last = next_run(compared, larger(row, 0), begin, end)
        while first < last:
            _compare_row(
                row,
                first - begin,
                last - begin,
                pitch,
                patch,
                states,
                rough,
                distances,
                similarities,
                differences,
            )
            first, last = next_run(compared, larger(row, 0), last, end)
        if row < 0:
            continue
        first, last = next_run(own, row, begin, end)
        while first < last:
            at, column = np.uint64(row), np.uint64(first)
            up, here, down, of_up, of_own, into = _around(row, first - begin, pitch, count)
            inside = np.uint64(smaller(last, width) - first)
            for i in range(inside):
                times[into + i] = more[at, column + i]
            for i in range(np.uint64(last - first)):
                _average_rough(
                    states,
                    rough,
                    times,
                    similarities,
                    up + i,
                    here + i,
                    down + i,
                    of_up + i,
                    of_own + i,
                    np.uint64(pitch),
                    averaged,
                    into + i,
                )
            for i in range(inside):
                alone, together = out[at, column + i], averaged[into + i]
                out[at, column + i] = together if averages[at, column + i] else alone
            for i in range(inside):
                alone, together = left[at, column + i], averaged[into + _ONE + i]
                left[at, column + i] = together if averages[at, column + i] else alone
            first, last = next_run(own, row, last, end)


@loop
def _hear(  # type: ignore[no-untyped-def]
    level, known, moving, change, of_silent, of_moving, width, seen, variance, near, left
):
    """Fill blocks that are seen, of flat planes: P with the variance of subthreshold changes; it and L once more."""
    rows, blocks = seen.shape
    for row in range(rows):
        for block in range(blocks):
            if seen[row, block]:
                at = np.uint64(row * width + BLOCK * block)
                for i in range(np.uint64(smaller(BLOCK, width - BLOCK * block))):
                    unsignalled = of_moving if moving[at + i] else of_silent * change[at + i]
                    variance[at + i] = smaller(known[at + i] + unsignalled, _UNKNOWN)
                for i in range(np.uint64(smaller(BLOCK, width - BLOCK * block))):
                    near[at + i], left[at + i] = level[at + i], variance[at + i]


@loop
def _take_averaged(pixels, level, alone, together, averaged, left):  # type: ignore[no-untyped-def]
    """Take L and its variance at some pixels: errors of neighbours are correlated."""
    for i in range(len(pixels)):
        at = np.uint64(pixels[i])
        averaged[i] = level[at]
        left[i] = CORRELATED * alone[at] + (ONE - CORRELATED) * together[at]


@loop
def _put(values, pixels, plane):  # type: ignore[no-untyped-def]
    """Write values at some pixels of a flattened plane."""
    for i in range(len(pixels)):
        plane[np.uint64(pixels[i])] = values[i]


@loop
def read_levels(level, doubt, prior, log_offset):  # type: ignore[no-untyped-def]
    """From L of single pixels, of the variance ``doubt``, to I, with the prior on highlights (K6). In place.

    Without branches, so that it becomes vector code.
    """
    zero = np.float32(0.0)
    white, scale2, unknown_scale, gain, growth = prior
    doubted = scale2 > zero
    for i in range(len(level)):
        beyond = larger(level[i] - white, zero)
        believed = white + believed_highlight(beyond, doubt[i], scale2, unknown_scale, gain, growth)
        level[i] = larger(
            exponential(believed if doubted and level[i] > white else level[i]) - log_offset, zero
        )


@nb.njit(cache=True, inline="always")
def _part_of_row(plane, row, begin, count, states):  # type: ignore[no-untyped-def]
    """A row, the first of its pixels that a strip needs, their place in the ring and their number: 0 outside the image.

    Below the image nothing is known.
    """
    height, width = plane.shape
    place = np.uint64(row % count) * np.uint64(2 * _ROW)
    if row >= height:
        for i in range(np.uint64(_ROW)):
            states[place + _VARIANCE + i] = _UNKNOWN
    first = larger(begin - _MARGIN, 0)
    size = np.uint64(smaller(begin + _STRIP + _MARGIN, width) - first) if 0 <= row < height else np.uint64(0)
    return np.uint64(row), np.uint64(first), place + np.uint64(first - begin + _MARGIN), size


@nb.njit(cache=True, inline="always")
def _load_surface(  # type: ignore[no-untyped-def]
    level, variance, allowed, factor, seen, row, begin, pitch, count, states, rough
):
    """Load L, its variance, and by how much pixels differ from neighbours on one surface, of a row's blocks.

    Of the blocks that are ``seen``, also of those beside the strip, since a margin is as wide as one.
    """
    at, start, into, size = _part_of_row(level, row, begin, count, states)
    for first in range(np.uint64(0), size, np.uint64(BLOCK)):
        column, place = start + first, into + first
        if seen[at, column // np.uint64(BLOCK)]:
            for i in range(smaller(size - first, np.uint64(BLOCK))):
                states[place + _LEVEL + i] = level[at, column + i]
                states[place + _VARIANCE + i] = variance[at, column + i]
            _load_rough(
                allowed, at, column, smaller(size - first, np.uint64(BLOCK)), factor, pitch, rough, place
            )


@nb.njit(cache=True, inline="always")
def _any(octets, first, count):  # type: ignore[no-untyped-def]
    """Whether any of ``count`` bytes from ``first`` on is not 0: ``count`` is a multiple of 8."""
    found = np.uint64(0)
    for k in range(np.uint64(first), np.uint64(first + count), np.uint64(8)):
        found |= word_at(octets, k)
    return found != np.uint64(0)


@nb.njit(cache=True, inline="always")
def _load_row(  # type: ignore[no-untyped-def]
    log_intensity, variance, moving, change, subthreshold, row, begin, count, states
):
    """Load L of a row, and its variance with that of changes that no event has signalled yet (K11)."""
    at, start, into, size = _part_of_row(log_intensity, row, begin, count, states)
    of_silent, of_moving = subthreshold
    for i in range(size):
        states[into + _LEVEL + i] = log_intensity[at, start + i]
    for i in range(size):
        unsignalled = of_moving if moving[at, start + i] else of_silent * change[at, start + i]
        total = variance[at, start + i] + unsignalled
        states[into + _VARIANCE + i] = total if total < _UNKNOWN else _UNKNOWN


@nb.njit(cache=True, inline="always")
def _load_rough(plane, row, column, size, factor, pitch, rough, into):  # type: ignore[no-untyped-def]
    """Load by how much some pixels of a row differ from neighbours, from the variance at a distance of one."""
    for i in range(size):
        near = larger(plane[row, column + i] * factor * np.float32(pitch * pitch), _LEAST_ALLOWED)
        rough[into + _STRAIGHT + i] = near
        rough[into + _DIAGONAL + i] = near + near


@inner
def _mark_moving(moving, row, begin, marked, spans):  # type: ignore[no-untyped-def]
    """Mark the moving pixels of a row, and the span of blocks that have any; there are none outside the image."""
    place = np.uint64(row % len(spans))
    first, last = _STRIP, 0
    if row < len(moving):
        at, start = np.uint64(row), np.uint64(begin)
        for i in range(np.uint64(smaller(moving.shape[1] - begin, _STRIP))):
            marked[place, i] = moving[at, start + i]
        own = marked[place]
        for block in range(0, _STRIP, BLOCK):
            if _any(own, block, BLOCK):
                first, last = smaller(first, block), block + BLOCK
    spans[place, 0], spans[place, 1] = first, last


def _inverses(a: Number, b: Number, c: Number, d: Number) -> tuple[Number, ...]:
    """One over each of four numbers, with one division: 1 / a = b (c d) / ((a b) (c d)), and so on."""
    ab, cd = a * b, c * d
    inverse = ONE / (ab * cd)
    of_ab, of_cd = inverse * cd, inverse * ab
    return of_ab * b, of_ab * a, of_cd * d, of_cd * c


@formula()
def _compare_pixels(
    states: Row,
    allowed: Row,
    own: Number,
    other: Number,
    step: Number,
    differences: Row,
    into: Number,
) -> None:
    """Squared normalised differences of a pixel at ``own`` to four neighbours, three in the row of ``other``."""
    level, variance = states[own + _LEVEL], states[own + _VARIANCE]
    right = states[own + _LEVEL + step] - level
    left_under = states[other + _LEVEL - step] - level
    straight_under = states[other + _LEVEL] - level
    right_under = states[other + _LEVEL + step] - level
    near_slack, far_slack = allowed[own + _STRAIGHT] * _SLACK, allowed[own + _DIAGONAL] * _SLACK
    a = variance + states[own + _VARIANCE + step] + near_slack
    b = variance + states[other + _VARIANCE - step] + far_slack
    c = variance + states[other + _VARIANCE] + near_slack
    d = variance + states[other + _VARIANCE + step] + far_slack
    a, b, c, d = _inverses(a, b, c, d)
    differences[into] = right * right * a
    differences[into + _ONE] = left_under * left_under * b
    differences[into + _TWO] = straight_under * straight_under * c
    differences[into + _THREE] = right_under * right_under * d


@formula()
def _weigh_pixel(states: Row, allowed: Row, own: Number, weights: Row) -> None:
    """Weights of a pixel in the means of its neighbours, 1 / (P' + s^2), where there is no edge."""
    a, b = (states[own + _VARIANCE] + allowed[own + place] for place in (_STRAIGHT, _DIAGONAL))
    inverse = ONE / (a * b)
    weights[own + _STRAIGHT] = b * inverse
    weights[own + _DIAGONAL] = a * inverse


@formula()
def _compare_patches(distances: Row, before: Number, own: Number, after: Number, similarities: Row) -> None:
    """Factors of the weights of a pixel's four neighbours, from three rows around both."""
    places = _ZERO, _ONE, _TWO, _THREE
    edges = (edge(distances[before + k] + distances[own + k] + distances[after + k]) for k in places)
    for k, inverse in zip(places, _inverses(*edges), strict=True):
        similarities[own + k] = squared(inverse)


@nb.njit(cache=True, inline="always")
def _compare_row(  # type: ignore[no-untyped-def]
    row, first, last, pitch, patch, states, allowed, distances, similarities, differences
):
    """Similarities of a row's pixels to their four neighbours in `_Ring`, for columns ``first`` to ``last``.

    Patches are of pixels ``patch`` apart, and reach into the row so far below: that is compared first.
    """
    count = 4 * pitch + 1
    above, here, below, under = (
        np.uint64((row - patch) % count),
        np.uint64(row % count),
        np.uint64((row + patch) % count),
        np.uint64((row + patch + pitch) % count),
    )
    size, step, aside = np.uint64(last - first + 2 * _ASIDE), np.uint64(pitch), np.uint64(patch)
    begin = np.uint64(_MARGIN - _ASIDE + first)
    own, other = below * _TWO + begin, under * _TWO + begin
    for i in range(size):
        _compare_pixels(states, allowed, own + i, other + i, step, differences, begin + i)
    into = below * _FOUR + begin
    for k in range(np.uint64(4)):
        start = begin + k * _ONE
        for i in range(size):
            distances[into + k * _ONE + i] = (
                differences[start - aside + i] + differences[start + i] + differences[start + aside + i]
            )
    before, own = above * _FOUR + begin, here * _FOUR + begin
    for i in range(size):
        _compare_patches(distances, before + i, own + i, into + i, similarities)


@nb.njit(cache=True, inline="always")
def _weigh_row(row, first, last, pitch, states, allowed, weights):  # type: ignore[no-untyped-def]
    """Weights of a row's pixels in the means of their neighbours."""
    place = np.uint64(row % (4 * pitch + 1)) * _TWO + np.uint64(_MARGIN - _ASIDE + first)
    for i in range(np.uint64(last - first + 2 * _ASIDE)):
        _weigh_pixel(states, allowed, place + i, weights)


@formula()
def _average(
    states: Row,
    weights: Row,
    similarities: Row,
    up: Number,
    own: Number,
    down: Number,
    of_up: Number,
    of_own: Number,
    step: Number,
    averaged: Row,
    into: Number,
) -> None:
    """K12 of a pixel, where all neighbours differ alike: their weights are known."""
    beside = _beside(up, own, down, step)
    heard = [(weights[ahead + lies], weights[behind + lies]) for ahead, behind, lies in beside]
    _mean(states, beside, heard, similarities, (own, of_up, of_own), step, averaged, into)


@formula()
def _average_rough(
    states: Row,
    rough: Row,
    times: Row,
    similarities: Row,
    up: Number,
    own: Number,
    down: Number,
    of_up: Number,
    of_own: Number,
    step: Number,
    averaged: Row,
    into: Number,
) -> None:
    """K12 of a pixel from which neighbours differ by so many ``times`` what they do on the surface around them."""
    more, beside = times[into], _beside(up, own, down, step)
    heard = [
        [ONE / (states[place + _VARIANCE] + more * rough[place + lies]) for place in pair]
        for *pair, lies in beside
    ]
    _mean(states, beside, heard, similarities, (own, of_up, of_own), step, averaged, into)


def _beside(up: Number, own: Number, down: Number, step: Number) -> tuple[tuple[Any, ...], ...]:
    """Places of a pixel's neighbours, one ahead and the one opposite to it, and whether they lie straight beside it."""
    return (
        (own + step, own - step, _STRAIGHT),
        (down - step, up + step, _DIAGONAL),
        (down, up, _STRAIGHT),
        (down + step, up - step, _DIAGONAL),
    )


def _mean(
    states: Row,
    beside: tuple[tuple[Any, ...], ...],
    heard: Sequence[Sequence[Number]],
    similarities: Row,
    places: tuple[Number, ...],
    step: Number,
    averaged: Row,
    into: Number,
) -> None:
    """The weighted mean of a pixel and its eight neighbours, and its variance if errors were independent.

    ``heard`` are the weights of the neighbours ``beside`` it where there is no edge.
    """
    own, of_up, of_own = places
    value, variance = states[own + _LEVEL], states[own + _VARIANCE]
    likeness = (
        (of_own, of_own - step),
        (of_own + _ONE, of_up + _ONE + step),
        (of_own + _TWO, of_up + _TWO),
        (of_own + _THREE, of_up + _THREE - step),
    )
    information, deviation = None, None
    for (ahead, behind, _), weights, (onward, back) in zip(beside, heard, likeness, strict=True):
        there, back_there = similarities[onward] * weights[0], similarities[back] * weights[1]
        more = there * (states[ahead + _LEVEL] - value) + back_there * (states[behind + _LEVEL] - value)
        deviation = more if deviation is None else deviation + more
        information = there + back_there if information is None else information + (there + back_there)
    independent = variance / (ONE + variance * information)  # 1 / (1 / variance + information)
    averaged[into] = value + deviation * independent
    averaged[into + _ONE] = independent


@nb.njit(cache=True, inline="always")
def _around(row, first, pitch, count):  # type: ignore[no-untyped-def]
    """Places of a row's ``first`` pixel: in states above, here and below, similarities above and here, and results."""
    above, here, below = (
        np.uint64((row - pitch) % count),
        np.uint64(row % count),
        np.uint64((row + pitch) % count),
    )
    begin = np.uint64(_MARGIN + first)
    up, own, down = above * _TWO + begin, here * _TWO + begin, below * _TWO + begin
    return up, own, down, above * _FOUR + begin, here * _FOUR + begin, begin


@nb.njit(cache=True, inline="always")
def _average_row(  # type: ignore[no-untyped-def]
    row, first, last, pitch, states, weights, similarities, marked, averaged, level
):
    """K12 of a row: ``averaged`` of all pixels from ``first`` to ``last``; ``level`` of the moving ones."""
    count = 4 * pitch + 1
    here, size, step, column = (
        np.uint64(row % count),
        np.uint64(last - first),
        np.uint64(pitch),
        np.uint64(first),
    )
    up, own, down, of_up, of_own, begin = _around(row, first, pitch, count)
    for i in range(size):
        _average(
            states,
            weights,
            similarities,
            up + i,
            own + i,
            down + i,
            of_up + i,
            of_own + i,
            step,
            averaged,
            begin + i,
        )
    for i in range(size):
        alone, together = level[column + i], averaged[begin + i]
        level[column + i] = together if marked[here, column + i] else alone


@inner
def _take_averaged_variance(row, first, last, ring, left):  # type: ignore[no-untyped-def]
    """``left``, the variances of a row, after averaging of the moving pixels."""
    here, column, two = np.uint64(row % len(ring.spans)), np.uint64(first), np.uint64(_ROW + _MARGIN + first)
    for i in range(np.uint64(last - first)):
        alone = left[column + i]
        together = CORRELATED * alone + (ONE - CORRELATED) * ring.averaged[two + i]
        left[column + i] = together if ring.moving[here, column + i] else alone


@nb.njit(cache=True, inline="always", error_model="numpy")
def _shrink_highlights(  # type: ignore[no-untyped-def]
    level, variance, row, start, bright, prior, log_offset, places, excess, doubt, out
):
    """K6 of the bright pixels of a row, gathered so that they go through vector code and others cost nothing."""
    white, scale2, unknown_scale, gain, growth = prior
    count = np.uint64(0)
    for first in range(0, len(level), BLOCK):
        if _any(bright, first, BLOCK):
            for column in range(np.uint64(first), np.uint64(first + BLOCK)):
                places[count] = column
                count += np.uint64(bright[column])
    for k in range(count):
        excess[k] = level[places[k]] - white
        doubt[k] = variance[places[k]]
    for k in range(count):
        believed = believed_highlight(excess[k], doubt[k], scale2, unknown_scale, gain, growth)
        excess[k] = larger(exponential(white + believed) - log_offset, np.float32(0.0))
    for k in range(count):
        out[row, start + places[k]] = excess[k]
