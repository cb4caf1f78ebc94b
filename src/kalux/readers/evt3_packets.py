"""EVT3 in ROS packets: one stream of words, of which packets may be lost, dated by the stamps of the packets.

What a word means depends on words before it, also of other packets. Where the packets' numbers leap, words are
ignored up to the next high part of a time, as at the beginning of a stream, and rows and columns are unknown until
they are stated again. The sensor's time wraps around every 16.8 s: which time is meant after a gap, the stamps tell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from kalux.events import EventArray
from kalux.readers import evt
from kalux.readers.source import TriggerArray

_JOINED_WORDS: Final = 1 << 16
_WRAP: Final = 1 << 24  # us
_LARGEST_NUMBER: Final = (1 << 63) - 1
_LEAP_US: Final = 1_000_000
"""From packet to packet, stamps and the sensor's clock go on alike, but for some milliseconds, or the time that a busy
computer leaves a packet waiting. More is another clock."""

# What is known of the packets so far, int64: whether there was a time; number of the last packet; stamp and time of the
# last one that states a time, us, without wrap-around; whether packets were lost since.
_STARTED, _NUMBER, _STAMP, _TIME, _LOST = range(5)


class Packet(NamedTuple):
    """``number`` in the sequence of packets; ``stamp`` in us."""

    number: int
    stamp: int
    words: NDArray[Any]


class RestartError(ValueError):
    """A clock or the driver was started anew within the recording."""


def decode_events(packets: Iterable[Packet], size: tuple[int, int], offset: int) -> Iterator[EventArray]:
    """The events of packets, in chunks; ``offset`` is added to the sensor's time.

    Raises
    ------
    ClockError
        Where the time goes back.
    RestartError
        Where stamps and times do not go on alike.
    """
    return _shifted(evt.decode_events, packets, size, offset)


def decode_triggers(packets: Iterable[Packet], size: tuple[int, int], offset: int) -> Iterator[TriggerArray]:
    """The edges on trigger inputs, as `decode_events`."""
    return _shifted(evt.decode_triggers, packets, size, offset)


def _shifted(
    decode: Callable[..., Iterator[NDArray[np.void]]],
    packets: Iterable[Packet],
    size: tuple[int, int],
    offset: int,
) -> Iterator[NDArray[np.void]]:
    state = evt.new_state()
    for chunk in decode(evt.EVT3, _words(packets, state), size, state):
        chunk["t"] += offset
        yield chunk


def time_offset(packets: Iterable[Packet]) -> int:
    """What makes ROS time of the sensor's time, us: a packet's stamp is that of the first time that it states.

    That of the first packet that states one.
    """
    for packet in packets:
        place, time = _first_time(packet.words, 0, len(packet.words))
        if place >= 0:
            return packet.stamp - int(time)
    return 0


def _words(packets: Iterable[Packet], state: NDArray[np.int64]) -> Iterator[NDArray[Any]]:
    """The words of packets. Where some are left out, the decoder's ``state`` is told what time it is then."""
    clock = np.zeros(5, np.int64)
    # Joined: drivers send packets of a few hundred events, each a call of a compiled loop.
    for held in _joined(packets):
        words = np.concatenate([packet.words for packet in held])
        ends = np.cumsum([len(packet.words) for packet in held])
        rows = np.array([(packet.number & _LARGEST_NUMBER, packet.stamp) for packet in held], np.int64)
        cuts = np.empty((len(held), 3), np.int64)
        count, wrong = _follow(words, ends, rows, clock, cuts)
        start = 0
        for end, next_start, time in cuts[:count].tolist():
            yield words[start:end]
            if time >= 0:
                evt.resume(state, time)
            start = next_start
        if wrong >= 0:
            yield words[start : ends[wrong - 1] if wrong else 0]
            raise RestartError(
                f"the packet of {held[wrong].stamp / 1e6:.3f} s does not go on from those before it: the driver or a "
                "clock was started anew; cut the recording there and read the parts one by one"
            )
        yield words[start:]


def _joined(packets: Iterable[Packet]) -> Iterator[list[Packet]]:
    held: list[Packet] = []
    count = 0
    for packet in packets:
        held.append(packet)
        count += len(packet.words)
        if count >= _JOINED_WORDS:
            yield held
            held, count = [], 0
    if held:
        yield held


@njit(cache=True, nogil=True)
def _first_time(words, start, end):  # type: ignore[no-untyped-def]
    """Where the first TIME_HIGH is, and its time, us, with the TIME_LOW that belongs to it; -1, 0: there is none."""
    for i in range(start, end):
        if words[i] >> 12 != 0x8:
            continue
        high = np.int64(words[i] & 0xFFF) << 12
        for k in range(i + 1, end):
            if words[k] >> 12 == 0x6:
                return i, high | np.int64(words[k] & 0xFFF)
            if words[k] >> 12 == 0x8 and words[k] != words[i]:
                break
        return i, high
    return -1, np.int64(0)


@njit(cache=True, nogil=True)
def _follow(words, ends, rows, clock, cuts):  # type: ignore[no-untyped-def]
    """Follow the clock from packet to packet, rows of number and stamp, whose words end at ``ends``.

    Fills ``cuts`` with the words to be left out, from and to, and the time of the word after them, or -1 where that is
    none. Returns how many there are, and the packet that cannot follow on those before it, or -1.
    """
    start, count = 0, 0
    for i in range(len(rows)):
        number, stamp = rows[i]
        end = ends[i]
        place, time = _first_time(words, start, end)
        broken = False
        if clock[_STARTED]:
            # Drivers that do not count packets give all the same number.
            step = number - clock[_NUMBER]
            clock[_LOST] |= step != 0 and step != 1
            if step < 0 and stamp > clock[_STAMP]:
                return count, i
            expected = clock[_TIME] + stamp - clock[_STAMP]
            if place >= 0:
                time += (expected - time + _WRAP // 2) // _WRAP * _WRAP
                if abs(time - expected) > _LEAP_US:
                    return count, i
            # Beyond half of the range the decoder would take the time for an earlier one.
            broken = clock[_LOST] or (place >= 0 and time - clock[_TIME] >= _WRAP // 2)
        if broken:
            cuts[count, 0] = start
            cuts[count, 1] = place if place >= 0 else end
            cuts[count, 2] = time if place >= 0 else -1
            count += 1
        if place >= 0:
            clock[_STARTED], clock[_STAMP], clock[_TIME], clock[_LOST] = 1, stamp, time, 0
        clock[_NUMBER] = number
        start = end
    return count, -1
