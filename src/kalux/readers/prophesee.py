"""Prophesee's files: RAW with EVT 2.0, 2.1 or 3.0 words, and DAT with decoded events.

Both begin with lines ``% keyword value``; see https://docs.prophesee.ai/stable/data/file_formats/.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EventArray
from kalux.readers import evt
from kalux.readers.source import SIZE_UNKNOWN, Source, TriggerArray, counted, reading, smallest_size

_HEADER_BYTES: Final = 1 << 16
_BLOCK_BYTES: Final = 1 << 19
_LARGEST: Final = (1 << 11, 1 << 11)  # coordinates of RAW have 11 bits
_NO_FRAMES: Final = "The file has no frames: Prophesee's cameras record events only."
_SIZES: Final = {
    "genx320": (320, 320),
    "gen3": (480, 640),
    "gen4": (720, 1280),
    "imx636": (720, 1280),
    "imx646": (720, 1280),
}
_VERSIONS: Final = {"2.0": "EVT2", "2.1": "EVT21", "3.0": "EVT3"}
_ENCODINGS: Final = {"EVT2": evt.EVT2, "EVT21": evt.EVT21, "EVT3": evt.EVT3}
_DAT_EVENTS: Final = {0: "events", 12: "events", 14: "edges of trigger inputs"}
"""What the records of a DAT file are, by the type that it states."""


@dataclass(frozen=True)
class _Header:
    """Values by lower-case keyword, and where the header ends, bytes."""

    fields: dict[str, str]
    end: int

    @property
    def format(self) -> tuple[str, dict[str, str]]:
        """Name and options of ``% format EVT3;height=720;width=1280``, or of the older ``% evt 3.0``."""
        name, *options = self.fields.get("format", "").split(";")
        if not name and "evt" in self.fields:
            name = _VERSIONS.get(self.fields["evt"], f"EVT {self.fields['evt']}")
        pairs = (option.partition("=") for option in options)
        return name, {key.strip().lower(): value.strip() for key, _, value in pairs}

    @property
    def size(self) -> tuple[int, int] | None:
        """(height, width) as stated, or that of the model of the camera, if either is known."""
        _, options = self.format
        stated = options | self.fields
        geometry = re.fullmatch(r"(\d{1,5})x(\d{1,5})", self.fields.get("geometry", ""))
        width, height = geometry.groups() if geometry else (stated.get("width", ""), stated.get("height", ""))
        if re.fullmatch(r"\d{1,5}", width) and re.fullmatch(r"\d{1,5}", height):
            size = int(height), int(width)
            if min(size) > 0:
                return size
        plugin = self.fields.get("plugin_name", "").lower()
        return next((size for model, size in _SIZES.items() if model in plugin), None)


def recognises_raw(path: Path) -> bool:
    """Whether the file begins with a header that names an encoding."""
    # Not any text with a comment that begins so.
    return re.fullmatch(r"[A-Z][A-Z0-9]{1,15}|EVT \d+(\.\d+)?", _header(path).format[0]) is not None


def recognises_dat(path: Path) -> bool:
    """Whether the file begins with a header that names none, and a type and a size of events."""
    header = _header(path)
    return (
        bool(header.fields)
        and not header.format[0]
        and _record_type(path, header)[1] == evt.DAT.word.itemsize
    )


def read_raw(path: Path) -> Source:
    """Open a RAW file of EVT 2.0, 2.1 or 3.0.

    Times are the sensor's, us. Edges on the trigger inputs are in ``triggers``.

    Raises
    ------
    FormatError
        If the encoding is unknown or the file ends within a word.
    InputError
        If it cannot be read.
    """
    with reading(path):
        header = _header(path)
    name, options = header.format
    if name not in _ENCODINGS:
        known = ", ".join(_ENCODINGS)
        raise FormatError(f"{path}: events encoded as {name[:40]!r} cannot be read; record as one of {known}")
    encoding = _ENCODINGS[name]
    order = options.get("endianness") or header.fields.get("endianness", "little")
    if name == "EVT21" and order == "legacy":
        encoding = evt.EVT21_LEGACY
    elif order not in ("little", "legacy"):
        raise FormatError(f"{path}: words in {order[:40]!r} order cannot be read; record in 'little' order")
    return _source(path, "prophesee-raw", _Words(path, header.end, encoding), header.size)


def read_dat(path: Path) -> Source:
    """Open a DAT file of events.

    Raises
    ------
    FormatError
        If it is of an old version or holds other than events, or ends within an event.
    InputError
        If it cannot be read.
    """
    with reading(path):
        header = _header(path)
        kind, _ = _record_type(path, header)
    if header.fields.get("version", "2") != "2":
        raise FormatError(
            f"{path}: DAT files of version {header.fields['version'][:40]!r} cannot be read; save it as version 2"
        )
    if _DAT_EVENTS.get(kind) != "events":
        held = _DAT_EVENTS.get(kind, f"records of type {kind}")
        raise FormatError(f"{path}: holds {held}, not events; open the file with the events")
    return _source(path, "prophesee-dat", _Words(path, header.end + 2, evt.DAT), header.size)


@dataclass(frozen=True)
class _Words:
    """The words of a file: where they begin, and what they are."""

    path: Path
    start: int
    encoding: evt.Encoding

    def check(self) -> None:
        size = self.path.stat().st_size
        if (size - self.start) % self.encoding.word.itemsize:
            raise FormatError(
                f"{self.path}: cut short: it ends within a word of {self.encoding.word.itemsize} bytes, "
                f"at byte {size}; copy or download it again"
            )

    def blocks(self) -> Iterator[NDArray[Any]]:
        count = _BLOCK_BYTES // self.encoding.word.itemsize
        with self.path.open("rb") as file:
            file.seek(self.start)
            while len(words := np.fromfile(file, self.encoding.word, count)):
                yield words

    def events(self, sensor_size: tuple[int, int]) -> Iterator[EventArray]:
        with reading(self.path, evt.ClockError):
            yield from evt.decode_events(self.encoding, self.blocks(), sensor_size)

    def triggers(self, sensor_size: tuple[int, int]) -> Iterator[TriggerArray]:
        with reading(self.path, evt.ClockError):
            yield from evt.decode_triggers(self.encoding, self.blocks(), sensor_size)


def _source(path: Path, name: str, words: _Words, stated_size: tuple[int, int] | None) -> Source:
    with reading(path):
        words.check()
    size = stated_size or smallest_size(path, words.events(_LARGEST))
    return Source(
        path=path,
        format=name,
        sensor_size=size,
        events=lambda: words.events(size),
        count_events=counted(lambda: words.events(size)),
        triggers=None if words.encoding is evt.DAT else lambda: words.triggers(size),
        missing=(_NO_FRAMES,) + (() if stated_size else (SIZE_UNKNOWN,)),
        sensor_size_known=stated_size is not None,
    )


def _header(path: Path) -> _Header:
    """Lines ``% keyword value`` at the beginning; no fields where there are none."""
    if not path.is_file():
        return _Header({}, 0)
    with path.open("rb") as file:
        data = file.read(_HEADER_BYTES)
    fields: dict[str, str] = {}
    position = 0
    while data.startswith(b"% ", position):
        end = data.find(b"\n", position)
        if end < 0:
            break
        line = data[position + 2 : end].decode("latin-1").strip()
        position = end + 1
        if line.lower() == "end":
            break
        keyword, _, value = line.partition(" ")
        fields[keyword.lower()] = value.strip()
    return _Header(fields, position)


def _record_type(path: Path, header: _Header) -> tuple[int, int]:
    """Type and size of the records of a DAT file; (-1, -1) where it ends before them."""
    with path.open("rb") as file:
        file.seek(header.end)
        pair = file.read(2)
    return (pair[0], pair[1]) if len(pair) == 2 else (-1, -1)
