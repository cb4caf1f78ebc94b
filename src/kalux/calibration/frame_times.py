"""Times of frames that are off one by one, as stamps of a computer are that fetches frames when it can.

Events between two frames tell what changes from the first to the second. If a frame is of another moment than its stamp
says, the events around it explain what is left, with one sign and one time everywhere:

    log I_{k+1} - log I_k = C(t_k, t_{k+1}) + R(t_{k+1}) d_{k+1} - R(t_k) d_k,

with C the change by the events between the stamps t, R its rate, and d the errors of the stamps. Least squares with
Huber's weights, in all errors at once, by Gauss and Newton's iteration; a normal prior holds frames that tell nothing.
A step is spread over the time in which it gathered (`kalux.calibration.alignment.levels`), so that light that changes
slowly does not seem late. What all frames have in common is no error of single ones, but the delay of the events, and
what all intervals have in common is no error of times, but the gain of the events. Where a gain of each interval
explains more than the times do, it is events that are lost, or late, when a camera shakes faster.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from kalux.calibration.alignment import levels
from kalux.calibration.intervals import Interval, intervals
from kalux.calibration.regression import grid_step, huber_weights, robust_deviation
from kalux.event_slices import joined_events, thinned
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings

Array = NDArray[np.float64]
Times = NDArray[np.int64]

_ASKED: Final = 16
_MOST_FRAMES: Final = 40
"""The first ones, which tell whether times may be off, and if so whether they are: then all frames are corrected."""

_SPREAD: Final = 5_000.0
"""us, standard deviation of the errors before the frames are asked."""

_FAREST: Final = 15_000.0  # us, of a stamp from its frame
_LARGEST_STEP: Final = 4_000.0  # us, of an iteration: further away the rate is another
_COMMON_ROUNDS: Final = 2
_ROUNDS: Final = 3

_MARGIN: Final = 80_000
"""us around an interval in which events are looked at: `_FAREST`, and some more for the steps before."""

_HALF_STEP: Final = 1_000  # us, of the rate
_MOST_PIXELS: Final = 90_000
"""About those of a DAVIS346, which all count: of larger sensors every second row and column is looked at, or fewer."""
_LEAST_PIXELS: Final = 200
_ALIKE: Final = 9.0  # neighbouring pixels that say the same
_LEAST_ERROR: Final = 0.02  # log intensity

_SUSPECT: Final = 0.97
_LEFT: Final = 0.92
"""Share of the misfit that errors of single frames leave, beside one that all have: by a straight line from the stamps
as they are, from which on nothing more is looked at; and in the end, from which on nothing is corrected."""

_LEAST_SPREAD: Final = 1_000.0
"""us, standard deviation of errors below which they are left: the light that changes between two events is not known
that well either. Of 180 recordings whose stamps are right none has more together with `_LEFT`."""

_KNOWN: Final = 6.0
"""Least spread of the errors, in standard errors of the median one: where few edges of an image of 48 x 64 pixels move
by 20 pixels a second, errors seem to be five of these, 2.3 ms."""

_UNRELATED: Final = 0.5
"""Least mean square of the difference of one error to the next, of that of unrelated ones: what a sensor's delay, and
lost events, make of a scene that moves is alike from frame to frame (0.2 and 0.5 of two fast pans that seem to be 3.3
and 2.4 ms off, 0.6 to 1.3 of stamps that are, 0.02 to 0.4 of a clock that is fast)."""


_BEYOND_GAINS: Final = 1.5
"""Least share of the misfit that errors explain, in units of what a gain of each interval does: events that are lost,
or late, where a camera shakes faster. Of errors of 2 and 5 ms, known otherwise, 0.14 is left in the median of 112
recordings that have more, 0.64 in that of five that have less."""


class FrameTimes(NamedTuple):
    """Errors of the times of frames.

    Attributes
    ----------
    shifts
        (K,) us, what is to be added to the times of each frame.
    left
        Share of what events did not explain of the frames that is left with them.
    """

    shifts: Times
    left: float

    @property
    def spread(self) -> float:
        """Standard deviation of the errors, us."""
        return float(np.std(self.shifts))

    def of_all(self, exposures: Times, left_out: Sequence[int]) -> FrameTimes:
        """With times of frames that were ``left_out``, too, so that all can be moved.

        Those are moved as the frames around. No frame begins before the one before it ends, the first is not moved to
        later times, nor the last to earlier ones: there are images at all times of the recording as it is stored.

        Parameters
        ----------
        exposures
            (K, 2) starts and ends of all frames, us.
        left_out
            Indices of those that were not there when the errors were found.
        """
        kept = np.setdiff1d(np.arange(len(exposures)), left_out)
        shifts = np.round(np.interp(np.arange(len(exposures)), kept, self.shifts)).astype(np.int64)
        return self._replace(shifts=_in_order(exposures, shifts))


class _Normal(NamedTuple):
    """Normal equations for K errors: (K,) diagonal and (K - 1,) beside it, (K,) right side; the misfit without them."""

    diagonal: Array
    beside: Array
    right: Array
    misfit: float


def find_frame_times(
    recording: Recording, camera: CameraSettings, events: EventSettings
) -> FrameTimes | None:
    """Errors of the times of single frames, where they explain much of what events do not; else None.

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response and I_0.
    events
        Both thresholds, and the delay.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    normal = _Normals(recording, camera, events, [])
    found = _first_errors(normal)
    if found is None or not found.are_certain:
        return None
    frames = recording.source.count_frames()
    errors = found.errors
    if frames > _MOST_FRAMES:
        common = all_errors = np.full(frames, found.common)
        with_gain = normal.with_gain(found.gain)
        for _ in range(_ROUNDS):
            all_errors = _moved(with_gain.at(all_errors), all_errors, common)
        errors = all_errors - common
    return FrameTimes(np.round(errors).astype(np.int64), found.left)


