"""How much pixels change without an event, from what frames say of silent ones (docs/equations.md, K11)."""

from __future__ import annotations

from typing import Any, Final

import cv2
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
    seconds = np.float32((segment.end - segment.start) * 1e-6)
    q0, most = np.float32(quantisation_variance), np.float32(threshold2)
    noise = (segment.forward_variance + segment.backward_variance).astype(np.float32, copy=False)
    measured = noise < UNMEASURED
    silent = measured & (segment.events == 0)
    change = np.minimum(np.square(segment.slope.astype(np.float32, copy=False) * seconds), most)
    # The slope takes the share q0 / V of the mismatch (K1), and so of the frames' noise in it.
    share = np.square(q0 / (noise + q0))
    change -= noise * share
    share[~silent] = 0.0
    change[~silent] = 0.0
    seen = float(share.sum())
    whole = max(float(change.sum()), 0.0) / seen if seen > _ENOUGH else UNKNOWN_CHANGE * threshold2
    change += np.where(silent, 1 - share, np.float32(0.0)) * np.float32(whole)
    total, count = (_sum_around(values) for values in (change, silent.astype(np.float32)))
    mean: Array = np.maximum(total, 0.0) / np.maximum(count, 1.0)
    mean[count < 0.5] = UNKNOWN_CHANGE * most
    mean[~measured] = _UNMEASURED_CHANGE * most
    return mean


def _sum_around(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Over 5 x 5 pixels; beyond the border there is nothing."""
    size = (_WINDOW, _WINDOW)
    summed = cv2.boxFilter(values, cv2.CV_32F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed, np.float32)
