"""Read-out of highlights that no frame has shown yet (docs/equations.md, K13)."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.highlights import Unshown

Floats = NDArray[np.floating[Any]]

_LEAST_SPREAD: Final = np.float32(0.3)
"""Standard deviation that is left where pixels around say that all lie just above their bounds."""


def lift_to_expected(log_intensity: Floats, variance: Floats, unshown: Unshown) -> None:
    """From its bound, (H, W), to where a pixel is expected, with the variance of that. In place."""
    log_intensity.reshape(-1)[unshown.pixels] += unshown.excess
    variance.reshape(-1)[unshown.pixels] = np.maximum(unshown.excess, _LEAST_SPREAD) ** 2 + unshown.noise


def mean_level(log_intensity: Floats, bound: Floats, unshown: Unshown) -> Floats:
    """(N,) log of the *mean* intensity of these pixels: half the variance more than the mean of the log.

    Parameters
    ----------
    log_intensity
        (H, W) L of `lift_to_expected`, after neighbours were heard (K12).
    bound
        (H, W) as before: it still holds.
    """
    pixels = unshown.pixels
    level = np.maximum(log_intensity.reshape(-1)[pixels], bound.reshape(-1)[pixels])
    mean: Floats = level + unshown.excess**2 / np.float32(2.0)
    return mean


def smoothed_unshown(forward: Unshown | None, backward: Unshown | None) -> Unshown | None:
    """Pixels that no frame of the recording measures; of what both directions expect, the mean."""
    if forward is None or backward is None:
        return None
    pixels, first, second = np.intersect1d(
        forward.pixels, backward.pixels, assume_unique=True, return_indices=True
    )
    excess = (forward.excess[first] + backward.excess[second]) / np.float32(2.0)
    return Unshown(pixels, excess, np.minimum(forward.noise[first], backward.noise[second]))


def obey_bounds(
    smoothed: Floats,
    bound: Floats,
    unshown: Unshown | None,
    level: Floats,
    variance: Floats,
    other: Unshown | None,
) -> None:
    """Smoothed L, (H, W), where one direction knows no more than a ``bound``: that of the other direction. In place.

    ``level`` and ``variance`` are the other direction's, ``other`` the pixels of which that knows no more either. Where
    its level is below the bound, both are wrong, each in proportion to its variance.
    """
    if unshown is None:
        return
    only = np.ones(len(unshown.pixels), np.bool_)
    if other is not None:
        only = np.isin(unshown.pixels, other.pixels, assume_unique=True, invert=True)
    pixels = unshown.pixels[only]
    known, doubt = level.reshape(-1)[pixels], variance.reshape(-1)[pixels]
    short = np.maximum(bound.reshape(-1)[pixels] - known, np.float32(0.0))
    smoothed.reshape(-1)[pixels] = known + short * doubt / (doubt + unshown.noise[only])
