"""The sensor's thresholds and refractory period, for a reconstruction: log frame differences against event counts.

Counts of events have errors: noise events, lost events, changes below the threshold. In ordinary least squares errors
of the regressors make thresholds too small (attenuation), and 0 where nothing moves. Two-stage least squares avoids
this by instruments, which are correlated with the counts but not with their errors. There are two kinds:

- The mean counts of the eight neighbours, which see the same edges. They have more information. They are biased where
  the errors of neighbours are correlated, as those of flickering lamps are, and where frames show a range of only a few
  thresholds: pixels are used if both frames show them well, and among these are too many whose counts are too large.
- The mean change of the neighbours between the frames. It has nothing to do with errors of events, and the selection by
  frames does not bias it. But changes too small for an event make thresholds too large.

Each kind has a variance for its bias. The two results and the usual thresholds are combined by Bayes' rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.delay import DelayEstimate, in_thresholds, vertex
from kalux.calibration.intervals import APART, APART_IN_TIME
from kalux.calibration.refractory import LATE, Period, intervals, possible_periods
from kalux.calibration.regression import Fit, halves, products, robust_deviation, standard_errors, two_stage
from kalux.calibration.steps import MAX_SAMPLES, Steps, steps
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings

Array = NDArray[np.float64]

_MIN_SAMPLES: Final = 200
_SHORTEST_EVENTS: Final = 500_000
"""Events from which the shortest interval is taken: some 10,000 intervals then lie at its edge."""

ROUGH_SAMPLES: Final = 10_000
"""Pixels for each delay that is tried: on twenty scenes and recordings the best delay is then within 0.2 ms of that of
more pixels. Also for the thresholds with which I_0 is estimated: they are then within 1 %, and two frame intervals have
so many pixels."""

_TRAILING: Final = (0, 2_000, 4_000, 6_000)
"""us by which the apparent delay mostly exceeds the true one: 0.9 to 5.9 ms on forty scenes whose true delay is 0."""

_MOST_TRAILING: Final = 14_000
"""us by which it may: events of slow light trail it for longer. Steps are spread over 15 ms at most."""

_PERIOD_SAMPLES: Final = 30_000
"""Pixels for the refractory period: the standard error of the excess is then 0.02 on scenes where changes are lost."""

_COUNTS_ERROR: Final = 0.02
"""Relative error of thresholds from the neighbours' counts, beside the statistical one: -1.3 to 4.3 %, 1.6 % in the
root mean square, on seventeen simulated scenes."""

_COMMON: Final = 0.1
"""Share of what frames do not explain in the neighbours' counts that may be common to neighbours."""

_CHANGES_ERROR: Final = 0.1
"""Relative error of thresholds from the neighbours' changes in frames, beside the statistical one: they are 0 to 3 %
larger than those from counts on seventeen simulated scenes, and 2 to 9 % on three real recordings."""

_SMALL_CHANGES: Final = 0.12
"""The same where frames change by one threshold in the root mean square; it goes as the square of thresholds over
changes. Of 41 simulated scenes, whole and cut to ten ranges, 0.06 there and 0.33 at half a threshold."""

_NARROW_COUNTS: Final = 0.4
"""Relative error of thresholds from the neighbours' counts where frames change by one threshold in the root mean square
and all pixels are lost from one to the next: by the share that is lost, times the third power of thresholds over
changes. Of the same scenes, 0.10 there and 0.43 at half a threshold, where half or more is lost."""

_ROUGH_INTERVALS: Final = 2
_INTERVALS: Final = 4
"""Least number of frame intervals that samples are taken from, if there are so many: what moves differs between them
more than between pixels of one."""

_PRIOR_REACH: Final = 6.0  # standard deviations, or a factor of 400
_PRIOR_POINTS: Final = 1201  # 0.005 apart with the usual spread, a quarter of the least error

