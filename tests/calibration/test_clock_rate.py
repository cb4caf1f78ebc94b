"""A clock of the frames that is fast or slow is found by what events say all over; a right one is left."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux import Recording
from kalux.calibration import clock_rate
from kalux.calibration.clock_rate import Offsets, _line, _stretches, find_clock_rate, offsets
from kalux.datasets import SensorSettings, simulate
from kalux.datasets.motion import combine, handheld, spin
from kalux.datasets.scenes import photograph_scene
from kalux.errors import EventError
from kalux.evaluation.held_out import hold_out_frames
from kalux.pipeline import execute, reconstruct
from kalux.planning import plan
from kalux.recording import with_frames, with_shifted_frames
from kalux.settings import PRESETS, altered

from builders import blocks

SIZE = (48, 64)
CAMERA = PRESETS["default"].camera
TIMES = [*range(12_000_000, 13_000_000, 50_000)]


@lru_cache(maxsize=1)
def filmed():
    """14 s of a camera in the hand, 25 frames a second."""
    seen = photograph_scene(blocks(), combine(handheld(3), spin(0.05)), sensor_size=SIZE, duration=14_000_000)
    made = simulate(seen, SensorSettings(threshold_on=0.3, threshold_off=0.3, frame_rate=25.0), seed=1)
    return made.events, made.frames


def recorded(rate=0.0):
    """A recording whose frames' clock is slow by this rate."""
    source = Recording.from_arrays(*filmed(), sensor_size=SIZE)
    middles = exposures_of(source).mean(axis=1)
    return with_shifted_frames(source, np.round(-rate * (middles - middles[0])).astype(np.int64))


def exposures_of(source):
    return np.array([(frame.exposure_start, frame.exposure_end) for frame in source.frames()], np.int64)


def found(source):
    return find_clock_rate(source, CAMERA, exposures_of(source))


@pytest.mark.parametrize("rate", [2e-3, -1e-3])
def test_a_rate_is_found(rate):
    source = recorded(rate)
    clock = found(source)
    assert clock is not None
    assert clock.rate == pytest.approx(rate, abs=1.5e-4)
    assert abs(clock.rate - rate) < 4 * clock.standard_error
    assert clock.shifts[0] == 0
    assert clock.shifts[-1] == pytest.approx(clock.rate * np.ptp(exposures_of(source).mean(axis=1)), abs=1)


def test_a_right_clock_is_left():
    assert found(recorded()) is None


def test_events_that_are_late_throughout_are_not_a_rate():
    source = recorded()
    count = source.source.count_frames()
    assert found(with_shifted_frames(source, np.full(count, -20_000))) is None


@pytest.mark.parametrize(("rate", "enough"), [(0.0, True), (2e-3, False), (-5e-4, False)])
def test_of_a_right_clock_the_ends_of_the_recording_are_read_alone(rate, enough, monkeypatch):
    """Whether or not later events can be read without those before them."""
    asked = []
    seen = clock_rate.offsets
    monkeypatch.setattr(
        clock_rate,
        "offsets",
        lambda *given, **named: (asked.append(len(given[2])), seen(*given, **named))[1],
    )
    source = recorded(rate)
    rewound = Recording(dataclasses.replace(source.source, events=source.source.events.whole))
    assert source.is_seekable
    assert not rewound.is_seekable
    stretches = len(_stretches(exposures_of(source)))
    assert stretches > 6
    told = [found(either) for either in (source, rewound)]
    assert asked == 2 * ([6] if enough else [6, stretches])
    assert (told[0] is None) == (told[1] is None)
    if told[0] is not None:
        assert told[0].rate == told[1].rate


def test_where_the_ends_do_not_tell_all_is_read_unless_too_little_is_left(monkeypatch):
    source, asked = recorded(2e-3), []
    seen = clock_rate.offsets

    def without_ends(recording, camera, stretches, **named):
        asked.append(len(stretches))
        if len(stretches) == 6:
            return Offsets(np.empty(0), np.empty(0))
        return seen(recording, camera, stretches, **named)

    monkeypatch.setattr(clock_rate, "offsets", without_ends)
    many = [slice(24 * k, 24 * k + 24) for k in range(14)]
    for count, read in ((13, [6]), (14, [6, 14])):
        monkeypatch.setattr(clock_rate, "_stretches", lambda _, count=count: many[:count])
        asked.clear()
        clock = found(source)
        assert asked == read
        assert (clock is not None) == (len(read) == 2)


def test_nothing_is_read_of_a_recording_that_is_too_short():
    source = recorded(2e-3)
    short = with_frames(source, lambda: pytest.fail("read"))
    assert find_clock_rate(short, CAMERA, exposures_of(source)[:280]) is None


