"""By how much more an event's step varies in the dark: slow pixels miss what is fast there.

A photoreceptor's time constant goes by 1 / I. Where it is longer than texture takes to pass, events come late, or for
less than the light has changed, and what frames tell of the change differs from what events say by more, the darker
the pixel. One variance for all would trust such events as others, and keep an image on their way although the next
frame contradicts it.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.event_model import DARKEST, ErrorModel, Samples, mismatch_of
from kalux.calibration.intervals import counted_intervals
from kalux.models.dark_steps import PARTS, DarkSteps, octave
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings

Array = NDArray[np.float64]

_MAX_FRAMES: Final = 40
_ENOUGH: Final = 300_000  # dark pixels and intervals

_FEWEST_EVENTS: Final = 2.0
"""Of a pixel in an interval, as for the steps of all (`kalux.calibration.mismatch`)."""

_LEAST_LIGHT: Final = DARKEST / 2
"""Of a pixel in either frame, of white, unless the frame's noise asks for more."""

_CUT: Final = 4.0
"""Standard deviations of the frames' noise from which pixels count: the logarithm of darker ones is skewed, and black
cuts a part of it. From 2 on, d is up to 0.7 where nothing lags (c = 0.1, noise of 0.01 of white)."""

_MIN_SAMPLES: Final = 500
"""Of an octave: as pixels along an edge err alike, these tell a variance within a third."""

_CLIP: Final = 3.0  # standard deviations of a mismatch: flicker and occlusions say nothing of steps

_ROUNDS: Final = 8
"""Of the search for the variance by which mismatches are weighed and clipped: it changes by less than 1 % after."""

_LEAST: Final = 0.05
"""c^2: less is what octaves of sensors that do not lag differ by."""

_MOST: Final = 4.0
"""What is believed at most, c^2: single events of such a pixel tell nothing any more."""


def estimate_dark_steps(
    recording: Recording, camera: CameraSettings, events: EventSettings
) -> DarkSteps | None:
    """Variance of an event's step beyond ``events.step_noise``, c^2, in six octaves below 0.32 of white.

    Of the pixels of an octave, by their mean intensity in two frames that both measure them, with two events and more
    between, m their mismatch (docs/equations.md, K1 and K20), n their events, Var m its variance with a step's variance
    q c^2 and Var' m without: the q that is, with v = n / Var^2 m, the sum of v (m^2 - Var' m) over that of v n c^2. An
    octave of which too few pixels tell has what those beside it have.

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response, saturation, I_0 and frame noise.
    events
        With both thresholds, their spread, and the variance of a step.

    Returns None where no octave has more than 0.05.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    seen = _samples(recording, camera, events)
    found = np.array([_step_variance(one, events.step_noise) for one in seen])
    told = np.flatnonzero(~np.isnan(found))
    if len(told) == 0:
        return None
    more = np.interp(np.arange(PARTS), told, found[told]) - events.step_noise
    more = np.where(more < _LEAST, 0.0, more)
    return tuple(more.round(3).tolist()) if more.any() else None


def _samples(recording: Recording, camera: CameraSettings, events: EventSettings) -> list[Array]:
    """Of every octave (3, N): squared mismatches and their variances without the steps', c^2, and events."""
    on, off = events.thresholds
    model = ErrorModel(events.thresholds, camera.noise, events.mismatch, events.quantisation_variance)
    parts: list[list[Array]] = [[np.empty((3, 0))] for _ in range(PARTS)]
    count = 0
    for interval, of_on, of_off, bend in counted_intervals(
        recording, camera, events, most_frames=_MAX_FRAMES
    ):
        first, second = interval.ends
        usable = first.shot.measured & second.shot.measured & (of_on + of_off >= _FEWEST_EVENTS)
        for end in interval.ends:
            usable &= end.intensity > max(_LEAST_LIGHT, _CUT * camera.noise[0]) * end.shot.white
        place = np.where(usable, octave(interval.level), -1)
        dark = place >= 0
        whites = (np.full(np.count_nonzero(dark), np.float64(end.shot.white)) for end in interval.ends)
        planes = first.intensity, second.intensity, of_on, of_off, bend
        chosen = Samples(*(plane[dark] for plane in planes), *whites)
        mismatch, variance = mismatch_of(chosen, model, camera.offset, 0.0)
        values = np.stack([mismatch**2, variance, chosen.on + chosen.off])
        values[:2] /= on * off
        for k in range(PARTS):
            parts[k].append(values[:, place[dark] == k])
        count += len(mismatch)
        if count >= _ENOUGH:
            break
    return [np.concatenate(part, axis=1) for part in parts]


def _step_variance(samples: Array, usual: float) -> float:
    """The variance of a step, c^2, sought from a ``usual`` one on; NaN: too few samples."""
    square, variance, count = samples
    if len(square) < _MIN_SAMPLES:
        return float("nan")
    found = usual
    for _ in range(_ROUNDS):
        whole = variance + found * count
        weight = count / whole**2
        told = np.minimum(square, _CLIP**2 * whole) - variance
        found = float(np.clip((weight * told).sum() / (weight * count).sum(), 0.0, _MOST))
    return found
