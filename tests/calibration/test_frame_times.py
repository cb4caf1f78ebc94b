"""Stamps of frames that are off one by one are found by their events, and those that are right are left."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux import Recording
from kalux.calibration import frame_times
from kalux.calibration.frame_times import FrameTimes, _in_order, find_frame_times
from kalux.datasets import SensorSettings, simulate
from kalux.datasets.motion import pan, shake, still
from kalux.datasets.scenes import photograph_scene
from kalux.pipeline import reconstruct
from kalux.planning import plan
from kalux.recording import with_shifted_frames
from kalux.settings import PRESETS, altered

from builders import blocks

SIZE = (48, 64)
KNOWN = altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2, delay=0)
OFF = np.array([0, 3_500, -4_000, 2_000, -1_500, 4_000, -3_000, 500, 3_000, -4_500, 1_000, 0])


def filmed(motion=None, size=SIZE, duration=500_000, **sensor):
    seen = photograph_scene(blocks(), motion or pan(80.0), sensor_size=size, duration=duration)
    made = simulate(seen, SensorSettings(**{"threshold_on": 0.2, "threshold_off": 0.2, **sensor}), seed=1)
    return made.events, made.frames


def recorded(events, frames, off=None):
    """A recording whose stamps are ``off`` by so much, us."""
    source = Recording.from_arrays(events, frames, sensor_size=frames[0].image.shape)
    return source if off is None else with_shifted_frames(source, -off[: len(frames)])


def found(source, known=KNOWN):
    return find_frame_times(source, known.camera, known.events)


def test_stamps_that_are_off_are_found():
    events, frames = filmed(pan(120.0), noise_rate=2.0, read_noise=0.005)
    times = found(recorded(events, frames, OFF))
    assert times is not None
    assert times.left < 0.7
    wrong = times.shifts - OFF[: len(frames)]
    assert np.std(wrong[1:-1]) < 0.15 * np.std(OFF)
    assert times.spread == pytest.approx(np.std(OFF), rel=0.25)


def test_of_many_pixels_some_tell_enough(monkeypatch):
    events, frames = filmed(pan(120.0), (96, 128), noise_rate=2.0, read_noise=0.005)
    monkeypatch.setattr(frame_times, "_MOST_PIXELS", 4_000)  # every second row and column
    times = found(recorded(events, frames, OFF))
    assert times is not None
    wrong = times.shifts - OFF[: len(frames)]
    assert np.std(wrong[1:-1]) < 0.15 * np.std(OFF)


@pytest.mark.parametrize("motion", [pan(80.0), pan(20.0), still()])
def test_right_stamps_are_left(motion):
    assert found(recorded(*filmed(motion, noise_rate=2.0))) is None


def test_what_all_stamps_have_in_common_is_the_delay_of_the_events():
    events, frames = filmed()
    late = events.copy()
    late["t"] += 5_000
    assert found(recorded(late, frames)) is None


def test_thresholds_that_are_wrong_do_not_hide_them():
    """Events that change 0.13 are taken for 0.2: what all intervals have in common is no error of times."""
    events, frames = filmed(
        pan(120.0), (96, 128), noise_rate=2.0, read_noise=0.005, threshold_on=0.13, threshold_off=0.13
    )
    times = found(recorded(events, frames, OFF))
    assert times is not None
    assert np.std((times.shifts - OFF[: len(frames)])[1:-1]) < 0.15 * np.std(OFF)


def test_events_that_are_lost_where_a_camera_shakes_are_no_error_of_stamps():
    """The faster it moves, the more events fall into the refractory period: a gain of each interval explains more."""
    thresholds = {"threshold_on": 0.1, "threshold_off": 0.1}
    made = filmed(shake(7, amplitude=5.0), (144, 192), 800_000, refractory=1_500, **thresholds)
    assert found(recorded(*made), altered(KNOWN, "events", **thresholds)) is None


def test_few_frames_tell_nothing():
    events, frames = filmed()
    assert found(recorded(events, frames[:1])) is None
    assert found(recorded(events, frames[:2], OFF)) is None


def test_a_plan_corrects_them_unless_told_not_to():
    events, frames = filmed(read_noise=0.002)
    right, wrong = recorded(events, frames), recorded(events, frames, OFF)
    times = [*range(100_000, 400_000, 10_000)]
    made = plan(wrong, times=times)
    assert made.mends.moved.times is not None
    assert made.mends.changes
    images = [
        np.log(
            np.array([image.intensity for image in reconstruct(source, times=times, settings=settings)])
            + 0.01
        )
        for source, settings in (
            (right, PRESETS["default"]),
            (wrong, PRESETS["default"]),
            (wrong, altered(PRESETS["default"], "camera", mend_times=False)),
        )
    ]
    corrected, kept = (float(np.mean(np.square(each - images[0]))) for each in images[1:])
    assert corrected < 0.5 * kept
    assert plan(right, times=times).mends.moved.times is None
    assert plan(wrong, times=times, preset="iccv2021").mends.moved.times is None


def test_frames_that_are_left_out_keep_their_place():
    """Copies between frames whose stamps are off: what is found is of those that are left."""
    events, frames = filmed(read_noise=0.002)
    wrong = [*recorded(events, frames, OFF).frames()]
    copied = []
    for index, frame in enumerate(wrong):
        copied.append(frame)
        if index % 4 == 2:
            length = frame.exposure_end - frame.exposure_start
            later = (frame.exposure_end, frame.exposure_end + min(length, 500))
            copied.append(
                dataclasses.replace(
                    frame, image=frame.image.copy(), exposure_start=later[0], exposure_end=later[1]
                )
            )
    made = plan(Recording.from_arrays(events, copied, sensor_size=SIZE), rate_hz=20)
    assert made.mends.corrections.left_out == tuple(
        i for i, f in enumerate(copied) if not any(f is w for w in wrong)
    )
    assert made.mends.moved.times is not None
    assert len(made.mends.moved.times.shifts) == len(copied)
    kept = [i for i, f in enumerate(copied) if any(f is w for w in wrong)]
    wrong_by = made.mends.moved.times.shifts[kept] - OFF[: len(frames)]
    assert np.std(wrong_by[1:-1]) < 0.4 * np.std(OFF)


def test_times_of_frames_that_are_left_out_are_between_those_around():
    times, apart = FrameTimes(np.array([-100, 300, 200]), 0.5), np.arange(5)[:, np.newaxis] * 1000 + [0, 10]
    assert times.of_all(apart[:3], ()).shifts.tolist() == [-100, 300, 200]
    assert times.of_all(apart, (1, 4)).shifts.tolist() == [-100, 100, 300, 200, 200]


@given(
    st.lists(
        st.tuples(st.integers(0, 20_000), st.integers(1, 9_000), st.integers(-15_000, 15_000)), min_size=1
    )
)
def test_frames_stay_in_order_and_the_recording_as_long(drawn):
    start, exposures = 0, []
    for gap, length, _ in drawn:
        exposures.append((start + gap, start + gap + length))
        start = exposures[-1][1]
    stored = np.array(exposures)
    moved = stored + _in_order(stored, np.array([shift for *_, shift in drawn]))[:, np.newaxis]
    assert (moved[1:, 0] >= moved[:-1, 1]).all()
    assert moved[0, 0] <= stored[0, 0]
    assert moved[-1, 1] >= stored[-1, 1]
