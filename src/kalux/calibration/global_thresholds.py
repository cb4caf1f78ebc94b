"""The sensor's thresholds and refractory period, for a reconstruction: log frame differences against event counts.

Counts of events are wrong: by noise, by events that are lost, by what is not told yet. Least squares would take their
errors for smaller thresholds (attenuation), down to nothing where nothing moves. Two kinds of instruments do not: the
mean counts of the eight neighbours, which see the same edges with errors of their own, and the mean change of the
neighbours as the frames show it.

The first tell more, and are right where the noise of neighbours is not the same; where little moves and lamps flicker
it is. And only pixels that both frames show well are seen: where frames show a range of a few thresholds, these are
pixels of which counts say too much, and thresholds come out too small. The second are what the pixels are selected by,
so that it does not bias them, nor do they care what noise events have; but changes too small for an event make
thresholds too large. Each has a variance for that, the usual thresholds have theirs, and all are combined by Bayes'
rule.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.delay import DelayEstimate, in_thresholds, vertex
from kalux.calibration.refractory import LATE, intervals, possible_periods
from kalux.calibration.regression import Fit, halves, products, standard_errors, two_stage
from kalux.calibration.steps import MAX_SAMPLES, Steps, steps
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings

Array = NDArray[np.float64]

_MIN_SAMPLES: Final = 200
_SHORTEST_EVENTS: Final = 500_000
"""Of which the shortest interval is taken: its edge is then that of 10,000 pairs."""

ROUGH_SAMPLES: Final = 10_000
"""Pixels for one delay, of which the best is then within 0.2 ms of that of more on twenty scenes and recordings, and
for thresholds that I_0 is to be found with: these are then within 1 %, and two intervals have them."""

_TRAILING: Final = (0, 2_000, 4_000, 6_000)
"""us by which events may seem later than they are: 0.9 to 5.9 ms on forty scenes whose events are in time."""

_PERIOD_SAMPLES: Final = 30_000
"""Pixels for the refractory period: what is not known of the excess is then 0.02 on scenes where something is lost."""

_MODEL: Final = 0.02
"""Relative error of thresholds from the neighbours' counts, beside the statistical one: -1.3 to 4.3 %, 1.6 % in the
root mean square, on seventeen simulated scenes."""

_SHARED: Final = 0.1
"""Share of what frames do not explain in the neighbours' counts that may be common to neighbours."""

_SUBTHRESHOLD: Final = 0.1
"""Relative error of thresholds from the neighbours' changes in frames, beside the statistical one: they are 0 to 3 %
larger than those from counts on seventeen simulated scenes, and 2 to 9 % on three real recordings."""

_SMALL_CHANGES: Final = 0.12
"""The same where frames change by one threshold in the root mean square; it goes as the square of thresholds over
changes. Of 41 simulated scenes, whole and cut to ten ranges, 0.06 there and 0.33 at half a threshold."""

_NARROW_COUNTS: Final = 0.4
"""Relative error of thresholds from the neighbours' counts where frames change by one threshold in the root mean square
and all pixels are lost from one to the next: by the share that is lost, times the third power of thresholds over
changes. Of the same scenes, 0.10 there and 0.43 at half a threshold, where half or more is lost."""

_PRIOR_REACH: Final = 6.0  # standard deviations, or a factor of 400
_PRIOR_POINTS: Final = 1201  # 0.005 apart with the usual spread, a quarter of the least error

_LEAST_EXCESS: Final = 0.05
"""By how much more events that follow soon must tell than late ones, two standard errors taken off, for something to be
lost in the refractory period. Where nothing is lost it is -0.02 to 0.05 on twelve simulated scenes and -0.18 +- 0.05,
0.12 +- 0.06 and -0.02 +- 0.08 on three recordings, with 0.2 to 2 ms 0.12 to 0.92 on eight scenes. What is lost and not
believed costs more than what is believed and not lost: 0.2 ms change the held-out errors of the three recordings by 5 %
to the better and 2 % to the worse."""

_USUAL_EXCESS: Final = 0.02  # where nothing is lost

_THRESHOLD_OF_EXCESS: Final = 0.6
"""Relative error of thresholds over that of the excess: what is lost makes thresholds of seven scenes by 0.3 to 0.63 of
the excess too large."""

_LEAST_DOUBT: Final = 0.02
"""Of thresholds, by what may be lost: that of an excess that would be believed if it were exact."""

