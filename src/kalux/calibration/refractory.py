"""How soon pixels can follow one event by another, and what that says of their refractory period."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.compiled import empty, loop
from kalux.events import NEVER
from kalux.recording import Recording

_EDGE: Final = 0.02  # of the most frequent inter-event interval: what is rarer and shorter is noise
_MOST_OF_PIXEL: Final = 200  # intervals: some hot pixels are then a few percent of a recording's
_FINE: Final = 10  # fine bins, 2 % wide, in one of the bins whose edges count
_EDGE_BINS: Final = np.logspace(1, 6, 50 * _FINE + 1)  # us

_PILE: Final = 0.1
"""Share of the intervals up to twice as long that one fine bin has where events pile up in it. 0.005 to 0.05 on forty
scenes and recordings whose pixels are reset or lose nothing, 0.15 to 0.48 on eight whose events wait."""

_LEAST_PILE: Final = 100  # us: fine bins of shorter intervals hold one or two whole microseconds
_LEAST_PILED: Final = 1_000  # intervals up to twice as long, so that no share of 0.05 is chance

_TRIED: Final = (0.35, 0.6, 0.85, 1.1)
"""Refractory periods that are tried, as shares of the shortest interval, between which the best is interpolated. None
is longer than that, but it is only known to lie in a bin of a quarter of its size."""

LATE: Final = 5.0
"""Events later than so many shortest intervals after their predecessors say little of the refractory period: at most a
quarter of their step is lost. And they are as often noise, or the rest of a change that was not finished."""


_DEAD_EVENTS: Final = 2_000_000
_DEAD_TIMES: Final = np.arange(50, 5_001)  # us: those of sensors and simulators
_LEAST_AFTER: Final = 25
"""Intervals up to a tenth longer than the dead time: were there none, 125 would lie in the half of it before them."""

_MOST_BEFORE: Final = 0.02
"""Of how densely intervals lie just beyond the dead time, how densely they may lie in the half of it before: pixels
differ. Where only the light's pace keeps events apart, intervals set in by degrees: 0.06 of it and more where their
density grows by the tenth power of their length."""

_MOST_BEYOND: Final = 1.6
"""How many times as dense, or less, intervals of 1.1 to 1.2 dead times are: 0.7 to 1.2 on thirteen simulated scenes,
2.3 on a DAVIS346 before a bench, where the density grows from near nothing by the tenth power."""

_LEAST_BEYOND: Final = 1 / 3
"""The same, at least: events that wait for the end of their pixel's dead time and lose nothing (`Intervals.pile_up`)
are denser there."""


_LEAST_TURNING: Final = 0.2
"""Share of the intervals just beyond the dead time whose events differ in polarity: a half of noise, 0.29 to 0.57 on
thirteen simulated scenes; none where edges of one speed and contrast make intervals that are all alike."""


class Intervals(NamedTuple):
    """Times between two events of a pixel.

    Attributes
    ----------
    shortest
        Their lower edge, us: no refractory period is longer. 0 without events that follow one another.
    pile_up
        Whether many are the same. A pixel that is held in reset needs a new change of a threshold after that, and no
        interval is preferred. Where events only wait, to be told as soon as the pixel may, they come when its time is
        over: nothing is lost (equations.md, K13).
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
    read = 0
    for chunk in recording.events():
        part = chunk[: most_events - read]
        yield _intervals_of(part["t"], part["x"], part["y"], part["p"], last, seen)
        read += len(part)
        if read >= most_events:
            break


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
