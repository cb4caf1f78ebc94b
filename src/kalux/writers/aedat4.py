"""AEDAT 4, for iniVation's DV, dv-processing and others: events, frames and their exposures.

The counterpart of `kalux.readers.aedat4`, which names the description of the format. A packet is a FlatBuffers table of
which every byte but the contents is known before, so that no builder is needed
(https://flatbuffers.dev/internals/): offsets here count from the beginning of the packet, its size prefix included.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import BinaryIO, Final, Literal, NamedTuple, TypeVar

import lz4.frame
import numpy as np
import zstandard

from kalux.errors import FrameError, OutputError
from kalux.events import EVENT_DTYPE, EventArray
from kalux.frames import Frame
from kalux.layouts import AEDAT4_MAGIC, AEDAT4_PACKET, AEDAT4_PIXELS
from kalux.writers.files import output_errors, replacing

T = TypeVar("T")
Compression = Literal["lz4", "zstd", "none"]

EVENTS_PER_PACKET: Final = 8192
"""Players decompress whole packets to show a moment; DV's own hold about 10 ms of events."""

_LARGEST_SIDE: Final = 2**15 - 1  # coordinates are int16
_EVENTS, _FRAMES = 0, 1  # numbers of the streams
_KINDS: Final = {
    (dtype, channels): number for number, (dtype, channels) in AEDAT4_PIXELS.items() if channels < 4
}
_COMPRESSIONS: Final[dict[Compression, tuple[int, Callable[[bytes], bytes]]]] = {
    "none": (0, lambda data: data),
    "lz4": (1, lambda data: lz4.frame.compress(data, content_checksum=True)),
    "zstd": (3, lambda data: zstandard.ZstdCompressor(write_checksum=True).compress(data)),
}


class _Packet(NamedTuple):
    stream: int
    data: bytes
    elements: int
    first: int  # time, us
    last: int


def write(
    path: str | Path,
    *,
    sensor_size: tuple[int, int],
    events: Iterable[EventArray],
    frames: Iterable[Frame],
    exposure_known: bool = True,
    compression: Compression = "lz4",
) -> None:
    """Write events and frames, packet by packet in time order, in bounded memory.

    Times, polarities, pixels and exposures are kept. The white value and the pattern of a mosaic are not: AEDAT 4
    has no place for them. The file appears under its name only when it is complete.

    Parameters
    ----------
    path
        Replaced if it exists.
    sensor_size
        (height, width), pixels.
    events
        Chunks of `EVENT_DTYPE` in time order, of any length.
    frames
        In time order, uint8 or uint16, grey (or a mosaic) or RGB, of the sensor's size.
    exposure_known
        Whether the frames carry their exposure, or only a stamp (start and end equal).
    compression
        Of the packets. LZ4 is what DV writes.

    Raises
    ------
    FrameError
        If a frame has pixels that AEDAT 4 cannot hold: floats, or some that are not valid.
    OutputError
        If the sensor is larger than the format's coordinates, or the file cannot be written.
    """
    path = Path(path)
    if max(sensor_size) > _LARGEST_SIDE:
        height, width = sensor_size
        raise OutputError(
            f"{path}: AEDAT 4 holds sensors of up to {_LARGEST_SIDE} pixels a side, this one has {width}x{height}; "
            "write kalux HDF5"
        )
    with output_errors(path), replacing(path) as temporary, temporary.open("wb") as file:
        _write(file, path, sensor_size, events, frames, exposure_known, compression)


