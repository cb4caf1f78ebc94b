"""Interpolation between deblurred frames as the paper has it, equations (10)-(13)."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SCALE_INVERSE_BOUNDS: Final = (0.6, 100.0)
"""1 / c_p outside of these is not used: bounds of the released code, which the paper does not print."""


def threshold_scale(difference: Array, integral: Array) -> Array:
    """c_p^k of equation (12), per pixel; 1 where it is meaningless.

    Parameters
    ----------
    difference
        L^D(tau^{k+1} + T/2) - L^D(tau^k - T/2), (H, W).
    integral
        Sum of the nominal event steps between the two, (H, W).
    """
    inverse = np.divide(integral, difference, out=np.zeros_like(integral), where=difference != 0)
    low, high = SCALE_INVERSE_BOUNDS
    usable = (inverse >= low) & (inverse <= high)
    return np.divide(1.0, inverse, out=np.ones_like(inverse), where=usable)


def forward(start_latent: Array, scale: Array, integral: Array) -> Array:
    """L^{A-} of equation (10): from the start of an exposure, with the events since then."""
    return start_latent + scale * integral


def backward(end_latent: Array, scale: Array, integral: Array) -> Array:
    """L^{A+} of equation (11): back from the end of the next exposure, with the events until then."""
    return end_latent - scale * integral


class InterpolatedSegment(NamedTuple):
    """L^A and R from the start of exposure k to the start of exposure k+1, equations (7), (9) and (13).

    Times are int us, arrays (H, W) float64. Within the exposure L^A moves from ``forward`` to ``backward``
    (13); both take an event's nominal step times their scale. In causal mode both are the same.

    Attributes
    ----------
    start, exposure_end, end
        s_k, e_k and s_{k+1} (a far future after the last frame).
    previous_middle, middle, next_middle
        tau^{k-1}, tau^k, tau^{k+1}.
    forward, backward
        L^{A-} of the interval before the frame and L^{A+} of the one after it, at ``start``.
    scale_before, scale_after
        c_p of both intervals.
    covariance_before, covariance_at, covariance_from, covariance_after
        R (9) at tau^{k-1} and tau^k with the intensity of frame k-1; at tau^k and tau^{k+1} with that of k.
    step_on, step_off
        Nominal thresholds.
    """

    start: int
    exposure_end: int
    end: int
    previous_middle: int
    middle: int
    next_middle: int
    forward: Array
    backward: Array
    scale_before: Array
    scale_after: Array
    covariance_before: Array
    covariance_at: Array
    covariance_from: Array
    covariance_after: Array
    step_on: float
    step_off: float
