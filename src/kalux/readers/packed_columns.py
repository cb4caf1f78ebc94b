"""The columns of events as `kalux.readers.hdf5` packs them, unpacked straight into events: two thirds of HDF5's time.

HDF5 would unpack a chunk of a column, copy it, and leave the columns to be joined. Here LZ4 unpacks planes of bytes or
bits, and one loop makes events of them. What is unpacked is what the file holds: its checksum is that of HDF5's filter
Fletcher32. A chunk that is anything but what kalux writes, or damaged, is left to HDF5, which can say what is wrong.

The layout is that of Blosc 1 (github.com/Blosc/c-blosc, README_CHUNK_FORMAT.rst): a header, then the planes of a block,
with bits of bitshuffle (github.com/kiyo-masui/bitshuffle), each after its length.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, Final, Self

import lz4.block
import numba as nb
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

_BLOSC, _FLETCHER = 32001, 3  # numbers of HDF5's filters
_HEADER: Final = struct.Struct(
    "<BBBBIII"
)  # version, of the codec, flags, bytes of a number, of all, of a block, packed
_LENGTH: Final = struct.Struct("<i")
_CHECKSUM: Final = struct.Struct("<I")
_VERSION: Final = 2
_BYTES, _BITS = 0b001, 0b100  # how planes are made
_WHOLE, _LZ4 = 0b10000, 1 << 5  # planes not apart; the codec, in the upper three bits
_LEAST: Final = 128  # numbers of a block; planes of fewer are not apart
_MOST: Final = 1 << 22  # numbers for which memory is taken

_NUMBERS: Final = (("<i8", _BYTES), ("<u2", _BITS), ("<u2", _BITS), ("|b1", _BITS))
"""Of the columns t, x, y and p."""

_ODD: Final = (OSError, RuntimeError, ValueError, KeyError, struct.error, lz4.block.LZ4BlockError)
"""What a chunk that is not there, cut short or damaged may raise."""


class PackedColumns:
    """The columns t, x, y and p of a file, in chunks of ``length`` events."""

    def __init__(self, columns: Sequence[Any], length: int) -> None:
        self._columns = columns
        self._length = length
        self._work = np.empty((5, length // 8), np.uint64)

    @classmethod
    def of(cls, columns: Sequence[Any]) -> Self | None:
        """Those of four datasets of h5py, in this order; None where they are not as kalux writes them."""
        chunks = columns[0].chunks
        if chunks is None or chunks[0] % 8 or not _LEAST <= chunks[0] <= _MOST:
            return None
        for column, (kind, _) in zip(columns, _NUMBERS, strict=True):
            filters = column.id.get_create_plist()
            codes = [filters.get_filter(k)[0] for k in range(filters.get_nfilters())]
            if column.chunks != chunks or column.dtype != np.dtype(kind) or codes != [_BLOSC, _FLETCHER]:
                return None
        return cls(columns, chunks[0])

    def unpack(self, start: int, words: NDArray[np.int64]) -> bool:
        """Fill events' ``words`` (`kalux.compiled.event_words`) from the chunk that begins with event ``start`` on.

        False: it is not as expected, or damaged, and the words are not to be used.
        """
        planes = []
        try:
            for column, (kind, flags) in zip(self._columns, _NUMBERS, strict=True):
                mask, chunk = column.id.read_direct_chunk((start,))
                found = None if mask else _planes(chunk, np.dtype(kind).itemsize, flags, self._length)
                if found is None:
                    return False
                planes.append(found)
        except _ODD:
            return False
        t, x, y, p = planes
        _join(t, x, y, p, self._work, self._work.view(np.uint8), words)
        return True


def _planes(chunk: bytes, size: int, flags: int, length: int) -> tuple[Bytes, ...] | None:
    """The planes of ``length`` numbers of ``size`` bytes each: as many, of a byte, or of 8 bits one after the other."""
    data = memoryview(chunk)[: -_CHECKSUM.size]
    version, _, found, number, total, block, packed = _HEADER.unpack_from(data)
    if (version, found & ~_WHOLE, number, total, block) != (
        _VERSION,
        flags | _LZ4,
        size,
        size * length,
        total,
    ):
        return None
    if packed != len(data) or _CHECKSUM.unpack_from(chunk, len(data))[0] != _checksum(data):
        return None
    count = 1 if found & _WHOLE else size
    at, planes = _LENGTH.unpack_from(data, _HEADER.size)[0], []
    for _ in range(count):
        stored = _LENGTH.unpack_from(data, at)[0]
        at += _LENGTH.size
        part, at = data[at : at + stored], at + stored
        plane = part if stored == total // count else lz4.block.decompress(part, total // count)
        if len(plane) != total // count:
            return None
        planes.append(np.frombuffer(plane, np.uint8))
    return tuple(planes) if count == size else tuple(planes[0].reshape(size, length))


def _checksum(data: memoryview) -> int:
    """HDF5's Fletcher32, of big-endian numbers of 16 bits; a last byte counts as the first of two."""
    even = len(data) // 2 * 2
    first, second = _sums(np.frombuffer(data[:even], "<u2"))
    first, second = int(first), int(second)
    if even < len(data):
        first += data[even] << 8
        second += first
    # Folded as HDF5 does, what is not 0 never becomes 0.
    return _folded(second) << 16 | _folded(first)


