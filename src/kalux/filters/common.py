"""What the filter loops share: clocks of the pixels."""

from __future__ import annotations

from typing import Final

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux import memory
from kalux.compiled import larger, largest_around, loop, smaller

MICROSECOND: Final = 1e-6
"""Seconds."""

Clock = NDArray[np.int32]
"""(H + 2, W + 2) int32: time of every pixel's newest event, us after an origin kept beside it. The frame of one pixel
around the sensor has never seen an event, so that neighbourhoods need no special case at the border."""

EPOCH: Final = 1 << 30
"""Span of a clock, us (18 minutes): the origin moves on before an int32 overflows. An event older than one epoch
may count as that old; the probability that its successor is signal (K5) is below 1e-4 either way at the usual noise
rates."""

NEVER: Final = np.int32(-EPOCH)


def make_clock(shape: tuple[int, int], since: int) -> Clock:
    """A clock on which every pixel of the sensor had an event ``since`` us before the origin."""
    clock = np.full((shape[0] + 2, shape[1] + 2), NEVER, np.int32)
    clock[1:-1, 1:-1] = -min(since, EPOCH)
    return clock


def moved_clock(clock: Clock, span: int) -> Clock:
    """The clock with its origin ``span`` us later."""
    moved: Clock = memory.empty(clock.shape, np.int32)
    _move(clock.reshape(-1), span, moved.reshape(-1))
    return moved


@loop
def _move(clock, span, moved):  # type: ignore[no-untyped-def]
    for i in range(len(clock)):
        moved[i] = larger(clock[i] - span, NEVER)


@nb.njit(cache=True, inline="always")
def newest_around(newest, row, column):  # type: ignore[no-untyped-def]
    """Time (us) of the newest event in the 3x3 pixels around and including one; clipped at the border.

    The paper leaves N(p) open; the released code uses these nine.
    """
    height, width = newest.shape
    latest = newest[row, column]
    for i in range(larger(row - 1, 0), smaller(row + 2, height)):
        for j in range(larger(column - 1, 0), smaller(column + 2, width)):
            latest = larger(latest, newest[i, j])
    return latest


@nb.njit(cache=True, inline="always")
def newest_around_inside(clock, at, stride):  # type: ignore[no-untyped-def]
    """As `newest_around`, of a flat `Clock` with rows of ``stride``, by a pixel's index in it."""
    return largest_around(clock, at, stride)
