"""How rough surfaces are that no frame around an image measures (docs/equations.md, K12)."""

from __future__ import annotations

import itertools
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.parts import PART, between_parts, part_grid, parts_of, weighted_sums
from kalux.compiled import larger, loop, smaller

_INDEPENDENT: Final = np.float32(0.7)
"""Part of the variances of two neighbours that is in their difference: their errors have correlations of 0.1 to 0.5."""

_EDGE: Final = np.float32(4.0)
"""Squared differences count up to this many times their usual expectation: beyond, there is an edge between."""

_PRIOR_PAIRS: Final = 6.0
"""Pairs of pixels, one apart and exactly known, as which the usual roughness counts."""

_LEAST: Final = 0.1
_MOST: Final = 1.25
"""Least and most standard deviation of neighbours' differences, in units of the usual one: of no surface is it known
that it is even, and what differs by more is seldom texture."""

_BRIGHT: Final = 2.0
_BRIGHTEST: Final = 4.0
_ROUGHER: Final = 0.4
"""Log intensity over white from which, and up to which, surfaces are rougher the brighter they are, and by which part
of what it is for each unit: lamps are small. In the truth of 19 pans neighbours of pixels 2 to 3 beyond white differ
from these by 0.15 (median), of those 3 to 4 beyond by 0.19, 4 to 5 by 0.59, 5 to 7 by 0.83 (docs/equations.md, K12)."""

_FARTHEST: Final = 6
"""Parts on one side, with the one itself, that count for each other: farther ones have less than 1e-7 of its weight."""

_LEAST_PIXELS: Final = 16
"""Of a part that belongs to a surface: a quarter. Single pixels have no neighbours on it to be averaged with."""


def surface_pixels(unmeasured: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Those of the pixels that make up a surface: many in their part of the image, or in one beside it.

    Both are indices in the flattened image, ascending.
    """
    part, (rows, columns) = parts_of(unmeasured, shape), part_grid(shape)
    many = np.bincount(part, minlength=rows * columns).reshape(rows, columns) >= _LEAST_PIXELS
    near = cv2.dilate(many.view(np.uint8), np.ones((3, 3), np.uint8)).view(np.bool_)
    return unmeasured[near.reshape(-1)[part]]


def surface_variance(
    level: NDArray[np.float32],
    variance: NDArray[np.float32],
    surface: NDArray[np.bool_],
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
        (H, W) L and its variance.
    surface
        (H, W): its pixels.
    usual
        What it is where nothing else is known, log intensity^2.
    pitch
        Distance of the neighbours, pixels.
    out
        (H, W), filled with it, log intensity^2: of pixels beside the surface half-way to what it is usually, which it
        is elsewhere.
    """
    excess, certainty = np.zeros((2, *part_grid(level.shape)))
    _compare_neighbours(level, variance, surface, usual, pitch, excess, certainty)
    prior = _PRIOR_PAIRS / float(usual) ** 2
    found = (weighted_sums(excess, _FARTHEST) + prior * float(usual)) / (
        weighted_sums(certainty, _FARTHEST) + prior
    )
    limited = np.clip(found, _LEAST**2 * usual, _MOST**2 * usual).astype(np.float32)
    near = cv2.dilate(surface.view(np.uint8), np.ones((4 * pitch + 1, 4 * pitch + 1), np.uint8))
    _spread(limited, surface, near, usual, out)


def rougher_where_bright(
    level: NDArray[np.float32], white: np.float32, pitch: int, out: NDArray[np.float32]
) -> None:
    """Fill (H, W): by how many times that variance the neighbours of a pixel differ from it, where it may be of a lamp.

    By the median of L, whose white is ``white``, of it and its neighbours, so that not where it alone is bright: 1 up
    to 2 beyond white, 3.2 from 4 on.
    """
    _take_medians(level, pitch, out)
    _make_rougher(out, white)


def _take_medians(level: NDArray[np.float32], pitch: int, out: NDArray[np.float32]) -> None:
    """Of every pixel and its eight neighbours, ``pitch`` apart: that of a single bright one is as those around it."""
    for row, column in itertools.product(range(pitch), repeat=2):
        out[row::pitch, column::pitch] = cv2.medianBlur(
            np.ascontiguousarray(level[row::pitch, column::pitch]), 3
        )


@loop
def _spread(limited, surface, near, usual, variances):  # type: ignore[no-untyped-def]
    """Fill the variances from those of parts: all of it on the surface, half of it near to it, elsewhere the usual."""
    for row in range(surface.shape[0]):
        for column in range(surface.shape[1]):
            variance = usual
            if near[row, column]:
                variance = between_parts(limited, row, column)
                if not surface[row, column]:
                    variance = (variance + usual) / np.float32(2.0)
            variances[row, column] = variance


@loop
def _make_rougher(level, white):  # type: ignore[no-untyped-def]
    """From L to how many times the variance is, in place."""
    for row in range(level.shape[0]):
        for column in range(level.shape[1]):
            beyond = smaller(larger(level[row, column] - white, np.float32(_BRIGHT)), np.float32(_BRIGHTEST))
            more = np.float32(1.0) + np.float32(_ROUGHER) * (beyond - np.float32(_BRIGHT))
            level[row, column] = more * more


@loop
def _compare_neighbours(level, variance, surface, usual, pitch, excess, certainty):  # type: ignore[no-untyped-def]
    """Sums over pairs, in every part: by how much squares exceed the noise, and what they would for a variance of 1."""
    height, width = level.shape
    for row, column in np.ndindex(height, width):
        if not surface[row, column]:
            continue
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
            more += np.float64(weight * (square - _INDEPENDENT * explained))
            sure += np.float64(weight * distance2)
        excess[row // PART, column // PART] += more
        certainty[row // PART, column // PART] += sure
