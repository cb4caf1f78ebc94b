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

LATE: Final = 5.0
"""Shortest intervals after its predecessor from which an event has little information of the refractory period: at most
a quarter of its step is lost. Later ones are often noise, or the rest of a change."""

_DEAD_EVENTS: Final = 2_000_000
_DEAD_TIMES: Final = np.arange(50, 5_001)  # us: those of sensors and simulators
_LEAST_AFTER: Final = 10
"""Least number of intervals from one to 1.1 dead times. Of noise without a dead time 50 would lie in the half of it
before them, where there may be one. With 8 one is found 3 % too short; on 62 scenes and recordings without a dead
time, or with one that noise does not keep, none is found with either."""

_MOST_BEFORE: Final = 0.02
"""Largest density of intervals from a half to one dead time, over that from 1 to 1.1; not 0, since pixels differ. Where
only the pace of the light keeps events apart, the density rises gradually: the ratio is 0.06 and more where it grows by
the tenth power of the length."""

_MOST_BEYOND: Final = 1.6
"""Largest density of intervals from 1.1 to 1.2 dead times, over that from 1 to 1.1: 0.7 to 1.2 on thirteen simulated
scenes, 2.3 on a DAVIS346 before a bench, where the density grows by the tenth power of the length."""

_LEAST_BEYOND: Final = 1 / 3
"""The least of the same ratio: it is less where events wait for the end of the dead time, so that nothing is lost
(`Intervals.pile_up`)."""

_LEAST_TURNING: Final = 0.2
"""Least share of the intervals from 1 to 1.1 dead times whose events differ in polarity. It is a half for noise, 0.29
to 0.57 on thirteen simulated scenes, and 0 where edges of one speed and contrast make equal intervals."""


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
    """

    shortest: int
    pile_up: bool


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
    for found, _ in _of_first_events(recording, most_events):
        histogram += np.histogram(found, _EDGE_BINS)[0]
    if not histogram.any():
        return Intervals(0, pile_up=False)
    coarse = histogram.reshape(-1, _FINE).sum(1)
    first = int(np.argmax(coarse >= _EDGE * coarse.max())) * _FINE
    shortest = round(float(_EDGE_BINS[first]))
    return Intervals(shortest, pile_up=shortest >= _LEAST_PILE and _piles_up(histogram[first:]))


def dead_time(recording: Recording) -> int:
    """How long pixels are blind after an event, us, where noise shows it; 0 where it does not.

    Events of noise come at any time, but for the refractory period of the event before them: where there are enough of
    them, intervals set in at its end, all at once. Of the first two million events, and the first 200 of each pixel.
    """
    longest = 2 * int(_DEAD_TIMES[-1])
    count = np.zeros((2, longest), np.int64)
    for found, turning in _of_first_events(recording, _DEAD_EVENTS):
        short = found < longest
        for row, chosen in zip(count, (short & ~turning, short & turning), strict=True):
            row += np.bincount(found[chosen], minlength=longest)
    going_on, turned = np.cumsum(np.pad(count, ((0, 0), (1, 0))), axis=1)
    return _onset(going_on + turned, turned)


def _onset(shorter: NDArray[np.int64], turning: NDArray[np.int64]) -> int:
    """Where intervals of noise set in all at once, us; 0: nowhere.

    ``shorter`` says how many intervals are shorter, for every us, and ``turning`` of how many both events differ in
    polarity.
    """
    ends = (_DEAD_TIMES // 2, _DEAD_TIMES, _DEAD_TIMES * 11 // 10, _DEAD_TIMES * 12 // 10)
    before, after, beyond = (shorter[end] - shorter[start] for start, end in pairwise(ends))
    of_before, of_after, of_beyond = (end - start for start, end in pairwise(ends))
    density = after / of_after
    ratio = beyond / of_beyond / np.maximum(density, 1e-9)
    sudden = (
        (after >= _LEAST_AFTER)
        & (before / of_before <= _MOST_BEFORE * density)
        & (ratio <= _MOST_BEYOND)
        & (ratio >= _LEAST_BEYOND)
        & (turning[ends[2]] - turning[ends[1]] >= _LEAST_TURNING * after)
    )
    if not sudden.any():
        return 0

    def likelihood(number: NDArray[np.int64], time: NDArray[np.int64]) -> NDArray[np.float64]:
        """Log likelihood of ``number`` intervals in ``time`` at their own density, up to terms that all edges share."""
        return np.asarray(number * np.log(np.maximum(number, 1) / time))

    gain = likelihood(before, of_before) + likelihood(after, of_after)
    gain -= likelihood(before + after, of_before + of_after)
    return int(_DEAD_TIMES[np.argmax(np.where(sudden, gain, -np.inf))])


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
