"""What one pass over all frames tells."""

from __future__ import annotations

from functools import reduce

import pytest

from kalux import PRESETS, Recording
from kalux.errors import FrameError
from kalux.models.camera import BrightTail, Camera, count_bright
from kalux.planning import plan
from kalux.planning.survey import survey
from kalux.settings import altered

from builders import events, recording


def test_exposures_are_all_there_and_nothing_else_unless_asked_for():
    seen = survey(recording(), PRESETS["default"])
    expected = [(frame.exposure_start, frame.exposure_end) for frame in recording().frames()]
    assert seen.exposures.tolist() == [list(exposure) for exposure in expected]
    assert (seen.tail, seen.faults) == (None, None)


def test_without_frames_there_is_nothing_to_survey():
    with pytest.raises(FrameError, match="no frames"):
        survey(Recording.from_arrays(events(), [], sensor_size=(1, 1)), PRESETS["default"])


def test_the_bright_tail_comes_from_the_frames_and_can_be_given():
    doubted = recording(0, None)
    made = plan(doubted, at="frames").settings
    counts = [count_bright(Camera.named("linear", 0.98), f.normalised()) for f in doubted.frames()]
    expected = reduce(BrightTail.joined, counts).scale
    assert made.filter.bright_tail == expected
    given = altered(PRESETS["default"], "filter", bright_tail=0.7)
    assert plan(doubted, at="frames", settings=given).settings.filter.bright_tail == 0.7


def test_the_bright_tail_is_not_looked_for_where_nothing_asks_for_it():
    """Thresholds are stated, and no highlight is expected above its bound."""
    chosen = altered(PRESETS["default"], "filter", unshown_tail=0.0)
    assert plan(recording(), at="frames", settings=chosen).settings.filter.bright_tail is None
    assert plan(recording(), at="frames").settings.filter.bright_tail is not None
    assert plan(recording(), at="frames", preset="iccv2021").settings.filter.bright_tail is None