def _write(
    file: BinaryIO,
    path: Path,
    sensor_size: tuple[int, int],
    events: Iterable[EventArray],
    frames: Iterable[Frame],
    exposure_known: bool,
    compression: Compression,
) -> None:
    has_frames, frames = _begun(frames)
    has_events, events = _begun(events)
    # A file without any stream could not be opened again.
    kinds = {_EVENTS: "EVTS"} if has_events or not has_frames else {}
    kinds |= {_FRAMES: "FRME"} if has_frames else {}
    number, compress = _COMPRESSIONS[compression]
    info = _streams(kinds, sensor_size, compression)
    file.write(AEDAT4_MAGIC + _header(number, -1, info))  # -1: not closed
    table = array("q")
    position = file.tell()
    for packet in _packets(path, events, frames, exposure_known):
        packed = compress(packet.data)
        file.write(AEDAT4_PACKET.pack(packet.stream, len(packed)) + packed)
        position += AEDAT4_PACKET.size
        table.extend((position, packet.stream, len(packed), packet.elements, packet.first, packet.last))
        position += len(packed)
    file.write(compress(_data_table(table)))
    file.seek(len(AEDAT4_MAGIC))
    file.write(_header(number, position, info))


def _begun(items: Iterable[T]) -> tuple[bool, Iterator[T]]:
    """Whether there are any, and all of them."""
    rest = iter(items)
    first = list(next(([item] for item in rest), []))
    return bool(first), chain(first, rest)


def _packets(
    path: Path, events: Iterable[EventArray], frames: Iterator[Frame], exposure_known: bool
) -> Iterator[_Packet]:
    """Both streams by time; a frame comes before the events that begin at its start or later."""
    numbered = enumerate(frames)
    pending = next(numbered, None)
    for chunk in events:
        for start in range(0, len(chunk), EVENTS_PER_PACKET):
            part = chunk[start : start + EVENTS_PER_PACKET]
            while pending is not None and pending[1].exposure_start <= part["t"][0]:
                yield _frame(path, *pending, exposure_known)
                pending = next(numbered, None)
            yield _event_packet(part)
    while pending is not None:
        yield _frame(path, *pending, exposure_known)
        pending = next(numbered, None)


def _event_packet(events: EventArray) -> _Packet:
    """The FlatBuffers struct of an event is `EVENT_DTYPE`, of which the padding must be the same each time."""
    clean = np.zeros(len(events), EVENT_DTYPE)
    for name in ("t", "x", "y", "p"):
        clean[name] = events[name]
    data = _vector_head("EVTS", len(events), len(events) * EVENT_DTYPE.itemsize) + clean.tobytes()
    return _Packet(_EVENTS, data, len(events), int(events["t"][0]), int(events["t"][-1]))


# Size; root table at 44; type; vtable of 13 fields (up to the exposure time, 11) from 12, none for the position and
# the start and end of the whole frame; the table: its vtable is 32 bytes before, times, sizes, pixel type; pixels at
# 96.
_FRAME_HEAD: Final = struct.Struct("<II4s 14H 2x2x iqqqq hhbxxx II")
_FRAME_FIELDS: Final = (28, 48, 4, 0, 0, 12, 20, 40, 36, 38, 0, 0, 44, 28)
_STAMP_FIELDS: Final = (28, 48, 4, 0, 0, 0, 0, 40, 36, 38, 0, 0, 44, 0)


def _frame(path: Path, index: int, frame: Frame, exposure_known: bool) -> _Packet:
    image = frame.image
    channels = 3 if image.ndim == 3 else 1
    kind = _KINDS.get((image.dtype.newbyteorder("<"), channels))
    if kind is None:
        raise FrameError(
            f"{path}: frame {index} has pixels of {image.dtype}; AEDAT 4 is written with 8 or 16 bits; write kalux "
            "HDF5 (a name that ends in .h5)"
        )
    if frame.valid is not None and not frame.valid.all():
        raise FrameError(
            f"{path}: frame {index} has pixels that are not valid, which AEDAT 4 cannot say; write kalux HDF5 "
            "(a name that ends in .h5)"
        )
    if frame.gain != 1.0:
        raise FrameError(
            f"{path}: frame {index} has a gain of {frame.gain:g}, which AEDAT 4 cannot say; write kalux HDF5 "
            "(a name that ends in .h5)"
        )
    height, width = image.shape[:2]
    stored = image if channels == 1 else image[..., ::-1]  # BGR
    pixels = np.ascontiguousarray(stored, image.dtype.newbyteorder("<")).tobytes()
    head = _FRAME_HEAD.pack(
        _FRAME_HEAD.size + len(pixels) - 4,
        40,
        b"FRME",
        *(_FRAME_FIELDS if exposure_known else _STAMP_FIELDS),
        32,
        frame.exposure_start,
        frame.exposure_start,
        frame.exposure_end,
        frame.exposure,
        width,
        height,
        kind,
        4,
        len(pixels),
    )
    return _Packet(_FRAMES, head + pixels, 1, frame.exposure_start, frame.exposure_start)


