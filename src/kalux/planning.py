"""Plan a reconstruction: settings that are None are estimated from the recording, and the times of images chosen."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.black_level import BlackLevel, with_known_black
from kalux.calibration.delay import DelayEstimate, estimate_delay
from kalux.calibration.event_layout import LayoutFit, find_layout
from kalux.calibration.event_model import EventModel, estimate_event_model
from kalux.calibration.fixed_pattern import USUAL_PATTERN, FixedPattern, estimate_fixed_pattern
from kalux.calibration.frame_faults import FrameFaults, FrameWatch, find_frame_faults
from kalux.calibration.frame_noise import FrameNoise, UsualNoise, estimate_frame_noise, usual_noise
from kalux.calibration.global_thresholds import (
    ROUGH_SAMPLES,
    ThresholdEstimate,
    Usual,
    estimate_thresholds,
    refine_thresholds,
    with_true_delay,
)
from kalux.calibration.hot_pixels import find_hot_pixels
from kalux.calibration.levels import Ceiling, exact_end, find_ceiling
from kalux.calibration.mismatch import Mismatch, estimate_mismatch
from kalux.calibration.noise import event_noise
from kalux.calibration.refractory import dead_time
from kalux.calibration.steps import MAX_SAMPLES
from kalux.calibration.values import Calibration
from kalux.calibration.white_balance import grey_world
from kalux.errors import InputError, require_type
from kalux.frames import median_exposure
from kalux.models.camera import BrightTail, Camera, count_bright
from kalux.models.colour import white_balance
from kalux.models.pixels import PixelCalibration, require_size, with_hot
from kalux.recording import (
    RECORDING_NEEDED,
    UNCHANGED,
    FrameCorrections,
    Recording,
    less_black,
    no_frames,
    with_cached_start,
    with_corrected_frames,
    with_event_layout,
    without_events_of,
)
from kalux.schedule import image_times
from kalux.settings import SETTINGS_NEEDED, Settings, altered, chosen_response
from kalux.settings import preset as named_preset

Thresholds = tuple[float, float]
"""On and off, log intensity."""

ThresholdOrigin = Literal["settings", "recording", "calibration", "estimate", "assumed"]

ESTIMATED_ORIGINS: Final[tuple[ThresholdOrigin, ...]] = ("estimate", "assumed")
"""Origins of thresholds that nobody has stated or measured."""

UNCERTAIN_ORIGINS: Final[tuple[ThresholdOrigin, ...]] = ("calibration", *ESTIMATED_ORIGINS)
"""Origins of thresholds that may differ from the pixels' own: highlights are then shrunk more towards white."""

_CALIBRATION_NEEDED: Final = "a kalux.Calibration is needed, from kalux.load_calibration"

_NOISE_EVENTS: Final = 1_000_000
"""Number of events from which the background noise is estimated: at 15 million events/s, those of 70 ms."""


_LEAST_NOISE: Final = 0.5
"""Least background noise with lookahead, Hz per pixel: events are isolated for other reasons, too (leak of bright
pixels, flicker). slider_depth has 0.15 where nothing is seen, street 0.005 (docs/equations.md, K5)."""

_USUAL_LOG_OFFSET: Final = 0.01
"""I_0, white = 1, beyond which stated thresholds are looked at again. It is 0.004 to 0.008 on 21 scenes, and 0.015 to
0.12 where two thirds of their thresholds are stated and the slope is usual all the same."""

_REFUTED: Final = 3.0
"""Standard deviations of estimated thresholds by which stated ones must differ from them to be wrong."""

_LIKELIER: Final = 0.02
"""Mean logarithm of the likelihood ratio of the frames by which they are so: 0.05 to 1.4 where stated thresholds are 10
to 50 % off, 0.01 and less where they are right, and less than 0 where frames are beside the events or I_0 is large."""

_CACHED_EVENTS: Final = 1 << 21
_CACHED_FRAME_BYTES: Final = 1 << 25
"""Number of events (32 MB) and bytes of frames (32 MB) at the beginning of a recording that stay in memory while it is
planned: most estimates take their samples from there, so that they are read and decoded once."""


