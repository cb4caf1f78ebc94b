"""Changes that a pixel cannot report in its refractory period: a weight for every event makes up for them.

After an event a pixel is held in reset for its refractory period, and compares with the light at the end of that, not
with the light at the event. What changed meanwhile is never reported. A pixel that looked for the time l before it
reported a threshold saw light of the pace 1 / l. In the refractory period between two looks the light went on at their
mean pace, so that from event to event it changes by about so many thresholds:

    1 + rho (1 / l + 1 / l') / 2,      l = Delta - rho,                                       (docs/equations.md, K13)

with rho the refractory period, Delta the time since the pixel's previous event and l' the look before that, if all
three events have the same polarity; of the first two l alone tells the pace. Looks are taken to be a little longer than
they were, since a short one may be chance or noise.

Where the direction turns, or nothing follows, the light went on in the refractory period all the same. So a part of
what that is to hide, as the slower of the two last paces tells, is counted when it begins, and the rest with the next
event, if that goes on. Every event is given its weight once, when it arrives, in the bytes that
`kalux.events.EVENT_DTYPE` leaves unused; all that adds up steps multiplies by it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.compiled import (
    AHEAD,
    ONE,
    WEIGHT_UNIT,
    event_column,
    event_is_on,
    event_row,
    event_weight,
    event_words,
    larger,
    loop,
    prefetch,
    smaller,
    weighed,
)
from kalux.events import EVENT_DTYPE, NEVER, EventArray

_UNSTEADY: Final = np.float32(0.2)
"""Refractory periods by which a look is taken to be longer, as the other side of a right triangle, where it alone tells
the pace: second events of one polarity that come 1.2 to 1.3 periods after the first stand for 3.7 to 4.2 thresholds on
simulated scenes, where it would be 5 without (docs/equations.md, K13)."""

_UNSTEADY_OF_TWO: Final = np.float32(0.15)
"""The same of either look where two tell the pace. With 0.1 the few pixels that noise gives two short looks in a row
come out several times too bright."""

_LAG: Final = np.float32(500.0)
"""us: a photoreceptor's low pass rounds off turns, so that looks show it where light slows down. Where a period is no
longer than that, little of what it hides lies beyond a turn: of a DAVIS240C with 0.5 ms, counting half of it makes the
MSE of pans 1.03 of what it is without; of sensors without low pass 0.96 to 1.00 (docs/equations.md, K13)."""

_EARLY: Final = np.float32(0.95)
"""Shares of the refractory period from which on an event counts as one that came at its end: pixels differ. What comes
earlier is noise, of which no light was missed."""


class EventClock:
    """Weighs the events of a stream; remembers when every pixel had its latest one.

    Parameters
    ----------
    sensor_size
        (height, width), pixels.
    refractory_period
        us; 0: every event has the weight 1.
    """

    def __init__(self, sensor_size: tuple[int, int], refractory_period: float) -> None:
        self._sensor_size = sensor_size
        self._refractory_period = np.float32(refractory_period)
        self._latest: NDArray[np.int64] | None = (
            None  # twice its time, plus 1 if it was on; once it is needed
        )
        self._before = np.empty(0, np.float32)  # us, of `step_weight`
        self._counted = np.empty(0, np.float32)  # thresholds, of `_to_come`

    @property
    def weighs(self) -> bool:
        """Whether events may have other weights than 1."""
        return bool(self._refractory_period > 0)

    def weigh(self, words: NDArray[np.int64]) -> None:
        """Write the weights of the next events into their words (`kalux.compiled.event_words`), in place."""
        if not self.weighs:
            _weigh_equally(words)
            return
        height, width = self._sensor_size
        if self._latest is None:
            self._latest = np.full(height * width, NEVER, np.int64)
            self._before = np.zeros(height * width, np.float32)
            self._counted = np.zeros(height * width, np.float32)
        memory = self._latest, self._before, self._counted
        _weigh(words, *memory, np.uint64(width), self._refractory_period)

    def weighed(self, events: EventArray) -> EventArray:
        """A copy of the next events, with their weights."""
        words = event_words(events).copy()
        self.weigh(words)
        return words.reshape(-1).view(EVENT_DTYPE)


@nb.njit(cache=True, inline="always", error_model="numpy")
def step_weight(since_pixel, before, refractory_period):  # type: ignore[no-untyped-def]
    """Thresholds from the pixel's previous event to one that goes on where that went (K13); float32.

    ``since_pixel`` us after the previous one, which came ``before`` us after one that it went on from, or 0.
    """
    earliest = _EARLY * refractory_period
    if since_pixel <= earliest:  # also without a period, of events at one time
        return ONE
    if before <= earliest:
        return ONE + _pace(since_pixel, refractory_period, _UNSTEADY)
    pace = _pace(since_pixel, refractory_period, _UNSTEADY_OF_TWO)
    return ONE + np.float32(0.5) * (pace + _pace(before, refractory_period, _UNSTEADY_OF_TWO))


@nb.njit(cache=True, inline="always", error_model="numpy")
def _to_come(since_pixel, before, refractory_period):  # type: ignore[no-untyped-def]
    """Thresholds of an event of `step_weight` for what its own refractory period will hide (K13); float32."""
    if before <= _EARLY * refractory_period or refractory_period <= _LAG:  # one look alone may be noise
        return np.float32(0.0)
    pace = _pace(since_pixel, refractory_period, _UNSTEADY_OF_TWO)
    slower = smaller(pace, _pace(before, refractory_period, _UNSTEADY_OF_TWO))
    return np.float32(0.5) * (ONE - _LAG / refractory_period) * slower


@nb.njit(cache=True, inline="always", error_model="numpy")
def _pace(interval, refractory_period, unsteady):  # type: ignore[no-untyped-def]
    """Thresholds in a refractory period, by the look that ended an ``interval`` between two events, us."""
    looked, unsteady = interval - refractory_period, unsteady * refractory_period
    return refractory_period / np.sqrt(looked * looked + unsteady * unsteady)


def growth_with_period(
    chunks: Iterable[EventArray], shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """By how much the weights of on and of off events of every pixel would grow with the refractory period (K10).

    Parameters
    ----------
    chunks
        Events with their weights.
    shape
        (H, W).

    Returns
    -------
    (H, W) each, thresholds: sums of the derivatives of weights by the logarithm of the refractory period.
    """
    height, width = shape
    grown = np.zeros((2, height * width), np.float32)
    for chunk in chunks:
        _growth_with_period(event_words(chunk), grown, np.uint64(width))
    return grown[1].reshape(shape), grown[0].reshape(shape)


@loop
def _growth_with_period(words, grown, width):  # type: ignore[no-untyped-def]
    for i in range(len(words)):
        word = words[i, 1]
        hidden = event_weight(word, WEIGHT_UNIT) - ONE
        if hidden > np.float32(0.0):
            at = event_row(word) * width + event_column(word)
            grown[np.uint64(event_is_on(word)), at] += _growth_of_pace(hidden)


@nb.njit(cache=True, inline="always", error_model="numpy")
def _growth_of_pace(pace):  # type: ignore[no-untyped-def]
    """Derivative of a `_pace` by the logarithm of the refractory period; at least the pace itself; float32."""
    unsteady = _UNSTEADY_OF_TWO * _UNSTEADY_OF_TWO
    looked = np.sqrt(larger(ONE / (pace * pace) - unsteady, np.float32(0.0)))  # in refractory periods
    return pace + larger(pace * pace * pace * (looked - unsteady), np.float32(0.0))


@loop
def _weigh(words, latest, before, counted, width, refractory_period):  # type: ignore[no-untyped-def]
    last = len(words) - 1
    for i in range(len(words)):
        ahead = words[smaller(i + AHEAD, last), 1]
        place = event_row(ahead) * width + event_column(ahead)
        prefetch(latest, place)
        prefetch(before, place)
        prefetch(counted, place)
        t, word = words[i, 0], words[i, 1]
        at = event_row(word) * width + event_column(word)
        code = t * 2 + np.int64(event_is_on(word))
        goes_on = latest[at] != NEVER and (code ^ latest[at]) & 1 == 0
        since = np.float32(t - (latest[at] >> 1))
        weight, to_come = ONE, np.float32(0.0)
        if goes_on and since > _EARLY * refractory_period:
            to_come = _to_come(since, before[at], refractory_period)
            weight = step_weight(since, before[at], refractory_period) - counted[at] + to_come
        before[at] = since if goes_on else np.float32(0.0)
        counted[at] = to_come
        latest[at] = code
        words[i, 1] = weighed(word, np.int32((weight - ONE) / WEIGHT_UNIT + np.float32(0.5)))


@loop
def _weigh_equally(words):  # type: ignore[no-untyped-def]
    for i in range(len(words)):
        words[i, 1] = weighed(words[i, 1], np.int32(0))
