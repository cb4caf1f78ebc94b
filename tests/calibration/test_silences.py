"""Times without an event: those in which events were lost."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux import Recording
from kalux.augmentation.lost import lost_time
from kalux.calibration.silences import MissingWatch, find_silences, overlaps
from kalux.datasets import SensorSettings, simulate
from kalux.datasets.motion import pan
from kalux.datasets.scenes import Scene, photograph_scene

from builders import blocks, moving_blocks, unlabelled, without_events


def test_silences_in_which_frames_change_are_found_the_longest_first():
    whole = unlabelled(moving_blocks(duration=1_000_000))
    assert find_silences(whole) == []
    cut = without_events(without_events(whole, 100_000, 350_000), 500_000, 900_000)
    (first, second) = find_silences(cut)
    assert first == (pytest.approx(500_000, abs=10_000), pytest.approx(900_000, abs=10_000))
    assert second == (pytest.approx(100_000, abs=10_000), pytest.approx(350_000, abs=10_000))


LOSSY = without_events(without_events(moving_blocks().recording(), 110_000, 130_000), 300_000, 312_000)


@given(st.lists(st.integers(1, 20_000), max_size=6))
def test_events_are_missing_in_the_same_intervals_however_they_are_cut(cuts):
    events = np.concatenate([*LOSSY.events()])
    frames = [*LOSSY.frames()]
    watch = MissingWatch(np.array([(frame.exposure_start, frame.exposure_end) for frame in frames]))
    for chunk in np.split(events, sorted(min(cut, len(events)) for cut in cuts)):
        if len(chunk):
            watch.see(chunk)
    watch.finish()
    middles = [frame.middle for frame in frames]
    between = [
        events[(events["t"] > start) & (events["t"] <= end)] for start, end in itertools.pairwise(middles)
    ]
    lost = [lost_time([some], int(some["t"][0]), int(some["t"][-1])) for some in between]
    found = watch.found
    assert (found.intervals, found.lossy, found.time) == (len(lost), np.count_nonzero(lost), sum(lost))
    assert found.lossy >= 2
    assert found.first == middles[next(k for k, time in enumerate(lost) if time)]


def test_a_silence_in_which_the_frames_end_is_found_though_events_come_after_them():
    cut = without_events(unlabelled(moving_blocks(duration=1_000_000)), 500_000, 900_000)
    frames = [frame for frame in cut.frames() if frame.exposure_end < 850_000]
    (events,) = cut.events()
    short = Recording.from_arrays(events, frames, sensor_size=cut.sensor_size)
    assert find_silences(short) == [(pytest.approx(500_000, abs=10_000), frames[-1].exposure_end)]


def test_where_frames_stand_still_silence_is_as_it_should_be():
    made = moving_blocks(duration=1_000_000)
    still = [
        dataclasses.replace(f, image=made.frames[7].image) if 300_000 < f.middle < 700_000 else f
        for f in made.frames
    ]
    whole = Recording.from_arrays(made.events, still, sensor_size=made.scene.sensor_size)
    assert find_silences(without_events(whole, 300_000, 700_000)) == []


def test_what_moves_now_and_then_leaves_silences_as_they_should_be():
    """Most frames are still then, and change by their noise: about as much in a silence as in most others."""
    passing = photograph_scene(blocks(), pan(60.0), sensor_size=(32, 40), duration=2_000_000)

    def moved(t):
        return t // 400_000 * 80_000 + min(t % 400_000, 80_000)

    scene = Scene(lambda t: passing.at(int(moved(t))), (32, 40), 0, 2_000_000)
    made = simulate(scene, SensorSettings(read_noise=0.005), seed=1)
    whole = unlabelled(made)
    assert len(made.events) > 5_000
    assert find_silences(whole) == []


def test_only_the_frames_that_are_asked_for_are_looked_at():
    cut = without_events(unlabelled(moving_blocks(duration=1_000_000)), 500_000, 900_000)
    assert find_silences(cut, most_frames=10) == []
    assert find_silences(cut, end=480_000) == []
    (events,) = cut.events()
    assert find_silences(Recording.from_arrays(events, [], sensor_size=cut.sensor_size)) == []


def test_overlaps():
    silences = [(10, 20), (40, 50)]
    assert overlaps(silences, 15, 16)
    assert overlaps(silences, 0, 11)
    assert overlaps(silences, 19, 60)
    assert not overlaps(silences, 20, 40)
    assert not overlaps([], 0, 100)
