"""By how much neighbours differ on the surfaces that frames show (docs/equations.md, K12)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.bridge import UNMEASURED, Latent
from kalux.augmentation.parts import PART, interpolated_plane, part_grid, weighted_sums
from kalux.compiled import empty, larger, loop, smaller

Floats = NDArray[np.floating[Any]]

_PRIOR_PAIRS: Final = 6.0
"""Pairs of pixels, one apart and exactly known, as which the usual variance counts."""

_LEAST: Final = 0.1
"""Least standard deviation of neighbours' differences, in units of the usual one: of no surface is it known that it is
even."""

INDEPENDENT: Final = np.float32(0.7)
"""Part of the variances of two neighbours that is in their difference: their errors have correlations of 0.1 to 0.5."""

_MOVED: Final = np.float32(0.5)
"""Events of a pixel since the frame before, as far as they are signal, from which on it has moved: what stands still
may be of another texture than what passes before it."""

_FARTHEST: Final = 6
"""Parts on one side, with the one itself, that count for each other: farther ones have less than 1e-7 of its weight."""


class Texture(NamedTuple):
    """What pairs of neighbours tell of the variance by which neighbours one apart differ, summed by parts of the image.

    Attributes
    ----------
    excess
        By how much their squared differences are more than their own variances explain, each by how much it tells.
    certainty
        What that would be of a variance of 1.
    """

    excess: Floats
    certainty: Floats


def frame_texture(latent: Latent, events: Floats, usual: float, pitch: int) -> Texture:
    """What the neighbours of a deblurred frame tell, ``pitch`` pixels apart, of which both move.

    With e the difference of two neighbours at distance d, V and V' their variances, and E = V + V' + d^2 ``usual``: the
    sums of d^2 (e^2 - 0.7 (V + V')) / E^2 and of d^4 / E^2. Clipped pixels are in neither.

    Parameters
    ----------
    latent
        The frame.
    events
        (H, W) of every pixel since the frame before, as far as they are signal.
    usual
        Variance by which neighbours one apart usually differ, log intensity^2.
    pitch
        Distance of the neighbours, pixels.
    """
    excess, certainty = np.zeros((2, *part_grid(latent.value.shape)))
    planes = (np.ascontiguousarray(plane, np.float32) for plane in (*latent[:2], events))
    _add_pairs(*planes, np.float32(usual), pitch, excess, certainty)
    return Texture(excess, certainty)


def neighbour_variance(textures: Sequence[Texture], usual: float, most: float = 1.0) -> NDArray[np.float32]:
    """Of every part of an image, the variance by which neighbours one apart differ, by what textures of it tell.

    It lies between 0.01 and ``most``^2 times the ``usual`` one, which counts as six exact pairs more.
    """
    prior = _PRIOR_PAIRS / usual**2
    excess, certainty = (sum(sums) for sums in zip(*textures, strict=True))
    found = (weighted_sums(excess, _FARTHEST) + prior * usual) / (weighted_sums(certainty, _FARTHEST) + prior)
    return np.clip(found, _LEAST**2 * usual, most**2 * usual).astype(np.float32)


def shown_texture(textures: Sequence[Texture], frames: Sequence[Latent], usual: float) -> NDArray[np.float32]:
    """(H, W) the variance by which neighbours one apart differ: by the ``textures`` of the ``frames`` around an image.

    It is the geometric mean of what these show and of the ``usual`` one. Of pixels that one of the frames does not
    measure the latter alone: lamps are small, and no frame shows their texture.
    """
    parts = np.sqrt(neighbour_variance(textures, usual) * np.float32(usual))
    shown = interpolated_plane(parts, frames[0].value.shape)
    for frame in frames:
        _leave_usual(frame.variance.reshape(-1), np.float32(usual), shown.reshape(-1))
    return shown


@loop
def _add_pairs(value, variance, events, usual, pitch, excess, certainty):  # type: ignore[no-untyped-def]
    height, width = value.shape
    more, sure = empty(width, np.float32), empty(width, np.float32)
    for row in range(height):
        for k in range(4):  # beside it, and the three below
            down, right = (0, pitch) if k == 0 else (pitch, (k - 2) * pitch)
            other = row + down
            if other >= height:
                continue
            first, count = larger(-right, 0), width - larger(right, -right)
            distance2 = np.float32(down * down + right * right)
            at, beside, start, shift = np.uint64(row), np.uint64(other), np.uint64(first), np.int64(right)
            for i in range(np.uint64(larger(count, 0))):
                one, two = start + i, np.uint64(np.int64(start + i) + shift)
                explained = variance[at, one] + variance[beside, two]
                expected = explained + usual * distance2
                difference = value[beside, two] - value[at, one]
                moves = smaller(events[at, one], events[beside, two]) >= _MOVED
                weight = distance2 / (expected * expected) if moves else np.float32(0.0)
                more[i] = weight * (difference * difference - INDEPENDENT * explained)
                sure[i] = weight * distance2
            for part in range(excess.shape[1]):
                begin = larger(part * PART - first, 0)
                for i in range(begin, smaller((part + 1) * PART - first, count)):
                    excess[row // PART, part] += np.float64(more[i])
                    certainty[row // PART, part] += np.float64(sure[i])


@loop
def _leave_usual(variance, usual, shown):  # type: ignore[no-untyped-def]
    for i in range(len(shown)):
        shown[i] = shown[i] if variance[i] < np.float32(UNMEASURED) else usual
