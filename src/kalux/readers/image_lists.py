"""Lists of images with their times: a CSV with a line per image, the ``images.txt`` of the IJRR layout, times alone."""

from __future__ import annotations

import csv
import re
import zipfile
from collections.abc import Callable, Iterator, Sequence
from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path
from typing import Final, NamedTuple

from kalux.errors import FormatError
from kalux.events import FIELD_NAMES, LATEST
from kalux.frames import Frame
from kalux.readers.columns import find_name, find_time
from kalux.readers.images import images_in, load_image

_EXPOSURE: Final = ("exposure", "exposure_time")
_FILE: Final = ("file", "filename", "file_name", "image", "name", "path")
_NUMBER: Final = re.compile(r"\d{1,18}(\.\d*)?|\.\d+")
_PRINTED: Final = re.compile(r"(\d{1,18}(\.\d*)?|\.\d+)(e[+-]?\d{1,2})?", re.IGNORECASE)
_NUMBERED: Final = re.compile(r"\s*\d+\s+\d+\.\d+\s+(?P<file>\S.*?)\s*")
"""A line of an ``images.txt`` that may begin with a number of the image."""
_PER_UNIT: Final = {"s": Decimal(10**6), "ms": Decimal(1000), "us": Decimal(1), "ns": Decimal("0.001")}

WANTED: Final = (
    "a CSV named frames.csv with a line per image and the columns timestamp_us, perhaps exposure_us and file, the "
    "images.txt of the IJRR layout, or a timestamps.txt with a time per line"
)
"""What a list of images may be, for messages."""


class Listed(NamedTuple):
    """An image file and its exposure, us; start and end are both the stamp where that is all that is known."""

    file: Path
    start: int
    end: int


def read_csv(
    path: Path, text: str, *, wanted: str = WANTED, signed: bool = False
) -> tuple[list[Listed], bool]:
    """The images that a CSV lists, and whether it states their exposures.

    ``wanted`` says in messages what it may be; ``signed``, whether times may be negative.

    Raises
    ------
    FormatError
        If it has no column of times, or a line cannot be read.
    """
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    if not lines or "\0" in text:
        raise FormatError(f"{path}: is empty, or no text; {wanted} is needed")
    separator = next((c for c in ",;\t" if c in lines[0][1]), ",")
    header = [name.strip() for name in next(csv.reader([lines[0][1].lstrip("# ")], delimiter=separator))]
    time, exposure = find_time(header, FIELD_NAMES["t"]), find_time(header, _EXPOSURE)
    name = find_name(header, _FILE)
    if time is None:
        raise FormatError(f"{path}: has the columns {', '.join(header)[:80]}; {wanted} is needed")
    rows = []
    for number, line in lines[1:]:
        if line.lstrip().startswith("#"):
            continue
        fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
        if len(fields) != len(header):
            raise FormatError(
                f"{path}: line {number}: {line[:60]!r} has {len(fields)} columns, not {len(header)}"
            )
        rows.append((number, dict(zip(header, fields, strict=True))))
    files = images_in(path.parent) if name is None else [path.parent / row[name].strip() for _, row in rows]
    if len(files) != len(rows):
        raise FormatError(
            f"{path}: lists {len(rows)} times, but there are {len(files)} images beside it; add a column file"
        )
    listed = []
    for (number, row), file in zip(rows, files, strict=True):
        stamp = _microseconds(path, number, row[time[0]], time[1], signed=signed)
        length = 0 if exposure is None else _microseconds(path, number, row[exposure[0]], exposure[1])
        listed.append(Listed(file, stamp, stamp + length))
    return listed, exposure is not None


def read_ijrr(
    path: Path | zipfile.Path, text: str, exists: Callable[[str], bool]
) -> Iterator[tuple[int, str]]:
    """The times, us, and names of the images of an ``images.txt``: a line ``t file`` for each, t in seconds.

    Or ``id t file``, as UZH-FPV has it, if a comment says so or ``exists`` says of every file that it is there.

    Raises
    ------
    FormatError
        If a line cannot be read.
    """
    numbered = _has_ids(text, exists)
    wanted = "id t file" if numbered else "t file"
    for number, line in enumerate(text.splitlines(), 1):
        if _is_comment(line):
            continue
        fields = line.split(maxsplit=len(wanted.split()) - 1)
        if len(fields) != len(wanted.split()):
            raise FormatError(f"{path}: line {number}: {line[:60]!r} is not {wanted!r} with t in seconds")
        yield _microseconds(path, number, fields[-2], "s"), fields[-1].strip()


