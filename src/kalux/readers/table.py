"""Events in a text table whose first line names its columns: CSV, TSV, or separated by blanks.

The columns may have any order and any of the names in `kalux.readers.columns`; others are skipped. Lines that begin
with # are comments; the one with the names may begin with it, too (as ``numpy.savetxt`` writes it). Some lines need no
names: those of ``events.txt`` in the IJRR layout, which other programs write alone (v2e, and rpg_e2vid with a line
``width height`` before them), and ``x,y,p,t`` in microseconds, as Prophesee's programs write them, some with a line
``%geometry:width,height`` before them (``metavision_file_to_csv`` and ``standalone_samples`` of
https://github.com/prophesee-ai/openeb).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EventArray
from kalux.readers.characters import (
    DOT,
    FIVE,
    LONGEST_LINE,
    NEWLINE,
    NINE,
    ONE,
    SPACE,
    TAB,
    TOO_LONG,
    ZERO,
    parsed_events,
    skip_blanks,
)
from kalux.readers.columns import RENAME, UNIT_ASSUMED, Columns, find_columns
from kalux.readers.source import (
    NO_FRAMES,
    SIZE_UNKNOWN,
    Source,
    counted,
    reading,
    smallest_size,
    with_rows_turned,
)

_MOST_COLUMNS: Final = 64
_TXYP: Final = (1, 2, 3, 4)
"""Roles of columns in the order of IJRR."""
_XYPT: Final = (2, 3, 4, 1)
"""In that of Prophesee's programs."""
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_IJRR_LINE: Final = re.compile(r"\s*(\d+\.\d+|\d+(\.\d+)?[eE]-\d+)\s+\d+\s+\d+\s+[01]\s*")
"""Seconds with decimals, or as Python prints small ones (8.3e-05), x, y, and polarity, which nothing else is likely to
be."""
_LABELLED: Final = re.compile(_IJRR_LINE.pattern + r"\s[01]\s*")
"""As v2e writes them with ``--label_signal_noise``."""
_LABELS: Final = "signal/noise"
"""What v2e calls the labels in a comment."""
_LABELS_SKIPPED: Final = "The fifth column, v2e's labels of signal and noise, is not read."
_SIZE_LINE: Final = re.compile(r"\s*([1-9]\d{0,4})\s+([1-9]\d{0,4})\s*")
"""Width and height, as rpg_e2vid has them before the events."""
_GEOMETRY: Final = re.compile(r"\s*%\s*geometry:\s*([1-9]\d{0,4})\s*,\s*([1-9]\d{0,4})\s*")
"""Width and height, as Prophesee's programs state them."""
_PROPHESEE_LINE: Final = re.compile(r"\s*\d+,\d+,[01],(\d+)\s*")
_PROPHESEE_ASSUMED: Final = (
    "The columns have no names; they are taken as x, y, p, t (us), as metavision_file_to_csv writes them."
)
_SIZED: Final = re.compile(r"(.+)@([1-9]\d{0,4})")
"""A name with the number of columns or rows of the sensor, as faery writes them."""
_IJRR_ASSUMED: Final = (
    "The columns have no names; they are taken as t (s), x, y, p, as events.txt of IJRR has them."
)
_FORMAT: Final = re.compile(r"^format:\s*", re.IGNORECASE)
"""What jAER writes before the names."""
_UNIT_OF_LEGEND: Final = re.compile(r"timestamp\((?:(?:float|int32)[ ,])?(?P<unit>s|us)\)")
_LEGEND: Final = re.compile(r"^\W*dvs-events:(?: One event per line:)?\s*(?P<names>.*)$")
_OF_LEGEND: Final = re.compile(r"[ ,]?\([^)]*\)")
"""How jAER names the columns, in a comment: `timestamp(float s) x y polarity(off/on=0/1)`, with what is in brackets.
Some of its versions write the line that begins with format, too."""
_JAER: Final = re.compile(r"^\W*jAER\b.* text file output")
"""The first comment of jAER's DavisTextOutputWriter and CsvEventSink (https://github.com/SensorsINI/jaer), of any
version. They write the rows of its BasicEvent: "by convention starts at bottom"."""
_ROWS_FROM_BELOW: Final = "jAER counts rows from the bottom; they are turned."
_SECONDS_ASSUMED: Final = (
    "The unit of time is not stated; lines are like those of events.txt of IJRR, and times taken as seconds."
)
_DECIMALS: Final = {"s": 6, "ms": 3, "us": 0, "ns": -3, None: 0}
"""How many decimals of each unit a microsecond needs."""


