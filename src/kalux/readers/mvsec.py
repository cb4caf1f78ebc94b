"""MVSEC's HDF5 files: ``davis/left/events`` (N, 4) of x, y, t, p, ``davis/left/image_raw`` and ``image_raw_ts``.

Times are floating-point seconds, polarity is -1 or +1. Written from the data format at
https://daniilidis-group.github.io/mvsec/. The left camera is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EVENT_DTYPE, EventArray
from kalux.readers import hdf5_layout
from kalux.readers.source import Source

_EVENTS: Final = "davis/left/events"
_IMAGES: Final = "davis/left/image_raw"
_STAMPS: Final = "davis/left/image_raw_ts"
_RIGHT: Final = "davis/right/events"


def recognises(path: Path) -> bool:
    """Whether it is an HDF5 file with events in this layout."""
    return hdf5_layout.holds(path, (_EVENTS,))


def read(path: Path) -> Source:
    """Open the left camera of an MVSEC recording (``..._data.hdf5``).

    The layout has no exposure times. The sensor has the size of the images.

    Raises
    ------
    FormatError
        If it is damaged.
    InputError
        If it cannot be read.
    """
    with hdf5_layout.opened(path) as file:
        events = file[_EVENTS]
        if events.ndim != 2 or events.shape[1] != 4 or events.dtype.kind not in "fiu":
            raise FormatError(
                f"{path}: {_EVENTS} has the shape {events.shape}; (N, 4) numbers x, y, t, p are needed"
            )
        hdf5_layout.check_seconds(path, events.dtype)
        hdf5_layout.check_dataset(path, events)
        count = int(events.shape[0])
        stack = hdf5_layout.find_stack(path, file, _IMAGES, _STAMPS, partial(hdf5_layout.microseconds, path))
        notes = ("The left camera is read.",) if _RIGHT in file else ()
    return hdf5_layout.source_with_stack(path, "mvsec", lambda: _events(path), count, stack, *notes)


def _events(path: Path) -> Iterator[EventArray]:
    before = 0
    with hdf5_layout.opened(path) as file:
        table = file[_EVENTS]
        for part in hdf5_layout.slices(table, table.shape[0]):
            stored = table[part]
            hdf5_layout.refuse_coarse(path, stored[:, 2])
            rows = np.ascontiguousarray(stored, np.float64)
            events: EventArray = np.empty(len(rows), EVENT_DTYPE)
            good = _convert(rows, events["t"], events["x"], events["y"], events["p"])
            if good < len(rows):
                shown = ", ".join(f"{value:g}" for value in rows[good])
                raise FormatError(
                    f"{path}: event {before + good} is {shown}; x and y from 0, t in seconds, p -1 or +1 are needed"
                )
            before += len(rows)
            yield events


@njit(cache=True, nogil=True)
def _convert(
    rows: NDArray[np.float64],
    t: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.bool_],
) -> int:
    """Fill the columns; the number of good rows before the first that cannot be an event."""
    for i in range(len(rows)):
        column, row, seconds, polarity = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3]
        # Written so that NaN fails.
        if not (0 <= column <= 65535 and 0 <= row <= 65535 and abs(seconds) < 4e12):
            return i
        if not (polarity == 1 or polarity == -1 or polarity == 0):
            return i
        if column != np.floor(column) or row != np.floor(row):
            return i
        t[i] = np.int64(np.rint(seconds * 1e6))
        x[i] = np.uint16(column)
        y[i] = np.uint16(row)
        p[i] = polarity > 0
    return len(rows)
