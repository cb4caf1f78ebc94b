"""Histogram equalisation in tiles."""

from __future__ import annotations

import numpy as np

from curves import hdr_scene
from kalux.display import Clahe, DisplaySettings, apply, measure, tone_map


def test_clahe_orders_the_values_of_one_place():
    dark = np.full((32, 32), 0.1, np.float32)
    scene = np.random.default_rng(0).uniform(0, 1, (32, 32)).astype(np.float32)
    curve, statistics = DisplaySettings(Clahe()), measure(scene, Clahe())
    assert (apply(dark, curve, statistics) <= apply(2 * dark, curve, statistics)).all()


def test_clahe_of_a_clip_of_one_is_the_log():
    scene = hdr_scene()
    curve = DisplaySettings(Clahe(clip=1))
    mapped = tone_map(scene, curve)
    log = np.log(scene + 1e-3)
    limits = measure(scene, Clahe(clip=1))[:2]
    expected = np.clip((log - limits[0]) / (limits[1] - limits[0]), 0, 1)
    np.testing.assert_allclose(mapped, expected, atol=1e-5)
