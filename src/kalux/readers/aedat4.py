"""AEDAT 4, the format of iniVation's DV: a header, then compressed packets of FlatBuffers.

Decoded here rather than with the ``aedat`` package, which ends the whole process on some damaged files and
decodes frames even where only events are wanted. The format is described at
https://docs.inivation.com/software/software-advanced-usage/file-formats/aedat-4.0.html
"""

from __future__ import annotations

import dataclasses
import os
import re
import struct
import xml.etree.ElementTree as ElementTree
from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, TypeVar

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EVENT_DTYPE, LATEST, EventArray
from kalux.frames import Frame, Mosaic
from kalux.layouts import AEDAT4_MAGIC, AEDAT4_PACKET, AEDAT4_PIXELS
from kalux.readers import aedat2
from kalux.readers.source import (
    CHUNK_EVENTS,
    EXPOSURE_UNKNOWN,
    NO_FRAMES,
    TRIGGER_DTYPE,
    SeekableEvents,
    Source,
    TriggerArray,
    begins_with,
    reading,
)
from kalux.readers.streams import in_order, unzstd
from kalux.wording import one_line

T = TypeVar("T")
_DAVIS_FILTER: Final[Mosaic] = "RGGB"
_DEMOSAICED: Final = (
    f"The frames were made RGB from the Bayer mosaic of a DAVIS, taken as {_DAVIS_FILTER}; every pixel gets its own "
    "channel back (--bayer none: luminance and chromaticity)."
)
_JAER: Final = "jAER"  # what wrote a stream, which counts rows from the bottom
_JAER_EXPOSURE: Final = (
    "jAER records how long the exposures of the frames are, but not when they begin; they are taken to be in the "
    "middle between the first read of a pixel's reset and the last of a signal, as with a global shutter."
)
_JAER_COLOURS: Final = (
    "The sensor has filters of colours in no pattern that is known; its frames are taken as grey."
)
# Whatever a wrong offset, size or compressed byte can lead to.
_DAMAGE: Final = (
    struct.error,
    ValueError,
    RuntimeError,
    EOFError,
    MemoryError,
    OverflowError,
    zstandard.ZstdError,
)


@dataclass(frozen=True)
class _Stream:
    number: int
    kind: str  # EVTS, FRME, IMUS, TRIG
    size: tuple[int, int]  # height, width
    camera: str
    module: str = ""  # what wrote it
    filters: bool = False  # whether colour filters are stated

    @property
    def by_jaer(self) -> bool:
        return self.module == _JAER


@dataclass(frozen=True)
class _Container:
    """Where the packets of each stream lie."""

    path: Path
    decompress: Callable[[bytes], bytes]
    streams: tuple[_Stream, ...]
    packets: dict[int, array[int]]  # stream -> offset, size, offset, size, ...

    def read(self, stream: _Stream, decode: Callable[[_Table], T], first: int = 0) -> Iterator[T]:
        """The contents of one stream, packet by packet, from the ``first`` on."""
        places = self.packets.get(stream.number, array("q"))[2 * first :]
        identifier = stream.kind.encode()
        with reading(self.path), self.path.open("rb", buffering=0) as file:
            for offset, size in zip(places[::2], places[1::2], strict=True):
                try:
                    packet = os.pread(file.fileno(), size, offset)
                    if len(packet) != size:
                        raise EOFError(
                            f"{size} bytes expected, {len(packet)} found before the end of the file"
                        )
                    content = decode(_root(self.decompress(packet), identifier))
                except FormatError:
                    raise
                except _DAMAGE as error:
                    raise FormatError(
                        f"{self.path}: damaged {_NAMES[stream.kind]} packet at byte {offset} "
                        f"({one_line(error)}); copy or download it again"
                    ) from error
                yield content


_CHUNK_BYTES: Final = CHUNK_EVENTS * EVENT_DTYPE.itemsize
_NAMES: Final = {"EVTS": "event", "FRME": "frame", "TRIG": "trigger"}
# The sources of iniVation's cameras: model and serial number, as DAVIS346_00000391 and DVXplorer_DXB00010. Modules have
# names like dvsnoisefilter_1.
_SERIAL: Final = re.compile(r"(DAVIS|DVS|DVXplorer)\w*_[A-Z]*\d{4,}")
_SHOWN: Final = 40  # letters of a name, in a sentence
_POLARITY: Final = EVENT_DTYPE.fields["p"][1]  # type: ignore[index]
# Numbers of dv::TriggerType for edges of the external input; others are of the generator and of the sensor itself.
_EDGES: Final = {1: True, 2: False}


