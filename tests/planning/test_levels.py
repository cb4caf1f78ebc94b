"""Where frames are clipped: at full scale, unless events go on where they end."""

from __future__ import annotations

import pytest

from kalux import PRESETS
from kalux.planning import plan
from kalux.settings import altered

from builders import passing_by, sky, textured


@pytest.mark.parametrize("stated", [True, False], ids=["thresholds stated", "estimated"])
@pytest.mark.parametrize("cut", [102, 240])
def test_a_camera_that_ends_below_full_scale_saturates_there(cut, stated):
    source = passing_by(textured(3 * cut / 255), cut)
    settings = altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2)
    made = plan(source, at="frames", settings=settings if stated else None)
    assert made.settings.camera.saturation == pytest.approx(0.98 * cut / 255)
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
