"""Bicubic resampling of maps to the size of a band, as ``imresize`` does it."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

Array = NDArray[np.float64]


def resize(image: Array, shape: tuple[int, ...]) -> Array:
    """An image of the same extent with other pixels; the kernel widens with the pixels when they grow."""
    if image.shape == shape:
        return image
    rows = _weights(image.shape[0], shape[0]) @ image
    resized: Array = np.ascontiguousarray((_weights(image.shape[1], shape[1]) @ rows.T).T)
    return resized


@lru_cache(maxsize=64)
def _weights(size: int, new_size: int) -> Any:
    """Sparse (new_size, size) matrix that resamples one axis.

    Beyond its ends the axis continues mirrored. Weights of a widened kernel do not quite sum to 1 when the ratio of
    the sizes is not a whole number, and are left so: the reference values were computed thus (in GNU Octave).
    """
    scale = new_size / size
    widening = min(scale, 1.0)
    reach = int(np.ceil(2 / widening))
    place = 0.5 / scale - 0.5 + np.arange(new_size)[:, None] / scale
    whole = np.floor(place).astype(int)
    source = whole + np.arange(1 - reach, reach + 1)
    weights = widening * _cubic(widening * (source - place))
    folded = source % (2 * size)
    folded = np.where(folded < size, folded, 2 * size - 1 - folded)
    target = np.broadcast_to(np.arange(new_size)[:, None], source.shape)
    return sparse.csr_array((weights.ravel(), (target.ravel(), folded.ravel())), shape=(new_size, size))


def _cubic(distance: Array) -> Array:
    """Cubic convolution kernel of Keys (1981) with a = -1/2."""
    x = np.abs(distance)
    near = (1.5 * x - 2.5) * x**2 + 1
    far = ((-0.5 * x + 2.5) * x - 4) * x + 2
    return np.where(x <= 1, near, np.where(x <= 2, far, 0.0))
