"""AEDAT 3.1, the format of cAER and libcaer: header lines, then packets of events of one type.

Little-endian. The file is described at
https://docs.inivation.com/software/software-advanced-usage/file-formats/aedat-3.1.html, and the events by libcaer's
headers ``events/common.h``, ``polarity.h`` and ``frame.h``. Rows are counted from the top, columns from the left.
A time is the 31 bits of the event and, above them, the overflow counter of its packet, us.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EVENT_DTYPE, EventArray
from kalux.frames import Frame, Mosaic
from kalux.readers.source import (
    NO_EVENTS,
    NO_FRAMES,
    SIZE_UNKNOWN,
    Source,
    begins_with,
    counted,
    reading,
    smallest_size,
)
from kalux.readers.streams import in_order, rechunk

_MAGIC: Final = b"#!AER-DAT3."
_LONGEST_LINE: Final = 1 << 16
_LARGEST_HEADER: Final = 1 << 24
_PACKET: Final = struct.Struct("<hhiiiiii")
_POLARITY, _FRAME = 1, 2  # types of packets
_LAST_TYPE: Final = 255  # those in use are below 20; a greater one is damage
_EVENT: Final = np.dtype([("data", "<u4"), ("t", "<i4")])
_FRAME_HEADER: Final = struct.Struct("<I8i")
_BLOCK_EVENTS: Final = 1 << 16
_SIZES: Final = {
    "DVS128": (128, 128),
    "EDVS": (128, 128),
    "DAVIS128": (128, 128),
    "DAVIS208": (192, 208),
    "DAVIS240": (180, 240),
    "DAVIS346": (260, 346),
    "DAVIS640": (480, 640),
}
# The colour filters of libcaer's frame.h by its numbers, and what their names mean: the pixels of 2x2, by rows.
_FILTERS: Final[dict[int, Mosaic]] = {1: "RGGB", 2: "GRBG", 3: "GBRG", 4: "BGGR"}


class _Damage(ValueError):
    """The content contradicts the format."""


@dataclass(frozen=True)
class _Header:
    """The lines that matter, and where the header ends, bytes."""

    version: str
    format: str
    sources: dict[int, str]
    end: int


class _Packet(NamedTuple):
    """One packet: where its events begin, how large and how many they are, and their overflow counter."""

    start: int
    size: int
    length: int
    overflow: int


@dataclass(frozen=True)
class _Packets:
    """Where the packets of each source and type lie, as the numbers of `_Packet` one after another."""

    path: Path
    places: dict[tuple[int, int], array[int]]

    def of(self, source: int, kind: int) -> Iterator[_Packet]:
        numbers = self.places.get((source, kind), array("q"))
        for i in range(0, len(numbers), len(_Packet._fields)):
            yield _Packet(*numbers[i : i + len(_Packet._fields)])

    def sources(self, kind: int) -> set[int]:
        return {source for source, held in self.places if held == kind}

    def events(self, source: int) -> Iterator[EventArray]:
        with reading(self.path, _Damage), self.path.open("rb") as file:
            yield from rechunk(
                block
                for packet in self.of(source, _POLARITY)
                for block in _events(file, packet)
                if len(block)
            )

    def frames(self, source: int) -> Iterator[Frame]:
        with reading(self.path, _Damage), self.path.open("rb") as file:
            yield from in_order(
                frame for packet in self.of(source, _FRAME) for frame in _frames(str(self.path), file, packet)
            )

    def mosaic(self, source: int) -> Mosaic | None:
        """The colour filter of the first frame."""
        with reading(self.path, _Damage), self.path.open("rb") as file:
            for packet in self.of(source, _FRAME):
                for _, info in _frame_headers(file, packet):
                    return _FILTERS.get(info >> 4 & 0xF)
        return None


def recognises(path: Path) -> bool:
    """Whether the file begins like AEDAT 3."""
    return begins_with(path, _MAGIC)


def read(path: Path) -> Source:
    """Open an AEDAT 3.1 file: the polarity events and the frames of one source.

    Raises
    ------
    FormatError
        If it is of another version or compressed, cut short or damaged, holds neither events nor frames, or
        its frames have a colour filter with white.
    InputError
        If it cannot be read.
    """
    with reading(path, _Damage):
        header = _header(path)
        if header.version != "3.1":
            raise FormatError(
                f"{path}: AEDAT {header.version[:8]} cannot be read; 3.1 can, as well as 2.0 and 4.0"
            )
        if header.format.upper() != "RAW":
            raise FormatError(
                f"{path}: packets as {header.format[:40]!r} cannot be read; save the file as 'RAW'"
            )
        packets = _find_packets(path, header.end)
    with_events, with_frames = packets.sources(_POLARITY), packets.sources(_FRAME)
    choices = sorted(with_events & with_frames) or sorted(with_events or with_frames)
    if not choices:
        raise FormatError(f"{path}: holds neither events nor frames")
    source = choices[0]

    @cache
    def count_frames() -> int:
        return sum(1 for _ in packets.frames(source))

    stated = _stated_size(header.sources.get(source, ""))
    first = next(packets.frames(source), None)
    size = stated or (None if first is None else (first.image.shape[0], first.image.shape[1]))
    others = (with_events | with_frames) - {source}
    return Source(
        path=path,
        format="aedat3",
        sensor_size=size or smallest_size(path, packets.events(source)),
        events=lambda: packets.events(source),
        frames=lambda: packets.frames(source),
        count_events=counted(lambda: packets.events(source)),
        count_frames=count_frames,
        missing=(() if source in with_events else (NO_EVENTS,))
        + (() if first is not None else (NO_FRAMES,))
        + ((f"The file has {len(others) + 1} sources; only source {source} is read.",) if others else ())
        + (() if size else (SIZE_UNKNOWN,)),
        sensor_size_known=size is not None,
        mosaic=None if first is None else packets.mosaic(source),
    )


def _stated_size(sensor: str) -> tuple[int, int] | None:
    name = sensor.strip().upper()
    return next((size for model, size in _SIZES.items() if name.startswith(model)), None)


def _header(path: Path) -> _Header:
    version, packets = "", "RAW"
    sources: dict[int, str] = {}
    with path.open("rb") as file:
        while file.tell() < _LARGEST_HEADER:
            line = file.readline(_LONGEST_LINE)
            if not line.startswith(b"#") or not line.endswith(b"\n"):
                break
            text = line.decode("latin-1").strip()
            if text == "#!END-HEADER":
                return _Header(version, packets, sources, file.tell())
            if text.startswith("#!AER-DAT"):
                version = text.removeprefix("#!AER-DAT")
            elif text.startswith("#Format:"):
                packets = text.removeprefix("#Format:").strip()
            elif match := re.fullmatch(r"#Source (\d{1,5}):(.*)", text):
                sources[int(match[1])] = match[2]
    if version and version != "3.1":
        return _Header(version, packets, sources, 0)
    raise _Damage("its header does not end")


def _find_packets(path: Path, position: int) -> _Packets:
    places: dict[tuple[int, int], array[int]] = {}
    end = path.stat().st_size
    with path.open("rb") as file:
        while position < end:
            file.seek(position)
            data = file.read(_PACKET.size)
            if len(data) < _PACKET.size:
                raise _Damage(f"it ends within the header of a packet, at byte {position}")
            kind, source, size, _, overflow, capacity, count, _ = _PACKET.unpack(data)
            least = {_POLARITY: _EVENT.itemsize, _FRAME: _FRAME_HEADER.size}.get(kind, 1)
            if not 0 <= kind <= _LAST_TYPE or size < least or not 0 <= count <= capacity or overflow < 0:
                raise _Damage(f"the header of the packet at byte {position} makes no sense")
            if kind == _POLARITY and size != _EVENT.itemsize:
                raise _Damage(f"the events of the packet at byte {position} have {size} bytes instead of 8")
            start = position + _PACKET.size
            position = start + size * capacity
            if position > end:
                raise _Damage(
                    f"the packet whose events begin at byte {start} goes on beyond the end, byte {end}"
                )
            if kind in (_POLARITY, _FRAME) and count:
                places.setdefault((source, kind), array("q")).extend((start, size, count, overflow))
    return _Packets(path, places)


# The contents of packets


def _events(file: BinaryIO, packet: _Packet) -> Iterator[EventArray]:
    """The valid events of a packet, in blocks."""
    for first in range(0, packet.length, _BLOCK_EVENTS):
        file.seek(packet.start + first * _EVENT.itemsize)
        stored = np.fromfile(file, _EVENT, min(_BLOCK_EVENTS, packet.length - first))
        data, t = stored["data"], stored["t"]
        if t.min(initial=0) < 0:
            raise _Damage(f"an event of the packet at byte {packet.start} has a negative time")
        if not (data & 1).all():
            t, data = t[(data & 1) == 1], data[(data & 1) == 1]
        yield _unpacked(data, t, packet.overflow)


def _unpacked(data: NDArray[np.uint32], t: NDArray[np.int32], overflow: int) -> EventArray:
    """Bits 31-17 are the column, 16-2 the row, 1 the polarity."""
    events = np.zeros(len(data), EVENT_DTYPE)
    events["t"] = t
    events["t"] += overflow << 31
    events["x"] = data >> 17
    events["y"] = data >> 2 & 0x7FFF
    events["p"] = (data & 2).astype(np.bool_)
    return events


def _frame_headers(file: BinaryIO, packet: _Packet) -> Iterator[tuple[int, int]]:
    """Place and first word of the valid frames of a packet."""
    for index in range(packet.length):
        start = packet.start + index * packet.size
        file.seek(start)
        info = int.from_bytes(file.read(4), "little")
        if info & 1:
            yield start, info


def _frames(where: str, file: BinaryIO, packet: _Packet) -> Iterator[Frame]:
    """The valid frames of a packet, colours in the order red, green, blue."""
    for start, info in _frame_headers(file, packet):
        file.seek(start)
        _, _, _, begin, end, width, height, _, _ = _FRAME_HEADER.unpack(file.read(_FRAME_HEADER.size))
        channels, colour_filter = info >> 1 & 7, info >> 4 & 0xF
        if colour_filter and colour_filter not in _FILTERS:
            raise FormatError(
                f"{where}: its frames have a colour filter that is no Bayer mosaic (number {colour_filter}); "
                "record or convert to grey frames"
            )
        values = width * height * channels
        if (
            min(width, height) <= 0
            or channels not in (1, 3, 4)
            or min(begin, end) < 0
            or _FRAME_HEADER.size + 2 * values > packet.size
        ):
            raise _Damage(f"the frame at byte {start} makes no sense")
        image = np.fromfile(file, "<u2", values)
        image = image.reshape((height, width) if channels == 1 else (height, width, channels))
        past = packet.overflow << 31
        yield Frame(np.ascontiguousarray(image[..., :3]) if channels > 1 else image, begin + past, end + past)
