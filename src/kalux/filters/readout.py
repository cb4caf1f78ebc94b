"""From the state to an intensity: I = exp(L) - I_0, with what is known of highlights."""

from __future__ import annotations

from typing import Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


MOST_VARIANCE: Final = 0.3
"""Largest variance that an excess is shrunk for. A pixel that was never seen below white has the variance of its
start, white, which is the prior itself: what events add to it must not be shrunk for it a second time."""


class HighlightPrior(NamedTuple):
    """How far beyond white an estimate is believed (docs/equations.md, K6).

    Attributes
    ----------
    white
        log(1 + I_0) of the brightest level that a frame can show.
    scale2
        Variance of the log of highlights over white; 0 turns the prior off.
    stretch
        Variance of the log of the scale that events have there, over the scale.
    """

    white: float
    scale2: float
    stretch: float


@nb.njit(cache=True, inline="always")
def believed_highlight(excess, variance, scale2, stretch):  # type: ignore[no-untyped-def]
    """Posterior of L - white > 0, given its estimate ``excess`` and the filter's ``variance``.

    Additive noise: a normal prior of variance ``scale2`` shrinks the excess. Unknown scale of the events: with
    a log-normal scale and an exponential prior the mode solves d exp(stretch d) = excess, i.e.
    d = W(stretch excess) / stretch with Lambert's W.
    """
    shrunk = excess * scale2 / (scale2 + variance)
    if stretch == 0.0:
        return shrunk
    return lambert_w(stretch * shrunk) / stretch


@nb.njit(cache=True, inline="always")
def lambert_w(x):  # type: ignore[no-untyped-def]
    """Lambert's W of x >= 0, to 1e-8 of itself: its series (Corless et al. 1996, eq. 3.1), or Newton's iteration."""
    if x < 0.01:
        return x * (1.0 - x * (1.0 - x * (1.5 - x * (8.0 / 3.0 - x * 125.0 / 24.0))))
    w = np.log1p(x)
    for _ in range(8):
        e = np.exp(w)
        step = (w * e - x) / (e * (w + 1.0))
        w -= step
        if abs(step) < 1e-5 * w:  # the next step is of the order of this one's square
            break
    return w


def intensity(
    log_intensity: Array, variance: Array, log_offset: float, prior: HighlightPrior
) -> NDArray[np.float32]:
    """I of a state, (H, W) float32: linear, 1 = a saturated frame pixel at the reference exposure, never negative.

    Parameters
    ----------
    log_intensity, variance
        (H, W) L = log(I + I_0) and P.
    log_offset
        I_0.
    prior
        Of highlights.
    """
    out = np.empty(log_intensity.shape, np.float32)
    _intensity(log_intensity, variance, log_offset, prior, out)
    return out


@nb.njit(cache=True, nogil=True)
def _intensity(log_intensity, variance, log_offset, prior, out):  # type: ignore[no-untyped-def]
    height, width = log_intensity.shape
    offset = np.float32(log_offset)
    for row in range(height):
        for column in range(width):
            value = log_intensity[row, column]
            if prior.scale2 > 0.0 and value > prior.white:
                value = prior.white + believed_highlight(
                    value - prior.white,
                    min(variance[row, column], MOST_VARIANCE),
                    prior.scale2,
                    prior.stretch,
                )
            # The output is float32, and its exponential half the price.
            out[row, column] = max(np.exp(np.float32(value)) - offset, np.float32(0.0))
