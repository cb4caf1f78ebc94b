"""Features of pictures, which of them look alike in two pictures, and the homography that most of these agree on.

References
----------
.. [1] D. Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", IJCV 60(2), 2004.
.. [2] D. Barath et al., "MAGSAC++, a Fast, Reliable and Accurate Robust Estimator", CVPR 2020.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WORK_WIDTH: Final = 640
"""Smaller photographs are enlarged to it for SIFT, which finds little in 240 x 180."""

_ITERATIONS: Final = 10_000
_CONFIDENCE: Final = 0.9999


class Features(NamedTuple):
    """SIFT features of a picture: its (height, width), positions (N, 2) in its pixels, and descriptors (N, 128)."""

    size: tuple[int, int]
    points: Array
    descriptors: Any


def find_features(
    picture: NDArray[np.uint8],
    mask: Mask | None = None,
    *,
    width: int = WORK_WIDTH,
    most: int = 6000,
    contrast: float = 0.02,
) -> Features:
    """SIFT [1]_ features of an (H, W) picture, where the mask is True.

    Parameters
    ----------
    width
        Narrower pictures are enlarged to it; 0: none are.
    most
        The strongest are taken, as many as this.
    contrast
        SIFT's threshold. Low: the ratio test and the homography judge the features, not their contrast.
    """
    size = (picture.shape[0], picture.shape[1])
    scale = max(width / size[1], 1.0)
    allowed = None if mask is None else mask.astype(np.uint8)
    if scale > 1.0:
        larger = (round(size[1] * scale), round(size[0] * scale))
        picture = np.asarray(cv2.resize(picture, larger, interpolation=cv2.INTER_CUBIC), np.uint8)
        if allowed is not None:
            allowed = np.asarray(cv2.resize(allowed, larger, interpolation=cv2.INTER_NEAREST), np.uint8)
    sift = cv2.SIFT.create(most, contrastThreshold=contrast)
    keypoints, descriptors = sift.detectAndCompute(picture, allowed)
    points = np.array([k.pt for k in keypoints], np.float64).reshape(-1, 2)
    return Features(size, (points + 0.5) / scale - 0.5, descriptors)


def alike(first: Features, second: Features, ratio: float) -> tuple[Array, Array]:
    """Positions (N, 2) of features of two pictures that look alike.

    The distance to the best match is less than ``ratio`` times that to the second best (Lowe).
    """
    if min(len(first.points), len(second.points)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first.descriptors, second.descriptors, k=2)
    good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < ratio * p[1].distance]
    return (
        first.points[[m.queryIdx for m in good]].reshape(-1, 2),
        second.points[[m.trainIdx for m in good]].reshape(-1, 2),
    )


def agreed_homography(source: Array, target: Array, tolerance: float) -> tuple[Array | None, int]:
    """The homography from source to target points (N, 2) that most pairs agree with, by MAGSAC++ [2]_.

    Parameters
    ----------
    tolerance
        Pixels of the target.

    Returns
    -------
    (3, 3), None if there is none; and how many pairs agree.
    """
    if len(source) < 4:
        return None, 0
    found, inliers = cv2.findHomography(
        source, target, cv2.USAC_MAGSAC, tolerance, None, _ITERATIONS, _CONFIDENCE
    )
    if found is None or not np.isfinite(found).all():
        return None, 0
    return np.asarray(found, np.float64), int(np.count_nonzero(inliers))
