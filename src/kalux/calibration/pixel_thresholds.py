"""`kalux calibrate contrast`: thresholds of the sensor and of its single pixels, with what is not known of them.

A reconstruction finds those of the sensor by itself (`kalux.calibration.global_thresholds`). Here the change d of the
deblurred log intensity between the middles of two exposures is explained by

    d = c_on n_on - c_off n_off + h s

with n the events between, and s the change of the sign of each pixel's latest event, halved (-1, 0, 1). After an ON
event the intensity lies half a threshold above the reported level on average, after an OFF event half a threshold
below, so that where the direction turns around one threshold is never reported: left out, this makes every small
step look larger. h is free; (c_on + c_off) / 2 is what an ideal pixel has.

Counts are wrong by noise events, lost events and what is not yet reported, and least squares would take that for a
smaller threshold (attenuation). Neighbouring pixels see the same edges with errors of their own: their mean counts are
instruments (two-stage least squares), for which no noise level needs to be known. Intervals with events that follow
one another as fast as the pixel can are left out, since events may be lost there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.deblur import integrate_exposure, latent_middle, latent_peak
from kalux.augmentation.refractory import step_weight
from kalux.calibration.black_level import with_known_black
from kalux.calibration.delay import estimate_delay
from kalux.calibration.global_thresholds import Usual, estimate_thresholds
from kalux.calibration.intervals import SOON_FOR_THRESHOLDS, Interval, intervals
from kalux.calibration.refractory import Period, counted_period, dead_time, shortest_interval
from kalux.calibration.region import event_region
from kalux.calibration.regression import (
    HUBER,
    products,
    robust_deviation,
    standard_errors,
    two_stage,
    weighted_least_squares,
)
from kalux.calibration.values import Calibration
from kalux.compiled import loop
from kalux.event_slices import between
from kalux.events import NEVER, EventArray
from kalux.filters.shots import Shot
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings

Array = NDArray[np.float64]

MAX_FRAMES: Final = 1000
"""Frames that are looked at for the thresholds of single pixels: some 500 events of a pixel that sees motion."""

_GLOBAL_SAMPLES: Final = 400_000  # pixels for the global fit; its standard error is then below 0.5 %
_SEARCH_FRAMES: Final = 40
_SEARCHED: Final = (-4_000, 0, 3_000, 6_000, 10_000)  # delays, us, at which the trailing is measured
_SEARCHED_FAR: Final = (10_000, 14_000, 18_000, 24_000, 30_000, 36_000)
"""The same where events still trail too far behind at the last of these."""

_IN_TIME: Final = (0.7, 0.95, 1.15)
"""h over the mean threshold where events are in time: 1 in theory, 0.79 to 1.02 on five simulated scenes. Between the
outer values no delay is corrected, beyond them until the middle one is reached."""
_MIN_SAMPLES: Final = 500
_MOST_USUAL: Final = 0.1
"""Largest share of the usual thresholds in the quick estimate (`ThresholdEstimate.usual_share`) with which a recording
tells enough: it is 0.01 at most on fifteen scenes and recordings with motion, 0.17 where only lamps and noise make
events."""
_WHITE: Final = 0.95  # of the response: the whole deblurred path lies below
_CROWDED: Final = 3.0
"""Intervals with events closer than this many times the smallest inter-event interval are left out. With 3, a
refractory period of 200 us costs 4 % where edges pass at 50 thresholds per 10 ms, without it 8 %."""
_EM_STEPS: Final = 60
_LEAST_SPREAD: Final = 0.01


@dataclass(frozen=True, eq=False)
class ContrastCalibration:
    """Contrast thresholds, log intensity, with standard errors (jackknife over 8 x 8 parts of the sensor).

    Attributes
    ----------
    on, off, on_error, off_error
        Mean thresholds, positive, and their standard errors.
    spread_on, spread_off
        Relative standard deviation between pixels, with what the fit cannot know taken out.
    correlation
        Of the ON and OFF thresholds of a pixel.
    delay
        How late the events are taken to be, us; given, or from the trailing.
    trailing
        h of the module's text.
    residual
        Robust standard deviation of the fit, log intensity.
    step_variance
        How much the variance of the fit grows per event, in units of c_on c_off.
    shortest_interval
        Shortest time between two events of a pixel that is not chance, us.
    refractory
        Refractory period, us, that the thresholds take account of; 0: none.
    refractory_spread
        Its relative standard deviation; 0 where it is given, or shown by noise.
    black_level
        What was taken off the frames, a share of white, given or found; None: nothing, or what they state themselves.
    samples, intervals
        Pixels of the global fit, and frame intervals that were looked at.
    on_factor, off_factor, on_variance, off_variance
        (H, W) thresholds of every pixel in units of ``on`` and ``off``, shrunk towards 1 as far as the pixel says
        little, and the variance that is left.
    """

    on: float
    off: float
    on_error: float
    off_error: float
    spread_on: float
    spread_off: float
    correlation: float
    delay: int
    trailing: float
    residual: float
    step_variance: float
    shortest_interval: int
    refractory: int
    refractory_spread: float
    black_level: float | None
    samples: int
    intervals: int
    on_factor: Array
    off_factor: Array
    on_variance: Array
    off_variance: Array

    def doubted(self, doubt: float) -> Self:
        """The same thresholds with a relative error more, that of both."""
        on, off = (
            float(np.hypot(error, doubt * value))
            for error, value in ((self.on_error, self.on), (self.off_error, self.off))
        )
        return dataclasses.replace(self, on_error=on, off_error=off)

    def calibration(self) -> Calibration:
        """As settings with standard errors, and maps of the pixels."""
        settings: dict[str, Any] = {
            "threshold_on": self.on,
            "threshold_off": self.off,
            "threshold_spread": float(np.hypot(self.spread_on, self.spread_off) / np.sqrt(2)),
        }
        if self.refractory > 0:
            settings["refractory_period"] = self.refractory
        if self.refractory_spread > 0:
            settings["refractory_spread"] = self.refractory_spread
        errors = {"threshold_on": self.on_error, "threshold_off": self.off_error}
        names = ("spread_on", "spread_off", "correlation", "trailing", "residual", "shortest_interval")
        measured = {name: getattr(self, name) for name in (*names, "samples", "intervals")}
        maps = {
            "threshold_on": self.on_factor,
            "threshold_off": self.off_factor,
            "threshold_on_variance": self.on_variance,
            "threshold_off_variance": self.off_variance,
        }
        finite = {name: value for name, value in errors.items() if np.isfinite(value)}
        groups: dict[str, dict[str, Any]] = {"events": settings}
        if self.black_level is not None:  # the thresholds hold for frames without it
            groups["camera"] = {"black_level": self.black_level}
        return Calibration(groups, finite, {**measured, "trailing_delay": self.delay}, maps)


def calibrate_contrast(
    recording: Recording, camera: CameraSettings, *, delay: int | None = None, refractory: int | None = None
) -> ContrastCalibration | None:
    """Measure the contrast thresholds of a recording's sensor.

    Parameters
    ----------
    recording
        With frames and exposures, and motion before well exposed pixels; five frames are enough for the mean.
    camera
        Response, saturation and black level; where that is None and events show one, it is taken off.
    delay
        How late the events are, us. None: so that they trail the light by half a threshold, as those of an ideal
        pixel do.
    refractory
        Refractory period, us: what is lost in it is added to the events. None: that which noise shows, else that
        under which events explain the frames best.

    Returns
    -------
    None where too few pixels (500) change, or where events do not explain the changes.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    recording, _ = with_known_black(recording, camera, EventSettings(delay=delay))
    first = estimate_thresholds(recording, camera, Usual.of(EventSettings()), delay=delay or 0)
    if first is None or first.usual_share > _MOST_USUAL:
        return None
    given = None if refractory is None else (Period(refractory), 0.0)
    period, doubt = given or _lost_period(recording, camera, delay)
    sampling = _Sampling((first.on, first.off), shortest_interval(recording), period, event_region(recording))
    if delay is None:
        delay = _delay_of_trailing(recording, camera, sampling)
    fit, data = None, None
    for _ in range(2):  # the second time deblurred with the thresholds of the first
        data = _gathered(_samples(recording, camera, sampling, (delay,), MAX_FRAMES), _GLOBAL_SAMPLES)
        fit = _fit(data[0]) if data else None
        if fit is None:
            return None
        sampling = sampling._replace(thresholds=(fit.on, fit.off))
    assert fit is not None
    assert data is not None
    return _per_pixel(recording, camera, sampling, fit, data[0], delay).doubted(doubt)