_LEAST_EXCESS: Final = 0.05
"""Least excess of the steps of events that follow soon over those of late ones, less two standard errors, from which
changes count as lost in the refractory period. Where nothing is lost it is -0.02 to 0.05 on twelve simulated scenes and
-0.18 +- 0.05, 0.12 +- 0.06 and -0.02 +- 0.08 on three recordings; with 0.2 to 2 ms it is 0.12 to 0.92 on eight scenes.
The limit is low because a period that is missed costs more than one that is assumed wrongly: 0.2 ms change the held-out
errors of the three recordings by 5 % to the better and 2 % to the worse."""

_USUAL_EXCESS: Final = 0.02
"""Where nothing is lost. Under the true period it is 0.03 +- 0.04 on nine scenes with 1 and 2 ms."""

_HIDDEN: Final = 1.04
"""Over the period under which events that follow soon are worth as much as late ones: of these something is hidden,
too. With it events tell in sum what the light did (docs/equations.md, K13)."""

_LEAST_STEPS: Final = 1e-9  # log intensity: nothing to divide by

_THRESHOLD_OF_EXCESS: Final = 0.6
"""Relative error of thresholds over that of the excess: lost changes make the thresholds of seven scenes too large by
0.3 to 0.63 of the excess."""

_LEAST_DOUBT: Final = 0.02
"""Least relative error of thresholds, by changes that may be lost, that matters: that of the least excess."""

_PERIOD_ERRORS: Final = 3.0
"""Standard errors of the excess, as its regression tells them, that the refractory period is taken to be off by. Pixels
beside one another err alike: on 41 simulated scenes it is 4 to 5 of them, and 5 % of the period. More than 3 takes from
highlights of those whose period is right as much as it mends of the others (docs/equations.md, K10)."""

_LARGEST_SPREAD: Final = 1.0  # relative: nothing is known of the refractory period

_LEAST_MISSING: Final = 0.1
"""Logarithm of the factor by which known thresholds seem too large, from which a period is found by what events are
worth in sum. Of seven simulated scenes with less it is found 13 to 92 % too short, of 59 others up to 22 % too short
and 14 % too long, 7 % in the root mean square."""

_EVEN: Final = -0.01
"""The same under the true period. On three scenes in which nothing is lost events seem to be worth 3 to 6 % too much;
with 0, periods that hide little (up to 0.2 of the logarithm) are found 5 % too short in the median of 16 scenes."""

_SUMS_ERROR: Final = 0.03
_WORTH_ERROR: Final = 0.025
"""Relative errors, of the period found in this way and of the thresholds that it is found by: together 0.06 where these
seem half too large, as large as on 33 scenes, and more the less is hidden."""

_ROUGH: Final = 0.09
"""Relative error from which this period counts only if the other one's is larger: thresholds seem less than a third too
large. In a dark scene with 1 ms (1.25 times too large) it is 1.24 ms, and 1.05 ms by late events and others."""

_EXCESS_ERROR: Final = 0.06
"""Relative error of the period by late events and others, beside that which their regression tells: 7 % in the root
mean square on 82 simulated scenes, more on six others."""

_BETTER: Final = 0.95
"""Share of the residual by larger thresholds that a period may leave to be believed; either has one number to explain
it. 0.40 to 0.94 on the 59 scenes. On five others with 1 to 3 ms, of which neither explains much, 0.98 to 1.08."""

