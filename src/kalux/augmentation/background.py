"""Which share of a pixel's events is signal: what its neighbours' events say (docs/equations.md, K5).

Background noise adds to the events of a pixel a number that is Poisson distributed and independent of all else. If p(a)
is the distribution of a pixel's events of one polarity in an interval, among pixels whose neighbours have as many as
its own have, then of a events the share

    (m / a) p(a - 1) / p(a)

is noise, where m is expected of it (Robbins 1956: nothing is assumed of the signal). p is counted in the image itself:
where neighbours are silent, most pixels with one event have it from noise; where they are not, few have none.
"""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.compiled import apart, loop, smaller

Floats = NDArray[np.floating[Any]]

_MOST: Final = 6
"""Events of a pixel from which on one more or less is as likely, so that m / a is left."""

_EXACT: Final = 4
"""Events of the neighbours up to which every number is a class of its own; then half octaves are."""

_CLASSES: Final = 25
"""Of the neighbours' events: up to 4096."""

_PRIOR_PIXELS: Final = 4.0
"""Pixels by which every number is as likely as the next, beside those counted: a class with few says little."""


def signal_shares(on: Floats, off: Floats, expected: float) -> tuple[Floats, Floats]:
    """Probability that an event of a pixel is signal, of on and of off events: (H, W) float32 each.

    Parameters
    ----------
    on, off
        (H, W) events of each polarity in an interval (sums of their weights, K13).
    expected
        Noise events of a pixel in that time, of both polarities.
    """
    planes = tuple(np.rint(counts).astype(np.float32) for counts in (on, off))
    around = tuple(_around(counts) for counts in planes)
    pixels = np.full((_CLASSES, _MOST), _PRIOR_PIXELS)
    for counts, near in zip(planes, around, strict=True):
        _count(counts.reshape(-1), near.reshape(-1), _OF_NUMBER, pixels)
    own = np.arange(1, _MOST)
    noise = np.minimum(expected / 2.0 / own * pixels[:, :-1] / pixels[:, 1:], 1.0)
    signal = np.ones((_CLASSES, _MOST), np.float32)  # also of no event
    signal[:, 1:] = 1.0 - np.minimum.accumulate(noise, axis=1)  # no less for more events
    shares = apart(2, on.shape)
    for counts, near, share in zip(planes, around, shares, strict=True):
        half = np.float32(expected / 2.0)
        _look_up(counts.reshape(-1), near.reshape(-1), _OF_NUMBER, signal, half, share.reshape(-1))
    return shares[0], shares[1]


def doubt(shares: tuple[Floats, Floats], step_variance: float, threshold2: float) -> tuple[Floats, Floats]:
    """Of on and of off events, by how much the variance of a step is more than a sure event's, q c^2 (K5): (H, W) each.

    An event that is signal with probability f has f (q + 1 - f) c^2. ``step_variance`` is q c^2, ``threshold2`` c^2.
    """
    c2, q = np.float32(threshold2), np.float32(step_variance / threshold2)
    on, off = (c2 * (np.float32(1.0) - f) * (f - q) for f in shares)
    return on, off


def _around(counts: NDArray[np.float32]) -> NDArray[np.float32]:
    """Events of the 24 pixels around each, those of the 8 nearest twice."""
    nearest, near = (
        cv2.boxFilter(counts, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for side in (3, 5)
    )
    return np.asarray(nearest + near - 2.0 * counts, np.float32)


def _classes() -> NDArray[np.int64]:
    """The class of every number of the neighbours' events."""
    numbers = np.arange(_EXACT, 2 ** (_CLASSES // 2) + 1)
    return np.concatenate([np.arange(_EXACT), np.floor(2.0 * np.log2(numbers)).astype(np.int64)])


_OF_NUMBER: Final = _classes()


@loop
def _count(counts, near, classes, pixels):  # type: ignore[no-untyped-def]
    """Add the pixels to their classes, by their own events: up to one less than counted."""
    most, last = np.int64(pixels.shape[1]), np.int64(len(classes) - 1)
    for i in range(len(counts)):
        own = np.int64(counts[i])
        if own < most:
            pixels[classes[smaller(np.int64(near[i]), last)], own] += 1.0


@loop
def _look_up(counts, near, classes, signal, expected, shares):  # type: ignore[no-untyped-def]
    most, last, one = np.int64(signal.shape[1]), np.int64(len(classes) - 1), np.float32(1.0)
    for i in range(len(counts)):
        own = np.int64(counts[i])
        if own < most:
            shares[i] = signal[classes[smaller(np.int64(near[i]), last)], own]
        else:
            shares[i] = one - smaller(expected / counts[i], one)
