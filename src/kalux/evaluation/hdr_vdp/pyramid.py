"""The steerable pyramid with one orientation, built by filters in space, borders mirrored at the edge pixels."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from kalux.compiled import loop
from kalux.evaluation.hdr_vdp import constants as c

Array = NDArray[np.float64]

SMALLEST_SIDE: Final = 2 * len(c.HIGH_RESIDUAL) - 1
"""Pixels: the first filter must fit into the image."""

LOWEST_RESOLUTION: Final = 2.0
"""Pixels per degree, beyond which there is a band below the high-frequency residual."""

HIGHEST_RESOLUTION: Final = 1000.0
"""Pixels per degree: the eye tells 60 apart, and filters of far more are too narrow to be numbers."""


def height(shape: tuple[int, ...], pixels_per_degree: float) -> int:
    """Levels of band-pass filters: to 1 to 2 cycles per degree, or to where the low-pass filter no longer fits."""
    wanted = int(np.ceil(np.log2(pixels_per_degree))) - 2
    side, fitting = min(shape), 0
    while side >= 2 * len(c.LOW_PASS) - 1:
        side, fitting = side // 2, fitting + 1
    return min(wanted, fitting)


def frequencies(levels: int, pixels_per_degree: float) -> list[float]:
    """Of the bands that `decompose` returns, cycles per degree."""
    return [pixels_per_degree / 2 / 2**band for band in range(levels + 2)]


def decompose(image: Array, levels: int) -> list[Array]:
    """High-frequency residual, ``levels`` bands, and base band, each half the size of the one before from the third on.

    Amplitudes, which grow twofold from level to level, are brought back to those of the image; the mean of the base
    band is taken out.
    """
    bands = [correlate(image, "HIGH_RESIDUAL")]
    low = correlate(image, "LOW_RESIDUAL")
    for level in range(1, levels + 1):
        bands.append(correlate(low, "BAND") / 2**level)
        low = correlate(low, "LOW_PASS", step=2)
    low /= 2 ** (levels + 1)
    return [*bands, low - low.mean()]


def correlate(image: Array, name: str, step: int = 1) -> Array:
    """Correlation with a filter of `constants`, at every ``step``-th row and column."""
    quadrant = _quadrant(name)
    padded = np.pad(image, len(quadrant) - 1, mode="reflect")
    out = np.zeros([-(-side // step) for side in image.shape])
    _correlate(padded, quadrant, step, out)
    return out


@lru_cache(maxsize=4)
def _quadrant(name: str) -> Array:
    return np.array(getattr(c, name))


@loop(error_model="python")
def _correlate(padded, quadrant, step, out):  # type: ignore[no-untyped-def]
    """Rows at equal distance from the centre are added first, then columns, so each tap is multiplied once."""
    reach = len(quadrant) - 1
    width = out.shape[1]
    for i in range(out.shape[0]):
        centre = i * step + reach
        for v in range(reach + 1):
            rows = padded[centre] if v == 0 else padded[centre - v] + padded[centre + v]
            for j in range(width):
                out[i, j] += quadrant[v, 0] * rows[j * step + reach]
            for u in range(1, reach + 1):
                for j in range(width):
                    at = j * step + reach
                    out[i, j] += quadrant[v, u] * (rows[at - u] + rows[at + u])