def _has_ids(text: str, exists: Callable[[str], bool]) -> bool:
    """Whether the lines of an ``images.txt`` begin with a number of the image, before its time."""
    lines = text.splitlines()
    names = [line.lstrip("# \t").lower().split() for line in lines if line.lstrip().startswith("#")]
    if any(len(fields) == 3 and fields[0] == "id" for fields in names):
        return True
    matches = [_NUMBERED.fullmatch(line) for line in lines if not _is_comment(line)]
    return bool(matches) and all(match is not None and exists(match["file"]) for match in matches)


def _is_comment(line: str) -> bool:
    """Whether a line is blank or begins with #."""
    return not line.strip() or line.lstrip().startswith("#")


def read_stamps(path: Path, text: str, unit: str) -> list[int]:
    """The times, us, of a list that has nothing else: one a line, in ``"us"`` or ``"s"``, as programs print floats.

    Raises
    ------
    FormatError
        If a line cannot be read, or is no whole number of microseconds where they are the unit.
    """
    stamps = []
    for number, line in enumerate(text.splitlines(), 1):
        field = line.strip()
        if not field or field.startswith("#"):
            continue
        stamp = Decimal(field) * _PER_UNIT[unit] if _PRINTED.fullmatch(field) else None
        if stamp is None or stamp >= LATEST or (unit == "us" and stamp != stamp.to_integral_value()):
            wanted = "a whole number of microseconds" if unit == "us" else "a time in seconds"
            raise FormatError(f"{path}: line {number}: {field[:40]!r} is not {wanted}")
        stamps.append(int(stamp.to_integral_value(ROUND_HALF_UP)))
    return stamps


def are_stamps(text: str) -> bool:
    """Whether a list has nothing but times, one a line."""
    fields = [line.strip() for line in text.splitlines() if not _is_comment(line)]
    return bool(fields) and all(_PRINTED.fullmatch(field) for field in fields)


def read_images_with_stamps(path: Path, text: str) -> tuple[list[Listed], str]:
    """The images beside a list of times alone, and what is to be said of the unit: us, or s if one has a fraction.

    Raises
    ------
    FormatError
        If there are not as many images as times, or a time is impossible.
    """
    times = [line.strip() for line in text.splitlines() if not _is_comment(line)]
    unit = "us" if all(time == time.to_integral_value() for time in map(Decimal, times)) else "s"
    stamps = read_stamps(path, text, unit)
    files = images_in(path.parent)
    if len(files) != len(stamps):
        raise FormatError(
            f"{path}: lists {len(stamps)} times, but there are {len(files)} images beside it; a time for each is needed"
        )
    taken = "whole numbers are taken as microseconds" if unit == "us" else "decimals are taken as seconds"
    listed = [Listed(file, stamp, stamp) for file, stamp in zip(files, stamps, strict=True)]
    return listed, f"{path.name} does not state the unit of the images' times; its {taken}."


def read_listed(place: Path, listed: Sequence[Listed], *, colour: bool) -> Iterator[Frame]:
    """The frames of listed images; ``place`` is the recording, for messages."""
    for image in listed:
        yield Frame(load_image(place, image.file, colour=colour), image.start, image.end)


def _microseconds(
    path: Path | zipfile.Path, number: int, text: str, unit: str | None, *, signed: bool = False
) -> int:
    """A time, rounded to the nearest microsecond from its digits."""
    text = text.strip()
    digits = text.removeprefix("-") if signed else text
    time = Decimal(text) * _PER_UNIT[unit or "us"] if _NUMBER.fullmatch(digits) else None
    if time is None or abs(time) >= LATEST:
        raise FormatError(f"{path}: line {number}: {text[:40]!r} is not a plain number that can be a time")
    if unit is None and "." in text:
        raise FormatError(
            f"{path}: line {number}: {text[:40]!r} has decimals, but no unit; name it in the column, as timestamp_s"
        )
    return int(time.to_integral_value(ROUND_HALF_UP))
