"""MATLAB files in the layout of the AKF authors' datasets, version 5 or 7.3.

The variables and their units are those that the released ``akf_reconstruction.m`` and
``event_asynchronous_filter.m`` load; ``docs/formats.md`` lists them. A file of version 7.3 is HDF5 and is
streamed; one of version 5 holds 2 GB per variable at most, and its events or images are loaded whole while
they are iterated.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from kalux.errors import EventError, FormatError
from kalux.events import EventArray, make_events
from kalux.frames import Frame, GroundTruth
from kalux.readers.hdf5_layout import library
from kalux.readers.source import (
    CHUNK_EVENTS,
    NO_EVENTS,
    NO_FRAMES,
    Source,
    begins_with,
    checked_inverse_covariance,
    reading,
)

_MAGIC_5: Final = b"MATLAB 5.0 MAT-file"
_MAGIC_73: Final = b"MATLAB 7.3 MAT-file"
_WHITE: Final = 255.0  # of image and HDR_mat, whatever their type: the released code divides both by 255
_SHORTEST_FRAME_PERIOD: Final = 100.0  # us; times closer than that are not in microseconds
_BLOCK_BYTES: Final = 32 << 20

_DAMAGE: Final = (
    AttributeError,
    EOFError,
    IndexError,
    KeyError,
    MemoryError,
    OverflowError,
    RuntimeError,
    TypeError,
    ValueError,
    struct.error,
    zlib.error,
)
_Shape = tuple[int, ...]


def recognises(path: Path) -> bool:
    """Whether the file begins like a MATLAB file of version 5 or 7.3."""
    return begins_with(path, _MAGIC_5, _MAGIC_73)


def read(path: Path) -> Source:
    """Open a ``.mat`` file of the AKF authors' layout.

    Raises
    ------
    FormatError
        If it is damaged, or its variables are not those of the layout.
    InputError
        If it cannot be read.
    """
    variables = _open(path)
    shapes = variables.shapes()
    if "events" not in shapes:
        named = [name for name in sorted(shapes) if name.isidentifier()][:20]
        raise FormatError(
            f"{path}: has no variable 'events' (it has {', '.join(named) or 'none'}); the layout needs "
            "events, image, time_image and exposure"
        )
    if len(shapes["events"]) != 2 or shapes["events"][1] != 4:
        raise FormatError(f"{path}: events is {_by(shapes['events'])}; N x 4 is needed: t, x, y, polarity")
    event_count = shapes["events"][0]
    frame_count = _count_frames(path, shapes)
    starts, ends, missing = _exposures(path, variables, shapes, frame_count)
    if not event_count:
        missing += (NO_EVENTS,)

    def read_frames() -> Iterator[Frame]:
        images = variables.images("image") if frame_count else iter(())
        for image, start, end in zip(images, starts, ends, strict=True):
            yield _frame(image, int(start), int(end))

    return Source(
        path=path,
        format="mat",
        sensor_size=_sensor_size(path, variables, shapes),
        events=lambda: _read_events(path, variables),
        frames=read_frames,
        count_events=lambda: event_count,
        count_frames=lambda: frame_count,
        exposure_known=not frame_count or "exposure" in shapes,
        contrast_threshold=_contrast_threshold(path, variables) if "ct" in shapes else None,
        inverse_covariance=(
            checked_inverse_covariance(path, "f_Q", _numbers(path, variables, "f_Q"))
            if "f_Q" in shapes
            else None
        ),
        ground_truth=_ground_truth(path, variables, shapes, (starts + ends) // 2),
        missing=missing,
    )


# What the variables mean


def _count_frames(path: Path, shapes: dict[str, _Shape]) -> int:
    if "image" not in shapes:
        if "img_color" in shapes:
            raise FormatError(
                f"{path}: has frames in colour only (img_color); convert them to a grey variable 'image' of "
                "height x width x frames, as the dataset's notes describe"
            )
        return 0
    shape = shapes["image"]
    if len(shape) == 2:  # MATLAB drops the last dimension of a single frame
        return 1 if min(shape) else 0
    if len(shape) != 3:
        raise FormatError(f"{path}: image is {_by(shape)}; height x width x frames, grey, is needed")
    return shape[2]


def _sensor_size(path: Path, variables: _Variables, shapes: dict[str, _Shape]) -> tuple[int, int]:
    stated = None
    if "im_height" in shapes and "im_width" in shapes:
        height, width = _numbers(path, variables, "im_height"), _numbers(path, variables, "im_width")
        if height.size == width.size == 1 and min(height[0], width[0]) >= 1:
            stated = int(height[0]), int(width[0])
    found = shapes["image"][:2] if "image" in shapes and min(shapes["image"]) else None
    if stated is None and found is None:
        raise FormatError(
            f"{path}: has neither images nor im_height and im_width, so the sensor size is unknown"
        )
    if stated is not None and found is not None and stated != found:
        raise FormatError(
            f"{path}: im_height x im_width is {_by(stated)}, but image is {_by(found)}; they must agree"
        )
    height_width = found if stated is None else stated
    assert height_width is not None
    return height_width[0], height_width[1]


def _exposures(
    path: Path, variables: _Variables, shapes: dict[str, _Shape], frame_count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], tuple[str, ...]]:
    """Start and end of each frame's exposure, us; and what is missing."""
    if not frame_count:
        return np.empty(0, np.int64), np.empty(0, np.int64), (NO_FRAMES,)
    if "time_image" not in shapes:
        raise FormatError(f"{path}: has no variable 'time_image', the middle of each frame's exposure in us")
    middles = _numbers(path, variables, "time_image")
    if len(middles) != frame_count:
        raise FormatError(
            f"{path}: time_image has {len(middles)} values for {frame_count} frames; one each is needed, the "
            "middle of the exposure in us"
        )
    if frame_count > 1 and abs(middles[-1] - middles[0]) < _SHORTEST_FRAME_PERIOD * (frame_count - 1):
        raise FormatError(
            f"{path}: time_image spans {abs(middles[-1] - middles[0]):g} over {frame_count} frames, which cannot "
            "be microseconds; convert events, time_image and exposure to microseconds"
        )
    if "exposure" not in shapes:
        stamps = np.rint(middles).astype(np.int64)
        return (
            stamps,
            stamps,
            (
                "The exposure times of the frames are not recorded; their stamps mark the middle (--stamp middle).",
            ),
        )
    exposures = _numbers(path, variables, "exposure")
    if len(exposures) != frame_count:
        if len(exposures) == 0 or exposures.min() != exposures.max():
            raise FormatError(
                f"{path}: exposure has {len(exposures)} values for {frame_count} frames; one each, or one for "
                "all, is needed, in us"
            )
        exposures = np.full(frame_count, exposures[0])
    starts = np.floor(middles - exposures / 2 + 0.5).astype(np.int64)
    return starts, starts + np.rint(exposures).astype(np.int64), ()


