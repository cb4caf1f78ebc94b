"""Changes that a pixel cannot report in its refractory period: a weight for every event makes up for them.

After an event a pixel is held in reset for its refractory period, and compares with the light at the end of that, not
with the light at the event. What changed meanwhile is never reported. If the light goes on at one pace from one event
to the next, it changes by the threshold in the time in which the pixel looks, so that from event to event it changes by
about the threshold times

    w = Delta / ((Delta - rho)^2 + (rho / 5)^2)^(1/2)                                       (docs/equations.md, K13)

with rho the refractory period and Delta the time since the pixel's previous event, if that has the same polarity; rho /
5 is there because the pace is not the same all the time, and what looked for a short time says little of it. Where the
direction turns, the light may have moved either way meanwhile, and nothing is added: w = 1. Every event is given its
weight once, when it arrives, in the bytes that `kalux.events.EVENT_DTYPE` leaves unused; all that adds up steps
multiplies by it.
"""

from __future__ import annotations

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
    event_words,
    loop,
    prefetch,
    smaller,
    weighed,
)
from kalux.events import EVENT_DTYPE, NEVER, EventArray

_UNSTEADY: Final = np.float32(0.2)
"""Refractory periods by which the time in which a pixel looked is taken to be longer, as the other side of a right
triangle: events of light that come 1.2 to 1.3 periods after another stand for 2.9 to 4.0 thresholds on simulated
scenes, where it would be 4.5 to 4.8 without (docs/equations.md, K13)."""

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
        _weigh(words, self._latest, np.uint64(width), self._refractory_period)

    def weighed(self, events: EventArray) -> EventArray:
        """A copy of the next events, with their weights."""
        words = event_words(events).copy()
        self.weigh(words)
        return words.reshape(-1).view(EVENT_DTYPE)


@nb.njit(cache=True, inline="always", error_model="numpy")
def step_weight(since_pixel, refractory_period):  # type: ignore[no-untyped-def]
    """Thresholds that an event stands for (K13), ``since_pixel`` us after the pixel's previous one; float32."""
    if since_pixel <= _EARLY * refractory_period:  # also without a period, of events at one time
        return ONE
    looked, unsteady = since_pixel - refractory_period, _UNSTEADY * refractory_period
    return since_pixel / np.sqrt(looked * looked + unsteady * unsteady)


@loop
def _weigh(words, latest, width, refractory_period):  # type: ignore[no-untyped-def]
    last = len(words) - 1
    for i in range(len(words)):
        ahead = words[smaller(i + AHEAD, last), 1]
        prefetch(latest, event_row(ahead) * width + event_column(ahead))
        t, word = words[i, 0], words[i, 1]
        at = event_row(word) * width + event_column(word)
        code = t * 2 + np.int64(event_is_on(word))
        goes_on = (code ^ latest[at]) & 1 == 0
        weight = step_weight(np.float32(t - (latest[at] >> 1)), refractory_period) if goes_on else ONE
        latest[at] = code
        words[i, 1] = weighed(word, np.int32((weight - ONE) / WEIGHT_UNIT + np.float32(0.5)))


@loop
def _weigh_equally(words):  # type: ignore[no-untyped-def]
    for i in range(len(words)):
        words[i, 1] = weighed(words[i, 1], np.int32(0))