class _Header(NamedTuple):
    """Where the data begin (bytes, lines), what separates columns, which column is what, and the sensor's size.

    ``assumed`` says what the file leaves open, for `Source.missing`, ``from_below`` whether rows count from the bottom.
    """

    begin: int
    lines: int
    separator: str
    roles: tuple[int, ...]
    unit: str | None
    assumed: tuple[str, ...]
    size: tuple[int, int] | None
    from_below: bool = False


class _Beginning(NamedTuple):
    """The first lines of a file: comments, then the sensor's (height, width) if a line has it, then the others.

    ``before`` says how many lines there are before the others.
    """

    comments: list[tuple[int, str]]
    size: tuple[int, int] | None
    before: int
    others: list[str]


class _Named(NamedTuple):
    """A line that names columns: what separates the names, the names, and which are an event's fields.

    ``before`` says how many lines there are before it, ``size`` is the sensor's (height, width) if the names state it.
    """

    before: int
    separator: str
    names: list[str]
    columns: Columns
    size: tuple[int, int] | None


def recognises(path: Path) -> bool:
    """Whether the first line names columns for t, x, y and p; or is a line of numbers, to say what is needed."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        beginning = _beginning(file.read(LONGEST_LINE))
    return any(_named(beginning)) or any(_has_numbers(line) for line in beginning.others[:1])


def read(path: Path) -> Source:
    """Open events in a text table.

    Integer times are microseconds unless the name of the column ends in a unit (``t_ns``); for times with decimals
    it must. They are rounded to the nearest microsecond from their digits, not through floating point.

    Raises
    ------
    FormatError
        If the columns have no names that could be known, or a line (named by its number) cannot be read.
    InputError
        If the file cannot be read.
    """
    with reading(path), path.open("rb") as file:
        header = _read_header(path, file.read(LONGEST_LINE))
    source = Source(
        path=path,
        format="table",
        sensor_size=header.size or smallest_size(path, _events(path, header)),
        events=lambda: _events(path, header),
        count_events=counted(lambda: _events(path, header)),
        missing=(NO_FRAMES, *header.assumed, *(() if header.size else (SIZE_UNKNOWN,))),
        sensor_size_known=header.size is not None,
    )
    return with_rows_turned(source) if header.from_below else source


# The line with the names


def _beginning(data: bytes) -> _Beginning:
    """The first lines; none if it is not text."""
    comments: list[tuple[int, str]] = []
    size = None
    lines = _whole_lines(data)
    for index, line in enumerate(lines):
        if "\0" in line:
            return _Beginning([], None, 0, [])
        match = None if size else _SIZE_LINE.fullmatch(line) or _GEOMETRY.fullmatch(line)
        if match is not None:
            size = (int(match[2]), int(match[1]))
        if _is_comment(line):
            comments.append((index, line))
        elif match is None:
            others = [other for other in lines[index:] if not _is_comment(other)]
            return _Beginning(comments, size, index, others)
    return _Beginning(comments, size, len(lines), [])


def _whole_lines(data: bytes) -> list[str]:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        text = data[: error.start].decode("utf-8-sig")
        if len(data) - error.start >= 4:  # more than a character that is cut off
            return []
    # Not splitlines, which also ends lines where the parser does not.
    lines = text.removesuffix("\n").split("\n")
    return lines[:-1] if len(data) == LONGEST_LINE else lines


def _is_comment(line: str) -> bool:
    """Whether a line is blank or begins with #, or with %, as Prophesee's do."""
    return not line.strip() or line.lstrip().startswith(("#", "%"))


