"""Characters of text tables, as bytes, and what both parsers of text do with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from kalux.events import EVENT_DTYPE, EventArray
from kalux.readers.source import CHUNK_EVENTS

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


# The shortest line, "0 0 0 0\n", has 8 bytes: a block holds at most CHUNK_EVENTS events.
BLOCK_BYTES: Final = 8 * CHUNK_EVENTS
LONGEST_LINE: Final = 4096
TOO_LONG: Final = -1
"""The fault of a line that is longer."""


def parsed_events(
    file: Any,
    parse: Callable[..., tuple[int, int, int, np.uint64]],
    bad_line: Callable[[int, int, str], Exception],
    *,
    lines_before: int = 0,
) -> Iterator[EventArray]:
    """The events of a text file, in bounded memory.

    Parameters
    ----------
    file
        Binary, at the beginning of a line.
    parse
        Called with a block of whole lines, whether it is the first, and the arrays t, x, y and p to be filled. Returns
        events, whole lines read, fault (0: none), start of the faulty line.
    bad_line
        The error for a line: its number, from 1, the fault, and its beginning.
    lines_before
        Lines of the file before its position.
    """
    buffer = bytearray(BLOCK_BYTES)  # used again and again: fresh memory costs as much as the parsing
    filled, is_first = 0, True
    while True:
        got = file.readinto(memoryview(buffer)[filled:])
        if not got and filled:
            buffer[filled] = NEWLINE  # the last line may lack its end
            got = 1
        if not got:
            return
        filled += got
        end = buffer.rfind(b"\n", 0, filled) + 1
        if filled - end > LONGEST_LINE:
            number = lines_before + buffer.count(b"\n", 0, end) + 1
            raise bad_line(number, TOO_LONG, _beginning(buffer, end))
        if end:
            text = np.frombuffer(buffer, np.uint8, end)
            events: EventArray = np.empty(np.count_nonzero(text == NEWLINE), EVENT_DTYPE)
            count, lines, fault, start = parse(text, is_first, *(events[name] for name in "txyp"))
            lines_before, is_first = lines_before + lines, False
            if fault:
                raise bad_line(lines_before + 1, fault, _beginning(buffer, int(start)))
            buffer[: filled - end] = buffer[end:filled]
            filled -= end
            yield events[:count]


def _beginning(buffer: bytearray, start: int) -> str:
    """Of a line, for messages."""
    line = bytes(buffer[start : start + 60]).split(b"\n", 1)[0]
    return line.decode("ascii", "replace").strip()
