"""Mapped values as whole numbers of 8 or 16 bits."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.compiled import FUSED, ONE, loop
from kalux.display.intensities import Float32


def to_uint8(mapped: NDArray[Any]) -> NDArray[np.uint8]:
    """Values 0 to 1 as uint8, 0 to 255, rounded to nearest; outside is clipped."""
    return _to_integer(mapped, np.empty(np.shape(mapped), np.uint8), 255)


def to_uint16(mapped: NDArray[Any]) -> NDArray[np.uint16]:
    """Values 0 to 1 as uint16, 0 to 65535, rounded to nearest; outside is clipped."""
    return _to_integer(mapped, np.empty(np.shape(mapped), np.uint16), 65535)


def fill(values: Float32, zero: float, scale: float, plane: NDArray[np.uint8]) -> None:
    """Fill a plane with ``zero + scale * values``, rounded; as of `fill_levels`."""
    _fill(np.ascontiguousarray(values, np.float32), np.float32(zero + 0.5), np.float32(scale), plane)


def _to_integer(mapped: NDArray[Any], integers: NDArray[Any], top: int) -> NDArray[Any]:
    values = np.ascontiguousarray(mapped, np.float32)
    quantise(values.reshape(-1), np.float32(top), integers.reshape(-1))
    return integers


# As who calls it: numba would else compile it in the manner of whoever comes first, and keep that for all.
@loop(fastmath=FUSED)
def quantise(values, top, integers):  # type: ignore[no-untyped-def]
    # Added and taken away again, it rounds to a whole number, halves to even ones.
    rounding = np.float32(1.5 * 2**23)
    for i in range(len(values)):
        value = values[i]
        value = value if value > np.float32(0.0) else np.float32(0.0)
        value = value if value < ONE else ONE
        integers[i] = np.int32((value * top + rounding) - rounding)


@loop
def _fill(values, offset, factor, plane):  # type: ignore[no-untyped-def]
    for row in range(len(plane)):
        fill_row(values[min(row, len(values) - 1)], offset, factor, plane[row])


@nb.njit(cache=True, inline="always", error_model="numpy")
def fill_row(values, offset, factor, levels):  # type: ignore[no-untyped-def]
    for column in range(len(values)):
        levels[column] = np.uint8(np.int32(offset + factor * values[column]))
    for column in range(len(values), len(levels)):
        levels[column] = levels[len(values) - 1]
