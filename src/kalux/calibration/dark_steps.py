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
from kalux.calibration.intervals import Counted
from kalux.calibration.slow_pixels import observe
from kalux.models.dark_steps import PARTS, DarkSteps, octave
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings

Array = NDArray[np.float64]

_ENOUGH: Final = 300_000  # dark pixels and intervals

_FEWEST_EVENTS: Final = 2.0
"""Of a pixel in an interval, as for the steps of all (`kalux.calibration.mismatch`)."""

_LEAST_LIGHT: Final = DARKEST / 2
"""Of a pixel in either frame, of white, unless the frame's noise asks for more."""

_CUT: Final = 4.0
"""Standard deviations of the frames' noise from which pixels count: the logarithm of darker ones is skewed, and black
cuts a part of it. From 2 on, d is up to 0.7 where nothing lags (c = 0.1, noise of 0.01 of white)."""

_MIN_SAMPLES: Final = 500
"""Of an octave: where 50 pixels along an edge err alike, as with I_0 (K9), these tell a variance within a half."""

_CLIP: Final = 3.0  # standard deviations of a mismatch: flicker and occlusions say nothing of steps

_ROUNDS: Final = 8
"""Of the search for the variance by which mismatches are weighed and clipped: of eleven recordings it changes by less
than 0.01 % after (after four by up to 1 %)."""

_LEAST: Final = 0.05
"""c^2: no octave has as much in 51 of 68 simulated scenes of sensors that do not lag."""

_MOST: Final = 4.0
"""What is believed at most, c^2: single events of such a pixel tell nothing any more."""


def estimate_dark_steps(
    recording: Recording, camera: CameraSettings, events: EventSettings, noise_rate: float = 0.0
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
    noise_rate
        Events of a pixel without reason, Hz, whose variance is in Var' m, too.

    Returns None where no octave has more than 0.05.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    seen = DarkSamples(camera, events, noise_rate)
    observe(recording, camera, events, seen)
    return seen.found


class DarkSamples:
    """What `estimate_dark_steps` compares, interval by interval: an observer of `kalux.calibration.slow_pixels`.

    Parameters
    ----------
    camera, events, noise_rate
        As of `estimate_dark_steps`.
    """

    def __init__(self, camera: CameraSettings, events: EventSettings, noise_rate: float = 0.0) -> None:
        self._camera, self._events, self._noise_rate = camera, events, noise_rate
        self._model = ErrorModel(
            events.thresholds, camera.noise, events.mismatch, events.quantisation_variance
        )
        # Of every octave (3, N) each: squared mismatches and their variances without the steps', c^2, and events.
        self._octaves: list[list[Array]] = [[np.empty((3, 0))] for _ in range(PARTS)]
        self._count = 0

    @property
    def enough(self) -> bool:
        """Whether 300,000 dark pixels have been seen."""
        return self._count >= _ENOUGH

    @property
    def found(self) -> DarkSteps | None:
        """By what was seen until now; None: no octave has more than 0.05."""
        usual = self._events.step_noise
        found = np.array([_step_variance(np.concatenate(seen, axis=1), usual) for seen in self._octaves])
        told = np.flatnonzero(~np.isnan(found))
        if len(told) == 0:
            return None
        more = np.interp(np.arange(PARTS), told, found[told]) - usual
        more = np.where(more < _LEAST, 0.0, more)
        return tuple(more.round(3).tolist()) if more.any() else None

    def add(self, counted: Counted) -> None:
        """Take the next interval in."""
        interval, on, off, bend = counted
        first, second = interval.ends
        usable = first.shot.measured & second.shot.measured & (on + off >= _FEWEST_EVENTS)
        for end in interval.ends:
            usable &= end.intensity > max(_LEAST_LIGHT, _CUT * self._camera.noise[0]) * end.shot.white
        place = np.where(usable, octave(interval.level), -1)
        dark = place >= 0
        whites = (np.full(np.count_nonzero(dark), np.float64(end.shot.white)) for end in interval.ends)
        chosen = Samples(
            *(plane[dark] for plane in (first.intensity, second.intensity, on, off, bend)), *whites
        )
        mismatch, variance = mismatch_of(chosen, self._model, self._camera.offset, 0.0)
        values = np.stack([mismatch**2, variance, chosen.on + chosen.off])
        values[:2] /= float(np.prod(self._events.thresholds))
        values[1] += self._noise_rate * interval.seconds
        for k, seen in enumerate(self._octaves):
            seen.append(values[:, place[dark] == k])
        self._count += len(mismatch)


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
