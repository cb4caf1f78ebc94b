"""Plan a reconstruction: settings that are None are estimated from the recording, and the times of images chosen."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.delay import DelayEstimate, estimate_delay
from kalux.calibration.event_model import EventModel, estimate_event_model
from kalux.calibration.fixed_pattern import USUAL_PATTERN, FixedPattern, estimate_fixed_pattern
from kalux.calibration.frame_noise import FrameNoise, estimate_frame_noise, usual_noise
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
from kalux.recording import RECORDING_NEEDED, Recording, no_frames, remembering, without_events_of
from kalux.schedule import image_times
from kalux.settings import SETTINGS_NEEDED, Settings, altered, chosen_response
from kalux.settings import preset as named_preset

ThresholdOrigin = Literal["settings", "recording", "calibration", "estimate", "assumed"]

_NOT_STATED: Final[tuple[ThresholdOrigin, ...]] = ("estimate", "assumed")

DOUBTED: Final[tuple[ThresholdOrigin, ...]] = ("calibration", *_NOT_STATED)
"""Origins of thresholds that may differ from the pixels' own: highlights are then shrunk more towards white."""

_CALIBRATION_NEEDED: Final = "a kalux.Calibration is needed, from kalux.load_calibration"

_NOISE_EVENTS: Final = 1_000_000
"""From which the background noise is estimated: at 15 million events/s, those of 300,000 pixels in 70 ms."""

_REMEMBERED_EVENTS: Final = 1 << 21
_REMEMBERED_FRAMES: Final = 1 << 25
"""Events (32 MB) and bytes of frames at the beginning that are read once for all estimates, which take most of their
samples from there."""


@dataclass(frozen=True)
class Plan:
    """Everything that a reconstruction will use, decided before it starts.

    Attributes
    ----------
    settings
        With thresholds, refractory period, delay, frame noise, fixed pattern, I_0, step variance, saturation, reference
        exposure and white balance filled in.
    threshold_origin
        Whether the thresholds come from the settings, the recording, a calibration, an estimate, or are assumed.
    estimate
        The fit of the thresholds and the refractory period, where there was one.
    delay_estimate
        The fit of the events' delay, where there was one.
    event_model
        The fit of I_0 and the variance of an event's step, where there was one.
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
    dead_time
        The refractory period that noise shows, us; 0 where it does not.
    hot_pixels
        How many event pixels were found to be hot, whose events are left out.
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
    dead_time: int = 0
    hot_pixels: int = 0


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
    recording = remembering(recording, _REMEMBERED_EVENTS, _REMEMBERED_FRAMES)
    looks_for_hot = _uses_steps(chosen) and chosen.events.leave_out_hot
    hot = find_hot_pixels(recording, _NOISE_EVENTS) if looks_for_hot else None
    if hot is not None and hot.any():
        recording = without_events_of(recording, hot)
    chosen, ceiling = with_saturation(recording, chosen)
    response = chosen_response(chosen.camera.response, recording.response)
    camera = Camera.named(response, chosen.camera.clipped_from)
    exposures, tail = _survey(recording, camera if _measures_tail(chosen) else None)
    begin = _begin_time(exposures[0], chosen, lookahead)
    if chosen.filter.motion == "auto":
        follows = smooth or chosen.filter.follows_motion(recording.sensor_size)
        chosen = altered(chosen, "filter", motion="on" if follows else "off")
    wanted = image_times(recording, exposures, begin, rate_hz=rate_hz, times=times, at=at)
    lengths = exposures[:, 1] - exposures[:, 0]
    reference = chosen.camera.reference_exposure or median_exposure(lengths)
    chosen = altered(chosen, "camera", reference_exposure=reference, response=response)
    chosen = _with_white_balance(recording, chosen)
    chosen, noise = _with_frame_noise(recording, chosen)
    chosen, pattern = _with_fixed_pattern(recording, chosen)
    chosen, period = _with_dead_time(recording, chosen)
    chosen, origin, estimate, delay, model = _with_event_steps(recording, chosen)
    unsure = estimate.spread if estimate is not None and origin in _NOT_STATED else 0.0
    chosen, mismatch = _with_mismatch(recording, chosen, unsure)
    chosen, background = _with_background(recording, chosen, known.pixels)
    if origin == "settings" and _are_calibrated(chosen, known):
        origin = "calibration"
    doubted = origin in DOUBTED or (_uses_steps(chosen) and chosen.filter.unshown_tail > 0)
    if doubted and tail is not None:
        chosen = altered(chosen, "filter", bright_tail=tail.scale)
    return Plan(
        settings=chosen,
        threshold_origin=origin,
        estimate=estimate,
        delay_estimate=delay,
        event_model=model,
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
        dead_time=period,
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


def with_saturation(recording: Recording, settings: Settings) -> tuple[Settings, Ceiling | None]:
    """Fill in the saturation: from the settings, else the level at which all frames end while events go on, else usual.

    Frames may also end where the scene does. Events decide, by thresholds estimated as if frames were clipped there.

    Returns
    -------
    The settings, and the level at which frames are clipped, if that was found.
    """
    camera = settings.camera
    usual = altered(settings, "camera", saturation=camera.clipped_from)
    if camera.saturation is not None or not _uses_steps(settings):
        return usual, None
    end = exact_end(recording, camera.usual_saturation)
    if end is None:
        return usual, None
    clipped = altered(settings, "camera", saturation=camera.usual_saturation * end)
    known = _with_event_steps(recording, clipped).settings
    found = find_ceiling(recording, known.camera, known.events)
    return (clipped, found) if found is not None and found.is_at(end) else (usual, None)


def _survey(recording: Recording, camera: Camera | None) -> tuple[NDArray[np.int64], BrightTail | None]:
    """(K, 2) exposure starts and ends, us, of all frames, and, given a camera, their bright tail."""
    exposures, tail = [], BrightTail()
    for frame in recording.frames():
        exposures.append((frame.exposure_start, frame.exposure_end))
        if camera is not None:
            tail = tail.joined(count_bright(camera, frame.image, frame.white_value))
    if not exposures:
        raise no_frames(recording)
    return np.array(exposures, np.int64), None if camera is None else tail


def _measures_tail(settings: Settings) -> bool:
    """Whether the frames' bright tail may be needed: for the prior on highlights, unless it is given."""
    filtered = settings.filter
    return filtered.kind == "akf" and filtered.highlight_scale > 0 and filtered.bright_tail is None


