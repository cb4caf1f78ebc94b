"""How much pixels change without an event, from what frames say of silent ones (docs/equations.md, K11)."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.bridge import UNMEASURED, BridgedSegment

Array = NDArray[np.floating[Any]]

UNKNOWN_CHANGE: Final = 0.1
"""Mean square, in c^2, where nothing tells it: that of eleven simulated scenes under a moving camera."""

_UNMEASURED_CHANGE: Final = 0.4
"""The same where a frame does not measure the pixel, so that none says that it has changed little: the variance
half-way to such a frame is then that of a moving pixel, as on the same scenes."""

_ENOUGH: Final = 25.0
"""Pixels without noise, or as much information in more of them, that tell the change of the whole image."""

_WINDOW: Final = 5
"""Pixels: one difference says little of a mean square. 3 to 9 predict the errors of these scenes about alike."""


def silent_change(segment: BridgedSegment, quantisation_variance: float, threshold2: float) -> Array:
    """Mean square change of silent pixels from one frame to the next, around every pixel: (H, W), log intensity^2.

    The mean is over the pixels of 5 x 5 that have no event in the segment and are measured by both frames, of the
    squares of what the frames say of their change (``segment.slope``), at most c^2, since more cannot be hidden, less
    what the frames' noise makes of them. As far as noise hides a pixel's change, that of the whole image stands in.

    Parameters
    ----------
    segment
        From `bridge`.
    quantisation_variance
        As in `BridgeNoise`.
    threshold2
        c^2.
    """
    shape = segment.slope.shape
    change, untold, silent, mean = (np.empty(shape, np.float32) for _ in range(4))
    seconds = np.float32((segment.end - segment.start) * 1e-6)
    q0, most = np.float32(quantisation_variance), np.float32(threshold2)
    variances = segment.forward_variance, segment.backward_variance
    of_all, told = _told(segment.slope, *variances, segment.events, seconds, q0, most, change, untold, silent)
    whole = max(of_all, 0.0) / told if told > _ENOUGH else UNKNOWN_CHANGE * threshold2
    change += untold * np.float32(whole)
    unknown, unmeasured = (np.float32(u * threshold2) for u in (UNKNOWN_CHANGE, _UNMEASURED_CHANGE))
    _mean(_sum_around(change), _sum_around(silent), *variances, unknown, unmeasured, mean)
    return mean


def forget_silence(
    grown: Array,
    segment: BridgedSegment,
    silent: NDArray[np.bool_],
    change: Array,
    quantisation_variance: float,
) -> None:
    """Add to ``grown``, (H, W), what the state of silent pixels loses from one frame to the next. In place.

    What such a pixel changes is not told by events, and by frames only as far as the slope takes it, the share q0 / V
    of the mismatch (K1): of the mean square change the square of the other share comes to P (docs/equations.md, K11).

    Parameters
    ----------
    silent
        (H, W): pixels without an event from one to the other that both frames measure.
    change
        From `silent_change`.
    quantisation_variance
        As in `BridgeNoise`.
    """
    variances = segment.forward_variance, segment.backward_variance
    _forget(*variances, silent, change, np.float32(quantisation_variance), grown)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _forget(forward, backward, silent, change, q0, grown):  # type: ignore[no-untyped-def]
    zero = np.float32(0.0)
    for row in range(grown.shape[0]):
        for column in range(grown.shape[1]):
            i = row, column
            noise = np.float32(forward[i]) + np.float32(backward[i])
            missed = noise / (noise + q0)
            grown[i] += np.float32(change[i]) * missed * missed if silent[i] else zero


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _told(  # type: ignore[no-untyped-def]
    slope, forward, backward, events, seconds, q0, most, change, untold, silent
):
    """Of silent pixels (0 elsewhere): squared change without noise, and the share of it that noise hides; both sums."""
    zero, one = np.float32(0.0), np.float32(1.0)
    unmeasured = np.float32(UNMEASURED)
    of_all = told = 0.0
    for row in range(slope.shape[0]):
        sum_change = sum_share = zero
        for column in range(slope.shape[1]):
            i = row, column
            noise = np.float32(forward[i]) + np.float32(backward[i])
            # The slope takes the share q0 / V of the mismatch (K1), and so of the frames' noise in it.
            share = q0 / (noise + q0)
            share *= share
            moved = np.float32(slope[i]) * seconds
            is_silent = one if noise < unmeasured and events[i] == zero else zero
            part = is_silent * (min(moved * moved, most) - min(noise, unmeasured) * share)
            change[i], silent[i], untold[i] = part, is_silent, is_silent * (one - share)
            sum_change += part
            sum_share += is_silent * share
        of_all += float(sum_change)
        told += float(sum_share)
    return of_all, told


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _mean(total, count, forward, backward, unknown, unmeasured_change, mean):  # type: ignore[no-untyped-def]
    zero, one = np.float32(0.0), np.float32(1.0)
    unmeasured = np.float32(UNMEASURED)
    for row in range(total.shape[0]):
        for column in range(total.shape[1]):
            i = row, column
            near = max(total[i], zero) / max(count[i], one) if count[i] > np.float32(0.5) else unknown
            measured = np.float32(forward[i]) + np.float32(backward[i]) < unmeasured
            mean[i] = near if measured else unmeasured_change


def _sum_around(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Over 5 x 5 pixels; beyond the border there is nothing."""
    size = (_WINDOW, _WINDOW)
    summed = cv2.boxFilter(values, cv2.CV_32F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed, np.float32)
