"""The events that the engine holds: added at the end, dropped at the start, each copied once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numba as nb
import numpy as np

from kalux.augmentation.refractory import EventClock
from kalux.compiled import UNWEIGHED, event_column, event_row, event_words, loop
from kalux.event_slices import events_until
from kalux.events import EVENT_DTYPE, LATEST, EventArray

_BLOCK: Final = 1 << 16
"""Least events of a block of memory, 1 MB, so that pushes of single events do not allocate each."""

_SPARE: Final = 1 << 20
"""Largest block that is kept for reuse: fresh memory costs more than the copy into it."""


class _Block:
    """Events ``start`` to ``stop`` of some memory, the last of them at ``last`` (us); what is behind them is free."""

    def __init__(self, memory: EventArray) -> None:
        self.memory, self.start, self.stop, self.last = memory, 0, 0, 0

    @property
    def events(self) -> EventArray:
        return self.memory[self.start : self.stop]

    def until(self, t: int) -> int:
        """Number of the events up to and at ``t`` (us)."""
        return self.stop - self.start if self.last <= t else events_until(self.events, t)


class EventBuffer:
    """Events in time order, numbered from 0 on as they were appended, with the weights that ``clock`` gives them."""

    def __init__(self, clock: EventClock) -> None:
        self._clock = clock
        self._blocks: list[_Block] = []
        self._spare: EventArray | None = None
        self._first = 0  # number of the first event held

    def __len__(self) -> int:
        return sum(block.stop - block.start for block in self._blocks)

    def __getstate__(self) -> dict[str, Any]:
        """Pickled without the free memory."""
        blocks = []
        for block in self._blocks:
            blocks.append(_Block(_copied(block.events)))
            blocks[-1].stop, blocks[-1].last = len(blocks[-1].memory), block.last
        return {"_clock": self._clock, "_blocks": blocks, "_spare": None, "_first": self._first}

    @property
    def first(self) -> int:
        """Number of the first event held."""
        return self._first

    @property
    def chunks(self) -> list[EventArray]:
        """All events, in a few arrays."""
        return [block.events for block in self._blocks]

    def append(
        self,
        events: EventArray,
        sensor_size: tuple[int, int],
        *,
        earliest: int | None,
        delay: int,
        weighed: bool = False,
    ) -> bool:
        """Copy events to the end, ``delay`` us earlier than stamped; ``weighed`` ones carry their weights already.

        False, and nothing is appended, unless they are in time order, none is stamped before ``earliest`` (us) or
        beyond what is possible, and all lie inside the sensor, (height, width).
        """
        count = len(events)
        if count == 0:
            return True
        if not self._blocks or len(self._blocks[-1].memory) - self._blocks[-1].stop < count:
            memory, self._spare = self._spare, None
            if memory is None or len(memory) < count:
                memory = np.empty(max(count, _BLOCK), EVENT_DTYPE)
            block = _Block(memory)
        else:
            block = self._blocks[-1]
        height, width = (np.uint64(n) for n in sensor_size)
        least = -LATEST if earliest is None else earliest
        free = event_words(block.memory[block.stop : block.stop + count])
        kept = np.int64(-1) if weighed else UNWEIGHED
        fine = _copy_checked(event_words(events), free, least, delay, height, width, kept)
        if not fine or events["t"][-1] > LATEST:
            return False
        if not weighed and self._clock.weighs:
            self._clock.weigh(free)
        block.stop += count
        block.last = int(free[-1, 0])
        if not (self._blocks and self._blocks[-1] is block):
            self._blocks.append(block)
        return True

    def drop(self, until: int) -> None:
        """Forget the events up to and at ``until`` (us)."""
        while self._blocks:
            block = self._blocks[0]
            count = block.until(until)
            block.start += count
            self._first += count
            if block.start < block.stop:
                break
            self._blocks.pop(0)
            spare = 0 if self._spare is None else len(self._spare)
            if spare < len(block.memory) <= _SPARE:
                self._spare = block.memory
        if self._blocks and 2 * (self._blocks[0].stop - self._blocks[0].start) < len(self._blocks[0].memory):
            self._shrink(self._blocks[0])

    def number(self, t: int) -> int:
        """Number of the first event after the time ``t`` (us), one more than that of the last if there is none."""
        number = self._first
        for block in self._blocks:
            count = block.until(t)
            number += count
            if count < block.stop - block.start:
                break
        return number

    def after(self, number: int, until: int) -> Iterator[EventArray]:
        """The events from ``number`` on up to and at the time ``until`` (us), in order, in a few arrays."""
        first = self._first
        for block in self._blocks:
            count = block.stop - block.start
            if number < first + count:
                start, stop = max(number - first, 0), block.until(until)
                if start < stop:
                    yield block.events[start:stop]
                if stop < count:
                    return
            first += count

    def _shrink(self, block: _Block) -> None:
        """Copy the rest of a large block to memory of its own size, so that the block is freed."""
        if len(block.memory) > _SPARE:
            rest = _copied(block.events)
            block.memory, block.start, block.stop = rest, 0, len(rest)


def _copied(events: EventArray) -> EventArray:
    """A copy with the events' weights, which NumPy's copy takes for padding and leaves out."""
    return event_words(events).copy().reshape(-1).view(EVENT_DTYPE)


@nb.njit(cache=True, inline="always")
def _outside(word, height, width):  # type: ignore[no-untyped-def]
    return (event_column(word) >= width) | (event_row(word) >= height)


@loop
def _copy_checked(words, copy, earliest, delay, height, width, kept):  # type: ignore[no-untyped-def]
    """Copy event words, one or more, with their times moved; False if an event is out of order or outside the sensor.

    ``kept`` are the bits of the second word that are copied. Each event is compared with the next one, in flat arrays:
    vector code.
    """
    given, taken = words.reshape(-1), copy.reshape(-1)
    one, two = np.uint64(1), np.uint64(2)
    last = np.uint64(2 * len(words) - 2)
    wrong = (given[0] < earliest) | _outside(given[last + one], height, width)
    for i in range(np.uint64(len(words) - 1)):
        at = two * i
        word = given[at + one]
        wrong |= (given[at + two] < given[at]) | _outside(word, height, width)
        taken[at] = given[at] - delay
        taken[at + one] = word & kept
    taken[last] = given[last] - delay
    taken[last + one] = given[last + one] & kept
    return not wrong
