"""What the filter loops share."""

from __future__ import annotations

import numba as nb

MICROSECOND = 1e-6


@nb.njit(cache=True, inline="always")
def newest_around(newest, row, column):  # type: ignore[no-untyped-def]
    """Time (us) of the newest event in the 3x3 pixels around and including one; clipped at the border.

    The paper leaves N(p) open; the released code uses these nine.
    """
    height, width = newest.shape
    latest = newest[row, column]
    for i in range(max(row - 1, 0), min(row + 2, height)):
        for j in range(max(column - 1, 0), min(column + 2, width)):
            latest = max(latest, newest[i, j])
    return latest
