"""Where a recording's events become logarithmic, how much one event's step varies, and what the refractory period
hides: by maximum likelihood.

Events are steps of log(I + I_d), with I_d the dark current of their pixels, seen by the frames' scale. The state is
log(I + I_0), equation (8); it moves as the events say only if I_0 is near I_d. Too large, and steps in the dark are
taken for larger ones than they are, so that pixels learn wrong thresholds there and carry them into highlights; too
small, and the noise of dark frame pixels is magnified. What two successive frames and the events between them say of
each other decides (docs/equations.md, K9).

A refractory period makes the steps of events that soon follow others look larger than the threshold (K13). The periods
that are possible are tried; only where one explains the frames clearly better than none is it believed: not every
sensor, and not every simulation, loses what happens meanwhile.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.deblur import between
from kalux.calibration.contrast import HUBER, NORMAL_MAD
from kalux.calibration.intervals import intervals, spread
from kalux.calibration.refractory import LATE, Counts, possible_periods, shortest_interval
from kalux.models.camera import noise_variance
from kalux.recording import Recording
from kalux.settings import CameraSettings

Array = NDArray[np.float64]

LOG_OFFSETS: Final = (0.004, 0.008, 0.015, 0.03, 0.06)
"""I_0 that are tried, white = 1. Less than a level of an 8-bit frame cannot be told; more than 0.06 is not dark."""

STEP_VARIANCES: Final = (0.05, 0.1, 0.2, 0.4)
"""Variances of an event's step that are tried, in units of c^2."""

MAX_SAMPLES: Final = 100_000
_MIN_SAMPLES: Final = 1_000
_MAX_FRAMES: Final = 80
_LEAST_NET: Final = 2  # as for the thresholds: a net count of one may be noise
_DARKEST: Final = 0.01  # two to three levels of 8 bits: below, a frame's log is rounding
_SHORTEST_EVENTS: Final = (
    500_000  # of which the shortest interval is taken: its edge is then that of 10,000 pairs
)
_FIT_STEPS: Final = 8
_LEAST_GAIN: Final = 0.01
"""In log likelihood per sample, for a refractory period to be believed. On eleven simulations and three recordings,
thresholds stated, it was 0.034 to 0.65 where there is one, and less than 0 where nothing is lost; thresholds estimated,
in which the loss can hide, 0.014 and 0.32 where it is found, and 0.002 at most where nothing is lost."""
_FREEDOM: Final = 4.0  # degrees of freedom of Student's t, whose tails take flicker and occlusions


class EventModel(NamedTuple):
    """What a recording says of its events.

    Attributes
    ----------
    log_offset
        I_0, white = 1.
    step_variance
        Variance of one event's step, in units of c^2.
    refractory_period
        us; 0 where nothing is lost in it, or too little to tell.
    samples
        Pixels and frame intervals used.
    """

    log_offset: float
    step_variance: float
    refractory_period: int
    samples: int


class Samples(NamedTuple):
    """Pixels of frame intervals: I before and after, and the on and off events between, weighed; all (N,)."""

    before: Array
    after: Array
    on: Array
    off: Array


class _Tried(NamedTuple):
    """Samples under several refractory periods: I before and after (N,), and the events between, (R, N).

    ``late_on`` and ``late_off`` are those of the events that come late after their predecessors.
    """

    periods: tuple[int, ...]
    before: Array
    after: Array
    on: Array
    off: Array
    late_on: Array
    late_off: Array

    def under(self, index: int) -> Samples:
        """The samples under one of the periods."""
        return Samples(self.before, self.after, self.on[index], self.off[index])

    def those(self, chosen: NDArray[np.bool_]) -> _Tried:
        """Some of the samples."""
        return _Tried(self.periods, *(values[..., chosen] for values in self[1:]))


