"""Events in named columns: which name means what, in which unit, and how a chunk of them becomes events."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from numpy.typing import NDArray

from kalux.errors import EventError, FormatError
from kalux.events import FIELD_NAMES, EventArray, as_events

UNIT_ASSUMED: Final = "The unit of time is not stated; its integers are taken as microseconds."
"""For `Source.missing`, where `Columns.unit` is None."""

# timestamp_us, t[us], "time (us)", t.us; jAER and others write "usec"
_UNIT: Final = re.compile(r"(?P<name>[a-z_]+?)[\s._\-]*[\[(]?(?P<unit>s|sec|ms|msec|us|usec|ns|nsec)[\])]?")
_SHORT_UNIT: Final = {"sec": "s", "msec": "ms", "usec": "us", "nsec": "ns"}


class Columns(NamedTuple):
    """Where the four fields of an event are.

    Attributes
    ----------
    t, x, y, p
        The names as they stand in the file.
    unit
        Of the time: ``"s"``, ``"ms"``, ``"us"``, ``"ns"``; None if its name does not say.
    """

    t: str
    x: str
    y: str
    p: str
    unit: str | None


def find_columns(names: Sequence[str]) -> Columns | None:
    """Which of the names are the four fields of an event; None if one of them is missing."""
    found = {field: find_name(names, aliases) for field, aliases in FIELD_NAMES.items() if field != "t"}
    time = find_time(names, FIELD_NAMES["t"])
    if time is None or None in found.values():
        return None
    return Columns(t=time[0], **{field: str(name) for field, name in found.items()}, unit=time[1])


def find_name(names: Sequence[str], aliases: Sequence[str]) -> str | None:
    """The first of the names that is an alias, in capital or small letters; None if none is."""
    return next((name for name in names if name.strip().lower() in aliases), None)


def find_time(names: Sequence[str], aliases: Sequence[str]) -> tuple[str, str | None] | None:
    """As `find_name`, with the unit that the name ends in; None for the unit if it has none."""
    plain = find_name(names, aliases)
    if plain is not None:
        return plain, None
    for name in names:
        match = _UNIT.fullmatch(name.strip().lower())
        if match is not None and match["name"] in aliases:
            return name, _SHORT_UNIT.get(match["unit"], match["unit"])
    return None


def join(path: Path, data: Mapping[str, NDArray[Any]], columns: Columns) -> EventArray:
    """A chunk of events from its columns.

    Raises
    ------
    FormatError
        If the values cannot be events; it names the file.
    """
    try:
        fields = {field: data[getattr(columns, field)] for field in "txyp"}
        return as_events(fields, time_unit=columns.unit)
    except EventError as error:
        message = str(error).removeprefix("events: ")
        hint = "; " + RENAME if "unit cannot be known" in message else ""
        raise FormatError(f"{path}: {message.split('; give time_unit')[0]}{hint}") from error


RENAME: Final = "name the unit in the column, as t_s, t_ms, t_us or t_ns"
"""What to do about times with decimals and without a unit."""
