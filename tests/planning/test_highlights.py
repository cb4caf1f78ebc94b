"""How far a scene goes beyond white, by what leaves saturation in its first frames."""

from __future__ import annotations

import numpy as np
import pytest

from kalux import PRESETS, Recording
from kalux.planning import plan
from kalux.settings import altered

from builders import passing_by, sky, textured


def found_in(recording, **options):
    return plan(recording, at="frames", **options).unshown_scale


@pytest.fixture(scope="module")
def beyond():
    """Half of the surfaces are up to six times white."""
    return passing_by(textured(6.0))


@pytest.fixture(scope="module")
def ending():
    """The same where nothing is brighter than white, as in a video that is taken for light."""
    return passing_by(np.minimum(textured(6.0), 1.0))


def test_a_scene_that_ends_at_white_is_told_from_one_that_goes_beyond(beyond, ending):
    """The better the more pixels count as clipped: those just below white are, if told so, not by themselves."""
    told = altered(PRESETS["default"], "camera", saturation=0.98)
    far, near = found_in(beyond, settings=told), found_in(ending, settings=told)
    assert far.scale > 1.1 > 1.5 * near.scale
    assert found_in(beyond).scale > 1.2 > 1 > found_in(ending).scale
    assert far.excess > 1.3 * far.expected
    assert near.excess < near.expected / 5


def test_what_is_found_is_used(ending):
    made = plan(ending, at="frames")
    assert made.settings.filter.unshown_scale == made.unshown_scale.scale


def test_a_given_scale_is_kept(ending):
    given = altered(PRESETS["default"], "filter", unshown_scale=0.7)
    made = plan(ending, at="frames", settings=given)
    assert (made.settings.filter.unshown_scale, made.unshown_scale) == (0.7, None)


@pytest.mark.parametrize(
    "options",
    [
        {"lookahead": False},
        {"preset": "iccv2021"},
        {"preset": "cf"},
        {"settings": altered(PRESETS["default"], "filter", unshown_tail=0.0)},
        {"settings": altered(PRESETS["default"], "filter", highlight_scale=0.0)},
    ],
)
def test_it_is_not_looked_for_where_nothing_may_use_it(ending, options):
    """In causal mode it would be of the future."""
    made = plan(ending, at="frames", **options)
    assert (made.settings.filter.unshown_scale, made.unshown_scale) == (None, None)


def test_frames_that_clip_nothing_tell_nothing():
    made = plan(passing_by(textured(0.9)), at="frames")
    assert (made.settings.filter.unshown_scale, made.unshown_scale) == (1.0, None)


@pytest.mark.parametrize("most", [3, 100])
@pytest.mark.parametrize("chunk", [50, 1 << 20])
def test_events_end_the_look_however_they_come(beyond, most, chunk, monkeypatch):
    """After as many frames as have them, or all, whatever chunks a file comes in."""
    times = np.concatenate(list(beyond.events()))["t"]
    ends = [frame.exposure_end for frame in beyond.frames()]
    monkeypatch.setattr("kalux.planning.highlights._MOST_FRAMES", most)
    few = found_in(beyond)
    monkeypatch.setattr("kalux.planning.highlights._MOST_FRAMES", 100)
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", chunk)
    if most < len(ends):
        delay = plan(beyond, at="frames").settings.events.lateness
        until = int(np.searchsorted(times, ends[most - 1] + delay, "right"))
        monkeypatch.setattr("kalux.planning.highlights._MOST_EVENTS", until)
    assert found_in(beyond) == few


def test_a_recording_of_one_frame_tells_nothing():
    source = passing_by(sky(3.0))
    alone = Recording.from_arrays(
        np.concatenate(list(source.events())), list(source.frames())[:1], sensor_size=source.sensor_size
    )
    assert found_in(alone) is None
