"""What frames and events show without any change of the light, and by how much pixels differ, filled in."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from kalux.calibration.compression import Compression
from kalux.calibration.dark_shares import estimate_dark_shares
from kalux.calibration.dark_steps import DarkSamples
from kalux.calibration.fixed_pattern import FixedPattern, estimate_fixed_pattern, largest_pattern
from kalux.calibration.frame_noise import FrameNoise, UsualNoise, estimate_frame_noise, usual_noise
from kalux.calibration.lag import Lag, LagSums
from kalux.calibration.mismatch import Mismatch, estimate_mismatch
from kalux.calibration.moving_noise import MovingNoise, told_by_motion
from kalux.calibration.noise import event_noise
from kalux.calibration.refractory import counted_period, dead_time
from kalux.calibration.slow_pixels import Observer, observe
from kalux.models.pixels import PixelCalibration
from kalux.recording import Recording
from kalux.settings import (
    AUTO,
    EVEN,
    NO_DARK_STEPS,
    USUAL_PATTERN,
    EventSettings,
    Settings,
    altered,
    completed,
)

_NOISE_EVENTS: Final = 1_000_000
"""Number of events from which the background noise is estimated: at 15 million events/s, those of 70 ms."""

_LEAST_NOISE: Final = 0.5
"""Least background noise with lookahead, Hz per pixel: events are isolated for other reasons, too (leak of bright
pixels, flicker). slider_depth has 0.15 where nothing is seen, street 0.005 (docs/equations.md, K5)."""


class FilledFrameNoise(NamedTuple):
    """Settings with the frames' noise.

    Attributes
    ----------
    settings
        With frame noise and shot noise.
    estimate
        The fit of the noise, where there was one.
    doubted
        Whether the noise is more than pixels without events tell, so that events may contradict.
    was_given
        Whether a part of it is from the settings as they were.
    """

    settings: Settings
    estimate: FrameNoise | MovingNoise | None = None
    doubted: bool = False
    was_given: bool = False


_TYPICAL: Final = 0.65
"""Errors of pixels by JPEG in terms of `Compression.error`, root mean square: 0.5 to 0.8 on 17 scenes, qualities of 97
to 75."""


def with_frame_noise(
    recording: Recording, settings: Settings, compression: Compression | None
) -> FilledFrameNoise:
    """Fill in the frames' noise, where the filter uses it: from the settings, else an estimate, else the usual.

    Estimates are of what stands still, where a ``compression`` is the same in every frame: what it does is added.
    """
    camera = settings.camera
    if camera.frame_noise is not None or not settings.filter.joins_frames:
        return FilledFrameNoise(settings, was_given=True)
    delay = settings.events.lateness
    found = estimate_frame_noise(recording, camera, delay=delay)
    if found is not None and not found.is_reliable:
        found = None
    noise = usual_noise(recording, camera, delay=delay) if found is None else found
    doubted = isinstance(noise, UsualNoise) and noise.is_doubtful and camera.shot_noise is None
    of_blocks = 0.0 if compression is None else _TYPICAL * compression.error
    read = float(np.hypot(noise.read, of_blocks))
    filled = completed(settings, "camera", frame_noise=read, shot_noise=noise.shot)
    return FilledFrameNoise(filled, found, doubted, was_given=camera.shot_noise is not None)


def with_moving_noise(
    recording: Recording, of_frames: FilledFrameNoise, settings: Settings, compression: Compression | None
) -> FilledFrameNoise:
    """``settings``, which have the fixed pattern, too, with the noise that frames show of what moves.

    It counts where nothing stands still that would tell the noise, and where it is far less than what seems to stand
    still says. Not beside a pattern, which counts as noise of what moves, but not of what does not; nor of a
    ``compression``, which leaves less of fine noise than of the rest.
    """
    filled, camera = of_frames._replace(settings=settings), settings.camera
    if of_frames.was_given or compression is not None or camera.fixed_pattern != 0:
        return filled
    moving = told_by_motion(recording, camera, camera.noise, is_seen=of_frames.estimate is not None)
    if moving is None:
        return filled
    settings = altered(settings, "camera", frame_noise=moving.read, shot_noise=moving.shot)
    return FilledFrameNoise(settings, moving)


def with_fixed_pattern(
    recording: Recording, settings: Settings, compression: Compression | None
) -> tuple[Settings, FixedPattern | None]:
    """Fill in the frames' fixed pattern, where the variance counts it: from the settings, else an estimate.

    Where the recording cannot tell, because nothing moves, the usual one, or what smooth parts allow, if that is less
    and no ``compression`` has smoothed them; 0 of frames in colour.
    """
    if settings.camera.fixed_pattern is not None or not settings.filter.joins_frames:
        return settings, None
    found = estimate_fixed_pattern(recording, settings.camera)
    if found is not None and not found.is_measured:
        most = math.inf if compression is not None else largest_pattern(recording, settings.camera)
        return altered(settings, "camera", fixed_pattern=min(USUAL_PATTERN, most)), None
    return altered(settings, "camera", fixed_pattern=0.0 if found is None else found.deviation), found


def with_dead_time(recording: Recording, settings: Settings) -> tuple[Settings, int]:
    """Fill in the refractory period where noise events show a dead time, which is returned, us; 0: they do not."""
    if settings.events.refractory_period is not None or not settings.filter.joins_frames:
        return settings, 0
    period = dead_time(recording)
    return altered(settings, "events", refractory_period=counted_period(period) or None), period


def with_step_errors(
    recording: Recording,
    settings: Settings,
    threshold_error: float,
    *,
    known: EventSettings,
    noise_rate: float,
) -> tuple[Settings, Mismatch | None]:
    """Fill in the thresholds' spread between pixels and the variance of a step, as far as they are not ``known``.

    From an estimate, else what the settings have: the usual spread, and the variance that goes with I_0. The relative
    error of estimated thresholds, 0 of others, is a part of the spread. ``noise_rate``: what is known of it, Hz.
    """
    events = settings.events
    wanted = None in (known.threshold_spread, known.step_variance)
    if not wanted or not settings.filter.joins_frames:
        return settings, None
    # Filled in before: as wide as thresholds are uncertain that nothing tells.
    if events.threshold_spread != known.threshold_spread:
        return settings, None
    found = estimate_mismatch(recording, settings.camera, events, noise_rate)
    spread = events.threshold_spread
    if spread is None:
        spread = float(np.hypot(events.mismatch if found is None else found.spread, threshold_error))
    step_variance = events.step_variance
    if found is not None and known.step_variance is None:
        measured = found.step_variance(spread)
        step_variance = step_variance if measured is None else round(measured, 3)
    return altered(settings, "events", threshold_spread=spread, step_variance=step_variance), found


def with_slow_pixels(
    recording: Recording, settings: Settings, *, noise_rate: float, lookahead: bool
) -> tuple[Settings, Lag | None]:
    """Fill in what slow pixels do: by how much more steps vary in the dark, and the variance of errors of the moment.

    Where frames are joined: from the settings, else an estimate. In causal mode there is none of either: nothing is
    between two frames there. ``noise_rate``: what is known of it, Hz.
    """
    camera, events = settings.camera, settings.events
    if not settings.filter.joins_frames:
        return settings, None
    dark = DarkSamples(camera, events, noise_rate) if events.dark_steps == AUTO else None
    lag = LagSums(recording.sensor_size, camera, events) if events.lag_variance is None else None
    wanted: list[Observer] = [one for one in (dark, lag) if one is not None]
    if lookahead and wanted:
        observe(recording, camera, events, *wanted)
    if dark is not None:
        steps = dark.found
        told = NO_DARK_STEPS if steps is None else " ".join(f"{step:.3g}" for step in steps)
        settings = altered(settings, "events", dark_steps=told)
    if lag is None:
        return settings, None
    found = lag.found
    variance = 0.0 if found is None else round(found.believed, 3)
    return altered(settings, "events", lag_variance=variance), found


def with_dark_shares(recording: Recording, settings: Settings) -> Settings:
    """Fill in how often frames show light that their noise hides: from the settings, else an estimate, else even."""
    if settings.filter.dark_shares != AUTO or not settings.filter.joins_frames:
        return settings
    found = estimate_dark_shares(recording, settings.camera)
    shares = EVEN if found is None else " ".join(f"{share:.3g}" for share in found)
    return altered(settings, "filter", dark_shares=shares)


def with_background(
    recording: Recording, settings: Settings, pixels: PixelCalibration | None, *, lookahead: bool
) -> tuple[Settings, float | None]:
    """Fill in the background noise: from the settings, else what is measured, at least the least, else the usual.

    With lookahead neighbours tell what is noise, by its rate; else ages of events do, for which the usual is the least.
    Returned as well is what was measured, Hz per pixel.
    """
    events = settings.events
    if events.noise_rate is not None or not settings.filter.joins_frames:
        return settings, None
    least = min(_LEAST_NOISE, events.usual_noise_rate) if lookahead else events.usual_noise_rate
    hot = None if pixels is None else pixels.hot
    found = event_noise(recording, _NOISE_EVENTS, hot, enough=least)
    if found is None:
        return altered(settings, "events", noise_rate=events.background_rate), None
    return altered(settings, "events", noise_rate=max(found.rate, least)), found.rate
