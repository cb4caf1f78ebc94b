"""The curve for everything: the camera frame, rolled off or lifted."""

from __future__ import annotations

import numpy as np
import pytest

from curves import hdr_scene
from kalux.display import Auto, DisplaySettings, Linear, apply, measure, to_uint8, tone_map


def test_auto_shows_a_well_exposed_scene_as_the_camera_does():
    frame = np.linspace(0, 1, 100, dtype=np.float32).reshape(10, 10)
    np.testing.assert_array_equal(tone_map(frame), frame)


def test_auto_keeps_normal_tones_and_rolls_off_highlights():
    scene = hdr_scene()
    mapped = tone_map(scene)
    normal = scene < 0.5
    np.testing.assert_allclose(mapped[normal], scene[normal], atol=1e-6)
    lamp = scene > 2
    assert np.unique(to_uint8(mapped[lamp])).size > 20
    assert np.unique(to_uint8(tone_map(scene, DisplaySettings(Linear()))[lamp])).size == 1


def test_the_shoulder_of_auto_has_no_kink():
    scene = hdr_scene()
    statistics = measure(scene, Auto())
    line = np.linspace(0.4, 0.6, 2001, dtype=np.float32)[None]
    slope = np.diff(apply(line, DisplaySettings(), statistics).astype(np.float64)[0]) / 1e-4
    assert slope[:900].mean() == pytest.approx(1, abs=1e-3)
    assert slope[1001:1011].mean() == pytest.approx(1, abs=0.01)
    assert (slope < 1.02).all()


def test_auto_lifts_a_dark_scene_but_not_further_than_allowed():
    scene = hdr_scene(0.02)
    assert np.median(tone_map(scene)) > 3 * np.median(scene)
    np.testing.assert_allclose(
        tone_map(scene, DisplaySettings(Auto(lift=1))), np.minimum(scene, 1), atol=0.35
    )
    assert np.median(tone_map(scene, DisplaySettings(Auto(lift=1)))) == pytest.approx(np.median(scene))
