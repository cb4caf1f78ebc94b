"""Plan a reconstruction: mend the recording, measure what settings leave open, choose the times of images."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.clock_rate import find_clock_rate
from kalux.calibration.delay import DelayEstimate
from kalux.calibration.fixed_pattern import FixedPattern
from kalux.calibration.frame_noise import FrameNoise
from kalux.calibration.frame_times import find_frame_times
from kalux.calibration.lag import Lag
from kalux.calibration.mismatch import Mismatch
from kalux.calibration.moving_noise import MovingNoise
from kalux.calibration.values import Calibration, require_white
from kalux.calibration.white_balance import grey_world
from kalux.errors import InputError, require_type
from kalux.frames import median_exposure
from kalux.models.camera import BrightTail
from kalux.models.colour import white_balance
from kalux.models.pixels import CALIBRATION_NEEDED, PixelCalibration, require_size, with_hot
from kalux.planning.event_steps import (
    UNCERTAIN_ORIGINS,
    StepEstimates,
    ThresholdOrigin,
    with_event_steps,
)
from kalux.planning.highlights import UnshownScale, with_unshown_scale
from kalux.planning.mending import Mends, Moved, mend_events_and_levels
from kalux.planning.sensor_noise import (
    with_background,
    with_dark_shares,
    with_dead_time,
    with_fixed_pattern,
    with_frame_noise,
    with_moving_noise,
    with_slow_pixels,
    with_step_errors,
)
from kalux.planning.survey import survey
from kalux.recording import (
    RECORDING_NEEDED,
    Recording,
    with_cached_start,
    with_rows_at_once,
    with_shifted_frames,
)
from kalux.schedule import begin_time, image_times
from kalux.settings import SETTINGS_NEEDED, Settings, altered, chosen_response, completed
from kalux.settings import preset as named_preset

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
        With thresholds, refractory period, delay, frame noise, fixed pattern, shares of dark light, I_0, variances of
        steps, of those in the dark and of lag, black level, saturation, reference exposure and white balance filled in.
    threshold_origin
        Whether the thresholds come from the settings, the recording, a calibration, an estimate, or are assumed.
    times
        (N,) int64 us, none before the one before it: the images to make.
    lookahead
        Whether images use the frame after them.
    smooth
        Whether images use all of the recording after them.
    pixels
        What a calibration says of single pixels, and which ones are hot.
    mends
        What of the recording is put right.
    steps
        By what the size and the time of an event's step were estimated.
    frame_noise
        The fit of the frames' noise, of what stands still or of what moves, where there was one.
    fixed_pattern
        The fit of the frames' fixed pattern, where there was one.
    mismatch
        The fit of the thresholds' spread between pixels, where there was one.
    lag
        How far slow pixels are off the light at a moment, where pixels with events told it.
    background_rate
        The measured noise of events, Hz per pixel, where it was.
    dead_time
        The refractory period that noise shows, us; 0 where it does not.
    unshown_scale
        How far the scene goes beyond white, where the beginning of the recording tells.
    """

    settings: Settings
    threshold_origin: ThresholdOrigin
    times: NDArray[np.int64]
    lookahead: bool
    smooth: bool
    pixels: PixelCalibration | None
    mends: Mends
    steps: StepEstimates
    frame_noise: FrameNoise | MovingNoise | None
    fixed_pattern: FixedPattern | None
    mismatch: Mismatch | None
    lag: Lag | None
    background_rate: float | None
    dead_time: int
    unshown_scale: UnshownScale | None


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
    _check_types(recording, settings, calibration)
    known = Calibration() if calibration is None else calibration
    chosen = settings if settings is not None else known.apply(named_preset(preset))
    if sum(choice is not None for choice in (rate_hz, times, at)) != 1:
        raise InputError("reconstruct: give exactly one of rate_hz, times and at")
    if smooth:
        _check_smooth(chosen, lookahead)
    if known.pixels is not None:
        require_size(known.pixels, recording.sensor_size)
    require_white(known, recording)
    asked = _Asked(rate_hz, times, at, lookahead, smooth)
    row_time = chosen.camera.row_time if chosen.filter.joins_frames else 0.0
    if not row_time:
        return _planned(recording, chosen, known, asked)
    # Beside events in the time of its rows a frame is one whose rows are exposed at once: so all is estimated.
    at_once = altered(chosen, "camera", row_time=0.0)
    planned = _planned(with_rows_at_once(recording, row_time), at_once, known, asked)
    return dataclasses.replace(planned, settings=altered(planned.settings, "camera", row_time=row_time))


