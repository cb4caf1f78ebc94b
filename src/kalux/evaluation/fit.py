"""Settings fitted to a recording's own frames: those under which held-out frames are most likely.

Every second frame is held out. A setting is judged by the mean negative log predictive density of the held-out pixels,

    -log p(B),  log(B + I_0) ~ Normal(L, P + R),

with L and P the filter's estimate and its own variance, and R that of the frame (9): a filter that claims too small a
variance pays for it, as does one that knows too little. The density is that of the intensity B itself, so that
different I_0 can be compared; a clipped pixel counts with the probability of being at least white. One pixel in a
hundred is granted ten times the standard deviation, or a few flickering pixels would decide.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from kalux.calibration.values import Calibration
from kalux.errors import InputError
from kalux.evaluation.held_out import HeldOut, hold_out_frames
from kalux.filters.shots import Shot, level_variance, take_shot
from kalux.models.camera import Camera, common_rounding
from kalux.pipeline import reconstruct
from kalux.planning import plan
from kalux.recording import Recording, with_frames
from kalux.settings import Settings, altered, from_dict, preset

Array = NDArray[np.float64]

READS: Final = 3
"""Reads across the exposure of a held-out frame."""

_OUTLIERS: Final = 0.01
_OUTLIER_SCALE: Final = 10.0

STEPS: Final[Mapping[str, float]] = {
    "threshold_scale": 1.2,
    "events.step_variance": 2.0,
    "events.threshold_spread": 2.0,
    "events.noise_rate": 2.0,
    "camera.frame_noise": 1.5,
    "camera.log_offset": 1.5,
}
"""What is fitted, and the factor of its first steps; ``threshold_scale`` is that of both thresholds, and shot noise
goes with frame noise, which does not become less than rounding."""

_ROUNDS: Final = 4  # of steps, each the square root of the last


class Score(NamedTuple):
    """How likely held-out pixels are.

    Attributes
    ----------
    nll
        Mean negative log density per pixel.
    mse
        Mean squared error of the intensity, scaled as `kalux.evaluation.held_out` does.
    """

    nll: float
    mse: float


@dataclass(frozen=True)
class Fit:
    """Fitted settings.

    Attributes
    ----------
    settings
        By group and name, with thresholds and delay filled in.
    start, best
        Scores before and after; never is either of the two numbers worse after.
    evaluations
        Reconstructions that were made.
    factors
        By how much every fitted value was changed.
    """

    settings: Mapping[str, Mapping[str, float | int | str]]
    start: Score
    best: Score
    evaluations: int
    factors: Mapping[str, float]

    def described(self) -> str:
        """In words."""
        changes = ", ".join(
            f"{name} x {factor:.3g}" for name, factor in self.factors.items() if abs(factor - 1.0) > 1e-9
        )
        return (
            f"fit: {self.evaluations} reconstructions; negative log likelihood per held-out pixel "
            f"{self.start.nll:.4f} -> {self.best.nll:.4f}, MSE x100 {100 * self.start.mse:.4f} -> "
            f"{100 * self.best.mse:.4f}; {changes or 'nothing changed'}"
        )

    def calibration(self) -> Calibration:
        """As a calibration."""
        measured = {
            "nll_before": self.start.nll,
            "nll_after": self.best.nll,
            "held_out_mse_before": self.start.mse,
            "held_out_mse_after": self.best.mse,
            "evaluations": self.evaluations,
        }
        return Calibration(self.settings, {}, measured)


def fit_settings(
    recording: Recording,
    start: Calibration | None = None,
    *,
    evaluations: int = 60,
    most_frames: int = 40,
    on_evaluation: Callable[[], None] = lambda: None,
) -> Fit:
    """Fit what cannot be measured directly to the recording's own held-out frames.

    A coordinate search in the logarithm of `STEPS`: each value is raised and lowered by its factor, and what makes the
    frames likelier, without a larger squared error, is kept. The same recording gives the same result.

    Parameters
    ----------
    recording
        With exposures.
    start
        What is known already; the default preset otherwise. Its maps of pixels are used.
    evaluations
        Reconstructions at most, at least 1.
    most_frames
        Only so many frames from the start are looked at.
    on_evaluation
        Called after every reconstruction.

    Raises
    ------
    InputError
        If ``evaluations`` is less than 1.
    FrameError
        If there are too few frames to hold some out.
    """
    if evaluations < 1:
        raise InputError(f"fit: {evaluations} evaluations; at least 1 is needed")
    known = Calibration() if start is None else start
    settings = known.apply(preset("default"))
    held = hold_out_frames(
        _first_frames(recording, most_frames),
        reads=READS,
        response=settings.camera.response,
        black_level=settings.camera.black_level,
    )
    settings = _filled_in(held, settings)
    response = Camera.named(settings.camera.response, settings.camera.clipped_from).response
    rounding = common_rounding(next(iter(held.kept.frames())), response)
    current = dict.fromkeys(STEPS, 1.0)
    first = best = score_settings(held, settings, known)
    on_evaluation()
    used = 1
    steps = dict(STEPS)
    for _ in range(_ROUNDS):
        for name in STEPS:
            for factor in (steps[name], 1.0 / steps[name]):
                moved = False
                while used < evaluations:  # on in the same direction as long as it helps
                    trial = {**current, name: current[name] * factor}
                    found = score_settings(held, _changed(settings, trial, rounding), known)
                    on_evaluation()
                    used += 1
                    if not (found.nll < best.nll - 1e-5 and found.mse <= first.mse):
                        break
                    current, best, moved = trial, found, True
                if moved:
                    break
        steps = {name: float(np.sqrt(step)) for name, step in steps.items()}
    chosen = _changed(settings, current, rounding)
    return Fit(_fitted_values(chosen), first, best, used, current)


def _first_frames(recording: Recording, count: int) -> Recording:
    return with_frames(recording, lambda: islice(recording.frames(), count))


def _filled_in(held: HeldOut, settings: Settings) -> Settings:
    """With thresholds, delay and reference exposure as a reconstruction would choose them."""
    return plan(held.kept, times=held.times.ravel(), settings=settings).settings


def _changed(settings: Settings, factors: Mapping[str, float], rounding: float) -> Settings:
    """The settings times the factors; frame noise does not fall below ``rounding``, white = 1, if it is not there."""
    values: dict[str, dict[str, float]] = {"camera": {}, "events": {}}
    for name, factor in factors.items():
        if name == "threshold_scale":
            for threshold in ("threshold_on", "threshold_off"):
                values["events"][threshold] = getattr(settings.events, threshold) * factor
            continue
        group, field = name.split(".")
        if field == "frame_noise":
            read = settings.camera.noise[0]
            factor = max(factor, min(rounding / read, 1.0)) if read > 0 else factor
        values[group][field] = getattr(getattr(settings, group), field) * factor
        if field == "frame_noise":
            values[group]["shot_noise"] = settings.camera.noise[1] * factor**2
    return from_dict(values, settings)


def _fitted_values(settings: Settings) -> dict[str, dict[str, float | int | str]]:
    values: dict[str, dict[str, float | int | str]] = {"camera": {}, "events": {}}
    names = ("threshold_on", "threshold_off", "delay", "step_variance", "threshold_spread", "noise_rate")
    for name in (*names, "dark_steps", "lag_variance", "refractory_period"):
        values["events"][name] = getattr(settings.events, name)
    if settings.events.refractory_doubt:
        values["events"]["refractory_spread"] = settings.events.refractory_doubt
    for name in ("frame_noise", "shot_noise", "log_offset"):
        values["camera"][name] = getattr(settings.camera, name)
    return values


def score_settings(held: HeldOut, settings: Settings, calibration: Calibration | None = None) -> Score:
    """How likely settings make the held-out frames; of the calibration only the maps of pixels are used.

    The frames' fixed pattern is in the held-out ones, too.
    """
    settings = altered(settings, "camera", fixed_pattern=0.0)
    images = reconstruct(held.kept, times=held.times.ravel(), settings=settings, calibration=calibration)
    reads = held.times.shape[1]
    nll, errors, pixels = 0.0, 0.0, 0
    camera = Camera.named(settings.camera.response, settings.camera.clipped_from)
    for frame in held.frames():
        group = [next(images) for _ in range(reads)]
        mean: Array = np.stack([image.intensity for image in group]).mean(axis=0, dtype=np.float64)
        variance = group[reads // 2].variance.astype(np.float64)
        shot = take_shot(frame, camera, held.reference_exposure)
        counted = ... if shot.valid is None else shot.valid
        squared = ((mean - shot.intensity) / held.scale) ** 2
        nll += float(_negative_log_density(mean, variance, shot, settings)[counted].sum())
        errors += float(squared[counted].sum())
        pixels += squared[counted].size
    return Score(nll / pixels, errors / pixels)


def _negative_log_density(mean: Array, variance: Array, shot: Shot, settings: Settings) -> Array:
    """(H, W) of every pixel of a frame, or the negative log probability of being clipped."""
    offset = settings.camera.offset
    observed = np.maximum(shot.intensity, 0.0)
    total = variance + level_variance(shot, settings.camera.noise, offset)[shot.levels]
    away = (np.log(observed + offset) - np.log(np.maximum(mean, 0.0) + offset)) / np.sqrt(total)
    narrow = np.log(1 - _OUTLIERS) - 0.5 * away**2
    wide = np.log(_OUTLIERS / _OUTLIER_SCALE) - 0.5 * (away / _OUTLIER_SCALE) ** 2
    density = np.logaddexp(narrow, wide) - 0.5 * np.log(2 * np.pi * total) - np.log(observed + offset)
    above = np.logaddexp(
        np.log(1 - _OUTLIERS) + log_ndtr(-away), np.log(_OUTLIERS) + log_ndtr(-away / _OUTLIER_SCALE)
    )
    return np.asarray(-np.where(shot.clipped, above, density), np.float64)