def _separator(line: str) -> str:
    return next((c for c in ",;\t" if c in line), " ")


def _fields(line: str, separator: str) -> list[str]:
    fields = line.split() if separator == " " else line.split(separator)
    return [field.strip().strip("\"'").strip() for field in fields]


def _named(beginning: _Beginning) -> Iterator[_Named]:
    """The lines that name columns: the first that is no comment, and comments."""
    others = [(beginning.before, line) for line in beginning.others[:1]]
    legends = []
    for index, line in beginning.comments:
        legend = _LEGEND.match(line)
        if legend is not None:
            legends.append((index, _OF_LEGEND.sub("", legend["names"])))
    for index, line in (*others, *beginning.comments, *legends):
        text = _FORMAT.sub("", line.strip().lstrip("#%").strip())
        separator = _separator(text)
        matches = [(name, _SIZED.fullmatch(name)) for name in _fields(text, separator)]
        names = [name if match is None else match[1] for name, match in matches]
        lengths = {match[1]: int(match[2]) for _, match in matches if match is not None}
        columns = find_columns(names)
        if columns is not None:
            stated = columns.x in lengths and columns.y in lengths
            size = (lengths[columns.y], lengths[columns.x]) if stated else None
            yield _Named(index, separator, names, columns, size)


def _has_numbers(line: str) -> bool:
    fields = _fields(line.strip(), _separator(line.strip()))
    return len(fields) >= 4 and all(_NUMBER.fullmatch(field) for field in fields)


def _read_header(path: Path, data: bytes) -> _Header:
    beginning = _beginning(data)
    header = _header_as_stored(path, data, beginning)
    if not any(_JAER.match(comment) for _, comment in beginning.comments):
        return header
    return header._replace(assumed=(*header.assumed, _ROWS_FROM_BELOW), from_below=True)


def _header_as_stored(path: Path, data: bytes, beginning: _Beginning) -> _Header:
    all_named = list(_named(beginning))
    named = next((named for named in all_named if _fits(beginning, named)), None)
    if named is not None:
        return _header_of_names(path, data, beginning, named)
    found = _nameless(beginning)
    if found is not None:
        return found._replace(
            begin=_place(data, beginning.before), lines=beginning.before, size=beginning.size
        )
    if all_named:  # a line will be found to have more or fewer columns
        return _header_of_names(path, data, beginning, all_named[0])
    raise FormatError(
        f"{path}: its first line does not name the columns; put a line such as {_example(beginning)!r} there, in "
        "their order"
    )


def _example(beginning: _Beginning) -> str:
    """A line of names for columns that have none, as many and separated as they are."""
    line = beginning.others[0].strip() if beginning.others else ""
    separator = _separator(line) if line else ","
    fields = _fields(line, separator)[:_MOST_COLUMNS]
    time = "t_s" if "." in fields[0] else "t_us"
    more = [f"other{number}" for number in range(1, len(fields) - 3)]
    return separator.join([time, "x", "y", "p", *more])[:80]


def _data_lines(beginning: _Beginning, named: _Named) -> list[str]:
    return beginning.others[1:] if named.before == beginning.before else beginning.others


def _fits(beginning: _Beginning, named: _Named) -> bool:
    """Whether it is no comment, or one with as many names as the first line after the comments has columns."""
    if named.before == beginning.before or not beginning.others:
        return True
    line = beginning.others[0]
    return any(len(_fields(line, by)) == len(named.names) for by in (named.separator, _separator(line)))


def _data_separator(named: _Named, lines: list[str]) -> str:
    """What separates columns: the same as the names, unless only what the lines have gives as many columns."""
    if not lines or len(_fields(lines[0], named.separator)) == len(named.names):
        return named.separator
    own = _separator(lines[0])
    return own if len(_fields(lines[0], own)) == len(named.names) else named.separator