_LARGEST_SHORTEST: Final = 5_000
"""us: where events of a pixel are never closer, little is lost in the refractory period of any sensor, at most 2 ms."""


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
    refractory_spread
        Its relative standard deviation, as far as it matters; 0 where it is given, or 0.
    delay
        How much later than the frames' clock events were taken to be stamped, us.
    delay_found
        Whether that is what explains the frames best; else it is the apparent one less the usual trailing.
    doubt
        Relative error of thresholds that comes from that of the refractory period; a part of ``spread``.
    shortest_interval
        How soon a pixel can follow one event by another, us (`kalux.calibration.refractory`); 0: not known, or not
        looked for, as where the refractory period is given or events pile up at its end.
    longest_period
        The longest refractory period that light leaves possible, us; 0: not known.
    """

    on: float
    off: float
    residual: float
    samples: int
    spread: float
    usual_share: float
    refractory_period: int
    refractory_spread: float
    delay: int
    delay_found: bool
    doubt: float
    shortest_interval: int
    longest_period: int

    @property
    def may_lose(self) -> bool:
        """Whether changes are lost in the refractory period, or the estimate cannot exclude it."""
        return self.refractory_period > 0 or self.doubt > _LEAST_DOUBT


class Usual(NamedTuple):
    """What thresholds usually are, log intensity, and their relative standard deviation."""

    on: float
    off: float
    spread: float

    @classmethod
    def of(cls, events: EventSettings) -> Usual:
        """Those of the settings: known ones if there are, with a spread of 0."""
        if events.has_thresholds:
            return cls(*events.thresholds, 0.0)
        return cls(events.usual_threshold_on, events.usual_threshold_off, events.usual_spread)


def estimate_thresholds(
    recording: Recording,
    camera: CameraSettings,
    usual: Usual,
    *,
    of_log_offset: bool = False,
    delay: int = 0,
    refractory_period: int | None = 0,
    most: int = MAX_SAMPLES,
) -> ThresholdEstimate | None:
    """Global on and off thresholds, and the refractory period, by robust regression of frame changes on event counts.

    For pixels that are well exposed in two successive frames: log(I' + I_0) - log(I + I_0) = s (c_on n_on - c_off
    n_off), with s = I / (I + I_0) the share of a step of log I that shows in log(I + I_0), and n the steps up and down
    that lie between the frames, spread over time and weighted (`kalux.calibration.steps`). Looks at the
    first 200 frames, or at fewer when those give enough pixels.

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
        How much later than the frames' clock events seem to be, us (`kalux.calibration.delay`): what of it is due to
        the half threshold by which they trail the light, 0 to 15 ms, is found and taken off.
    refractory_period
        Of the pixels, us: what is lost in it is added to the events (docs/equations.md, K13). None: to be found.
    most
        Pixels that are enough.

    Returns None where the recording has too few such pixels (200), e.g. because nothing moves.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    shortest, longest = (0, 0) if refractory_period is not None else _possible_with_reset(recording)
    about_true = delay - _TRAILING[1]  # to begin with: trailing is mostly about so long
    sampling = _Sampling(recording, camera, of_log_offset, about_true, False, shortest, longest, (0.0, 0.0))
    period = refractory_period or 0
    if usual.spread == 0:
        sampling = sampling._replace(thresholds=(usual.on, usual.off))
    else:  # what the light does within exposures needs thresholds
        rough = _combined(sampling.samples(period, most=ROUGH_SAMPLES), usual, Period(period), sampling, 0.0)
        sampling = sampling if rough is None else sampling._replace(thresholds=(rough.on, rough.off))
    sampling = sampling.without_trailing(delay, period)
    return _estimate(sampling, usual, refractory_period, most, delay)


def with_true_delay(
    recording: Recording,
    camera: CameraSettings,
    apparent: DelayEstimate,
    usual: Usual,
    *,
    of_log_offset: bool = False,
    refractory_period: int = 0,
) -> DelayEstimate:
    """A delay estimate completed by the true delay, where an estimate of the thresholds finds that.

    ``apparent`` is what `kalux.calibration.delay.estimate_delay` has found. The other parameters are those of
    `estimate_thresholds`.
    """
    found = estimate_thresholds(
        recording,
        camera,
        usual,
        of_log_offset=of_log_offset,
        delay=apparent.apparent,
        refractory_period=refractory_period,
        most=ROUGH_SAMPLES,
    )
    return apparent if found is None or not found.delay_found else apparent._replace(true=found.delay)


