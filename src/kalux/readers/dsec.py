"""DSEC: events in ``events.h5``, images and their exposures beside it.

``events/{t,x,y,p}`` with t in microseconds after ``t_offset``; ``ms_to_idx`` is not needed. In a sequence's folder::

    events/left/events.h5
    images/left/rectified/*.png
    images/left/exposure_timestamps.txt      a line "start, end" per image, us
    images/timestamps.txt                    mean of the exposures' middles, left and right, us

Written from https://dsec.ifi.uzh.ch/data-format/ and the layout in https://github.com/uzh-rpg/DSEC. The published
images are of another camera and size; they are refused with what to do. Images of the sensor's size are read.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EventArray
from kalux.frames import Frame
from kalux.readers import hdf5_layout
from kalux.readers.images import files_in_colour, images_in, load_image
from kalux.readers.source import SIZE_NOT_STATED, Source, reading

_COLUMNS: Final = ("events/t", "events/x", "events/y", "events/p")
_PUBLISHED_SIZE: Final = (480, 640)
_SIZE_ASSUMED: Final = (
    SIZE_NOT_STATED + "that of the published sequences, or the smallest that holds all events, is taken."
)
_EVENTS: Final = ("events/left/events.h5", "events_left/events.h5", "events.h5")
_IMAGES: Final = ("images/left/rectified", "images_rectified_left", "images/left")
_EXPOSURES: Final = ("images/left/exposure_timestamps.txt", "images/exposure_timestamps_left.txt")
_EXPOSURES_PATTERN: Final = "*image_exposure_timestamps_left.txt"
_STAMPS: Final = ("images/timestamps.txt",)
_STAMPS_PATTERN: Final = "*image_timestamps.txt"
_HINT: Final = (
    "give its events.h5 as the recording and join images of the events' pixels to it (--frames FOLDER)"
)


class _Images(NamedTuple):
    """Image files with start and end of their exposures, us (both the stamp where only that is known)."""

    files: tuple[Path, ...] = ()
    times: tuple[tuple[int, int], ...] = ()
    exposure_known: bool = True
    missing: tuple[str, ...] = ("There are no images.",)
    colour: bool = False


def recognises(path: Path) -> bool:
    """Whether it is a folder with ``events/left/events.h5``, or an HDF5 file with DSEC's events."""
    if path.is_dir():
        return _first(path, _EVENTS) is not None
    return hdf5_layout.holds(path, _COLUMNS)


def read(path: Path) -> Source:
    """Open a DSEC sequence (the left camera), or its ``events.h5`` alone.

    The sensor has the size of ``rectify_map.h5`` beside the events, or that of the attributes ``height`` and ``width``
    of the file or its ``events``, as jAER writes them; without them 640x480, as published, or the smallest that holds
    all events if that is larger.

    Raises
    ------
    FormatError
        If a file is damaged, times and images differ in number, or images have another size than the sensor.
    InputError
        If a file cannot be read.
    """
    events_path = path if path.is_file() else _first(path, _EVENTS)
    if events_path is None:
        raise FormatError(f"{path}: has no {_EVENTS[0]}; give the folder of a sequence")
    with hdf5_layout.opened(events_path) as file:
        count = hdf5_layout.common_length(events_path, file, _COLUMNS)
        offset = int(file["t_offset"][()]) if "t_offset" in file else 0
    images = _Images() if path.is_file() else _find_images(path)
    stated_size = _stated_size(events_path)
    size = stated_size or _assumed_size(events_path, offset)
    missing = images.missing + (() if stated_size else (_SIZE_ASSUMED,))
    if images.files:
        _check_first(path, images, size)
    if (path / "events/right").is_dir():
        missing += ("The left camera is read; open events/right/events.h5 for the events of the right one.",)
    return Source(
        path=path,
        format="dsec",
        sensor_size=size,
        events=lambda: _events(events_path, offset),
        frames=lambda: _frames(path, images),
        count_events=lambda: count,
        count_frames=lambda: len(images.files),
        exposure_known=images.exposure_known,
        missing=missing,
        sensor_size_known=stated_size is not None,
    )


