"""How large an event's step is, and when it was: thresholds, refractory period, delay, I_0 and variance, filled in.

All of them depend on one another. Thresholds are estimated under the apparent delay and the usual I_0, the true delay
comes with them, I_0 and the variance are estimated with both, and thresholds once more with the I_0 that is found.
"""

from __future__ import annotations

import dataclasses
from typing import Final, Literal, NamedTuple

import numpy as np

from kalux.calibration.delay import DelayEstimate, estimate_delay
from kalux.calibration.event_model import EventModel, estimate_event_model
from kalux.calibration.global_thresholds import (
    ROUGH_SAMPLES,
    ThresholdEstimate,
    Usual,
    estimate_thresholds,
    refine_thresholds,
    with_true_delay,
)
from kalux.calibration.steps import MAX_SAMPLES
from kalux.recording import Recording
from kalux.settings import EventSettings, Settings, altered, completed

Thresholds = tuple[float, float]
"""On and off, log intensity."""

ThresholdOrigin = Literal["settings", "recording", "calibration", "estimate", "assumed"]

ESTIMATED_ORIGINS: Final[tuple[ThresholdOrigin, ...]] = ("estimate", "assumed")
"""Origins of thresholds that nobody has stated or measured."""

UNCERTAIN_ORIGINS: Final[tuple[ThresholdOrigin, ...]] = ("calibration", *ESTIMATED_ORIGINS)
"""Origins of thresholds that may differ from the pixels' own: highlights are then shrunk more towards white."""

_USUAL_LOG_OFFSET: Final = 0.01
"""I_0, white = 1, beyond which stated thresholds are looked at again. It is 0.004 to 0.008 on 21 scenes, and 0.015 to
0.12 where two thirds of their thresholds are stated and the slope is usual all the same."""

_REFUTED: Final = 3.0
"""Standard deviations of estimated thresholds by which stated ones must differ from them to be wrong."""

_LIKELIER: Final = 0.02
"""Mean logarithm of the likelihood ratio of the frames by which they are so: 0.05 to 1.4 where stated thresholds are 10
to 50 % off, 0.01 and less where they are right, and less than 0 where frames are beside the events or I_0 is large."""


class StepEstimates(NamedTuple):
    """What events' steps were estimated by.

    Attributes
    ----------
    thresholds
        The fit of the thresholds and the refractory period, where there was one.
    delay
        The fit of the events' delay, where there was one.
    model
        The fit of I_0 and the variance of an event's step, where there was one.
    contradicted
        Thresholds that the recording states, where its frames contradict them so that estimated ones are used.
    """

    thresholds: ThresholdEstimate | None = None
    delay: DelayEstimate | None = None
    model: EventModel | None = None
    contradicted: Thresholds | None = None


class EventSteps(NamedTuple):
    """Settings with the size and the time of an event's step filled in.

    Attributes
    ----------
    settings
        With thresholds, refractory period, delay, I_0, step variance and extrapolation gain.
    origin
        Of the thresholds: the settings, the recording, an estimate, or an assumption.
    estimates
        Which of them were estimated, and how.
    """

    settings: Settings
    origin: ThresholdOrigin
    estimates: StepEstimates

    @property
    def threshold_error(self) -> float:
        """Relative standard deviation of thresholds that are estimated; 0 of others."""
        found = self.estimates.thresholds
        return 0.0 if found is None or self.origin not in ESTIMATED_ORIGINS else found.spread


class _FilledThresholds(NamedTuple):
    """Settings with thresholds and refractory period, where the former come from, and the fit of both, if any."""

    settings: Settings
    origin: ThresholdOrigin
    estimate: ThresholdEstimate | None