_LARGEST_SHORTEST: Final = 5_000
"""us: of pixels that never follow sooner little is lost in the refractory period of any sensor, some 2 ms at most."""


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
    delay
        How much later than the frames' clock events were taken to be stamped, us.
    doubt
        Relative error of thresholds that comes from that of the refractory period; a part of ``spread``.
    shortest_interval
        How soon a pixel can follow one event by another, us (`kalux.calibration.refractory`); 0: not known, or not
        looked for, as where the refractory period is given or events pile up at its end.
    """

    on: float
    off: float
    residual: float
    samples: int
    spread: float
    usual_share: float
    refractory_period: int
    delay: int
    doubt: float
    shortest_interval: int

    @property
    def may_lose(self) -> bool:
        """Whether something is lost in the refractory period, or may be as far as this estimate can tell."""
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
        the half threshold by which they trail the light, 0 to 6 ms, is found and taken off.
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
    shortest = 0 if refractory_period is not None else _reset_after(recording)
    view = _View(recording, camera, of_log_offset, delay - _TRAILING[1], shortest, (0.0, 0.0))
    period = refractory_period or 0
    if usual.spread == 0:
        view = view._replace(thresholds=(usual.on, usual.off))
    else:  # what the light does within exposures needs thresholds
        rough = _by_information(view.seen(period, most=ROUGH_SAMPLES), usual, period, view, 0.0)
        view = view if rough is None else view._replace(thresholds=(rough.on, rough.off))
    view = view.without_trailing(delay, period)
    return _estimate(view, usual, refractory_period, most, delay)


def with_true_delay(
    recording: Recording,
    camera: CameraSettings,
    late: DelayEstimate,
    usual: Usual,
    *,
    of_log_offset: bool = False,
    refractory_period: int = 0,
) -> DelayEstimate:
    """How late events are, of how late they seem, where an estimate of the thresholds finds it.

    Parameters are those of `estimate_thresholds`.
    """
    found = estimate_thresholds(
        recording,
        camera,
        usual,
        of_log_offset=of_log_offset,
        delay=late.apparent,
        refractory_period=refractory_period,
        most=ROUGH_SAMPLES,
    )
    return late if found is None else late._replace(true=found.delay)


def _reset_after(recording: Recording) -> int:
    """Shortest interval, us, up to which a refractory period may hide something; 0 where events wait for its end."""
    found = intervals(recording, _SHORTEST_EVENTS)
    return 0 if found.pile_up else found.shortest


def refine_thresholds(
    recording: Recording,
    camera: CameraSettings,
    usual: Usual,
    rough: ThresholdEstimate,
    *,
    of_log_offset: bool = False,
    refractory_period: int | None = 0,
) -> ThresholdEstimate:
    """The thresholds with another I_0 than that of a rough estimate, whose delay is right whatever I_0 is.

    Parameters are those of `estimate_thresholds`, by which ``rough`` was made with the same ``refractory_period``.
    """
    thresholds = rough.on, rough.off
    view = _View(recording, camera, of_log_offset, rough.delay, rough.shortest_interval, thresholds)
    period = rough.refractory_period
    if refractory_period is not None or period == 0:
        return _estimate(view, usual, refractory_period, MAX_SAMPLES, None) or rough
    period = _without_excess(view) or period
    return _by_information(view.seen(period, most=MAX_SAMPLES), usual, period, view, rough.doubt) or rough


def _estimate(
    view: _View, usual: Usual, refractory_period: int | None, most: int, delay: int | None
) -> ThresholdEstimate | None:
    """Thresholds, and the refractory period if it is not given; None where there are too few pixels.

    ``delay`` is what events seem to be late, us, of which the part that is due to what is lost is looked for. None:
    that of the view is right.
    """
    period = refractory_period or 0
    samples = view.seen(period, most=most)
    if len(samples.steps.change) < _MIN_SAMPLES:
        return None
    if not 0 < view.shortest <= _LARGEST_SHORTEST:
        return _by_information(samples, usual, period, view, 0.0)
    excess = _excess_of_soon(samples)
    # Where it is too uncertain to be believed, thresholds may still be as much too large.
    maybe = _THRESHOLD_OF_EXCESS * max(excess.value - _USUAL_EXCESS, 0.0)
    estimate = _by_information(samples, usual, period, view, maybe)
    if estimate is None or not excess.value - 2 * excess.error > _LEAST_EXCESS:
        return estimate
    for _ in range(2 if delay is not None else 1):  # what is lost looks like delay, too
        period = _without_excess(view)
        if period == 0:
            return estimate
        view = view if delay is None else view.without_trailing(delay, period)
    doubt = _THRESHOLD_OF_EXCESS * float(np.hypot(excess.error, _USUAL_EXCESS))
    return _by_information(view.seen(period, most=most), usual, period, view, doubt) or estimate


class _View(NamedTuple):
    """How to look at a recording: whether events are steps of log(I + I_0), their delay and shortest interval, us.

    The latter is 0 where the refractory period is not to be found. The thresholds are those that tell how far the light
    moves within exposures.
    """

    recording: Recording
    camera: CameraSettings
    of_log_offset: bool
    delay: int
    shortest: int
    thresholds: tuple[float, float]

    def seen(self, *periods: int, most: int) -> _Seen:
        """Samples under refractory periods, us."""
        return self._seen((self.delay,), periods, most)[0]

    def without_trailing(self, delay: int, period: int) -> _View:
        """With the delay under which events explain the frames best when their steps are spread over time (`steps`).

        Half a threshold, by which events trail the light, is a part of ``delay``; spread over time they do not trail.
        """
        delays = tuple(delay - trailing for trailing in _TRAILING)
        residuals = [seen.residual() for seen in self._seen(delays, (period,), ROUGH_SAMPLES)]
        if not np.isfinite(residuals).all():
            return self
        least = int(np.argmin(residuals))
        middle = min(max(least, 1), len(_TRAILING) - 2)
        found = vertex(*residuals[middle - 1 : middle + 2])
        best = _TRAILING[least] if found is None else _TRAILING[middle] + _TRAILING[1] * found
        if best >= _TRAILING[-1] + _TRAILING[1] / 2:  # no delay explains the frames
            return self
        return self._replace(delay=delay - round(max(best, 0.0)))

    def _seen(self, delays: tuple[int, ...], periods: tuple[int, ...], most: int) -> list[_Seen]:
        at_least = 2 if most <= ROUGH_SAMPLES else 4
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
        )
        return [_Seen(one, self.recording.sensor_size) for one in found]


class _Seen(NamedTuple):
    """Samples, and the size of the sensor."""

    steps: Steps
    sensor_size: tuple[int, int]

    def columns(self, events: Array, index: int) -> Array:
        """(N, 2) what explains changes under a refractory period: steps upwards and downwards."""
        late, soon = events[:, index, 0], events[:, index, 1]  # NumPy's sum over so short an axis is slow
        return np.asarray((late + soon) * np.array([1.0, -1.0]) * self.steps.share[:, None], np.float64)

    def residual(self) -> float:
        """In thresholds, of the regression on frames under the first refractory period; nan where there is none."""
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

    def changes_around(self) -> Array:
        """(N, 2) the neighbours' changes, upwards and downwards."""
        return halves(self.steps.change_around)


