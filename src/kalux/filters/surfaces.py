"""Pixels that no frame around an image measures: which make up surfaces, and how rough these are (K12).

What follows from the pixels alone is found once for all images between two frames.
"""

from __future__ import annotations

import functools
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.parts import PART, between_parts, part_grid, parts_of
from kalux.augmentation.texture import INDEPENDENT, Texture, neighbour_variance
from kalux.compiled import ONE, empty, inner, loop, smaller
from kalux.formulas import Number, Pixels, larger_of, row_formula, smaller_of, squared

_EDGE: Final = np.float32(4.0)
"""Squared differences count up to this many times their usual expectation: beyond, there is an edge between."""

_MOST: Final = 1.25
"""Most standard deviation of neighbours' differences, in units of the usual one: what differs by more is seldom
texture."""

_BRIGHT: Final = 2.0
_BRIGHTEST: Final = 4.0
_ROUGHER: Final = 0.4
"""Log intensity over white from which, and up to which, surfaces are rougher the brighter they are, and by which part
of what it is for each unit: lamps are small. In the truth of 19 pans neighbours of pixels 2 to 3 beyond white differ
from these by 0.15 (median), of those 3 to 4 beyond by 0.19, 4 to 5 by 0.59, 5 to 7 by 0.83 (docs/equations.md, K12)."""

_LEAST_PIXELS: Final = 16
"""Of a part that belongs to a surface: a quarter. Single pixels have no neighbours on it to be averaged with."""

BLOCK: Final = 32
"""Pixels of a row in a block: blocks without any that is averaged, or without highlights, are skipped."""

_REACH: Final = 4
"""Pixels around a surface that its means look at, at most, times the pitch of its pixels: neighbours twice as far away,
and the patches around them. As many rows before a pixel's own are compared."""


class Surface(NamedTuple):
    """Pixels that make up surfaces, and the blocks of `BLOCK` pixels of a row in which there is something to do.

    Attributes
    ----------
    pixels
        (N,) indices in the flattened image, ascending.
    mask
        (H, W) bool: the same.
    near
        (H, W) bool: up to two neighbours away from them.
    own
        (H, B) bool: blocks with such pixels.
    compared
        (H, B) bool: blocks that are compared with those below before such a pixel is averaged.
    seen
        (H, B) bool: blocks that means look at.
    """

    pixels: NDArray[np.int64]
    mask: NDArray[np.bool_]
    near: NDArray[np.bool_]
    own: NDArray[np.bool_]
    compared: NDArray[np.bool_]
    seen: NDArray[np.bool_]


class Unmeasured:
    """Pixels that neither of the frames around an image measures, nor the only one known.

    Parameters
    ----------
    pixels
        (N,) their indices in the flattened image, ascending.
    shape
        Of the image, (H, W).
    """

    def __init__(self, pixels: NDArray[np.int64], shape: tuple[int, ...]) -> None:
        self.pixels = pixels
        self.shape = shape
        self._surface: tuple[NDArray[np.int64] | None, int, Surface] | None = None

    @functools.cached_property
    def mask(self) -> NDArray[np.bool_]:
        """(H, W): the same. Not to be changed."""
        return _marked(self.pixels, self.shape)

    def surface(self, unshown: NDArray[np.int64] | None, pitch: int) -> Surface:
        """Those that make up a surface, without the ``unshown``, which no other frame has shown either.

        ``pitch`` is the distance of neighbours. Not to be changed, since it is kept for other images.
        """
        kept = self._surface  # another thread may replace it
        if kept is None or kept[1] != pitch or not _same(kept[0], unshown):
            kept = unshown, pitch, surface_of(self._without(unshown), self.shape, pitch)
            self._surface = kept
        return kept[2]

    def _without(self, unshown: NDArray[np.int64] | None) -> NDArray[np.int64]:
        if unshown is None:
            return self.pixels
        return self.pixels[~_marked(unshown, self.shape).reshape(-1)[self.pixels]]


def _same(one: NDArray[np.int64] | None, other: NDArray[np.int64] | None) -> bool:
    if one is None or other is None:
        return one is other
    return one is other or np.array_equal(one, other)