@dataclass(frozen=True)
class Plan:
    """Everything that a reconstruction will use, decided before it starts.

    Attributes
    ----------
    settings
        With thresholds, refractory period, delay, frame noise, fixed pattern, I_0, step variance, black level,
        saturation, reference exposure and white balance filled in.
    threshold_origin
        Whether the thresholds come from the settings, the recording, a calibration, an estimate, or are assumed.
    estimate
        The fit of the thresholds and the refractory period, where there was one.
    delay_estimate
        The fit of the events' delay, where there was one.
    event_model
        The fit of I_0 and the variance of an event's step, where there was one.
    contradicted
        Thresholds that the recording states, where its frames contradict them so that estimated ones are used.
    times
        (N,) int64 us, none before the one before it: the images to make.
    lookahead
        Whether images use the frame after them.
    smooth
        Whether images use all of the recording after them.
    pixels
        What a calibration says of single pixels, and which ones are hot.
    frame_noise
        The fit of the frames' noise, where there was one.
    fixed_pattern
        The fit of the frames' fixed pattern, where there was one.
    mismatch
        The fit of the thresholds' spread between pixels, where there was one.
    background_rate
        The measured noise of events, Hz per pixel, where it was.
    ceiling
        Where the frames end at one level below the usual saturation while events go on.
    black
        What was looked for where the frames begin above 0: whether that is black.
    dead_time
        The refractory period that noise shows, us; 0 where it does not.
    hot_pixels
        How many event pixels were found to be hot, whose events are left out.
    frame_faults
        Frames that are left out, or whose gain is not that of others.
    corrections
        What is done about these.
    layout
        How events lie to the frames, where that is looked for and can be told.
    """

    settings: Settings
    threshold_origin: ThresholdOrigin
    estimate: ThresholdEstimate | None
    delay_estimate: DelayEstimate | None
    event_model: EventModel | None
    times: NDArray[np.int64]
    lookahead: bool
    smooth: bool
    pixels: PixelCalibration | None = None
    frame_noise: FrameNoise | None = None
    fixed_pattern: FixedPattern | None = None
    mismatch: Mismatch | None = None
    background_rate: float | None = None
    ceiling: Ceiling | None = None
    black: BlackLevel | None = None
    contradicted: Thresholds | None = None
    dead_time: int = 0
    hot_pixels: int = 0
    frame_faults: FrameFaults | None = None
    corrections: FrameCorrections = UNCHANGED
    layout: LayoutFit | None = None


