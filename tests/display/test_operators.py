"""The curves of one formula, against their papers."""

from __future__ import annotations

import numpy as np

from curves import hdr_scene
from kalux.display import DisplaySettings, Drago, Linear, Reinhard, tone_map


def test_linear_limits():
    mapped = tone_map(np.array([[0, 1, 2, 3, 9]], np.float32), DisplaySettings(Linear(black=1, white=3)))
    np.testing.assert_allclose(mapped, [[0, 0, 0.5, 1, 1]])


def test_reinhard_maps_as_equation_4():
    scene = hdr_scene()
    mapped = tone_map(scene, DisplaySettings(Reinhard(key=0.36, white=20), encoding="none"))
    average = np.exp(np.log(scene.astype(np.float64) + 1e-3).mean()) - 1e-3
    luminance, white = 0.36 * scene / average, 0.36 * 20 / average
    expected = np.clip(luminance * (1 + luminance / white**2) / (1 + luminance), 0, 1)
    np.testing.assert_allclose(mapped, expected, atol=1e-5)


def test_drago_maps_as_equation_4():
    scene = hdr_scene()
    mapped = tone_map(scene, DisplaySettings(Drago(bias=0.8, high=100), encoding="none"))
    relative = scene / (np.exp(np.log(scene.astype(np.float64) + 1e-3).mean()) - 1e-3)
    below = np.log(2 + 8 * (relative / relative.max()) ** (np.log(0.8) / np.log(0.5)))
    expected = np.log(relative + 1) / below / np.log10(relative.max() + 1)
    np.testing.assert_allclose(mapped, np.clip(expected, 0, 1), atol=1e-5)
