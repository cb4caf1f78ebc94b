"""How soon pixels can follow one event by another, and what that says of their refractory period."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.compiled import empty, loop
from kalux.event_slices import first_events
from kalux.events import NEVER
from kalux.recording import Recording

_EDGE: Final = 0.02  # share of the histogram's peak below which shorter intervals are noise
_MOST_OF_PIXEL: Final = 200  # intervals of a pixel that count, so that hot pixels have a few percent of all
_FINE: Final = 10  # fine bins, 2 % wide, in a coarse bin, at one of which the shortest interval begins
_EDGE_BINS: Final = np.logspace(1, 6, 50 * _FINE + 1)  # us

_PILE: Final = 0.1
"""Share of the intervals up to twice as long that lies in one fine bin if events pile up there. It is 0.005 to 0.05 on
forty scenes and recordings whose pixels are reset or lose nothing, 0.15 to 0.48 on eight whose events wait for the end
of the refractory period."""

_LEAST_PILE: Final = 100  # us: fine bins of shorter intervals hold only one or two microseconds
_LEAST_PILED: Final = 1_000  # intervals up to twice as long: so many that a share of 0.1 is not chance

_TRIED: Final = (0.35, 0.6, 0.85, 1.1)
"""Refractory periods that are tried, as shares of the shortest interval; the best is interpolated between them. It is
not longer than that interval, which is known to a coarse bin of a quarter of its size."""

_OF_LIGHT: Final = 0.93
"""Refractory period at most, as a share of the shortest interval that is light's: on 46 simulated recordings of ideal
sensors with 0.3 and 1 ms that is 1.07 times the period or more, 1.07 to 1.25 where edges are steep."""

_LIGHT_SETS_IN: Final = (0.9, 1.0, 1.1, 1.2)
"""Edges of the windows, in units of that interval, in each of which there must be more than noise makes: in the first
alone may be by chance (0.3 ms of 1 ms on one of these recordings)."""

_MORE_THAN_NOISE: Final = (5.0, 4.0)  # intervals, and standard deviations of noise's number

_LIGHT_FOLLOWS: Final = (50, 10_000)
"""Intervals between which it is sought, us: from the least dead time on, to twice the longest of the shortest ones with
which a period is sought."""

LATE: Final = 5.0
"""Shortest intervals after its predecessor from which an event has little information of the refractory period: at most
a quarter of its step is lost. Later ones are often noise, or the rest of a change."""

_DEAD_EVENTS: Final = 2_000_000
_DEAD_TIMES: Final = np.arange(50, 5_001)  # us: those of sensors and simulators
_WINDOWS: Final = (1.0, 2.0, 0.5, 0.25)
"""How far behind a dead time intervals are looked at, in units of it, in the order in which they are: farther where
there is little noise, less far where light soon makes most of them. Of 270 simulated recordings the dead time is found
in 254, 236, 226 and 178 by one of these, in 267 by any, and in none of 195 others that have none that noise shows, of
68 without noise, or of five real ones of DAVIS sensors. (With an eighth of it, 261 us are found on one of these.)"""

_LEAST_AFTER: Final = 15
"""Least number of intervals in such a window. Of the 267 recordings, with 15 to thousands, all are found within 3 %
but for six in which the first of any interval comes late (up to 8 %)."""

_LEAST_SUDDEN: Final = 5.0
"""By how much an onset must be more likely than a density that grows by a power of the length, nats. Of 280
recordings, real ones and simulated, no onset was wrong that passed the other conditions; this is for unlike ones."""

_MOST_BEFORE: Final = 0.02
"""Largest density of intervals below a dead time, over that beyond; not 0, since pixels differ."""

_MOST_BEYOND: Final = 1.6
"""Largest density of intervals beyond a tenth of the window behind the dead time, a quarter and a half, over that
before, beside chance: on 63 simulated recordings 0.6 to 1.75 of half a dead time. It is more where the light turns
sooner or later: 4 behind 0.28 ms on a DAVIS346 before a bench."""

_LEAST_BEYOND: Final = 1 / 3
"""The least of these ratios, of all intervals within a tenth, and of that from 2 to 3 dead times, or of the next window
if that is longer: it is less where events wait for the end of the dead time, so that nothing is lost
(`Intervals.pile_up`), and under a lamp, whose light turns after half a period, and again after another."""

_LATE_BY: Final = 6.0
"""Mean times between two intervals by which the first one between events of unlike polarity is late, at most: by more
in one of 20 cases, in which the dead time is found too long by a few of them."""

_HIDDEN: Final = 1.02
"""Refractory period by which what is hidden is counted, over the dead time: K13's h is too small by some percent in
light that is fast. On 63 simulated recordings of DAVIS the MSE is 0.983 of that with 1 in the geometric mean, both ways
0.979 (31 of them); with 1.04 it is 0.975 and 0.971, but up to 1.28 instead of 1.11 of it."""


class Period(NamedTuple):
    """A refractory period, us, and its relative standard deviation: 0 where it is known."""

    length: int
    spread: float = 0.0


class Intervals(NamedTuple):
    """Times between two events of a pixel.

    Attributes
    ----------
    shortest
        Their lower edge, us, which no refractory period exceeds. 0 if no pixel has two events.
    pile_up
        Whether many have the same length. After a reset a pixel needs a new change of a threshold, so that no length is
        preferred. Where events only wait for the end of the refractory period they come at that moment, and nothing is
        lost (docs/equations.md, K13).
    of_light
        The shortest that light makes, us; 0: unknown. Noise makes shorter ones, as many between events of one polarity
        as between such of both.
    """

    shortest: int
    pile_up: bool
    of_light: int = 0

    @property
    def longest_period(self) -> int:
        """The longest refractory period that light leaves possible, us; 0: unknown."""
        return int(_OF_LIGHT * self.of_light)


def shortest_interval(recording: Recording, most_events: int = 3_000_000) -> int:
    """`Intervals.shortest` of the first ``most_events``, us."""
    return intervals(recording, most_events).shortest


def intervals(recording: Recording, most_events: int = 3_000_000) -> Intervals:
    """Shortest interval, and whether events pile up at one.

    The shortest is where their histogram over log time first reaches 2 % of its peak; below that are noise events,
    which follow the others at any time. Of the first ``most_events``, and the first 200 of each pixel, so that hot
    pixels, which keep no period that others have, do not decide.
    """
    histogram = np.zeros(len(_EDGE_BINS) - 1, np.int64)
    count, turned = counts = np.zeros((2, _LIGHT_FOLLOWS[1]), np.int64)
    for found, turning in _of_first_events(recording, most_events):
        histogram += np.histogram(found, _EDGE_BINS)[0]
        _add_short(found, turning, counts)
    if not histogram.any():
        return Intervals(0, pile_up=False)
    coarse = histogram.reshape(-1, _FINE).sum(1)
    first = int(np.argmax(coarse >= _EDGE * coarse.max())) * _FINE
    shortest = round(float(_EDGE_BINS[first]))
    piles_up = shortest >= _LEAST_PILE and _piles_up(histogram[first:])
    return Intervals(shortest, piles_up, _first_of_light(count - turned, turned))


def _first_of_light(like: NDArray[np.int64], turned: NDArray[np.int64]) -> int:
    """The least length from which there are more intervals between events of ``like`` polarity than noise makes, us.

    Noise makes as many of these as of those that have ``turned``, whose density up to that length it is taken to have
    beyond. Light makes ever more, the longer they are. 0: nowhere.
    """
    shorter, turned_before = (np.concatenate([[0], np.cumsum(each)]) for each in (like, turned))
    length = np.arange(_LIGHT_FOLLOWS[0], int(len(like) / _LIGHT_SETS_IN[-1]))
    edges = [(share * length).astype(np.int64) for share in _LIGHT_SETS_IN]
    density = turned_before[edges[0]] / edges[0]
    least, deviations = _MORE_THAN_NOISE
    sets_in = np.ones(len(length), np.bool_)
    for begin, end in pairwise(edges):
        of_noise = density * (end - begin)
        more = shorter[end] - shorter[begin] - of_noise
        sets_in &= more >= least + deviations * np.sqrt(np.maximum(of_noise, 1.0))
    return int(length[np.argmax(sets_in)]) if sets_in.any() else 0


def dead_time(recording: Recording) -> int:
    """How long pixels are blind after an event, us, where noise shows it; 0 where it does not.

    Events of noise come at any time, but for the refractory period of the event before them: where there are enough of
    them, intervals set in at its end, all at once. Half of them lie between events of unlike polarity, which light that
    goes on does not make: these alone tell, however many others there are. Of the first two million events, and the
    first 200 of each pixel.
    """
    longest = round((1 + 2 * max(_WINDOWS)) * int(_DEAD_TIMES[-1]))  # the window, and the next one
    count, turned = counts = np.zeros((2, longest), np.int64)
    for found, turning in _of_first_events(recording, _DEAD_EVENTS):
        _add_short(found, turning, counts)
    return _onset(count, turned)


def counted_period(dead_time: int) -> int:
    """The refractory period, us, by which what pixels miss in a dead time is counted (K13)."""
    return round(_HIDDEN * dead_time)


def _onset(count: NDArray[np.int64], turned: NDArray[np.int64]) -> int:
    """Where intervals of noise set in all at once, us; 0: nowhere.

    ``count`` says how many intervals are of each length, us, and ``turned`` of how many both events differ in polarity.
    """
    found = (_onset_of(share, count, turned) for share in _WINDOWS)
    return next(filter(None, found), 0)


def _onset_of(share: float, count: NDArray[np.int64], turned: NDArray[np.int64]) -> int:
    """The same, by the intervals in a window behind it that is as long as a ``share`` of it."""
    begin = _DEAD_TIMES
    window = (share * begin).astype(np.int64)
    end = begin + window
    shorter, any_shorter = (np.concatenate([[0], np.cumsum(each)]) for each in (turned, count))
    before, within = shorter[begin], shorter[end]
    after = within - before
    density = after / window
    gain = _log_likelihood(before, begin) + _log_likelihood(after, window)
    sudden = (
        (count[begin] > 0)
        & (after >= _LEAST_AFTER)
        & (before / begin <= _MOST_BEFORE * density)
        & (any_shorter[begin] / begin <= _MOST_BEFORE * 2 * density)  # half of those of noise turn
        & (gain - _of_power(turned, within, end) >= _LEAST_SUDDEN)
    )
    for unit in (window // 10, window // 4, window // 2):
        ratio, chance = _growth(shorter, begin, unit)
        sudden &= ratio <= _MOST_BEYOND + chance
    if share < 1.0:
        sudden &= _are_of_noise(shorter, any_shorter, begin, window // 10)
    lasting = np.maximum(window, begin)
    for lengths, unit in ((shorter, lasting // 2), (shorter, lasting), (any_shorter, window // 10)):
        ratio, chance = _growth(lengths, begin, unit)
        sudden &= ratio >= _LEAST_BEYOND - chance
    if not sudden.any():
        return 0
    best = int(np.argmax(np.where(sudden, gain - _log_likelihood(within, end), -np.inf)))
    apart = 1 / float(2 * density[best])  # mean time between two, of any polarity
    latest = int(begin[best])
    earliest = max(latest - round(_LATE_BY * apart), 0)
    first_of_any = earliest + int(np.argmax(count[earliest : latest + 1] > 0))
    return first_of_any - round(apart)  # by which the first comes late


def _are_of_noise(
    shorter: NDArray[np.int64],
    any_shorter: NDArray[np.int64],
    begin: NDArray[np.int64],
    unit: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Whether of the intervals of up to ``begin + unit`` about half turn, as those of noise do, and not fewer.

    Light that begins to make intervals makes few that turn, which may come at once as well.
    """
    turned, of_any = (each[begin + unit] - each[begin] for each in (shorter, any_shorter))
    most = 2 * (_MOST_BEYOND * turned + 2 * np.sqrt(np.maximum(turned, 1)))
    return np.asarray(of_any <= most, np.bool_)


