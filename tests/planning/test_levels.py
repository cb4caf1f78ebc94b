"""Where frames are clipped: at full scale, or just below it, unless events go on where they end."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kalux import PRESETS, Recording
from kalux.calibration.levels import LAST_LEVEL
from kalux.planning import plan
from kalux.settings import altered

from builders import passing_by, sky, textured


@pytest.mark.parametrize("stated", [True, False], ids=["thresholds stated", "estimated"])
@pytest.mark.parametrize("cut", [102, 240])
def test_a_camera_that_ends_below_full_scale_saturates_there(cut, stated):
    source = passing_by(textured(3 * cut / 255), cut)
    settings = altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2)
    made = plan(source, at="frames", settings=settings if stated else None)
    assert made.settings.camera.saturation == pytest.approx(LAST_LEVEL * cut / 255)
    assert made.mends.ceiling.level == pytest.approx(cut / 255)
    given = plan(source, at="frames", settings=altered(settings, "camera", saturation=0.9))
    assert (given.settings.camera.saturation, given.mends.ceiling) == (0.9, None)


@pytest.mark.parametrize("picture", [sky(0.5), sky(0.9), textured(0.6)], ids=["sky", "bright sky", "texture"])
def test_a_scene_that_ends_below_white_does_not_saturate(picture):
    """Nor does the paper's filter, whatever it sees."""
    made = plan(passing_by(picture), at="frames")
    assert (made.settings.camera.saturation, made.mends.ceiling) == (0.98, None)
    paper = plan(passing_by(textured(1.2), 102), at="frames", preset="iccv2021")
    assert (paper.settings.camera.saturation, paper.mends.ceiling) == (0.98, None)


def unevenly(recording, spread):
    """The frames where each pixel ends at a level of its own, around full scale."""
    ends = 1 + spread * np.random.default_rng(3).standard_normal(recording.sensor_size)
    levels = np.rint(255 * ends.clip(0, 1)).astype(np.uint8)
    frames = [
        dataclasses.replace(frame, image=np.minimum(frame.image, levels)) for frame in recording.frames()
    ]
    return Recording.from_arrays(
        np.concatenate(list(recording.events())), frames, sensor_size=recording.sensor_size
    )


def test_pixels_just_below_white_are_measured_where_all_end_at_white():
    """Where each ends at a level of its own, those a little below white may be clipped."""
    source = passing_by(textured(3.0))
    assert plan(source, at="frames").settings.camera.saturation == LAST_LEVEL
    assert plan(unevenly(source, 0.005), at="frames").settings.camera.saturation == 0.98
