"""The HDF5 layout of HQF and of E2VID+ (ECNN): ``events/{xs,ys,ts,ps}`` and ``images/image000000000``.

Times are floating-point seconds, in ``events/ts`` and in the attribute ``timestamp`` of each image. Written from the
description of the format in https://github.com/TimoStoff/event_cnn_minimal and the packager of
https://github.com/TimoStoff/event_utils.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EventArray
from kalux.frames import Frame
from kalux.readers import hdf5_layout
from kalux.readers.source import EXPOSURE_UNKNOWN, SIZE_UNKNOWN, Source, smallest_size

_COLUMNS: Final = ("events/ts", "events/xs", "events/ys", "events/ps")


def recognises(path: Path) -> bool:
    """Whether it is an HDF5 file with events in this layout."""
    return hdf5_layout.holds(path, _COLUMNS)


def read(path: Path) -> Source:
    """Open a recording in the layout of HQF.

    The layout has no exposure times. The sensor has the size of the images; without images that of the attribute
    ``sensor_resolution``, in whichever order holds all events (files differ in it).

    Raises
    ------
    FormatError
        If it is damaged.
    InputError
        If it cannot be read.
    """
    with hdf5_layout.opened(path) as file:
        count = hdf5_layout.common_length(path, file, _COLUMNS)
        hdf5_layout.check_seconds(path, file[_COLUMNS[0]].dtype)
        names = sorted(file["images"]) if "images" in file else []
        stamps = [_stamp(path, file["images"][name]) for name in names]
        size = hdf5_layout.size_of(path, file["images"][names[0]].shape) if names else None
        stated = [int(n) for n in np.ravel(file.attrs.get("sensor_resolution", ()))[:2]]
    missing: tuple[str, ...] = (EXPOSURE_UNKNOWN,) if names else ("The file has no images.",)
    size_known = size is not None or len(stated) == 2
    if size is None:
        size = _without_images(smallest_size(path, _events(path)), stated)
        if not size_known:
            missing += (SIZE_UNKNOWN,)
    return Source(
        path=path,
        format="hqf",
        sensor_size=size,
        events=lambda: _events(path),
        frames=lambda: _frames(path, names, stamps, size),
        count_events=lambda: count,
        count_frames=lambda: len(names),
        exposure_known=not names,
        missing=missing,
        sensor_size_known=size_known,
    )


def _stamp(path: Path, image: Any) -> int:
    return int(hdf5_layout.microseconds(path, np.array([image.attrs["timestamp"]]).ravel()[:1])[0])


def _without_images(needed: tuple[int, int], stated: list[int]) -> tuple[int, int]:
    """The stated size, height first or width first; the needed one if neither holds it."""
    orders = [(stated[0], stated[1]), (stated[1], stated[0])] if len(stated) == 2 else []
    fits = (size for size in orders if size[0] >= needed[0] and size[1] >= needed[1])
    return next(fits, needed)


def _events(path: Path) -> Iterator[EventArray]:
    def convert(t: NDArray[Any], p: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        if p.dtype.kind == "f":
            whole = np.where((p == 0) | (np.abs(p) == 1), p, 2).astype(np.int8)  # 2 is refused
            p = whole
        return hdf5_layout.microseconds(path, t), p

    return hdf5_layout.column_events(path, _COLUMNS, convert)


def _frames(path: Path, names: list[str], stamps: list[int], size: tuple[int, int]) -> Iterator[Frame]:
    with hdf5_layout.opened(path) as file:
        for name, stamp in zip(names, stamps, strict=True):
            image = file["images"][name]
            if hdf5_layout.size_of(path, image.shape) != size:
                raise FormatError(f"{path}: {name} has the shape {image.shape}, the first image {size}")
            hdf5_layout.check_dataset(path, image)
            pixels = image[...]
            # Stored as "color_bgr".
            pixels = pixels[..., 2::-1] if pixels.size != size[0] * size[1] else pixels.reshape(size)
            yield Frame(np.ascontiguousarray(pixels), stamp, stamp)
