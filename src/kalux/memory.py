"""Arrays aligned to pages; the memory of large ones is reused, since fresh pages cost about as much as filling them.

The engine makes and drops the same planes frame after frame. Whether the system's allocator keeps such memory depends
on the system, the thread, and what else is allocated at that moment.
"""

from __future__ import annotations

import ctypes
import functools
import math
import os
import sys
import threading
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

PAGE: Final = 4096
"""Bytes of a page of memory: all arrays begin with one. NumPy's commonly begin 16 bytes after a cache line, so that
every other record of 32 bytes lies in two lines: the filter then takes 1.35 times as long, and EDI 1.8 times."""

_SMALL: Final = 1 << 16
"""Bytes below which the usual allocator is as good."""

MOST_FREE: Final = 64 << 20
"""Most bytes of free memory that are kept: at 640x480 a segment ends with 50 MB. With 128 MB a run is not faster, but
its memory grows by the difference; with 96 MB a photograph panned before it holds 12 MB more."""

_ARENA_MAX: Final = -8
"""M_ARENA_MAX of glibc's malloc.h."""


class _Free:
    """Free pieces of memory, by their sizes in bytes, of which there are eight between two powers of two."""

    def __init__(self) -> None:
        # Reentrant: while a thread holds it, Python may collect an array, whose memory is then given back.
        self._lock = threading.RLock()
        self._pieces: dict[int, list[NDArray[np.uint8]]] = {}
        self.total = 0

    def take(self, least: int) -> NDArray[np.uint8]:
        """A piece of ``least`` bytes or up to an eighth more, the rest of which is never touched."""
        step = 1 << (least.bit_length() - 4)
        size = -(-least // step) * step
        with self._lock:
            pieces = self._pieces.get(size)
            if pieces:
                self.total -= size
                return pieces.pop()
        return _fresh(size)

    def give(self, piece: NDArray[np.uint8], most: int = MOST_FREE) -> None:
        """Keep a piece for reuse, if there is room for it in ``most`` bytes.

        ``most`` is a default argument because arrays are also collected at Python's exit, after the module's names.
        """
        with self._lock:
            if self.total + piece.size > most:  # of another sensor, most likely
                self._pieces.clear()
                self.total = 0
            if piece.size <= most:
                self._pieces.setdefault(piece.size, []).append(piece)
                self.total += piece.size


def _fresh(size: int) -> NDArray[np.uint8]:
    """Memory that begins with a page."""
    piece = np.empty(size + PAGE, np.uint8)
    first = -piece.ctypes.data % PAGE
    return piece[first : first + size]


_free: Final = _Free()


class _Lent:
    """What arrays over a piece of memory hold on to, so that it comes back with the last of them.

    A mixin of ctypes' arrays, which NumPy takes a tenth of the time to look into that it takes for other objects, and
    which it does not leave out for what is below, as it does with arrays of its own.
    """

    piece: NDArray[np.uint8] | None = None  # where an interrupt comes before it is known
    give: Callable[[NDArray[np.uint8]], None]

    def __del__(self) -> None:
        if self.piece is not None:
            self.give(self.piece)


@functools.cache
def _lent_bytes(size: int) -> Any:
    return type("_LentBytes", (_Lent, ctypes.c_uint8 * size), {})


def empty(shape: tuple[int, ...], dtype: Any = np.float32) -> NDArray[Any]:
    """As ``numpy.empty``, in memory that an array of about the same size may have used before. For any thread."""
    kind = np.dtype(dtype)
    size = math.prod(shape) * kind.itemsize
    lent: Any
    if size < _SMALL:
        lent = _fresh(size)
    else:
        piece = _free.take(size)
        lent = _lent_bytes(len(piece)).from_buffer(piece)
        lent.give, lent.piece = _free.give, piece
    array: NDArray[Any] = np.ndarray(shape, kind, lent)
    return array


def share_arena() -> None:
    """Have all threads take memory from one arena of the system's allocator, if the user has not chosen their number.

    glibc gives each thread an arena of its own, what is free in one of which no other thread gets. With one, 4 s of a
    photograph panned before 640x480 hold 580 instead of 640 MB, and take as long. It holds for the whole process and
    is not undone, so that it is for programs, and not for a library, to ask for. Elsewhere nothing is done.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None and "MALLOC_ARENA_MAX" not in os.environ:
        mallopt(_ARENA_MAX, 1)


def give_back() -> None:
    """Have the system's allocator give back the memory that it holds and nobody uses.

    glibc's keeps what lies below something that is still used: after planning that is 90 MB of a run at 640x480, in 12
    ms. Elsewhere nothing is done.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