def _lost_period(recording: Recording, camera: CameraSettings, delay: int | None) -> tuple[Period, float]:
    """The refractory period, and the relative error of thresholds that comes from its own.

    Noise shows it where there is enough of it: a part of a sensor, or of the time, may have too little.
    """
    shown = dead_time(recording)
    if shown:
        return Period(counted_period(shown)), 0.0
    if delay is None:
        apparent = estimate_delay(recording, camera)
        delay = 0 if apparent is None else apparent.apparent
    usual = Usual.of(EventSettings())
    found = estimate_thresholds(recording, camera, usual, delay=delay, refractory_period=None)
    if found is None:
        return Period(0), 0.0
    return Period(found.refractory_period, found.refractory_spread), found.doubt


# --- samples --------------------------------------------------------------------------------------------------


class _Sampling(NamedTuple):
    """How pixels are sampled: thresholds to deblur with, shortest inter-event interval, us, and refractory period.

    And ``inside``, (H, W) bool: which pixels may have events.
    """

    thresholds: tuple[float, float]
    shortest: int
    refractory: Period
    inside: NDArray[np.bool_]


class _Samples(NamedTuple):
    """(N,) pixels: change, explaining values and their instruments (N, 3), index of the pixel."""

    change: Array
    explained: Array
    instruments: Array
    pixel: NDArray[np.int64]