def _possible_with_reset(recording: Recording) -> tuple[int, int]:
    """Shortest interval between two events of a pixel, and the longest refractory period that light leaves possible,
    us; 0 where events wait for the end of the refractory period, in which nothing is lost then."""
    found = intervals(recording, _SHORTEST_EVENTS)
    return (0, 0) if found.pile_up else (found.shortest, found.longest_period)


def refine_thresholds(
    recording: Recording,
    camera: CameraSettings,
    usual: Usual,
    rough: ThresholdEstimate,
    *,
    of_log_offset: bool = False,
    refractory_period: int | None = 0,
) -> ThresholdEstimate:
    """The thresholds with another I_0 than a ``rough`` estimate, of which the delay is kept: it does not depend on I_0.

    Parameters are those of `estimate_thresholds`, by which ``rough`` was made with the same ``refractory_period``.
    """
    thresholds = rough.on, rough.off
    possible = rough.shortest_interval, rough.longest_period
    sampling = _Sampling(
        recording, camera, of_log_offset, rough.delay, rough.delay_found, *possible, thresholds
    )
    if refractory_period is not None or rough.refractory_period == 0:
        return _estimate(sampling, usual, refractory_period, MAX_SAMPLES, None) or rough
    found = _with_period(sampling, usual, None, by_excess=True)
    period = Period(rough.refractory_period, rough.refractory_spread) if found is None else found[1]
    samples = sampling.samples(period.length, most=MAX_SAMPLES)
    return _combined(samples, usual, period, sampling, rough.doubt) or rough


def _estimate(
    sampling: _Sampling, usual: Usual, refractory_period: int | None, most: int, delay: int | None
) -> ThresholdEstimate | None:
    """Thresholds, and the refractory period if it is not given; None where there are too few pixels.

    ``delay`` is the apparent one, us: what is lost in the refractory period makes events seem late, too, so that the
    delay is found again with the period. None: that of the sampling is right.
    """
    given = Period(refractory_period or 0)
    samples = sampling.samples(given.length, most=most)
    if len(samples.steps.change) < _MIN_SAMPLES:
        return None
    if not 0 < sampling.shortest <= _LARGEST_SHORTEST:
        return _combined(samples, usual, given, sampling, 0.0)
    excess = _measured_excess(samples, _fit_late_and_soon(samples, 0))
    # Thresholds may be too large by this even where the excess is too uncertain to be corrected.
    doubt = _THRESHOLD_OF_EXCESS * max(excess.value - _USUAL_EXCESS, 0.0)
    estimate = _combined(samples, usual, given, sampling, doubt)
    if estimate is None:
        return None
    by_excess = excess.value - 2 * excess.error > _LEAST_EXCESS
    found = _with_period(sampling, usual, delay, by_excess=by_excess)
    if found is None:
        return estimate
    sampling, period = found
    doubt = _THRESHOLD_OF_EXCESS * float(np.hypot(excess.error, _USUAL_EXCESS))
    return _combined(sampling.samples(period.length, most=most), usual, period, sampling, doubt) or estimate


def _with_period(
    sampling: _Sampling, usual: Usual, delay: int | None, *, by_excess: bool
) -> tuple[_Sampling, Period] | None:
    """The refractory period, and the sampling with the true delay under it; None where nothing speaks for one.

    Parameters are those of `_period`; ``delay`` is that of `_estimate`.
    """
    period = None
    for _ in range(2 if delay is not None else 1):
        period = _period(sampling, usual, by_excess=by_excess)
        if period is None:
            return None
        sampling = sampling if delay is None else sampling.without_trailing(delay, period.length)
    assert period is not None
    return sampling, period


def _period(sampling: _Sampling, usual: Usual, *, by_excess: bool) -> Period | None:
    """The refractory period; None where nothing speaks for one.

    By late events and those that follow soon, if they differ, ``by_excess``, and by what all events are worth where
    thresholds are known; by both in proportion to what they tell. No longer than light leaves possible.
    """
    known = usual.spread == 0
    if not (by_excess or known):
        return None
    periods = possible_periods(sampling.shortest)
    samples = sampling.samples(*periods, most=_PERIOD_SAMPLES)
    of_excess = _period_without_excess(samples, periods) if by_excess else None
    of_sums = _period_of_sums(sampling, samples, periods) if known else None
    found = of_excess or of_sums
    if of_excess is not None and of_sums is not None:
        found = _joined(of_excess, of_sums)
    if found is None or not 0 < sampling.longest < found.length:
        return found
    return found._replace(length=sampling.longest)


