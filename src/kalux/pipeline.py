"""Reconstruct a whole recording: choose what is missing, drive the engine over the file, nothing else."""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from kalux.ahead import ahead
from kalux.calibration.contrast import (
    ROUGH_SAMPLES,
    ThresholdEstimate,
    Usual,
    estimate_thresholds,
    refine_thresholds,
)
from kalux.calibration.delay import DelayEstimate, estimate_delay
from kalux.calibration.event_model import EventModel, estimate_event_model
from kalux.calibration.frame_noise import FrameNoise, estimate_frame_noise
from kalux.calibration.mismatch import Mismatch, estimate_mismatch
from kalux.calibration.noise import event_noise
from kalux.calibration.steps import MAX_SAMPLES
from kalux.calibration.values import Calibration
from kalux.calibration.white_balance import grey_world
from kalux.errors import InputError
from kalux.events import EventArray
from kalux.frames import Frame
from kalux.images import Estimate, Image
from kalux.models.camera import BrightTail, Camera, count_bright
from kalux.models.colour import white_balance
from kalux.models.pixels import PixelCalibration, require_size
from kalux.reconstructor import Reconstructor
from kalux.recording import Recording, no_frames, remembering
from kalux.settings import EventSettings, Settings, chosen_response
from kalux.settings import preset as named_preset
from kalux.smoothing import Backward, combine, reversed_settings

ThresholdOrigin = Literal["settings", "recording", "calibration", "estimate", "assumed"]

_DOUBTED: Final[tuple[ThresholdOrigin, ...]] = ("calibration", "estimate", "assumed")
"""Thresholds of these origins are not quite the pixels' own: highlights are then believed less."""


_NOISE_EVENTS: Final = 1_000_000
"""Of which the background noise is taken: at 15 million events/s the quiet time of 300,000 pixels in 70 ms."""


_REMEMBERED_EVENTS: Final = 1 << 22
_REMEMBERED_FRAMES: Final = 1 << 25
"""Events (64 MB) and bytes of frames at the beginning that are read once for all estimates, which take most of their
samples from there."""

_IMAGES_AHEAD: Final = 4
"""Images that are held while those before are written: a frame takes the filter as long as ten images, and meanwhile
none come. With 2, which is 2.5 MB less at 640x480, two cores would take 2 % longer; more than 8 gain nothing."""


