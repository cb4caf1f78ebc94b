"""Folders of EVREAL, a benchmark of video from events: NumPy arrays of events and grey images, times in seconds.

::

    events_ts.npy  (N,) or (N, 1)            images.npy     (K, height, width, 1)
    events_xy.npy  (N, 2)                    images_ts.npy  (K, 1)
    events_p.npy   (N,), 0 and 1             metadata.json  {"sensor_resolution": [height, width]}

Written from ``dataset.py`` and ``tools`` of https://github.com/ercanburak/EVREAL, which makes them of ECD, MVSEC, HQF
and other sets. Images and ``metadata.json`` may be missing; ``image_event_indices.npy`` says nothing that the times do
not.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EventArray
from kalux.frames import Frame
from kalux.readers import hdf5_layout
from kalux.readers.numpy_files import mapped
from kalux.readers.source import (
    CHUNK_EVENTS,
    EXPOSURE_UNKNOWN,
    NO_FRAMES,
    SIZE_UNKNOWN,
    Source,
    reading,
    smallest_size,
)

_TIMES: Final = "events_ts.npy"
_PLACES: Final = "events_xy.npy"
_POLARITIES: Final = "events_p.npy"
_IMAGES: Final = "images.npy"
_STAMPS: Final = "images_ts.npy"
_METADATA: Final = "metadata.json"
_RESOLUTION: Final = "sensor_resolution"
_LARGEST_METADATA: Final = 1 << 20  # bytes
_LARGEST_SIDE: Final = 1 << 16


def recognises(path: Path) -> bool:
    """Whether it is a folder with the arrays of events."""
    return path.is_dir() and all((path / name).is_file() for name in (_TIMES, _PLACES, _POLARITIES))


def read(path: Path) -> Source:
    """Open a sequence.

    The layout has no exposure times. The sensor has the size of the images; without them, that of the metadata.

    Raises
    ------
    FormatError
        If the arrays do not belong together, or one is cut short or damaged.
    InputError
        If a file cannot be read.
    """
    count = _count_events(path)
    stamps, image_size = _find_images(path)
    size = _joint_size(path, image_size, _stated_size(path / _METADATA))

    def events() -> Iterator[EventArray]:
        return _events(path, count)

    return Source(
        path=path,
        format="evreal",
        sensor_size=size or smallest_size(path, events()),
        events=events,
        count_events=lambda: count,
        frames=lambda: _frames(path, stamps, image_size),
        count_frames=lambda: len(stamps),
        exposure_known=not len(stamps),
        missing=(EXPOSURE_UNKNOWN if len(stamps) else NO_FRAMES, *(() if size else (SIZE_UNKNOWN,))),
        sensor_size_known=size is not None,
    )


def _count_events(path: Path) -> int:
    times, places, polarities = (mapped(path / name) for name in (_TIMES, _PLACES, _POLARITIES))
    for name, array in ((_TIMES, times), (_POLARITIES, polarities)):
        _check_column(path / name, array)
    if places.ndim != 2 or places.shape[1] != 2:
        raise FormatError(f"{path / _PLACES}: has the shape {places.shape}; (N, 2) is needed, x and y")
    hdf5_layout.check_seconds(path / _TIMES, times.dtype)
    if not len(times) == len(places) == len(polarities):
        raise FormatError(
            f"{path}: its arrays have different lengths ({_TIMES} {len(times)}, {_PLACES} {len(places)}, {_POLARITIES} "
            f"{len(polarities)}); copy or make them again"
        )
    return len(times)


def _check_column(file: Path, array: NDArray[Any]) -> None:
    if not array.ndim or math.prod(array.shape[1:]) != 1:
        raise FormatError(f"{file}: has the shape {array.shape}; (N,) is needed")


def _find_images(path: Path) -> tuple[NDArray[np.int64], tuple[int, int] | None]:
    """The times of the images, us, and their size; none of both where there are no images."""
    if not ((path / _IMAGES).is_file() and (path / _STAMPS).is_file()):
        return np.empty(0, np.int64), None
    images, stamps = mapped(path / _IMAGES), mapped(path / _STAMPS)
    _check_column(path / _STAMPS, stamps)
    size = hdf5_layout.size_of(path / _IMAGES, images.shape[1:], grey=True)
    if len(images) != len(stamps):
        raise FormatError(
            f"{path}: has {len(images)} images for {len(stamps)} times; copy or make them again"
        )
    return hdf5_layout.microseconds(path / _STAMPS, np.array(stamps).reshape(-1)), size


def _stated_size(file: Path) -> tuple[int, int] | None:
    """(height, width) of the metadata, if there are any."""
    if not file.is_file():
        return None
    with reading(file, ValueError, RecursionError):
        if file.stat().st_size > _LARGEST_METADATA:
            raise FormatError(f"{file}: is too large for metadata")
        found = json.loads(file.read_text("utf-8-sig"))
    size = found.get(_RESOLUTION) if isinstance(found, dict) else None
    if size is None:
        return None
    whole = isinstance(size, list) and all(type(side) is int and 0 < side <= _LARGEST_SIDE for side in size)
    if not whole or len(size) != 2:
        raise FormatError(f"{file}: {_RESOLUTION} is {str(size)[:60]!r}; height and width are needed")
    return size[0], size[1]


def _joint_size(
    path: Path, images: tuple[int, int] | None, stated: tuple[int, int] | None
) -> tuple[int, int] | None:
    if images and stated and images != stated:
        raise FormatError(
            f"{path}: its images have {images[1]}x{images[0]} pixels, but {_METADATA} says {stated[1]}x{stated[0]}; "
            "copy or make them again"
        )
    return images or stated


def _events(path: Path, count: int) -> Iterator[EventArray]:
    # Mapped anew for every chunk: what was read of a mapped file counts as memory of the process.
    for start in range(0, count, CHUNK_EVENTS):
        seconds, places, p = (
            np.array(mapped(path / name)[start : start + CHUNK_EVENTS])
            for name in (_TIMES, _PLACES, _POLARITIES)
        )
        t = hdf5_layout.microseconds(path / _TIMES, seconds.reshape(-1))
        yield hdf5_layout.checked_events(path, t, places[:, 0], places[:, 1], p.reshape(-1))


def _frames(path: Path, stamps: NDArray[np.int64], size: tuple[int, int] | None) -> Iterator[Frame]:
    if size is None:
        return
    for index, stamp in enumerate(stamps.tolist()):
        yield Frame(np.array(mapped(path / _IMAGES)[index]).reshape(size), stamp, stamp)
