"""HDF5 files of v2e: ``events`` (N, 4) of t, x, y, p, ``frame`` (K, H, W) and ``frame_ts``; times in microseconds.

v2e makes events of a video. Written from the writer in https://github.com/SensorsINI/v2e (``v2ecore/emulator.py``,
version 1.6), which takes pixel values as linear in the light.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EventArray
from kalux.readers import hdf5_layout
from kalux.readers.source import Source

_EVENTS: Final = "events"
_IMAGES: Final = "frame"
_STAMPS: Final = "frame_ts"


def recognises(path: Path) -> bool:
    """Whether it is an HDF5 file with a table of events in this layout."""
    if not hdf5_layout.holds(path, (_EVENTS,)):
        return False
    with hdf5_layout.opened(path) as file:
        return bool(file[_EVENTS].dtype == np.uint32) and file[_EVENTS].shape[1:] == (4,)


def read(path: Path) -> Source:
    """Open a recording that v2e has simulated (``--dvs_h5``).

    The layout has no exposure times. The sensor has the size of the frames.

    Raises
    ------
    FormatError
        If it is damaged.
    InputError
        If it cannot be read.
    """
    with hdf5_layout.opened(path) as file:
        hdf5_layout.check_dataset(path, file[_EVENTS])
        count = int(file[_EVENTS].shape[0])
        stack = hdf5_layout.find_stack(path, file, _IMAGES, _STAMPS, partial(_whole, path))
    return hdf5_layout.source_with_stack(path, "v2e", lambda: _events(path), count, stack)


def _whole(path: Path, stamps: NDArray[Any]) -> NDArray[np.int64]:
    if stamps.dtype.kind not in "iu":
        raise FormatError(f"{path}: {_STAMPS} has times of type {stamps.dtype}; whole us are needed")
    return stamps.astype(np.int64)


def _events(path: Path) -> Iterator[EventArray]:
    with hdf5_layout.opened(path) as file:
        table = file[_EVENTS]
        for part in hdf5_layout.slices(table, table.shape[0]):
            t, x, y, p = np.ascontiguousarray(table[part].T)
            yield hdf5_layout.checked_events(path, t, x, y, p)