def _begin_time(first: NDArray[np.int64], settings: Settings, lookahead: bool) -> int:
    """The first time that can be read, us, as the engine says, by the ``first`` exposure."""
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
    recording: Recording, settings: Settings, late: DelayEstimate | None, estimate: ThresholdEstimate | None
) -> tuple[Settings, DelayEstimate | None]:
    """Fill in the events' delay: from the settings, else how late they seem and are, else the usual.

    How late they are is known from an estimate of the thresholds; without, of one that is made with known ones.
    """
    events = settings.events
    if events.delay is not None:
        return settings, None
    if late is None:
        return altered(settings, "events", delay=events.usual_delay), None
    if estimate is not None:
        late = late._replace(true=estimate.delay)
    else:
        late = with_true_delay(
            recording,
            settings.camera,
            late,
            Usual.of(events),
            of_log_offset=settings.filter.augmentation == "paper",
            refractory_period=events.refractory if _uses_steps(settings) else 0,
        )
    return altered(settings, "events", delay=late.delay), late


def _with_frame_noise(recording: Recording, settings: Settings) -> tuple[Settings, FrameNoise | None]:
    """Fill in the frames' noise, where the filter uses it: from the settings, else an estimate, else the usual."""
    camera = settings.camera
    if camera.frame_noise is not None or not _uses_steps(settings):
        return settings, None
    found = estimate_frame_noise(recording, camera)
    if found is not None and not found.believed:
        found = None
    read, shot = usual_noise(recording, camera) if found is None else (found.read, found.shot)
    shot = shot if camera.shot_noise is None else camera.shot_noise
    return altered(settings, "camera", frame_noise=read, shot_noise=shot), found


def _with_fixed_pattern(recording: Recording, settings: Settings) -> tuple[Settings, FixedPattern | None]:
    """Fill in the frames' fixed pattern, where the variance counts it: from the settings, else an estimate.

    Where the recording cannot tell, because nothing moves, the usual one; 0 of frames that have been processed.
    """
    if settings.camera.fixed_pattern is not None or not _uses_steps(settings):
        return settings, None
    found = estimate_fixed_pattern(recording, settings.camera)
    if found is not None and not found.told:
        return altered(settings, "camera", fixed_pattern=USUAL_PATTERN), None
    return altered(settings, "camera", fixed_pattern=0.0 if found is None else found.deviation), found


def _with_dead_time(recording: Recording, settings: Settings) -> tuple[Settings, int]:
    """Fill in the refractory period where noise shows it; and what that is, us, 0 where it does not."""
    if settings.events.refractory_period is not None or not _uses_steps(settings):
        return settings, 0
    period = dead_time(recording)
    return altered(settings, "events", refractory_period=period or None), period


class _EventSteps(NamedTuple):
    """Settings in which what an event's step is, and when, is filled in; and what was found on the way."""

    settings: Settings
    origin: ThresholdOrigin
    estimate: ThresholdEstimate | None
    delay: DelayEstimate | None
    model: EventModel | None


