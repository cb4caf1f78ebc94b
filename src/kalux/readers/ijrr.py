"""The text layout of the IJRR 2017 event camera dataset (Mueggler et al.), as a folder or zipped.

``events.txt`` has a line ``t x y p`` per event, ``images.txt`` a line ``t file`` per frame; ``t`` is in
seconds, ``x`` and ``y`` 0-based, ``p`` 0 or 1. See https://rpg.ifi.uzh.ch/davis_data.html. UZH-FPV
(https://fpv.ifi.uzh.ch) has a line ``id t file`` per frame. The zips of rpg_e2vid (https://github.com/uzh-rpg/rpg_e2vid)
hold the events alone, under another name.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EventArray
from kalux.frames import Frame
from kalux.readers.characters import (
    DOT,
    FIVE,
    LONGEST_LINE,
    NEWLINE,
    NINE,
    ONE,
    SPACE,
    TOO_LONG,
    ZERO,
    parsed_events,
    skip_blanks,
)
from kalux.readers.image_lists import read_ijrr
from kalux.readers.images import in_colour, read_image
from kalux.readers.source import (
    EXPOSURE_UNKNOWN,
    SIZE_UNKNOWN,
    Source,
    begins_with,
    counted,
    reading,
    smallest_size,
)

_EVENTS: Final = "events.txt"
_IMAGES: Final = "images.txt"
_EVENT: Final = re.compile(rb"\s*\d+\.\d+\s+\d+\s+\d+\s+[01]\s*")
_ZIP_SIGNATURE: Final = b"PK\x03\x04"
_DAMAGE: Final = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    NotImplementedError,  # a compression that zipfile lacks
    RuntimeError,  # an encrypted member
    ValueError,
    KeyError,
)

_Place = Path | zipfile.Path


class _Found(NamedTuple):
    """The folder of a recording, in the file system or inside a zip, and the file of its events."""

    root: _Place
    events: _Place


def recognises(path: Path) -> bool:
    """Whether the folder or zip has events, at its root or in its one folder; or is a broken zip."""
    if path.is_dir():
        return (path / _EVENTS).is_file()
    if not begins_with(path, _ZIP_SIGNATURE):
        return False
    try:
        return _find(path) is not None
    except _DAMAGE:
        return True  # so that the reader can say that it is damaged


def read(path: Path) -> Source:
    """Open a recording in the IJRR text layout.

    Times are rounded to the nearest microsecond from their decimal digits, not through floating point. The
    layout has no exposure times. The sensor size is that of the first image; without images, that of a
    first line ``width height`` of ``events.txt``, else the smallest that holds all events.

    Raises
    ------
    FormatError
        If a line cannot be read (named by its number), or an image is missing, damaged, or in colour among grey ones.
    InputError
        If a file cannot be read.
    """
    with reading(path, *_DAMAGE):
        found = _find(path)
        if found is None:
            raise FormatError(f"{path}: has no {_EVENTS}; give the folder or zip that contains it")
        root = found.root
        declared_size = _check_beginning(path, found.events)
        images, missing = _image_list(path, root)
    colour = False
    if images:
        colour = in_colour(path, [name for _, name in images], lambda name: (name, _bytes(path, root, name)))
        size = _load(path, root, images[0][1], colour).shape
        sensor_size = (int(size[0]), int(size[1]))
        missing += (EXPOSURE_UNKNOWN,)
    elif declared_size is not None:
        sensor_size = declared_size
    else:
        sensor_size = smallest_size(path, _read_events(path))
        missing += (SIZE_UNKNOWN,)

    def read_frames() -> Iterator[Frame]:
        place = _find_again(path).root
        for stamp, name in images:
            yield Frame(_load(path, place, name, colour), stamp, stamp)

    return Source(
        path=path,
        format="ijrr",
        sensor_size=sensor_size,
        events=lambda: _read_events(path),
        frames=read_frames,
        count_events=counted(lambda: _read_events(path)),
        count_frames=lambda: len(images),
        exposure_known=not images,
        missing=missing,
        sensor_size_known=bool(images) or declared_size is not None,
    )


def _find(path: Path) -> _Found | None:
    """Where ``events.txt`` is; or the only text in a zip, if it begins like it."""
    if path.is_dir():
        return _Found(path, path / _EVENTS)
    top = zipfile.Path(path)
    folders = [entry for entry in top.iterdir() if entry.is_dir() and not entry.name.startswith("__MACOSX")]
    for root in (top, *(folders if len(folders) == 1 else ())):
        if (root / _EVENTS).is_file():
            return _Found(root, root / _EVENTS)
    with zipfile.ZipFile(path) as archive:
        texts = [
            name for name in archive.namelist() if name.endswith(".txt") and not name.startswith("__MACOSX")
        ]
    if len(texts) != 1 or not _begins_with_events(top / texts[0]):
        return None
    return _Found(top, top / texts[0])


def _begins_with_events(place: _Place) -> bool:
    with place.open("rb") as file:
        lines = file.read(LONGEST_LINE).splitlines()
    content = [line for line in lines if line.strip() and not line.lstrip().startswith(b"#")]
    return any(_EVENT.fullmatch(line) for line in content[:2])  # the first may be width and height


def _find_again(path: Path) -> _Found:
    """A handle of its own for each iteration, so that several may run at once."""
    with reading(path, *_DAMAGE):
        found = _find(path)
    if found is None:
        raise FormatError(f"{path}: {_EVENTS} has gone since the recording was opened")
    return found


# Events


def _check_beginning(path: Path, events: _Place) -> tuple[int, int] | None:
    """Check the unit of time; return (height, width) if the first line is a header ``width height``."""
    with events.open("rb") as file:
        lines = [line.split() for line in file.read(LONGEST_LINE).splitlines()[:-1]]
    size = None
    if lines and len(lines[0]) == 2 and all(field.isdigit() for field in lines[0]):
        width, height = map(int, lines[0])
        size = (height, width) if min(height, width) > 0 else None
    times = [line[0] for line in lines if len(line) == 4]
    if times and all(time.isdigit() for time in times) and int(times[-1]) > 0:
        raise FormatError(
            f"{path}: the times in {events.name} have no decimal point ({times[-1][:20].decode()!r}), but this layout "
            "is in seconds; convert them to seconds"
        )
    return size


def _read_events(path: Path) -> Iterator[EventArray]:
    events = _find_again(path).events

    def bad_line(number: int, fault: int, shown: str) -> FormatError:
        return FormatError(
            f"{path}: {events.name}, line {number}: {_FAULTS[fault]}: {shown!r}; a line is 't x y p', t in seconds as "
            "a plain decimal, x and y from 0, p 0 or 1"
        )

    with reading(path, *_DAMAGE), events.open("rb") as file:
        yield from parsed_events(file, _parse, bad_line)


_FAULTS: Final = {
    TOO_LONG: "the line is too long",
    1: "the time is not a plain decimal number of seconds",
    2: "x is not a pixel coordinate",
    3: "y is not a pixel coordinate",
    4: "the polarity is not 0 or 1",
    5: "there are more than four columns",
    6: "there are fewer than four columns",
}
# Unsigned, of the width of what they are compared with: that keeps the compiled loops free of conversions
# and of the test for negative indices, and doubles their speed.
_TEN: Final = np.uint64(10)
_SECONDS_DIGITS: Final = np.uint64(12)  # keeps microseconds within 64 bits
_MICRO_DIGITS: Final = np.uint64(6)
_HASH: Final = np.uint8(ord("#"))


@njit(cache=True, nogil=True)
def _parse(
    text: NDArray[np.uint8],
    skip_header: bool,
    t: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.bool_],
) -> tuple[int, int, int, np.uint64]:
    """Parse whole lines. Returns events, whole lines read, fault (0: none), start of the faulty line.

    Blank lines and lines that begin with # are skipped, as is a first line of two numbers (a header).
    """
    end = np.uint64(len(text))
    i = np.uint64(0)
    count = 0
    lines = 0
    while i < end:
        start = i
        i = skip_blanks(text, i)
        if text[i] == NEWLINE or text[i] == _HASH:
            while text[i] != NEWLINE:
                i += ONE
            i += ONE
            lines += 1
            continue
        micros, i = _parse_time(text, i)
        if micros < 0:
            return count, lines, 1, start
        column = 1
        while column < 4:
            i = skip_blanks(text, i)
            if text[i] == NEWLINE:
                break
            value, i = _parse_integer(text, i)
            if value < 0 or (column == 3 and value > 1):
                return count, lines, column + 1, start
            if column == 1:
                x[count] = value
            elif column == 2:
                y[count] = value
            else:
                p[count] = value == 1
            column += 1
        i = skip_blanks(text, i)
        if text[i] != NEWLINE:
            return count, lines, 5, start
        if column == 4:
            t[count] = micros
            count += 1
        elif not (skip_header and lines == 0 and column == 2):
            return count, lines, 6, start
        i += ONE
        lines += 1
    return count, lines, 0, end


@njit(cache=True, nogil=True, inline="always")
def _parse_digits(text: NDArray[np.uint8], i: np.uint64, value: np.uint64) -> tuple[np.uint64, np.uint64]:
    """Append decimal digits to a number; overlong ones wrap and are refused by their length."""
    while True:
        digit = np.uint8(text[i] - ZERO)
        if digit > NINE:
            return value, i
        value = value * _TEN + np.uint64(digit)
        i += ONE


@njit(cache=True, nogil=True, inline="always")
def _parse_integer(text: NDArray[np.uint8], i: np.uint64) -> tuple[np.int64, np.uint64]:
    """An integer up to 65535 that ends at a blank; -1 if it is none."""
    start = i
    value, i = _parse_digits(text, i, np.uint64(0))
    if i == start or i - start > _TEN or value > np.uint64(65535) or text[i] > SPACE:
        return np.int64(-1), i
    return np.int64(value), i


@njit(cache=True, nogil=True, inline="always")
def _parse_time(text: NDArray[np.uint8], i: np.uint64) -> tuple[np.int64, np.uint64]:
    """Seconds as microseconds, rounded half up; -1 if it is not a plain decimal."""
    start = i
    value, i = _parse_digits(text, i, np.uint64(0))
    digits = i - start
    if digits > _SECONDS_DIGITS:
        return np.int64(-1), i
    decimals = np.uint64(0)
    if text[i] == DOT:
        i += ONE
        while decimals < _MICRO_DIGITS:
            digit = np.uint8(text[i] - ZERO)
            if digit > NINE:
                break
            value = value * _TEN + np.uint64(digit)
            decimals += ONE
            i += ONE
    digits += decimals
    if decimals == _MICRO_DIGITS:
        next_digit = np.uint8(text[i] - ZERO)
        if next_digit <= NINE:
            value += np.uint64(next_digit >= FIVE)
            _, i = _parse_digits(text, i, np.uint64(0))
    while decimals < _MICRO_DIGITS:
        value *= _TEN
        decimals += ONE
    if digits == np.uint64(0) or text[i] > SPACE:
        return np.int64(-1), i
    return np.int64(value), i


# Images


def _image_list(path: Path, root: _Place) -> tuple[list[tuple[int, str]], tuple[str, ...]]:
    """(stamp in us, file name) of each frame, and what is missing."""
    if not (root / _IMAGES).is_file():
        return [], (f"There is no {_IMAGES}, so there are no frames.",)
    exists = cache(lambda name: (root / name).is_file())
    images = list(read_ijrr(root / _IMAGES, (root / _IMAGES).read_bytes().decode("utf-8-sig"), exists))
    absent = [name for _, name in images if not exists(name)]
    if absent:
        raise FormatError(
            f"{path}: {len(absent)} of {len(images)} images listed in {_IMAGES} are missing, the first is "
            f"{absent[0][:60]!r}; copy or download the recording again"
        )
    return images, () if images else (f"{_IMAGES} is empty, so there are no frames.",)


def _load(path: Path, root: _Place, name: str, colour: bool) -> NDArray[Any]:
    return read_image(path, name, _bytes(path, root, name), colour=colour)


def _bytes(path: Path, root: _Place, name: str) -> bytes:
    with reading(path, *_DAMAGE):
        return (root / name).read_bytes()
