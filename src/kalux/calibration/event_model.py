"""Where a recording's events become logarithmic, and how much one event's step varies: by maximum likelihood.

Events are steps of log(I + I_d), with I_d the dark current of their pixels, seen by the frames' scale. The state is
log(I + I_0), equation (8); it moves as the events say only if I_0 is near I_d. Too large, and steps in the dark are
taken for larger ones than they are, so that pixels learn wrong thresholds there and carry them into highlights; too
small, and the noise of dark frame pixels is magnified. What two successive frames and the events between them say of
each other decides (docs/equations.md, K9).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.frame_noise import quiet_noise, trimmed_variance
from kalux.calibration.intervals import counted_intervals, spread
from kalux.calibration.regression import products
from kalux.models.camera import (
    CRUSHED,
    Camera,
    black_ceiling,
    log_covariance,
    named_responses,
    noise_variance,
)
from kalux.recording import Recording
from kalux.settings import UNKNOWN_LOG_OFFSET, CameraSettings, EventSettings, chosen_response

Array = NDArray[np.float64]

LOG_OFFSETS: Final = (0.004, 0.008, 0.015, 0.03, 0.06, 0.12)
"""I_0 that are tried, white = 1; 0.12 is the usual 0.03 of frames that are exposed four times as long as they ought to
be."""

SMALL_LOG_OFFSETS: Final = (0.002, 0.001)
"""I_0 of less than a level of an 8-bit frame, tried where the least of the others is best. Simulators have them (ESIM
0.001)."""

_CERTAIN: Final = (0.93, 0.012)
"""What is asked of these: the squared correlation of the frames' and the events' changes, and a gain of log-likelihood,
with the prior and the limits by which pixels are chosen, for each independent observation. Of 294 scenes with an I_0 of
0.004 four gain more, 0.015 to 0.024, whose MSE would be 1.02 to 2.2 times as large with 0.004; of twelve with 0.001 ten
gain 0.013 to 0.035, and two for which it does not matter 0.003 and 0.008."""

STEP_VARIANCES: Final = (0.07, 0.1, 0.2, 0.4)
"""Variances of an event's step that are tried with every I_0, in units of c^2. The likelihood often asks for less than
the first, but what is not modelled counts, too. Steps are judged by their mean square, where enough of them can be seen
(`kalux.calibration.mismatch`)."""

MAX_SAMPLES: Final = 100_000
_MIN_SAMPLES: Final = 1_000
_MAX_FRAMES: Final = 80
_LEAST_NET: Final = 2  # a net count of one may be noise
DARKEST: Final = 0.01  # two to three levels of 8 bits: below, a frame's log is rounding
_DARK: Final = 3 * DARKEST
"""Mean of I at both ends up to which noise is that of the dark."""

_FEW_EVENTS: Final = 4
"""Of a dark pixel between two frames: with more, errors of events hide the noise of frames."""

_MIN_DARK: Final = 50
"""Dark pixels from which the standard deviation of their noise is known within a tenth."""

_USUAL_SLOPES: Final = (0.93, 1.05)
"""Slopes of the frames' changes in those by events, where thresholds are right: 0.95 to 1.02 on 21 simulated scenes of
ideal sensors, 0.97 and 1.01 on two recordings."""

_LEAST_SLOPE: Final = 0.88
"""The least, since noise of events makes it less: 0.89 to 0.97 on six simulated scenes of a DAVIS240C."""

_LARGEST_SLOPE: Final = 1.15
"""The most: thresholds that are two thirds of the true ones have 1.07 to 1.15, as changes then seem to be lost."""

_TRUSTED: Final = (0.7, 0.85)
"""Squared correlations of the frames' and the events' changes between which far highlights come to be believed: 0.81
and more on 36 simulated scenes, 0.90 to 0.95 on three recordings; 0.06 to 0.76 where frames lie three pixels beside the
events, or off events are missing (docs/equations.md, K6)."""

_LEAST_SQUARE: Final = 1e-6  # log intensity^2, of all samples together: is divided by

_CORRELATED: Final = 50.0
"""Samples that count as one independent observation: pixels along one edge have the same errors in an interval."""

_LOG_OFFSET_SPREAD: Final = 1.0  # of log I_0: 0.004 to 0.03 on simulations and recordings
_FREEDOM: Final = 4.0  # degrees of freedom of Student's t, whose tails take flicker and occlusions


class Agreement(NamedTuple):
    """How well events explain the changes of frames, where pixels changed by two events and more.

    Attributes
    ----------
    slope
        Of the frames' changes of log intensity in those by the events, by least squares: 1 where thresholds are right,
        less where they are too large, events are wrong, or frames show something else.
    explained
        Squared correlation of both: 0.9 and more where frames and events belong together.
    loss
        Mean negative logarithm of the probability density of the later frame's I, given the earlier one and the events.
    """

    slope: float
    explained: float
    loss: float

    @property
    def is_usual(self) -> bool:
        """Whether the slope is what right thresholds mostly have."""
        return _USUAL_SLOPES[0] < self.slope < _USUAL_SLOPES[1]

    @property
    def contradicts_thresholds(self) -> bool:
        """Whether thresholds are certainly wrong, if events and frames are right."""
        return not _LEAST_SLOPE < self.slope < _LARGEST_SLOPE

    @property
    def gain(self) -> float:
        """Share of the changes by events that is to be believed where no frame tells: 0 to 1."""
        return min(max(self.slope / _LEAST_SLOPE, 0.0), 1.0)

    @property
    def trust(self) -> float:
        """How far highlights much farther beyond white than usual are to be believed: 0 to 1."""
        least, most = _TRUSTED
        return min(max((self.explained - least) / (most - least), 0.0), 1.0)


class EventModel(NamedTuple):
    """What a recording says of its events.

    Attributes
    ----------
    log_offset
        I_0, white = 1.
    step_variance
        Likeliest variance of one event's step, in units of c^2, of `STEP_VARIANCES`.
    samples
        Pixels and frame intervals used.
    agreement
        Of events and frames.
    frame_noise
        Read and shot noise of frames, where they were in doubt and there is less in the dark than was taken; else None.
    """

    log_offset: float
    step_variance: float
    samples: int
    agreement: Agreement
    frame_noise: tuple[float, float] | None = None


class Samples(NamedTuple):
    """Pixels of frame intervals: I before and after, and what events tell (`kalux.calibration.intervals.Counted`).

    The whites are the I of a pixel that the frame before, or after, shows saturated. All (N,).
    """

    before: Array
    after: Array
    on: Array
    off: Array
    bend: Array
    white_before: Array
    white_after: Array

    @property
    def darkest(self) -> Array:
        """(N,) the lesser of both levels, each of a saturated pixel's."""
        least: Array = np.minimum(self.before / self.white_before, self.after / self.white_after)
        return least

    @property
    def white(self) -> Array:
        """(N,) mean of the whites of both frames."""
        mean: Array = (self.white_before + self.white_after) / 2
        return mean

    def where(self, chosen: NDArray[np.bool_]) -> Samples:
        """Some of them."""
        return Samples(*(values[chosen] for values in self))