def plan(
    recording: Recording,
    *,
    rate_hz: float | None = None,
    times: Any = None,
    at: Literal["frames"] | None = None,
    preset: str = "default",
    settings: Settings | None = None,
    calibration: Calibration | None = None,
    lookahead: bool = True,
    smooth: bool = False,
) -> Plan:
    """Plan a reconstruction. See `kalux.reconstruct` for the parameters and errors."""
    require_type("reconstruct: recording", recording, Recording, RECORDING_NEEDED)
    if settings is not None:
        require_type("reconstruct: settings", settings, Settings, SETTINGS_NEEDED)
    if calibration is not None:
        require_type("reconstruct: calibration", calibration, Calibration, _CALIBRATION_NEEDED)
    known = Calibration() if calibration is None else calibration
    chosen = settings if settings is not None else known.apply(named_preset(preset))
    if sum(choice is not None for choice in (rate_hz, times, at)) != 1:
        raise InputError("reconstruct: give exactly one of rate_hz, times and at")
    if smooth:
        _check_smooth(chosen, lookahead)
    if known.pixels is not None:
        require_size(known.pixels, recording.sensor_size)
    recording = with_cached_start(recording, _CACHED_EVENTS, _CACHED_FRAME_BYTES)
    looks_for_layout = chosen.filter.joins_frames and chosen.events.mend_layout
    layout = find_layout(recording, chosen.camera) if looks_for_layout else None
    if layout is not None:
        recording = with_event_layout(recording, layout.found)
    looks_for_hot = chosen.filter.joins_frames and chosen.events.leave_out_hot
    hot = find_hot_pixels(recording) if looks_for_hot else None
    if hot is not None and hot.any():
        recording = without_events_of(recording, hot)
    recording, chosen, black = _less_black(recording, chosen)
    chosen, ceiling = with_saturation(recording, chosen)
    response = chosen_response(chosen.camera.response, recording.response)
    camera = Camera.named(response, chosen.camera.clipped_from)
    watch = _frame_watch(chosen, camera)
    exposures, tail = _survey(recording, camera if _measures_tail(chosen) else None, watch)
    if chosen.filter.motion == "auto":
        follows = smooth or chosen.filter.follows_motion(recording.sensor_size)
        chosen = altered(chosen, "filter", motion="on" if follows else "off")
    faults = None if watch is None else find_frame_faults(recording, chosen.camera, watch) or None
    first = 0 if faults is None else faults.first
    begin = _begin_time(exposures[first], chosen, lookahead)
    earliest = begin if times is None else _begin_time(exposures[0], chosen, lookahead)
    wanted = image_times(recording, exposures, earliest, rate_hz=rate_hz, times=times, at=at)
    corrections = UNCHANGED
    if faults is not None:
        corrections = faults.corrections(with_first=bool(len(wanted)) and int(wanted[0]) < begin)
        recording = with_corrected_frames(recording, corrections)
    lengths = exposures[:, 1] - exposures[:, 0]
    reference = chosen.camera.reference_exposure or median_exposure(lengths)
    chosen = altered(chosen, "camera", reference_exposure=reference, response=response)
    chosen = _with_white_balance(recording, chosen)
    chosen, noise, doubted = _with_frame_noise(recording, chosen)
    chosen, pattern = _with_fixed_pattern(recording, chosen)
    chosen, period = _with_dead_time(recording, chosen)
    seen_delay = None
    if black is not None and not black.level and ceiling is None and lengths[0] == reference:
        seen_delay = black.delay  # estimated while black was looked for, and not found: of these very frames
    chosen, origin, estimate, delay, model, contradicted = _with_event_steps(
        recording, chosen, seen_delay, doubt_noise=doubted
    )
    threshold_error = estimate.spread if estimate is not None and origin in ESTIMATED_ORIGINS else 0.0
    chosen, mismatch = _with_mismatch(recording, chosen, threshold_error)
    chosen, background = _with_background(recording, chosen, known.pixels, lookahead)
    if origin == "settings" and _are_calibrated(chosen, known):
        origin = "calibration"
    uses_tail = origin in UNCERTAIN_ORIGINS or (chosen.filter.joins_frames and chosen.filter.unshown_tail > 0)
    if uses_tail and tail is not None:
        chosen = altered(chosen, "filter", bright_tail=tail.scale)
    return Plan(
        settings=chosen,
        threshold_origin=origin,
        estimate=estimate,
        delay_estimate=delay,
        event_model=model,
        contradicted=contradicted,
        times=wanted,
        lookahead=lookahead,
        smooth=smooth,
        pixels=known.pixels if hot is None else with_hot(known.pixels, hot, chosen.events.mismatch),
        hot_pixels=0 if hot is None else int(np.count_nonzero(hot)),
        frame_noise=noise,
        fixed_pattern=pattern,
        mismatch=mismatch,
        background_rate=background,
        ceiling=ceiling,
        black=black,
        dead_time=period,
        frame_faults=faults,
        corrections=corrections,
        layout=layout,
    )


def _check_smooth(settings: Settings, lookahead: bool) -> None:
    if not lookahead:
        raise InputError(
            "reconstruct: smooth uses the future, lookahead=False (causal) forbids it; choose one"
        )
    if settings.filter.kind == "cf":
        raise InputError(
            "reconstruct: the complementary filter has no variance, so that it cannot be smoothed"
        )


def _less_black(recording: Recording, settings: Settings) -> tuple[Recording, Settings, BlackLevel | None]:
    """Take the black level off, and fill it in where the frames begin above 0 and events say that this is black.

    The paper's filters take off what is given and look for nothing.
    """
    if not settings.filter.joins_frames:
        return less_black(recording, settings.camera.black_level), settings, None
    recording, found = with_known_black(recording, settings.camera, settings.events)
    if found is not None and found.level:
        settings = altered(settings, "camera", black_level=found.level)
    return recording, settings, found


def with_saturation(recording: Recording, settings: Settings) -> tuple[Settings, Ceiling | None]:
    """Fill in the saturation: from the settings, else the level at which all frames end while events go on, else usual.

    Frames also end where the scene has nothing brighter. Events tell which it is: pixels at that level are clipped if
    events go on there, by thresholds that are estimated as if it were the saturation.

    Returns
    -------
    The settings, and the level at which frames are clipped, if that was found.
    """
    camera = settings.camera
    usual = altered(settings, "camera", saturation=camera.clipped_from)
    if camera.saturation is not None or not settings.filter.joins_frames:
        return usual, None
    end = exact_end(recording, camera.usual_saturation)
    if end is None:
        return usual, None
    clipped = altered(settings, "camera", saturation=camera.usual_saturation * end)
    known = _with_event_steps(recording, clipped).settings
    found = find_ceiling(recording, known.camera, known.events)
    return (clipped, found) if found is not None and found.is_at(end) else (usual, None)


