"""Baselines: each against what it must give by hand, and all as methods of one kind."""

from __future__ import annotations

import numpy as np
import pytest

from kalux import PRESETS, Frame, Recording, reconstruct
from kalux.datasets import SensorSettings
from kalux.evaluation.baselines import (
    EventWindow,
    Planner,
    edi_video,
    hold_last_frame,
    mean_of_neighbours,
    methods,
    nearest_frames,
)
from kalux.settings import altered

from builders import frame, moving_blocks, pixel_events


def test_a_plan_is_made_once_for_the_same_recording_times_and_settings():
    recording, times = moving_blocks().recording(), np.array([80_000, 120_000])
    planner, settings = Planner(), PRESETS["default"]
    first = planner.plan(recording, times, settings)
    others = [
        planner.plan(moving_blocks().recording(), times, settings),
        planner.plan(recording, times, altered(settings, "events", threshold_on=0.3)),
        planner.plan(recording, times, settings, smooth=True),
    ]
    assert planner.plan(recording, times.copy(), settings) is first
    assert all(other is not first for other in others)
    assert planner.plan(recording, times[:1], settings).times.tolist() == [80_000]


def of_frames(*frames, events=(), threshold=0.2):
    events = pixel_events([], []) if len(events) == 0 else events
    return Recording.from_arrays(events, frames, sensor_size=(1, 1), contrast_threshold=threshold)


def values(images):
    return [float(image[0, 0]) for image in images]


def test_frames_are_held_from_the_middle_of_their_exposure_and_scaled_to_the_median_exposure():
    recording = of_frames(frame(51, 0, 10), frame(102, 100, 120), frame(204, 200, 220))
    times = np.array([0, 109, 110, 209, 999])
    assert values(hold_last_frame(recording, times)) == pytest.approx([0.4, 0.4, 0.4, 0.4, 0.8])


def test_the_mean_is_of_the_frames_on_both_sides():
    recording = of_frames(frame(51, 0, 10), frame(102, 100, 110))
    assert values(mean_of_neighbours(recording, np.array([2, 50, 200]))) == pytest.approx([0.2, 0.3, 0.4])


def test_edi_moves_the_nearest_frame_by_its_events_forward_and_backward():
    shots = frame(100, 0, 1000), frame(50, 100_000, 101_000)
    recording = of_frames(*shots, events=pixel_events([20_000, 90_000], [True, False]))
    found = values(edi_video(recording, np.array([10_000, 30_000, 80_000, 100_500])))
    a, b = 100 / 255 + 0.03, 50 / 255 + 0.03
    expected = [a, a * np.exp(0.2), b * np.exp(0.2), b]
    assert np.array(found) + 0.03 == pytest.approx(expected, rel=1e-6)


def test_edi_takes_events_at_the_time_of_their_light():
    recording = moving_blocks().recording()
    times = np.array([80_000, 120_000])
    stamped = np.concatenate(list(recording.events()))
    stamped["t"] += 3_000
    late = Recording.from_arrays(
        stamped, list(recording.frames()), sensor_size=recording.sensor_size, contrast_threshold=0.2
    )
    known = altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2)
    known = altered(known, "camera", log_offset=0.01)
    on_time, put_right, left = (
        np.stack([*edi_video(one, times, settings=altered(known, "events", delay=delay))])
        for one, delay in ((recording, 0), (late, 3_000), (late, 0))
    )
    np.testing.assert_array_equal(put_right, on_time)
    assert np.abs(left - on_time).max() > 0.05


def test_edi_removes_blur():
    """A step in the middle of the exposure: the frame shows the mean, EDI both levels."""
    low, step = 0.4, 0.2
    mean = ((low + 0.03) * (1 + np.exp(step)) / 2) - 0.03
    blurred = Frame(np.array([[mean]]), 0, 1000)
    recording = of_frames(blurred, frame(0.5, 9000, 10_000, dtype=float), events=pixel_events([500], [True]))
    found = values(edi_video(recording, np.array([100, 900])))
    assert found == pytest.approx([low, (low + 0.03) * np.exp(step) - 0.03], rel=1e-6)


def test_the_nearest_frame_has_every_time_once():
    frames = [frame(0, t, t + 10) for t in (0, 100, 200, 300)]
    times = np.array([0, 54, 55, 56, 350, 350])
    found = [(shot.middle, wanted.tolist()) for shot, wanted in nearest_frames(frames, times)]
    assert found == [(5, [0, 54, 55]), (105, [56]), (305, [350, 350])]


def test_a_window_over_chunks_gives_what_the_whole_stream_would():
    events = pixel_events(sorted([*range(0, 100, 3), 30, 30, 60]), [True] * 37)
    window = EventWindow([events[:5], events[5:5], events[5:20], events[20:]])
    for start, end in ((-1, 20), (10, 30), (30, 31), (31, 60), (59, 500)):
        inside = (events["t"] > start) & (events["t"] <= end)
        assert np.array_equal(window.between(start, end), events[inside])


@pytest.mark.parametrize("name", methods())
def test_every_method_gives_one_image_per_time_near_the_truth(name):
    simulation = moving_blocks()
    times = simulation.truth_times()
    images = list(methods()[name].images(simulation.recording(), times))
    truth = simulation.truth().images
    assert len(images) == len(times)
    assert np.mean((np.stack(images) - truth) ** 2) < 0.03
    assert images[0].dtype == np.float32


def test_events_make_images_better_than_held_frames():
    sensor = SensorSettings(threshold_mismatch=0.1, noise_rate=1.0)
    simulation = moving_blocks(sensor=sensor)
    recording, times, truth = simulation.recording(), simulation.truth_times(), simulation.truth().images
    error = {
        name: np.mean((np.stack(list(methods()[name].images(recording, times))) - truth) ** 2)
        for name in ("hold", "edi", "default")
    }
    assert error["edi"] < error["hold"] / 2
    assert error["default"] < error["edi"]


def test_kalux_itself_is_among_them_unchanged():
    simulation = moving_blocks()
    times = simulation.truth_times()[:4]
    own = reconstruct(simulation.recording(), times=times)
    for image, expected in zip(methods()["default"].images(simulation.recording(), times), own, strict=True):
        assert np.array_equal(image, expected.intensity)