def recognises(path: Path) -> bool:
    """Whether the file begins like AEDAT 4."""
    return begins_with(path, AEDAT4_MAGIC)


def read(path: Path) -> Source:
    """Open an AEDAT 4 file.

    The first event stream and the first frame stream of one camera are read, else those of equal size, but never
    those of two cameras, and none without packets if another has some. Frames of another size than the events are
    left out. Frames may be 8 or 16 bits, grey or in colour; those in colour of a DAVIS come from a Bayer
    sensor. Files of jAER count rows from the bottom and place exposures elsewhere. Times are absolute, us.
    Edges on the same camera's external input are in ``triggers``, input 0.

    Raises
    ------
    FormatError
        If the file is cut short or damaged, or has no event or frame stream.
    InputError
        If it cannot be read.
    """
    with reading(path, *_DAMAGE, ElementTree.ParseError, KeyError), path.open("rb") as file:
        container = _open(path, file)
    event_streams = [s for s in container.streams if s.kind == "EVTS"]
    event_streams = [s for s in event_streams if container.packets.get(s.number)] or event_streams
    frame_streams = [s for s in container.streams if s.kind == "FRME" and container.packets.get(s.number)]
    if not event_streams and not frame_streams:
        raise FormatError(f"{path}: holds neither events nor frames; record with an events output in DV")
    events, frames = _choose(event_streams, frame_streams)
    first = None if frames is None else next(_stored_frames(container, frames), None)
    missing = _others("event", events, event_streams) + _others("frame", frames, frame_streams)
    if events is None:
        missing += ("The file has no event stream.",)
    # A stream that states the size of the events, with a frame of another, is damaged.
    if frames is not None and first and events and events.size not in (frames.size, first.image.shape[:2]):
        missing += (_of_other_size(first.image.shape, events.size),)
        frames = first = None
    elif frames is not None:
        missing += _doubts(events, frames)
    elif frame_streams:
        missing += (
            f"The frames are not read: they are of {frame_streams[0].camera[:_SHOWN]}, another camera than "
            f"{event_streams[0].camera[:_SHOWN]} of the events.",
        )
    else:
        missing += (NO_FRAMES,)

    exposure_known = True
    white = None
    if first is not None and first.exposure <= 0:
        exposure_known = False
        missing += (EXPOSURE_UNKNOWN,)
    elif first is not None:
        missing += _about_exposure(container, frames, first)  # type: ignore[arg-type]
    # Only those cameras have colour filters over pixels of events and frames alike.
    is_colour_davis = first is not None and first.image.ndim == 3 and "DAVIS" in frames.camera.upper()  # type: ignore[union-attr]
    if is_colour_davis:
        missing += (_DEMOSAICED,)
    mosaic = _DAVIS_FILTER if is_colour_davis else None
    if first is not None and frames.by_jaer:  # type: ignore[union-attr]
        mosaic = aedat2.mosaic_of(frames.camera)  # type: ignore[union-attr]
        # Of what it read from other files, jAER writes more bits.
        white = aedat2.WHITE if first.image.max(initial=0) <= aedat2.WHITE else None
        if mosaic is None and any(stream.filters for stream in container.streams):
            missing += (_JAER_COLOURS,)

    def read_events(since: int | None = None) -> Iterator[EventArray]:
        if events is None:
            return iter(())
        first = 0 if since is None else _packet_of(container, events, since)
        chunks = _joined(container.read(events, _events, first))
        return (_upright(chunk, events.size[0]) for chunk in chunks) if events.by_jaer else chunks

    def read_frames() -> Iterator[Frame]:
        if frames is None:
            return iter(())
        ordered = in_order(_stored_frames(container, frames, white))
        return ordered if exposure_known else map(_stamp_only, ordered)

    triggers = _triggers(container.streams, events or frames)  # type: ignore[arg-type]

    def read_triggers() -> Iterator[TriggerArray]:
        return iter(()) if triggers is None else container.read(triggers, _edges)

    @cache
    def count_events() -> int:
        return 0 if events is None else sum(container.read(events, _event_count))

    return Source(
        path=path,
        format="aedat4",
        sensor_size=(events or frames).size,  # type: ignore[union-attr]
        events=SeekableEvents(read_events, read_events),
        frames=read_frames,
        count_events=count_events,
        count_frames=lambda: 0 if frames is None else len(container.packets[frames.number]) // 2,
        exposure_known=exposure_known,
        triggers=None if triggers is None else read_triggers,
        missing=missing,
        mosaic=mosaic,
    )