def _folded(total: int) -> int:
    return (total - 1) % 65535 + 1 if total else 0


@nb.njit(cache=True, nogil=True)
def _sums(words):  # type: ignore[no-untyped-def]
    """The sum of the numbers, and that of the sums after each."""
    first, second = np.uint64(0), np.uint64(0)
    for begin in range(0, len(words), 256):  # whose sums are uint32
        end = min(begin + 256, len(words))
        count = np.uint32(end - begin)
        plain, weighted = np.uint32(0), np.uint32(0)
        for i in range(count):
            word = np.uint32(words[np.uint64(begin) + np.uint64(i)])
            swapped = np.uint32((word & np.uint32(0xFF)) << np.uint32(8)) | np.uint32(word >> np.uint32(8))
            plain = np.uint32(plain + swapped)
            weighted = np.uint32(weighted + np.uint32(swapped * np.uint32(count - np.uint32(i))))
        second += first * np.uint64(count) + np.uint64(weighted)
        first += np.uint64(plain)
    return first, second


@nb.njit(cache=True, nogil=True)
def _join(t, x, y, p, work, of_bytes, words):  # type: ignore[no-untyped-def]
    """Events of planes: t of bytes, the others of bits; ``work`` is for their bytes, also as ``of_bytes``."""
    _to_bytes(x[0], work[0])
    _to_bytes(x[1], work[1])
    _to_bytes(y[0], work[2])
    _to_bytes(y[1], work[3])
    _to_bytes(p[0], work[4])
    base, changing = np.int64(0), 0
    for k in range(3, 8):
        if _is_constant(t[k]):
            base |= np.int64(np.uint64(t[k][0]) << np.uint64(8 * k))
        else:
            changing += 1
    if changing == 0:
        for i in range(np.uint64(len(words))):
            low = np.int64(t[0][i]) | np.int64(t[1][i]) << np.int64(8) | np.int64(t[2][i]) << np.int64(16)
            words[i, 0] = base | low
    else:
        for i in range(np.uint64(len(words))):
            value = np.uint64(0)
            for k in range(8):
                value |= np.uint64(t[k][i]) << np.uint64(8 * k)
            words[i, 0] = np.int64(value)
    for i in range(np.uint64(len(words))):
        column = np.int64(of_bytes[0, i]) | np.int64(of_bytes[1, i]) << np.int64(8)
        row = np.int64(of_bytes[2, i]) | np.int64(of_bytes[3, i]) << np.int64(8)
        words[i, 1] = column | row << np.int64(16) | np.int64(of_bytes[4, i] != 0) << np.int64(32)


@nb.njit(cache=True, inline="always")
def _is_constant(plane):  # type: ignore[no-untyped-def]
    first, differs = plane[0], np.uint8(0)
    for i in range(len(plane)):
        differs |= plane[i] ^ first
    return differs == 0


@nb.njit(cache=True, inline="always")
def _to_bytes(plane, numbers):  # type: ignore[no-untyped-def]
    """Eight rows of bits to bytes, eight in each of ``numbers``: matrices of 8 x 8 bits, transposed (Warren 2013)."""
    count = np.uint64(len(numbers))
    for i in range(count):
        v = np.uint64(plane[i])
        for k in range(1, 8):
            v |= np.uint64(plane[np.uint64(k) * count + i]) << np.uint64(8 * k)
        s = (v ^ (v >> np.uint64(7))) & np.uint64(0x00AA00AA00AA00AA)
        v ^= s ^ (s << np.uint64(7))
        s = (v ^ (v >> np.uint64(14))) & np.uint64(0x0000CCCC0000CCCC)
        v ^= s ^ (s << np.uint64(14))
        s = (v ^ (v >> np.uint64(28))) & np.uint64(0x00000000F0F0F0F0)
        numbers[i] = v ^ (s ^ (s << np.uint64(28)))