@dataclass(frozen=True)
class Plan:
    """Everything that a reconstruction will use, decided before it starts.

    Attributes
    ----------
    settings
        With thresholds, refractory period, delay, frame noise, I_0, step variance, reference exposure and white balance
        filled in.
    threshold_origin
        Whether the thresholds come from the settings, the recording, a calibration, an estimate, or are assumed.
    estimate
        The fit of the thresholds and the refractory period, where there was one.
    delay_estimate
        The fit of the events' delay, where there was one.
    event_model
        The fit of I_0 and the variance of an event's step, where there was one.
    times
        (N,) int64 us, increasing: the images to make.
    lookahead
        Whether images use the frame after them.
    smooth
        Whether images use all of the recording after them.
    pixels
        What a calibration says of single pixels.
    frame_noise
        The fit of the frames' noise, where there was one.
    mismatch
        The fit of the thresholds' spread between pixels, where there was one.
    background_rate
        The measured noise of events, Hz per pixel, where it was.
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
    mismatch: Mismatch | None = None
    background_rate: float | None = None


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
    """Decide what a reconstruction will do. See `reconstruct` for the parameters and errors."""
    for name, given, kind, source in (
        ("recording", recording, Recording, "kalux.open or Recording.from_arrays"),
        ("settings", settings, Settings, "kalux.preset"),
        ("calibration", calibration, Calibration, "kalux.load_calibration"),
    ):
        if not isinstance(given, kind) and (given is not None or name == "recording"):
            raise InputError(
                f"reconstruct: {name} is a {type(given).__name__}; a kalux.{kind.__name__} is needed, from {source}"
            )
    known = Calibration() if calibration is None else calibration
    chosen = settings if settings is not None else known.apply(named_preset(preset))
    if sum(choice is not None for choice in (rate_hz, times, at)) != 1:
        raise InputError("reconstruct: give exactly one of rate_hz, times and at")
    if smooth and not lookahead:
        raise InputError(
            "reconstruct: smooth uses the future, lookahead=False (causal) forbids it; choose one"
        )
    if smooth and chosen.filter.kind == "cf":
        raise InputError(
            "reconstruct: the complementary filter has no variance, so that it cannot be smoothed"
        )
    if known.pixels is not None:
        require_size(known.pixels, recording.sensor_size)
    recording = remembering(recording, _REMEMBERED_EVENTS, _REMEMBERED_FRAMES)
    response = chosen_response(chosen.camera.response, recording.response)
    camera = Camera.named(response, chosen.camera.saturation)
    exposures, tail = _survey(recording, camera)
    wanted = _times(recording, exposures, rate_hz, times, at, chosen, lookahead)
    reference = chosen.camera.reference_exposure or round(float(np.median(exposures[:, 1] - exposures[:, 0])))
    chosen = dataclasses.replace(
        chosen, camera=dataclasses.replace(chosen.camera, reference_exposure=reference, response=response)
    )
    chosen = _with_white_balance(recording, chosen)
    chosen, noise = _with_frame_noise(recording, chosen)
    chosen, delay = _with_delay(recording, chosen)
    filled, origin, estimate = _with_thresholds(recording, chosen)
    filled, model = _with_event_model(recording, filled)
    if estimate is not None and chosen.camera.log_offset is None:
        estimated = origin in ("estimate", "assumed")
        if estimated or (estimate.may_lose and chosen.camera.offset != filled.camera.offset):
            unfilled = dataclasses.replace(chosen.events, step_variance=filled.events.step_variance)
            rough = estimate if estimated else None
            filled = dataclasses.replace(filled, events=unfilled)
            filled, origin, estimate = _with_thresholds(recording, filled, rough)
    unsure = estimate.spread if estimate is not None and origin in ("estimate", "assumed") else 0.0
    filled, mismatch = _with_mismatch(recording, filled, unsure)
    filled, background = _with_background(recording, filled, known.pixels)
    if origin == "settings" and _are_calibrated(filled, known):
        origin = "calibration"
    doubted = origin in _DOUBTED or (_uses_steps(filled) and filled.filter.unshown_tail > 0)
    if doubted and filled.filter.bright_tail is None:
        filled = dataclasses.replace(
            filled, filter=dataclasses.replace(filled.filter, bright_tail=tail.scale)
        )
    return Plan(
        filled,
        origin,
        estimate,
        delay,
        model,
        wanted,
        lookahead,
        smooth,
        known.pixels,
        noise,
        mismatch,
        background,
    )


def reconstruct(
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
) -> Iterator[Image]:
    """Images of a recording, in time order; memory is bounded whatever the recording's length.

    Parameters
    ----------
    recording
        From `kalux.open` or `Recording.from_arrays`.
    rate_hz
        Images per second, from the start of the first exposure to the end of the last.
    times
        (N,) increasing times, us.
    at
        ``"frames"``: one image at the middle of each exposure.
    preset, settings
        Name of a preset, or whole `Settings`, which win.
    calibration
        From `kalux.load_calibration`: what was measured replaces the preset's settings (not those of ``settings``), and
        what is known of single pixels is used.
    lookahead
        Whether an image uses the frame after it too; False is what a robot would see.
    smooth
        Whether an image uses everything after it: the filter runs backward too (`kalux.smoothing`). Takes
        three times as long, and room for the events and some states in the folder for temporary files.

    Raises
    ------
    InputError
        If not exactly one of rate_hz, times and at is given, or times lie outside the recording.
    FrameError
        If the recording has no frames.
    EventError, ExposureError
        If the recording is damaged; images before the damage have been returned.
    """
    return execute(
        recording,
        plan(
            recording,
            rate_hz=rate_hz,
            times=times,
            at=at,
            preset=preset,
            settings=settings,
            calibration=calibration,
            lookahead=lookahead,
            smooth=smooth,
        ),
    )


def execute(
    recording: Recording,
    plan: Plan,
    on_events: Callable[[int], None] | None = None,
    on_backward: Callable[[int], None] | None = None,
    *,
    threads: int = 1,
    with_variance: bool = True,
) -> Generator[Image, None, None]:
    """Carry out a plan. The callbacks are told the number of events of every chunk read, for progress:

    ``on_backward`` in the backward pass of a smoothed reconstruction, ``on_events`` in the pass that makes the images.
    With more than one of ``threads``, reading, filtering, and making images of what the filter says have a thread each,
    while the caller uses the images before; the callbacks are then called in the second. The images are the same.
    Not ``with_variance`` is faster; grey images then have an infinite one.
    """
    engine = _engine(recording, plan, plan.settings)
    several = threads > 1
    estimates = _smoothed_estimates(recording, engine, plan, on_events, on_backward, several)
    images = _images(engine, ahead(estimates, name="filter") if several else estimates, with_variance)
    yield from ahead(images, _IMAGES_AHEAD, "images") if several else images


def _images(
    engine: Reconstructor, estimates: Generator[Estimate, None, None], with_variance: bool
) -> Generator[Image, None, None]:
    with contextlib.closing(estimates):
        for estimate in estimates:
            yield engine.image(estimate, with_variance=with_variance)


def _smoothed_estimates(
    recording: Recording,
    engine: Reconstructor,
    plan: Plan,
    on_events: Callable[[int], None] | None,
    on_backward: Callable[[int], None] | None,
    read_ahead: bool,
) -> Generator[Estimate, None, None]:
    if not plan.smooth:
        yield from _estimates(recording, engine, plan, on_events, read_ahead)
        return
    with tempfile.TemporaryDirectory(prefix="kalux-") as folder:
        trail = _trail(plan)
        backward = Backward(
            recording,
            _engine(recording, plan, reversed_settings(plan.settings)),
            plan.times,
            Path(folder),
            on_backward,
            trail=trail,
        )
        on, off = engine.thresholds
        for estimate in _estimates(recording, engine, plan, on_events, read_ahead):
            ahead_of_events = None if trail is None else engine.trail(estimate.t)
            yield combine(estimate, backward.estimate(estimate.t), ahead_of_events, on * off)


def _trail(plan: Plan) -> tuple[Settings, NDArray[np.bool_] | None] | None:
    """What the backward filter must know of K14, where the forward one follows it."""
    if plan.settings.filter.augmentation != "bridge" or plan.settings.events.trail == 0:
        return None
    hot = None if plan.pixels is None or not plan.pixels.hot.any() else plan.pixels.hot
    return plan.settings, hot


def _engine(recording: Recording, plan: Plan, settings: Settings) -> Reconstructor:
    return Reconstructor(
        recording.sensor_size,
        settings=settings,
        lookahead=plan.lookahead,
        threshold_is_estimate=plan.threshold_origin in _DOUBTED,
        inverse_covariance=recording.source.inverse_covariance,
        pixels=plan.pixels,
    )


def _estimates(
    recording: Recording,
    engine: Reconstructor,
    plan: Plan,
    on_events: Callable[[int], None] | None,
    read_ahead: bool,
) -> Iterator[Estimate]:
    """Drive the engine over the recording, reading each time of the plan as soon as it is final."""
    if not read_ahead:
        yield from _driven(recording, iter(recording.events()), engine, plan, on_events)
        return
    with contextlib.closing(ahead(recording.events(), 1, "read")) as chunks:
        yield from _driven(recording, chunks, engine, plan, on_events)


def _driven(
    recording: Recording,
    chunks: Iterator[EventArray],
    engine: Reconstructor,
    plan: Plan,
    on_events: Callable[[int], None] | None,
) -> Iterator[Estimate]:
    pending = iter(plan.times.tolist())
    t = next(pending, None)
    ended = False
    for frame in recording.frames():
        engine.push_frame(frame)
        while not ended and not engine.covers(frame.exposure_end):
            ended = not _push_next(engine, chunks, on_events)
        if ended:
            engine.advance(frame.exposure_end + (plan.settings.events.delay or 0))
        while t is not None and _is_final(engine, t):
            yield engine.estimate(t)
            t = next(pending, None)
        if t is None:
            return
        engine.forget(t)
    engine.end_frames()
    while not ended and t is not None:
        ended = not _push_next(engine, chunks, on_events)
        while t is not None and _is_final(engine, t):
            yield engine.estimate(t)
            t = next(pending, None)
        if t is not None:
            engine.forget(t)
    engine.finish()
    while t is not None:
        yield engine.estimate(t)
        t = next(pending, None)


def _is_final(engine: Reconstructor, t: int) -> bool:
    return engine.final_until is not None and t <= engine.final_until


def _push_next(
    engine: Reconstructor, chunks: Iterator[EventArray], on_events: Callable[[int], None] | None
) -> bool:
    chunk = next(chunks, None)
    if chunk is None:
        return False
    engine.push_events(chunk)
    if on_events is not None:
        on_events(len(chunk))
    return True


def _survey(recording: Recording, camera: Camera) -> tuple[NDArray[np.int64], BrightTail]:
    """(K, 2) exposure starts and ends, us, and how the brightness of pixels falls off towards white; of all frames."""
    exposures, tail = [], BrightTail()
    for frame in recording.frames():
        exposures.append((frame.exposure_start, frame.exposure_end))
        tail = tail.joined(count_bright(camera, frame.image, frame.white_value))
    if not exposures:
        raise no_frames(recording)
    return np.array(exposures, np.int64), tail


def _with_white_balance(recording: Recording, settings: Settings) -> Settings:
    """Measure the gains of a white balance that has none, where frames are in colour."""
    first = next(iter(recording.frames()))
    if first.colours == "grey" or white_balance(settings.camera.white_balance) is not None:
        return settings
    gains = ";".join(f"{gain:.4f}" for gain in grey_world(recording, settings.camera))
    return dataclasses.replace(settings, camera=dataclasses.replace(settings.camera, white_balance=gains))


def _are_calibrated(settings: Settings, calibration: Calibration) -> bool:
    """Whether the thresholds are those of the calibration."""
    found = calibration.settings.get("events", {})
    names = ("threshold_on", "threshold_off")
    return all(name in found and found[name] == getattr(settings.events, name) for name in names)


def _with_delay(recording: Recording, settings: Settings) -> tuple[Settings, DelayEstimate | None]:
    """Fill in the events' delay: from the settings, else an estimate, else the usual."""
    if settings.events.delay is not None:
        return settings, None
    estimate = estimate_delay(recording, settings.camera)
    delay = settings.events.usual_delay if estimate is None else estimate.delay
    return dataclasses.replace(settings, events=dataclasses.replace(settings.events, delay=delay)), estimate


