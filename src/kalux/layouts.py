"""What the reader and the writer of a format both have to know of it."""

from __future__ import annotations

import struct
from typing import Any, Final

import numpy as np

HDF5_MAJOR_VERSION: Final = 1
"""Of kalux HDF5. Files with a greater one are refused; a minor version only adds."""

HDF5_VERSION: Final = f"{HDF5_MAJOR_VERSION}.3"
"""That is written."""

HDF5_COLUMNS: Final = ("t", "x", "y", "p")
"""The data sets of events."""

AEDAT4_MAGIC: Final = b"#!AER-DAT4.0\r\n"
"""The first bytes of a file."""

AEDAT4_PACKET: Final = struct.Struct("<ii")
"""Before every packet: stream, size in bytes."""

AEDAT4_PIXELS: Final[dict[int, tuple[np.dtype[Any], int]]] = {
    0: (np.dtype("u1"), 1),
    2: (np.dtype("<u2"), 1),
    16: (np.dtype("u1"), 3),
    18: (np.dtype("<u2"), 3),
    24: (np.dtype("u1"), 4),
    26: (np.dtype("<u2"), 4),
}
"""OpenCV's numbers of pixel types: 8 or 16 bits, one channel, BGR or BGRA."""
