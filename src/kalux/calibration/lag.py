"""How far pixels are, at a moment, from the light, beyond what their steps add up to: slow ones lag in the dark.

Errors of steps stay: from frame to frame they add up, and those of two successive intervals have nothing to do with one
another. A pixel's lag behind the light is of the moment: what makes it darker at one frame, beside its events, makes an
interval's mismatch too small and the next one's too large. So the mean product of the mismatches of two successive
intervals is, but for the sign, the variance of such errors at the frame between them, and that of the frame's noise.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.event_model import DARKEST
from kalux.calibration.intervals import Counted
from kalux.calibration.regression import parts, ratio_error
from kalux.calibration.slow_pixels import observe
from kalux.models.camera import noise_variance
from kalux.models.lag import lag_growth
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings

Array = NDArray[np.float64]

_ENOUGH: Final = 300_000  # pixels and frames: the standard error is a few percent of a slow sensor's

_BELOW_THRESHOLD: Final = 0.12
"""Variance, c^2, of what is below the threshold at a frame, by which all pixels are off their events: 0.10 to 0.15
where nothing lags, in a scene without noise."""

_CLIP: Final = 9.0  # thresholds: flicker and occlusions, or a pixel that lost many events

_CUT: Final = 2.0
"""Standard deviations of the frames' noise from which pixels count: black cuts the noise of darker ones."""

_CERTAIN: Final = 2.0  # standard errors by which it must be more than none
_MOST: Final = 4.0
"""What is believed at most, c^2: on 465 simulated scenes it is up to 3.4, but for one of a fine texture, of 17 +- 7."""


class Lag(NamedTuple):
    """What a recording says of errors of the moment.

    Attributes
    ----------
    variance, error
        At `kalux.models.lag.LEVEL`, in units of c^2, and its standard error.
    samples
        Pixels and frames used.
    """

    variance: float
    error: float
    samples: int

    @property
    def believed(self) -> float:
        """The variance, c^2, up to 4: 0 where it may be none."""
        return min(self.variance, _MOST) if self.variance > _CERTAIN * self.error else 0.0


def estimate_lag(recording: Recording, camera: CameraSettings, events: EventSettings) -> Lag | None:
    """The variance of errors of the moment, from the first 40 frames, or as many as have 300,000 pixels that tell.

    With m and m' a pixel's mismatches (docs/equations.md, K1) of two successive intervals, both with events, N the
    variance of the noise of the frame between and g how the variance grows in the dark (`lag_growth`), it is the sum of
    g (-m m' - N - 0.12 c^2) over that of g^2 c^2 (docs/equations.md, K11).

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response, saturation, I_0 and frame noise.
    events
        With both thresholds.

    Returns None where no pixel has events in two successive intervals whose frames measure it.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    seen = LagSums(recording.sensor_size, camera, events)
    observe(recording, camera, events, seen)
    return seen.found


class LagSums:
    """What `estimate_lag` sums up, interval by interval: an observer of `kalux.calibration.slow_pixels`.

    Parameters
    ----------
    sensor_size
        (H, W).
    camera, events
        As of `estimate_lag`.
    """

    def __init__(self, sensor_size: tuple[int, int], camera: CameraSettings, events: EventSettings) -> None:
        self._camera, self._events = camera, events
        self._part = parts(sensor_size)
        self._sums: Array = np.zeros((int(self._part.max()) + 1, 2))
        self._samples = 0
        self._before: _Mismatches | None = None

    @property
    def enough(self) -> bool:
        """Whether 300,000 pixels have told."""
        return self._samples >= _ENOUGH

    @property
    def found(self) -> Lag | None:
        """By what was seen until now; None: nothing told."""
        if not self._samples:
            return None
        over, under = self._sums.sum(axis=0)
        return Lag(float(over / under), ratio_error(self._sums), self._samples)

    def add(self, counted: Counted) -> None:
        """Take the next interval in."""
        before, here = self._before, _mismatches(counted, self._camera, self._events)
        self._before = here
        if before is None or before.end != here.start:
            return
        threshold2 = float(np.prod(self._events.thresholds))
        shared = before.told & here.told
        told = before.second[shared]
        growth = lag_growth(told).astype(np.float64)
        product = -before.change[shared] * here.change[shared]
        excess = product - before.noise[shared] - _BELOW_THRESHOLD * threshold2
        for column, values in enumerate((growth * excess, growth**2 * threshold2)):
            self._sums[:, column] += np.bincount(self._part[shared], values, len(self._sums))
        self._samples += len(told)


class _Mismatches(NamedTuple):
    """An interval's: where it begins and ends, us; (H, W): the mismatch, clipped, and whether it counts; I at its end,
    and the variance of its logarithm by the frame's noise."""

    start: int
    end: int
    change: Array
    told: NDArray[np.bool_]
    second: Array
    noise: Array


def _mismatches(counted: Counted, camera: CameraSettings, events: EventSettings) -> _Mismatches:
    most = _CLIP * max(events.thresholds)
    interval = counted.interval
    mismatch = np.clip(_mismatch(counted, events), -most, most)
    told = (counted.on + counted.off > 0) & interval.first.measured & interval.second.measured
    for end in interval.ends:
        told &= end.intensity > max(DARKEST, _CUT * camera.noise[0]) * end.shot.white
    end = interval.ends[1]
    noise = (
        noise_variance(end.intensity, camera.noise, end.shot.white) / (end.intensity + end.log_offset) ** 2
    )
    return _Mismatches(interval.start, interval.end, mismatch, told, end.intensity, noise)


def _mismatch(counted: Counted, events: EventSettings) -> Array:
    """By how much the frames' logs differ from what the events between say."""
    on, off = events.thresholds
    told: Array = counted.interval.change - counted.bend - (on * counted.on - off * counted.off)
    return told
