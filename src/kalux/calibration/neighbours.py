"""What calibrations ask of the pixels around each."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def sum_of_neighbours(values: NDArray[Any]) -> NDArray[Any]:
    """(H, W) sum over the eight neighbours of every pixel, in the same type; 0 beyond the border."""
    total = cv2.boxFilter(values, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(total - values)
