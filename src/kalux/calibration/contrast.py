"""Contrast thresholds and refractory period from a recording: log frame differences against event counts.

Counts of events are wrong: by noise, by events that are lost, by what is not told yet. Least squares would take their
errors for smaller thresholds (attenuation), down to nothing where nothing moves. Two kinds of instruments do not: the
mean counts of the eight neighbours, which see the same edges with errors of their own, and the mean change of the
neighbours as the frames show it.

The first tell more, and are right where the noise of neighbours is not the same; where little moves and lamps flicker
it is. The second do not care what noise events have, but changes too small for an event make thresholds too large. Each
has a variance for that, the usual thresholds have theirs, and all are combined by information.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.refractory import LATE, possible_periods, shortest_interval
from kalux.calibration.regression import HUBER, NORMAL_MAD, Fit, standard_errors, two_stage
from kalux.calibration.steps import Steps, steps
from kalux.recording import Recording
from kalux.settings import CameraSettings

Array = NDArray[np.float64]

_MIN_SAMPLES: Final = 200
_SHORTEST_EVENTS: Final = 500_000
"""Of which the shortest interval is taken: its edge is then that of 10,000 pairs."""

_MODEL: Final = 0.03
"""Relative error of thresholds from the neighbours' counts, beside the statistical one: they are up to 3 % too large on
ten of eleven simulated scenes."""

_SHARED: Final = 0.1
"""Share of what frames do not explain in the neighbours' counts that may be common to neighbours."""

_SUBTHRESHOLD: Final = 0.2
"""Relative error of thresholds from the neighbours' changes in frames, beside the statistical one: they are 1 to 13 %
too large on eleven simulated scenes, and 12 to 45 % larger than those from counts on three real recordings."""

_LEAST_EXCESS: Final = 0.1
"""By how much more events that follow soon must tell than late ones, two standard errors taken off, for something to be
lost in the refractory period. Where nothing is lost it is 0 to 0.03 on seven simulated scenes and -0.03, 0.04 and 0.14
+- 0.05 on three recordings, with 0.5 to 2 ms 0.22 to 0.83 on four scenes."""

_APART: Final = 1.2
"""Two estimates of the refractory period that differ by more do not have the errors of estimates alone: on three scenes
with the right delay they are 0.98, 1.05 and 1.07 of one another, with a delay that is none 1.5."""

_USUAL_EXCESS: Final = 0.02  # where nothing is lost

_LEAST_GAIN: Final = 0.02
"""Share of the residual that the period found must take away. On the same four scenes it is 0.043 to 0.17, on edges of
objects without texture, whose first events are late ones and tell less, 0.01 at most."""


class ThresholdEstimate(NamedTuple):
    """Estimated contrast thresholds.

    Attributes
    ----------
    on, off
        Thresholds, log intensity, both positive.
    residual
        Robust standard deviation of the fit, log intensity.
    samples
        Pixels and frame intervals used.
    spread
        Relative standard deviation of the thresholds: what is not known of them.
    usual_share
        Share of the information that is not the recording's, but that of the usual thresholds; 0 to 1.
    refractory_period
        us; 0 where nothing is lost in it, or too little to tell.
    """

    on: float
    off: float
    residual: float
    samples: int
    spread: float
    usual_share: float
    refractory_period: int


class Usual(NamedTuple):
    """What thresholds usually are, log intensity, and their relative standard deviation."""

    on: float
    off: float
    spread: float