def _first(folder: Path, names: tuple[str, ...], pattern: str | None = None) -> Path | None:
    found = [folder / name for name in names if (folder / name).exists()]
    if not found and pattern is not None:
        found = sorted(folder.glob(pattern))
    return found[0] if found else None


def _events(path: Path, offset: int) -> Iterator[EventArray]:
    def convert(t: NDArray[Any], p: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        if t.dtype.kind not in "iu":
            raise FormatError(f"{path}: its times are {t.dtype}; this layout has integer microseconds")
        return t.astype(np.int64) + offset, p

    return hdf5_layout.column_events(path, _COLUMNS, convert)


def _stated_size(events_path: Path) -> tuple[int, int] | None:
    rectify = events_path.with_name("rectify_map.h5")
    if not rectify.is_file():
        with hdf5_layout.opened(events_path) as file:
            return hdf5_layout.stated_size(events_path, file, file["events"])
    with hdf5_layout.opened(rectify) as file:
        return hdf5_layout.size_of(rectify, file["rectify_map"].shape[:2])


def _assumed_size(events_path: Path, offset: int) -> tuple[int, int]:
    height, width = _PUBLISHED_SIZE
    for chunk in _events(events_path, offset):
        height = max(height, int(chunk["y"].max(initial=0)) + 1)
        width = max(width, int(chunk["x"].max(initial=0)) + 1)
    return height, width


# Images


def _find_images(folder: Path) -> _Images:
    with reading(folder):
        place = _first(folder, _IMAGES)
        files = () if place is None else tuple(images_in(place))
        if not files:
            return _Images()
        exposures = _first(folder, _EXPOSURES, _EXPOSURES_PATTERN)
        stamps = _first(folder, _STAMPS, _STAMPS_PATTERN)
    if exposures is not None:
        times = tuple((start, end) for start, end in _read_times(exposures, 2))
        missing: tuple[str, ...] = ()
    elif stamps is not None:
        times = tuple((stamp, stamp) for (stamp,) in _read_times(stamps, 1))
        missing = ("The exposure times of the frames are not recorded; their stamps mark the middle.",)
    else:
        raise FormatError(
            f"{folder}: has images, but neither {_EXPOSURES[0]} nor {_STAMPS[0]}; download them, too"
        )
    if len(times) != len(files):
        raise FormatError(
            f"{folder}: has {len(files)} images, but {len(times)} lines in {(exposures or stamps)!s}; "
            "copy or download it again"
        )
    colour = files_in_colour(folder, files)
    return _Images(files, times, exposures is not None, missing, colour)


def _read_times(path: Path, columns: int) -> Iterator[tuple[int, ...]]:
    with reading(path, UnicodeError):
        lines = path.read_text("utf-8").splitlines()
    for number, line in enumerate(lines, 1):
        fields = [field for field in re.split(r"[,;\s]+", line.strip()) if field]
        if not fields or line.lstrip().startswith("#"):
            continue
        if len(fields) != columns or not all(re.fullmatch(r"\d{1,18}", field) for field in fields):
            wanted = "'start, end'" if columns == 2 else "a time"
            raise FormatError(f"{path}: line {number}: {line[:60]!r} is not {wanted} in whole microseconds")
        yield tuple(int(field) for field in fields)


def _check_first(path: Path, images: _Images, size: tuple[int, int]) -> None:
    shape = load_image(path, images.files[0], colour=images.colour).shape[:2]
    if shape != size:
        raise FormatError(
            f"{path}: its images have {shape[1]}x{shape[0]} pixels, its events {size[1]}x{size[0]}; {_HINT}"
        )


def _frames(path: Path, images: _Images) -> Iterator[Frame]:
    for file, (start, end) in zip(images.files, images.times, strict=True):
        yield Frame(load_image(path, file, colour=images.colour), start, end)