def _header_of_names(path: Path, data: bytes, beginning: _Beginning, named: _Named) -> _Header:
    if len(named.names) > _MOST_COLUMNS:
        raise FormatError(
            f"{path}: has {len(named.names)} columns, kalux reads up to {_MOST_COLUMNS}; leave some out"
        )
    columns = named.columns
    roles = tuple(columns[:4].index(name) + 1 if name in columns[:4] else 0 for name in named.names)
    lines = _data_lines(beginning, named)
    unit = columns.unit or _unit_of_legend(beginning)
    assumed: tuple[str, ...] = () if unit else (UNIT_ASSUMED,)
    if unit is None and roles == _TXYP and _are_seconds(lines):
        unit, assumed = "s", (_SECONDS_ASSUMED,)
    before = max(beginning.before, named.before + 1)
    return _Header(
        _place(data, before),
        before,
        _data_separator(named, lines),
        _first_of_each(roles),
        unit,
        assumed,
        named.size or beginning.size,
    )


def _unit_of_legend(beginning: _Beginning) -> str | None:
    matches = (_UNIT_OF_LEGEND.search(comment) for _, comment in beginning.comments)
    return next((match["unit"] for match in matches if match is not None), None)


def _are_seconds(lines: list[str]) -> bool:
    """Whether lines of t, x, y, p are like those of ``events.txt``; whole numbers with a point may be microseconds."""
    matches = [_IJRR_LINE.fullmatch(line) for line in lines]
    return bool(matches) and matches[0] is not None and any(m and float(m[1]) % 1 for m in matches)


def _nameless(beginning: _Beginning) -> _Header | None:
    """Lines without names that can be told all the same; where they begin is not said."""
    line = beginning.others[0] if beginning.others else ""
    if _IJRR_LINE.fullmatch(line):
        return _Header(0, 0, " ", _TXYP, "s", (_IJRR_ASSUMED,), None)
    if _LABELLED.fullmatch(line) and any(_LABELS in comment for _, comment in beginning.comments):
        return _Header(0, 0, " ", (*_TXYP, 0), "s", (_IJRR_ASSUMED, _LABELS_SKIPPED), None)
    stated = any(_GEOMETRY.fullmatch(comment) for _, comment in beginning.comments)
    if _PROPHESEE_LINE.fullmatch(line) and (stated or _are_prophesee_lines(beginning.others)):
        assumed = () if stated else (_PROPHESEE_ASSUMED,)
        return _Header(0, 0, ",", _XYPT, "us", assumed, None)
    return None


def _are_prophesee_lines(lines: list[str]) -> bool:
    """Whether the third number is 0 or 1 in all lines, and the fourth a time in order, which goes beyond 1."""
    matches = [_PROPHESEE_LINE.fullmatch(line) for line in lines]
    times = [int(match[1]) for match in matches if match is not None]
    return len(times) == len(lines) and times == sorted(times) and times[-1] > 1


def _place(data: bytes, lines: int) -> int:
    """Where the line begins before which there are so many."""
    begin = 0
    for _ in range(lines):
        begin = data.index(b"\n", begin) + 1 if b"\n" in data[begin:] else len(data)
    return begin


def _first_of_each(roles: tuple[int, ...]) -> tuple[int, ...]:
    """The roles of columns, 0 where an earlier column has the same role."""
    return tuple(0 if role in roles[:i] else role for i, role in enumerate(roles))


# The lines with numbers


def _events(path: Path, header: _Header) -> Iterator[EventArray]:
    roles, separator = np.array(header.roles, np.uint8), np.uint8(ord(header.separator))
    whole_times, decimals = header.unit is None, _DECIMALS[header.unit]

    def parse(text: NDArray[np.uint8], is_first: bool, *fields: NDArray[Any]) -> Any:
        return _parse(text, separator, roles, whole_times, decimals, *fields)

    def bad_line(number: int, fault: int, shown: str) -> FormatError:
        return FormatError(f"{path}: line {number}: {_FAULTS[fault]}: {shown!r}")

    with reading(path), path.open("rb") as file:
        file.seek(header.begin)
        yield from parsed_events(file, parse, bad_line, lines_before=header.lines)


