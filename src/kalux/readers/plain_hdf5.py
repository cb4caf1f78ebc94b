"""Events in HDF5 files of no layout of their own: columns, or one table, with the names that peers give them.

Such as ``x``, ``y``, ``p``, ``t`` at the root (e2calib, EDS), ``prophesee/left/{x,y,t,p}`` (M3ED), or a dataset of
records.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import parse_qsl

import numpy as np

from kalux.errors import FormatError, InputError
from kalux.events import EventArray
from kalux.readers import hdf5_layout
from kalux.readers.columns import UNIT_ASSUMED, Columns, find_columns, join
from kalux.readers.source import NO_FRAMES, SIZE_UNKNOWN, Source, begins_with, smallest_size

_DEEPEST: Final = 3  # groups above a column
_MOST: Final = 1000  # groups and datasets that are looked at
_SHOWN: Final = 6
_LARGEST_ITEM: Final = 256  # bytes per event; more is damage, and would need much memory
_LATEST: Final = 1 << 60  # us
_NAME: Final = 40  # letters of a name, in a sentence
_LEFT: Final = "left"
_SIZES: Final = ("resolution", "sensor_resolution", "sensor_size")
_RESOLUTION: Final = "calib/resolution"  # of M3ED, beside the columns


class _Place(NamedTuple):
    """Where events are.

    ``name`` is that of the group of the columns, or of the table; ``datasets`` are those of t, x, y, p, or the table.
    """

    name: str
    datasets: tuple[str, ...]
    columns: Columns

    @property
    def group(self) -> str:
        return self.datasets[0].rpartition("/")[0] or "/"


def recognises(path: Path) -> bool:
    """Whether it is an HDF5 file that holds columns, or a table, named like events."""
    if not begins_with(path, hdf5_layout.SIGNATURE):
        return False
    try:
        with hdf5_layout.library().File(path, "r") as file:
            return bool(_places(_datasets(file)))
    except (OSError, *hdf5_layout.DAMAGE):
        return False


def read(path: Path, choice: str = "") -> Source:
    """Open events in an HDF5 file of no other layout.

    Integer times are microseconds unless the name of their column ends in a unit (``t_ns``); for floating-point times
    it must. An integer ``t_offset`` beside them, or at the root, is added, as in DSEC's layout.

    Parameters
    ----------
    path
        The file.
    choice
        The group or table of the events where there are several: ``events=prophesee/right``.

    Raises
    ------
    FormatError
        If the columns cannot be events, or the file is damaged.
    InputError
        If it cannot be read, or it is not clear which events are meant.
    """
    with hdf5_layout.opened(path) as file:
        datasets = _datasets(file)
        places = _places(datasets)
        if not places:
            raise FormatError(f"{path}: has no events; copy or download it again")
        place = _chosen(path, places, choice)
        count = _length(path, file, place)
        offset = _offset(path, file, place)
        size = _stated_size(path, file, place)
        missing: tuple[str, ...] = (_about_frames(datasets),)
    if place.columns.unit is None:
        missing += (UNIT_ASSUMED,)
    if size is None:
        missing += (SIZE_UNKNOWN,)
    if len(places) > 1:
        others = ", ".join(_shown(other.name) for other in places[:_SHOWN] if other != place)
        missing += (
            f"The events of {_shown(place.name)} are read; others are {others} ('{path.name}?events=NAME').",
        )
    return Source(
        path=path,
        format="hdf5",
        sensor_size=size or smallest_size(path, _events(path, place, offset)),
        events=lambda: _events(path, place, offset),
        count_events=lambda: count,
        missing=missing,
        sensor_size_known=size is not None,
    )


def held(path: Path) -> str:
    """What an HDF5 file holds, to be shown; nothing if it is none or cannot be read."""
    if not begins_with(path, hdf5_layout.SIGNATURE):
        return ""
    try:
        with hdf5_layout.library().File(path, "r") as file:
            return _listed(_datasets(file))
    except (OSError, *hdf5_layout.DAMAGE):
        return ""


# Where events are


def _datasets(file: Any) -> dict[str, Any]:
    """The first datasets of a file by their names, in whichever order it lists them."""
    return {name: item for name, item in islice(_walk(file, "", 0), _MOST) if hasattr(item, "dtype")}


def _walk(group: Any, above: str, depth: int) -> Iterator[tuple[str, Any]]:
    for name in islice(group, _MOST):
        item = group.get(name)  # None: a link that leads nowhere
        yield above + name, item
        if depth < _DEEPEST and isinstance(item, hdf5_layout.library().Group):
            yield from _walk(item, f"{above}{name}/", depth + 1)


def _places(datasets: dict[str, Any]) -> list[_Place]:
    """Groups with a column for each field of an event, and tables with such fields."""
    columns: dict[str, list[str]] = {}
    places = []
    for name, dataset in datasets.items():
        if dataset.shape is None or dataset.ndim != 1:
            continue
        if dataset.dtype.names is None:
            above, _, last = name.rpartition("/")
            columns.setdefault(above, []).append(last)
        elif (found := find_columns(dataset.dtype.names)) is not None:
            places.append(_Place(name, (name,), found))
    for group, names in columns.items():
        found = find_columns(names)
        if found is not None:
            joined = tuple(f"{group}/{getattr(found, field)}".lstrip("/") for field in "txyp")
            places.append(_Place(group or "/", joined, found))
    return places


def _chosen(path: Path, places: list[_Place], choice: str) -> _Place:
    """The one that is asked for; else the only one, or the only one of a left camera."""
    wanted = dict(parse_qsl(choice, keep_blank_values=True))
    names = ", ".join(_shown(place.name) for place in places[:_SHOWN])
    if choice:
        if wanted.keys() != {"events"}:
            raise InputError(f"{path}: after '?' goes events=NAME, where NAME is of {names}")
        found = [place for place in places if place.name.strip("/") == wanted["events"].strip("/")]
        if not found:
            raise InputError(f"{path}: has no events in {wanted['events'][:_NAME]!r}; they are in {names}")
        return found[0]
    found = [place for place in places if _LEFT in place.name.split("/")] if len(places) > 1 else places
    if len(found) != 1:
        raise InputError(f"{path}: has events in {names}; choose with '{path.name}?events=NAME'")
    return found[0]


def _length(path: Path, file: Any, place: _Place) -> int:
    for name in place.datasets:
        dtype = file[name].dtype
        if dtype.hasobject or dtype.itemsize > _LARGEST_ITEM:
            raise FormatError(f"{path}: {_shown(name)} holds objects or huge items; save plain numbers")
    return hdf5_layout.common_length(path, file, place.datasets)


def _offset(path: Path, file: Any, place: _Place) -> int:
    """What is to be added to times in whole microseconds."""
    found = [group["t_offset"] for group in (file[place.group], file) if "t_offset" in group]
    offsets = [item for item in found if item.size == 1 and item.dtype.kind in "iu"]
    if not offsets or place.columns.unit not in (None, "us"):
        return 0
    offset = int(np.ravel(offsets[0][()])[0])
    if not abs(offset) < _LATEST:
        raise FormatError(f"{path}: its t_offset is {offset}, which can be no time in us; write it again")
    return offset


def _stated_size(path: Path, file: Any, place: _Place) -> tuple[int, int] | None:
    """The size in attributes, of the columns' group or the table before those of the root, or beside the columns."""
    group = file[place.group]
    holders = (file[place.name], group, file)
    size = hdf5_layout.stated_size(path, *holders)
    if size is not None:
        return size
    pairs = [holder.attrs[name] for holder in holders for name in _SIZES if name in holder.attrs]
    if _RESOLUTION in group and group[_RESOLUTION].size == 2:
        pairs.append(group[_RESOLUTION][...])
    sides = [np.ravel(pair) for pair in pairs]
    found = next((pair for pair in sides if len(pair) == 2 and pair.dtype.kind in "iuf"), None)
    # Some state the height first, others the width, and sensors are no higher than wide.
    return None if found is None else hdf5_layout.checked_sides(path, min(found), max(found))


