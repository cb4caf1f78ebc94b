"""Folders of event files and images: HS-ERGB and BS-ERGB, of Time Lens and Time Lens++, and what vid2e makes.

For each interval between images there is an ``.npz`` with x, y, t or timestamp, p or polarity::

    events_aligned/000001.npz    images_corrected/000000.png    images_corrected/timestamp.txt    HS-ERGB
    events/000000.npz            images/000000.png              images/timestamp.txt              BS-ERGB
    events/0000000000.npz        imgs/00000000.png              timestamps.txt                    vid2e

Written from https://github.com/uzh-rpg/rpg_timelens and https://github.com/uzh-rpg/rpg_vid2e (esim_torch, upsampling),
and, of BS-ERGB, which its authors do not describe, from two programs that read it: the tools of
https://github.com/ercanburak/EVREAL and https://github.com/ZiyunClaudeWang/event-continuitycam.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EventArray, check_events
from kalux.readers import numpy_files
from kalux.readers.columns import join
from kalux.readers.image_lists import Listed, read_listed, read_stamps
from kalux.readers.images import files_in_colour, images_in, load_image
from kalux.readers.source import EXPOSURE_UNKNOWN, Source, counted, natural_order, reading
from kalux.readers.streams import rechunk

_PARTS_OF_A_PIXEL: Final = 32  # of BS-ERGB, in 16 bits
_TELLING: Final = 10_000  # events whose coordinates tell what their unit is
_LARGEST_LIST: Final = 1 << 27  # bytes; it is read as a whole
_SUFFIX: Final = ".npz"


class _Layout(NamedTuple):
    """Where things are in a folder, and the units of time of the list and of the events."""

    events: str
    images: str
    stamps: str
    stamp_unit: str
    event_unit: str


_LAYOUTS: Final = (
    _Layout("events_aligned", "images_corrected", "images_corrected/timestamp.txt", "us", "us"),
    _Layout("events", "images", "images/timestamp.txt", "us", "us"),
    _Layout("events", "imgs", "timestamps.txt", "s", "ns"),
)


class _Coordinates(NamedTuple):
    """What the coordinates of events are: parts of a pixel, and whether they were mapped onto the images."""

    parts: int
    mapped: bool


def recognises(path: Path) -> bool:
    """Whether it is a folder with numbered event files in a folder of one of the layouts, or such a folder itself."""
    return path.is_dir() and any(
        any(_event_files(place)) for place in (path, *(path / layout.events for layout in _LAYOUTS))
    )


def read(path: Path) -> Source:
    """Open a sequence.

    Raises
    ------
    FormatError
        If images or their times are not where a layout has them, or a file is damaged.
    InputError
        If a file cannot be read.
    """
    with reading(path):
        layout = _find_layout(path)
        files = sorted(_event_files(path / layout.events), key=natural_order)
    listed, missing = _find_images(path, layout)
    colour = files_in_colour(path, [image.file for image in listed])
    height, width = load_image(path, listed[0].file, colour=colour).shape[:2]
    size = (height, width)
    coordinates = _find_coordinates(files, size)
    if coordinates.mapped:
        unit = "" if coordinates.parts == 1 else f", given in 1/{coordinates.parts} of a pixel,"
        missing += (
            f"The events were mapped onto the images: coordinates{unit} are rounded to the nearest pixel, "
            "and events beyond the images are left out.",
        )

    def events() -> Iterator[EventArray]:
        return rechunk(_events(files, layout, size, coordinates))

    return Source(
        path=path,
        format="npz-folder",
        sensor_size=size,
        events=events,
        count_events=counted(events),
        frames=lambda: read_listed(path, listed, colour=colour),
        count_frames=lambda: len(listed),
        exposure_known=False,
        missing=(EXPOSURE_UNKNOWN, *missing),
    )


def _event_files(folder: Path) -> Iterator[Path]:
    """Event files, whose names are numbers; not in order."""
    if folder.is_dir():
        yield from (f for f in folder.iterdir() if f.suffix == _SUFFIX and f.stem.isdecimal())


def _find_layout(path: Path) -> _Layout:
    layouts = [layout for layout in _LAYOUTS if any(_event_files(path / layout.events))]
    if not layouts:
        raise FormatError(
            f"{path}: holds event files alone; give the folder that has them in 'events' and their images in "
            "'images' (docs/formats.md)"
        )
    found = next((layout for layout in layouts if (path / layout.images).is_dir()), None)
    if found is None:
        wanted = " or ".join(f"{layout.images!r}" for layout in layouts)
        raise FormatError(
            f"{path}: has event files in {layouts[0].events!r}, but no folder {wanted} with their images"
        )
    return found


def _find_images(path: Path, layout: _Layout) -> tuple[list[Listed], tuple[str, ...]]:
    """The images that have a time, and what to say of the others."""
    files = images_in(path / layout.images)
    list_file = path / layout.stamps
    if not list_file.is_file():
        raise FormatError(f"{path}: has images, but no {layout.stamps} with their times")
    with reading(list_file, UnicodeError):
        if list_file.stat().st_size > _LARGEST_LIST:
            raise FormatError(f"{list_file}: is too large for a list of times")
        stamps = read_stamps(list_file, list_file.read_text("utf-8-sig"), layout.stamp_unit)
    if not stamps or len(stamps) > len(files):
        raise FormatError(
            f"{list_file}: lists {len(stamps)} times, but there are {len(files)} images in {layout.images!r}; "
            "a time for each image is needed"
        )
    listed = [Listed(file, stamp, stamp) for file, stamp in zip(files, stamps, strict=False)]
    if len(files) == len(stamps):
        return listed, ()
    return listed, (
        f"The last {len(files) - len(stamps)} of {len(files)} images have no time, and are not read.",
    )


def _find_coordinates(files: list[Path], size: tuple[int, int]) -> _Coordinates:
    """The unit of the coordinates: pixels, unless most of the first events would lie beyond the images.

    Of HS-ERGB they are floats in pixels (its description says otherwise, its programs do not), of BS-ERGB integers in
    1/32 of a pixel; others store such folders with integers in pixels.
    """
    height, width = size
    seen = beyond = 0
    fractions = False
    for file in files:
        layout = numpy_files.find_events(file)
        for data in numpy_files.read_columns(file, layout):
            x, y = (_numbers(file, name, data[name]) for name in (layout.columns.x, layout.columns.y))
            seen += len(x)
            beyond += int(np.count_nonzero((x >= width) | (y >= height)))
            fractions |= len(x) > 0 and "f" in (x.dtype.kind, y.dtype.kind)
        if seen >= _TELLING:
            break
    parts = _PARTS_OF_A_PIXEL if 2 * beyond > seen else 1
    return _Coordinates(parts, fractions or parts > 1)


def _events(
    files: list[Path], layout: _Layout, size: tuple[int, int], coordinates: _Coordinates
) -> Iterator[EventArray]:
    previous_t = None
    for file in files:
        first = 0
        for events, inside in _file_events(file, layout, size, coordinates):
            check_events(events, size, where=str(file), first_index=first, previous_t=previous_t)
            first += len(events)
            if len(events):
                previous_t = int(events["t"][-1])
                yield events if inside is None else events[inside]


def _file_events(
    file: Path, layout: _Layout, size: tuple[int, int], coordinates: _Coordinates
) -> Iterator[tuple[EventArray, NDArray[np.bool_] | None]]:
    """Chunks of one file, and which of their events are within the images; those that are not are at pixel 0."""
    found = numpy_files.find_events(file)
    columns = found.columns._replace(unit=found.columns.unit or layout.event_unit)
    for data in numpy_files.read_columns(file, found):
        _check_whole(file, columns.t, data[columns.t], columns.unit)
        if not coordinates.mapped:
            yield join(file, data, columns), None
            continue
        x, y = (
            np.floor(_numbers(file, name, data[name]) / coordinates.parts + 0.5)
            for name in (columns.x, columns.y)
        )
        inside = (x >= 0) & (x < size[1]) & (y >= 0) & (y < size[0])
        kept = {columns.x: np.where(inside, x, 0), columns.y: np.where(inside, y, 0)}
        yield join(file, data | kept, columns), inside


def _check_whole(file: Path, name: str, times: NDArray[Any], unit: str | None) -> None:
    """Refuse fractions of microseconds, which are likely seconds."""
    if unit == "us" and times.dtype.kind == "f":
        wrong = np.flatnonzero(np.rint(times) != times)
        if len(wrong):
            raise FormatError(
                f"{file}: {name} of event {wrong[0]} is {times[wrong[0]]}; this layout has whole microseconds"
            )


def _numbers(file: Path, name: str, values: NDArray[Any]) -> NDArray[Any]:
    if values.dtype.kind not in "iuf":
        raise FormatError(f"{file}: {name} is {values.dtype}, not a coordinate")
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        index = int(np.flatnonzero(~np.isfinite(values))[0])
        raise FormatError(f"{file}: {name} of event {index} is {values[index]}")
    return values
