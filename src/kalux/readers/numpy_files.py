"""Events in NumPy files: ``.npy`` and ``.npz``, of the layouts that tonic, Metavision and scripts leave behind.

A ``.npy`` holds one structured array; an ``.npz`` holds one, or an array for each of t, x, y and p, and perhaps
``height`` and ``width``. Read in pieces, compressed or not, so that memory stays bounded; the format is described at
https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html
"""

from __future__ import annotations

import contextlib
import math
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EventArray
from kalux.readers.columns import UNIT_ASSUMED, Columns, find_columns, join
from kalux.readers.source import (
    CHUNK_EVENTS,
    NO_FRAMES,
    SIZE_UNKNOWN,
    Source,
    begins_with,
    reading,
    smallest_size,
)

_NPY: Final = b"\x93NUMPY"
_ZIP: Final = b"PK\x03\x04"
_LARGEST_ITEM: Final = 256  # bytes per event; more is damage, and would need much memory
DAMAGE: Final = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    NotImplementedError,  # a compression that zipfile lacks
    RuntimeError,  # an encrypted member
    ValueError,
    TypeError,
    KeyError,
    SyntaxError,  # a header that Python cannot read
    tokenize.TokenError,
    MemoryError,
    RecursionError,
    UnicodeError,
)
"""What damaged files, or others under such a name, can lead to in NumPy and zipfile."""

_WANTED: Final = "an array for each of t, x, y and p, or one structured array with these fields"


class _Array(NamedTuple):
    """One array of a file: its name in an ``.npz`` (none in an ``.npy``), and what its header says."""

    member: str | None
    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    @property
    def name(self) -> str:
        return "" if self.member is None else self.member.removesuffix(".npy")


class Layout(NamedTuple):
    """Which arrays of a file are events, what their names mean, and how many events there are."""

    arrays: tuple[_Array, ...]
    columns: Columns
    length: int


def recognises(path: Path) -> bool:
    """Whether it is an ``.npy``, or a zip that holds one at its root."""
    if begins_with(path, _NPY):
        return True
    if not begins_with(path, _ZIP):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") and "/" not in name for name in archive.namelist())
    except DAMAGE:
        return False


def read(path: Path) -> Source:
    """Open events in a NumPy file.

    Integer times are microseconds unless the name of their array or field ends in a unit (``t_ns``); for
    floating-point times it must.

    Raises
    ------
    FormatError
        If the arrays are not events, or the file is cut short or damaged.
    InputError
        If it cannot be read.
    """
    arrays = _list_arrays(path)
    layout = _find_layout(path, arrays)
    size = _stated_size(path, arrays)
    missing: tuple[str, ...] = (_about_frames(arrays),)
    if layout.columns.unit is None:
        missing += (UNIT_ASSUMED,)
    if size is None:
        missing += (SIZE_UNKNOWN,)
    return Source(
        path=path,
        format="npy" if arrays[0].member is None else "npz",
        sensor_size=size or smallest_size(path, _events(path, layout)),
        events=lambda: _events(path, layout),
        count_events=lambda: layout.length,
        missing=missing,
        sensor_size_known=size is not None,
    )


def find_events(path: Path) -> Layout:
    """Where the events of a file are.

    Raises
    ------
    FormatError
        If the arrays are not events, or the file is cut short or damaged.
    """
    return _find_layout(path, _list_arrays(path))


@contextlib.contextmanager
def _opened(path: Path, member: str | None) -> Iterator[IO[bytes]]:
    if member is None:
        with path.open("rb") as file:
            yield file
        return
    with zipfile.ZipFile(path) as archive, archive.open(member) as inside:
        yield inside


def _list_arrays(path: Path) -> list[_Array]:
    with reading(path, *DAMAGE):
        if begins_with(path, _NPY):
            sizes: dict[str | None, int] = {None: path.stat().st_size}
        else:
            with zipfile.ZipFile(path) as archive:
                sizes = {i.filename: i.file_size for i in archive.infolist() if i.filename.endswith(".npy")}
        arrays = []
        for member, size in sizes.items():
            with _opened(path, member) as file:
                dtype, shape, begin = _read_header(file)
                if not dtype.hasobject and begin + math.prod(shape) * dtype.itemsize > size:
                    raise EOFError(f"{member or 'the array'} is cut short")
            arrays.append(_Array(member, dtype, shape))
    return arrays


def _read_header(file: IO[bytes]) -> tuple[np.dtype[Any], tuple[int, ...], int]:
    """Type, shape and where the values begin."""
    version = npy.read_magic(file)
    if version == (1, 0):
        shape, _, dtype = npy.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, _, dtype = npy.read_array_header_2_0(file)
    else:
        raise ValueError(f"version {version} of its header is not known")
    if any(n < 0 for n in shape):
        raise ValueError("a length is negative")
    return dtype, shape, file.tell()