def _contrast_threshold(path: Path, variables: _Variables) -> tuple[float, float]:
    ct = _numbers(path, variables, "ct")
    if len(ct) not in (1, 2) or ct.min() <= 0:
        raise FormatError(f"{path}: ct is {ct[:4].tolist()}; one positive threshold, or (on, off), is needed")
    return float(ct[0]), float(ct[-1])


def _ground_truth(
    path: Path, variables: _Variables, shapes: dict[str, _Shape], times: NDArray[np.int64]
) -> Callable[[], GroundTruth] | None:
    """``HDR_mat``: one image, colour or grey, per frame, at the middle of its exposure."""
    if "HDR_mat" not in shapes:
        return None
    shape = shapes["HDR_mat"]
    count = shape[-1] if len(times) > 1 else 1
    if len(shape) not in (2, 3, 4) or count != len(times) or not min(shape):
        raise FormatError(
            f"{path}: HDR_mat is {_by(shape)} for {len(times)} frames; height x width x 3 x frames is needed"
        )

    def load() -> GroundTruth:
        images, masks = [], []
        for image in variables.images("HDR_mat", count):
            grey = _mean_of_channels(image)
            images.append(grey / np.float32(_WHITE))
            masks.append(grey > 0)
        return GroundTruth(times, np.stack(images), None if np.all(masks) else np.stack(masks))

    return load


def _mean_of_channels(image: NDArray[Any]) -> NDArray[np.float32]:
    image = image.astype(np.float32)
    return image.mean(axis=2, dtype=np.float32) if image.ndim == 3 else image


def _read_events(path: Path, variables: _Variables) -> Iterator[EventArray]:
    count = 0
    for block in variables.rows("events"):
        yield _events(path, block, count)
        count += len(block)


