"""Noise and hot pixels of sensors where they are known."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from kalux import EVENT_DTYPE, Recording
from kalux.calibration import noise
from kalux.calibration.delay import DelayEstimate
from kalux.calibration.noise import (
    calibrate_noise,
    event_noise,
    shrunk_rates,
)
from kalux.datasets import SensorSettings, demo_scene, simulate, static
from kalux.events import make_events
from kalux.planning import plan
from kalux.settings import CameraSettings

from builders import from_black, lifted, unlabelled, without_events

CAMERA = CameraSettings()
SIZE = (64, 96)
NOTHING = np.empty(0, EVENT_DTYPE)
SCENE = demo_scene(sensor_size=(90, 120), duration=600_000)


@lru_cache(maxsize=1)
def noisy():
    """A recording with three events of noise per second and pixel."""
    return unlabelled(simulate(SCENE, SensorSettings(noise_rate=3.0)))


def noise_events(rate, *, hot=(), hot_rate=200.0, seconds=1.0, seed=0):
    """Poisson events of every pixel, and of some hot ones (y, x)."""
    rng = np.random.default_rng(seed)
    rates = np.full(SIZE, rate)
    for y, x in hot:
        rates[y, x] = hot_rate
    counts = rng.poisson(rates * seconds)
    y, x = (np.repeat(i.ravel(), counts.ravel()) for i in np.indices(SIZE))
    t = np.sort(rng.integers(0, int(seconds * 1e6), len(x)))
    order = rng.permutation(len(x))
    return make_events(t, x[order], y[order], rng.integers(0, 2, len(x)))


@pytest.mark.parametrize("rate", [0.3, 3.0])
def test_the_rate_of_pure_noise(rate):
    found = event_noise(Recording.from_arrays(noise_events(rate, seconds=2.0), [], sensor_size=SIZE))
    assert found.rate == pytest.approx(rate, rel=0.08)
    assert found.rate_error < 0.1 * rate
    assert found.rates.mean() == pytest.approx(rate, rel=0.1)


def test_pixels_beyond_a_region_of_interest_are_not_quiet():
    """They are off, and say nothing of the rate of those that are on: it is that of a sensor of this size."""
    events = noise_events(3.0, seconds=2.0)
    inside = (events["y"] >= 16) & (events["y"] < 40) & (events["x"] >= 30) & (events["x"] < 70)
    found = event_noise(Recording.from_arrays(events[inside], [], sensor_size=SIZE))
    cut = events[inside].copy()
    cut["x"] -= 30
    cut["y"] -= 16
    small = event_noise(Recording.from_arrays(cut, [], sensor_size=(24, 40)))
    assert found.rate == pytest.approx(small.rate)
    assert found.rate > 2.0
    assert found.quiet_share == pytest.approx(small.quiet_share)


@pytest.mark.parametrize("improvement", [0.02, 0.04])
def test_a_delay_that_explains_next_to_nothing_is_not_written(monkeypatch, improvement):
    """The one that was best is told."""
    found = DelayEstimate(3_000, improvement, 10_000, 2_000)
    monkeypatch.setattr(noise, "estimate_delay", lambda *_: found)
    monkeypatch.setattr(noise, "with_true_delay", lambda *_, **__: found)
    measured = calibrate_noise(unlabelled(simulate(SCENE)), CAMERA)
    calibration = measured.calibration()
    assert calibration.settings["events"].get("delay") == (2_500 if improvement > 0.03 else None)
    assert calibration.measured["apparent_delay"] == 3_000


@pytest.mark.parametrize("shift", [2 * 10**16, -(10**9)])
def test_times_may_be_of_any_clock(shift):
    """Also of 634 years, where a float's step is 4 us, and of before zero."""
    events = noise_events(3.0, seconds=0.5)
    found = event_noise(Recording.from_arrays(events, [], sensor_size=SIZE))
    events["t"] += shift
    assert event_noise(Recording.from_arrays(events, [], sensor_size=SIZE)).rate == pytest.approx(found.rate)


def test_noise_beside_motion_is_not_much_overestimated():
    """Faint edges that make single events look like noise: an upper bound where everything moves."""
    found = event_noise(noisy())
    assert 2.7 < found.rate < 5.0


def test_faint_edges_that_pass_slowly_are_no_noise():
    """At 25 pixels/s, where neighbours in a row have the same edge 40 ms later, and those in a column 15 ms apart."""
    rng = np.random.default_rng(3)
    y, x, edge = (i.ravel() for i in np.indices((*SIZE, 40)))
    begin = rng.uniform(-4.0, 2.0, 40)
    t = ((begin[edge] + x / 25.0) * 1e6 + rng.normal(0.0, 15_000.0, len(x))).astype(np.int64)
    inside = (t > 0) & (t < 2_000_000)
    edges = make_events(t[inside], x[inside], y[inside], rng.integers(0, 2, int(inside.sum())))
    both = np.concatenate([edges, noise_events(0.5, seconds=2.0)])
    recording = Recording.from_arrays(both[np.argsort(both["t"], kind="stable")], [], sensor_size=SIZE)
    found = event_noise(recording)
    assert event_noise(recording, enough=np.inf).rate > 1.5 * found.rate  # after the first look
    assert found.rate == pytest.approx(0.5, rel=0.3)