_T, _X, _Y, _P, _FEW, _MANY, _UNITLESS = range(1, 8)
_FAULTS: Final = {
    _T: "the time is not a number from 0 to 10^18 us (of ns, name the column t_ns)",
    _X: "x is not a pixel coordinate",
    _Y: "y is not a pixel coordinate",
    _P: "the polarity is none of 0, 1, -1, true and false",
    _FEW: "it has fewer columns than the first line",
    _MANY: "it has more columns than the first line",
    TOO_LONG: "it is too long",
    _UNITLESS: f"the time has decimals, but no unit; {RENAME}",
}
_BAD: Final = np.int64(-2)
_MOST_DIGITS: Final = 18  # that surely fit into 64 bits
_HASH, _MINUS, _PLUS = (np.uint8(ord(c)) for c in "#-+")
_LOWER: Final = np.uint8(0x20)
_E, _LETTER_T, _LETTER_F = (np.uint8(ord(c)) for c in "etf")
_TEN: Final = np.int64(10)


@njit(cache=True, nogil=True)
def _parse(
    text: NDArray[np.uint8],
    separator: np.uint8,
    roles: NDArray[np.uint8],
    whole_times: bool,
    decimals: int,
    t: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.bool_],
) -> tuple[int, int, int, np.uint64]:
    """Parse whole lines. Returns events, whole lines read, fault (0: none), start of the faulty line."""
    end = np.uint64(len(text))
    i = np.uint64(0)
    count = lines = 0
    blank = separator == SPACE
    while i < end:
        start = i
        i = skip_blanks(text, i)
        if text[i] == NEWLINE or text[i] == _HASH:
            while text[i] != NEWLINE:
                i += ONE
            i += ONE
            lines += 1
            continue
        column = np.uint64(0)
        while True:
            if column == np.uint64(len(roles)):
                return count, lines, _MANY, start
            role = roles[column]
            if role == 0:
                while text[i] != NEWLINE and text[i] != separator and not (blank and text[i] == TAB):
                    i += ONE
            elif role == 1:
                t[count], fraction, i = _parse_value(text, i, decimals)
                if whole_times and fraction:
                    return count, lines, _UNITLESS, start
                if t[count] < 0:
                    return count, lines, _T, start
            else:
                value, fraction, i = _parse_value(text, i, 0)
                if fraction or value < (-1 if role == 4 else 0) or value > (1 if role == 4 else 65535):
                    return count, lines, int(role), start
                if role == 2:
                    x[count] = value
                elif role == 3:
                    y[count] = value
                else:
                    p[count] = value == 1
            column += ONE
            before = i
            i = skip_blanks(text, i)
            if text[i] == NEWLINE:
                break
            if text[i] == separator:  # blanks have been skipped: a comma or semicolon
                i = skip_blanks(text, i + ONE)
            elif i == before or not (blank or separator == TAB):
                return count, lines, int(max(role, 1)), start
        if column < np.uint64(len(roles)):
            return count, lines, _FEW, start
        count += 1
        i += ONE
        lines += 1
    return count, lines, 0, end


@njit(cache=True, nogil=True, inline="always")
def _parse_value(text: NDArray[np.uint8], i: np.uint64, decimals: int) -> tuple[np.int64, bool, np.uint64]:
    """A number times 10^decimals, rounded half up; whether it had a fraction; where it ends.

    ``_BAD`` for what is no number, for numbers below -1, and for those that do not fit. True and false are 1 and 0.
    This is the way of plain decimals; all others take the slow one.
    """
    begin = i
    value = np.int64(0)
    while True:
        digit = np.uint8(text[i] - ZERO)
        if digit > NINE:
            break
        value = value * _TEN + np.int64(digit)
        i += ONE
    places = np.int64(decimals)
    fraction = False
    if text[i] == DOT:
        i += ONE
        while places > 0:
            digit = np.uint8(text[i] - ZERO)
            if digit > NINE:
                break
            value = value * _TEN + np.int64(digit)
            fraction = fraction or bool(digit > 0)
            places -= 1
            i += ONE
        next_digit = np.uint8(text[i] - ZERO)
        round_up = FIVE <= next_digit <= NINE
        while True:
            digit = np.uint8(text[i] - ZERO)
            if digit > NINE:
                break
            fraction = fraction or bool(digit > 0)
            i += ONE
        value += np.int64(round_up)
    while places > 0:
        value *= _TEN
        places -= 1
    plain = text[i] <= SPACE or text[i] == np.uint8(44) or text[i] == np.uint8(59)  # , ;
    no_digits = i == begin or (text[begin] == DOT and i == begin + ONE)
    if not plain or no_digits or i - begin > np.uint64(12) or decimals < 0:
        return _parse_slowly(text, begin, decimals)
    return value, fraction, i


