"""Percentiles of many intensities, without putting them in order."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from kalux.compiled import empty, loop, zeros
from kalux.display.intensities import LARGEST, Float32, Statistics

SAMPLES: Final = 1 << 14
"""So many pixels tell the percentiles of an image, as far as a picture shows them: in 120 images of newton and street,
no pixel of a video is 0.3 of its 255 levels off what all pixels would make of it."""

_COARSE_BITS: Final = 20
"""The exponent and four bits more are what is left of a positive float32 without its last ones: in the order of the
numbers themselves, and 4096 at most."""

_LARGEST_BITS: Final = np.float32(LARGEST).view(np.int32)


def sampled(intensity: Float32) -> Float32:
    """A regular grid of pixels: all, or at least `SAMPLES` of them."""
    step = max(1, math.isqrt(intensity.shape[0] * intensity.shape[1] // SAMPLES))
    return intensity[::step, ::step]


def percentiles(values: Float32, percents: list[float]) -> Statistics:
    """Percentiles of values in rows, wherever they lie, linear between the two nearest of them.

    The values are finite; those below 0 count as 0, those above `LARGEST` as that.
    """
    bits = np.empty(values.size + 1, np.int32)
    # Numbers of Python: NumPy takes longer for a few than the loops for all of the sample.
    positions = [percent / 100 * (values.size - 1) for percent in percents]
    ranks = [rank for position in positions for rank in (math.floor(position), math.ceil(position))]
    # Few numbers are left to be put in order: those that share their first bits with one that is looked for.
    order = sorted(range(len(ranks)), key=ranks.__getitem__)
    places, count = _narrowed(values.view(np.int32), np.array(ranks), np.array(order), bits)
    ordered = np.partition(bits[:count], places)[places].view(np.float32).tolist()
    found = [
        low + (position - math.floor(position)) * (high - low)
        for position, low, high in zip(positions, ordered[::2], ordered[1::2], strict=True)
    ]
    return np.array(found)


@loop
def _narrowed(rows, ranks, order, bits):  # type: ignore[no-untyped-def]
    """The numbers among which those of some ranks are, in ``bits``, with room for one more; their places, and how many.

    ``order`` is that of the ranks, from the lowest to the highest.

    Numbers are compared by their bits: as float32 that are not negative, they are in the same order.
    """
    counts = zeros((4, 1 << (31 - _COARSE_BITS)), np.int32)  # four, so that equal neighbours need not wait
    height, width = rows.shape
    at = np.uint64(0)
    for row in range(height):
        for column in range(width):
            value = rows[row, column]
            value = value if value > np.int32(0) else np.int32(0)
            value = value if value < _LARGEST_BITS else _LARGEST_BITS
            bits[at] = value
            counts[at & np.uint64(3), np.uint64(value) >> np.uint64(_COARSE_BITS)] += 1
            at += np.uint64(1)
    total = counts[0]
    for i in range(len(total)):
        total[i] += counts[1, i] + counts[2, i] + counts[3, i]
    wanted = zeros(len(total), np.uint8)
    places = empty(len(ranks), np.int64)
    below, kept, part = np.int64(0), np.int64(0), 0
    for k in order:
        while below + total[part] <= ranks[k]:
            below += total[part]
            kept += total[part] * np.int64(wanted[part])
            part += 1
        wanted[part] = 1
        places[k] = kept + ranks[k] - below
    found = np.uint64(0)
    for i in range(np.uint64(at)):
        value = bits[i]
        bits[found] = value  # never behind what is still to be read
        found += np.uint64(wanted[np.uint64(value) >> np.uint64(_COARSE_BITS)])
    return places, found
