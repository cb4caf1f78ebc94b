"""What `kalux calibrate contrast` measures, from recordings whose thresholds are known."""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import numpy as np
import pytest

import kalux
from kalux import Recording
from kalux.calibration import pixel_thresholds
from kalux.calibration.pixel_thresholds import calibrate_contrast, shrunk
from kalux.calibration.refractory import Period
from kalux.datasets import SensorSettings, demo_scene, simulate, static
from kalux.settings import CameraSettings

from builders import from_black, lifted, pixel_events, quick_frames, unlabelled

CAMERA = CameraSettings()
SCENE = demo_scene(sensor_size=(90, 120))


def first_frames(recording, count, start=0):
    """A recording of some frames, with the events around them."""
    frames = list(recording.frames())[start : start + count]
    t = np.concatenate(list(recording.events()))
    inside = (t["t"] >= frames[0].exposure_start - 5_000) & (t["t"] <= frames[-1].exposure_end + 20_000)
    return Recording.from_arrays(t[inside], frames, sensor_size=recording.sensor_size)


SENSOR = SensorSettings(
    threshold_on=0.25, threshold_off=0.2, threshold_mismatch=0.1, noise_rate=3.0, read_noise=0.006
)


@pytest.fixture(scope="module")
def simulation():
    """A window in a dim room, a part of it saturated; 10 % mismatch and noise."""
    return simulate(SCENE, SENSOR)


@lru_cache(maxsize=2)
def noiseless(period):
    """Of a sensor without noise and with a refractory period."""
    sensor = SensorSettings(threshold_on=0.3, threshold_off=0.2, refractory=period)
    return unlabelled(simulate(demo_scene(sensor_size=(60, 80)), sensor))


@pytest.fixture(scope="module")
def found(simulation):
    return calibrate_contrast(unlabelled(simulation), CAMERA)


def test_within_five_percent_with_mismatch_noise_and_saturation(simulation, found):
    assert np.mean([frame.image == 255 for frame in simulation.frames]) > 0.02
    assert found.on == pytest.approx(0.25, rel=0.05)
    assert found.off == pytest.approx(0.2, rel=0.05)


def test_within_fifteen_percent_by_frames_every_two_milliseconds():
    """Between two of them too little moves."""
    found = calibrate_contrast(unlabelled(quick_frames()), CAMERA)
    assert found.on == pytest.approx(0.3, rel=0.15)
    assert found.off == pytest.approx(0.35, rel=0.15)


def test_within_fifteen_percent_from_five_frames(simulation):
    for start in (0, 12):
        few = calibrate_contrast(first_frames(unlabelled(simulation), 5, start), CAMERA)
        assert few.intervals == 4
        assert few.on == pytest.approx(0.25, rel=0.15)
        assert few.off == pytest.approx(0.2, rel=0.15)


def test_the_refractory_period_is_made_up_for_where_it_is_known():
    """With 500 us lost after every event the plain fit is several percent too large."""
    recording = noiseless(500.0)
    known = calibrate_contrast(recording, CAMERA, delay=0, refractory=500)
    plain = calibrate_contrast(recording, CAMERA, delay=0, refractory=0)
    assert known.on == pytest.approx(0.3, rel=0.05)
    assert known.off == pytest.approx(0.2, rel=0.05)
    assert plain.off > 1.04 * known.off
    assert known.calibration().settings["events"]["refractory_period"] == 500
    assert "refractory_spread" not in known.calibration().settings["events"]
    assert "refractory_period" not in plain.calibration().settings["events"]


@pytest.mark.parametrize(("period", "found"), [(500.0, (350, 550)), (0.0, (0, 0))])
def test_a_refractory_period_that_no_noise_shows_is_found(period, found):
    """By what explains the frames, and its own error is one of the thresholds."""
    recording = noiseless(period)
    told, known = (calibrate_contrast(recording, CAMERA, refractory=us) for us in (None, int(period)))
    assert told.on == pytest.approx(0.3, rel=0.04)
    assert told.off == pytest.approx(0.2, rel=0.04)
    assert found[0] <= told.refractory <= found[1]
    assert (told.on_error > 1.5 * known.on_error) == (period > 0)
    assert (told.calibration().settings["events"].get("refractory_spread", 0) > 0.01) == (period > 0)


def test_a_region_of_interest_is_measured_as_a_sensor_of_its_size(simulation):
    """Pixels beside it are off: that they change without events says nothing."""
    events = simulation.events
    inside = (events["y"] >= 20) & (events["y"] < 70) & (events["x"] >= 30) & (events["x"] < 100)
    recording = Recording.from_arrays(events[inside], simulation.frames, sensor_size=(90, 120))
    part = calibrate_contrast(recording, CAMERA)
    cut = events[inside].copy()
    cut["x"] -= 30
    cut["y"] -= 20
    frames = [dataclasses.replace(f, image=f.image[20:70, 30:100].copy()) for f in simulation.frames]
    small = calibrate_contrast(Recording.from_arrays(cut, frames, sensor_size=(50, 70)), CAMERA)
    assert part.on == pytest.approx(small.on, rel=0.003)
    assert part.off == pytest.approx(small.off, rel=0.003)
    beside = np.ones((90, 120), np.bool_)
    beside[20:70, 30:100] = False
    assert (part.on_factor[beside] == part.on_factor[0, 0]).all()