def _choose(
    event_streams: list[_Stream], frame_streams: list[_Stream]
) -> tuple[_Stream | None, _Stream | None]:
    """The first pair of streams of equal size and of one camera, else of equal size, else of one camera.

    Never a pair of two cameras: rather the events alone.
    """
    if not event_streams or not frame_streams:
        return next(iter(event_streams), None), next(iter(frame_streams), None)
    pairs = [(e, f) for e in event_streams for f in frame_streams if not _of_two_cameras(e, f)]
    # The first of the best.
    best = max(pairs, key=lambda pair: (pair[0].size == pair[1].size, _alike(*pair)), default=None)
    return (event_streams[0], None) if best is None else best


def _alike(first: _Stream, second: _Stream) -> bool:
    return first.camera == second.camera


def _of_two_cameras(first: _Stream, second: _Stream) -> bool:
    """Whether both name a camera with its serial number, not the same. Modules that change a stream may rename it."""
    named = all(_SERIAL.fullmatch(stream.camera) for stream in (first, second))
    return named and not _alike(first, second)


def _triggers(streams: tuple[_Stream, ...], read: _Stream) -> _Stream | None:
    """The first trigger stream of the camera of the stream that is read, else the first that may be."""
    found = [stream for stream in streams if stream.kind == "TRIG" and not _of_two_cameras(stream, read)]
    return max(found, key=lambda stream: _alike(stream, read), default=None)


def _doubts(events: _Stream | None, frames: _Stream) -> tuple[str, ...]:
    """A sentence about streams that are paired for their size alone."""
    if events is None or _alike(events, frames):
        return ()
    return (
        f"The events are of the source {events.camera[:_SHOWN]!r}, the frames of {frames.camera[:_SHOWN]!r}; they are "
        "taken for one camera's.",
    )


def _others(name: str, chosen: _Stream | None, streams: list[_Stream]) -> tuple[str, ...]:
    if chosen is None or len(streams) < 2:
        return ()
    height, width = chosen.size
    return (
        f"The file has {len(streams)} {name} streams; only stream {chosen.number} ({width}x{height}) "
        "is read.",
    )


def _of_other_size(frame: tuple[int, ...], events: tuple[int, int]) -> str:
    return (
        f"The frames are not read: they have {frame[1]}x{frame[0]} pixels, the events {events[1]}x{events[0]}; images "
        "of the events' pixels can be joined (--frames)."
    )


def _about_exposure(container: _Container, frames: _Stream, first: Frame) -> tuple[str, ...]:
    """A sentence about exposures of which the file does not say enough, or too much."""
    if frames.by_jaer:
        return (_JAER_EXPOSURE,)
    stated = next(container.read(frames, _stated_exposure))
    if not 0 < stated < first.exposure:
        return ()
    return (
        f"The first frame states an exposure of {stated} us, but one that takes {first.exposure} us from its start to "
        "its end, which is taken (another: --exposure).",
    )


def _stamp_only(frame: Frame) -> Frame:
    return dataclasses.replace(frame, exposure_end=frame.exposure_start)


# The contents of packets


def _events(table: _Table) -> memoryview:
    """The bytes of a packet's events: the FlatBuffers struct (int64, int16, int16, bool, 3 bytes) is EVENT_DTYPE."""
    start, count = table.vector(0)
    end = start + EVENT_DTYPE.itemsize * count
    if end > len(table.data):
        raise EOFError("the packet is shorter than its events")
    if table.data[start + _POLARITY : end : EVENT_DTYPE.itemsize].translate(None, b"\0\1"):
        raise ValueError("polarity is neither 0 nor 1")
    return memoryview(table.data)[start:end]