class _Errors(NamedTuple):
    """Errors of frames.

    Attributes
    ----------
    errors
        (K,) us, beside what they have in common:
    common
        us.
    gain
        Of the change by events, which all intervals have.
    left, left_by_gains
        Share of the misfit that is left with them, and with a gain of each interval in their place.
    spread, standard_error
        Their standard deviation, those that are known well counting most, and how well the median one is known, us.
    """

    errors: Array
    common: float
    gain: float
    left: float
    left_by_gains: float
    spread: float
    standard_error: float

    @property
    def are_certain(self) -> bool:
        """Whether they are large, explain much, more than gains do, and have nothing to do with one another."""
        if self.left > _LEFT or 1.0 - self.left < _BEYOND_GAINS * (1.0 - self.left_by_gains):
            return False
        if self.spread < max(_LEAST_SPREAD, _KNOWN * self.standard_error):
            return False
        return float(np.mean(np.square(np.diff(self.errors)))) >= _UNRELATED * 2 * float(np.var(self.errors))


class _Normals(NamedTuple):
    """Makes the normal equations for what is added to errors of the first frames.

    ``scales`` holds the error of the pixels, log intensity, of every interval that has been looked at: misfits are
    compared.
    """

    recording: Recording
    camera: CameraSettings
    events: EventSettings
    scales: list[float]

    def at(self, errors: Array) -> _Normal:
        """Of as many frames as there are ``errors``, us."""
        return _joined([_equations(seen, scale) for seen, scale in self._seen(errors)])

    def gain(self, errors: Array) -> float:
        """That which all intervals have, as the frames' ``errors`` are, us."""
        sums = np.array([_gain_sums(seen, scale) for seen, scale in self._seen(errors)]).reshape(-1, 2)
        told, weight = sums.sum(axis=0)
        return float(1.0 + (told / weight if weight > 0 else 0.0))

    def with_gain(self, gain: float) -> _Normals:
        """The same with thresholds that are ``gain`` times as large."""
        on, off = (gain * threshold for threshold in self.events.thresholds)
        return self._replace(events=replace(self.events, threshold_on=on, threshold_off=off))

    def misfit_with_gains(self, errors: Array) -> float:
        """What is left where every interval has a gain of its own."""
        return sum(_left_by_gain(seen, scale) for seen, scale in self._seen(errors))

    def _seen(self, errors: Array) -> Iterator[tuple[_Seen | None, float]]:
        """Every interval of as many frames as there are ``errors``, with its scale."""
        seen = intervals(self.recording, self.camera, margin=_MARGIN, most_frames=len(errors), apart=0)
        for index, interval in enumerate(seen):
            found = _see(interval, self.events, (float(errors[index]), float(errors[index + 1])))
            if index == len(self.scales):
                self.scales.append(0.0)
            if found is not None and self.scales[index] == 0.0:
                self.scales[index] = max(robust_deviation(found.left), _LEAST_ERROR)
            yield found, self.scales[index]


