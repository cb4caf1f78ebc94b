"""Parts of an image, squares of 8x8 pixels, over which what is rare is summed; they count for each other if near."""

from __future__ import annotations

import functools
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.compiled import inner, larger, loop, smaller, zeros

Floats = NDArray[np.floating[Any]]

PART: Final = 8
"""Side of the parts, pixels."""

_RANGE: Final = 8.0
"""Standard deviation, pixels, of the normal weights by which parts count for each other. 4, 8 and 12 explain the excess
of clipped pixels of 48 simulated scenes equally well."""

ALL: Final = 39
"""Parts on one side, with the one itself, whose weights double precision tells from 0."""


def part_grid(shape: tuple[int, ...]) -> tuple[int, int]:
    """Rows and columns of parts of an image of ``shape``."""
    height, width = shape
    return -(-height // PART), -(-width // PART)


def parts_of(pixels: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.int64]:
    """(N,) numbers of the parts, row after row, that pixels of an image of ``shape`` lie in."""
    row, column = np.divmod(pixels, shape[1])
    part: NDArray[np.int64] = row // PART * part_grid(shape)[1] + column // PART
    return part


def interpolated(parts: NDArray[np.float32], pixels: NDArray[np.int64], width: int) -> NDArray[np.float32]:
    """(N,) values of the ``parts`` at pixels, interpolated linearly between the middles of the parts."""
    values = np.empty(len(pixels), np.float32)
    _at_pixels(pixels, width, parts, values)
    return values


def interpolated_plane(parts: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """(H, W) values of the ``parts`` at all pixels of an image of ``shape``, as `interpolated`."""
    height, width = shape
    size = parts.shape[1] * PART, parts.shape[0] * PART
    whole = cv2.resize(parts, size, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(whole[:height, :width], np.float32)


@loop
def _at_pixels(pixels, width, parts, values):  # type: ignore[no-untyped-def]
    for i in range(len(pixels)):
        row, column = divmod(pixels[i], width)
        values[i] = between_parts(parts, row, column)


@inner
def between_parts(parts, row, column):  # type: ignore[no-untyped-def]
    """Value of the float32 ``parts`` at a pixel: `interpolated`."""
    one, zero = np.float32(1.0), np.float32(0.0)
    last_row, last_column = parts.shape[0] - 1, parts.shape[1] - 1
    y = larger((np.float32(row) + np.float32(0.5)) / np.float32(PART) - np.float32(0.5), zero)
    x = larger((np.float32(column) + np.float32(0.5)) / np.float32(PART) - np.float32(0.5), zero)
    top, left = smaller(np.int64(y), last_row), smaller(np.int64(x), last_column)
    below, beside = smaller(top + 1, last_row), smaller(left + 1, last_column)
    down, right = y - np.float32(top), x - np.float32(left)
    upper = parts[top, left] * (one - right) + parts[top, beside] * right
    lower = parts[below, left] * (one - right) + parts[below, beside] * right
    return upper * (one - down) + lower * down


def part_sums(values: NDArray[Any]) -> Floats:
    """Sums over the pixels of every part."""
    height, width = values.shape
    below, right = -height % PART, -width % PART
    plane: NDArray[Any] = values.astype(np.float32, copy=False)
    if below or right:
        plane = cv2.copyMakeBorder(plane, 0, below, 0, right, cv2.BORDER_CONSTANT, value=0.0)
    size = (plane.shape[1] // PART, plane.shape[0] // PART)
    means = cv2.resize(plane, size, interpolation=cv2.INTER_AREA)
    return np.asarray(means, np.float64) * (PART * PART)


@functools.cache
def weighted_area(shape: tuple[int, int]) -> Floats:
    """Weighted number of pixels around every part. Not to be changed, since it is cached."""
    return weighted_sums(part_sums(np.ones(shape, np.float32)))


def weighted_sums(parts: Floats, farthest: int = ALL) -> Floats:
    """For every part, the sum over the parts up to the ``farthest`` one, weighted by their nearness.

    Not as a product of matrices: the last bits of BLAS depend on the number of threads.
    """
    near = np.zeros(parts.shape)
    _weigh(np.ascontiguousarray(parts, np.float64), *(_weights(min(n, farthest)) for n in parts.shape), near)
    return near


@loop
def _weigh(parts, below, beside, near):  # type: ignore[no-untyped-def]
    """Add up first the parts of each column, then of each row, beside which there are zeros."""
    (height, width), reach, margin = parts.shape, len(below) // 2, len(beside) // 2
    of_columns = zeros(width + 2 * margin, np.float64)
    for row in range(height):
        of_columns[:] = 0.0
        for k in range(larger(reach - row, 0), smaller(len(below), height + reach - row)):
            other, weight = row + k - reach, below[k]
            for i in range(np.uint64(width)):
                of_columns[np.uint64(margin) + i] += weight * parts[other, i]
        for k in range(len(beside)):
            weight, first = beside[k], np.uint64(k)
            for i in range(np.uint64(width)):
                near[row, i] += weight * of_columns[first + i]


@functools.cache
def _weights(reach: int) -> Floats:
    """Weights of a part and of those on both sides of it, of each ``reach`` with itself."""
    distance = PART * np.arange(1 - reach, reach)
    nearness: Floats = np.exp(-0.5 * (distance / _RANGE) ** 2)
    return nearness
