"""Event Stream (``.es``) of the Paris neuromorphic groups, version 2, DVS events only.

A header of 20 bytes, then five bytes per event: microseconds since the previous event (7 bits) and polarity, x, y;
``0xff`` stands for 127 us without an event, ``0xfe`` for nothing. Written from the description at
https://github.com/neuromorphic-paris/event_stream.

That leaves open where y begins. The authors' converters from other formats (``dat_to_es`` in
https://github.com/neuromorphic-paris/command_line_tools) count rows from the bottom, so they are turned here.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EVENT_DTYPE, EventArray
from kalux.readers.source import CHUNK_EVENTS, Source, begins_with, counted, reading

_SIGNATURE: Final = b"Event Stream"
_TYPES: Final = {0: "generic", 1: "DVS", 2: "ATIS", 3: "display", 4: "colour"}
_DVS: Final = 1
_SIZE: Final = struct.Struct("<HH")
_EVENT_BYTES: Final = 5
_NO_FAULT, _OUTSIDE, _TOO_LATE = 0, 1, 2
_LAST_TIME: Final = np.int64(1) << np.int64(62)  # a file of overflows must not wrap around


class _Header(NamedTuple):
    height: int
    width: int
    length: int


def recognises(path: Path) -> bool:
    """Whether the file begins with ``Event Stream``."""
    return begins_with(path, _SIGNATURE)


def read(path: Path) -> Source:
    """Open an Event Stream file of DVS events.

    Raises
    ------
    FormatError
        If it has another version or type of events, or is cut short.
    InputError
        If it cannot be read.
    """
    header = _read_header(path)
    return Source(
        path=path,
        format="es",
        sensor_size=(header.height, header.width),
        events=lambda: _events(path, header),
        count_events=counted(lambda: _events(path, header)),
        missing=(
            "The format has no frames.",
            "Rows are counted from the bottom, as the authors' own tools do.",
        ),
    )


def _read_header(path: Path) -> _Header:
    with reading(path), path.open("rb") as file:
        data = file.read(len(_SIGNATURE) + 8)
    fields = data[len(_SIGNATURE) :]
    if len(fields) >= 4 and fields[0] != 2:
        version = ".".join(str(part) for part in fields[:3])
        raise FormatError(f"{path}: is Event Stream {version}; kalux reads version 2, so convert it")
    if len(fields) >= 4 and fields[3] != _DVS:
        kind = _TYPES.get(fields[3], f"unknown ({fields[3]})")
        remedy = ", so convert it (atis_to_dvs)" if kind == "ATIS" else " only"
        raise FormatError(f"{path}: holds events of type {kind}; kalux reads DVS events{remedy}")
    if len(fields) < 8:
        raise FormatError(f"{path}: is cut short within its header; copy or download it again")
    width, height = _SIZE.unpack(fields[4:8])
    if not (width and height):
        raise FormatError(f"{path}: says that the sensor has {width}x{height} pixels; its header is damaged")
    return _Header(height, width, len(data))


def _events(path: Path, header: _Header) -> Iterator[EventArray]:
    buffer = bytearray(_EVENT_BYTES * CHUNK_EVENTS)
    filled, before, t = 0, header.length, np.int64(0)
    with reading(path), path.open("rb") as file:
        file.seek(header.length)
        while got := file.readinto(memoryview(buffer)[filled:]):
            filled += got
            chunk: EventArray = np.empty(filled // _EVENT_BYTES, EVENT_DTYPE)
            count, used, t, fault = _decode(
                np.frombuffer(buffer, np.uint8, filled),
                t,
                header.width,
                header.height,
                chunk["t"],
                chunk["x"],
                chunk["y"],
                chunk["p"],
            )
            if fault:
                raise _damage(path, before + used, fault, header)
            buffer[: filled - used] = buffer[used:filled]
            before, filled = before + used, filled - used
            yield chunk[:count]
        if filled:
            raise FormatError(
                f"{path}: is cut short, {filled} bytes into an event; copy or download it again"
            )


def _damage(path: Path, position: int, fault: int, header: _Header) -> FormatError:
    what = (
        f"an event lies outside the sensor of {header.width}x{header.height} pixels"
        if fault == _OUTSIDE
        else "the time exceeds what can be stored"
    )
    return FormatError(f"{path}: {what} (byte {position}); it is damaged, so copy or download it again")


@njit(cache=True, nogil=True)
def _decode(
    data: NDArray[np.uint8],
    now: np.int64,
    width: int,
    height: int,
    t: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.bool_],
) -> tuple[int, int, np.int64, int]:
    """Decode whole events. Returns their number, the bytes used, the time, and a fault (0: none)."""
    count = i = 0
    end = len(data)
    while i < end:
        first = data[i]
        if first == 255:
            now += np.int64(127)
            if now > _LAST_TIME:
                return count, i, now, _TOO_LATE
            i += 1
        elif first == 254:
            i += 1
        elif i + 5 > end:
            break
        else:
            now += np.int64(first >> 1)
            column = int(data[i + 1]) | int(data[i + 2]) << 8
            row = int(data[i + 3]) | int(data[i + 4]) << 8
            if column >= width or row >= height:
                return count, i, now, _OUTSIDE
            t[count] = now
            x[count] = column
            y[count] = height - 1 - row
            p[count] = (first & 1) == 1
            count += 1
            i += 5
    return count, i, now, _NO_FAULT
