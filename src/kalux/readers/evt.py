"""Prophesee's event encodings: EVT 2.0, 2.1 and 3.0, as in RAW files and in ROS event packets, and DAT.

Written from the public descriptions at https://docs.prophesee.ai/stable/data/encoding_formats/. An encoded stream is a
sequence of little-endian words of 2 (EVT3), 4 (EVT2) or 8 (EVT2.1) bytes, whose top four bits say what they are.
Times come in two parts, high bits in words of their own, and wrap around (EVT3 every 16.8 s, the others every 4.8 h).
A word of DAT (8 bytes) is an event; its time wraps around every 1.2 h.

All that a decoder knows is in its state, an array, so that a stream decodes to the same events however it is cut.
What real streams need, as in the vendor's decoder:

- Words before the first high time are ignored: they cannot be dated. So are EVT3 events before the first row.
- EVT3 events outside the sensor are dropped: the last part of a vector may lie there, and some sensors send
  rows that do not exist.
- A clock that wrapped is told from one that went back by the size of the step: at least half of the range.

And beyond it: where the clock goes back a little (single wrong bits do occur), events keep the time of the event
before, so times never decrease. Where it goes back by more than 41 ms, the stream is damaged, or two recordings in one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from kalux.events import EVENT_DTYPE, EventArray
from kalux.readers.source import CHUNK_EVENTS, TRIGGER_DTYPE, TriggerArray

# What a decoder remembers from word to word, int64: the places of it. Times are in us, without wrap-around.
STARTED, HIGH, _LOW, NOW, _Y, _X, _POLARITY, ERROR = range(8)
_STATE_SIZE: Final = 8

_NO_ROW: Final = 0xFFFF
_NO_COLUMN: Final = 1 << 16
ROOM: Final = 32  # events of one word, at most
_TRIGGERS: Final = 4096  # room for trigger events
BACKWARDS_US: Final = 10 << 12  # that the clock may go back: ten high times of EVT3


class ClockError(ValueError):
    """The sensor's clock goes back."""


@dataclass(frozen=True)
class Encoding:
    """One of the encodings.

    Attributes
    ----------
    name
        As in the header of a RAW file.
    word
        Dtype of a word.
    kernel
        Decodes words: (words, state, events, triggers, height, width) -> numbers of words used, of events and
        of triggers. Stops early where an output is full or the clock is wrong.
    """

    name: str
    word: np.dtype[Any]
    kernel: Callable[..., tuple[int, int, int]]


def new_state() -> NDArray[np.int64]:
    """The state of a decoder before the first word."""
    state = np.zeros(_STATE_SIZE, np.int64)
    state[_Y] = _NO_ROW
    return state


def resume(state: NDArray[np.int64], time: int) -> None:
    """Let a decoder of EVT3 go on after words that are lost, at a TIME_HIGH of the given time, us.

    Raises
    ------
    ClockError
        If that is before what it has decoded.
    """
    state[HIGH], state[_LOW] = time >> 12 << 12, 0
    state[_Y], state[_X] = _NO_ROW, _NO_COLUMN
    if state[HIGH] + BACKWARDS_US < state[NOW]:
        raise ClockError(f"the sensor's clock goes back from {state[NOW]} to {state[HIGH]} us")


def decode_events(
    encoding: Encoding,
    blocks: Iterable[NDArray[Any]],
    sensor_size: tuple[int, int],
    state: NDArray[np.int64] | None = None,
) -> Iterator[EventArray]:
    """The events of a stream of words.

    Parameters
    ----------
    encoding
        One of `EVT2`, `EVT21`, `EVT21_LEGACY`, `EVT3`, `DAT`.
    blocks
        Consecutive arrays of words, of any lengths.
    sensor_size
        (height, width), pixels. Used by EVT3 only.
    state
        A `new_state` that whoever makes the blocks may `resume` between two of them.

    Yields
    ------
    Chunks of at most `CHUNK_EVENTS` events, in time order. How the blocks are cut makes no difference.

    Raises
    ------
    ClockError
        Where the time goes back.
    """
    triggers = np.empty((_TRIGGERS, 2), np.uint64)
    out, count = _event_buffer(), 0
    for found, _ in _run(encoding, blocks, sensor_size, triggers, state):
        while len(found):
            part = found[: CHUNK_EVENTS - count]
            out[count : count + len(part)] = part
            count += len(part)
            found = found[len(part) :]
            if count == CHUNK_EVENTS:
                yield rows_as_events(out)
                out, count = _event_buffer(), 0
    if count:
        yield rows_as_events(out[:count])


