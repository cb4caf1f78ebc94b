"""Frames of a smooth texture that moves, and an image joined with what they show."""

from __future__ import annotations

import cv2
import numpy as np

from kalux.augmentation.along import join_along
from kalux.augmentation.bridge import Latent

SHAPE = (72, 96)


def texture(seed, x=0.0, y=0.0, shape=SHAPE, scale=3.0):
    """Smooth noise of standard deviation 0.5, whose pixel (row, column) is at (row - y, column - x) of the first."""
    wide = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(160, 200)), (0, 0), scale)
    wide = (0.5 * wide / wide.std() - 1.0).astype(np.float32)
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(np.float32) + 40
    return cv2.remap(wide, columns - np.float32(x), rows - np.float32(y), cv2.INTER_CUBIC)


def frame_of(value, variance=1e-4):
    return Latent(value, np.full(value.shape, variance, np.float32))


def whole(along, level, variance):
    """What `join_along` makes of an image."""
    level, variance = level.copy(), variance.copy()
    join_along(along, level, variance)
    return level, variance