def _joined(of_excess: Period, of_sums: Period) -> Period:
    """The period that two estimates tell, whose errors have nothing to do with one another.

    Where much is hidden both count, in proportion to their information, else the one whose error is less.
    """
    errors = np.hypot(of_excess.spread, _EXCESS_ERROR), of_sums.spread
    if of_sums.spread > _ROUGH:
        return of_excess if errors[0] < errors[1] else of_sums
    information = 1 / np.square(errors)
    length = float(np.exp(information @ np.log([of_excess.length, of_sums.length]) / information.sum()))
    return Period(round(length), float(information.sum() ** -0.5))


class _Sampling(NamedTuple):
    """How pixels and their events are sampled from a recording.

    Attributes
    ----------
    recording, camera, of_log_offset
        As in `estimate_thresholds`.
    delay, delay_found
        Of the events, us, and whether it is known.
    shortest
        Shortest interval between two events of a pixel, us; 0 where the refractory period is not to be found.
    longest
        The longest refractory period that light leaves possible, us; 0: unknown.
    thresholds
        On and off, log intensity: by these the intensity moves within exposures.
    """

    recording: Recording
    camera: CameraSettings
    of_log_offset: bool
    delay: int
    delay_found: bool
    shortest: int
    longest: int
    thresholds: tuple[float, float]

    def samples(self, *periods: int, most: int) -> _Samples:
        """Samples under refractory periods, us."""
        return self._of_delays((self.delay,), periods, most, APART)[0]

    def without_trailing(self, delay: int, period: int) -> _Sampling:
        """With the true delay in place of the apparent ``delay``, us.

        The apparent one includes the time that the light needs for half a threshold, by which events trail it. Steps
        that are spread over time (`steps`) do not trail: the delay under which they explain the frames best is true.
        """
        tried, step = list(_TRAILING), _TRAILING[1]

        def residuals_of(trailing: Sequence[int]) -> list[float]:
            delays = tuple(delay - each for each in trailing)
            return [
                samples.residual()
                for samples in self._of_delays(delays, (period,), ROUGH_SAMPLES, APART_IN_TIME)
            ]

        residuals = residuals_of(tried)
        while np.isfinite(residuals).all() and residuals[-1] <= min(residuals) and tried[-1] < _MOST_TRAILING:
            tried.append(tried[-1] + step)
            residuals += residuals_of(tried[-1:])
        if not np.isfinite(residuals).all():
            return self
        least = int(np.argmin(residuals))
        middle = min(max(least, 1), len(tried) - 2)
        found = vertex(*residuals[middle - 1 : middle + 2])
        best = tried[least] if found is None else tried[middle] + step * found
        if best >= tried[-1] + step / 2:  # no delay explains the frames
            return self
        return self._replace(delay=delay - round(max(best, 0.0)), delay_found=True)

    def _of_delays(
        self, delays: tuple[int, ...], periods: tuple[int, ...], most: int, apart: int
    ) -> list[_Samples]:
        """Samples under each of the delays, us."""
        at_least = _ROUGH_INTERVALS if most <= ROUGH_SAMPLES else _INTERVALS
        late = LATE * self.shortest if self.shortest else np.inf
        found = steps(
            self.recording,
            self.camera,
            delays=delays,
            periods=periods,
            late=late,
            thresholds=self.thresholds,
            of_log_offset=self.of_log_offset,
            most=most,
            at_least=at_least,
            apart=apart,
        )
        return [_Samples(one, self.recording.sensor_size) for one in found]


