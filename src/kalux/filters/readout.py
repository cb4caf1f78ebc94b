"""From the state to an intensity: I = exp(L) - I_0, with what is known of highlights."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.compiled import ONE, exponential, logarithm

Array = NDArray[np.floating[Any]]


MOST_VARIANCE: Final = 0.3
"""Largest variance that an excess is shrunk for. A pixel that was never seen below white has the variance of its
start, white, which is the prior itself: what events add to it must not be shrunk for it a second time."""

_BLOCK: Final = 256
"""Pixels that are looked at together: the highlights of a block are brought together, so that they go through vector
code and the others do not pay for them."""


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


@nb.njit(cache=True, inline="always", error_model="numpy")
def believed_highlight(excess, variance, scale2, stretch):  # type: ignore[no-untyped-def]
    """Posterior of L - white > 0, given its estimate ``excess`` and the filter's ``variance``; float32.

    Additive noise: a normal prior of variance ``scale2`` shrinks the excess. Unknown scale of the events: with
    a log-normal scale and an exponential prior the mode solves d exp(stretch d) = excess, i.e.
    d = W(stretch excess) / stretch with Lambert's W.
    """
    scale2, stretch = np.float32(scale2), np.float32(stretch)
    shrunk = np.float32(excess) * (scale2 / (scale2 + np.float32(variance)))
    if stretch == np.float32(0.0):
        return shrunk
    return lambert_w(stretch * shrunk) / stretch


@nb.njit(cache=True, inline="always", error_model="numpy")
def lambert_w(x):  # type: ignore[no-untyped-def]
    """Lambert's W of a float32 x >= 0, to 4e-7 of itself, without branches.

    A guess that is everywhere within 2 % (Iacono and Boyd 2017, eq. 17, in other words), and one step of
    Fritsch's iteration, which takes the error to its fourth power.
    """
    two = np.float32(2.0)
    x = max(x, np.float32(1e-30))
    log = logarithm(ONE + x)
    guess = log * (ONE - logarithm(ONE + log) / (two + log))
    # The logarithm of 1 + x cannot tell a small x; there W = x - x^2.
    w = guess if x > np.float32(1e-3) else x * (ONE - x)
    z = logarithm(x / w) - w
    q = two * (ONE + w) * (ONE + w + two / np.float32(3.0) * z)
    return w * (ONE + z / (ONE + w) * (q - z) / (q - two * z))


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
    _intensity(
        log_intensity.reshape(-1), variance.reshape(-1), np.float32(log_offset), prior, out.reshape(-1)
    )
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _intensity(log_intensity, variance, log_offset, prior, out):  # type: ignore[no-untyped-def]
    zero, most_variance = np.float32(0.0), np.float32(MOST_VARIANCE)
    white, scale2, stretch = np.float32(prior.white), np.float32(prior.scale2), np.float32(prior.stretch)
    places = np.empty(_BLOCK, np.int64)
    excess, doubt = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    for first in range(0, len(out), _BLOCK):
        logs, variances = log_intensity[first : first + _BLOCK], variance[first : first + _BLOCK]
        block = out[first : first + _BLOCK]
        highlights = 0
        for i in range(len(block)):
            value = np.float32(logs[i])
            highlights += int(value > white)
            block[i] = max(exponential(value) - log_offset, zero)
        if highlights == 0 or scale2 == zero:
            continue
        count = 0
        for i in range(len(block)):
            places[count] = i
            count += int(np.float32(logs[i]) > white)
        for k in range(highlights):
            excess[k] = np.float32(logs[places[k]]) - white
            doubt[k] = min(np.float32(variances[places[k]]), most_variance)
        for k in range(highlights):
            believed = white + believed_highlight(excess[k], doubt[k], scale2, stretch)
            excess[k] = max(exponential(believed) - log_offset, zero)
        for k in range(highlights):
            block[places[k]] = excess[k]
