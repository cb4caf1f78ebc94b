"""What the readers of HDF5 layouts share: opening, checking, reading whole chunks of the file."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.errors import EventError, FormatError
from kalux.events import EventArray, check_precision, make_events
from kalux.frames import Frame
from kalux.readers.source import (
    CHUNK_EVENTS,
    EXPOSURE_UNKNOWN,
    NO_FRAMES,
    SIZE_UNKNOWN,
    Source,
    begins_with,
    reading,
    smallest_size,
)

DAMAGE: Final = (KeyError, ValueError, TypeError, RuntimeError, AttributeError, IndexError, MemoryError)
"""What h5py raises for damaged files, besides OSError."""

LARGEST_IMAGE: Final = 1 << 28
"""Pixels; more is damage, and would need much memory."""

LARGEST_SIDE: Final = 1 << 16
"""Pixels of a sensor in a row or column."""

LARGEST_CHUNK: Final = 1 << 29
"""Bytes of a chunk of the file, which HDF5 unpacks as a whole; more is damage."""

SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
"""How HDF5 files begin."""

_ECF: Final = 0x8ECF


def library() -> Any:
    """h5py, which takes 0.1 s to import: recordings of other formats do without."""
    import h5py
    import hdf5plugin  # noqa: F401 - registers Blosc, LZ4, ZSTD and others with HDF5

    return h5py


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The file, open for reading; damage becomes a FormatError."""
    with reading(path, *DAMAGE), library().File(path, "r") as file:
        yield file


def holds(path: Path, names: tuple[str, ...]) -> bool:
    """Whether it is an HDF5 file with datasets of all these names."""
    if not begins_with(path, SIGNATURE):
        return False
    try:
        with library().File(path, "r") as file:
            return all(isinstance(file.get(name), library().Dataset) for name in names)
    except (OSError, *DAMAGE):
        return False


def common_length(path: Path, file: Any, names: tuple[str, ...]) -> int:
    """The length of columns, which must be equal, of one dimension, and really there.

    Raises
    ------
    FormatError
        If they are not, or compressed with a filter that is not installed.
    """
    lengths = {name: file[name].shape[0] for name in names}
    if len(set(lengths.values())) != 1:
        found = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise FormatError(f"{path}: columns have different lengths ({found}); copy or download it again")
    for name in names:
        check_dataset(path, file[name])
    return int(next(iter(lengths.values())))