class _Model(NamedTuple):
    """What the likelihood needs to know beside what is tried."""

    thresholds: tuple[float, float]
    frame_noise: tuple[float, float]
    threshold_spread: float
    quantisation_variance: float

    def loss(self, samples: Samples, log_offset: float, step_variance: float) -> float:
        return negative_log_likelihood(samples, self.thresholds, log_offset, step_variance, *self[1:])

    def best(self, samples: Samples, log_offsets: tuple[float, ...]) -> tuple[float, float, float]:
        """The least loss, and the I_0 and the variance of a step that have it."""
        return min((self.loss(samples, i, q), i, q) for i in log_offsets for q in STEP_VARIANCES)


def estimate_event_model(
    recording: Recording,
    camera: CameraSettings,
    thresholds: tuple[float, float],
    *,
    delay: int = 0,
    threshold_spread: float = 0.1,
    quantisation_variance: float = 1 / 6,
    refractory_period: int | None = 0,
    thresholds_are_estimated: bool = False,
) -> EventModel | None:
    """I_0, the variance of an event's step, and the refractory period, from the first 80 frames.

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response, saturation, frame noise, and I_0 if it is known.
    thresholds
        (on, off) contrast thresholds, log intensity.
    delay
        How much later than the frames' clock events are stamped, us.
    threshold_spread, quantisation_variance
        As in `kalux.settings.EventSettings`.
    refractory_period
        us; None: to be found.
    thresholds_are_estimated
        From this recording, under the assumption that nothing is lost.

    Returns None where fewer than 1000 pixels changed by two events between two frames that show them well enough.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    shortest = 0 if refractory_period is not None else shortest_interval(recording, _SHORTEST_EVENTS)
    periods = possible_periods(shortest) if refractory_period is None else (refractory_period,)
    samples = _samples(recording, camera, delay, periods, LATE * shortest if shortest else np.inf)
    net = np.abs(samples.on[0] - samples.off[0])
    signals = samples.those((net >= _LEAST_NET) & (np.minimum(samples.before, samples.after) > _DARKEST))
    if len(signals.before) < _MIN_SAMPLES:
        return None
    # Frames are taken as they are, with the blur that the filter removes: what that changes is not the events' error.
    noise = (max(camera.noise[0], camera.usual_frame_noise), camera.noise[1])
    model = _Model(thresholds, noise, threshold_spread, quantisation_variance)
    log_offsets = LOG_OFFSETS if camera.log_offset is None else (camera.log_offset,)
    found = _refractory(signals, model, log_offsets, thresholds_are_estimated) if len(periods) > 1 else None
    if found is None:
        index, (_, log_offset, _) = 0, model.best(signals.under(0), log_offsets)
    else:
        index, log_offset = found
    # Single events, most of them noise where nothing moves, say much of the step and nothing of I_0.
    _, _, step_variance = model.best(samples.under(index), (log_offset,))
    return EventModel(log_offset, step_variance, periods[index], len(samples.before))


def _refractory(
    samples: _Tried, model: _Model, log_offsets: tuple[float, ...], scale_is_free: bool
) -> tuple[int, float] | None:
    """Index of the refractory period and the I_0 that make the frames most likely; None where the period is 0."""
    losses = [
        min(
            (
                model.best(_rescaled(samples, index, model, log_offset, scale_is_free), (log_offset,))[0],
                log_offset,
            )
            for log_offset in log_offsets
        )
        for index in range(len(samples.periods))
    ]
    index = int(np.argmin([loss for loss, _ in losses]))
    gain = losses[0][0] - losses[index][0]
    return (index, losses[index][1]) if gain >= _LEAST_GAIN else None


def _rescaled(samples: _Tried, index: int, model: _Model, log_offset: float, scale_is_free: bool) -> Samples:
    """Samples whose late events have the step that fits best, so that only those that follow soon decide.

    With ``scale_is_free`` these, too.
    """
    on, off = model.thresholds
    change = np.log(samples.after + log_offset) - np.log(samples.before + log_offset)
    late_on, late_off = samples.late_on[index], samples.late_off[index]
    soon_on, soon_off = samples.on[index] - late_on, samples.off[index] - late_off
    late, soon = on * late_on - off * late_off, on * soon_on - off * soon_off
    if scale_is_free:
        of_late, of_soon = _robust_fit(np.column_stack([late, soon]), change)
    else:
        of_late, of_soon = float(_robust_fit(late[:, None], change - soon)[0]), 1.0
    return Samples(
        samples.before,
        samples.after,
        of_soon * soon_on + of_late * late_on,
        of_soon * soon_off + of_late * late_off,
    )


def _robust_fit(design: Array, values: Array) -> Array:
    """Least squares with Huber's weights; a column that is nearly empty gets a coefficient near 0, no less."""
    weights = np.ones(len(values))
    solution: Array = np.zeros(design.shape[1])
    for _ in range(_FIT_STEPS):
        weighted = design * weights[:, None]
        normal = weighted.T @ design + 1e-6 * len(values) * np.eye(design.shape[1])
        solution = np.linalg.solve(normal, weighted.T @ values).astype(np.float64)
        residual = np.abs(values - design @ solution)
        weights = np.minimum(1.0, HUBER * NORMAL_MAD * np.median(residual) / np.maximum(residual, 1e-12))
    return np.maximum(solution, 0.0)  # an event never tells of less than nothing


