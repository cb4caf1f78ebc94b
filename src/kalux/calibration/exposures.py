"""What a frame's exposure does to log intensities: the frame averages the intensity, and events tell how that moved."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.deblur import integrate_exposure
from kalux.event_slices import between
from kalux.events import EventArray
from kalux.filters.shots import Shot

Array = NDArray[np.float64]


class Bends(NamedTuple):
    """By how much the log of a frame, the mean intensity of its exposure, exceeds log intensities within, (H, W) each.

    Attributes
    ----------
    over_mean
        Their mean; never negative (Jensen's inequality).
    over_middle
        That at the middle of the exposure.
    """

    over_mean: Array
    over_middle: Array


def bends(
    events: EventArray, sensor_size: tuple[int, int], start: int, end: int, thresholds: tuple[float, float]
) -> Bends:
    """The bends of an exposure from ``start`` to ``end`` (us), by the contrast thresholds on and off.

    Between events the intensity is taken to stay at the level of the last one (`kalux.augmentation.deblur`). Both are 0
    where there is no event, where the thresholds are 0, and where the exposure has no length.
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


class Exposures:
    """`bends` of the exposures of successive frames, two at a time; each exposure is integrated once.

    Parameters
    ----------
    sensor_size
        (height, width), pixels.
    delay
        How much later than the frames' clock events are stamped, us.
    thresholds
        On and off, log intensity. 0: as if nothing moved.
    """

    def __init__(self, sensor_size: tuple[int, int], delay: int, thresholds: tuple[float, float]) -> None:
        self._sensor_size, self._delay, self._thresholds = sensor_size, delay, thresholds
        self._latest: tuple[Shot, Bends] | None = None

    def of(self, first: Shot, second: Shot, events: EventArray) -> tuple[Bends, Bends]:
        """The bends of two successive frames; ``events`` has all events of both exposures."""
        if self._latest is not None and self._latest[0] is first:
            before = self._latest[1]
        else:
            before = self._bends(first, events)
        after = self._bends(second, events)
        self._latest = second, after
        return before, after

    def _bends(self, shot: Shot, events: EventArray) -> Bends:
        start, end = shot.start + self._delay, shot.end + self._delay
        return bends(events, self._sensor_size, start, end, self._thresholds)