def test_where_the_direction_turns_nothing_is_added():
    """K13: meanwhile the light may have moved either way."""
    everywhere = np.ones((1, 1), np.bool_)
    sampling = pixel_thresholds._Sampling((0.2, 0.2), 1000, Period(1000), everywhere)
    history = pixel_thresholds._History((1, 1), sampling)
    on, off, _ = history.counts(pixel_events([10_000, 13_500, 17_000], [True, False, False]))
    going_on = 1 + 1 / np.hypot(2.5, 0.2)
    assert (on[0, 0], off[0, 0]) == (1.0, pytest.approx(1.0 + going_on))


def test_the_spread_is_found_and_standard_errors_are_small(found):
    for spread in (found.spread_on, found.spread_off):
        assert spread == pytest.approx(0.1, abs=0.035)
    assert found.on_error < 0.01 * found.on
    assert found.off_error < 0.01 * found.off


def test_pixels_have_the_error_that_they_claim(simulation, found):
    """Standardised errors of the pixels' thresholds are within 30 % of one, and the errors beat those of the mean."""
    truths = (simulation.threshold_on, simulation.threshold_off)
    maps = ((found.on_factor, found.on_variance), (found.off_factor, found.off_variance))
    for truth, (factor, variance) in zip(truths, maps, strict=True):
        told = variance < 0.8 * variance.max()
        assert told.sum() > 100
        error = (factor - truth / truth.mean())[told]
        assert (error / np.sqrt(variance[told])).std() == pytest.approx(1.0, abs=0.3)
        assert error.std() < 0.8 * (truth / truth.mean())[told].std()


def test_a_delay_of_the_events_is_recovered(simulation, found):
    assert abs(found.delay) < 1_500
    events = simulation.events.copy()
    events["t"] += 5_000
    late = Recording.from_arrays(events, simulation.frames, sensor_size=simulation.scene.sensor_size)
    again = calibrate_contrast(late, CAMERA)
    assert again.delay - found.delay == pytest.approx(5_000, abs=1_500)
    assert again.on == pytest.approx(0.25, rel=0.08)


def test_halves_of_slider_depth_agree(shared_data):
    """ON within 3 %, OFF within 15 % (measured: 0.732 and 0.738, 0.490 and 0.436)."""
    recording = kalux.open(shared_data / "slider_depth", exposure=10_000)
    first, second = (
        calibrate_contrast(first_frames(recording, 44, start), CAMERA, delay=0) for start in (0, 43)
    )
    assert second.on == pytest.approx(first.on, rel=0.05)
    assert second.off == pytest.approx(first.off, rel=0.15)


def test_a_still_scene_tells_nothing():
    scene = static(0.4, sensor_size=(32, 40), duration=300_000)
    assert calibrate_contrast(unlabelled(simulate(scene, SensorSettings(noise_rate=1.0))), CAMERA) is None


def test_noise_and_lamps_tell_nothing(shared_data):
    """A bench before which nothing moves: counts alone would find thresholds of 0.004 and 0.015."""
    assert calibrate_contrast(kalux.open(shared_data / "bench_davis346.aedat4"), CAMERA) is None


def test_shrinkage_finds_mean_and_covariance():
    rng = np.random.default_rng(3)
    truth = rng.multivariate_normal([0.0, 0.0], [[0.04, 0.01], [0.01, 0.02]], 4000)
    normal = np.column_stack([rng.uniform(10, 200, 4000), np.zeros(4000), rng.uniform(10, 200, 4000)])
    noisy = truth + rng.standard_normal((4000, 2)) / np.sqrt(normal[:, [0, 2]])
    normal[:500] = 0.0  # say nothing
    mean, covariance, values, left = shrunk(normal, normal[:, [0, 2]] * noisy)
    np.testing.assert_allclose(mean, 0.0, atol=0.02)
    np.testing.assert_allclose(covariance, [[0.04, 0.01], [0.01, 0.02]], atol=0.005)
    np.testing.assert_allclose(values[:500], 0.0, atol=1e-9)
    np.testing.assert_allclose(left[:500, 0], covariance[0, 0], rtol=0.01)
    error = (values - truth)[500:]
    np.testing.assert_allclose((error**2 / left[500:]).mean(axis=0), 1.0, atol=0.1)


def test_a_black_level_is_taken_off_and_told():
    """Left in, thresholds come out a third too small: frames change too little in the dark."""
    plain = calibrate_contrast(from_black(), CAMERA)
    source = lifted(from_black(), 16)
    found = calibrate_contrast(source, CAMERA)
    assert (found.on, found.off) == pytest.approx((plain.on, plain.off), rel=0.05)
    told = found.calibration().settings["camera"]["black_level"]
    assert told == found.black_level == pytest.approx(16 / 255, abs=1 / 255)
    left = calibrate_contrast(source, dataclasses.replace(CAMERA, black_level=0.0))
    assert left.on < 0.8 * plain.on
    assert left.calibration().settings["camera"] == {"black_level": 0}
    assert "camera" not in plain.calibration().settings
