"""Highlights that no frame has shown yet: clipped in every frame since the start (docs/equations.md, K15).

Of such a pixel the frames and its events give a bound. How far above its bound it is, pixels tell that were like it and
have left saturation: where a frame first measures one, its distance from its bound is known. It is learned as the
recording goes on, and for every part of the image, since a window is brighter than the floor that it lights.
"""

from __future__ import annotations

import functools
from typing import Any, Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.bridge import UNMEASURED, UNSEEN, Latent, UnshownMemory

Floats = NDArray[np.floating[Any]]

_PART: Final = 8
"""Side of the parts of the image for which it is learned, pixels."""

_RANGE: Final = 8.0
"""Distance over which parts tell of each other, standard deviation of a normal curve, pixels. 6 to 16 are as good on
eleven simulated scenes (docs/tuning.md)."""

_PRIOR_PIXELS: Final = 10.0
"""Pixels that the prior counts for: little beside the tens of a part that leave saturation."""


class Unshown(NamedTuple):
    """Pixels that no frame has measured yet.

    Attributes
    ----------
    pixels
        (N,) their places in the flattened image, ascending.
    excess
        (N,) float32: how far above their bounds they are expected, log intensity; the mean, and the standard deviation
        too, of an exponential distribution.
    noise
        (N,) float32: variance of the bounds, that of the events.
    """

    pixels: NDArray[np.int64]
    excess: NDArray[np.float32]
    noise: NDArray[np.float32]


def begin_unshown(first: Latent) -> UnshownMemory:
    """What the first frame does not show."""
    height, width = first.value.shape
    parts = -(-height // _PART), -(-width // _PART)
    clipped = (first.variance >= UNMEASURED) & (first.variance < UNSEEN)
    pixels = np.flatnonzero(clipped)
    bound = first.value.reshape(-1)[pixels].astype(np.float32)
    return UnshownMemory(pixels, bound, (height, width), np.zeros(parts), np.zeros(parts))


def follow_unshown(memory: UnshownMemory, following: Latent, net: Floats) -> UnshownMemory:
    """After the next frame; ``net``, (H, W), is what events add to L between the two.

    A pixel that is measured below its bound was at it: events are not exact.
    """
    pixels = memory.pixels
    if len(pixels) == 0:
        return memory
    predicted = memory.bound + net.reshape(-1)[pixels].astype(np.float32)
    value, variance = following.value.reshape(-1)[pixels], following.variance.reshape(-1)[pixels]
    measured = variance < UNMEASURED
    bounded = np.where(variance < UNSEEN, np.maximum(predicted, value), predicted)
    row, column = np.divmod(pixels[measured], memory.shape[1])
    parts = memory.told.shape
    part = row // _PART * parts[1] + column // _PART
    excess = np.maximum(value[measured] - predicted[measured], np.float32(0.0))
    told = np.bincount(part, excess, memory.told.size).reshape(parts)
    tellers = np.bincount(part, minlength=memory.told.size).reshape(parts)
    return memory._replace(
        pixels=pixels[~measured],
        bound=bounded[~measured],
        told=memory.told + told,
        tellers=memory.tellers + tellers,
    )


def expected_excess(
    memory: UnshownMemory, variance: Floats, initial_variance: float, prior: float
) -> Unshown | None:
    """How far pixels are expected above their bounds, from what others around have told; None: there are none.

    Parameters
    ----------
    memory
        Which pixels, and what has been told.
    variance, initial_variance
        (H, W) P, and what it began as: what has come to it is noise of the events.
    prior
        What is expected where no pixel has told, log intensity.
    """
    if len(memory.pixels) == 0:
        return None
    rows, columns = (_nearness(n) for n in memory.told.shape)
    told, tellers = (rows @ values @ columns for values in (memory.told, memory.tellers))
    mean = np.maximum((told + _PRIOR_PIXELS * prior) / (tellers + _PRIOR_PIXELS), 0.0)
    excess, noise = np.empty((2, len(memory.pixels)), np.float32)
    flat = variance.reshape(-1)
    _at_pixels(
        memory.pixels,
        memory.shape[1],
        mean.astype(np.float32),
        flat,
        np.float32(initial_variance),
        excess,
        noise,
    )
    return Unshown(memory.pixels, excess, noise)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _at_pixels(pixels, width, mean, variance, initial_variance, excess, noise):  # type: ignore[no-untyped-def]
    """The ``mean`` of the parts, linear between their middles, and what has come to the variance."""
    one, zero = np.float32(1.0), np.float32(0.0)
    last_row, last_column = mean.shape[0] - 1, mean.shape[1] - 1
    for i in range(len(pixels)):
        row, column = divmod(pixels[i], width)
        y = max((np.float32(row) + np.float32(0.5)) / np.float32(_PART) - np.float32(0.5), zero)
        x = max((np.float32(column) + np.float32(0.5)) / np.float32(_PART) - np.float32(0.5), zero)
        top, left = min(int(y), last_row), min(int(x), last_column)
        below, beside = min(top + 1, last_row), min(left + 1, last_column)
        down, right = y - np.float32(top), x - np.float32(left)
        upper = mean[top, left] * (one - right) + mean[top, beside] * right
        lower = mean[below, left] * (one - right) + mean[below, beside] * right
        excess[i] = upper * (one - down) + lower * down
        noise[i] = max(np.float32(variance[pixels[i]]) - initial_variance, zero)


@functools.cache
def _nearness(parts: int) -> Floats:
    """(parts, parts): weights of parts for each other along one side. Not to be changed."""
    distance = _PART * np.subtract.outer(np.arange(parts), np.arange(parts))
    nearness: Floats = np.exp(-0.5 * (distance / _RANGE) ** 2)
    return nearness