def with_event_steps(
    recording: Recording,
    settings: Settings,
    apparent: DelayEstimate | None = None,
    *,
    doubt_noise: bool = False,
) -> EventSteps:
    """Fill in what an event's step is, by the thresholds that the recording states unless its frames contradict them.

    Parameters
    ----------
    recording
        With frames and exposures.
    settings
        What they state is kept.
    apparent
        The delay under which events explain the frames best, where that has been estimated already.
    doubt_noise
        Whether the frames' noise is filled in, too, where it is less than was taken.
    """
    if apparent is None and settings.events.delay is None:
        apparent = estimate_delay(recording, settings.camera)
    stated = recording.contrast_threshold
    found = _filled_in(recording, settings, stated, apparent, doubt_noise)
    model = found.estimates.model
    if found.origin != "recording" or model is None or _are_plausible(model):
        return found
    estimated = _filled_in(recording, settings, None, apparent, doubt_noise)
    if not _refutes(estimated, found):
        return found
    return estimated._replace(estimates=estimated.estimates._replace(contradicted=stated))


def _are_plausible(model: EventModel) -> bool:
    """Whether nothing speaks against the thresholds. Those that are too small make I_0 large."""
    return model.agreement.is_usual and model.log_offset <= _USUAL_LOG_OFFSET


def _refutes(estimated: EventSteps, stated: EventSteps) -> bool:
    """Whether frames are so much likelier by estimated thresholds, with their own I_0, that stated ones are wrong.

    Frames beside the events make any thresholds look wrong: then they are no likelier by estimated ones.
    """
    fit, model = estimated.estimates.thresholds, estimated.estimates.model
    if estimated.origin != "estimate" or model is None or fit is None:
        return False
    assert stated.estimates.model is not None
    gain = stated.estimates.model.agreement.loss - model.agreement.loss
    thresholds = zip(estimated.settings.events.thresholds, stated.settings.events.thresholds, strict=True)
    apart = max(abs(np.log(one / other)) for one, other in thresholds)
    return bool(apart > _REFUTED * fit.spread and gain > _LIKELIER)


def _filled_in(
    recording: Recording,
    settings: Settings,
    stated: Thresholds | None,
    apparent: DelayEstimate | None,
    doubt_noise: bool,
) -> EventSteps:
    """`with_event_steps` by ``stated`` thresholds, those of the recording or None, whatever its frames say."""
    filled = _with_thresholds(recording, settings, stated, apparent)
    known, delay = _with_delay(recording, filled, apparent)
    known, model = _with_event_model(recording, known, doubt_noise=doubt_noise)
    if _depend_on_offset(filled, settings, known):
        filled = _with_thresholds(
            recording,
            dataclasses.replace(known, events=_unfilled(settings, known)),
            stated,
            delay,
            filled.estimate if filled.origin in ESTIMATED_ORIGINS else None,
        )
        known = filled.settings
    return EventSteps(known, filled.origin, StepEstimates(filled.estimate, delay, model))


def _depend_on_offset(filled: _FilledThresholds, settings: Settings, known: Settings) -> bool:
    """Whether thresholds, or the refractory period, were estimated with an I_0 that is another one by now."""
    if filled.estimate is None or settings.camera.log_offset is not None:
        return False
    if filled.origin in ESTIMATED_ORIGINS:
        return True
    return filled.estimate.may_lose and settings.camera.offset != known.camera.offset


def _unfilled(settings: Settings, known: Settings) -> EventSettings:
    """The events' settings that are ``known``, but for thresholds and refractory period, which are as before."""
    events = known.events
    return dataclasses.replace(
        settings.events,
        delay=events.delay,
        step_variance=events.step_variance,
        extrapolation_gain=events.extrapolation_gain,
        extrapolation_trust=events.extrapolation_trust,
    )


