"""What every curve needs of intensities: that they are finite, limits, and logarithms that are finite too."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kalux.compiled import INFINITE_BITS, magnitude_bits
from kalux.errors import InputError

Float32 = NDArray[np.float32]
Statistics = NDArray[np.float64]

SMALLEST = 1e-3
"""Added before a logarithm, about a quarter of a level of an 8-bit frame: black pixels stay finite."""

LARGEST = 1e30
"""Larger intensities count as this, so that no formula overflows."""


def checked_image(intensity: NDArray[Any]) -> Float32:
    """The intensity, contiguous float32, of a possible shape and finite; `bounded` or the curve limits its values."""
    checked = np.ascontiguousarray(intensity, np.float32)
    if (checked.ndim != 2 and checked.shape[2:] != (3,)) or checked.size == 0:
        raise InputError(
            f"display: the intensity has shape {checked.shape}; (height, width) or (height, width, 3) is needed"
        )
    if magnitude_bits(checked) >= INFINITE_BITS:
        y, x = (int(i[0]) for i in np.nonzero(~np.isfinite(checked))[:2])
        raise InputError(f"display: the intensity at x={x}, y={y} is not finite (NaN or infinite)")
    return checked


def bounded(values: Float32) -> Float32:
    """A copy with values from 0 to `LARGEST`."""
    return np.clip(values, np.float32(0.0), np.float32(LARGEST))


def log_of(intensity: NDArray[Any]) -> Statistics:
    """Logarithms of intensities, finite for black, too."""
    return np.log(np.asarray(intensity, np.float64) + SMALLEST)


def intensities_of(statistics: Statistics) -> tuple[float, float]:
    """The intensities of two statistics that are logarithms; the inverse of `log_of`."""
    first, second = np.maximum(np.exp(statistics) - SMALLEST, 0)
    return float(first), float(second)
