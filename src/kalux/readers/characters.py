"""Characters of text tables, as bytes, and what both parsers of text do with them."""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

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
