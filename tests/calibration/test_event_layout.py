"""Events that lie the wrong way round to the frames, and those that have nothing to do with them."""

from __future__ import annotations

import numpy as np
import pytest

from kalux import Recording
from kalux.calibration.event_layout import find_layout
from kalux.datasets import SensorSettings, simulate
from kalux.datasets.motion import pan, still
from kalux.datasets.scenes import photograph_scene
from kalux.pipeline import reconstruct
from kalux.planning import plan
from kalux.recording import AS_STORED, EventLayout, with_event_layout
from kalux.settings import PRESETS, altered

from builders import blocks, moving_blocks

SETTINGS = PRESETS["default"]
LAYOUTS = [EventLayout(x, y, p) for x in (False, True) for y in (False, True) for p in (False, True)]


def moving():
    return moving_blocks(sensor=SensorSettings(threshold_on=0.2, threshold_off=0.2, noise_rate=1.0))


def recorded(made, events=None):
    return Recording.from_arrays(
        made.events if events is None else events, made.frames, sensor_size=made.scene.sensor_size
    )


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_layout_in_which_events_follow_the_frames_is_found(layout):
    source = recorded(moving())
    found = find_layout(with_event_layout(source, layout), SETTINGS.camera)
    assert found is not None
    assert (found.found, found.contradicts) == (layout, False)
    assert found.correlation > 0.6


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_undoes_itself(layout):
    source = recorded(moving())
    twice = with_event_layout(with_event_layout(source, layout), layout)
    assert all(np.array_equal(a, b) for a, b in zip(source.events(), twice.events(), strict=True))


def test_images_are_those_of_events_as_they_should_be():
    source, wrong = recorded(moving()), EventLayout(mirrored_y=True, swapped=True)
    spoilt = with_event_layout(source, wrong)
    for options in ({}, {"smooth": True}):
        for right, mended in zip(
            reconstruct(source, at="frames", **options),
            reconstruct(spoilt, at="frames", **options),
            strict=True,
        ):
            assert np.array_equal(right.intensity, mended.intensity)
    kept = plan(spoilt, at="frames", settings=altered(SETTINGS, "events", mend_layout=False))
    assert kept.mends.layout is None


def test_events_of_another_scene_contradict():
    events, frames = (
        simulate(
            photograph_scene(blocks(seed=seed), pan(60.0, speed), sensor_size=(96, 128), duration=500_000),
            SensorSettings(threshold_on=0.2, threshold_off=0.2),
        )
        for seed, speed in ((0, 0.0), (1, 30.0))
    )
    source = Recording.from_arrays(events.events, frames.frames, sensor_size=(96, 128))
    found = find_layout(source, SETTINGS.camera)
    assert found is not None
    assert (found.found, found.contradicts) == (AS_STORED, True)


def test_noise_of_a_still_scene_contradicts_nothing():
    scene = photograph_scene(blocks(), still(), sensor_size=(48, 64), duration=500_000)
    made = simulate(scene, SensorSettings(noise_rate=5.0, read_noise=0.02), seed=2)
    found = find_layout(recorded(made), SETTINGS.camera)
    assert found is not None
    assert (found.found, found.contradicts) == (AS_STORED, False)


def test_few_events_tell_nothing():
    made = moving()
    assert find_layout(recorded(made, made.events[::500]), SETTINGS.camera) is None


@pytest.mark.parametrize("name", ["slider_depth", "newton_davis346.aedat4", "street_davis346.aedat4"])
def test_real_recordings_agree_as_they_are(shared_data, name):
    import kalux

    options = {"exposure": 10_000, "stamp": "start"} if name == "slider_depth" else {}
    found = find_layout(kalux.open(shared_data / name, **options), SETTINGS.camera)
    assert found is not None
    assert found.found == AS_STORED
    assert found.correlation > 0.5