def _frame_watch(settings: Settings, camera: Camera) -> FrameWatch | None:
    """What sees the frames go by, for as much as the settings let be mended; None for nothing."""
    chosen = settings.camera
    asked = (chosen.even_gain, chosen.leave_out_faulty, chosen.mend_stuck)
    if not settings.filter.joins_frames or not any(asked):
        return None
    gain, faulty, stuck = asked
    return FrameWatch(camera, gain=gain, faulty=faulty, stuck=stuck)


def _survey(
    recording: Recording, camera: Camera | None, watch: FrameWatch | None
) -> tuple[NDArray[np.int64], BrightTail | None]:
    """(K, 2) starts and ends, us, of all exposures, and, given a camera, the frames' bright tail, in one pass.

    A watch sees all frames.
    """
    exposures, tail = [], BrightTail()
    for frame in recording.frames():
        exposures.append((frame.exposure_start, frame.exposure_end))
        if camera is not None:
            tail = tail.joined(count_bright(camera, frame.image, frame.white_value, frame.black))
        if watch is not None:
            watch.see(frame)
    if not exposures:
        raise no_frames(recording)
    return np.array(exposures, np.int64), None if camera is None else tail


def _measures_tail(settings: Settings) -> bool:
    """Whether the prior on highlights may need the frames' bright tail, which is not given."""
    filtered = settings.filter
    return filtered.kind == "akf" and filtered.highlight_scale > 0 and filtered.bright_tail is None


def _begin_time(first: NDArray[np.int64], settings: Settings, lookahead: bool) -> int:
    """The first time that can be read, us, given the ``first`` exposure; the same as `Reconstructor.begin_time`."""
    start, end = (int(t) for t in first)
    if not lookahead:
        return end
    return start + (end - start) // 2 if settings.filter.kind == "cf" else start


def _with_white_balance(recording: Recording, settings: Settings) -> Settings:
    """Measure the gains of a white balance that has none, where frames are in colour."""
    first = next(iter(recording.frames()))
    if first.colours == "grey" or white_balance(settings.camera.white_balance) is not None:
        return settings
    gains = ";".join(f"{gain:.4f}" for gain in grey_world(recording, settings.camera))
    return altered(settings, "camera", white_balance=gains)


def _are_calibrated(settings: Settings, calibration: Calibration) -> bool:
    """Whether the thresholds are those of the calibration."""
    found = calibration.settings.get("events", {})
    names = ("threshold_on", "threshold_off")
    return all(name in found and found[name] == getattr(settings.events, name) for name in names)


def _with_delay(
    recording: Recording, settings: Settings, delay: DelayEstimate | None, estimate: ThresholdEstimate | None
) -> tuple[Settings, DelayEstimate | None]:
    """Fill in the events' delay: from the settings, else an estimate, else the usual.

    ``delay`` holds the apparent one. The true one is a result of estimating the thresholds; where these are known, and
    ``estimate`` is None, they are estimated for its sake alone.
    """
    events = settings.events
    if events.delay is not None:
        return settings, None
    if delay is None:
        return altered(settings, "events", delay=events.usual_delay), None
    if estimate is not None:
        delay = delay._replace(true=estimate.delay)
    else:
        delay = with_true_delay(
            recording,
            settings.camera,
            delay,
            Usual.of(events),
            of_log_offset=_steps_log_offset(settings),
            refractory_period=_refractory_period(settings) or 0,
        )
    return altered(settings, "events", delay=delay.delay), delay


def _with_frame_noise(recording: Recording, settings: Settings) -> tuple[Settings, FrameNoise | None, bool]:
    """Fill in the frames' noise, where the filter uses it: from the settings, else an estimate, else the usual.

    Returned is also whether it is more than pixels without events tell, so that events may contradict.
    """
    camera = settings.camera
    if camera.frame_noise is not None or not settings.filter.joins_frames:
        return settings, None, False
    found = estimate_frame_noise(recording, camera)
    if found is not None and not found.is_reliable:
        found = None
    noise = usual_noise(recording, camera) if found is None else found
    shot = noise.shot if camera.shot_noise is None else camera.shot_noise
    doubted = isinstance(noise, UsualNoise) and not noise.silent and camera.shot_noise is None
    return altered(settings, "camera", frame_noise=noise.read, shot_noise=shot), found, doubted