def estimate_thresholds(
    recording: Recording,
    camera: CameraSettings,
    usual: Usual,
    *,
    of_log_offset: bool = False,
    delay: int = 0,
    refractory_period: int | None = 0,
) -> ThresholdEstimate | None:
    """Global on and off thresholds, and the refractory period, by robust regression of frame changes on event counts.

    For pixels that are well exposed in two successive frames: log(I' + I_0) - log(I + I_0) = s (c_on n_on - c_off n_off
    + h turned), with s = I / (I + I_0) the share of a step of log I that shows in log(I + I_0), n the weighted counts
    of `kalux.calibration.steps`, and h what is not reported where the direction turns
    (`kalux.calibration.thresholds`). Looks at the first 200 frames, or at fewer when those give enough pixels.

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response and I_0.
    usual
        The thresholds before the recording has said anything. Of a spread of 0: they are known, and only the refractory
        period is found.
    of_log_offset
        Steps of log(I + I_0) instead of log I, s = 1, as in the paper's model.
    delay
        How much later than the frames' clock events are stamped, us.
    refractory_period
        Of the pixels, us: what is lost in it is added to the events (docs/equations.md, K13). None: to be found.

    Returns None where the recording has too few such pixels (200), e.g. because nothing moves.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    shortest = 0 if refractory_period is not None else shortest_interval(recording, _SHORTEST_EVENTS)
    late = LATE * shortest if shortest else np.inf

    def seen(*periods: int) -> _Seen:
        found = steps(recording, camera, delay=delay, periods=periods, late=late)
        log_offset = 0.0 if of_log_offset else camera.offset
        return _Seen(found, found.level / np.maximum(found.level + log_offset, 1e-9), recording.sensor_size)

    period = refractory_period or 0
    samples = seen(period)
    if len(samples.share) < _MIN_SAMPLES:
        return None
    estimate = _by_information(samples, usual, period)
    if estimate is None or refractory_period is not None or not _loses(samples):
        return estimate
    periods = possible_periods(shortest)
    period = _without_excess(periods, seen(*periods), usual)
    if period == 0:
        return estimate
    lossy = _by_information(seen(period), usual, period)
    explains = lossy is not None and lossy.residual < (1 - _LEAST_GAIN) * estimate.residual
    return lossy if explains else estimate


class _Seen(NamedTuple):
    """Samples, the share of a step of log I that shows in log(I + I_0), (N,), and the size of the sensor."""

    steps: Steps
    share: Array
    sensor_size: tuple[int, int]

    def columns(self, events: Array, turned: Array) -> Array:
        """(N, 3) what explains changes: (N, 2) on and off events and the turns."""
        return np.column_stack([events[:, 0], -events[:, 1], turned]) * self.share[:, None]

    def explained(self, index: int) -> Array:
        """(N, 3) what explains the pixels' own changes under a refractory period."""
        return self.columns(self.steps.events[:, index].sum(axis=1), self.steps.turned)

    def counts_around(self, index: int) -> Array:
        """(N, 3) the same of their neighbours."""
        return self.columns(self.steps.events_around[:, index].sum(axis=1), self.steps.turned_around)

    def changes_around(self) -> Array:
        """(N, 3) the neighbours' changes, upwards and downwards, and turns."""
        change = self.steps.change_around
        upwards, downwards = np.maximum(change, 0.0), np.minimum(change, 0.0)
        return np.column_stack([upwards, downwards, self.steps.turned_around * self.share])


class _Told(NamedTuple):
    """What a regression tells: logs of the thresholds on and off, and their variances, (2,); inf where nothing."""

    logs: Array
    variances: Array


def _by_information(seen: _Seen, usual: Usual, period: int) -> ThresholdEstimate | None:
    """Thresholds from either kind of instruments and the usual ones, weighted by the inverse of their variances."""
    change, explained = seen.steps.change, seen.explained(0)
    counts, changes = seen.counts_around(0), seen.changes_around()
    by_counts, by_changes = (two_stage(change, explained, instruments) for instruments in (counts, changes))
    fits = [fit for fit in (by_counts, by_changes) if fit is not None]
    if not fits:
        return None
    common = np.log1p(_SHARED * _unexplained(seen, by_counts, counts)) if by_counts is not None else np.inf
    of_counts = _told(seen, by_counts, explained, counts, float(np.hypot(common, _MODEL)))
    of_changes = _told(seen, by_changes, explained, changes, _SUBTHRESHOLD)
    # What both cannot explain is noise that neighbours share.
    apart = (of_counts.logs - of_changes.logs) ** 2 - 4 * (of_counts.variances + of_changes.variances)
    told = [
        _Told(np.log([usual.on, usual.off]), np.full(2, usual.spread**2)),
        of_counts._replace(variances=of_counts.variances + np.maximum(apart, 0.0)),
        of_changes,
    ]
    information = np.array([1 / np.maximum(one.variances, 1e-9) for one in told])
    total = information.sum(axis=0)
    on, off = np.exp((information * np.array([one.logs for one in told])).sum(axis=0) / total)
    return ThresholdEstimate(
        on=float(on),
        off=float(off),
        residual=fits[0].residual,
        samples=len(change),
        spread=float(np.sqrt(np.mean(1 / total))),
        usual_share=float(np.mean(information[0] / total)),
        refractory_period=period,
    )


def _told(seen: _Seen, fit: Fit | None, explained: Array, instruments: Array, error: float) -> _Told:
    """A regression's thresholds, with ``error`` the relative error that it has beside the statistical one."""
    if fit is None:
        return _Told(np.zeros(2), np.full(2, np.inf))
    samples = seen.steps
    errors = standard_errors(
        samples.change, explained, instruments, fit.weights, samples.pixel, seen.sensor_size
    )
    found = fit.solution[:2]
    positive = found > 0
    logs = np.log(np.where(positive, found, 1.0))
    variances = (errors[:2] / np.where(positive, found, 1.0)) ** 2 + error**2
    return _Told(logs, np.where(positive, variances, np.inf))


def _unexplained(seen: _Seen, fit: Fit, counts: Array) -> float:
    """What the neighbours' counts say that their frames do not, over what both say: mean squares."""
    predicted = np.abs(fit.solution[0]) * counts[:, 0] + np.abs(fit.solution[1]) * counts[:, 1]
    change = seen.steps.change_around
    both = float(predicted @ change) ** 2
    return float(predicted @ predicted) * float(change @ change) / max(both, 1e-12) - 1.0