def _samples(
    recording: Recording,
    camera: CameraSettings,
    sampling: _Sampling,
    delays: tuple[int, ...],
    most_frames: int,
) -> Iterator[tuple[_Samples, ...]]:
    """The usable pixels of every frame interval, once for every delay."""
    margin = recording.longest_exposure + max(abs(d) for d in delays)
    histories = [_History(recording.sensor_size, sampling) for _ in delays]
    for interval in intervals(
        recording, camera, margin=margin, most_frames=most_frames, soon=SOON_FOR_THRESHOLDS
    ):
        yield tuple(
            _of_interval(interval, history, camera, sampling, d)
            for history, d in zip(histories, delays, strict=True)
        )


class _History:
    """Counts events interval by interval, and remembers time and sign of every pixel's latest one."""

    def __init__(self, shape: tuple[int, int], sampling: _Sampling) -> None:
        self._sampling, self._shape = sampling, shape
        self._last = np.full(shape, NEVER, np.int64)
        self._before = np.zeros(shape, np.float32)  # us, of `step_weight`
        self.sign = np.zeros(shape)
        self.begun = False

    def counts(self, events: EventArray) -> tuple[Array, Array, NDArray[np.bool_]]:
        """On and off counts of events, and which pixels had some that follow too fast."""
        on, off = np.zeros(self._shape), np.zeros(self._shape)
        crowded = np.zeros(self._shape, np.bool_)
        least = _CROWDED * max(self._sampling.shortest, self._sampling.refractory.length)
        t, x, y, p = (events[name] for name in ("t", "x", "y", "p"))
        memory, refractory = (
            (self._last, self._before, self.sign),
            np.float32(self._sampling.refractory.length),
        )
        _count(t, x, y, p, *memory, least, refractory, on, off, crowded)
        return on, off, crowded


@loop
def _count(t, x, y, p, last, before, sign, least, refractory, on, off, crowded):  # type: ignore[no-untyped-def]
    for i in range(len(t)):
        row, column = y[i], x[i]
        since = t[i] - last[row, column]
        if since < least:
            crowded[row, column] = True
        direction = 1.0 if p[i] else -1.0
        goes_on = sign[row, column] == direction
        weight = np.float32(1.0)
        if goes_on:
            weight = step_weight(np.float32(since), before[row, column], refractory)  # K13
        if p[i]:
            on[row, column] += weight
        else:
            off[row, column] += weight
        before[row, column] = since if goes_on else 0
        sign[row, column] = direction
        last[row, column] = t[i]


def _of_interval(
    interval: Interval, history: _History, camera: CameraSettings, sampling: _Sampling, delay: int
) -> _Samples:
    events = interval.events.copy()
    events["t"] -= delay
    if not history.begun:
        history.counts(between(events, NEVER, interval.start))
        history.begun = True
    before = history.sign.copy()
    on, off, crowded = history.counts(between(events, interval.start, interval.end))
    turned = (history.sign - before) / 2.0
    (first, first_good), (second, second_good) = (
        _latent(shot, events, camera, sampling.thresholds) for shot in (interval.first, interval.second)
    )
    around = [_around(values) for values in (on, -off, turned)]
    good = interval.usable & first_good & second_good & ~crowded & sampling.inside
    good &= _around(on + off) >= 1.0
    return _Samples(
        (second - first)[good],
        np.column_stack([values[good] for values in (on, -off, turned)]),
        np.column_stack([values[good] for values in around]),
        np.flatnonzero(good),
    )