def _with_event_steps(recording: Recording, settings: Settings) -> _EventSteps:
    """Fill in what an event's step is: thresholds, refractory period and delay, then I_0 and the step's variance.

    Thresholds depend on I_0 a little, and it on them: they are estimated once more with the I_0 that is found.
    """
    late = estimate_delay(recording, settings.camera) if settings.events.delay is None else None
    filled, origin, estimate = _with_thresholds(recording, settings, late)
    filled, late = _with_delay(recording, filled, late, estimate)
    filled, model = _with_event_model(recording, filled)
    if estimate is not None and settings.camera.log_offset is None:
        estimated = origin in _NOT_STATED
        if estimated or (estimate.may_lose and settings.camera.offset != filled.camera.offset):
            events = filled.events
            unfilled = dataclasses.replace(
                settings.events, delay=events.delay, step_variance=events.step_variance
            )
            filled, origin, estimate = _with_thresholds(
                recording, dataclasses.replace(filled, events=unfilled), late, estimate if estimated else None
            )
    return _EventSteps(filled, origin, estimate, late, model)


def _with_thresholds(
    recording: Recording,
    settings: Settings,
    late: DelayEstimate | None,
    rough: ThresholdEstimate | None = None,
) -> tuple[Settings, ThresholdOrigin, ThresholdEstimate | None]:
    """Fill in thresholds and refractory period: from the settings, else the recording, else an estimate, else usual.

    How ``late`` events seem tells where to look; without, that is where the settings say.
    An estimate without I_0 is rough; with I_0 it is made again, from that.
    """
    events = settings.events
    origin: ThresholdOrigin = "settings" if events.has_thresholds else "recording"
    known = events.with_thresholds(*(recording.contrast_threshold or (None, None)))
    finds_period = _uses_steps(settings) and events.refractory_period is None
    if known.has_thresholds and not finds_period:
        return dataclasses.replace(settings, events=known), origin, None
    usual = Usual.of(known)
    of_log_offset = settings.filter.augmentation == "paper"
    period = events.refractory_period if _uses_steps(settings) else 0
    estimate: ThresholdEstimate | None
    if rough is None:
        estimate = estimate_thresholds(
            recording,
            settings.camera,
            usual,
            of_log_offset=of_log_offset,
            delay=events.lateness if late is None else late.apparent,
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


def _with_event_model(recording: Recording, settings: Settings) -> tuple[Settings, EventModel | None]:
    """Fill in I_0 and the variance of steps: from the settings, else an estimate, else the usual."""
    camera, events = settings.camera, settings.events
    if camera.log_offset is not None and (events.step_variance is not None or not _uses_steps(settings)):
        return settings, None
    weighed = events if _uses_steps(settings) else dataclasses.replace(events, refractory_period=None)
    model = estimate_event_model(recording, camera, weighed)
    if model is not None:
        if camera.log_offset is None:
            camera = dataclasses.replace(camera, log_offset=model.log_offset)
        if events.step_variance is None:
            events = dataclasses.replace(events, step_variance=model.step_variance)
    # What could not be estimated is written down as it will be used.
    camera = dataclasses.replace(camera, log_offset=camera.offset)
    events = dataclasses.replace(events, step_variance=events.step_noise)
    return dataclasses.replace(settings, camera=camera, events=events), model


def _with_mismatch(
    recording: Recording, settings: Settings, unsure: float
) -> tuple[Settings, Mismatch | None]:
    """Fill in the thresholds' spread between pixels: from the settings, else an estimate, else the usual.

    Where the thresholds themselves are estimated, with the relative error ``unsure``, that is a part of it.
    """
    events = settings.events
    if events.threshold_spread is not None or not _uses_steps(settings):
        return settings, None
    found = estimate_mismatch(recording, settings.camera, events)
    spread = float(np.hypot(events.mismatch if found is None else found.spread, unsure))
    return altered(settings, "events", threshold_spread=spread), found


def _with_background(
    recording: Recording, settings: Settings, pixels: PixelCalibration | None
) -> tuple[Settings, float | None]:
    """Fill in the background noise: from the settings, else the usual, or what is measured where that is more."""
    events = settings.events
    if events.noise_rate is not None or not _uses_steps(settings):
        return settings, None
    found = event_noise(recording, _NOISE_EVENTS, None if pixels is None else pixels.hot)
    rate = events.background_rate if found is None else max(found.rate, events.usual_noise_rate)
    return altered(settings, "events", noise_rate=rate), None if found is None else found.rate


def _uses_steps(settings: Settings) -> bool:
    return settings.filter.kind == "akf" and settings.filter.augmentation == "bridge"
