"""What a recording is mended by, and that it is only where it is asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kalux import PRESETS, Recording, reconstruct
from kalux.datasets import SensorSettings, demo_scene, photograph_scene, simulate
from kalux.datasets.motion import Pose
from kalux.plan_report import plan_report
from kalux.planning import plan
from kalux.planning.mending import mend
from kalux.recording import AS_STORED, EventLayout, with_event_layout
from kalux.settings import altered

from builders import damaged, lifted, moving_blocks, passing_by, textured


def leaking_scene(pixels=0.005):
    """A room, seen by a camera of which some pixels leak."""
    scene = demo_scene(sensor_size=(48, 64), duration=500_000)
    return simulate(scene, SensorSettings(hot_pixels=pixels, hot_rate=200.0), seed=3)


def test_pixels_that_leak_are_found_and_left_out():
    """Where frames are clipped nothing contradicts their events: they would grow to many times what is there."""
    made = leaking_scene()
    seen = made.recording()
    settled = plan(seen, at="frames")
    clean = plan(leaking_scene(0.0).recording(), at="frames")
    assert clean.pixels is None
    assert clean.mends.hot_pixels == 0
    assert settled.pixels is not None
    assert settled.mends.hot_pixels == settled.pixels.hot.sum() > 3
    assert dict(plan_report(seen, settled, PRESETS["default"]))["hot pixels"] == (
        f"{settled.mends.hot_pixels} pixels whose events are left out (measured)"
    )
    assert "hot pixels" not in dict(plan_report(seen, clean, PRESETS["default"]))
    truth = made.truth()
    worst = max(
        float((image.intensity[settled.pixels.hot] / image_truth[settled.pixels.hot]).max())
        for image, image_truth in zip(reconstruct(seen, times=truth.times), truth.images, strict=True)
    )
    assert worst < 3


def test_the_paper_has_no_hot_pixels_and_who_says_so_neither():
    seen = leaking_scene().recording()
    assert plan(seen, at="frames", preset="iccv2021").pixels is None
    kept = altered(PRESETS["default"], "events", leave_out_hot=False)
    assert plan(seen, at="frames", settings=kept).pixels is None


def moving():
    sensor = SensorSettings(threshold_on=0.2, threshold_off=0.2, noise_rate=1.0)
    return moving_blocks(0.02, 1.2, sensor=sensor, duration=1_000_000).recording()


def test_a_sound_recording_is_left_as_it_is():
    source = moving()
    made = mend(source, PRESETS["default"])
    assert not made.mends.changes
    for one, other in zip(source.frames(), made.recording.frames(), strict=True):
        assert np.array_equal(one.normalised(), other.normalised())
    for chunk, same in zip(source.events(), made.recording.events(), strict=True):
        assert np.array_equal(chunk, same)


def test_all_that_is_wrong_is_mended_at_once():
    """As a plan mends it; and nothing of it where the settings do not ask."""
    wrong = EventLayout(mirrored_x=True, swapped=True)
    source = damaged(with_event_layout(moving(), wrong))
    made = mend(source, PRESETS["default"])
    mends = made.mends
    assert mends.layout.found == wrong
    assert (mends.faults.copies, mends.faults.stuck.sum()) == ((3,), 1)
    assert mends.corrections.gains[-1] / mends.corrections.gains[0] == pytest.approx(0.5, rel=0.1)
    assert len(made.recording.frames()) == len(source.frames()) - 1
    planned = plan(source, at="frames").mends
    assert (planned.layout, planned.faults.copies) == (mends.layout, mends.faults.copies)
    paper = mend(source, PRESETS["iccv2021"]).mends
    assert not paper.changes


def test_copies_do_not_turn_events_round():
    """Every frame twice, before a camera that goes on and back again: events since a copy say the contrary of
    what changed since the frame that it repeats."""

    sensor = SensorSettings(threshold_on=0.1, threshold_off=0.1, frame_rate=20.0, exposure=1_000)

    def to_and_fro(t):
        frames = t * 1e-6 * sensor.frame_rate - 0.5
        return Pose(0.5 * frames + 2.0 * (1 - np.cos(np.pi * frames)))

    waves = 0.3 + 0.25 * np.sin(np.add.outer(0.2 * np.arange(60), 0.25 * np.arange(90)))
    scene = photograph_scene(waves, to_and_fro, sensor_size=(32, 40), duration=800_000)
    source = simulate(scene, sensor).recording()
    frames = [*source.frames()]
    twice = [replace(frame, image=frames[i - i % 2].image) for i, frame in enumerate(frames)]
    events = np.concatenate([*source.events()])
    made = mend(Recording.from_arrays(events, twice, sensor_size=source.sensor_size), PRESETS["default"])
    assert made.mends.layout.found == AS_STORED
    assert made.mends.faults.copies == (*range(1, len(frames), 2),)
    assert len(made.recording.frames()) == len(frames[::2])


def test_black_and_saturation_are_settings_of_what_is_mended():
    raised = mend(lifted(moving(), 16), PRESETS["default"])
    assert raised.settings.camera.black_level == raised.mends.black.level
    assert raised.settings.camera.black_level == pytest.approx(16 / 255, abs=3 / 255)
    cut = mend(passing_by(textured(1.2), 102), PRESETS["default"])
    assert cut.settings.camera.saturation == pytest.approx(0.999 * 102 / 255)


def test_without_frames_hot_pixels_are_left_out_all_the_same():
    seen = leaking_scene().recording()
    events = Recording.from_arrays(np.concatenate(list(seen.events())), [], sensor_size=seen.sensor_size)
    assert mend(events, PRESETS["default"]).mends.hot_pixels > 3