class _Asked(NamedTuple):
    """What is asked for, as of `plan`."""

    rate_hz: float | None
    times: Any
    at: Literal["frames"] | None
    lookahead: bool
    smooth: bool


def _planned(
    recording: Recording,
    chosen: Settings,
    known: Calibration,
    asked: _Asked,
    moved: Moved | None = None,
) -> Plan:
    """The plan for frames whose rows are exposed at once, and whose times have been ``moved``, if they were off.

    None: nothing is known of that yet.
    """
    rate_hz, times, at, lookahead, smooth = asked
    as_stored, as_chosen = recording, chosen
    recording = with_shifted_frames(recording, None if moved is None else moved.shifts)
    chosen = _with_causal_trust(chosen, lookahead)
    recording = with_cached_start(recording, _CACHED_EVENTS, _CACHED_FRAME_BYTES)

    mended = mend_events_and_levels(recording, chosen)
    seen = survey(mended.recording, mended.settings, with_tail=_measures_tail(chosen))
    first = 0 if seen.faults is None else seen.faults.first
    begin, earliest = (begin_time(seen.exposures[index], chosen.filter, lookahead) for index in (first, 0))
    wanted = image_times(
        recording,  # with the events of hot pixels, which a recording may end with
        seen.exposures,
        begin if times is None else earliest,
        rate_hz=rate_hz,
        times=times,
        at=at,
    )
    mended = mended.with_frames(seen.faults, with_first=bool(len(wanted)) and int(wanted[0]) < begin)

    left_out = mended.mends.corrections.left_out
    if moved is None and _looks_for_times(chosen):
        kept = np.delete(seen.exposures, left_out, axis=0)
        clock = find_clock_rate(mended.recording, mended.settings.camera, kept)
        if clock is not None:
            return _planned(as_stored, as_chosen, known, asked, Moved(clock.of_all(seen.exposures)))
    moved = Moved() if moved is None else moved

    recording, chosen = mended.recording, _with_motion(mended.settings, recording.sensor_size, smooth)
    chosen = _with_exposure_and_response(recording, chosen, seen.exposures)
    chosen = _with_white_balance(recording, chosen)
    of_frames = with_frame_noise(recording, chosen, mended.mends.compression)
    chosen, pattern = with_fixed_pattern(recording, of_frames.settings, mended.mends.compression)
    of_frames = with_moving_noise(recording, of_frames, chosen, mended.mends.compression)
    chosen = of_frames.settings
    chosen, dead_time = with_dead_time(recording, chosen)
    apparent_delay = _delay_of_black(mended.mends, chosen, seen.exposures)
    steps = with_event_steps(recording, chosen, apparent_delay, doubt_noise=of_frames.doubted)
    if moved.times is None and _looks_for_times(chosen):
        times_found = find_frame_times(recording, steps.settings.camera, steps.settings.events)
        if times_found is not None:
            moved = moved._replace(times=times_found.of_all(seen.exposures, left_out))
            return _planned(as_stored, as_chosen, known, asked, moved)
    given = chosen.events
    chosen, background = with_background(recording, steps.settings, known.pixels, lookahead=lookahead)
    noise_rate = (given.noise_rate or 0.0) if background is None else background
    chosen, mismatch = with_step_errors(
        recording, chosen, steps.threshold_error, known=given, noise_rate=noise_rate
    )
    chosen = with_dark_shares(recording, chosen)
    chosen, lag = with_slow_pixels(recording, chosen, noise_rate=noise_rate, lookahead=lookahead)
    pixels = known.pixels_of(chosen.events.mismatch)
    origin = steps.origin
    if origin == "settings" and _are_calibrated(chosen, known):
        origin = "calibration"
    hot = mended.mends.hot
    pixels = pixels if hot is None else with_hot(pixels, hot, chosen.events.mismatch)
    chosen, unshown = with_unshown_scale(
        recording,
        _with_bright_tail(chosen, seen.tail, origin),
        pixels,
        threshold_is_estimate=origin in UNCERTAIN_ORIGINS,
        lookahead=lookahead,
    )
    return Plan(
        settings=chosen,
        threshold_origin=origin,
        times=wanted,
        lookahead=lookahead,
        smooth=smooth,
        pixels=pixels,
        mends=mended.mends._replace(moved=moved),
        steps=steps.estimates,
        frame_noise=of_frames.estimate,
        fixed_pattern=pattern,
        mismatch=mismatch,
        lag=lag,
        background_rate=background,
        dead_time=dead_time,
        unshown_scale=unshown,
    )