class FrameLimits(NamedTuple):
    """Least and most I of the frames after, (N,) each: what they can show, the least 0 where black is not crushed; or
    what pixels are chosen by."""

    least: Array
    most: Array

    def where(self, chosen: NDArray[np.bool_]) -> FrameLimits:
        """Those of some of the samples."""
        return FrameLimits(*(limit[chosen] for limit in self))


_LEAST_SHARE: Final = 1e-3
"""Of what the events predict, that frames could show: less is an event that is none of the pixel's."""


class ErrorModel(NamedTuple):
    """What is known of the events and frames of an interval, and of how wrong either is.

    Attributes
    ----------
    thresholds
        (on, off), log intensity.
    frame_noise
        Frame and shot noise, as of `kalux.settings.CameraSettings.noise`.
    threshold_spread, quantisation_variance
        As of `kalux.settings.EventSettings`.
    """

    thresholds: tuple[float, float]
    frame_noise: tuple[float, float]
    threshold_spread: float
    quantisation_variance: float

    def predicted_change(self, samples: Samples) -> Array:
        """(N,) change of the frames' log intensity by their events."""
        on, off = self.thresholds
        return on * samples.on - off * samples.off + samples.bend

    def best_fit(
        self, samples: Samples, limits: FrameLimits | None, log_offset: float
    ) -> tuple[float, float]:
        """The least negative log-likelihood with this I_0, and the variance of a step that has it."""
        return min((negative_log_likelihood(samples, self, log_offset, q, limits), q) for q in STEP_VARIANCES)