def _about_frames(datasets: dict[str, Any]) -> str:
    """That no frames are read, and which datasets look as if they were."""
    images = {name: item for name, item in datasets.items() if item.shape is not None and item.ndim in (3, 4)}
    if not images:
        return NO_FRAMES
    return (
        f"The arrays of frames ({_listed(images)}) are not read, as nothing states their exposures; make the recording "
        "with kalux.Recording.from_arrays, or save images and join them with --frames."
    )


def _listed(datasets: dict[str, Any]) -> str:
    shown = (f"{_shown(name)} {item.shape}" for name, item in islice(datasets.items(), _SHOWN))
    return ", ".join(shown) + (", ..." if len(datasets) > _SHOWN else "")


def _shown(name: str) -> str:
    """The end of a name, as it can be printed."""
    return "".join(letter if letter.isprintable() else "?" for letter in name[-_NAME:])


# What they are


def _events(path: Path, place: _Place, offset: int) -> Iterator[EventArray]:
    with hdf5_layout.opened(path) as file:
        length = hdf5_layout.common_length(path, file, place.datasets)
        stored = [file[name] for name in place.datasets]
        names = place.columns[:4]
        for part in hdf5_layout.slices(stored[0], length):
            values = [dataset[part] for dataset in stored]
            columns = values if len(values) == len(names) else [values[0][name] for name in names]
            events = join(path, dict(zip(names, columns, strict=True)), place.columns)
            events["t"] += offset
            yield events
