"""Pixels of frames, their neighbours of the same colour, and what stands for those that are stuck."""

from __future__ import annotations

import warnings
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_BESIDE: Final = tuple((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if y or x)


def around(values: NDArray[Any], pitch: int, beyond: float) -> NDArray[Any]:
    """(8, H, W) values of the eight neighbours of every pixel of (H, W), ``pitch`` pixels away: 2 in a Bayer mosaic.

    ``beyond`` is what lies beyond the border.
    """
    height, width = values.shape
    padded = np.pad(values, pitch, constant_values=beyond)
    return np.stack(
        [
            padded[pitch * (1 + y) : pitch * (1 + y) + height, pitch * (1 + x) : pitch * (1 + x) + width]
            for y, x in _BESIDE
        ]
    )


def without_stuck(image: NDArray[Any], stuck: NDArray[np.bool_], pitch: int) -> NDArray[Any]:
    """The image, (H, W) or (H, W, 3), in which stuck pixels are the median of their neighbours that are not.

    Those without such a neighbour stay as they are.
    """
    rows, columns = np.nonzero(stuck)
    height, width = stuck.shape
    y = rows + pitch * np.array([[y] for y, _ in _BESIDE])
    x = columns + pitch * np.array([[x] for _, x in _BESIDE])
    inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
    y, x = np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)
    good = inside & ~stuck[y, x]
    beside = image[y, x].astype(np.float64)
    beside[~good] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of pixels without good neighbours
        middle = np.nanmedian(beside, axis=0)
    middle = np.where(np.isnan(middle), image[rows, columns], middle)
    mended = image.copy()
    mended[rows, columns] = np.rint(middle) if image.dtype.kind == "u" else middle
    return mended