def _with_fixed_pattern(recording: Recording, settings: Settings) -> tuple[Settings, FixedPattern | None]:
    """Fill in the frames' fixed pattern, where the variance counts it: from the settings, else an estimate.

    Where the recording cannot tell, because nothing moves, the usual one; 0 of frames that have been processed.
    """
    if settings.camera.fixed_pattern is not None or not settings.filter.joins_frames:
        return settings, None
    found = estimate_fixed_pattern(recording, settings.camera)
    if found is not None and not found.is_measured:
        return altered(settings, "camera", fixed_pattern=USUAL_PATTERN), None
    return altered(settings, "camera", fixed_pattern=0.0 if found is None else found.deviation), found


def _with_dead_time(recording: Recording, settings: Settings) -> tuple[Settings, int]:
    """Fill in the refractory period where noise events show it. Returned as well, us; 0 where they do not."""
    if settings.events.refractory_period is not None or not settings.filter.joins_frames:
        return settings, 0
    period = dead_time(recording)
    return altered(settings, "events", refractory_period=period or None), period


class _EventSteps(NamedTuple):
    """Settings with the size and the time of an event's step filled in, and the estimates that these come from.

    ``contradicted`` are thresholds that the recording states and that were not taken, since its frames contradict.
    """

    settings: Settings
    origin: ThresholdOrigin
    estimate: ThresholdEstimate | None
    delay: DelayEstimate | None
    model: EventModel | None
    contradicted: Thresholds | None = None


def _with_event_steps(
    recording: Recording,
    settings: Settings,
    delay: DelayEstimate | None = None,
    *,
    doubt_noise: bool = False,
) -> _EventSteps:
    """`_filled_event_steps` with the thresholds that the recording states, unless its own frames contradict them.

    ``delay`` is the apparent one, where it has been estimated.
    """
    if delay is None and settings.events.delay is None:
        delay = estimate_delay(recording, settings.camera)
    stated = recording.contrast_threshold
    found = _filled_event_steps(recording, settings, stated, delay, doubt_noise)
    if found.origin != "recording" or found.model is None or _are_plausible(found.model):
        return found
    estimated = _filled_event_steps(recording, settings, None, delay, doubt_noise)
    return estimated._replace(contradicted=stated) if _refutes(estimated, found) else found


def _are_plausible(model: EventModel) -> bool:
    """Whether nothing speaks against the thresholds. Those that are too small make I_0 large."""
    return model.agreement.is_usual and model.log_offset <= _USUAL_LOG_OFFSET


def _refutes(estimated: _EventSteps, stated: _EventSteps) -> bool:
    """Whether frames are so much likelier by estimated thresholds, with their own I_0, that stated ones are wrong.

    Frames beside the events make any thresholds look wrong: then they are no likelier by estimated ones.
    """
    if estimated.origin != "estimate" or estimated.model is None or estimated.estimate is None:
        return False
    assert stated.model is not None
    gain = stated.model.agreement.loss - estimated.model.agreement.loss
    thresholds = zip(estimated.settings.events.thresholds, stated.settings.events.thresholds, strict=True)
    apart = max(abs(np.log(one / other)) for one, other in thresholds)
    return bool(apart > _REFUTED * estimated.estimate.spread and gain > _LIKELIER)


def _filled_event_steps(
    recording: Recording,
    settings: Settings,
    stated: Thresholds | None,
    delay: DelayEstimate | None,
    doubt_noise: bool,
) -> _EventSteps:
    """Fill in what an event's step is: thresholds, refractory period and delay, then I_0 and the step's variance.

    ``stated`` are the recording's thresholds, ``delay`` is the apparent one; None: not known. With ``doubt_noise`` the
    frames' noise is filled in, too, where it is less than was taken.

    Thresholds depend on I_0 a little, and it on them: they are estimated once more with the I_0 that is found.
    """
    filled, origin, estimate = _with_thresholds(recording, settings, stated, delay)
    filled, delay = _with_delay(recording, filled, delay, estimate)
    filled, model = _with_event_model(recording, filled, doubt_noise=doubt_noise)
    if estimate is not None and settings.camera.log_offset is None:
        estimated = origin in ESTIMATED_ORIGINS
        if estimated or (estimate.may_lose and settings.camera.offset != filled.camera.offset):
            events = filled.events
            unfilled = dataclasses.replace(
                settings.events,
                delay=events.delay,
                step_variance=events.step_variance,
                extrapolation_gain=events.extrapolation_gain,
            )
            filled, origin, estimate = _with_thresholds(
                recording,
                dataclasses.replace(filled, events=unfilled),
                stated,
                delay,
                estimate if estimated else None,
            )
    return _EventSteps(filled, origin, estimate, delay, model)


