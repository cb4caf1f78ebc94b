"""Events as the networks see them: a voxel grid of signed counts, linear between bins of time.

As in Rebecq et al., "High Speed and High Dynamic Range Video with an Event Camera" (T-PAMI 2021): the times of the
first and the last event of the window are the first and the last bin.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from kalux.events import EventArray

BINS: Final = 5
"""Of all five networks as published."""

SMALLEST_DEVIATION: Final = 1e-6
"""What a standard deviation of 0 (one value everywhere) is taken for."""


def voxel_grid(events: EventArray, sensor_size: tuple[int, int], bins: int = BINS) -> NDArray[np.float32]:
    """Every event, +1 or -1, shared between the two bins around its time.

    Parameters
    ----------
    events
        Sorted in time. Where all have the same time, they are in the first bin.
    sensor_size
        (height, width).
    bins
        At least 1.

    Returns
    -------
    numpy.ndarray
        (bins, height, width) float32; its sum is the number of positive less that of negative events.
    """
    height, width = sensor_size
    pixels = height * width
    if len(events) == 0:
        return np.zeros((bins, height, width), np.float32)
    t = events["t"] - events["t"][0]
    position = t * ((bins - 1) / max(int(t[-1]), 1))
    lower = np.minimum(position.astype(np.int64), bins - 1)
    share = position - lower
    sign = np.where(events["p"], 1.0, -1.0)
    index = lower * pixels + events["y"].astype(np.int64) * width + events["x"]
    # A grid more than is wanted takes the second share of the last bin, which is always 0.
    size = (bins + 1) * pixels
    grid = np.bincount(index, sign * (1.0 - share), size) + np.bincount(index + pixels, sign * share, size)
    return grid[: bins * pixels].reshape(bins, height, width).astype(np.float32)


def normalise(grid: NDArray[np.float32]) -> NDArray[np.float32]:
    """The values that are not 0 with a mean of 0 and a standard deviation of 1; the others stay 0."""
    touched = grid != 0
    values = grid[touched].astype(np.float64)
    if len(values) == 0:
        return grid
    scaled = np.zeros_like(grid)
    scaled[touched] = (values - values.mean()) / max(float(values.std()), SMALLEST_DEVIATION)
    return scaled