def _events(path: Path, block: NDArray[Any], first: int) -> EventArray:
    """Events from rows [t in us, x, y from 1, polarity -1 or +1]."""
    columns = [
        _whole(path, name, block[:, i], first) for i, name in enumerate(("time", "x", "y", "polarity"))
    ]
    t, x, y, p = columns
    if len(block) and min(x.min(), y.min()) < 1:
        i = int(np.argmax((x < 1) | (y < 1)))
        raise EventError(
            f"{path}: event {first + i} is at x={x[i]}, y={y[i]}; in this layout x and y begin at 1, add 1 to both"
        )
    try:
        return make_events(t, x - 1, y - 1, p)
    except EventError as error:
        raise EventError(f"{path}: from event {first} on: {error}") from error


def _whole(path: Path, name: str, column: NDArray[Any], first: int) -> NDArray[np.int64]:
    """A column of doubles as integers. Times are rounded, all else must be whole already."""
    if column.dtype.kind not in "iufb":
        raise FormatError(f"{path}: events are {column.dtype}; numbers are needed")
    rounded = np.rint(column) if column.dtype.kind == "f" else column
    valid = np.abs(rounded) < 2.0**62  # false for NaN
    if name != "time":
        valid &= rounded == column
    if not valid.all():
        i = int(np.argmin(valid))
        raise EventError(f"{path}: {name} of event {first + i} is {column[i]}; a whole number is needed")
    return rounded.astype(np.int64)


def _frame(image: NDArray[Any], start: int, end: int) -> Frame:
    if image.dtype not in (np.uint8, np.uint16):
        image = image.astype(np.float32)
    return Frame(np.ascontiguousarray(image), start, end, None if image.dtype == np.uint8 else _WHITE)


def _numbers(path: Path, variables: _Variables, name: str) -> NDArray[np.float64]:
    """A small variable as a flat array."""
    values = variables.array(name)
    if values.dtype.kind not in "iufb" or not (np.abs(values) < 2.0**62).all():
        raise FormatError(f"{path}: {name} is not an array of reasonable numbers; write the file again")
    return np.asarray(values.ravel(order="F"), dtype=np.float64)


def _by(shape: _Shape) -> str:
    return " x ".join(map(str, shape))


# The two file formats

_HEADER_BYTES: Final = 128
_BEGINNING_BYTES: Final = 1024  # holds type, dimensions and name of a variable
_MATRIX, _COMPRESSED = 14, 15
_COMPLEX: Final = 0x800
_STORED: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES: Final = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip


class _Variables(Protocol):
    """Access to the variables of a file, all in MATLAB's order of dimensions."""

    def shapes(self) -> dict[str, _Shape]: ...

    def array(self, name: str) -> NDArray[Any]: ...

    def rows(self, name: str) -> Iterator[NDArray[Any]]:
        """A matrix in blocks of rows."""

    def images(self, name: str, count: int = 0) -> Iterator[NDArray[Any]]:
        """An array along its last dimension; an array of a single image (``count`` 1) may lack it."""


def _open(path: Path) -> _Variables:
    with reading(path):
        return _Version73(path) if begins_with(path, _MAGIC_73) else _Version5(path)


@dataclass(frozen=True)
class _Element:
    """A numeric variable in a version 5 file."""

    name: str
    shape: _Shape
    dtype: np.dtype[Any]
    offset: int
    size: int
    compressed: bool
    values_at: int  # where the tag of its values begins, after decompression