def _with_frame_noise(recording: Recording, settings: Settings) -> tuple[Settings, FrameNoise | None]:
    """Fill in the frames' noise, where the filter uses it: from the settings, else an estimate, else the usual."""
    camera = settings.camera
    if camera.frame_noise is not None or not _uses_steps(settings):
        return settings, None
    found = estimate_frame_noise(recording, camera)
    if found is not None and not found.believed:
        found = None
    read, shot = camera.noise if found is None else (found.read, found.shot)
    shot = shot if camera.shot_noise is None else camera.shot_noise
    camera = dataclasses.replace(camera, frame_noise=read, shot_noise=shot)
    return dataclasses.replace(settings, camera=camera), found


def _with_thresholds(
    recording: Recording,
    settings: Settings,
    rough: ThresholdEstimate | None = None,
) -> tuple[Settings, ThresholdOrigin, ThresholdEstimate | None]:
    """Fill in thresholds and refractory period: from the settings, else the recording, else an estimate, else usual.

    An estimate without I_0 is rough; with I_0 it is made again, from that.
    """
    events = settings.events
    stated = (recording.contrast_threshold or (None, None)) if not _has_thresholds(events) else (None, None)
    origin: ThresholdOrigin = "settings" if _has_thresholds(events) else "recording"
    known = dataclasses.replace(
        events,
        threshold_on=stated[0] if events.threshold_on is None else events.threshold_on,
        threshold_off=stated[1] if events.threshold_off is None else events.threshold_off,
    )
    finds_period = _uses_steps(settings) and events.refractory_period is None
    if _has_thresholds(known) and not finds_period:
        return dataclasses.replace(settings, events=known), origin, None
    usual = Usual(events.usual_threshold_on, events.usual_threshold_off, events.usual_spread)
    if known.threshold_on is not None and known.threshold_off is not None:
        usual = Usual(known.threshold_on, known.threshold_off, 0.0)
    of_log_offset = settings.filter.augmentation == "paper"
    period = events.refractory_period if _uses_steps(settings) else 0
    estimate = (
        estimate_thresholds(
            recording,
            settings.camera,
            usual,
            of_log_offset=of_log_offset,
            delay=events.delay or 0,
            refractory_period=period,
            most=ROUGH_SAMPLES if settings.camera.log_offset is None else MAX_SAMPLES,
        )
        if rough is None
        else refine_thresholds(
            recording,
            settings.camera,
            usual,
            rough,
            of_log_offset=of_log_offset,
            refractory_period=period,
        )
    )
    if finds_period:
        period = 0 if estimate is None else estimate.refractory_period
        known = dataclasses.replace(known, refractory_period=period)
    if not _has_thresholds(known):
        origin = "assumed" if estimate is None or estimate.usual_share > 0.5 else "estimate"
        known = known.assuming() if estimate is None else _estimated(known, estimate)
    return dataclasses.replace(settings, events=known), origin, estimate