def _with_thresholds(
    recording: Recording,
    settings: Settings,
    stated: Thresholds | None,
    delay: DelayEstimate | None,
    rough: ThresholdEstimate | None = None,
) -> _FilledThresholds:
    """Fill in thresholds and refractory period: from the settings, else ``stated``, else an estimate, else usual.

    Events are counted under the apparent ``delay``, or that of the settings where it is None. With ``rough``, an
    estimate made before I_0 was known, only what depends on I_0 is estimated again.
    """
    events = settings.events
    origin: ThresholdOrigin = "settings" if events.has_thresholds else "recording"
    known = events.with_thresholds(*(stated or (None, None)))
    finds_period = _refractory_period(settings) is None
    if known.has_thresholds and not finds_period:
        return _FilledThresholds(dataclasses.replace(settings, events=known), origin, None)
    usual = Usual.of(known)
    of_log_offset = _steps_log_offset(settings)
    period = _refractory_period(settings)
    estimate: ThresholdEstimate | None
    if rough is None:
        estimate = estimate_thresholds(
            recording,
            settings.camera,
            usual,
            of_log_offset=of_log_offset,
            delay=events.lateness if delay is None else delay.apparent,
            refractory_period=period,
            most=ROUGH_SAMPLES if settings.camera.log_offset is None else MAX_SAMPLES,
        )
    else:
        estimate = refine_thresholds(
            recording,
            settings.camera,
            usual,
            rough,
            of_log_offset=of_log_offset,
            refractory_period=period,
        )
    if finds_period:
        period = 0 if estimate is None else estimate.refractory_period
        spread = 0.0 if estimate is None else round(estimate.refractory_spread, 3)
        known = dataclasses.replace(
            known,
            refractory_period=period,
            refractory_spread=spread if known.refractory_spread is None else known.refractory_spread,
        )
    if not known.has_thresholds:
        origin = "assumed" if estimate is None or estimate.usual_share > 0.5 else "estimate"
        known = known.assuming() if estimate is None else known.with_thresholds(estimate.on, estimate.off)
    return _FilledThresholds(dataclasses.replace(settings, events=known), origin, estimate)


def _with_delay(
    recording: Recording, filled: _FilledThresholds, apparent: DelayEstimate | None
) -> tuple[Settings, DelayEstimate | None]:
    """Fill in the events' delay: from the settings, else an estimate, else the usual.

    The true one is a result of estimating the thresholds; where these are known, and there is no estimate of them, they
    are estimated for its sake alone.
    """
    settings, events = filled.settings, filled.settings.events
    if events.delay is not None:
        return settings, None
    if apparent is None:
        return altered(settings, "events", delay=events.usual_delay), None
    if filled.estimate is not None:
        delay = apparent._replace(true=filled.estimate.delay) if filled.estimate.delay_found else apparent
    else:
        delay = with_true_delay(
            recording,
            settings.camera,
            apparent,
            Usual.of(events),
            of_log_offset=_steps_log_offset(settings),
            refractory_period=_refractory_period(settings) or 0,
        )
    return altered(settings, "events", delay=delay.delay), delay


def _with_event_model(
    recording: Recording, settings: Settings, *, doubt_noise: bool
) -> tuple[Settings, EventModel | None]:
    """Fill in I_0, the variance of steps and how far events are believed beyond white.

    From the settings, else an estimate, else the usual.
    """
    camera, events, bridged = settings.camera, settings.events, settings.filter.joins_frames
    of_events = events.step_variance, events.extrapolation_gain, events.extrapolation_trust
    if camera.log_offset is not None and (None not in of_events or not bridged):
        return settings, None
    used = dataclasses.replace(events, refractory_period=_refractory_period(settings))
    model = estimate_event_model(recording, camera, used, doubt_noise=doubt_noise)
    if model is not None:
        if model.frame_noise is not None:
            read, shot = model.frame_noise
            settings = altered(settings, "camera", frame_noise=read, shot_noise=shot)
        settings = completed(settings, "camera", log_offset=model.log_offset)
        settings = completed(settings, "events", step_variance=model.step_variance)
        if bridged:
            gain, trust = round(model.agreement.gain, 3), round(model.agreement.trust, 3)
            settings = completed(settings, "events", extrapolation_gain=gain, extrapolation_trust=trust)
    # What could not be estimated is filled in with the usual value, so that the settings tell what was used.
    settings = completed(settings, "camera", log_offset=camera.offset)
    return completed(settings, "events", step_variance=events.step_noise), model


def _refractory_period(settings: Settings) -> int | None:
    """The refractory period, us, that the filter corrects for: None while it is to be estimated, 0 in other filters."""
    return settings.events.refractory_period if settings.filter.joins_frames else 0


def _steps_log_offset(settings: Settings) -> bool:
    """Whether events are taken as steps of log(I + I_0), as in the paper, rather than of log I."""
    return settings.filter.augmentation == "paper"