def check_dataset(path: Path, dataset: Any) -> None:
    """Check that a dataset is stored in full, in chunks of a reasonable size, and can be unpacked.

    HDF5 reads what is not stored as zeros: without this check, a damaged length would be a flood of them.

    Raises
    ------
    FormatError
        If it is not.
    """
    plist = dataset.id.get_create_plist()
    for index in range(plist.get_nfilters()):
        code, _, _, name = plist.get_filter(index)
        if not library().h5z.filter_avail(code):
            raise FormatError(f"{path}: {_missing_filter(code, name)}")
    if dataset.chunks is not None and math.prod(dataset.chunks) * dataset.dtype.itemsize > LARGEST_CHUNK:
        raise FormatError(
            f"{path}: {dataset.name} is stored in chunks of {dataset.chunks}; repack it in smaller ones"
        )
    if dataset.size == 0:
        return
    if dataset.chunks is None:
        whole = dataset.id.get_storage_size() >= dataset.size * dataset.dtype.itemsize
    else:
        wanted = math.prod(-(-n // c) for n, c in zip(dataset.shape, dataset.chunks, strict=True))
        whole = dataset.id.get_num_chunks() >= wanted
    if not whole:
        raise FormatError(f"{path}: {dataset.name} is not stored in full; copy or download it again")


def _missing_filter(code: int, name: bytes) -> str:
    if code == _ECF:
        return (
            "is compressed with Prophesee's ECF, and no HDF5 filter for it is installed; install hdf5_ecf "
            "(github.com/prophesee-ai/hdf5_ecf) and set HDF5_PLUGIN_PATH to it, or use the RAW file"
        )
    shown = name.decode("ascii", "replace").strip("\0") or "unnamed"
    return f"is compressed with an HDF5 filter that is not installed ({shown}, number {code}); install it"


def slices(dataset: Any, length: int) -> Iterator[slice]:
    """Slices of whole chunks of the file: reading across their borders decompresses each twice."""
    stored = min((dataset.chunks or (CHUNK_EVENTS,))[0], 8 * CHUNK_EVENTS)
    step = max(CHUNK_EVENTS // stored, 1) * stored
    for start in range(0, length, step):
        yield slice(start, min(start + step, length))


def column_events(
    path: Path,
    names: tuple[str, str, str, str],
    convert: Callable[[NDArray[Any], NDArray[Any]], tuple[NDArray[Any], NDArray[Any]]],
) -> Iterator[EventArray]:
    """Events from four columns, ``names`` of t, x, y, p.

    Parameters
    ----------
    convert
        Makes integer microseconds and 0/1 (or -1/+1) of t and p.
    """
    with opened(path) as file:
        length = common_length(path, file, names)
        columns = [file[name] for name in names]
        for part in slices(columns[0], length):
            t, x, y, p = (column[part] for column in columns)
            t, p = convert(t, p)
            yield checked_events(path, t, x, y, p)


def checked_events(path: Path, t: Any, x: Any, y: Any, p: Any) -> EventArray:
    """As `make_events`; what is wrong is a FormatError that names the file."""
    with _events_of(path):
        return make_events(t, x, y, p)


def check_seconds(path: Path, dtype: np.dtype[Any]) -> None:
    """Require times in seconds, with decimals.

    Raises
    ------
    FormatError
        If they are whole numbers, which other programs write in other units.
    """
    if dtype.kind != "f":
        raise FormatError(
            f"{path}: its times are {dtype}, but this layout has floating-point seconds; divide microseconds by 1e6 "
            "and write it again"
        )


def microseconds(path: Path, seconds: NDArray[Any]) -> NDArray[np.int64]:
    """Floating-point seconds to the nearest microsecond.

    Raises
    ------
    FormatError
        If they are whole numbers, or one is not finite, or too large, or too large for its precision.
    """
    check_seconds(path, seconds.dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = np.rint(np.asarray(seconds, np.float64) * 1e6)
    # Also refuses NaN, of which no comparison is true.
    if scaled.size and not (np.abs(scaled).max() < 2.0**62):
        raise FormatError(f"{path}: has times that are not finite or out of range; copy or download it again")
    refuse_coarse(path, seconds)
    return scaled.astype(np.int64)


def refuse_coarse(path: Path, seconds: NDArray[Any]) -> None:
    """As `kalux.events.check_precision`; what is wrong is a FormatError that names the file."""
    if seconds.dtype.itemsize > 4:  # in double precision all possible times are fine
        return
    with _events_of(path):
        check_precision(seconds, 1e6)


@contextmanager
def _events_of(path: Path) -> Iterator[None]:
    """What is wrong with events becomes a FormatError that names the file."""
    try:
        yield
    except EventError as error:
        raise FormatError(f"{path}: {str(error).removeprefix('events: ')}") from error


def size_of(path: Path, shape: tuple[int, ...], *, grey: bool = False) -> tuple[int, int]:
    """(height, width) of an image's shape.

    Raises
    ------
    FormatError
        If it is no image, or in colour where a layout has none (``grey``).
    """
    if grey and len(shape) == 3 and shape[2] in (3, 4):
        raise FormatError(f"{path}: its images are in colour, which this layout has not; {JOIN_FRAMES}")
    if len(shape) == 3 and shape[2] in (1, 3, 4):
        shape = shape[:2]
    if len(shape) != 2 or not 0 < shape[0] * shape[1] <= LARGEST_IMAGE:
        raise FormatError(f"{path}: its images have the shape {shape}; (height, width) is needed")
    return int(shape[0]), int(shape[1])


def stated_size(path: Path, *places: Any) -> tuple[int, int] | None:
    """(height, width) of the sensor in the attributes of the first group or dataset that states both; else None.

    Raises
    ------
    FormatError
        If they are no possible size.
    """
    for place in places:
        if "height" in place.attrs and "width" in place.attrs:
            return checked_sides(path, place.attrs["height"], place.attrs["width"])
    return None


def checked_sides(path: Path, height: Any, width: Any) -> tuple[int, int]:
    """A sensor's height and width as whole numbers.

    Raises
    ------
    FormatError
        If they are none, or none that a sensor can have.
    """
    sides = [np.ravel(side) for side in (height, width)]
    if not all(
        len(side) == 1 and side.dtype.kind in "iuf" and 1 <= side[0] <= LARGEST_SIDE for side in sides
    ):
        shown = " x ".join(str(side)[:20] for side in (width, height))
        raise FormatError(f"{path}: says that the sensor has {shown} pixels; write it again")
    return int(sides[0][0]), int(sides[1][0])


class Stack(NamedTuple):
    """Grey images that are one dataset, of unknown exposures.

    Attributes
    ----------
    name
        Of the dataset.
    size
        (height, width); None: there is no such dataset.
    stamps
        us.
    """

    name: str
    size: tuple[int, int] | None
    stamps: NDArray[np.int64]


def find_stack(
    path: Path, file: Any, images: str, stamps: str, convert: Callable[[NDArray[Any]], NDArray[np.int64]]
) -> Stack:
    """The stack of ``images``, if the file has it; ``convert`` makes us of the times in ``stamps``.

    Raises
    ------
    FormatError
        If images and times are not as many, not stored in full, or the images are in colour.
    """
    if images not in file:
        return Stack(images, None, np.empty(0, np.int64))
    size = size_of(path, file[images].shape[1:], grey=True)
    if file[stamps].shape != file[images].shape[:1]:
        raise FormatError(
            f"{path}: has {file[images].shape[0]} images for {file[stamps].shape[0]} times; copy or download it again"
        )
    check_dataset(path, file[images])
    check_dataset(path, file[stamps])
    return Stack(images, size, convert(file[stamps][...]))


def source_with_stack(
    path: Path, format: str, events: Callable[[], Iterator[EventArray]], count: int, stack: Stack, *notes: str
) -> Source:
    """A recording of ``count`` events and a stack of images; the sensor has the size of these, if there are any."""
    missing = (EXPOSURE_UNKNOWN if len(stack.stamps) else NO_FRAMES, *notes)
    if stack.size is None:
        missing += (SIZE_UNKNOWN,)
    return Source(
        path=path,
        format=format,
        sensor_size=stack.size or smallest_size(path, events()),
        events=events,
        frames=lambda: _frames_of(path, stack),
        count_events=lambda: count,
        count_frames=lambda: len(stack.stamps),
        exposure_known=not len(stack.stamps),
        missing=missing,
        sensor_size_known=stack.size is not None,
    )


def _frames_of(path: Path, stack: Stack) -> Iterator[Frame]:
    if stack.size is None:
        return
    with opened(path) as file:
        for index, stamp in enumerate(stack.stamps.tolist()):
            image = file[stack.name][index]
            yield Frame(np.ascontiguousarray(image.reshape(stack.size)), stamp, stamp)


JOIN_FRAMES: Final = "join images of the events' pixels instead (--frames FOLDER --replace-frames)"
"""What to do about images of an unknown order of colours."""