def _has_thresholds(events: EventSettings) -> bool:
    return events.threshold_on is not None and events.threshold_off is not None


def _estimated(events: EventSettings, estimate: ThresholdEstimate) -> EventSettings:
    """With the estimated thresholds where none is set."""
    return dataclasses.replace(
        events,
        threshold_on=estimate.on if events.threshold_on is None else events.threshold_on,
        threshold_off=estimate.off if events.threshold_off is None else events.threshold_off,
    )


def _with_event_model(recording: Recording, settings: Settings) -> tuple[Settings, EventModel | None]:
    """Fill in I_0 and the variance of steps: from the settings, else an estimate, else the usual."""
    camera, events = settings.camera, settings.events
    if camera.log_offset is not None and (events.step_variance is not None or not _uses_steps(settings)):
        return settings, None
    assert events.threshold_on is not None
    assert events.threshold_off is not None
    model = estimate_event_model(
        recording,
        camera,
        (events.threshold_on, events.threshold_off),
        delay=events.delay or 0,
        threshold_spread=events.mismatch,
        quantisation_variance=events.quantisation_variance,
        refractory_period=events.refractory if _uses_steps(settings) else 0,
    )
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
    return dataclasses.replace(settings, events=dataclasses.replace(events, threshold_spread=spread)), found


