"""The curve `Clahe`: distributions of the log intensity in tiles, and the equalisation between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kalux.display.intensities import SMALLEST, Float32, Statistics, log_of
from kalux.display.percentiles import percentiles, sampled
from kalux.display.settings import BINS, Clahe


def measure_clahe(intensity: Float32, curve: Clahe) -> Statistics:
    """Log limits of the image, then tiles x tiles distributions at BINS + 1 edges, in one vector."""
    limits = log_of(percentiles(sampled(intensity), [0.1, 99.9]))
    position = _log_position(intensity, limits)
    bins = np.minimum(position.astype(np.int64), BINS - 1)
    rows = np.arange(intensity.shape[0]) * curve.tiles // intensity.shape[0]
    columns = np.arange(intensity.shape[1]) * curve.tiles // intensity.shape[1]
    tile = rows[:, None] * curve.tiles + columns[None, :]
    counts = np.bincount((tile * BINS + bins).ravel(), minlength=curve.tiles**2 * BINS)
    distributions = _limited_distributions(counts.reshape(-1, BINS).astype(np.float64), curve.clip)
    return np.concatenate([limits, distributions.ravel()])


def map_clahe(intensity: Float32, curve: Clahe, statistics: Statistics) -> Float32:
    """Equalise an image by the distributions of `measure_clahe`, linear between the centres of tiles."""
    tiles = curve.tiles
    distributions = statistics[2:].astype(np.float32).reshape(tiles, tiles, BINS + 1)
    position = _log_position(intensity, statistics[:2])
    below = np.minimum(position.astype(np.int32), BINS - 1)
    part = position - below
    row, row_part = _tile_position(intensity.shape[0], tiles)
    column, column_part = _tile_position(intensity.shape[1], tiles)
    flat = distributions.ravel()
    mapped = np.zeros(intensity.shape, np.float32)
    for down in (0, 1):
        weight_row = row_part if down else 1 - row_part
        tile_row = np.minimum(row + down, tiles - 1)
        for right in (0, 1):
            weight = weight_row[:, None] * (column_part if right else 1 - column_part)[None, :]
            tile = tile_row[:, None] * tiles + np.minimum(column + right, tiles - 1)[None, :]
            index = tile * (BINS + 1) + below
            low = flat[index]
            mapped += weight * (low + part * (flat[index + 1] - low))
    return mapped


def _limited_distributions(counts: Statistics, clip: float) -> Statistics:
    """Cumulative distributions, 0 to 1, of histograms (n, BINS) clipped at ``clip`` times the mean."""
    total = counts.sum(axis=1, keepdims=True)
    shares = np.where(total > 0, counts / np.maximum(total, 1), 1 / BINS)
    # What is cut off is spread over all bins. The cut lies so far below the limit that none then exceeds it.
    low, high = np.zeros((len(counts), 1)), np.full((len(counts), 1), clip / BINS)
    for _ in range(24):
        cut = (low + high) / 2
        too_low = np.minimum(shares, cut).sum(axis=1, keepdims=True) + clip - BINS * cut > 1
        low, high = np.where(too_low, cut, low), np.where(too_low, high, cut)
    clipped = np.minimum(shares, high)
    clipped += (1 - clipped.sum(axis=1, keepdims=True)) / BINS
    return np.concatenate([np.zeros((len(counts), 1)), np.cumsum(clipped, axis=1)], axis=1)


def _log_position(intensity: Float32, limits: Statistics) -> Float32:
    """The log intensity between its limits, 0 to BINS."""
    low, high = float(limits[0]), float(limits[1])
    scale = BINS / max(high - low, 1e-3)
    position: Float32 = (np.log(intensity + np.float32(SMALLEST)) - np.float32(low)) * np.float32(scale)
    return np.clip(position, np.float32(0), np.float32(BINS), out=position)


def _tile_position(size: int, tiles: int) -> tuple[NDArray[np.int32], Float32]:
    """For every pixel of an axis: the tile whose centre lies before it, and how far on it is to the next."""
    centred = np.clip((np.arange(size) + 0.5) * tiles / size - 0.5, 0, tiles - 1)
    before = centred.astype(np.int32)
    return before, (centred - before).astype(np.float32)
