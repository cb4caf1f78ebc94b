"""Samples for regressions: events of pixels and their neighbours between two frames, and the changes of the frames.

An event means that the light has moved by a threshold since the pixel's previous one, but not when. Here its step is
spread over that time, so that only a part of it may lie between the frames:

- Between two events of one sign the light moves straight from level to level.
- Where the direction turns it first goes on by half a threshold, the mean of 0 to 1, and then back by one and a half.
  Without the unreported way back, thresholds come out 5 to 13 % too large where texture is fine.
- It moves at the pace of the neighbouring events of the pixel, and rests for what remains of a long time.

On ideal sensors the residuals are half of those with steps that count as a whole at the time of their event, and the
error of the thresholds is within 2 %, whatever the exposures.

A frame shows the logarithm of the mean over its exposure, while steps add up to the mean of the logarithm. The
difference follows from the events within the exposure, and is subtracted. Otherwise steps of events that follow soon,
which are those of fast edges, would seem 13 % smaller to 10 % larger than others where exposures take three quarters of
the time (nine simulated scenes; 4 % smaller to 1 % larger with the correction).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba.core import types
from numpy.typing import NDArray

from kalux.augmentation.refractory import step_weight
from kalux.calibration.exposures import Exposures
from kalux.calibration.intervals import APART, SOON_FOR_THRESHOLDS, Interval, intervals
from kalux.calibration.neighbours import sum_of_neighbours
from kalux.compiled import empty, event_column, event_is_on, event_row, event_words, loop, smaller, zeros
from kalux.event_slices import between, count_chunks
from kalux.events import NEVER
from kalux.formulas import Number, choose, formula
from kalux.recording import Recording
from kalux.settings import CameraSettings

Array = NDArray[np.float64]

MAX_SAMPLES: Final = 100_000
"""Number of pixels that is enough: the standard error of thresholds is then below 1 %."""

_MAX_FRAMES: Final = 200
_LEAST_AROUND: Final = 8  # events of the eight neighbours: fewer may be noise
_LEAST_NEIGHBOURS: Final = 4  # neighbours that frames show well
_PATCH: Final = tuple((row, column) for row in (-1, 0, 1) for column in (-1, 0, 1))

_SAME_EDGE: Final = 0.3
"""Log intensity by which the changes of neighbours at the same edge differ. Others have less weight: a slow edge comes
to one pixel after the other, which would make thresholds a quarter too large."""

_SLOWEST: Final = 15_000.0
"""Longest time, us, in which moving light is taken to move by a threshold; for the rest of a longer one it rests. The
pixel's other events mostly determine the pace: with 20 and 50 ms thresholds differ by 0.4 %."""

_PEAK: Final = 0.5
"""Thresholds by which the light goes on before it turns, on average."""


class Steps(NamedTuple):
    """Pixels of frame intervals, (N,), for several refractory periods, P.

    Attributes
    ----------
    change
        Of the mean of log(I + I_0) over each exposure, between the frames.
    change_around
        Mean of the same of the neighbours, weighed by how alike these change.
    share
        I / (I + I_0), the share of a step of log I that shows in log(I + I_0); 1 for steps of log(I + I_0).
    events, events_around
        (N, P, 2, 2): sums of the parts of events' steps that lie between the frames, in thresholds, of the pixel
        itself, and such means of its neighbours'; of events that come late after their predecessors first and of those
        that follow soon second, of either on first and off second.
    pixel
        Index of the pixel.
    lost
        Of the pixels that one frame of the interval shows well and around which something happens, the share that the
        other does not.
    """

    change: Array
    change_around: Array
    share: Array
    events: Array
    events_around: Array
    pixel: NDArray[np.int64]
    lost: Array