def _first_errors(normal: _Normals) -> _Errors | None:
    """Those of the first frames; None where they can hardly explain anything."""
    frames = normal.recording.source.count_frames()
    asked = normal.at(np.zeros(min(frames, _ASKED)))
    if len(asked.right) < 3 or not _is_suspect(asked):
        return None
    common = np.zeros(min(frames, _MOST_FRAMES))
    for _ in range(_COMMON_ROUNDS):
        common += np.clip(_common(normal.at(common)), -_LARGEST_STEP, _LARGEST_STEP)
    gain = normal.gain(common)
    normal = normal.with_gain(gain)
    equations = normal.at(common)
    errors, without = common, equations.misfit
    for _ in range(_ROUNDS):
        errors = _moved(equations, errors, common)
        equations = normal.at(errors)
    found, known = errors - common, equations.diagonal
    median = float(np.median(known))
    if median == 0 or without == 0:
        return None
    about = found - np.average(found, weights=known)
    spread = float(np.sqrt(np.average(np.square(about), weights=known)))
    left, by_gains = equations.misfit / without, normal.misfit_with_gains(common) / without
    return _Errors(found, float(common[0]), gain, left, by_gains, spread, 1.0 / np.sqrt(median))


def _moved(equations: _Normal, errors: Array, common: Array) -> Array:
    """(K,) the ``errors`` of the frames, us, after one more iteration; not far from the ``common`` one of all, (K,)."""
    moved = errors + np.clip(_solved(equations, errors - common), -_LARGEST_STEP, _LARGEST_STEP)
    return np.asarray(common + np.clip(moved - common, -_FAREST, _FAREST), np.float64)


class _Seen(NamedTuple):
    """What the (N,) pixels of an interval say in which something moves.

    Attributes
    ----------
    change
        (N,) by the events, log intensity.
    left
        (N,) of that of the frames: what they do not explain.
    rates
        (2, N) of the change at both ends: how the first falls and the second grows with time, 1/us.
    """

    change: Array
    left: Array
    rates: Array


def _see(interval: Interval, events: EventSettings, errors: tuple[float, float]) -> _Seen | None:
    """None: too little moves, or frames with such ``errors`` would not come one after the other."""
    delay = events.delay or 0
    middles = [
        round(end + delay + error) for end, error in zip((interval.start, interval.end), errors, strict=True)
    ]
    times = np.array([t + step for t in middles for step in (-_HALF_STEP, 0, _HALF_STEP)], np.int64)
    if (np.diff(times) < 0).any() or not interval.chunks:
        return None
    step = grid_step(interval.usable.shape, _MOST_PIXELS)
    usable, change = interval.usable[::step, ::step], interval.change[::step, ::step]
    seen = interval.chunks if step == 1 else [thinned(chunk, step) for chunk in interval.chunks]
    on, off = levels(joined_events(seen), usable.shape, times)
    threshold_on, threshold_off = events.thresholds
    level = threshold_on * on[:, usable].astype(np.float64) - threshold_off * off[:, usable]
    by_events = level[4] - level[1]
    left = change[usable] - by_events
    rates = np.stack([level[0] - level[2], level[5] - level[3]]) / (2 * _HALF_STEP)
    moving = (rates != 0).any(axis=0)
    if np.count_nonzero(moving) < _LEAST_PIXELS:
        return None
    return _Seen(by_events[moving], left[moving] - np.median(left), rates[:, moving])