def _log_likelihood(number: NDArray[np.int64], time: NDArray[np.int64]) -> NDArray[np.float64]:
    """Log likelihood of ``number`` intervals in ``time`` at their own density, up to terms that all models share."""
    return np.asarray(number * np.log(np.maximum(number, 1) / time))


def _of_power(
    turned: NDArray[np.int64], number: NDArray[np.int64], end: NDArray[np.int64]
) -> NDArray[np.float64]:
    """The same of the ``number`` of intervals shorter than ``end`` whose density grows by the best power, not less than
    0, of their length, as that of light does."""
    logs = np.cumsum(turned * np.log(np.maximum(np.arange(len(turned)), 0.5)))[end - 1]
    short_of = np.maximum(number * np.log(end) - logs, 1e-9)  # sum of log(end / length)
    power = np.maximum(number / short_of - 1, 0.0)
    return np.asarray(_log_likelihood(number, end) + number * np.log(power + 1) - power * short_of)


def _growth(
    shorter: NDArray[np.int64], begin: NDArray[np.int64], unit: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How many intervals of more than ``begin + unit`` there are for one before, of a ``unit`` each, and twice the
    standard deviation of that by chance; ``shorter`` says how many are shorter than a length."""
    first = shorter[begin + unit] - shorter[begin]
    second = shorter[begin + 2 * unit] - shorter[begin + unit]
    return second / np.maximum(first, 1), 2 / np.sqrt(np.maximum(first, 1))


def _piles_up(histogram: NDArray[Any]) -> bool:
    """Whether a fine bin in which the shortest interval may lie has too many of those up to twice as long.

    Unless the bins after it are empty: where times are multiples of a step, intervals are the same whatever pixels do.
    """
    peak = int(histogram[:_FINE].argmax())
    beyond = histogram[peak : peak + round(_FINE * 10 * np.log10(2))]
    return bool(
        beyond.sum() >= _LEAST_PILED
        and beyond[0] > _PILE * beyond.sum()
        and np.count_nonzero(beyond[1 : 1 + _FINE]) > _FINE // 2
    )


def possible_periods(shortest: int) -> tuple[int, ...]:
    """Refractory periods, us, of pixels whose shortest interval is ``shortest``; first 0, nothing is lost."""
    return (0, *sorted({round(share * shortest) for share in _TRIED} - {0}))


def _of_first_events(recording: Recording, most_events: int) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """Of chunks of the first events: intervals, us, and whether both events of each differ in polarity."""
    last = np.full(recording.sensor_size, NEVER, np.int64)
    seen = np.zeros(recording.sensor_size, np.int32)
    for part in first_events(recording.events(), most_events):
        yield _intervals_of(part["t"], part["x"], part["y"], part["p"], last, seen)


def _add_short(found: NDArray[Any], turning: NDArray[Any], counts: NDArray[np.int64]) -> None:
    """Add to ``counts``, (2, N), how many intervals are of each length below N us, and how many of these turn."""
    longest = counts.shape[1]
    short = found < longest
    for total, chosen in zip(counts, (short, short & turning), strict=True):
        total += np.bincount(found[chosen], minlength=longest)


@loop
def _intervals_of(t, x, y, p, last, seen):  # type: ignore[no-untyped-def]
    """``last`` is twice the time of a pixel's latest event, plus 1 if it was on."""
    found, turning = empty(len(t), np.int64), empty(len(t), np.bool_)
    n = 0
    for i in range(len(t)):
        code, before = t[i] * 2 + p[i], last[y[i], x[i]]
        if before != NEVER and seen[y[i], x[i]] < _MOST_OF_PIXEL:
            found[n] = t[i] - (before >> 1)
            turning[n] = (code ^ before) & 1
            n += 1
            seen[y[i], x[i]] += 1
        last[y[i], x[i]] = code
    return found[:n], turning[:n]
