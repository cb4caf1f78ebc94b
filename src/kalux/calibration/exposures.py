"""What the light does within an exposure, as its events tell: a frame shows the mean, which is that of no moment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.deblur import between, integrate_exposure
from kalux.events import EventArray

Array = NDArray[np.float64]


class Bends(NamedTuple):
    """By how much the logarithm of what a frame shows, the mean of the light, is more than others, (H, W) each.

    Attributes
    ----------
    over_mean
        Than the mean of the logarithm.
    over_middle
        Than the logarithm at the middle of the exposure.
    """

    over_mean: Array
    over_middle: Array


def bends(
    events: EventArray, sensor_size: tuple[int, int], start: int, end: int, thresholds: tuple[float, float]
) -> Bends:
    """Of an exposure from ``start`` to ``end`` (us), by the thresholds on and off, log intensity.

    Between events the light is taken to be at the level of the last one (`kalux.augmentation.deblur`). Where nothing
    happens, where thresholds are 0, and where an exposure has no length, nothing bends.
    """
    within = between(events, start, end)
    if len(within) == 0 or not any(thresholds):
        return Bends(np.zeros(sensor_size), np.zeros(sensor_size))
    on, off = thresholds
    steps = [np.full(sensor_size, threshold, np.float32) for threshold in thresholds]
    integrals = integrate_exposure(within, start, end, steps[0], steps[1])
    log_mean = integrals.log_mean.astype(np.float64)
    # A step raises the mean by the share of the exposure that is left.
    raised = np.where(within["p"], on, -off) * ((end - within["t"]) / (end - start))
    at = within["y"].astype(np.intp) * sensor_size[1] + within["x"]
    mean = np.bincount(at, raised, minlength=log_mean.size).reshape(sensor_size)
    return Bends(log_mean - mean, log_mean - integrals.to_middle)