def _with_thresholds(
    recording: Recording,
    settings: Settings,
    stated: Thresholds | None,
    delay: DelayEstimate | None,
    rough: ThresholdEstimate | None = None,
) -> tuple[Settings, ThresholdOrigin, ThresholdEstimate | None]:
    """Fill in thresholds and refractory period: from the settings, else ``stated``, else an estimate, else usual.

    Events are counted under the apparent ``delay``, or that of the settings where it is None. With ``rough``, an
    estimate made before I_0 was known, only what depends on I_0 is estimated again.
    """
    events = settings.events
    origin: ThresholdOrigin = "settings" if events.has_thresholds else "recording"
    known = events.with_thresholds(*(stated or (None, None)))
    finds_period = _refractory_period(settings) is None
    if known.has_thresholds and not finds_period:
        return dataclasses.replace(settings, events=known), origin, None
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
        known = dataclasses.replace(known, refractory_period=period)
    if not known.has_thresholds:
        origin = "assumed" if estimate is None or estimate.usual_share > 0.5 else "estimate"
        known = known.assuming() if estimate is None else known.with_thresholds(estimate.on, estimate.off)
    return dataclasses.replace(settings, events=known), origin, estimate


def _refractory_period(settings: Settings) -> int | None:
    """The refractory period, us, that the filter corrects for: None while it is to be estimated, 0 in other filters."""
    return settings.events.refractory_period if settings.filter.joins_frames else 0


def _steps_log_offset(settings: Settings) -> bool:
    """Whether events are taken as steps of log(I + I_0), as in the paper, rather than of log I."""
    return settings.filter.augmentation == "paper"


def _with_event_model(
    recording: Recording, settings: Settings, *, doubt_noise: bool
) -> tuple[Settings, EventModel | None]:
    """Fill in I_0, the variance of steps and how far events are believed beyond white.

    From the settings, else an estimate, else the usual.
    """
    camera, events, bridged = settings.camera, settings.events, settings.filter.joins_frames
    of_events = events.step_variance, events.extrapolation_gain
    if camera.log_offset is not None and (None not in of_events or not bridged):
        return settings, None
    used = dataclasses.replace(events, refractory_period=_refractory_period(settings))
    model = estimate_event_model(recording, camera, used, doubt_noise=doubt_noise)
    if model is not None:
        if camera.log_offset is None:
            camera = dataclasses.replace(camera, log_offset=model.log_offset)
        if model.frame_noise is not None:
            read, shot = model.frame_noise
            camera = dataclasses.replace(camera, frame_noise=read, shot_noise=shot)
        if events.step_variance is None:
            events = dataclasses.replace(events, step_variance=model.step_variance)
        if events.extrapolation_gain is None and bridged:
            events = dataclasses.replace(events, extrapolation_gain=round(model.agreement.gain, 3))
    # What could not be estimated is filled in with the usual value, so that the settings tell what was used.
    camera = dataclasses.replace(camera, log_offset=camera.offset)
    events = dataclasses.replace(events, step_variance=events.step_noise)
    return dataclasses.replace(settings, camera=camera, events=events), model


def _with_mismatch(
    recording: Recording, settings: Settings, threshold_error: float
) -> tuple[Settings, Mismatch | None]:
    """Fill in the thresholds' spread between pixels: from the settings, else an estimate, else the usual.

    The relative error of estimated thresholds, 0 of others, is a part of it.
    """
    events = settings.events
    if events.threshold_spread is not None or not settings.filter.joins_frames:
        return settings, None
    found = estimate_mismatch(recording, settings.camera, events)
    spread = float(np.hypot(events.mismatch if found is None else found.spread, threshold_error))
    return altered(settings, "events", threshold_spread=spread), found


def _with_background(
    recording: Recording, settings: Settings, pixels: PixelCalibration | None, lookahead: bool
) -> tuple[Settings, float | None]:
    """Fill in the background noise: from the settings, else what is measured, at least the least, else the usual.

    With lookahead neighbours tell what is noise, by its rate; else ages of events do, for which the usual is the least.
    """
    events = settings.events
    if events.noise_rate is not None or not settings.filter.joins_frames:
        return settings, None
    found = event_noise(recording, _NOISE_EVENTS, None if pixels is None else pixels.hot)
    if found is None:
        rate = events.background_rate
    else:
        least = min(_LEAST_NOISE, events.usual_noise_rate) if lookahead else events.usual_noise_rate
        rate = max(found.rate, least)
    return altered(settings, "events", noise_rate=rate), None if found is None else found.rate