class _Samples(NamedTuple):
    """Samples, and the size of the sensor; columns of regressions on them."""

    steps: Steps
    sensor_size: tuple[int, int]

    def columns(self, events: Array, index: int) -> Array:
        """(N, 2) what explains changes under a refractory period: steps upwards and downwards."""
        late, soon = events[:, index, 0], events[:, index, 1]  # NumPy's sum over so short an axis is slow
        return np.asarray((late + soon) * np.array([1.0, -1.0]) * self.steps.share[:, None], np.float64)

    def residual(self) -> float:
        """Residual of the regression by frames under the first refractory period, in thresholds; nan: undetermined."""
        if len(self.steps.change) < _MIN_SAMPLES:
            return np.nan
        fit = two_stage(self.steps.change, self.explained(0), self.changes_around())
        return in_thresholds(fit) if fit is not None and (fit.solution > 0).all() else np.nan

    def explained(self, index: int) -> Array:
        """(N, 2) what explains the pixels' own changes under a refractory period."""
        return self.columns(self.steps.events, index)

    def counts_around(self, index: int) -> Array:
        """(N, 2) the same of their neighbours."""
        return self.columns(self.steps.events_around, index)

    def fit_by_counts(self, index: int) -> Fit | None:
        """The regression of the pixels' changes on their events, by their neighbours', under a refractory period."""
        return two_stage(self.steps.change, self.explained(index), self.counts_around(index))

    def changes_around(self) -> Array:
        """(N, 2) the neighbours' changes, upwards and downwards."""
        return halves(self.steps.change_around)


class _LogThresholds(NamedTuple):
    """Logs of the thresholds on and off, and their variances, (2,) each; inf where nothing is known."""

    logs: Array
    variances: Array


def _combined(
    samples: _Samples, usual: Usual, period: Period, sampling: _Sampling, doubt: float
) -> ThresholdEstimate | None:
    """Thresholds from either kind of instruments and the usual ones, combined by Bayes' rule (`_posterior`).

    ``doubt`` is the relative error of the thresholds that is due to the error of the refractory ``period``.
    """
    change, explained = samples.steps.change, samples.explained(0)
    counts, changes = samples.counts_around(0), samples.changes_around()
    by_counts, by_changes = (two_stage(change, explained, instruments) for instruments in (counts, changes))
    fits = [fit for fit in (by_counts, by_changes) if fit is not None]
    if not fits:
        return None
    model = np.hypot(_COUNTS_ERROR, doubt)
    common = np.log1p(_COMMON * _unexplained(samples, by_counts, counts)) if by_counts is not None else np.inf
    of_counts = _fitted(samples, by_counts, explained, counts, float(np.hypot(common, model)))
    of_changes = _fitted(samples, by_changes, explained, changes, float(np.hypot(_CHANGES_ERROR, doubt)))
    moved, lost = float(np.sqrt(np.mean(change**2))), float(np.mean(samples.steps.lost))
    known = _posterior(usual, of_counts, of_changes, moved, lost)
    on, off = np.exp(known.logs)
    return ThresholdEstimate(
        on=float(on),
        off=float(off),
        residual=fits[0].residual,
        samples=len(change),
        spread=float(np.sqrt(np.mean(known.variances))),
        usual_share=float(np.mean(np.minimum(known.variances / max(usual.spread**2, 1e-12), 1.0))),
        refractory_period=period.length,
        refractory_spread=period.spread,
        delay=sampling.delay,
        delay_found=sampling.delay_found,
        doubt=doubt,
        shortest_interval=sampling.shortest,
        longest_period=sampling.longest,
    )