def decode_triggers(
    encoding: Encoding,
    blocks: Iterable[NDArray[Any]],
    sensor_size: tuple[int, int],
    state: NDArray[np.int64] | None = None,
) -> Iterator[TriggerArray]:
    """The edges on the external trigger inputs in a stream of words, in bounded chunks; see `decode_events`."""
    triggers = np.empty((_TRIGGERS, 2), np.uint64)
    held: list[NDArray[np.uint64]] = []
    for _, found in _run(encoding, blocks, sensor_size, triggers, state):
        if len(found):
            held.append(found.copy())
        if sum(map(len, held)) >= _TRIGGERS:
            yield _as_triggers(np.concatenate(held))
            held = []
    if held:
        yield _as_triggers(np.concatenate(held))


def _run(
    encoding: Encoding,
    blocks: Iterable[NDArray[Any]],
    sensor_size: tuple[int, int],
    triggers: NDArray[np.uint64],
    state: NDArray[np.int64] | None,
) -> Iterator[tuple[NDArray[np.uint64], NDArray[np.uint64]]]:
    """Events and triggers of as many words as the buffers hold, which are used again and again."""
    events = np.empty((_WORK_EVENTS + ROOM, 2), np.uint64)
    state = new_state() if state is None else state
    height, width = sensor_size
    position = 0
    for words in blocks:
        while len(words):
            used, count, count_triggers = encoding.kernel(words, state, events, triggers, height, width)
            if state[ERROR]:
                raise ClockError(
                    f"the sensor's clock goes back from {state[NOW]} to {state[HIGH]} us at word {position + used}"
                )
            yield events[:count], triggers[:count_triggers]
            position += used
            words = words[used:]


_WORK_EVENTS: Final = 1 << 15  # half a MiB: stays in the cache between decoding and copying


def _event_buffer() -> NDArray[np.uint64]:
    return np.empty((CHUNK_EVENTS, 2), np.uint64)


def rows_as_events(rows: NDArray[np.uint64]) -> EventArray:
    return rows.view(EVENT_DTYPE)[:, 0]


def _as_triggers(rows: NDArray[np.uint64]) -> TriggerArray:
    out = np.zeros(len(rows), TRIGGER_DTYPE)
    out["t"] = rows[:, 0].astype(np.int64)
    out["id"] = rows[:, 1] >> np.uint64(1)
    out["rising"] = (rows[:, 1] & np.uint64(1)).astype(bool)
    return out


# The loops. An event is written as two 64-bit numbers, the time and the rest: EVENT_DTYPE in memory.


@njit(cache=True, nogil=True, inline="always")
def place(x, y, polarity):  # type: ignore[no-untyped-def]
    return np.uint64(x) | np.uint64(y) << np.uint64(16) | np.uint64(polarity) << np.uint64(32)


@njit(cache=True, nogil=True, inline="always")
def put_trigger(triggers, count, t, pin, edge):  # type: ignore[no-untyped-def]
    """How many triggers there are with this one."""
    triggers[count, 0] = t
    triggers[count, 1] = pin << 1 | edge
    return count + 1


@njit(cache=True, nogil=True, inline="always")
def _unwrap(high, new, wrap, backwards):  # type: ignore[no-untyped-def]
    """The high time, us, that is meant by its lowest bits.

    ``wrap``, a power of two, is where those begin again. Where the clock seems to leap over nearly all of them,
    it has gone back a little to before a wrap.
    """
    last = high & (wrap - 1)
    start = high - last
    if last - new >= wrap // 2:
        start += wrap
    elif new - last >= wrap - backwards and start > 0:
        start -= wrap
    return start + new