def estimate_event_model(
    recording: Recording, camera: CameraSettings, events: EventSettings, *, doubt_noise: bool = False
) -> EventModel | None:
    """I_0 and the variance of an event's step, from the first 80 frames.

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response, saturation, frame noise, and I_0 if it is known.
    events
        Thresholds, delay, refractory period, threshold spread and quantisation variance.
    doubt_noise
        Whether nothing has told the camera's frame noise: in the dark it is no more than events leave unexplained.

    Returns None where fewer than 1000 pixels changed by two events between two frames that show them well enough.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    samples, limits = _samples(recording, camera, events)
    net, darkest = np.abs(samples.on - samples.off), samples.darkest
    chosen = (net >= _LEAST_NET) & (darkest > np.maximum(limits.least / samples.white_after, DARKEST))
    signals = samples.where(chosen)
    if len(signals.before) < _MIN_SAMPLES:
        return None
    # Frames that show the dark range over a hundred to one: what is beyond matters little, and lost events, of
    # which the model knows nothing, would count for more.
    of_signals = limits.where(chosen) if limits.least.any() else None

    def fitted(model: ErrorModel) -> tuple[float, float]:
        log_offset = camera.log_offset or _log_offset(signals, of_signals, model)
        # Single events, most of them noise where nothing moves, say much of the step and nothing of I_0; so do those of
        # pixels that go black, whose steps are the least sure. Without these artificial HDR of slider_depth errs a
        # seventh more: they make up for what is not modelled of events where no frame checks them.
        return log_offset, model.best_fit(samples, None, log_offset)[1]

    model = ErrorModel(events.thresholds, camera.noise, events.mismatch, events.quantisation_variance)
    found = fitted(model)
    dark = dark_noise(samples, model, *found) if doubt_noise and of_signals is None else None
    noise = None
    if dark is not None and dark < camera.noise[0]:
        noise = quiet_noise(recording, camera, dark)
        model = model._replace(frame_noise=noise)
        found = fitted(model)
    loss = model.best_fit(signals, of_signals, found[0])[0]
    agreement = Agreement(*slope_and_share(signals, model, found[0]), loss)
    return EventModel(*found, len(samples.before), agreement, noise)


def slope_and_share(samples: Samples, model: ErrorModel, log_offset: float) -> tuple[float, float]:
    """`Agreement.slope` and `Agreement.explained` of these samples."""
    change, predicted = _changes(samples, log_offset), model.predicted_change(samples)
    both = np.stack([predicted, change])
    (predicted_square, common), (_, change_square) = products(both, both).tolist()
    slope = common / max(predicted_square, _LEAST_SQUARE)
    return slope, max(common, 0.0) * max(slope, 0.0) / max(change_square, _LEAST_SQUARE)


def _changes(samples: Samples, log_offset: float) -> Array:
    """(N,) of log(I + I_0), as the frames show them."""
    changes: Array = np.log(samples.after + log_offset) - np.log(samples.before + log_offset)
    return changes


def dark_noise(samples: Samples, model: ErrorModel, log_offset: float, step_variance: float) -> float | None:
    """Standard deviation of the frames' noise in the dark, white = 1, by what events leave unexplained there.

    Half of the variance of what dark pixels with few events changed beyond these, less what the events' own errors make
    of it, without what lies beyond four standard deviations. With noise of 0.003 to 0.012 it is 1.1 to 1.3 times as
    much as there is; where there is only the rounding of 8 bits, 0.0011, it is 0.0009 to 0.0025. None: too few pixels.
    """
    level = (samples.before + samples.after) / 2
    of_white = level / samples.white
    chosen = (of_white > DARKEST) & (of_white < _DARK) & (samples.on + samples.off <= _FEW_EVENTS)
    if np.count_nonzero(chosen) < _MIN_DARK:
        return None
    dark = samples.where(chosen)
    scale = (level[chosen] + log_offset) / dark.white
    mismatch, of_events = mismatch_of(dark, model._replace(frame_noise=(0.0, 0.0)), log_offset, step_variance)
    unexplained = trimmed_variance(mismatch * scale) - float(np.mean(of_events * scale**2))
    return float(np.sqrt(max(unexplained, 0.0) / 2))


def _log_offset(samples: Samples, limits: FrameLimits | None, model: ErrorModel) -> float:
    """The most likely I_0, to a fifth of itself: of those tried, then of those between the best and its neighbours.

    Samples count as far as events explain the changes of frames, since noise has no information of I_0; the less they
    count, the more does the prior around the usual I_0.
    """
    loss, explained, _ = _losses(samples, limits, model)
    losses = {offset: loss(offset) for offset in LOG_OFFSETS}

    def likeliest() -> float:
        return min(losses, key=lambda offset: losses[offset])

    correlation, gain = _CERTAIN
    reaches_least = explained >= correlation and likeliest() == LOG_OFFSETS[0]
    if reaches_least and _least_gain(samples, limits or _chosen_limits(samples), model) >= gain:
        losses |= {offset: loss(offset) for offset in SMALL_LOG_OFFSETS}
    for _ in range(2):
        offsets = sorted(losses)
        index = offsets.index(likeliest())
        between = [float(np.sqrt(a * b)) for a, b in pairwise(offsets[max(index - 1, 0) : index + 2])]
        losses |= {offset: loss(offset) for offset in between}
    return float(f"{likeliest():.2g}")


def _losses(
    samples: Samples, limits: FrameLimits | None, model: ErrorModel
) -> tuple[Callable[[float], float], float, float]:
    """The negative log-likelihood of an I_0 with its prior; how much events explain; the independent observations."""
    _, explained = slope_and_share(samples, model, UNKNOWN_LOG_OFFSET)
    count = len(samples.before) * explained / _CORRELATED

    def loss(log_offset: float) -> float:
        prior = 0.5 * (np.log(log_offset / UNKNOWN_LOG_OFFSET) / _LOG_OFFSET_SPREAD) ** 2
        return float(prior) + count * model.best_fit(samples, limits, log_offset)[0]

    return loss, explained, count


def _chosen_limits(samples: Samples) -> FrameLimits:
    """Limits of frames after that pixels are chosen by where black is not crushed: none is darker than `DARKEST`.

    Noise lifts some above it that are darker, and by these the light seems to have changed by less than events say, as
    if I_0 were small.
    """
    return FrameLimits(DARKEST * samples.white_after, np.full_like(samples.after, np.inf))


def _least_gain(samples: Samples, limits: FrameLimits | None, model: ErrorModel) -> float:
    """By how much the likeliest of `SMALL_LOG_OFFSETS` is likelier than the least of the others, an observation."""
    if len(samples.before) < _MIN_SAMPLES:
        return 0.0
    loss, _, count = _losses(samples, limits, model)
    return (loss(LOG_OFFSETS[0]) - min(loss(offset) for offset in SMALL_LOG_OFFSETS)) / max(count, 1.0)


def _frame_variance(intensity: Array, white: Array, model: ErrorModel, log_offset: float) -> Array:
    """(N,) V of log(I + I_0) of one of the frames, by its noise."""
    return log_covariance(intensity, noise_variance(intensity, model.frame_noise, white), log_offset)


def mismatch_of(
    samples: Samples, model: ErrorModel, log_offset: float, step_variance: float
) -> tuple[Array, Array]:
    """The mismatch: change of the frames less that by the events; and its variance in the model of the bridge (K1)."""
    on, off = model.thresholds
    variance = (
        _frame_variance(samples.before, samples.white_before, model, log_offset)
        + _frame_variance(samples.after, samples.white_after, model, log_offset)
        + model.threshold_spread**2 * ((on * samples.on) ** 2 + (off * samples.off) ** 2)
        + on * off * (step_variance * (samples.on + samples.off) + model.quantisation_variance)
    )
    return _changes(samples, log_offset) - model.predicted_change(samples), variance


def negative_log_likelihood(
    samples: Samples,
    model: ErrorModel,
    log_offset: float,
    step_variance: float,
    limits: FrameLimits | None = None,
) -> float:
    """Mean over the samples of -log p(I after | I before, events), up to a constant.

    The mismatch between frames and events has Student's t distribution with the variance of `mismatch_of`. The density
    is one of I, not of log(I + I_0), so that different I_0 can be compared. It is truncated to ``limits``: pixels that
    became brighter than white or darker than black are not among the samples.
    """
    mismatch, variance = mismatch_of(samples, model, log_offset, step_variance)
    tails = (_FREEDOM + 1) / 2 * np.log1p(mismatch**2 / (_FREEDOM * variance))
    after = np.log(samples.after + log_offset)
    losses = 0.5 * np.log(variance) + tails + after
    if limits is not None:
        predicted, scale = after - mismatch, np.sqrt(variance)
        share = _student_t_share((np.log(limits.most + log_offset) - predicted) / scale)
        share -= _student_t_share((np.log(limits.least + log_offset) - predicted) / scale)
        losses += np.log(np.maximum(share, _LEAST_SHARE))
    return float(np.mean(losses))


def _student_t_share(t: Array) -> Array:
    """The share of Student's t of `_FREEDOM` (4) below ``t``; in closed form (Abramowitz and Stegun, 26.7.4)."""
    sine2 = 1.0 / (1.0 + _FREEDOM / np.maximum(np.square(t), 1e-12))  # of the angle atan(t / 2)
    half: Array = np.copysign(np.sqrt(sine2) * (1.0 + (1.0 - sine2) / 2.0) / 2.0, t)
    return half + 0.5


