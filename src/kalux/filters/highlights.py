"""Read-out of highlights that no frame has shown yet (docs/equations.md, K13)."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.highlights import Unshown

Floats = NDArray[np.floating[Any]]

_LEAST_SPREAD: Final = 0.3
"""Standard deviation that is left where pixels around say that all lie just above their bounds."""


def event_noise(variance: Floats, unshown: Unshown, initial_variance: float) -> Floats:
    """(N,) what events have added to P, (H, W), which began as ``initial_variance``."""
    added: Floats = variance.reshape(-1)[unshown.pixels] - np.float32(initial_variance)
    return np.maximum(added, np.float32(0.0))


def lift_to_expected(log_intensity: Floats, variance: Floats, unshown: Unshown, noise: Floats) -> None:
    """From its bound, (H, W), to where a pixel is expected, with the variance of that. In place.

    ``noise`` is that of `event_noise`.
    """
    log_intensity.reshape(-1)[unshown.pixels] += unshown.excess
    spread = np.maximum(unshown.excess, np.float32(_LEAST_SPREAD))
    variance.reshape(-1)[unshown.pixels] = spread**2 + noise


def lift_to_mean(
    log_intensity: Floats, variance: Floats, bound: Floats, unshown: Unshown, noise: Floats
) -> None:
    """From there, after neighbours were heard (K12), to the log of the *mean* intensity: half the variance more.

    The bound, (H, W), still holds. The variance that is left is that of the events, by which the prior on highlights
    (K6) is to doubt them. In place.
    """
    level, bounds = log_intensity.reshape(-1), bound.reshape(-1)
    pixels = unshown.pixels
    level[pixels] = np.maximum(level[pixels], bounds[pixels]) + unshown.excess**2 / 2
    variance.reshape(-1)[pixels] = noise


def smoothed_unshown(forward: Unshown | None, backward: Unshown | None) -> Unshown | None:
    """Pixels that no frame of the recording measures; of what both directions expect, the mean."""
    if forward is None or backward is None:
        return None
    pixels, first, second = np.intersect1d(
        forward.pixels, backward.pixels, assume_unique=True, return_indices=True
    )
    return Unshown(pixels, (forward.excess[first] + backward.excess[second]) / 2)


def only_bounded(unshown: Unshown | None, other: Unshown | None) -> NDArray[np.int64]:
    """Places of pixels of which one direction knows no more than a bound, and the other more."""
    if unshown is None:
        return np.empty(0, np.int64)
    return unshown.pixels if other is None else np.setdiff1d(unshown.pixels, other.pixels, assume_unique=True)