def _packet_of(container: _Container, stream: _Stream, t: int) -> int:
    """The packet after which the events not before ``t``, us, begin, or that holds the first of them."""

    def begin(packet: int) -> int:
        filled = (content for content in container.read(stream, _events, packet) if len(content))
        content = next(filled, None)
        return LATEST if content is None else int(np.frombuffer(content, EVENT_DTYPE, 1)["t"][0])

    packets = range(len(container.packets.get(stream.number, ())) // 2)
    return max(bisect_left(packets, t, key=begin) - 1, 0)


def _joined(packets: Iterator[memoryview]) -> Iterator[EventArray]:
    """Events in chunks that are worth a loop. As bytes: packets are small, and NumPy takes long to begin."""
    held: list[memoryview] = []
    size = 0
    for packet in packets:
        while size + len(packet) > _CHUNK_BYTES:
            part = _CHUNK_BYTES - size
            yield np.frombuffer(bytearray().join([*held, packet[:part]]), EVENT_DTYPE)
            held, size, packet = [], 0, packet[part:]
        held.append(packet)
        size += len(packet)
    if size:
        yield np.frombuffer(bytearray().join(held), EVENT_DTYPE)


def _edges(table: _Table) -> TriggerArray:
    found = [(t, 0, _EDGES[kind]) for t, kind in trigger_types(table) if kind in _EDGES]
    return np.array(found, TRIGGER_DTYPE)


def trigger_types(table: _Table) -> Iterator[tuple[int, int]]:
    """Time (us) and dv::TriggerType of every trigger of a packet."""
    start, count = table.vector(0)
    for place in range(start, start + 4 * count, 4):
        trigger = _Table(table.data, place + _unpack("<I", table.data, place))
        yield trigger.scalar(0, "<q", 0), trigger.scalar(1, "<b", 0)


def _event_count(table: _Table) -> int:
    return table.vector(0)[1]


def _upright(events: EventArray, height: int) -> EventArray:
    """Events whose rows were counted from the bottom. One that lies outside stays there."""
    y = events["y"]
    events["y"] = np.where(y < height, height - 1 - y.astype(np.int32), y)
    return events


def _stored_frames(container: _Container, stream: _Stream, white: float | None = None) -> Iterator[Frame]:
    """Frames as stored, row 0 on top. Start and end of the exposure are equal where it is not recorded."""
    return container.read(stream, lambda table: _frame(table, str(container.path), stream.by_jaer, white))


def _frame(table: _Table, where: str, by_jaer: bool, white: float | None) -> Frame:
    kind = table.scalar(5, "<b", 0)
    if kind not in AEDAT4_PIXELS:
        raise FormatError(
            f"{where}: its frames have the unknown pixel type {kind}; 8 or 16 bits, grey or BGR, are needed"
        )
    width, height = table.scalar(6, "<h", 0), table.scalar(7, "<h", 0)
    dtype, channels = AEDAT4_PIXELS[kind]
    start, size = table.vector(10)
    if width <= 0 or height <= 0 or size != width * height * channels * dtype.itemsize:
        raise ValueError(f"{size} bytes of pixels for {width}x{height}")
    pixels = np.frombuffer(table.data, dtype, width * height * channels, start)
    image: NDArray[Any] = pixels.reshape((height, width) if channels == 1 else (height, width, channels))
    if channels > 1:
        image = image[..., 2::-1]
    start, end = _readout(table) if by_jaer else _exposure(table)
    return Frame(np.array(image[::-1] if by_jaer else image, order="C"), start, end, white)


def _exposure(table: _Table) -> tuple[int, int]:
    """Start and end of the exposure, us."""
    stamp = table.scalar(0, "<q", 0)
    start = table.scalar(3, "<q", 0) or stamp
    return start, table.scalar(4, "<q", 0) or start + _stated_exposure(table)


def _stated_exposure(table: _Table) -> int:
    """The field for the length of the exposure, us; 0 if there is none."""
    return table.scalar(11, "<q", 0)


def _readout(table: _Table) -> tuple[int, int]:
    """Start and end of the exposure of a frame of jAER, us.

    What stands in their fields is when the first pixel's reset was read and when the last signal was. Reading all
    resets takes as long as reading all signals, so that the exposure of a global shutter is in the middle.
    """
    first, last = table.scalar(3, "<q", 0), table.scalar(4, "<q", 0)
    length = max(_stated_exposure(table), 0)
    start = first + (last - first - length) // 2
    return start, start + length


# The container


def _open(path: Path, file: BinaryIO) -> _Container:
    """Read the header and find all packets, without decompressing any."""
    file.seek(0, 2)
    file_size = file.tell()
    file.seek(len(AEDAT4_MAGIC))
    prefix = _exactly(file, 4)
    header = _root(prefix + _exactly(file, struct.unpack("<I", prefix)[0]), b"IOHE")
    compression = header.scalar(0, "<i", 0)
    if compression not in _DECOMPRESS:
        raise FormatError(f"{path}: unknown compression {compression}; save it again with LZ4, ZSTD or none")
    table_position = header.scalar(1, "<q", -1)  # -1: the recording was not closed
    if table_position > file_size:
        raise FormatError(
            f"{path}: cut short: it ends at byte {file_size}, its packets should go on to byte "
            f"{table_position}; copy or download it again"
        )
    end = table_position if table_position > 0 else file_size
    return _Container(
        path,
        _DECOMPRESS[compression],
        tuple(_streams(header.text(2))),
        _packets(path, file, file.tell(), end),
    )


def _streams(info: str) -> Iterator[_Stream]:
    """Streams declared in the header's XML."""
    root = ElementTree.fromstring(info.rstrip("\0"))
    for node in root.findall("./node[@name='outInfo']/node"):
        kind = node.findtext("./attr[@key='typeIdentifier']", "")
        width, height = (
            int(node.findtext(f"./node[@name='info']/attr[@key='{key}']", "0")) for key in ("sizeX", "sizeY")
        )
        if kind in ("EVTS", "FRME") and (width <= 0 or height <= 0):
            raise ValueError(f"the {_NAMES[kind]} stream has no size")
        camera = node.findtext("./node[@name='info']/attr[@key='source']", "")
        module = node.findtext("./attr[@key='originalModuleName']", "")
        filters = node.find("./node[@name='info']/attr[@key='colorFilter']") is not None
        yield _Stream(int(node.attrib["name"]), kind, (height, width), camera, module, filters)


def _packets(path: Path, file: BinaryIO, position: int, end: int) -> dict[int, array[int]]:
    places: dict[int, array[int]] = {}
    found: Counter[int] = Counter()
    while position < end:
        file.seek(position)
        number, size = AEDAT4_PACKET.unpack(file.read(AEDAT4_PACKET.size).ljust(AEDAT4_PACKET.size, b"\xff"))
        start = position + AEDAT4_PACKET.size
        if size < 0 or start + size > end:
            raise FormatError(
                f"{path}: cut short or damaged: the packet at byte {position} (number {found.total()}) does "
                f"not end before byte {end}; copy or download it again"
            )
        places.setdefault(number, array("q")).extend((start, size))
        found[number] += 1
        position = start + size
    return places


def _exactly(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) != size:
        raise EOFError(f"{size} bytes expected, {len(data)} found before the end of the file")
    return data


def _lz4(data: bytes) -> bytes:
    # Not lz4.frame.decompress: that allocates whatever size a damaged frame claims.
    # Nor lz4.frame.LZ4FrameDecompressor, which calls the same but takes longer over a small packet than LZ4 does.
    context = lz4.frame.create_decompression_context()
    out: bytes
    out, _, complete = lz4.frame.decompress_chunk(context, data)
    if not complete:
        raise EOFError("compressed data are incomplete")
    return out


_DECOMPRESS: Final[dict[int, Callable[[bytes], bytes]]] = {
    0: lambda data: data,
    1: _lz4,
    2: _lz4,  # high compression, same format
    3: unzstd,
    4: unzstd,
}


# FlatBuffers: https://flatbuffers.dev/internals/


class _Table(NamedTuple):
    """A FlatBuffers table: fields found by number, each may be absent."""

    data: bytes
    position: int

    def scalar(self, field: int, code: str, default: int) -> int:
        place = self._field(field)
        return default if place is None else _unpack(code, self.data, place)

    def vector(self, field: int) -> tuple[int, int]:
        """Offset and length of a vector; (0, 0) if absent."""
        place = self._field(field)
        if place is None:
            return 0, 0
        start = place + _unpack("<I", self.data, place)
        return start + 4, _unpack("<I", self.data, start)

    def text(self, field: int) -> str:
        start, length = self.vector(field)
        return self.data[start : start + length].decode()

    def _field(self, field: int) -> int | None:
        table = self.position - _unpack("<i", self.data, self.position)
        slot = 4 + 2 * field
        if slot >= _unpack("<H", self.data, table):
            return None
        offset = _unpack("<H", self.data, table + slot)
        return self.position + offset if offset else None


def _root(data: bytes, identifier: bytes) -> _Table:
    """The root table of a size-prefixed buffer, whose type must be as declared."""
    size, root, found = _BUFFER_HEADER.unpack_from(data)
    if size + 4 > len(data):
        raise EOFError("the packet is shorter than it says")
    if found != identifier:
        raise ValueError(f"it is not of the declared type {identifier.decode()}")
    return _Table(data, 4 + root)


_BUFFER_HEADER: Final = struct.Struct("<II4s")
_CODES: Final = {code: struct.Struct(code).unpack_from for code in ("<b", "<h", "<H", "<i", "<I", "<q")}


def _unpack(code: str, data: bytes, position: int) -> int:
    if position < 0:  # struct would count from the end
        raise ValueError("an offset points before the packet")
    value: int = _CODES[code](data, position)[0]
    return value