@njit(cache=True, nogil=True)
def _parse_slowly(text: NDArray[np.uint8], i: np.uint64, decimals: int) -> tuple[np.int64, bool, np.uint64]:
    """As `_parse_value`, for signs, exponents, many digits, true and false."""
    letter = text[i] | _LOWER
    if letter in (_LETTER_T, _LETTER_F):
        return _parse_truth(text, i)
    negative = text[i] == _MINUS
    if negative or text[i] == _PLUS:
        i += ONE
    value = np.int64(0)
    digits = scale = 0  # value * 10^scale is the number
    seen = point = False
    while True:
        digit = np.uint8(text[i] - ZERO)
        if digit <= NINE:
            seen = True
            if digits < _MOST_DIGITS:
                value = value * _TEN + np.int64(digit)
                digits += int(value > 0)
                scale -= point
            else:
                scale += not point
        elif text[i] == DOT and not point:
            point = True
        else:
            break
        i += ONE
    if not seen:
        return _BAD, False, i
    if (text[i] | _LOWER) == _E:
        exponent, i = _parse_exponent(text, i + ONE)
        scale += exponent
    fraction = _has_fraction(value, scale)
    value = _scaled(value, digits, scale + decimals)
    if negative:
        value = -value if 0 <= value <= 1 else _BAD
    return value, fraction, i


@njit(cache=True, nogil=True)
def _parse_truth(text: NDArray[np.uint8], i: np.uint64) -> tuple[np.int64, bool, np.uint64]:
    """``true`` or ``false``, in small or capital letters."""
    word = b"true" if (text[i] | _LOWER) == _LETTER_T else b"false"
    for letter in word:
        if (text[i] | _LOWER) != letter:
            return _BAD, False, i
        i += ONE
    return np.int64(len(word) == 4), False, i


@njit(cache=True, nogil=True)
def _parse_exponent(text: NDArray[np.uint8], i: np.uint64) -> tuple[int, np.uint64]:
    """What follows the e. Without digits it stops before what is there, which then ends no number."""
    down = text[i] == _MINUS
    begin = i
    if down or text[i] == _PLUS:
        i += ONE
    exponent = 0
    first = i
    while np.uint8(text[i] - ZERO) <= NINE:
        exponent = min(exponent * 10 + int(text[i] - ZERO), 10_000)
        i += ONE
    if i == first:
        return 0, begin - ONE
    return -exponent if down else exponent, i


@njit(cache=True, nogil=True)
def _has_fraction(value: np.int64, scale: int) -> bool:
    """Whether value * 10^scale is not whole."""
    while scale < 0 and value > 0:
        if value % _TEN != 0:
            return True
        value //= _TEN
        scale += 1
    return False


@njit(cache=True, nogil=True)
def _scaled(value: np.int64, digits: int, scale: int) -> np.int64:
    """value * 10^scale, rounded half up; ``_BAD`` if it has more than 18 digits."""
    while scale > 0 and value > 0:
        if digits >= _MOST_DIGITS:
            return _BAD
        value *= _TEN
        digits += 1
        scale -= 1
    last = np.int64(0)
    while scale < 0 and (value > 0 or last > 0):
        last = value % _TEN
        value //= _TEN
        scale += 1
    return value + np.int64(last >= 5)