@njit(cache=True, nogil=True)
def _decode_evt3(words, state, events, triggers, height, width):  # type: ignore[no-untyped-def]
    started, high, low, now = state[STARTED], state[HIGH], state[_LOW], state[NOW]
    y, x, polarity = state[_Y], state[_X], state[_POLARITY]
    capacity, trigger_capacity = len(events) - ROOM, len(triggers)
    count, count_triggers, i = 0, 0, 0
    while not started and i < len(words):
        started = np.int64(words[i] >> 12 == 0x8)
        if started:
            high = np.int64(words[i] & 0xFFF) << 12
        i += 1
    now = max(now, high)
    while i < len(words) and count < capacity and count_triggers < trigger_capacity:
        word = np.int64(words[i])
        i += 1
        kind = word >> 12
        # Nearly all words are of these kinds, in an order that the processor cannot guess, so they are told apart
        # without branches: what is written below is an event only if it is counted. Repeated TIME_HIGH, OTHERS
        # and what CONTINUES them change nothing.
        if 0b1100_0000_1100_0101 >> kind & 1 | (word == 0x8000 | high >> 12 & 0xFFF):
            # ADDR_Y; its bit 11 marks another camera's rows, which are outside by that
            y ^= (y ^ word & 0xFFF) & -np.int64(kind == 0x0)
            # TIME_LOW
            low ^= (low ^ word & 0xFFF) & -np.int64(kind == 0x6)
            now = max(now, high + low)
            # ADDR_X
            column = word & 0x7FF
            events[count, 0] = now
            events[count, 1] = place(column, y, word >> 11 & 1)
            count += (kind == 0x2) & (y < height) & (column < width)
        elif kind == 0x8:  # TIME_HIGH
            high, low = _unwrap(high, (word & 0xFFF) << 12, 1 << 24, BACKWARDS_US), 0
            if high + BACKWARDS_US < now:
                state[ERROR] = 1
                i -= 1
                break
            now = max(now, high)
        elif kind == 0x3:  # VECT_BASE_X
            x = word & 0x7FF
            polarity = word >> 11 & 1
        elif kind == 0x4 or kind == 0x5:  # VECT_12, VECT_8: a bit for each of the next columns
            length = 12 if kind == 0x4 else 8
            if y < height:
                valid = word & ((1 << length) - 1)
                rest = place(0, y, polarity)
                column = x
                while valid:
                    if valid & 1 and column < width:
                        events[count, 0] = now
                        events[count, 1] = rest | np.uint64(column)
                        count += 1
                    valid >>= 1
                    column += 1
            x += length
        elif kind == 0xA:  # EXT_TRIGGER
            count_triggers = put_trigger(triggers, count_triggers, now, word >> 8 & 0xF, word & 1)
        elif kind == 0x1:  # rows of events that are not changes of brightness, in old cameras
            y = _NO_ROW
    state[STARTED], state[HIGH], state[_LOW], state[NOW] = started, high, low, now
    state[_Y], state[_X], state[_POLARITY] = y, x, polarity
    return i, count, count_triggers


@njit(cache=True, nogil=True, inline="always")
def _evt2_high(state, started, high, now, new):  # type: ignore[no-untyped-def]
    """The next high time of EVT2 and 2.1, us; the state's error is set where it goes back too far."""
    high = _unwrap(high, new, 1 << 34, BACKWARDS_US) if started else new
    if high + BACKWARDS_US < now:
        state[ERROR] = 1
    return high


@njit(cache=True, nogil=True, inline="always")
def _evt2_now(now, high, head):  # type: ignore[no-untyped-def]
    """The time, us, of an event or trigger of EVT2 and 2.1, never before the one before."""
    return max(now, high + (head >> 22 & 0x3F))


@njit(cache=True, nogil=True, inline="always")
def _evt2_trigger(triggers, count, now, head):  # type: ignore[no-untyped-def]
    return put_trigger(triggers, count, now, head >> 8 & 0x1F, head & 1)


