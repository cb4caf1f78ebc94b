"""Characters of text tables, as bytes, and what both parsers of text do with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from kalux.events import EventArray

# Unsigned, of the width of what they are compared with: that keeps the compiled loops free of conversions and of the
# test for negative indices, and doubles their speed.
ZERO: Final = np.uint8(ord("0"))
FIVE: Final = np.uint8(5)
NINE: Final = np.uint8(9)
DOT: Final = np.uint8(ord("."))
SPACE: Final = np.uint8(ord(" "))
TAB: Final = np.uint8(ord("\t"))
RETURN: Final = np.uint8(ord("\r"))
NEWLINE: Final = np.uint8(ord("\n"))
ONE: Final = np.uint64(1)


@njit(cache=True, nogil=True, inline="always")
def skip_blanks(text: NDArray[np.uint8], i: np.uint64) -> np.uint64:
    """Skip spaces, tabs and carriage returns; not the zeros of a hole in a damaged file."""
    while text[i] == SPACE or text[i] == TAB or text[i] == RETURN:
        i += ONE
    return i


def parsed_blocks(
    file: Any,
    parse: Callable[[memoryview, int], tuple[EventArray, int]],
    too_long: Callable[[int, bytes], Exception],
    *,
    lines_before: int,
    block_bytes: int,
    longest_line: int,
) -> Iterator[EventArray]:
    """The events of a text file, in bounded memory.

    Parameters
    ----------
    file
        Binary, at the beginning of a line.
    parse
        Called with a block of whole lines and the number of lines before it; returns its events, and its lines.
    too_long
        The error for a line longer than ``longest_line``, of its number, from 1, and its beginning.
    lines_before
        Lines of the file before its position.
    block_bytes
        Read at a time.
    """
    buffer = bytearray(block_bytes)  # used again and again: fresh memory costs as much as the parsing
    filled = 0
    while True:
        got = file.readinto(memoryview(buffer)[filled:])
        if not got and filled:
            buffer[filled] = NEWLINE  # the last line may lack its end
            got = 1
        if not got:
            return
        filled += got
        end = buffer.rfind(b"\n", 0, filled) + 1
        if filled - end > longest_line:
            number = lines_before + buffer.count(b"\n", 0, end) + 1
            raise too_long(number, bytes(buffer[end:filled]))
        if end:
            events, lines = parse(memoryview(buffer)[:end], lines_before)
            buffer[: filled - end] = buffer[end:filled]
            filled -= end
            lines_before += lines
            yield events