class _Parted(NamedTuple):
    """The regression on late events, events that follow soon, and turns, both events in units of the thresholds."""

    explained: Array
    instruments: Array
    fit: Fit

    @property
    def excess(self) -> float:
        """By which share events that follow soon tell more than late ones."""
        return float(self.fit.solution[1] / self.fit.solution[0]) - 1.0


def _loses(seen: _Seen) -> bool:
    """Whether events that follow soon clearly tell more than late ones, if nothing is lost."""
    parted = _parted(seen, 0)
    if parted is None:
        return False
    samples = seen.steps
    late, soon, _ = standard_errors(
        samples.change,
        parted.explained,
        parted.instruments,
        parted.fit.weights,
        samples.pixel,
        seen.sensor_size,
    )
    error = float(np.hypot(late, soon) / parted.fit.solution[0])
    return parted.excess - 2 * error > _LEAST_EXCESS


def _parted(seen: _Seen, index: int) -> _Parted | None:
    """Under a refractory period; None where it is not determined."""
    samples = seen.steps
    fit = two_stage(samples.change, seen.explained(index), seen.counts_around(index))
    if fit is None:
        return None
    on, off, _ = fit.solution

    def columns(events: Array, turned: Array) -> Array:
        both = on * events[:, index, :, 0] - off * events[:, index, :, 1]
        return np.column_stack([both, turned]) * seen.share[:, None]

    explained = columns(samples.events, samples.turned)
    instruments = columns(samples.events_around, samples.turned_around)
    again = two_stage(samples.change, explained, instruments)
    return None if again is None or not again.solution[0] > 0 else _Parted(explained, instruments, again)


def _without_excess(periods: tuple[int, ...], seen: _Seen, usual: Usual) -> int:
    """The refractory period, us, under which events that follow soon tell as much as late ones; 0 if unknown.

    With known thresholds it is the one under which these explain the frames; if that is clearly longer, the geometric
    mean of both: what is wrong with the delay makes that one too long and the first too short (by 34 and 11 % where
    1.8 ms are taken for a delay that is none). Weights grow without bound near the period, so that a third too much
    costs a hundred times what a third too little does (docs/equations.md, K13).
    """
    excess = [_excess(seen, index) for index in range(len(periods))]
    alike = _crossing(periods, excess, _USUAL_EXCESS)
    if usual.spread > 0:
        return 0 if alike is None else alike
    explained = _crossing(periods, [_too_large(seen, index, usual) for index in range(len(periods))], 0.0)
    if alike is None or explained is None:
        return alike or explained or 0
    return explained if explained <= _APART * alike else round(float(np.sqrt(alike * explained)))


def _crossing(periods: tuple[int, ...], excess: list[float], left: float) -> int | None:
    """The period at which so much is left of the excess, us; None if unknown."""
    if not np.isfinite(excess).all():
        return None
    # A longer period always explains more; what noise makes otherwise is evened out.
    falling = np.minimum.accumulate(excess)
    return round(float(np.interp(-left, -falling, periods)))


def _excess(seen: _Seen, index: int) -> float:
    """By which share events that follow soon tell more than late ones; nan if unknown."""
    parted = _parted(seen, index)
    return np.nan if parted is None else parted.excess


def _too_large(seen: _Seen, index: int, known: Usual) -> float:
    """By which share the thresholds that explain the frames are larger than the known ones; nan if unknown."""
    fit = two_stage(seen.steps.change, seen.explained(index), seen.counts_around(index))
    return np.nan if fit is None else float(np.mean(fit.solution[:2] / known[:2])) - 1.0


class PlainFit(NamedTuple):
    """Thresholds (on, off) that fit best, log intensity, and the robust standard deviation of what they leave."""

    on: float
    off: float
    residual: float


def fit_thresholds(difference: Array, on: Array, off: Array) -> PlainFit | None:
    """Thresholds by iteratively reweighted least squares; None if one is not determined.

    ``difference`` (N,) log intensity; ``on``, ``off`` (N,) event counts.
    """
    design = np.column_stack([on, -off])
    weights = np.ones(len(difference))
    solution: Array = np.zeros(2)
    scale = 0.0
    for _ in range(20):
        weighted = design * weights[:, None]
        normal = weighted.T @ design
        if np.linalg.cond(normal) > 1e8:
            return None
        previous = solution
        solution = np.linalg.solve(normal, weighted.T @ difference).astype(np.float64)
        residual = difference - design @ solution
        scale = NORMAL_MAD * float(np.median(np.abs(residual)))
        if scale < 1e-9:
            break  # an exact fit: nothing to weigh down
        weights = np.minimum(1.0, HUBER * scale / np.maximum(np.abs(residual), 1e-12))
        if np.abs(solution - previous).max() < 1e-5:
            break
    if not (solution > 0).all():
        return None
    return PlainFit(float(solution[0]), float(solution[1]), scale)