@njit(cache=True, nogil=True)
def _decode_evt2(words, state, events, triggers, height, width):  # type: ignore[no-untyped-def]
    started, high, now = state[STARTED], state[HIGH], state[NOW]
    capacity, trigger_capacity = len(events) - ROOM, len(triggers)
    count, count_triggers, i = 0, 0, 0
    while i < len(words) and count < capacity and count_triggers < trigger_capacity:
        word = np.int64(words[i])
        i += 1
        kind = word >> 28
        if kind == 0x8:  # TIME_HIGH
            high = _evt2_high(state, started, high, now, (word & 0xFFFFFFF) << 6)
            started = 1
            if state[ERROR]:
                i -= 1
                break
        elif not started:
            continue
        elif kind <= 0x1:  # CD_OFF, CD_ON
            now = _evt2_now(now, high, word)
            events[count, 0] = now
            events[count, 1] = place(word >> 11 & 0x7FF, word & 0x7FF, kind)
            count += 1
        elif kind == 0xA:  # EXT_TRIGGER
            now = _evt2_now(now, high, word)
            count_triggers = _evt2_trigger(triggers, count_triggers, now, word)
    state[STARTED], state[HIGH], state[NOW] = started, high, now
    return i, count, count_triggers


@njit(cache=True, nogil=True)
def _decode_evt21(words, state, events, triggers, height, width, head_shift):  # type: ignore[no-untyped-def]
    """``head_shift``: where the half with type, time and place lies, 32, or 0 in the legacy order of the halves."""
    started, high, now = state[STARTED], state[HIGH], state[NOW]
    capacity, trigger_capacity = len(events) - ROOM, len(triggers)
    count, count_triggers, i = 0, 0, 0
    while i < len(words) and count < capacity and count_triggers < trigger_capacity:
        head = np.int64(words[i] >> np.uint64(head_shift) & np.uint64(0xFFFFFFFF))
        valid = np.int64(words[i] >> np.uint64(32 - head_shift) & np.uint64(0xFFFFFFFF))
        i += 1
        kind = head >> 28
        if kind == 0x8:  # TIME_HIGH
            high = _evt2_high(state, started, high, now, (head & 0xFFFFFFF) << 6)
            started = 1
            if state[ERROR]:
                i -= 1
                break
        elif not started:
            continue
        elif kind <= 0x1:  # NEG, POS: a bit for each of 32 columns
            now = _evt2_now(now, high, head)
            column = head >> 11 & 0x7FF
            rest = place(0, head & 0x7FF, kind)
            while valid:
                if valid & 1:
                    events[count, 0] = now
                    events[count, 1] = rest | np.uint64(column)
                    count += 1
                valid >>= 1
                column += 1
        elif kind == 0xA:  # EXT_TRIGGER
            now = _evt2_now(now, high, head)
            count_triggers = _evt2_trigger(triggers, count_triggers, now, head)
    state[STARTED], state[HIGH], state[NOW] = started, high, now
    return i, count, count_triggers


@njit(cache=True, nogil=True)
def _decode_evt21_in_order(words, state, events, triggers, height, width):  # type: ignore[no-untyped-def]
    return _decode_evt21(words, state, events, triggers, height, width, 32)


@njit(cache=True, nogil=True)
def _decode_evt21_legacy(words, state, events, triggers, height, width):  # type: ignore[no-untyped-def]
    return _decode_evt21(words, state, events, triggers, height, width, 0)


@njit(cache=True, nogil=True)
def _decode_dat(words, state, events, triggers, height, width):  # type: ignore[no-untyped-def]
    started, high, now = state[STARTED], state[HIGH], state[NOW]
    count = min(len(words), len(events))
    for i in range(count):
        word = np.int64(words[i] & np.uint64(0x1FFFFFFFFFFFFFFF))
        new = word & 0xFFFFFFFF
        high = _unwrap(high, new, 1 << 32, BACKWARDS_US) if started else new
        started = 1
        if high + BACKWARDS_US < now:
            state[ERROR] = 1
            count = i
            break
        now = max(now, high)
        events[i, 0] = now
        events[i, 1] = place(word >> 32 & 0x3FFF, word >> 46 & 0x3FFF, word >> 60)
    state[STARTED], state[HIGH], state[NOW] = started, high, now
    return count, count, 0


EVT2: Final = Encoding("EVT2", np.dtype("<u4"), _decode_evt2)
EVT21: Final = Encoding("EVT21", np.dtype("<u8"), _decode_evt21_in_order)
EVT21_LEGACY: Final = Encoding("EVT21", np.dtype("<u8"), _decode_evt21_legacy)
EVT3: Final = Encoding("EVT3", np.dtype("<u2"), _decode_evt3)
DAT: Final = Encoding("DAT", np.dtype("<u8"), _decode_dat)