# What is asked for.


def _check_types(recording: Recording, settings: Settings | None, calibration: Calibration | None) -> None:
    require_type("reconstruct: recording", recording, Recording, RECORDING_NEEDED)
    if settings is not None:
        require_type("reconstruct: settings", settings, Settings, SETTINGS_NEEDED)
    if calibration is not None:
        require_type("reconstruct: calibration", calibration, Calibration, CALIBRATION_NEEDED)


def _check_smooth(settings: Settings, lookahead: bool) -> None:
    if not lookahead:
        raise InputError(
            "reconstruct: smooth uses the future, lookahead=False (causal) forbids it; choose one"
        )
    if settings.filter.kind == "cf":
        raise InputError(
            "reconstruct: the complementary filter has no variance, so that it cannot be smoothed"
        )


def _looks_for_times(settings: Settings) -> bool:
    """Whether times of frames that are off are to be corrected."""
    return settings.camera.mend_times and settings.filter.joins_frames


def _are_calibrated(settings: Settings, calibration: Calibration) -> bool:
    """Whether the thresholds are those of the calibration."""
    found = calibration.settings.get("events", {})
    names = ("threshold_on", "threshold_off")
    return all(name in found and found[name] == getattr(settings.events, name) for name in names)


# What is filled in from the sensor, the frames' exposures and their colours.


def _with_motion(settings: Settings, sensor_size: tuple[int, int], smooth: bool) -> Settings:
    """Fill in whether what moves is followed, where the settings leave it to the sensor's size."""
    if settings.filter.motion != "auto":
        return settings
    follows = smooth or settings.filter.follows_motion(sensor_size)
    return altered(settings, "filter", motion="on" if follows else "off")


def _with_causal_trust(settings: Settings, lookahead: bool) -> Settings:
    """Without lookahead far highlights (K6) are believed only if asked for.

    What is wrong of single pixels, P does not know before the next frame: one of eight scenes of a DAVIS240C had nine
    times the error.
    """
    return settings if lookahead else completed(settings, "events", extrapolation_trust=0.0)


def _with_exposure_and_response(
    recording: Recording, settings: Settings, exposures: NDArray[np.int64]
) -> Settings:
    """Fill in the exposure at which a saturated pixel is 1, and the camera's response."""
    camera = settings.camera
    return altered(
        settings,
        "camera",
        reference_exposure=camera.reference_exposure or median_exposure(exposures[:, 1] - exposures[:, 0]),
        response=chosen_response(camera.response, recording.response),
    )


def _with_white_balance(recording: Recording, settings: Settings) -> Settings:
    """Measure the gains of a white balance that has none, where frames are in colour."""
    first = next(iter(recording.frames()))
    if first.colours == "grey" or white_balance(settings.camera.white_balance) is not None:
        return settings
    gains = ";".join(f"{gain:.4f}" for gain in grey_world(recording, settings.camera))
    return altered(settings, "camera", white_balance=gains)


def _delay_of_black(mends: Mends, settings: Settings, exposures: NDArray[np.int64]) -> DelayEstimate | None:
    """The apparent delay that was estimated while black was looked for and not found, if it is of these very frames."""
    black, (start, end) = mends.black, exposures[0]
    if black is None or black.level or mends.ceiling is not None or mends.corrections:
        return None
    return black.delay if end - start == settings.camera.reference_exposure else None


def _measures_tail(settings: Settings) -> bool:
    """Whether the prior on highlights may need the frames' bright tail, which is not given."""
    filtered = settings.filter
    return filtered.kind == "akf" and filtered.highlight_scale > 0 and filtered.bright_tail is None


def _with_bright_tail(settings: Settings, tail: BrightTail | None, origin: ThresholdOrigin) -> Settings:
    """Fill in the frames' bright ``tail``, where the prior on highlights goes by it."""
    of_unshown = settings.filter.joins_frames and settings.filter.unshown_tail > 0
    if tail is None or not (of_unshown or origin in UNCERTAIN_ORIGINS):
        return settings
    return altered(settings, "filter", bright_tail=tail.scale)