def test_a_time_in_which_events_are_lost_is_not_quiet():
    """It would be the quietest of all, and the rate none."""
    whole = noisy()
    found = event_noise(without_events(whole, 200_000, 450_000))
    assert found.rate == pytest.approx(event_noise(whole).rate, rel=0.25)


def test_chunks_that_end_in_lost_events_do_not_matter(monkeypatch):
    recording = without_events(noisy(), 200_000, 450_000)
    whole = event_noise(recording)
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", 777)
    np.testing.assert_array_equal(event_noise(recording).rates, whole.rates)


def test_pixels_that_fire_far_more_often_are_not_counted_in_the_rate():
    busy = [(10, 10), (30, 50), (63, 95)]
    found = event_noise(Recording.from_arrays(noise_events(1.0, hot=busy), [], sensor_size=SIZE))
    assert found.rate == pytest.approx(1.0, rel=0.15)
    assert found.rates[30, 50] > 50


def test_a_pixel_that_says_nothing_among_many_that_do_is_dead():
    events = noise_events(60.0)
    events = events[~((events["x"] == 20) & (events["y"] == 30))]
    found = event_noise(Recording.from_arrays(events, [], sensor_size=SIZE))
    # At 60 Hz hardly anything is quiet, so no rate can be told; at the default gap this is None.
    assert found is None
    sparse = noise_events(40.0, seconds=1.0)
    columns = sparse["x"] >= 48  # the right half noisy, the left half quiet but for one pixel's neighbours
    sparse = sparse[columns & ~((sparse["x"] == 70) & (sparse["y"] == 30))]
    found = event_noise(Recording.from_arrays(sparse, [], sensor_size=SIZE))
    assert found.dead[30, 70]
    assert found.dead.sum() == 1


def test_no_events_tell_nothing():
    assert event_noise(Recording.from_arrays(NOTHING, [], sensor_size=SIZE)) is None


def test_chunks_do_not_matter(monkeypatch):
    recording = Recording.from_arrays(noise_events(2.0), [], sensor_size=SIZE)
    whole = event_noise(recording)
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", 777)
    again = event_noise(recording)
    assert again.rate == whole.rate
    np.testing.assert_array_equal(again.rates, whole.rates)


def test_rates_of_pixels_that_are_seldom_quiet_are_the_typical_one():
    counts = np.zeros((4, 50))
    quiet = np.full((4, 50), 1e-6)
    np.testing.assert_allclose(shrunk_rates(counts, quiet, 2.0, np.zeros((4, 50), bool)), 2.0, rtol=1e-3)


# --- all of it ------------------------------------------------------------------------------------------------


def test_settings_of_a_noise_calibration():
    sensor = SensorSettings(noise_rate=1.0, read_noise=0.008, refractory=300.0)
    found = calibrate_noise(unlabelled(simulate(SCENE, sensor)), CAMERA).calibration()
    assert {"noise_rate", "delay"} <= {*found.settings["events"]}
    assert found.measured["white_level"] >= 0.98
    assert "saturation" not in found.settings["camera"]  # where it is the usual it stays automatic
    assert found.settings["camera"]["frame_noise"] == pytest.approx(0.008, rel=0.2)
    assert {"frame_noise", "shot_noise"} <= {*found.errors}
    assert found.measured["noise_at_half"] >= found.settings["camera"]["frame_noise"]
    assert 300 <= found.measured["refractory_at_most"] < 900
    assert found.maps["hot"].shape == SCENE.sensor_size
    still = calibrate_noise(
        unlabelled(simulate(static(0.5, sensor_size=SIZE, duration=400_000), sensor)), CAMERA
    )
    assert still.delay is None
    assert still.events.rate == pytest.approx(1.0, rel=0.2)


def test_hot_pixels_are_those_of_a_reconstruction():
    sensor = SensorSettings(noise_rate=1.0, hot_pixels=0.002, hot_rate=200.0)
    recording = unlabelled(simulate(SCENE, sensor))
    found = calibrate_noise(recording, CAMERA)
    hot = plan(recording, at="frames").pixels.hot
    assert hot.sum() > 10
    np.testing.assert_array_equal(found.calibration().maps["hot"], hot)
    assert found.calibration().measured["hot_pixels"] == hot.sum()
    assert not (found.events.dead & hot).any()


def test_a_black_level_is_taken_off_and_told():
    plain = calibrate_noise(from_black(3.0), CAMERA)
    found = calibrate_noise(lifted(from_black(3.0), 16), CAMERA)
    assert found.calibration().settings["camera"]["black_level"] == pytest.approx(16 / 255, abs=1 / 255)
    assert found.delay == pytest.approx(plain.delay, abs=200)
    assert found.events.rate == plain.events.rate
    assert "black_level" not in plain.calibration().settings.get("camera", {})
