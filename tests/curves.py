"""Every curve of the display, a scene of much contrast, and an image with a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kalux.display import CURVES, Auto, Clahe, Drago, Reinhard

ALL = [
    *(kind() for kind in CURVES.values()),
    Auto(lift=1),
    Reinhard(key=0.7, white=3),
    Drago(bias=0.7),
    Clahe(clip=20, tiles=3),
]


@dataclass(frozen=True)
class Timed:
    t: int
    intensity: np.ndarray


def hdr_scene(scale: float = 1.0) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, 1, 64), np.linspace(0, 1, 48))
    lamp = 60 * np.exp(-((x - 0.7) ** 2 + (y - 0.3) ** 2) / 0.005)
    return (scale * (0.05 + 0.6 * x + lamp)).astype(np.float32)