def surface_of(unmeasured: NDArray[np.int64], shape: tuple[int, ...], pitch: int) -> Surface:
    """Those of the pixels that make up a surface: many in their part of the image, or in one beside it.

    ``unmeasured`` are indices in the flattened image, ascending, ``pitch`` the distance of neighbours.
    """
    part, (rows, columns) = parts_of(unmeasured, shape), part_grid(shape)
    many = np.bincount(part, minlength=rows * columns).reshape(rows, columns) >= _LEAST_PIXELS
    pixels = unmeasured[_widened(many, 1, 1).reshape(-1)[part]]
    mask, reach = _marked(pixels, shape), _REACH * pitch
    around = _widened(mask, reach, reach)
    own = _blocks(mask)
    return Surface(
        pixels, mask, _widened(mask, 2 * pitch, 2 * pitch), own, _widened(own, reach, 0), _blocks(around)
    )


def _marked(pixels: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    mask = np.zeros(shape, np.bool_)
    mask.reshape(-1)[pixels] = True
    return mask


def _widened(mask: NDArray[np.bool_], rows: int, columns: int) -> NDArray[np.bool_]:
    """``mask``, and what is up to so many rows and columns beside it."""
    near = cv2.dilate(mask.view(np.uint8), np.ones((2 * rows + 1, 2 * columns + 1), np.uint8))
    return np.asarray(near).view(np.bool_)


def _blocks(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(H, B): blocks of a row with any."""
    whole = np.pad(mask, ((0, 0), (0, -mask.shape[1] % BLOCK)))
    return np.asarray(whole.reshape(len(mask), -1, BLOCK).any(axis=2))


def surface_variance(
    level: NDArray[np.float32],
    variance: NDArray[np.float32],
    surface: Surface,
    usual: np.float32,
    pitch: int,
    out: NDArray[np.float32],
) -> None:
    """Variance by which neighbours one apart differ on the surface around each pixel.

    It is what the squared differences of neighbours, of which at least one is on the surface, are more than the
    variances explain: their mean, weighted by how much each tells, over the parts of the image around.

    Parameters
    ----------
    level, variance
        (H, W) L and its variance, in the blocks that are seen.
    surface
        Its pixels.
    usual
        What it is where nothing else is known, log intensity^2.
    pitch
        Distance of the neighbours, pixels.
    out
        (H, W), filled with it in the blocks that are seen, log intensity^2: of pixels beside the surface half-way to
        what it is usually, which it is elsewhere.
    """
    excess, certainty = np.zeros((2, *part_grid(level.shape)))
    _compare_neighbours(level, variance, surface.pixels, surface.mask, usual, pitch, excess, certainty)
    limited = neighbour_variance([Texture(excess, certainty)], float(usual), _MOST)
    _spread(limited, surface.mask, surface.near, surface.seen, usual, out)


@loop
def _spread(limited, surface, near, seen, usual, variances):  # type: ignore[no-untyped-def]
    """Fill the variances from those of parts: all of it on the surface, half of it near to it, elsewhere the usual."""
    width = surface.shape[1]
    for row, block in np.ndindex(seen.shape):
        if not seen[row, block]:
            continue
        for column in range(BLOCK * block, smaller(BLOCK * (block + 1), width)):
            variance = usual
            if near[row, column]:
                variance = between_parts(limited, row, column)
                if not surface[row, column]:
                    variance = (variance + usual) / np.float32(2.0)
            variances[row, column] = variance


def rougher_where_bright(
    level: NDArray[np.float32],
    own: NDArray[np.bool_],
    white: np.float32,
    pitch: int,
    out: NDArray[np.float32],
) -> None:
    """Fill in by how many times that variance neighbours of a pixel differ from it, where it may be of a lamp.

    By the median of L, whose white is ``white``, of it and its eight neighbours, ``pitch`` apart, so that not where it
    alone is bright: 1 up to 2 beyond white, 3.2 from 4 on. Beyond the image neighbours are as the last ones within.

    Parameters
    ----------
    level, out
        (H, W): L, around the blocks, and what is filled in.
    own
        (H, B): the blocks that are filled.
    """
    _fill_rougher(level, own, white, pitch, out.reshape(-1))


@loop
def _fill_rougher(level, own, white, pitch, out):  # type: ignore[no-untyped-def]
    height, width = level.shape
    length = width + 2 * pitch
    near = empty(3 * length, np.float32)  # three rows, with margins
    step, row_step = np.uint64(pitch), np.uint64(length)
    for row in range(height):
        begin, behind = next_run(own, row, np.int64(0), width)
        while begin < behind:
            end, start = smaller(behind, width), np.uint64(begin)
            for k in range(3):
                beside = row + (k - 1) * pitch
                at = np.uint64(row if beside < 0 or beside >= height else beside)
                into = np.uint64(k * length + pitch)
                for i in range(np.uint64(end - begin)):
                    near[into + start + i] = level[at, start + i]
                for i in range(pitch):
                    left, right = begin - pitch + i, end + i
                    before = np.uint64(left if left >= 0 else left + pitch)
                    after = np.uint64(right if right < width else right - pitch)
                    near[into + np.uint64(left)], near[into + np.uint64(right)] = (
                        level[at, before],
                        level[at, after],
                    )
            above, here, below = start, start + row_step, start + row_step + row_step
            # fmt: off
            _make_rougher(
                np.uint64(end - begin), out, np.uint64(row * width + begin),
                near, above, near, above + step, near, above + step + step,
                near, here, near, here + step, near, here + step + step,
                near, below, near, below + step, near, below + step + step, white,
            )
            # fmt: on
            begin, behind = next_run(own, row, behind, width)


@row_formula
def _make_rougher(
    more: Pixels,
    a: Pixels,
    b: Pixels,
    c: Pixels,
    d: Pixels,
    e: Pixels,
    f: Pixels,
    g: Pixels,
    h: Pixels,
    i: Pixels,
    white: Number,
) -> None:
    """`rougher_where_bright` of a row, by L of three times three pixels."""
    rows = (_sorted(*(row[0] for row in rows)) for rows in ((a, b, c), (d, e, f), (g, h, i)))
    lowest, middle, highest = zip(*rows, strict=True)
    # The median is that of the largest of the lowest, the middle one of the middle ones, the smallest of the highest.
    median = _sorted(_sorted(*lowest)[2], _sorted(*middle)[1], _sorted(*highest)[0])[1]
    beyond = smaller_of(larger_of(median - white, np.float32(_BRIGHT)), np.float32(_BRIGHTEST))
    more[0] = squared(ONE + np.float32(_ROUGHER) * (beyond - np.float32(_BRIGHT)))


def _sorted(one: Number, two: Number, three: Number) -> tuple[Number, Number, Number]:
    """From the least on."""
    low, high = smaller_of(one, two), larger_of(one, two)
    rest = smaller_of(high, three)
    return smaller_of(low, three), larger_of(low, rest), larger_of(high, three)


@inner
def next_run(blocks, row, column, end):  # type: ignore[no-untyped-def]
    """Where the next marked ``blocks`` of a row begin, from ``column`` on, and end; the same if there are none.

    ``column`` begins a block, and all begin before ``end``; the last may reach beyond it.
    """
    block, behind = column // BLOCK, -(-end // BLOCK)
    while block < behind and not blocks[row, block]:
        block += 1
    first = block
    while block < behind and blocks[row, block]:
        block += 1
    return first * BLOCK, block * BLOCK


@loop
def _compare_neighbours(  # type: ignore[no-untyped-def]
    level, variance, pixels, surface, usual, pitch, excess, certainty
):
    """Sums over pairs, in every part: by how much squares exceed the noise, and what they would for a variance of 1.

    A pair of which both are on the surface counts for the first of them, else for the one that is.
    """
    height, width = level.shape
    for pixel in pixels:
        row, column = pixel // width, pixel % width
        one, noise = level[row, column], variance[row, column]
        more, sure = 0.0, 0.0
        for k in range(9):
            down, right = k // 3 - 1, k % 3 - 1
            other, beside = row + down * pitch, column + right * pitch
            if k == 4 or other < 0 or beside < 0 or other >= height or beside >= width:
                continue
            if k < 4 and surface[other, beside]:  # this pair has been counted
                continue
            distance2 = np.float32((down * down + right * right) * pitch * pitch)
            explained = noise + variance[other, beside]
            expected = explained + usual * distance2
            difference = level[other, beside] - one
            square = smaller(difference * difference, _EDGE * expected)
            weight = distance2 / (expected * expected)
            more += np.float64(weight * (square - INDEPENDENT * explained))
            sure += np.float64(weight * distance2)
        excess[row // PART, column // PART] += more
        certainty[row // PART, column // PART] += sure