def _samples(
    recording: Recording, camera: CameraSettings, events: EventSettings
) -> tuple[Samples, FrameLimits]:
    """Pixels with events that both frames measure, interval by interval, and what their frames could show."""
    found: list[tuple[Array, ...]] = []
    count = 0
    response = named_responses(chosen_response(camera.response, recording.response))
    model = Camera(response[len(response) // 2])
    white = float(model.response.inverse(np.array(camera.clipped_from)))
    black = float(black_ceiling(model, np.zeros(1), 1.0)[0])
    black = black if black > CRUSHED else 0.0
    for interval, on, off, bend in counted_intervals(recording, camera, events, most_frames=_MAX_FRAMES):
        first, second = interval.first, interval.second
        chosen = spread(first.measured & second.measured & (on + off > 0), MAX_SAMPLES - count)
        pixels = (*(end.intensity for end in interval.ends), on, off, bend)
        whites = (first.white, second.white)
        limits = (black * second.white, white * second.white)  # of the frame after
        of_frames = (np.full(len(chosen), value) for value in (*whites, *limits))
        found.append((*(values.ravel()[chosen] for values in pixels), *of_frames))
        count += int(
            np.count_nonzero(np.minimum(pixels[0], pixels[1]).ravel()[chosen] >= black * second.white)
        )
        if count >= MAX_SAMPLES:
            break
    columns = [np.concatenate(column) for column in zip(*found, strict=True)] if found else [np.empty(0)] * 9
    return Samples(*columns[:7]), FrameLimits(*columns[7:])