def test_stretches_in_which_nothing_can_be_told_are_passed_over():
    """The middle has no events; the frames of the first stretch follow each other in 2 ms, so that few are compared."""
    events, _ = filmed()
    source = recorded(2e-3)
    frames = [*source.frames()]
    hasty = [
        dataclasses.replace(frame, exposure_start=900_000 + 2_000 * i, exposure_end=901_000 + 2_000 * i)
        for i, frame in enumerate(frames[:25])
    ]
    without = (events["t"] > 5_000_000) & (events["t"] < 8_000_000)
    part = Recording.from_arrays(events[~without], hasty + frames[25:], sensor_size=SIZE)
    told = offsets(part, CAMERA, _stretches(exposures_of(part)))
    assert len(told.times) >= 3
    assert told.times[0] > 1_000_000
    assert not ((told.times > 5_500_000) & (told.times < 7_500_000)).any()
    assert np.std(told.offsets - 2e-3 * told.times) < 3_000


def test_an_event_that_is_outside_the_sensor_is_told():
    events = filmed()[0].copy()
    events["x"][len(events) // 2] = 1_000
    right = Recording.from_arrays(*filmed(), sensor_size=SIZE)
    wrong = Recording(dataclasses.replace(right.source, events=lambda: iter([events])))
    with pytest.raises(EventError, match="1000"):
        found(wrong)


def test_a_plan_corrects_the_clock_unless_told_not_to():
    kept = altered(PRESETS["default"], "camera", mend_times=False)
    wrong = recorded(2e-3)
    made, left = (plan(wrong, times=TIMES, settings=settings) for settings in (PRESETS["default"], kept))
    assert made.mends.moved.clock is not None
    assert made.mends.changes
    assert left.mends.moved.clock is None
    assert plan(wrong, times=TIMES, preset="iccv2021").mends.moved.clock is None
    right, corrected, uncorrected = (
        np.log(np.array([image.intensity for image in images]) + 0.01)
        for images in (
            reconstruct(recorded(), times=TIMES, settings=kept),
            execute(wrong, made),
            execute(wrong, left),
        )
    )
    assert np.mean(np.square(corrected - right)) < 0.3 * np.mean(np.square(uncorrected - right))


def test_held_out_frames_are_compared_in_the_events_clock():
    wrong = recorded(2e-3)
    held = hold_out_frames(wrong)
    assert held.clock is not None
    assert "times of frames stretched by" in held.described()
    last = exposures_of(wrong)[held.compared[-1]]
    assert held.times[-1, 0] - last[0] == pytest.approx(2e-3 * last.mean(), rel=0.1)
    assert hold_out_frames(recorded()).clock is None


@given(
    st.floats(-3e-3, 3e-3), st.floats(-1e5, 1e5), st.integers(8, 24), st.integers(0, 7), st.floats(-1e5, 1e5)
)
def test_a_line_is_found_in_spite_of_one_stretch(rate, offset, count, wrong, by):
    times = np.linspace(1e6, 6e7, count)
    exact = offset + rate * times
    assert _line(Offsets(times, exact)).slope == pytest.approx(rate, abs=1e-9)
    scattered = exact + np.resize([800.0, -900.0, 300.0, -200.0], count)
    scattered[wrong] += by
    line = _line(Offsets(times, scattered))
    assert line.slope == pytest.approx(rate, abs=1e-4)
    assert line.standard_error > 0
    assert line.scatter > 300


def test_offsets_that_wander_are_no_rate(monkeypatch):
    """An even pan has offsets anywhere; some seem to follow each other."""
    source = recorded()
    monkeypatch.setattr(clock_rate, "_ends_suffice", lambda *_: False)
    times = np.linspace(0, 14e6, 8)
    wandering = np.array([0, 9, 12, 30, 26, 45, 61, 62]) * 1e3
    for factor, is_one in ((2.0, False), (0.5, True)):
        seen = Offsets(times, factor * wandering)
        monkeypatch.setattr(clock_rate, "offsets", lambda *_, seen=seen: seen)
        assert (found(source) is not None) == is_one


@given(st.integers(2, 100_000), st.integers(1_000, 1_000_000))
def test_stretches_do_not_overlap(count, interval):
    starts = interval * np.arange(count, dtype=np.int64)
    chosen = _stretches(np.stack([starts, starts + 500], axis=1))
    assert len(chosen) in (0, *range(8, 25))
    for before, after in pairwise(chosen):
        assert after.start - before.start >= 1.4 * (before.stop - before.start)
    if chosen:
        assert chosen[0].start == 0
        assert chosen[-1].stop == count
        assert (chosen[0].stop - chosen[0].start) * interval >= 1_000_000