def _weights(left: Array, scale: float) -> Array:
    """(N,) of pixels that events leave so much of."""
    return huber_weights(left)[0] / (_ALIKE * scale**2)


def _equations(seen: _Seen | None, scale: float) -> tuple[Array, Array, float]:
    """(2, 2) matrix and (2,) right side for what is added to the errors of both frames, and the misfit with them."""
    if seen is None:
        return np.zeros((2, 2)), np.zeros(2), 0.0
    weights = _weights(seen.left, scale)
    weighed = seen.rates * weights
    return weighed @ seen.rates.T, weighed @ seen.left, float(weights @ np.square(seen.left))


def _gain_sums(seen: _Seen | None, scale: float) -> tuple[float, float]:
    """Of least squares of what is left on the change by events: the product of both, and that with itself."""
    if seen is None:
        return 0.0, 0.0
    weighed = _weights(seen.left, scale) * seen.change
    return float(weighed @ seen.left), float(weighed @ seen.change)


def _left_by_gain(seen: _Seen | None, scale: float) -> float:
    """The misfit that is left of an interval if events count by its own gain."""
    if seen is None:
        return 0.0
    told, weight = _gain_sums(seen, scale)
    left = seen.left - (told / weight if weight > 0 else 0.0) * seen.change
    return float(_weights(left, scale) @ np.square(left))


def _joined(sums: Sequence[tuple[Array, Array, float]]) -> _Normal:
    """The equations of all intervals, each of which has an error at both ends."""
    diagonal, right = np.zeros(len(sums) + 1), np.zeros(len(sums) + 1)
    beside = np.zeros(len(sums))
    for index, (matrix, vector, _) in enumerate(sums):
        diagonal[index : index + 2] += np.diag(matrix)
        beside[index] = matrix[0, 1]
        right[index : index + 2] += vector
    return _Normal(diagonal, beside, right, sum(misfit for *_, misfit in sums))


def _common(normal: _Normal) -> float:
    """The step of an error that all frames have, us."""
    whole = float(normal.diagonal.sum() + 2 * normal.beside.sum())
    return float(normal.right.sum()) / whole if whole > 0 else 0.0


def _solved(normal: _Normal, errors: Array) -> Array:
    """(K,) the most probable step of each error, us, by the prior of what they are."""
    precision = 1.0 / _SPREAD**2
    matrix = np.zeros((2, len(normal.right)))
    matrix[0] = normal.diagonal + precision
    matrix[1, :-1] = normal.beside
    return np.asarray(solveh_banded(matrix, normal.right - precision * errors, lower=True), np.float64)


def _is_suspect(normal: _Normal) -> bool:
    """Whether errors of single frames may explain much more than one of all, by a straight line."""
    with_common = normal.misfit - _common(normal) * float(normal.right.sum())
    with_each = normal.misfit - float(_solved(normal, np.zeros(len(normal.right))) @ normal.right)
    return with_common > 0 and with_each < _SUSPECT * with_common


def _in_order(exposures: Times, shifts: Times) -> Times:
    """(K,) the shifts, so that no frame begins before the one before it ends, and the recording is not shorter.

    ``exposures`` are (K, 2) starts and ends, us.
    """
    made = shifts.copy()
    made[0] = min(made[0], 0)
    made[-1] = max(made[-1], 0)
    if len(made) == 1:
        return np.zeros_like(made)
    for index in range(1, len(made)):
        ended = int(exposures[index - 1, 1] + made[index - 1])
        made[index] = max(made[index], ended - int(exposures[index, 0]))
    return made