class _Told(NamedTuple):
    """What a regression tells: logs of the thresholds on and off, and their variances, (2,); inf where nothing."""

    logs: Array
    variances: Array


def _by_information(
    seen: _Seen, usual: Usual, period: int, view: _View, doubt: float
) -> ThresholdEstimate | None:
    """Thresholds from either kind of instruments and the usual ones, weighted by the inverse of their variances.

    ``doubt`` is the relative error of thresholds that comes from the period's.
    """
    change, explained = seen.steps.change, seen.explained(0)
    counts, changes = seen.counts_around(0), seen.changes_around()
    by_counts, by_changes = (two_stage(change, explained, instruments) for instruments in (counts, changes))
    fits = [fit for fit in (by_counts, by_changes) if fit is not None]
    if not fits:
        return None
    model = np.hypot(_MODEL, doubt)
    common = np.log1p(_SHARED * _unexplained(seen, by_counts, counts)) if by_counts is not None else np.inf
    of_counts = _told(seen, by_counts, explained, counts, float(np.hypot(common, model)))
    of_changes = _told(seen, by_changes, explained, changes, float(np.hypot(_SUBTHRESHOLD, doubt)))
    moved, lost = float(np.sqrt(np.mean(change**2))), float(np.mean(seen.steps.lost))
    known = _likely(usual, of_counts, of_changes, moved, lost)
    on, off = np.exp(known.logs)
    return ThresholdEstimate(
        on=float(on),
        off=float(off),
        residual=fits[0].residual,
        samples=len(change),
        spread=float(np.sqrt(np.mean(known.variances))),
        usual_share=float(np.mean(np.minimum(known.variances / max(usual.spread**2, 1e-12), 1.0))),
        refractory_period=period,
        delay=view.delay,
        doubt=doubt,
        shortest_interval=view.shortest,
    )