class _Version5:
    """Own parser of numeric arrays: scipy's crashes the process on some damaged files.

    The format is in MathWorks, "MAT-File Format", chapter 1.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with reading(path, *_DAMAGE), path.open("rb") as file:
            file.seek(126)
            self._order = {b"IM": "<", b"MI": ">"}[file.read(2)]
            self._elements = {element.name: element for element in self._scan(file)}

    def shapes(self) -> dict[str, _Shape]:
        return {name: element.shape for name, element in self._elements.items()}

    def array(self, name: str) -> NDArray[Any]:
        element = self._elements[name]
        with reading(self._path, *_DAMAGE), self._path.open("rb") as file:
            file.seek(element.offset)
            data = file.read(element.size)
            if element.compressed:
                data = zlib.decompress(data)
            kind, start, size, _ = self._tag(data, element.values_at)
            stored = np.dtype(self._order + _STORED[kind])
            count = math.prod(element.shape)
            if size != count * stored.itemsize:
                raise ValueError(f"{name} has {size} bytes for {_by(element.shape)} values")
            values = np.frombuffer(data, stored, count, start)
            return values.astype(element.dtype, copy=False).reshape(element.shape, order="F")

    def _scan(self, file: BinaryIO) -> Iterator[_Element]:
        """Numeric variables, found by the beginning of each element."""
        file_size = file.seek(0, 2)
        position = _HEADER_BYTES
        while position < file_size:
            file.seek(position)
            kind, size = struct.unpack(self._order + "II", file.read(8))
            position += 8
            if position + size > file_size:
                raise EOFError(f"the variable at byte {position - 8} ends after the file")
            beginning = file.read(min(size, _BEGINNING_BYTES))
            if kind == _COMPRESSED:
                beginning = zlib.decompressobj().decompress(beginning, _BEGINNING_BYTES)[8:]
            if kind in (_COMPRESSED, _MATRIX):
                yield from self._numeric(beginning, position, size, kind == _COMPRESSED)
            position += size

    def _numeric(self, data: bytes, offset: int, size: int, compressed: bool) -> Iterator[_Element]:
        _, start, _, following = self._tag(data, 0)
        flags = struct.unpack_from(self._order + "I", data, start)[0]
        if flags & 0xFF not in _CLASSES or flags & _COMPLEX:
            return
        _, start, length, following = self._tag(data, following)
        shape = struct.unpack_from(f"{self._order}{length // 4}i", data, start)
        if min(shape) < 0:
            raise ValueError("a variable has a negative size")
        _, start, length, following = self._tag(data, following)
        name = data[start : start + length].decode("ascii")
        values_at = following + (8 if compressed else 0)
        yield _Element(name, shape, np.dtype(_CLASSES[flags & 0xFF]), offset, size, compressed, values_at)

    def _tag(self, data: bytes, position: int) -> tuple[int, int, int, int]:
        """Type, start and size of the element at a position, and where the next one begins."""
        kind, size = struct.unpack_from(self._order + "II", data, position)
        if kind >> 16:  # up to four bytes are packed into the tag
            return kind & 0xFFFF, position + 4, kind >> 16, position + 8
        return kind, position + 8, size, position + 8 + (size + 7) // 8 * 8

    def rows(self, name: str) -> Iterator[NDArray[Any]]:
        matrix = self.array(name)
        for start in range(0, len(matrix), CHUNK_EVENTS):
            yield matrix[start : start + CHUNK_EVENTS]

    def images(self, name: str, count: int = 0) -> Iterator[NDArray[Any]]:
        array = self.array(name)
        if array.ndim == 2 or (count == 1 and array.shape[-1] != 1):
            array = array[..., None]
        for index in range(array.shape[-1]):
            yield array[..., index]


class _Version73:
    """HDF5, in which MATLAB's dimensions appear in reverse."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def shapes(self) -> dict[str, _Shape]:
        with self._file() as file:
            return {
                name: self._shape(item)
                for name, item in file.items()
                if isinstance(item, library().Dataset) and name != "#refs#"
            }

    def array(self, name: str) -> NDArray[Any]:
        with self._file() as file:
            array = np.asarray(file[name][()])
            return array.T if min(self._shape(file[name]), default=1) else np.empty(0)

    def rows(self, name: str) -> Iterator[NDArray[Any]]:
        with self._file() as file:
            matrix = file[name]
            count = self._shape(matrix)[0]
            if not count:
                return
            stored = (matrix.chunks or matrix.shape)[1]
            step = max(CHUNK_EVENTS // max(stored, 1), 1) * stored if stored < CHUNK_EVENTS else CHUNK_EVENTS
            for start in range(0, count, step):
                yield matrix[:, start : start + step].T

    def images(self, name: str, count: int = 0) -> Iterator[NDArray[Any]]:
        with self._file() as file:
            array = file[name]
            if array.ndim == 2 or (count == 1 and array.shape[0] != 1):
                yield array[()].T
                return
            image_bytes = array.dtype.itemsize * int(np.prod(array.shape[1:]))
            step = min((array.chunks or (1,))[0], max(_BLOCK_BYTES // max(image_bytes, 1), 1))
            for start in range(0, array.shape[0], step):
                for image in array[start : start + step]:
                    yield image.T

    @contextmanager
    def _file(self) -> Iterator[Any]:
        with reading(self._path, *_DAMAGE), library().File(self._path, "r") as file:
            yield file

    @staticmethod
    def _shape(dataset: Any) -> _Shape:
        # MATLAB stores the dimensions of an empty array in place of its contents.
        shape = dataset[()].ravel() if dataset.attrs.get("MATLAB_empty", 0) else dataset.shape[::-1]
        return tuple(map(int, shape))
