"""Homographies between images of a static, distant scene, from features and refined on the intensities; warping.

As in section 5 of the paper, with SIFT [1]_ (whose patent has expired) in place of SURF, and MAGSAC++ [2]_ for the
homography. Features place an image to about a third of a pixel; the Lucas-Kanade refinement [3]_ on the log
intensities, which a difference in exposure only shifts, to a few hundredths.

References
----------
.. [1] D. Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", IJCV 60(2), 2004.
.. [2] D. Barath et al., "MAGSAC++, a Fast, Reliable and Accurate Robust Estimator", CVPR 2020.
.. [3] S. Baker, I. Matthews, "Lucas-Kanade 20 Years On: A Unifying Framework", IJCV 56(3), 2004.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.homography import Features, agreed_homography, alike
from kalux.calibration.regression import HUBER, products, robust_deviation

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

LEAST_INLIERS: Final = 15
"""Matches that agree on a homography, at least: its four points must be many times overdetermined."""

_RATIO: Final = 0.8  # of the distances of the best and the second best match (Lowe)
_INLIER_DISTANCE: Final = 2.0  # pixels of the fixed image: SIFT in noisy, blurry frames
_ITERATIONS: Final = 20
_UNSMOOTHED: Final = 1.2  # pixels per pixel: bilinear sampling alone smooths as much
_CONVERGED: Final = 0.002  # pixels
_LEAP: Final = 5.0  # pixels: a step that is no refinement any more


@dataclass(frozen=True, eq=False)
class Match:
    """A homography from features.

    Attributes
    ----------
    matrix
        (3, 3) float64: from (x, y, 1) in the fixed image to the same point in the moving one, up to a factor.
        Pixel centres are whole numbers. None: no homography was found.
    matches, inliers
        How many features look alike, and how many of them agree with the homography.
    """

    matrix: Array | None
    matches: int
    inliers: int


def tone_compressed(log_intensity: NDArray[Any], low: float, high: float) -> NDArray[np.uint8]:
    """A log intensity as a picture: ``low`` is 0, ``high`` is 255."""
    share = (log_intensity - low) / max(high - low, 1e-6)
    return np.asarray(np.rint(255 * np.clip(share, 0.0, 1.0)), np.uint8)


def match_features(fixed: Features, moving: Features) -> Match:
    """The homography on which most features of two pictures, of any two sizes, agree."""
    source, target = alike(fixed, moving, _RATIO)
    if len(source) < 4:
        return Match(None, len(source), 0)
    # From the moving to the fixed image, so that the inlier distance is in pixels of the fixed one.
    found, count = agreed_homography(target, source, _INLIER_DISTANCE)
    if found is None or abs(np.linalg.det(found)) < 1e-12:
        return Match(None, len(source), 0)
    matrix: Array = np.asarray(np.linalg.inv(found), np.float64)
    if count < LEAST_INLIERS or not is_plausible(matrix, fixed.size):
        return Match(None, len(source), count)
    return Match(matrix / matrix[2, 2], len(source), count)


def is_plausible(matrix: Array, size: tuple[int, int]) -> bool:
    """Whether a homography keeps the corners of a (height, width) image convex, in order, and of a likely size."""
    corners = transformed(matrix, corners_of(size))
    if not np.isfinite(corners).all():
        return False
    edges = np.roll(corners, -1, axis=0) - corners
    following = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    area = 0.5 * abs(
        np.sum(corners[:, 0] * np.roll(corners[:, 1], -1) - corners[:, 1] * np.roll(corners[:, 0], -1))
    )
    share = area / (size[0] * size[1])
    return bool((turns > 0).all() and 1e-2 < share < 1e4)


def corners_of(size: tuple[int, int]) -> Array:
    """(4, 2): x and y of the corners of a (height, width) image, clockwise."""
    height, width = size
    return np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], np.float64)


def transformed(matrix: Array, points: Array) -> Array:
    """Points (N, 2) under a homography; infinite where they go to infinity."""
    homogeneous = points @ matrix[:, :2].T + matrix[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:], np.float64)


def displacement(first: Array, second: Array, size: tuple[int, int]) -> float:
    """Largest distance, pixels, between where two homographies send the corners of a (height, width) image."""
    corners = corners_of(size)
    apart = transformed(first, corners) - transformed(second, corners)
    return float(np.sqrt((apart**2).sum(axis=1)).max())


def warped(image: NDArray[Any], matrix: Array, size: tuple[int, int]) -> Image:
    """The moving image seen in the fixed one's pixels: (height, width) or (height, width, C) float32.

    Where it is shown smaller than it is, it is smoothed first, as the larger pixels would. NaN beyond its edges.
    """
    return resampled(as_seen(image, _scale_at_middle(matrix, size)), matrix, size, np.nan)


def as_seen(image: NDArray[Any], shrink: float) -> Image:
    """An image as pixels ``shrink`` times as large would see it, not resampled: float32."""
    smooth = np.ascontiguousarray(image, np.float32)
    if shrink <= _UNSMOOTHED:
        return smooth
    # A box of the fixed image's pixel has the variance shrink^2 / 12; one moving pixel is there already.
    sigma = float(np.sqrt((shrink**2 - 1) / 12))
    return np.asarray(cv2.GaussianBlur(smooth, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101), np.float32)


def resampled(image: Image, matrix: Array, size: tuple[int, int], outside: float) -> Image:
    """The moving image's values at the fixed one's pixels, bilinear; ``outside`` beyond its edges."""
    return np.asarray(
        cv2.warpPerspective(
            image,
            matrix,
            (size[1], size[0]),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(outside,) * 4,
        ),
        np.float32,
    )


def warped_mask(mask: Mask, matrix: Array, size: tuple[int, int]) -> Mask:
    """Where all that a pixel of the fixed image sees of the moving one is valid: (height, width) bool."""
    valid = eroded(mask, _scale_at_middle(matrix, size))
    return np.asarray(resampled(valid, matrix, size, 0.0) > 0.999)


def eroded(mask: Mask, shrink: float) -> Image:
    """1 where pixels ``shrink`` times as large see only what is valid, else 0: float32."""
    reach = 1 if shrink <= _UNSMOOTHED else int(np.ceil(shrink))
    kernel = np.ones((2 * reach - 1, 2 * reach - 1), np.uint8)
    return 1.0 - np.asarray(cv2.dilate((~mask).astype(np.uint8), kernel), np.float32)


def _scale_at_middle(matrix: Array, size: tuple[int, int]) -> float:
    """Pixels of the moving image per pixel of the fixed one."""
    x, y = (size[1] - 1) / 2, (size[0] - 1) / 2
    square = np.array([[x, y], [x + 1, y], [x, y + 1]])
    a, b, c = transformed(matrix, square)
    u, v = b - a, c - a
    return float(np.sqrt(abs(u[0] * v[1] - u[1] * v[0])))


def refined(
    fixed: NDArray[Any], moving: NDArray[Any], fixed_mask: Mask, moving_mask: Mask, matrix: Array
) -> tuple[Array, float]:
    """A homography, improved so that the moving image equals the fixed one up to a constant.

    Parameters
    ----------
    fixed, moving
        (H, W) log intensities, of any two sizes.
    fixed_mask, moving_mask
        bool, True where they are measured.
    matrix
        Within a pixel or so.

    Returns
    -------
    The matrix, and the robust standard deviation of what is left, log intensity (infinite without overlap).
    """
    size = (fixed.shape[0], fixed.shape[1])
    target = np.asarray(cv2.GaussianBlur(np.asarray(fixed, np.float32), (0, 0), 0.8), np.float64)
    shrink = _scale_at_middle(matrix, size)
    filled = np.where(moving_mask, moving, np.median(moving[moving_mask]) if moving_mask.any() else 0.0)
    # As smooth as the target: its 0.8 pixels, in pixels of the moving image, and what its pixels smooth.
    source = np.asarray(cv2.GaussianBlur(as_seen(filled, shrink), (0, 0), 0.8 * shrink), np.float32)
    valid = eroded(moving_mask, shrink)
    # Around the middle and to about 1, so that the eight parameters are of one size.
    centre = np.array([[2 / size[1], 0, -1 + 1 / size[1]], [0, 2 / size[1], -size[0] / size[1]], [0, 0, 1]])
    rows, columns = np.mgrid[: size[0], : size[1]]
    x, y = centre[0, 0] * columns + centre[0, 2], centre[1, 1] * rows + centre[1, 2]
    current, deviation = matrix, np.inf
    for _ in range(_ITERATIONS):
        image = resampled(source, current, size, 0.0).astype(np.float64)
        inside = fixed_mask & (resampled(valid, current, size, 0.0) > 0.999)
        if np.count_nonzero(inside) < 50 * 8:
            return current, np.inf
        gy, gx = np.gradient(image)
        gx, gy = gx / centre[0, 0], gy / centre[1, 1]
        inside[0], inside[-1], inside[:, 0], inside[:, -1] = False, False, False, False
        slope = x * gx + y * gy
        columns_of = (gx * x, gx * y, gx, gy * x, gy * y, gy, -slope * x, -slope * y, np.ones(size))
        jacobian = np.stack([column[inside] for column in columns_of])
        residual = (target - image)[inside]
        offset = np.median(residual)
        deviation = robust_deviation(residual - offset) + 1e-9
        weight = np.minimum(1.0, HUBER * deviation / np.maximum(np.abs(residual - offset), 1e-12))
        weighted = weight * jacobian
        normal, right = products(weighted, jacobian), products(weighted, residual[None])[:, 0]
        step = np.linalg.lstsq(normal, right, rcond=1e-10)[0]
        update = np.eye(3) + np.append(step[:8], 0.0).reshape(3, 3)
        following = current @ np.linalg.inv(centre) @ update @ centre
        following = following / following[2, 2]
        moved = displacement(following, current, size) / shrink
        if not is_plausible(following, size) or moved > _LEAP:
            return current, deviation
        current = following
        if moved < _CONVERGED:
            break
    return current, deviation
