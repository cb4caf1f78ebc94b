"""Robust regressions on event counts, which are wrong themselves: by instruments."""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]

NORMAL_MAD: Final = 1.4826  # standard deviation over median absolute deviation, of a normal distribution
HUBER: Final = 1.345  # 95 % efficiency for normal residuals (Huber 1981)

_ITERATIONS: Final = 40
_LARGEST_CONDITION: Final = 1e6
_LEAST_SCALE: Final = 1e-9  # an exact fit: nothing to weigh down
_TILES: Final = 8  # per side: blocks of the jackknife
_LEAST_TILES: Final = 4


class Fit(NamedTuple):
    """A regression by instruments.

    Attributes
    ----------
    solution
        (K,) coefficients.
    residual
        Robust standard deviation of the residuals.
    weights
        (N,) Huber's weights.
    """

    solution: Array
    residual: float
    weights: Array


def two_stage(values: Array, explained: Array, instruments: Array) -> Fit | None:
    """Coefficients of (N, K) ``explained`` in (N,) ``values`` by two-stage least squares with Huber's weights.

    The columns of ``explained`` may have errors that those of ``instruments``, as many, do not share: least squares
    would then give too small coefficients (attenuation). With ``explained`` themselves for instruments this is least
    squares. None where the coefficients are not determined.
    """
    columns, instrument_columns = (np.ascontiguousarray(matrix.T) for matrix in (explained, instruments))
    weights = np.ones(len(values))
    solution: Array = np.zeros(len(columns))
    scale = 0.0
    for _ in range(_ITERATIONS):
        weighted = instrument_columns * weights
        normal = products(weighted, columns)
        if not np.linalg.cond(normal) <= _LARGEST_CONDITION:
            return None
        previous = solution
        solution = np.linalg.solve(normal, products(weighted, values[None])[:, 0]).astype(np.float64)
        predicted = sum(coefficient * column for coefficient, column in zip(solution, columns, strict=True))
        weights, scale = huber_weights(values - predicted)
        if np.abs(solution - previous).max() < 1e-5:
            break
    return Fit(solution, scale, weights)


def halves(changes: Array) -> Array:
    """(N, 2) the part upwards and the part downwards of (N,) changes of frames: instruments for thresholds.

    A pixel is looked at if both of its frames are well exposed: changes are selected, counts only through these. What
    frames say explains counts without bias whatever is selected by it. The other way round, where frames show a range
    of a few thresholds, those counts are kept that say too much, and thresholds come out too small.
    """
    return np.column_stack([np.maximum(changes, 0.0), np.minimum(changes, 0.0)])


def weighted_least_squares(values: Array, explained: Array, weights: Array) -> Array:
    """(K,) coefficients of (N, K) ``explained`` in (N,) ``values``, with (N,) ``weights``."""
    columns = np.ascontiguousarray(explained.T)
    weighted = columns * weights
    normal, right = products(weighted, columns), products(weighted, values[None])
    return np.asarray(np.linalg.solve(normal, right)[:, 0], np.float64)


def products(first: Array, second: Array) -> Array:
    """(K, M) sums over N of the products of (K, N) and (M, N).

    By no BLAS: that adds up in as many parts as it takes threads, so that the last bits depend on the machine, and
    its threads wait for each other.
    """
    return np.asarray(np.einsum("kn,mn->km", first, second), np.float64)


def huber_weights(residuals: Array) -> tuple[Array, float]:
    """Huber's weights of residuals, and their robust standard deviation."""
    away = np.abs(residuals)
    scale = max(_deviation(away), _LEAST_SCALE)
    return np.minimum(1.0, HUBER * scale / np.maximum(away, 1e-3 * _LEAST_SCALE)), scale


def robust_deviation(residuals: Floats) -> float:
    """Standard deviation about 0, from the median absolute value, as normal residuals have it; of one or more."""
    return _deviation(np.abs(residuals))


def _deviation(away: Floats) -> float:
    """By the median, which NumPy takes five to ten times as long for: it asks for three places at once."""
    half = len(away) // 2
    parted = np.partition(away, half)
    return NORMAL_MAD * float(parted[half] if len(away) % 2 else (parted[:half].max() + parted[half]) / 2)


def parts(shape: tuple[int, int]) -> NDArray[np.int64]:
    """(H, W) which of 8 x 8 parts of the sensor a pixel lies in, for a jackknife."""
    height, width = shape
    return (np.arange(height)[:, None] * _TILES // height) * _TILES + np.arange(width) * _TILES // width


def grid_step(shape: tuple[int, int], most: int) -> int:
    """From one row, or column, to the next of a grid over the sensor that has about ``most`` pixels, or fewer."""
    height, width = shape
    return math.ceil(math.sqrt(height * width / most))


def ratio_error(sums: Array) -> float:
    """Standard error of the ratio of two sums, (N, 2) over parts of the sensor: jackknife; inf if too few tell."""
    rest = sums.sum(axis=0) - sums
    rest = rest[rest[:, 1] > 0]
    return float(np.sqrt((len(rest) - 1) * np.var(rest[:, 0] / rest[:, 1]))) if len(rest) > 1 else np.inf


def standard_errors(
    values: Array,
    explained: Array,
    instruments: Array,
    weights: Array,
    pixel: NDArray[np.int64],
    shape: tuple[int, int],
) -> Array:
    """Of the coefficients of `two_stage`: jackknife over 8 x 8 parts of the sensor, weights kept; inf if too few tell.

    ``pixel`` (N,) is the index of every sample's pixel in a sensor of ``shape``.
    """
    tile = parts(shape).ravel()[pixel]
    weighted = instruments * weights[:, None]
    size, count = _TILES**2, explained.shape[1]
    normal, right = np.zeros((size, count, count)), np.zeros((size, count))
    for i in range(count):
        right[:, i] = np.bincount(tile, weighted[:, i] * values, size)
        for j in range(count):
            normal[:, i, j] = np.bincount(tile, weighted[:, i] * explained[:, j], size)
    used = np.flatnonzero(np.abs(normal).sum(axis=(1, 2)) > 0)
    without = [
        np.linalg.solve(normal.sum(axis=0) - normal[k], right.sum(axis=0) - right[k])
        for k in used
        if np.linalg.cond(normal.sum(axis=0) - normal[k]) < 100 * _LARGEST_CONDITION
    ]
    if len(without) < _LEAST_TILES:
        return np.full(count, np.inf)
    spread: Array = np.sqrt((len(without) - 1) * np.var(np.array(without), axis=0))
    return spread
