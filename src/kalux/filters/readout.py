"""From the state to an intensity: I = exp(L) - I_0, with what is known of highlights and of neighbours."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.unseen import UNKNOWN_CHANGE
from kalux.compiled import ONE, exponential, logarithm

Array = NDArray[np.floating[Any]]


HIDDEN_MOVING: Final = (0.005, 0.12)
"""Variance, in c^2, of what a pixel does between its events, at a frame and in addition half-way between two frames,
where events have come of late: that of mid-exposure frames and of times half-way between on eleven simulated scenes
(docs/equations.md, K11)."""

HIDDEN_STILL: Final = 0.35
"""Where no event has come of late: half-way between two frames, in units of the mean square change of the silent pixels
around from one to the other (`kalux.augmentation.unseen`); at a frame nothing."""

HIDDEN_LEAST: Final = 0.003
"""In c^2, there in any case: the same scenes at their frames."""

_NOTHING: Final = np.float32(1e9)
"""Variance of a pixel that knows nothing; its square is still a float32."""

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
    d = W(stretch excess) / stretch with Lambert's W. What is returned is the log of the mean intensity, half the
    variance that is left above the mean of the log, but no more than a part of d: at white nothing is added.
    """
    scale2, stretch = np.float32(scale2), np.float32(stretch)
    trust = scale2 / (scale2 + np.float32(variance))
    believed = np.float32(excess) * trust
    left = np.float32(variance) * trust
    if stretch != np.float32(0.0):
        w = lambert_w(stretch * believed)
        believed = w / stretch
        slope = exponential(-w) / (ONE + w)  # of d in the shrunk excess
        left *= slope * slope
    return believed + np.float32(0.5) * min(left, believed * np.sqrt(left))


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
    zero = np.float32(0.0)
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
            doubt[k] = np.float32(variances[places[k]])
        for k in range(highlights):
            believed = white + believed_highlight(excess[k], doubt[k], scale2, stretch)
            excess[k] = max(exponential(believed) - log_offset, zero)
        for k in range(highlights):
            block[places[k]] = excess[k]


def total_variance(
    variance: Array,
    moving: NDArray[np.bool_] | None,
    between: float,
    threshold2: float,
    silent_change: Array | None = None,
) -> NDArray[np.float32]:
    """P and the variance of what no event has told yet (docs/equations.md, K11), (H, W) float32.

    Parameters
    ----------
    variance
        (H, W) P.
    moving
        (H, W): pixels with an event of late, or about to have one; None: P as it is.
    between
        0 at a frame, 1 half-way between two.
    threshold2
        c^2.
    silent_change
        (H, W): mean square change of silent pixels from one frame to the next; None: not known.
    """
    if moving is None:
        return variance.astype(np.float32, copy=False)
    c2 = np.float32(threshold2)
    at, half = HIDDEN_MOVING
    move = np.float32(at + between * half) * c2
    change = np.float32(UNKNOWN_CHANGE) * c2 if silent_change is None else silent_change
    still = np.float32(between * HIDDEN_STILL) * change + np.float32(HIDDEN_LEAST) * c2
    return variance.astype(np.float32, copy=False) + np.where(moving, move, still)


def regularised(
    log_intensity: Array,
    variance: NDArray[np.float32],
    moving: NDArray[np.bool_],
    difference: float,
    pitch: int = 1,
) -> NDArray[np.float32]:
    """L with what neighbours know (docs/equations.md, K12), (H, W) float32; still pixels are as they were.

    The mean of a pixel and its eight neighbours, weighted by the information that each has about it: a neighbour at
    distance d differs by a normal amount of variance ``difference``^2 d^2, unless there is an edge between, which a
    difference beyond what both variances explain tells.

    Parameters
    ----------
    log_intensity, variance
        (H, W) L, and its variance.
    moving
        (H, W): pixels that are changed.
    difference
        Standard deviation of the difference of L between pixels one apart where there is no edge.
    pitch
        Distance of the neighbours: 2 in a Bayer mosaic, whose pixels repeat their colours.
    """
    out = log_intensity.astype(np.float32)
    _regularise(
        out.copy(), np.minimum(variance, _NOTHING), moving, np.float32(difference * difference), pitch, out
    )
    return out


@nb.njit(cache=True, inline="always")
def neighbour_weight(excess, variance, neighbour_variance, allowed):  # type: ignore[no-untyped-def]
    """Information that a neighbour has about a pixel; ``excess`` is the difference of their L.

    1 / (P' + s^2) (1 + excess^2 / (4 v))^-2 with v = P + P' + s^2: near exp(-excess^2 / (2 v)), with one division.
    """
    own = neighbour_variance + allowed
    both = variance + own
    edge = both + np.float32(0.25) * excess * excess
    return both * both / (own * edge * edge)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _regularise(log_intensity, variance, moving, allowed, pitch, out):  # type: ignore[no-untyped-def]
    """All pixels of a row at a time, neighbour by neighbour, so that it becomes vector code."""
    height, width = log_intensity.shape
    # A frame of pixels that know nothing: the border needs no special case.
    level = np.zeros((height + 2 * pitch, width + 2 * pitch), np.float32)
    doubt = np.full(level.shape, _NOTHING)
    level[pitch : pitch + height, pitch : pitch + width] = log_intensity
    doubt[pitch : pitch + height, pitch : pitch + width] = variance
    information, deviation = np.empty(width, np.float32), np.empty(width, np.float32)
    for row in range(height):
        if not moving[row].any():
            continue
        own_level, own_doubt = log_intensity[row], variance[row]
        for column in range(width):
            information[column] = ONE / own_doubt[column]
            deviation[column] = np.float32(0.0)
        for place in range(9):
            down, right = place // 3 - 1, place % 3 - 1
            if down == 0 and right == 0:
                continue
            spread = allowed * np.float32(pitch * pitch * (down * down + right * right))
            first = pitch + right * pitch
            other_level = level[row + pitch + down * pitch, first : first + width]
            other_doubt = doubt[row + pitch + down * pitch, first : first + width]
            for column in range(width):
                excess = other_level[column] - own_level[column]
                weight = neighbour_weight(excess, own_doubt[column], other_doubt[column], spread)
                deviation[column] += weight * excess
                information[column] += weight
        for column in range(width):
            if moving[row, column]:
                out[row, column] = own_level[column] + deviation[column] / information[column]