def _posterior(
    usual: Usual, of_counts: _LogThresholds, of_changes: _LogThresholds, moved: float, lost: float
) -> _LogThresholds:
    """Posterior mean and variance of the logs of the thresholds: the usual ones are the prior, both fits the data.

    ``moved`` is the root mean square of the frames' changes, ``lost`` the share of pixels that only one of two frames
    shows well. The errors of the fits depend on how many of the true thresholds ``moved`` is: where frames change
    little, large thresholds may look small, but hardly small ones large.
    """
    expected = np.log([usual.on, usual.off])
    if usual.spread == 0:
        return _LogThresholds(expected, np.zeros(2))
    reach = min(_PRIOR_REACH * usual.spread, _PRIOR_REACH)
    logs = expected[:, None] + np.linspace(-reach, reach, _PRIOR_POINTS)
    narrow = np.exp(logs) / max(moved, 1e-6)
    counts = of_counts.variances[:, None] + np.square(_NARROW_COUNTS * lost * narrow**3)
    changes = of_changes.variances[:, None] + np.square(_SMALL_CHANGES * narrow**2)
    # The counts are to blame where the fits differ by more than their errors: neighbours share noise, or frames do not
    # show all.
    apart = np.square(of_counts.logs - of_changes.logs)[:, None] - 4 * (counts + changes)
    counts += np.maximum(apart, 0.0)
    loss = np.square((logs - expected[:, None]) / usual.spread)
    for fitted, variances in ((of_counts, counts), (of_changes, changes)):
        information = 1 / np.minimum(variances, 1e9)
        loss += information * np.square(fitted.logs[:, None] - logs) - np.log(information)
    weights = np.exp(0.5 * (loss.min(axis=1, keepdims=True) - loss))
    weights /= weights.sum(axis=1, keepdims=True)
    mean = (weights * logs).sum(axis=1)
    return _LogThresholds(mean, (weights * np.square(logs - mean[:, None])).sum(axis=1))


def _fitted(
    samples: _Samples, fit: Fit | None, explained: Array, instruments: Array, error: float
) -> _LogThresholds:
    """The thresholds of a regression, with ``error`` its relative error beside the statistical one."""
    if fit is None:
        return _LogThresholds(np.zeros(2), np.full(2, np.inf))
    observed = samples.steps
    errors = standard_errors(
        observed.change, explained, instruments, fit.weights, observed.pixel, samples.sensor_size
    )
    found = fit.solution[:2]
    positive = found > 0
    logs = np.log(np.where(positive, found, 1.0))
    variances = (errors[:2] / np.where(positive, found, 1.0)) ** 2 + error**2
    return _LogThresholds(logs, np.where(positive, variances, np.inf))


def _unexplained(samples: _Samples, fit: Fit, counts: Array) -> float:
    """Mean square of the part of the neighbours' counts that their frames do not explain, over that of the rest."""
    predicted = np.abs(fit.solution[0]) * counts[:, 0] + np.abs(fit.solution[1]) * counts[:, 1]
    change = samples.steps.change_around
    both = np.stack([predicted, change])
    (of_counts, common), (_, of_frames) = products(both, both).tolist()
    return float(of_counts * of_frames / max(common**2, 1e-12)) - 1.0


class _LateAndSoon(NamedTuple):
    """A regression on late events and on those that follow soon, both in units of the thresholds.

    An event is late if it comes `LATE` shortest intervals after the pixel's previous one, or more: the refractory
    period was over long before it, and little of its step is lost. The step of one that follows soon has in it what the
    light did in the refractory period before, and looks larger.
    """

    explained: Array
    instruments: Array
    fit: Fit

    @property
    def excess(self) -> float:
        """By which share the step of an event that follows soon is larger than that of a late one."""
        return float(self.fit.solution[1] / self.fit.solution[0]) - 1.0


class _Excess(NamedTuple):
    """`_LateAndSoon.excess` and its standard error; 0 and inf where it is not determined."""

    value: float
    error: float


def _measured_excess(samples: _Samples, found: _LateAndSoon | None) -> _Excess:
    """The excess of a regression on the samples, with its standard error."""
    if found is None:
        return _Excess(0.0, np.inf)
    known, fit = samples.steps, found.fit
    late, soon = standard_errors(
        known.change, found.explained, found.instruments, fit.weights, known.pixel, samples.sensor_size
    )
    return _Excess(found.excess, float(np.hypot(late, soon) / fit.solution[0]))