def steps(
    recording: Recording,
    camera: CameraSettings,
    *,
    delays: tuple[int, ...],
    periods: tuple[int, ...],
    late: float,
    thresholds: tuple[float, float] = (0.0, 0.0),
    of_log_offset: bool = False,
    most: int = MAX_SAMPLES,
    at_least: int = 4,
    apart: int = APART,
) -> list[Steps]:
    """Well exposed pixels around which something happens, of the first 200 frames or as many as it takes.

    Parameters
    ----------
    recording
        With frames and exposures, without the events of hot pixels (`kalux.calibration.hot_pixels`).
    camera
        Response and I_0.
    delays
        How much later than the frames' clock events are stamped, us: one of the results for each.
    periods
        (P,) refractory periods, us (docs/equations.md, K13). What is hidden by one is added where the direction stays:
        where it turns light goes as often up as down meanwhile.
    late
        us after its predecessor from which on an event is late.
    thresholds
        On and off, log intensity: how far the light moved within the exposures. 0: as if it had not.
    of_log_offset
        Steps of log(I + I_0) instead of log I.
    most
        Pixels that are enough.
    at_least
        Intervals that they are taken from, if there are as many: these differ more than pixels of one.
    apart
        us between frames that follow sooner than `kalux.calibration.intervals.SOON_FOR_THRESHOLDS`.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    margin = recording.longest_exposure + max(abs(delay) for delay in delays) + round(_REACH)
    log_offset = 0.0 if of_log_offset else camera.offset
    samplers = [
        _StepSampler(
            recording.sensor_size, periods, late, delay, thresholds, log_offset, -(-most // at_least)
        )
        for delay in delays
    ]
    found: list[list[Steps]] = []
    count = 0
    found_in = intervals(
        recording,
        camera,
        margin=margin,
        most_frames=_MAX_FRAMES,
        apart=apart,
        soon=SOON_FOR_THRESHOLDS,
    )
    for interval in found_in:
        found.append([sampler.sample(interval) for sampler in samplers])
        count += len(found[-1][0].change)
        if count >= most:
            break
    if not found:
        return [_no_steps(len(periods)) for _ in delays]
    return [
        Steps(*(np.concatenate(values) for values in zip(*parts, strict=True)))
        for parts in zip(*found, strict=True)
    ]


def _no_steps(periods: int) -> Steps:
    none, counts = np.empty(0), np.empty((0, periods, 2, 2))
    return Steps(none, none, none, counts, counts, np.empty(0, np.int64), none)


_REACH: Final = (1 + _PEAK) * _SLOWEST
"""us before and after two exposures in which events tell where the light was during these."""


class _StepSampler:
    """Samples successive intervals, and remembers every pixel's newest event before each."""

    def __init__(
        self,
        sensor_size: tuple[int, int],
        periods: tuple[int, ...],
        late: float,
        delay: int,
        thresholds: tuple[float, float],
        log_offset: float,
        most: int,
    ) -> None:
        height, width = sensor_size
        self._shape = sensor_size
        self._periods, self._late = np.array(periods, np.float32), float(late)
        self._delay, self._most = delay, most
        self._exposures = Exposures(sensor_size, delay, thresholds)
        self._log_offset = log_offset
        # Time and sign of every pixel's newest event before the interval; 0 if there was none.
        self._latest = np.full(height * width, NEVER, np.int64)
        self._sign = np.zeros(height * width, np.int8)
        self._seen_until = NEVER

    def sample(self, interval: Interval) -> Steps:
        """The samples of the next interval."""
        height, width = self._shape
        first, second = interval.first, interval.second
        begin = first.start + self._delay - round(_REACH)
        end = second.end + self._delay + round(_REACH)
        passed = event_words(between(interval.events, self._seen_until, begin))
        _remember_newest(passed, np.uint64(width), self._latest, self._sign)
        self._seen_until = begin
        chosen, usable, lost = self._chosen(interval)
        words = event_words(between(interval.events, begin, end))
        codes, starts = _by_pixel(words, np.uint64(width), _with_neighbours(chosen, height, width))
        exposures = tuple(
            float(t + self._delay - begin)
            for shot in (first, second)
            for t in (shot.start, max(shot.end, shot.start + 1))
        )
        counts = np.zeros((height * width, len(self._periods), 2, 2), np.float32)
        events = codes, starts, self._latest, self._sign, begin
        _count(*events, exposures, self._periods, self._late, counts)
        shape = len(chosen), len(self._periods), 2, 2
        share = interval.level / np.maximum(interval.level + self._log_offset, 1e-9)
        # To second order, log(I + I_0) bends by the square of its share in the steps.
        before, after = self._exposures.of(interval.first, interval.second, interval.events)
        change = interval.change - share**2 * (after.over_mean - before.over_mean)
        own, around, change_around = _own_and_around(
            counts.reshape(height, width, 4 * len(self._periods)), change, usable, chosen
        )
        return Steps(
            change.ravel()[chosen],
            change_around,
            share.ravel()[chosen],
            own.reshape(shape),
            around.reshape(shape),
            chosen,
            np.full(len(chosen), lost),
        )

    def _chosen(self, interval: Interval) -> tuple[NDArray[np.int64], NDArray[np.bool_], float]:
        """Which pixels are sampled: indices, (H, W) all usable pixels, and `Steps.lost`.

        Usable pixels are well exposed. Of those with enough events around, evenly spread ones are sampled.
        """
        start, end = interval.start + self._delay, interval.end + self._delay
        on, off = count_chunks([between(interval.events, start, end)], self._shape, weighed=False)
        events = on + off
        usable, eventful = interval.usable, _eventful(events)
        either = sum(int(np.count_nonzero(end.usable & eventful)) for end in interval.ends)
        lost = 1.0 - 2 * int(np.count_nonzero(interval.usable & eventful)) / max(either, 1)
        neighbours = sum_of_neighbours(usable.view(np.uint8))
        candidates = np.flatnonzero(eventful & usable & (neighbours >= _LEAST_NEIGHBOURS))
        return candidates[:: max(-(-len(candidates) // self._most), 1)], usable, lost


def _with_neighbours(chosen: NDArray[np.int64], height: int, width: int) -> NDArray[np.bool_]:
    """(H W) bool: the ``chosen`` pixels, which are not at the border, and their neighbours."""
    found = np.zeros(height * width, np.bool_)
    for place in _PATCH:
        found[chosen + place[0] * width + place[1]] = True
    return found


@loop
def _remember_newest(words, width, latest, sign):  # type: ignore[no-untyped-def]
    """Remember time and sign of every pixel's newest event."""
    for i in range(len(words)):
        word = words[i, 1]
        at = event_row(word) * width + event_column(word)
        latest[at] = words[i, 0]
        sign[at] = 1 if event_is_on(word) else -1


@loop
def _by_pixel(words, width, wanted):  # type: ignore[no-untyped-def]
    """2 t + p of the wanted pixels' events, one pixel after the other and in order, and where those of each start."""
    starts = zeros(len(wanted) + 1, np.int64)
    for i in range(len(words)):
        word = words[i, 1]
        at = event_row(word) * width + event_column(word)
        starts[at + np.uint64(1)] += wanted[at]
    for at in range(len(wanted)):
        starts[at + 1] += starts[at]
    place = starts[:-1].copy()
    codes = empty(starts[-1], np.int64)
    for i in range(len(words)):
        word = words[i, 1]
        at = event_row(word) * width + event_column(word)
        if wanted[at]:
            codes[place[at]] = 2 * words[i, 0] + np.int64(event_is_on(word))
            place[at] += 1
    return codes, starts


def _ramp_sum(t: Number, start: Number, end: Number) -> Number:
    """Integral until t, us, of a ramp from 0 at ``start`` to 1 at ``end``."""
    within = (t - start) * (t - start) / (2.0 * (end - start))
    return choose(t > start, choose(t < end, within, t - 0.5 * (start + end)), t.like(0.0))


def _ramp_mean(begin: Number, stop: Number, start: Number, end: Number) -> Number:
    """Mean from ``begin`` to ``stop`` of a ramp from 0 at ``start`` to 1 at ``end``."""
    mean = (_ramp_sum(stop, start, end) - _ramp_sum(begin, start, end)) / (stop - begin)
    return choose(stop > start, choose(begin < end, mean, mean.like(1.0)), mean.like(0.0))


@formula(types.float64)
def _ramp_difference(
    begin: Number, stop: Number, second_begin: Number, second_stop: Number, start: Number, end: Number
) -> Number:
    """Mean over the second exposure less that over the first of a ramp from 0 at ``start`` to 1 at ``end``."""
    return _ramp_mean(second_begin, second_stop, start, end) - _ramp_mean(begin, stop, start, end)


@loop
def _count(codes, starts, latest, sign, origin, exposures, periods, late, counts):  # type: ignore[no-untyped-def]
    """Add to ``counts`` the part of every event's step that lies between the two exposures.

    Times are taken from the ``origin`` on, us: those since 1970 are no whole number of us in float64.
    """
    for at in range(len(starts) - 1):
        if starts[at] == starts[at + 1]:
            continue
        before, sign_before = float(latest[at] - origin), sign[at]
        pace_before = _SLOWEST  # us for a threshold
        went_on = np.float32(0.0)  # us, of K13
        for j in range(starts[at], starts[at + 1]):
            t, on = float((codes[j] >> 1) - origin), codes[j] & 1 == 1
            own_sign = 1 if on else -1
            since = t - before
            if t > exposures[0] and before < exposures[3]:
                pace_after = _SLOWEST
                if j + 1 < starts[at + 1] and (codes[j + 1] ^ codes[j]) & 1 == 0:
                    pace_after = smaller(_SLOWEST, float((codes[j + 1] >> 1) - origin) - t)
                soon, column = np.uint64(since < late), np.uint64(not on)
                if own_sign == -sign_before:
                    # At one pace, the way out takes a quarter of the time and the way back the rest.
                    out = _ramp_difference(
                        *exposures, before, before + smaller(_PEAK * pace_before, 0.25 * since)
                    )
                    back = _ramp_difference(
                        *exposures, t - smaller((1 + _PEAK) * pace_after, 0.75 * since), t
                    )
                    for k in range(len(periods)):
                        counts[at, k, soon, column] += back
                        counts[at, k, soon, 1 - column] += _PEAK * (out - back)
                else:
                    arrive = 0.5 * smaller(pace_after, since)
                    if sign_before == 0:  # where the light was before the pixel's first event is not known
                        step = _ramp_difference(*exposures, t - 2.0 * arrive, t)
                    else:
                        leave = 0.5 * smaller(pace_before, since)
                        step = 0.5 * _ramp_difference(*exposures, before, before + leave)
                        step += 0.5 * _ramp_difference(*exposures, t - arrive, t)
                    for k in range(len(periods)):
                        counts[at, k, soon, column] += step * step_weight(
                            np.float32(since), went_on, periods[k]
                        )
            pace_before = smaller(_SLOWEST, since) if own_sign == sign_before else _SLOWEST
            went_on = np.float32(since) if own_sign == sign_before else np.float32(0.0)
            before, sign_before = t, own_sign
        # The next event is too far away to know its sign: on both ways lies half a threshold.
        step = 0.5 * _ramp_difference(*exposures, before, before + 0.5 * pace_before)
        for k in range(len(periods)):
            counts[at, k, 0, np.uint64(sign_before < 0)] += step


def _eventful(events: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W): pixels not at the border whose neighbours have enough events."""
    found = np.zeros(events.shape, np.bool_)
    found[1:-1, 1:-1] = (sum_of_neighbours(events) >= _LEAST_AROUND)[1:-1, 1:-1]
    return found


@loop
def _own_and_around(counts, change, usable, chosen):  # type: ignore[no-untyped-def]
    """Counts of the chosen pixels, and weighted means of the counts and changes of their neighbours.

    One number at a time: for operations on whole rows numba would compile the error of rows that differ in size, which
    takes 1.5 s.
    """
    width, size = counts.shape[1:]
    own, around = empty((len(chosen), size), np.float64), zeros((len(chosen), size), np.float64)
    change_around = zeros(len(chosen), np.float64)
    for n in range(len(chosen)):
        row, column = chosen[n] // width, chosen[n] % width
        total = 0.0
        for k in range(size):
            own[n, k] = counts[row, column, k]
        for i in range(row - 1, row + 2):
            for j in range(column - 1, column + 2):
                if usable[i, j] and not (i == row and j == column):
                    apart = (change[i, j] - change[row, column]) / _SAME_EDGE
                    weight = 1.0 / (1.0 + apart * apart)
                    for k in range(size):
                        around[n, k] += weight * counts[i, j, k]
                    change_around[n] += weight * change[i, j]
                    total += weight
        for k in range(size):
            around[n, k] /= total
        change_around[n] /= total
    return own, around, change_around