def _find_layout(path: Path, arrays: list[_Array]) -> Layout:
    structured = [array for array in arrays if array.dtype.names is not None and _is_column(array)]
    if len(structured) == 1:
        chosen = tuple(structured)
        columns = find_columns(structured[0].dtype.names or ())
    else:
        flat = {array.name: array for array in arrays if _is_column(array)}
        columns = find_columns(list(flat))
        chosen = () if columns is None else tuple(flat[getattr(columns, field)] for field in "txyp")
    if columns is None:
        raise _no_events(path, arrays)
    if any(array.dtype.hasobject or array.dtype.itemsize > _LARGEST_ITEM for array in chosen):
        raise FormatError(f"{path}: its arrays hold Python objects or huge items; save plain numbers")
    counts = {array.name: array.shape[0] for array in chosen}
    if len(set(counts.values())) != 1:
        found = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise FormatError(f"{path}: its arrays have different lengths ({found}); save them again")
    return Layout(chosen, columns, chosen[0].shape[0])


def _is_column(array: _Array) -> bool:
    """Whether it has one value for each event: (N,), or (N, 1), as Time Lens saves columns."""
    return len(array.shape) >= 1 and math.prod(array.shape[1:]) == 1


def _no_events(path: Path, arrays: list[_Array]) -> FormatError:
    if any(len(array.shape) == 2 and array.shape[1] == 4 for array in arrays):
        return FormatError(
            f"{path}: holds an (N, 4) array, which does not say which column is what; save {_WANTED}, or use "
            "kalux.Recording.from_arrays(..., columns='txyp')"
        )
    found = ", ".join(_described(array) for array in arrays[:8]) or "nothing"
    return FormatError(f"{path}: holds {found}; {_WANTED} are needed")


def _about_frames(arrays: list[_Array]) -> str:
    """That no frames are read, and which arrays look as if they were."""
    images = [_described(array) for array in arrays if len(array.shape) in (3, 4)]
    if not images:
        return NO_FRAMES
    return (
        f"The arrays of frames ({', '.join(images[:4])}) are not read, as nothing states their exposures; make the "
        "recording with kalux.Recording.from_arrays, or save images and join them with --frames."
    )


def _described(array: _Array) -> str:
    names = f" with {', '.join(array.dtype.names)}" if array.dtype.names else ""
    return f"{array.name or 'an array'} {array.shape}{names}"[:80]


def _stated_size(path: Path, arrays: list[_Array]) -> tuple[int, int] | None:
    numbers = {
        array.name: array
        for array in arrays
        if array.name in ("height", "width") and math.prod(array.shape) == 1 and array.dtype.kind in "iu"
    }
    if len(numbers) != 2:
        return None
    height, width = (_read_number(path, numbers[name]) for name in ("height", "width"))
    if min(height, width) <= 0:
        raise FormatError(f"{path}: says that the sensor has {width}x{height} pixels; save it again")
    return height, width


def _read_number(path: Path, array: _Array) -> int:
    with reading(path, *DAMAGE), _opened(path, array.member) as file:
        _read_header(file)
        return int(np.frombuffer(_exactly(file, array.dtype.itemsize), array.dtype)[0])


def _events(path: Path, layout: Layout) -> Iterator[EventArray]:
    return (join(path, data, layout.columns) for data in read_columns(path, layout))


def read_columns(path: Path, layout: Layout) -> Iterator[dict[str, NDArray[Any]]]:
    """Chunks of the columns as they are stored, by their names in the file.

    Raises
    ------
    FormatError
        If the file is cut short or damaged.
    """
    with reading(path, *DAMAGE), contextlib.ExitStack() as stack:
        files = [stack.enter_context(_opened(path, array.member)) for array in layout.arrays]
        for file in files:
            _read_header(file)
        for start in range(0, layout.length, CHUNK_EVENTS):
            count = min(CHUNK_EVENTS, layout.length - start)
            data: dict[str, NDArray[Any]] = {}
            for file, array in zip(files, layout.arrays, strict=True):
                values = np.frombuffer(_exactly(file, count * array.dtype.itemsize), array.dtype)
                if values.dtype.names is None:
                    data[array.name] = values
                else:
                    data |= {name: values[name] for name in layout.columns[:4]}
            yield data


def mapped(path: Path) -> NDArray[Any]:
    """The numbers of an ``.npy``, mapped into memory: what is not used is not read.

    Raises
    ------
    FormatError
        If it holds anything else, or is cut short or damaged.
    """
    arrays = _list_arrays(path)  # which also checks that they are there in full
    if len(arrays) != 1 or arrays[0].member is not None or arrays[0].dtype.kind not in "biuf":
        raise FormatError(
            f"{path}: holds {', '.join(map(_described, arrays[:8])) or 'nothing'}; an array of numbers is needed"
        )
    with reading(path, *DAMAGE, OverflowError):
        if not math.prod(arrays[0].shape):  # nothing to map
            return np.empty(arrays[0].shape, arrays[0].dtype)
        return npy.open_memmap(path, mode="r")


def _exactly(file: IO[bytes], size: int) -> bytes:
    data = file.read(size)
    if len(data) != size:
        raise EOFError("an array is cut short")
    return data