def _with_background(
    recording: Recording, settings: Settings, pixels: PixelCalibration | None
) -> tuple[Settings, float | None]:
    """Fill in the background noise: from the settings, else the usual, or what is measured where that is more."""
    events = settings.events
    if events.noise_rate is not None or not _uses_steps(settings):
        return settings, None
    found = event_noise(recording, _NOISE_EVENTS, None if pixels is None else pixels.hot)
    rate = events.background_rate if found is None else max(found.rate, events.usual_noise_rate)
    settings = dataclasses.replace(settings, events=dataclasses.replace(events, noise_rate=rate))
    return settings, None if found is None else found.rate


def _uses_steps(settings: Settings) -> bool:
    return settings.filter.kind == "akf" and settings.filter.augmentation == "bridge"


def _times(
    recording: Recording,
    exposures: NDArray[np.int64],
    rate_hz: float | None,
    times: Any,
    at: str | None,
    settings: Settings,
    lookahead: bool,
) -> NDArray[np.int64]:
    """The times to read, checked against the recording."""
    first = Frame(np.empty((0, 0)), int(exposures[0, 0]), int(exposures[0, 1]))
    begin = _begin_time(first, settings, lookahead)
    end = int(exposures[-1, 1])
    if at is not None:
        if at != "frames":
            raise InputError(f"reconstruct: at is {at!r}; only 'frames' is known")
        middles: NDArray[np.int64] = exposures.sum(axis=1) // 2
        return middles[middles >= begin]
    if rate_hz is not None:
        if not (np.isfinite(rate_hz) and 0 < rate_hz <= 1e6):
            raise InputError(
                f"reconstruct: the image rate is {rate_hz} Hz; more than 0 and at most 1e6 is possible"
            )
        count = int(np.floor((end - begin) * 1e-6 * rate_hz + 1e-9)) + 1
        grid: NDArray[np.int64] = np.rint(np.arange(count) * (1e6 / rate_hz)).astype(np.int64)
        return begin + grid
    wanted = _whole_microseconds(times)
    backward = np.flatnonzero(np.diff(wanted) < 0)
    if len(backward):
        index = int(backward[0]) + 1
        raise InputError(
            f"reconstruct: times[{index}] is {wanted[index]} us, before {wanted[index - 1]} us, the one before it; "
            "times must increase"
        )
    if wanted[0] < begin:
        raise InputError(
            f"reconstruct: {wanted[0]} us lies before {begin} us, the earliest time the recording's frames allow"
        )
    if wanted[-1] > end:
        last = max((int(chunk["t"][-1]) for chunk in recording.events()), default=end)
        if wanted[-1] > max(last, end):
            raise InputError(
                f"reconstruct: {wanted[-1]} us lies after the recording's end at {max(last, end)} us"
            )
    return wanted


def _whole_microseconds(times: Any) -> NDArray[np.int64]:
    """The times to read as integers. Fractions are refused, not rounded: they may be seconds."""
    given = np.asarray(times)
    if given.ndim != 1 or len(given) == 0 or given.dtype.kind not in "iuf":
        raise InputError("reconstruct: times must be a list of whole microseconds, with at least one entry")
    fractional = np.flatnonzero(~np.isfinite(given) | (given != np.rint(given)))
    if len(fractional):
        index = int(fractional[0])
        raise InputError(
            f"reconstruct: times[{index}] is {given[index]}; whole microseconds are needed, such as np.rint gives"
        )
    return given.astype(np.int64)


def _begin_time(first: Frame, settings: Settings, lookahead: bool) -> int:
    """The first time that can be read, as the engine says."""
    if not lookahead:
        return first.exposure_end
    return first.middle if settings.filter.kind == "cf" else first.exposure_start
