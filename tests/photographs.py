"""A scene and simulated photographs of it at several exposure times."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from kalux.datasets.brackets import Picture
from kalux.models.camera import Response

from builders import blocks

TIMES = (4.0, 1.0, 1 / 4, 1 / 16)
SHAPE = (200, 260)


@cache
def scene_radiance():
    """Radiance from 0.01 to 12: (H, W, 3), colours that are not far from grey. Not to be changed."""
    grey = cv2.GaussianBlur(blocks(0.01, 12.0, shape=SHAPE), (0, 0), 0.7)
    return grey[..., None] * np.array([0.8, 1.0, 1.2])


def photographs(radiance, *, response=None, times=TIMES, change=None, seed=0):
    """What a camera of 8 bits with shot noise makes of it; ``change(k, radiance)`` alters exposure k."""
    rng, curve = np.random.default_rng(seed), response or Response.srgb()
    found = []
    for k, seconds in enumerate(times):
        seen = radiance if change is None else change(k, radiance)
        light = np.clip(seen * seconds, 0, 1)
        light = np.clip(light + rng.normal(size=light.shape) * np.sqrt(light / 8000 + 4e-7), 0, 1)
        found.append(Picture(f"{k}.png", np.rint(255 * curve(light)).astype(np.uint8), seconds))
    return found