def _fit_late_and_soon(samples: _Samples, index: int, *, by_changes: bool = False) -> _LateAndSoon | None:
    """The regression under a refractory period, by its index; None where it is not determined.

    The neighbours tell by their events, or ``by_changes``: by their changes in frames, split as their steps are.
    """
    known = samples.steps
    fit = samples.fit_by_counts(index)
    if fit is None:
        return None
    on, off = fit.solution

    def columns(events: Array) -> Array:
        steps_of = on * events[:, index, :, 0] - off * events[:, index, :, 1]
        return np.asarray(steps_of * known.share[:, None], np.float64)

    explained, instruments = columns(known.events), columns(known.events_around)
    if by_changes:
        steps_around = np.abs(instruments)
        total = np.maximum(steps_around.sum(axis=1, keepdims=True), _LEAST_STEPS)
        instruments = known.change_around[:, None] * steps_around / total
    again = two_stage(known.change, explained, instruments)
    return None if again is None or not again.solution[0] > 0 else _LateAndSoon(explained, instruments, again)


def _period_without_excess(samples: _Samples, periods: tuple[int, ...]) -> Period | None:
    """The refractory period under which events that follow soon have the steps of late ones; None if unknown, or 0.

    Of the ``samples`` under several ``periods``, us.
    """
    fits = [_fit_late_and_soon(samples, index, by_changes=True) for index in range(len(periods))]
    known = [fit for fit in fits if fit is not None]
    excess = np.array([fit.excess for fit in known])
    if len(known) < len(periods) or not np.isfinite(excess).all():
        return None
    # A longer period explains more of the excess; what does not decrease is noise.
    falling = np.minimum.accumulate(excess)
    even = float(np.interp(0.0, -falling, periods))
    length = round(_HIDDEN * even)
    if length == 0:
        return None
    after = int(np.clip(np.searchsorted(periods, even), 1, len(periods) - 1))
    around = slice(after - 1, after + 1)
    slope = -np.diff(falling[around]).item() / np.diff(periods[around]).item()
    errors = [_measured_excess(samples, fit).error for fit in known[around]]
    error = float(np.interp(even, periods[around], errors))
    told = slope > 0 and np.isfinite(error)
    spread = _PERIOD_ERRORS * error / (slope * even) if told else _LARGEST_SPREAD
    return Period(length, min(spread, _LARGEST_SPREAD))


def _period_of_sums(sampling: _Sampling, samples: _Samples, periods: tuple[int, ...]) -> Period | None:
    """The refractory period under which all events are worth the thresholds, which are known; None if there is none.

    Where light is fast, few events are late, and these have lost something, too, so that those that follow soon are
    worth no more (`_period_without_excess`). In sum events then tell too little, and thresholds seem larger than they
    are known to be. A period is believed if it explains the frames better than larger thresholds do.

    Of the ``samples`` of a ``sampling`` under several ``periods``, us.
    """
    known = np.array(sampling.thresholds)
    if len(samples.steps.change) < _MIN_SAMPLES:
        return None
    fits = [samples.fit_by_counts(index) for index in range(len(periods))]
    found = [fit for fit in fits if fit is not None and (fit.solution > 0).all()]
    if len(found) < len(periods):
        return None
    # By how much thresholds seem too large, as a logarithm. A longer period explains more; what rises is noise.
    missing = np.minimum.accumulate([np.log(fit.solution / known).mean() for fit in found])
    if not missing[-1] < _EVEN < _LEAST_MISSING < missing[0]:
        return None
    length = round(float(np.interp(-_EVEN, -missing, periods)))
    told = sampling.samples(length, most=_PERIOD_SAMPLES)
    unexplained = robust_deviation(told.steps.change - told.explained(0) @ known)
    if not unexplained < _BETTER * found[0].residual:
        return None
    return Period(length, float(np.hypot(_SUMS_ERROR, _WORTH_ERROR / missing[0])))
