"""The times of images: a grid, the frames, or as given."""

from __future__ import annotations

import numpy as np
import pytest

from kalux import PRESETS, Frame, Reconstructor, Recording, reconstruct
from kalux.errors import InputError
from kalux.events import make_events
from kalux.pipeline import plan
from kalux.schedule import begin_time

from builders import VARIANTS, events, frame, random_stream, recording

every_variant = pytest.mark.parametrize("variant", VARIANTS)


@pytest.mark.parametrize(("preset", "lookahead"), [("default", True), ("default", False), ("cf", True)])
def test_images_begin_where_the_engine_can_read_first(preset, lookahead):
    settings, first = PRESETS[preset], frame(9, 1_000, 9_000)
    engine = Reconstructor((1, 1), settings=settings, lookahead=lookahead)
    engine.push_frame(first)
    exposure = np.array([first.exposure_start, first.exposure_end])
    assert begin_time(exposure, settings.filter, lookahead) == engine.begin_time


@pytest.mark.parametrize("rate", [1.0, 24.0, 30.0, 300.0, 59.94, 12_345.6])
def test_a_rate_is_a_grid_without_drift_up_to_the_last_exposure(rate):
    times = plan(recording(), rate_hz=rate).times
    frames = list(recording().frames())
    begin, end = frames[0].exposure_start, frames[-1].exposure_end
    assert times[0] == begin
    assert times[-1] <= end < times[-1] + 1e6 / rate + 1
    assert np.abs(times - begin - np.arange(len(times)) * 1e6 / rate).max() <= 0.5


def test_a_rate_ends_on_the_last_exposures_end_where_it_falls_there():
    rec = Recording.from_arrays(
        events(), [frame(9, 0, 10_000), frame(9, 90_000, 100_000)], sensor_size=(1, 1), contrast_threshold=0.2
    )
    assert plan(rec, rate_hz=30).times.tolist() == [0, 33333, 66667, 100_000]
    assert plan(rec, rate_hz=100).times.tolist() == list(range(0, 100_001, 10_000))


def test_at_the_frames():
    middles = [shot.middle for shot in recording().frames()]
    assert plan(recording(), at="frames").times.tolist() == middles
    assert plan(recording(), at="frames", lookahead=False).times.tolist() == middles[1:]
    assert [image.t for image in reconstruct(recording(), at="frames")] == middles


def test_given_times_may_reach_to_a_last_event_of_a_hot_pixel():
    """Its events are left out, but the recording has them."""
    rng = np.random.default_rng(0)
    some, hot = np.sort(rng.integers(0, 2_000_000, 5_000)), np.arange(1_000, 2_100_000, 5_000)
    t = np.concatenate([some, hot])
    x, y = (np.concatenate([rng.integers(0, 32, len(some)), np.full(len(hot), at)]) for at in (3, 5))
    p = np.concatenate([rng.random(len(some)) < 0.5, np.ones(len(hot), np.bool_)])
    order = np.argsort(t, kind="stable")
    stream = make_events(t[order], x[order], y[order], p[order])
    frames = [
        Frame(rng.integers(0, 256, (32, 32), np.uint8), 50_000 * k, 50_000 * k + 10_000) for k in range(38)
    ]
    filmed = Recording.from_arrays(stream, frames, sensor_size=(32, 32))
    made = plan(filmed, times=[0, int(hot[-1])])
    assert made.mends.hot_pixels == 1
    assert made.times[-1] == hot[-1]
    with pytest.raises(InputError, match="after the recording's end"):
        plan(filmed, times=[0, int(hot[-1]) + 1])


def test_given_times_may_repeat_and_reach_to_the_last_event():
    frames, last = list(recording().frames()), int(random_stream(0).events["t"][-1])
    assert last > frames[-1].exposure_end
    wanted = [frames[0].exposure_start, frames[1].middle, frames[1].middle, last]
    images = list(reconstruct(recording(), times=np.array(wanted, np.uint32)))
    assert [image.t for image in images] == wanted
    np.testing.assert_array_equal(images[1].intensity, images[2].intensity)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "exactly one of rate_hz, times and at"),
        ({"rate_hz": 10, "times": [1]}, "exactly one"),
        ({"rate_hz": 10, "at": "frames"}, "exactly one"),
        ({"times": [1], "at": "frames", "rate_hz": 1}, "exactly one"),
        ({"at": "events"}, "at is 'events'; only 'frames'"),
        ({"rate_hz": 0}, "rate is 0 Hz"),
        ({"rate_hz": -5}, "rate is -5 Hz"),
        ({"rate_hz": float("nan")}, "rate is nan Hz"),
        ({"rate_hz": float("inf")}, "rate is inf Hz"),
        ({"rate_hz": 2e6}, "at most 1e6"),
        ({"rate_hz": 1e-320}, "at least 1e-6"),
        ({"rate_hz": "100"}, "rate is '100' Hz"),
        ({"times": []}, "at least one"),
        ({"times": 30_000}, "times must be a list"),
        ({"times": [30_000.5]}, "whole microseconds"),
        ({"times": [30_000, 1e300]}, r"times\[1\] is 1e\+300; whole microseconds"),
        ({"times": [30_000, np.nan]}, r"times\[1\] is nan; whole microseconds"),
        ({"times": [40_000, 39_999]}, r"times\[1\] is 39999 us, before 40000 us.*; times must not go back"),
        ({"times": [19_999]}, "19999 us lies before 20000 us"),
        ({"times": [30_000, 10**9]}, "1000000000 us lies after the recording's end"),
    ],
)
def test_times_that_cannot_be(options, message):
    """Before the first image, not while iterating."""
    with pytest.raises(InputError, match=message):
        reconstruct(recording(), **options)


@pytest.mark.parametrize(("last", "rate"), [(1_700_000_000_000_000, 100), (3_600_000_000, 1e6)])
def test_more_images_than_memory_holds_are_refused(last, rate):
    """One damaged time stamp in a recording makes years of it."""
    rec = Recording.from_arrays(
        events(),
        [frame(9, 0, 10_000), frame(9, last, last + 10_000)],
        sensor_size=(1, 1),
        contrast_threshold=0.2,
    )
    with pytest.raises(InputError, match=r"100,000,000 at most are possible\. Are the frames' times right"):
        plan(rec, rate_hz=rate)


def test_times_may_be_floats_that_are_whole():
    times = np.linspace(30_000, 50_000, 3)
    assert [image.t for image in reconstruct(recording(), times=times)] == [30_000, 40_000, 50_000]


@every_variant
def test_times_outside_depend_on_the_mode(variant):
    first = next(iter(recording().frames()))
    options = {"settings": VARIANTS[variant], "lookahead": False}
    with pytest.raises(InputError, match=f"lies before {first.exposure_end} us"):
        reconstruct(recording(), times=[first.exposure_end - 1], **options)
    assert len(list(reconstruct(recording(), times=[first.exposure_end], **options))) == 1
