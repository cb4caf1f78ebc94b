"""Metavision's HDF5 event files: ``CD/events``, a table of x, y, p and t (us), compressed with Prophesee's ECF.

The size of the sensor is the attribute ``geometry`` ("1280x720"). Written from
https://docs.prophesee.ai/stable/data/file_formats/hdf5.html. The filter for ECF comes with the Metavision SDK or with
https://github.com/prophesee-ai/hdf5_ecf; no Python package brings it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from kalux.errors import FormatError
from kalux.events import EventArray
from kalux.readers import hdf5_layout
from kalux.readers.source import SIZE_UNKNOWN, Source, smallest_size
from kalux.wording import how_many

_EVENTS: Final = "CD/events"
_TRIGGERS: Final = "EXT_TRIGGER/events"
_GEOMETRY: Final = re.compile(r"\s*([1-9]\d{0,4})\s*x\s*([1-9]\d{0,4})\s*")


def recognises(path: Path) -> bool:
    """Whether it is an HDF5 file with events in this layout."""
    return hdf5_layout.holds(path, (_EVENTS,))


def read(path: Path) -> Source:
    """Open a Metavision HDF5 event file.

    Raises
    ------
    FormatError
        If it is damaged, or the ECF filter is not installed.
    InputError
        If it cannot be read.
    """
    with hdf5_layout.opened(path) as file:
        events = file[_EVENTS]
        if events.ndim != 1 or not {"x", "y", "p", "t"} <= {*(events.dtype.names or ())}:
            raise FormatError(f"{path}: {_EVENTS} is no table of x, y, p and t; copy or download it again")
        hdf5_layout.check_dataset(path, events)
        count = int(events.shape[0])
        size = _geometry(path, file.attrs.get("geometry"))
        triggers = file[_TRIGGERS].shape[0] if _TRIGGERS in file else 0
    missing: tuple[str, ...] = ("The format has no frames.",)
    if triggers:
        missing += (f"Not read: {how_many(triggers, 'external trigger event')}.",)
    if size is None:
        missing += (SIZE_UNKNOWN,)
    return Source(
        path=path,
        format="metavision hdf5",
        sensor_size=size or smallest_size(path, _read_events(path)),
        events=lambda: _read_events(path),
        count_events=lambda: count,
        missing=missing,
        sensor_size_known=size is not None,
    )


def _geometry(path: Path, value: Any) -> tuple[int, int] | None:
    if value is None:
        return None
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else str(value)
    match = _GEOMETRY.fullmatch(text)
    if match is None:
        raise FormatError(
            f"{path}: its geometry is {text[:40]!r}, not WIDTHxHEIGHT; copy or download it again"
        )
    return int(match[2]), int(match[1])


def _read_events(path: Path) -> Iterator[EventArray]:
    with hdf5_layout.opened(path) as file:
        table = file[_EVENTS]
        for part in hdf5_layout.slices(table, table.shape[0]):
            rows = table[part]
            yield hdf5_layout.checked_events(path, rows["t"], rows["x"], rows["y"], rows["p"])
