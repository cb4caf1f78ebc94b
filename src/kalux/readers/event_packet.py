"""Events in ROS messages: ``dvs_msgs/EventArray`` and the encodings of ``event_camera_msgs/EventPacket``.

The layouts are those of https://github.com/ros-event-camera/event_camera_msgs and of rpg_dvs_ros, which
those of dv-ros are, too. Nothing is deserialised event by event: each kind has one loop over the bytes of a message.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from kalux.events import EventArray
from kalux.readers import evt, evt3_packets
from kalux.readers.evt import BACKWARDS_US, rows_as_events
from kalux.readers.source import Lost, TriggerArray
from kalux.readers.streams import rechunk

EVENT_ARRAYS: Final = (
    "dvs_msgs/EventArray",
    "dv_ros_msgs/EventArray",
    "dv_ros2_msgs/EventArray",
    "prophesee_event_msgs/EventArray",
)
EVENT_PACKETS: Final = ("event_camera_msgs/EventPacket", "event_array_msgs/EventArray")

_RECORD: Final = 13  # bytes of an event of an EventArray in ROS 1: x, y, secs, nsecs, polarity
_CDR_RECORD: Final = 16  # ... in ROS 2, aligned; the last one is 13


@cache
def _fields(codes: str, shift: int | None) -> struct.Struct:
    """Numbers one after the other; aligned, the first is ``shift`` bytes past a multiple of 8."""
    layout, position = "<", shift or 0
    for code in codes:
        size = struct.calcsize("<" + code)
        gap = 0 if shift is None else -position % size
        layout += f"{gap}x{code}"
        position += gap + size
    return struct.Struct(layout)


class Message:
    """The bytes of a message, read field by field.

    Parameters
    ----------
    data
        As stored.
    cdr
        Whether it is serialised by CDR, as in ROS 2: fields aligned, after four bytes that say so. Otherwise as in
        ROS 1: packed.
    """

    def __init__(self, data: bytes, cdr: bool) -> None:
        self.data, self.cdr = data, cdr
        self.position = 4 if cdr else 0
        if cdr and data[:2] != b"\0\1":
            raise ValueError("it is not serialised as little-endian CDR")

    def number(self, code: str) -> int:
        """A number, by its code in `struct`: one of B, I, i, Q."""
        return self.numbers(code)[0]

    def numbers(self, codes: str) -> tuple[int, ...]:
        """Several numbers."""
        # Of CDR, numbers are aligned from where the four bytes end.
        fields = _fields(codes, (self.position - 4) % 8 if self.cdr else None)
        position = self.position
        self.position += fields.size
        return fields.unpack_from(self.data, position)

    def text(self) -> str:
        """A string."""
        start, length = self.sequence()
        return self.data[start : start + length].rstrip(b"\0").decode()

    def sequence(self) -> tuple[int, int]:
        """Offset and length of a sequence of bytes, which is skipped."""
        length = self.number("I")
        start = self.position
        if start + length > len(self.data):
            raise EOFError(f"{length} bytes expected, {len(self.data) - start} found")
        self.position += length
        return start, length

    def stamp(self) -> int:
        """Skip a ``std_msgs/Header``; its time stamp, ns."""
        return self.header()[1]

    def header(self) -> tuple[int | None, int]:
        """Skip a ``std_msgs/Header``; its running number, which ROS 1 alone has, and its time stamp, ns."""
        number = None if self.cdr else self.number("I")
        seconds, nanoseconds = self.numbers("iI" if self.cdr else "II")
        self.text()
        return number, seconds * 1_000_000_000 + nanoseconds


@dataclass(frozen=True)
class EventTopic:
    """The events of a topic.

    Attributes
    ----------
    size
        (height, width), pixels.
    events
        Called for a fresh iterator over chunks.
    count
        Number of events; reads through the messages.
    triggers
        Edges on the camera's trigger inputs, where the encoding has them.
    lost
        As of `kalux.readers.source.Source`, where messages have numbers.
    """

    size: tuple[int, int]
    events: Callable[[], Iterator[EventArray]]
    count: Callable[[], int]
    triggers: Callable[[], Iterator[TriggerArray]] | None = None
    lost: Callable[[int, int], Lost | None] | None = None


Messages = Callable[[], Iterator[Message]]


def open_topic(kind: str, messages: Messages) -> EventTopic:
    """The events of a topic that has a message.

    Parameters
    ----------
    kind
        One of `EVENT_ARRAYS` or `EVENT_PACKETS`.
    messages
        Called for a fresh iterator over the messages.

    Raises
    ------
    ValueError, EOFError, struct.error
        If a message is damaged, or of an unknown encoding.
    """
    return _open_arrays(messages) if kind in EVENT_ARRAYS else _open_packets(messages)


def lost_packets(numbered: Iterable[tuple[int, int]], begin: int, until: int) -> Lost | None:
    """What is missing of packets, of which number and time are given, before those from ``begin`` to ``until``, us.

    None where no number is left out. Where no more packets follow their predecessors than do not, the numbers are none
    of a publisher: some programs leave them 0, and two publishers have numbers of their own.
    """
    packets = gaps = followed = 0
    first = previous = None
    for number, t in numbered:
        if t > until:
            break
        missing = 0 if previous is None else number - previous - 1
        followed += previous is not None and missing == 0
        gaps += missing > 0
        if missing > 0 and t >= begin:
            packets += missing
            first = t if first is None else first
        previous = number
    return None if first is None or followed <= gaps else Lost(packets, first)


# EventArray of dvs_msgs and others, which are the same


def _open_arrays(messages: Messages) -> EventTopic:
    first = next(messages())
    first.stamp()
    height, width = first.numbers("II")

    return EventTopic(
        (height, width),
        lambda: rechunk(map(_array_events, messages())),
        lambda: sum(_array_length(message)[1] for message in messages()),
        lost=None if first.cdr else lambda *times: lost_packets(_numbered_arrays(messages()), *times),
    )


def _numbered_arrays(messages: Iterable[Message]) -> Iterator[tuple[int, int]]:
    """Numbers of arrays of ROS 1, and the times of their first events, us.

    Stamps may be 0: the driver of the DVS128, and that of the DAVIS once, set none. An empty array is as late as the
    last one, or as its stamp.
    """
    now = 0
    for message in messages:
        number, stamp = message.header()
        assert number is not None
        _, _, count = message.numbers("III")
        now = _array_start(message) if count else max(now, stamp // 1000)
        yield number, now


def _array_start(message: Message) -> int:
    """The time, us, of the event that follows in a message of ROS 1."""
    _, _, seconds, nanoseconds = message.numbers("HHII")
    return seconds * 1_000_000 + nanoseconds // 1000


def _array_length(message: Message) -> tuple[int, int]:
    """Where the events begin, and their number."""
    message.stamp()
    _, _, count = message.numbers("III")
    start = message.position
    size = count * _CDR_RECORD - 3 if message.cdr and count else count * _RECORD
    if start + size > len(message.data):
        raise EOFError(f"{count} events take {size} bytes, {len(message.data) - start} found")
    return start, count


def _array_events(message: Message) -> EventArray:
    start, count = _array_length(message)
    out = np.empty((count, 2), np.uint64)
    data = np.frombuffer(message.data, np.uint8)
    _decode_array(data[start:], count, message.cdr, out)
    return rows_as_events(out)


@njit(cache=True, nogil=True, inline="always")
def _u16(data, i):  # type: ignore[no-untyped-def]
    return np.uint64(data[i]) | np.uint64(data[i + 1]) << np.uint64(8)


@njit(cache=True, nogil=True, inline="always")
def _u32(data, i):  # type: ignore[no-untyped-def]
    return _u16(data, i) | _u16(data, i + 2) << np.uint64(16)


@njit(cache=True, nogil=True)
def _decode_array(data, count, cdr, out):  # type: ignore[no-untyped-def]
    stride = _CDR_RECORD if cdr else _RECORD
    for k in range(count):
        i = k * stride
        # In CDR the time is aligned to 4 bytes and x, y only to 2, so they follow the event before closely.
        place = i - 2 if cdr and k else i
        t = _u32(data, i + 4) * np.uint64(1_000_000) + _u32(data, i + 8) // np.uint64(1000)
        out[k, 0] = t
        out[k, 1] = (
            _u16(data, place)
            | _u16(data, place + 2) << np.uint64(16)
            | np.uint64(data[i + 12] != 0) << np.uint64(32)
        )


# event_camera_msgs/EventPacket, event_array_msgs/EventArray


@dataclass(frozen=True)
class _Packet:
    """``stamp`` and ``time_base`` in ns; ``number`` counts the packets that were sent."""

    stamp: int
    number: int
    size: tuple[int, int]
    time_base: int
    encoding: str
    content: bytes

    def words(self, dtype: str) -> NDArray[Any]:
        """The content as numbers."""
        return np.frombuffer(self.content, dtype)


def _packet(message: Message) -> _Packet:
    stamp = message.stamp()
    height, width, number, time_base = message.numbers("IIQQ")
    encoding = message.text()
    if message.number("B"):
        raise ValueError("its events are big-endian, which is not supported")
    start, length = message.sequence()
    return _Packet(stamp, number, (height, width), time_base, encoding, message.data[start : start + length])


def _open_packets(messages: Messages) -> EventTopic:
    def packets() -> Iterator[_Packet]:
        for message in messages():
            packet = _packet(message)
            if packet.encoding != first.encoding or packet.size != first.size:
                raise ValueError(
                    f"the encoding changes from {first.encoding!r} of {first.size} pixels to {packet.encoding!r} "
                    f"of {packet.size}"
                )
            yield packet

    def lost(begin: int, until: int) -> Lost | None:
        return lost_packets(((packet.number, packet.stamp // 1000) for packet in packets()), begin, until)

    first = _packet(next(messages()))
    if first.encoding == "evt3":  # the packets are one stream
        return dataclasses.replace(_open_evt3(first.size, packets), lost=lost)
    if first.encoding not in _ENCODINGS:
        known = ", ".join(("evt3", *_ENCODINGS))
        raise ValueError(f"its encoding {first.encoding[:40]!r} is not one of {known}")
    decode = _ENCODINGS[first.encoding]

    def events() -> Iterator[EventArray]:
        return rechunk(_decoded(decode, packets(), first))

    return EventTopic(first.size, events, lambda: sum(len(chunk) for chunk in events()), lost=lost)


def _open_evt3(size: tuple[int, int], messages: Callable[[], Iterator[_Packet]]) -> EventTopic:
    def packets() -> Iterator[evt3_packets.Packet]:
        for packet in messages():
            yield evt3_packets.Packet(packet.number, packet.stamp // 1000, packet.words("<u2"))

    offset = evt3_packets.time_offset(packets())

    def events() -> Iterator[EventArray]:
        return evt3_packets.decode_events(packets(), size, offset)

    def triggers() -> Iterator[TriggerArray]:
        return evt3_packets.decode_triggers(packets(), size, offset)

    return EventTopic(size, events, lambda: sum(len(chunk) for chunk in events()), triggers)


def _decoded(decode: _Decoder, packets: Iterator[_Packet], first: _Packet) -> Iterator[EventArray]:
    """Events of packets that state the time from which theirs count."""
    now = np.iinfo(np.int64).min
    # The deprecated encoding counts in the sensor's time, the others in that of ROS.
    shift = first.stamp - first.time_base if first.encoding == "mono" else 0
    for packet in packets:
        base = packet.time_base + shift
        if not 0 <= base < 1 << 62:
            raise ValueError(f"the time {base} ns is impossible")
        out, count = decode(packet, base)
        rows = out[:count]
        if count:
            now = _make_ordered(rows.view(np.int64), now)
            if now < 0:
                raise evt.ClockError("the sensor's clock goes back by more than 41 ms")
        yield rows_as_events(rows)


@njit(cache=True, nogil=True)
def _make_ordered(rows, now):  # type: ignore[no-untyped-def]
    """Let times that go back a little stand still; the last time, or -1 where they go back too far."""
    for i in range(len(rows)):
        if rows[i, 0] + BACKWARDS_US < now:
            return -1
        now = max(now, rows[i, 0])
        rows[i, 0] = now
    return now


def _mono(packet: _Packet, base: int) -> tuple[NDArray[np.uint64], int]:
    words = packet.words("<u8")
    out = np.empty((len(words), 2), np.uint64)
    _decode_mono(words, np.uint64(base), out)
    return out, len(out)


@njit(cache=True, nogil=True)
def _decode_mono(words, base, out):  # type: ignore[no-untyped-def]
    for i in range(len(words)):
        word = words[i]
        out[i, 0] = (base + (word & np.uint64(0xFFFFFFFF))) // np.uint64(1000)
        # x and y are where they shall be but for the bit above them, the polarity
        out[i, 1] = (word >> np.uint64(32) & np.uint64(0x7FFFFFFF)) | word >> np.uint64(63) << np.uint64(32)


def _libcaer(packet: _Packet, base: int) -> tuple[NDArray[np.uint64], int]:
    words = packet.words("<u4").reshape(-1, 2)
    out = np.empty((len(words), 2), np.uint64)
    _decode_libcaer(words, base // 1000, out)
    return out, len(out)


@njit(cache=True, nogil=True)
def _decode_libcaer(words, base, out):  # type: ignore[no-untyped-def]
    """Pairs of place and time of 31 bits, us, which may wrap around within a packet."""
    last = np.int64(0)
    for i in range(len(words)):
        place, low = np.uint64(words[i, 0]), np.int64(words[i, 1] & 0x7FFFFFFF)
        if low < last:
            base += 1 << 31
        last = low
        out[i, 0] = base + low
        out[i, 1] = (
            place >> np.uint64(17)
            | (place >> np.uint64(2) & np.uint64(0x7FFF)) << np.uint64(16)
            | (place >> np.uint64(1) & np.uint64(1)) << np.uint64(32)
        )


def _libcaer_compressed(packet: _Packet, base: int) -> tuple[NDArray[np.uint64], int]:
    words = packet.words("<u2")
    height, width = packet.size
    out = np.empty((8 * len(words), 2), np.uint64)
    return out, _decode_libcaer_compressed(words, base // 1000, height, width, out)


@njit(cache=True, nogil=True)
def _decode_libcaer_compressed(words, base, height, width, out):  # type: ignore[no-untyped-def]
    """Words like those of EVT3, with x before y; everything begins anew with each packet."""
    high, low, x, y, polarity, count = 0, 0, 0, 0, 0, 0
    for i in range(len(words)):
        word = int(words[i])
        kind = word >> 12
        if kind == 0:
            high = (word & 0xFFF) << 12
        elif kind == 1:
            low = word & 0xFFF
        elif kind == 2:
            x = word & 0x7FF
        elif kind == 3 or kind == 4:  # one event; or a row and a polarity for those that follow
            y, polarity = word & 0x7FF, word >> 11 & 1
            if kind == 3 and x < width and y < height:
                out[count, 0] = base + high + low
                out[count, 1] = x | y << 16 | polarity << 32
                count += 1
        elif kind == 5:  # a bit for each of the next 8 rows
            for k in range(8):
                if word >> k & 1 and x < width and y + k < height:
                    out[count, 0] = base + high + low
                    out[count, 1] = x | (y + k) << 16 | polarity << 32
                    count += 1
            y += 8
    return count


_Decoder = Callable[[_Packet, int], tuple[NDArray[np.uint64], int]]
_ENCODINGS: Final[dict[str, _Decoder]] = {
    "libcaer_cmp": _libcaer_compressed,
    "libcaer": _libcaer,
    "mono": _mono,
}