# Size; root table at 20; type; vtable of one field from 14; the table: its vtable is 6 bytes before, a vector at 28.
_VECTOR_HEAD: Final = struct.Struct("<II4s 2x3H iII")


def _vector_head(kind: str, count: int, size: int) -> bytes:
    """What comes before the contents, ``size`` bytes, of a table that has one vector."""
    return _VECTOR_HEAD.pack(_VECTOR_HEAD.size + size - 4, 16, kind.encode(), 6, 8, 4, 6, 4, count)


_ENTRY: Final = np.dtype(
    [("vtable", "<i4"), ("stream", "<i4"), ("size", "<i4"), ("padding", "<i4")]
    + [(name, "<i8") for name in ("offset", "elements", "first", "last")]
)


def _data_table(rows: array[int]) -> bytes:
    """Where every packet is: a vector of tables of one shape, which share one vtable."""
    columns = np.frombuffer(rows, np.int64).reshape(-1, 6)
    count = len(columns)
    vtable = _VECTOR_HEAD.size + 4 * count
    vtable_bytes = struct.pack("<7H", 14, _ENTRY.itemsize, 16, 4, 24, 32, 40)
    vtable_bytes += bytes(-(vtable + len(vtable_bytes)) % 8)
    places = vtable + len(vtable_bytes) + _ENTRY.itemsize * np.arange(count)
    entries = np.zeros(count, _ENTRY)
    entries["vtable"] = places - vtable
    for name, column in zip(
        ("offset", "stream", "size", "elements", "first", "last"), columns.T, strict=True
    ):
        entries[name] = column
    offsets = (places - (_VECTOR_HEAD.size + 4 * np.arange(count))).astype("<u4").tobytes()
    content = offsets + vtable_bytes + entries.tobytes()
    return _vector_head("FTAB", count, len(content)) + content


# Size; root table at 24; type; vtable of 3 fields from 12; the table: its vtable is 12 bytes before, compression,
# position of the data table, text at 44.
_HEADER: Final = struct.Struct("<II4s 5H2x iiqII")


def _header(compression: int, table_position: int, info: bytes) -> bytes:
    size = _HEADER.size + len(info) + 1 - 4
    values = (10, 20, 4, 8, 16, 12, compression, table_position, 4, len(info))
    return _HEADER.pack(size, 20, b"IOHE", *values) + info + b"\0"


_DESCRIPTIONS: Final = {
    "EVTS": ("events", "Array of events (polarity ON/OFF)."),
    "FRME": ("frames", "Frame."),
}


def _streams(kinds: dict[int, str], sensor_size: tuple[int, int], compression: Compression) -> bytes:
    """The XML that declares the streams, as DV writes it."""
    height, width = sensor_size
    nodes = []
    for number, kind in kinds.items():
        name, description = _DESCRIPTIONS[kind]
        attributes = (
            ("compression", compression.upper()),
            ("originalModuleName", "kalux"),
            ("originalOutputName", name),
            ("typeDescription", description),
            ("typeIdentifier", kind),
        )
        lines = "".join(f'<attr key="{key}" type="string">{value}</attr>\n' for key, value in attributes)
        nodes.append(
            f'<node name="{number}" path="/outInfo/{number}/">\n{lines}'
            f'<node name="info" path="/outInfo/{number}/info/">\n<attr key="sizeX" type="int">{width}</attr>\n'
            f'<attr key="sizeY" type="int">{height}</attr>\n<attr key="source" type="string">kalux</attr>\n'
            "</node>\n</node>\n"
        )
    return (
        f'<dv version="2.0">\n<node name="outInfo" path="/outInfo/">\n{"".join(nodes)}</node>\n</dv>\n'
    ).encode()