def _likely(usual: Usual, of_counts: _Told, of_changes: _Told, moved: float, lost: float) -> _Told:
    """Mean and variance of the logs of thresholds, by Bayes' rule: the usual ones, and what both instruments say.

    ``moved`` is the root mean square of the changes, ``lost`` the share of pixels of which one frame alone tells. How
    wrong either instrument is depends on how many thresholds ``moved`` is: a small estimate from narrow frames may be
    one of large thresholds, a large one hardly of small ones.
    """
    expected = np.log([usual.on, usual.off])
    if usual.spread == 0:
        return _Told(expected, np.zeros(2))
    reach = min(_PRIOR_REACH * usual.spread, _PRIOR_REACH)
    logs = expected[:, None] + np.linspace(-reach, reach, _PRIOR_POINTS)
    narrow = np.exp(logs) / max(moved, 1e-6)
    counts = of_counts.variances[:, None] + np.square(_NARROW_COUNTS * lost * narrow**3)
    changes = of_changes.variances[:, None] + np.square(_SMALL_CHANGES * narrow**2)
    # What both cannot explain is noise that neighbours share, or what frames do not show.
    apart = np.square(of_counts.logs - of_changes.logs)[:, None] - 4 * (counts + changes)
    counts += np.maximum(apart, 0.0)
    loss = np.square((logs - expected[:, None]) / usual.spread)
    for told, variances in ((of_counts, counts), (of_changes, changes)):
        information = 1 / np.minimum(variances, 1e9)
        loss += information * np.square(told.logs[:, None] - logs) - np.log(information)
    weights = np.exp(0.5 * (loss.min(axis=1, keepdims=True) - loss))
    weights /= weights.sum(axis=1, keepdims=True)
    mean = (weights * logs).sum(axis=1)
    return _Told(mean, (weights * np.square(logs - mean[:, None])).sum(axis=1))


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
    both = np.stack([predicted, change])
    (told, common), (_, shown) = products(both, both).tolist()
    return float(told * shown / max(common**2, 1e-12)) - 1.0


class _Parted(NamedTuple):
    """The regression on late events and events that follow soon, both in units of the thresholds."""

    explained: Array
    instruments: Array
    fit: Fit

    @property
    def excess(self) -> float:
        """By which share events that follow soon tell more than late ones."""
        return float(self.fit.solution[1] / self.fit.solution[0]) - 1.0


class _Excess(NamedTuple):
    """By which share events that follow soon tell more than late ones, and its standard error; 0 and inf if unknown."""

    value: float
    error: float


def _excess_of_soon(seen: _Seen) -> _Excess:
    """If nothing is lost."""
    parted = _parted(seen, 0)
    if parted is None:
        return _Excess(0.0, np.inf)
    samples = seen.steps
    late, soon = standard_errors(
        samples.change,
        parted.explained,
        parted.instruments,
        parted.fit.weights,
        samples.pixel,
        seen.sensor_size,
    )
    return _Excess(parted.excess, float(np.hypot(late, soon) / parted.fit.solution[0]))


def _parted(seen: _Seen, index: int) -> _Parted | None:
    """Under a refractory period; None where it is not determined."""
    samples = seen.steps
    fit = two_stage(samples.change, seen.explained(index), seen.counts_around(index))
    if fit is None:
        return None
    on, off = fit.solution

    def columns(events: Array) -> Array:
        steps_of = on * events[:, index, :, 0] - off * events[:, index, :, 1]
        return np.asarray(steps_of * samples.share[:, None], np.float64)

    explained, instruments = columns(samples.events), columns(samples.events_around)
    again = two_stage(samples.change, explained, instruments)
    return None if again is None or not again.solution[0] > 0 else _Parted(explained, instruments, again)


def _without_excess(view: _View) -> int:
    """The refractory period, us, under which events that follow soon tell as much as late ones; 0 if unknown."""
    periods = possible_periods(view.shortest)
    seen = view.seen(*periods, most=_PERIOD_SAMPLES)
    parted = [_parted(seen, index) for index in range(len(periods))]
    excess = np.array([np.nan if one is None else one.excess for one in parted])
    if not np.isfinite(excess).all():
        return 0
    # A longer period always explains more; what noise makes otherwise is evened out.
    falling = np.minimum.accumulate(excess)
    return round(float(np.interp(-_USUAL_EXCESS, -falling, periods)))