def _latent(
    shot: Shot, events: EventArray, camera: CameraSettings, thresholds: tuple[float, float]
) -> tuple[Array, NDArray[np.bool_]]:
    """Log intensity of a frame without blur, and where the whole path of its exposure is well exposed."""
    blurred = np.log(np.maximum(shot.intensity, 1e-6))
    steps = (np.full(blurred.shape, c) for c in thresholds)
    integrals = integrate_exposure(events, shot.start, shot.end, *steps)
    good = latent_peak(blurred, integrals) < np.log(min(_WHITE, camera.clipped_from) * shot.white)
    return latent_middle(blurred, integrals), good


def _around(values: Array) -> Array:
    """Mean of the eight neighbours."""
    kernel = np.full((3, 3), 1 / 8)
    kernel[1, 1] = 0.0
    mean = cv2.filter2D(values, cv2.CV_64F, kernel, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(mean, np.float64)


def _gathered(parts: Iterator[tuple[_Samples, ...]], most: int) -> list[_Samples]:
    """Samples joined, for every delay, until there are enough."""
    kept: list[tuple[_Samples, ...]] = []
    count = 0
    for part in parts:
        kept.append(part)
        count += len(part[0].change)
        if count >= most:
            break
    return [
        _Samples(*(np.concatenate(c) for c in zip(*samples, strict=True)))
        for samples in zip(*kept, strict=True)
    ]


# --- the global fit -------------------------------------------------------------------------------------------


class _Fit(NamedTuple):
    on: float
    off: float
    trailing: float
    residual: float
    weights: Array


def _fit(data: _Samples) -> _Fit | None:
    """The global fit; None where it is not determined."""
    if len(data.change) < _MIN_SAMPLES:
        return None
    found = two_stage(data.change, data.explained, data.instruments)
    if found is None:
        return None
    on, off, trailing = (float(v) for v in found.solution)
    return _Fit(on, off, trailing, found.residual, found.weights) if on > 0 and off > 0 else None


def _delay_of_trailing(recording: Recording, camera: CameraSettings, sampling: _Sampling) -> int:
    """The delay, us, at which events trail the light by half a threshold; 0 where it cannot be told."""
    low, wanted, high = _IN_TIME
    ratio = _trailing_at(recording, camera, sampling, _SEARCHED)
    if ratio is None or low <= ratio[_SEARCHED.index(0)] <= high:
        return 0
    searched: tuple[int, ...] = _SEARCHED
    if ratio[-1] > high:
        searched, ratio = _SEARCHED_FAR, _trailing_at(recording, camera, sampling, _SEARCHED_FAR)
    if ratio is None or not ratio[-1] <= wanted <= ratio[0]:
        return 0
    return round(float(np.interp(wanted, ratio[::-1], searched[::-1])))


def _trailing_at(
    recording: Recording, camera: CameraSettings, sampling: _Sampling, delays: tuple[int, ...]
) -> Array | None:
    """h over the mean threshold under each of the ascending ``delays``; None where a fit fails."""
    parts = _samples(recording, camera, sampling, delays, _SEARCH_FRAMES)
    found = [_fit(data) for data in _gathered(parts, _GLOBAL_SAMPLES // 2)]
    fits = [fit for fit in found if fit is not None]
    if len(fits) < len(delays):
        return None
    # A longer delay leaves less trailing; what does not decrease is noise.
    return np.minimum.accumulate(
        np.array([2 * fit.trailing / (fit.on + fit.off) for fit in fits], np.float64)
    )


# --- single pixels --------------------------------------------------------------------------------------------


class _Variance(NamedTuple):
    """Variance of the fit's residuals: ``still`` and what every event adds, log intensity^2."""

    still: float
    per_event: float


def _residual_variance(data: _Samples, solution: Array) -> _Variance:
    """A line through the robust variances of the residuals with each number of events."""
    events = np.abs(data.explained[:, :2]).sum(axis=1).round().astype(np.int64)
    residual = data.change - data.explained @ solution
    numbers, variances, sizes = [], [], []
    for n in range(1, 9):
        inside = residual[events == n]
        if len(inside) >= 100:
            numbers.append(n)
            variances.append(robust_deviation(inside) ** 2)
            sizes.append(len(inside))
    if len(numbers) < 2:
        scale = robust_deviation(residual)
        return _Variance(max(scale**2, 1e-8), 0.0)
    per_event, still = np.polyfit(numbers, variances, 1, w=np.sqrt(sizes))
    per_event = max(float(per_event), 0.0)
    return _Variance(max(float(still), 0.25 * min(variances), 1e-8), per_event)


def _per_pixel(
    recording: Recording, camera: CameraSettings, sampling: _Sampling, fit: _Fit, data: _Samples, delay: int
) -> ContrastCalibration:
    # Deviations of single pixels are regressed on their own counts, so the mean they deviate from must be as
    # attenuated as they are: that of least squares, not of the instruments.
    plain = weighted_least_squares(data.change, data.explained, fit.weights)
    variance = _residual_variance(data, plain)
    size = int(np.prod(recording.sensor_size))
    normal: Array = np.zeros((size, 3))
    right: Array = np.zeros((size, 2))
    count = 0
    for (part,) in _samples(recording, camera, sampling, (delay,), MAX_FRAMES):
        count += 1
        predicted = part.explained[:, :2] * plain[:2]  # by factor 1 of either threshold
        residual = part.change - part.explained @ plain
        spread = np.sqrt(variance.still + variance.per_event * np.abs(part.explained[:, :2]).sum(axis=1))
        weight = np.minimum(1.0, 2 * HUBER * spread / np.maximum(np.abs(residual), 1e-12)) / spread**2
        for column, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
            normal[:, column] += np.bincount(part.pixel, weight * predicted[:, i] * predicted[:, j], size)
        for i in range(2):
            right[:, i] += np.bincount(part.pixel, weight * predicted[:, i] * residual, size)
    _, covariance, offset, left = shrunk(normal, right)
    errors = standard_errors(
        data.change, data.explained, data.instruments, fit.weights, data.pixel, recording.sensor_size
    )
    shape = recording.sensor_size
    spreads = np.sqrt(np.diag(covariance))
    return ContrastCalibration(
        on=fit.on * float(1 + covariance[0, 0]),  # the mean of 1 / c is what the instruments find
        off=fit.off * float(1 + covariance[1, 1]),
        on_error=float(errors[0]),
        off_error=float(errors[1]),
        spread_on=float(spreads[0]),
        spread_off=float(spreads[1]),
        correlation=float(covariance[0, 1] / max(spreads[0] * spreads[1], 1e-12)),
        delay=delay,
        trailing=fit.trailing,
        residual=fit.residual,
        step_variance=variance.per_event / (fit.on * fit.off),
        shortest_interval=sampling.shortest,
        refractory=sampling.refractory.length,
        refractory_spread=sampling.refractory.spread,
        black_level=recording.black_level or camera.black_level,
        samples=len(data.change),
        intervals=count,
        on_factor=np.clip(1 + offset[:, 0], 0.3, 3.0).reshape(shape),
        off_factor=np.clip(1 + offset[:, 1], 0.3, 3.0).reshape(shape),
        on_variance=left[:, 0].reshape(shape),
        off_variance=left[:, 1].reshape(shape),
    )


def shrunk(normal: Array, right: Array) -> tuple[Array, Array, Array, Array]:
    """Empirical Bayes of two values per pixel, with their covariance between pixels, by expectation maximisation.

    Parameters
    ----------
    normal
        (N, 3) normal equations of every pixel in units of its noise: xx, xy, yy.
    right
        (N, 2) their right sides.

    Returns
    -------
    Mean (2,) and covariance (2, 2) of the pixels with information; (N, 2) estimates of every pixel relative to that
    mean, shrunk towards it; (N, 2) their posterior variance. A pixel without information has the mean.
    """
    known = np.flatnonzero(normal[:, 0] + normal[:, 2] > 0)
    mean, covariance = np.zeros(2), 0.01 * np.eye(2)
    values, left = np.zeros((len(normal), 2)), np.zeros((len(normal), 2, 2))
    information = np.stack([normal[:, [0, 1]], normal[:, [1, 2]]], axis=1)
    for _ in range(_EM_STEPS):
        prior = np.linalg.inv(covariance)
        left = np.linalg.inv(information + prior)
        values = np.einsum("nij,nj->ni", left, right + prior @ mean)
        if len(known) < 10:
            break
        mean = values[known].mean(axis=0)
        away = values[known] - mean
        covariance = products(away.T, away.T) / len(known) + left[known].mean(axis=0)
        covariance += _LEAST_SPREAD**2 * 1e-2 * np.eye(2)
    return mean, covariance, values - mean, np.stack([left[:, 0, 0], left[:, 1, 1]], axis=1)