def negative_log_likelihood(
    samples: Samples,
    thresholds: tuple[float, float],
    log_offset: float,
    step_variance: float,
    noise: tuple[float, float],
    threshold_spread: float,
    quantisation_variance: float,
) -> float:
    """Mean over the samples of -log p(I after | I before, events), up to a constant.

    The mismatch between frames and events (docs/equations.md, K1) is Student's t with the variance that the bridge
    takes it to have. The density is one of I, not of log(I + I_0), so that different I_0 can be compared.
    """
    on, off = thresholds
    change = np.log(samples.after + log_offset) - np.log(samples.before + log_offset)
    mismatch = change - (on * samples.on - off * samples.off)
    variance = (
        noise_variance(samples.before, noise, 1.0) / (samples.before + log_offset) ** 2
        + noise_variance(samples.after, noise, 1.0) / (samples.after + log_offset) ** 2
        + threshold_spread**2 * ((on * samples.on) ** 2 + (off * samples.off) ** 2)
        + on * off * (step_variance * (samples.on + samples.off) + quantisation_variance)
    )
    tails = (_FREEDOM + 1) / 2 * np.log1p(mismatch**2 / (_FREEDOM * variance))
    jacobian = np.log(samples.after + log_offset)
    return float(np.mean(0.5 * np.log(variance) + tails + jacobian))


def _samples(
    recording: Recording, camera: CameraSettings, delay: int, periods: tuple[int, ...], late: float
) -> _Tried:
    """Pixels with events that no frame clips, interval by interval."""
    found: list[tuple[Array, ...]] = []
    count = 0
    counts = Counts(recording.sensor_size, periods, late)
    for interval in intervals(recording, camera, margin=abs(delay), most_frames=_MAX_FRAMES):
        every, latecomers = counts.add(between(interval.events, interval.start + delay, interval.end + delay))
        first, second = interval.first, interval.second
        usable = ~first.clipped & ~second.clipped & (every[0].sum(axis=0) > 0)
        chosen = spread(usable, MAX_SAMPLES - count)
        pixels = (every[:, 0], every[:, 1], latecomers[:, 0], latecomers[:, 1])
        found.append(
            (
                first.intensity.ravel()[chosen],
                second.intensity.ravel()[chosen],
                *(values.reshape(len(periods), -1)[:, chosen].astype(np.float64) for values in pixels),
            )
        )
        count += len(chosen)
        if count >= MAX_SAMPLES:
            break
    if not found:
        none = np.empty((len(periods), 0))
        return _Tried(periods, np.empty(0), np.empty(0), none, none, none, none)
    return _Tried(periods, *(np.concatenate(column, axis=-1) for column in zip(*found, strict=True)))
