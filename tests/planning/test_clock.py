"""The offset between clocks, of recordings that have to be mended."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import kalux
from kalux import PRESETS, Recording
from kalux.datasets import SensorSettings, pan, photograph_scene, simulate
from kalux.errors import InputError
from kalux.planning import clock
from kalux.planning.clock import offset_of_recording
from kalux.recording import AS_STORED, EventLayout, with_event_layout
from kalux.settings import altered

from builders import blocks, damaged, lifted

SETTINGS = PRESETS["default"]
SIZE = (120, 160)


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        # ../shared/data/README.md: the events agree best with 8 ms added to slider_depth's stamps,
        ("slider_depth", {"exposure": 10_000, "stamp": "middle"}, 8_000),
        # and with newton 6 ms after the middle of the exposure.
        ("newton_davis346.aedat4", {}, 6_000),
    ],
)
def test_the_measured_offsets_of_real_recordings(shared_data, name, options, expected):
    """Within 2 ms, with whole event steps, as they were measured; without the half threshold it is less."""
    found, _ = offset_of_recording(kalux.open(shared_data / name, **options), SETTINGS, reach=500_000)
    assert found.apparent == pytest.approx(expected, abs=2_000)
    assert found.offset < found.apparent - 1_000
    assert found.standard_error < 500
    assert found.coarse.sure


def later(source, shift, events=None):
    """The recording, whose frames' clock is ``shift`` us behind."""
    frames = [
        dataclasses.replace(f, exposure_start=f.exposure_start - shift, exposure_end=f.exposure_end - shift)
        for f in source.frames()
    ]
    stream = np.concatenate(list(source.events()))
    return Recording.from_arrays(stream, frames, sensor_size=source.sensor_size)


@pytest.fixture(scope="module")
def seen():
    picture = np.maximum(blocks(0.03, 1.0, shape=(170, 220)) - 0.05, 0)
    scene = photograph_scene(picture, pan(60.0), sensor_size=SIZE, duration=500_000)
    return simulate(scene, SensorSettings()).recording()


@pytest.fixture(scope="module")
def expected(seen):
    found, mends = offset_of_recording(seen, SETTINGS, reach=200_000)
    assert not mends.changes
    return found.offset


def test_a_black_level_is_taken_off(seen, expected):
    """Though events say where it is only in the clock of the frames. Left in, it moves the offset by 350 us."""
    raised = later(lifted(seen, 16), 70_000)
    found, mends = offset_of_recording(raised, SETTINGS, reach=200_000)
    assert mends.black.level == pytest.approx(16 / 255, abs=1 / 255)
    assert found.offset == pytest.approx(expected + 70_000, abs=50)
    given = altered(SETTINGS, "camera", black_level=0.0)
    left, mends = offset_of_recording(raised, given, reach=200_000)
    assert mends.black is None
    assert abs(left.offset - found.offset) > 200


@pytest.mark.parametrize("stated", ["srgb", "gamma:1.5"])
def test_the_response_that_the_recording_states_is_used(seen, expected, stated, monkeypatch):
    asked = set()
    whole = clock.estimate_offset

    def watched(*args, camera, **options):
        asked.add(camera.response)
        return whole(*args, camera=camera, **options)

    monkeypatch.setattr(clock, "estimate_offset", watched)
    source = dataclasses.replace(later(seen, 0).source, response=stated)
    found, _ = offset_of_recording(Recording(source), SETTINGS, reach=200_000)
    assert asked == {stated}
    assert found.offset == pytest.approx(expected, abs=300)


@pytest.mark.parametrize("layout", [EventLayout(mirrored_x=True), EventLayout(False, True, True)])
def test_events_the_wrong_way_round_are_put_right_at_any_offset(seen, expected, layout):
    spoilt = later(with_event_layout(seen, layout), 70_000)
    found, mends = offset_of_recording(spoilt, SETTINGS, reach=200_000)
    assert mends.layout.found == layout
    assert found.offset == pytest.approx(expected + 70_000, abs=50)
    kept = altered(SETTINGS, "events", mend_layout=False)
    with pytest.raises(InputError, match="events do not explain how the frames change"):
        offset_of_recording(spoilt, kept, reach=200_000)


def test_faulty_frames_are_mended_in_the_clock_of_the_events(seen, expected):
    spoilt = later(damaged(seen), 70_000)
    found, mends = offset_of_recording(spoilt, SETTINGS, reach=200_000)
    assert mends.faults.steps
    assert mends.faults.copies
    assert (mends.layout.found, found.coarse.sure) == (AS_STORED, True)
    assert found.offset == pytest.approx(expected + 70_000, abs=100)


@pytest.mark.parametrize(("sure", "asked"), [(True, 0), (False, 1)])
def test_layouts_are_tried_where_the_offset_is_not_sure(seen, sure, asked, monkeypatch):
    """They cost eight correlations, which an offset that is sure does not need."""
    found = offset_of_recording(seen, SETTINGS, reach=200_000)[0]
    coarse = found.coarse._replace(ratio=np.inf if sure else 1.0)
    assert coarse.sure == sure
    tried = []
    monkeypatch.setattr(clock, "estimate_offset", lambda *_, **__: found._replace(coarse=coarse))
    monkeypatch.setattr(clock, "_other_layout", lambda *arguments: tried.append(arguments))
    _, mends = offset_of_recording(seen, SETTINGS, reach=200_000)
    assert len(tried) == asked
    assert mends.layout.found == AS_STORED
