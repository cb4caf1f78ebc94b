"""The delay of events against frames."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kalux import PRESETS, Recording, reconstruct
from kalux.calibration import delay
from kalux.calibration.delay import best_delay, delays, estimate_delay
from kalux.calibration.pixel_thresholds import calibrate_contrast
from kalux.datasets import SensorSettings, demo_scene, pan, photograph_scene, simulate
from kalux.planning import plan
from kalux.settings import CameraSettings, altered

from builders import moving_blocks, quick_frames, unlabelled

CAMERA = CameraSettings()


def late(simulation, by):
    """The simulated recording with all events stamped ``by`` us later."""
    events = simulation.events.copy()
    events["t"] += by
    frames, size = simulation.frames, simulation.frames[0].image.shape
    return Recording.from_arrays(events, frames, sensor_size=size)


@pytest.fixture(scope="module")
def simulation():
    return moving_blocks(
        0.05, 0.8, sensor=SensorSettings(threshold_on=0.15, threshold_off=0.15), size=(48, 64)
    )


@pytest.mark.parametrize("by", [-5_000, -2_000, 3_000, 6_000])
def test_a_shift_of_the_events_is_found(simulation, by):
    """To 0.6 ms of what is found without one, which is the half threshold by which events trail.

    Blocks of one contrast leave a valley that is flat over 2 ms.
    """
    trail = estimate_delay(late(simulation, 0), CAMERA).apparent
    assert 0 <= trail < 5_000
    assert estimate_delay(late(simulation, by), CAMERA).apparent == pytest.approx(trail + by, abs=600)


@pytest.mark.parametrize("by", [-18_000, 20_000, 30_000])
def test_so_is_a_clock_that_started_apart(simulation, by):
    """Where no delay of a sensor is best."""
    trail = estimate_delay(late(simulation, 0), CAMERA).apparent
    found = estimate_delay(late(simulation, by), CAMERA)
    assert found.apparent == pytest.approx(trail + by, abs=900)
    assert found.improvement > 0.5


def test_of_frames_every_two_milliseconds_too():
    """A shift by more than their interval compares events with another change, which may fit as well or not at all."""
    found = estimate_delay(unlabelled(quick_frames()), CAMERA)
    assert 5_000 < found.apparent < 8_000
    assert found.improvement > 0.2


def test_slow_pixels_of_a_dim_scene_are_followed():
    """They lag by 3 ms at white, and the more the darker: the valley is wide, no delay far better than others."""
    sensor = SensorSettings(
        threshold_on=0.2,
        threshold_off=0.2,
        threshold_mismatch=0.1,
        cutoff=50.0,
        noise_rate=1.0,
        read_noise=0.005,
    )
    recording = unlabelled(simulate(demo_scene(sensor_size=(90, 120), duration=700_000), sensor))
    assert estimate_delay(recording, CAMERA).apparent == pytest.approx(17_000, abs=2_000)
    found = calibrate_contrast(recording, CAMERA)
    assert found.delay == pytest.approx(17_000, abs=2_000)
    assert np.sqrt(found.on * found.off) == pytest.approx(0.2, rel=0.1)  # without it 0.14


@pytest.mark.parametrize(
    ("residuals", "found"),
    [
        ([2.0, 1.5, 1.0, 1.1, 1.2], True),
        ([np.nan, 1.3, 1.0, 1.3, np.nan], False),  # one wall must be higher than that
        ([2.0, 1.5, 1.0, 1.05, 1.0], False),
        ([2.0, 1.5, 1.2, 1.1, 1.0], False),  # goes on beyond the end
    ],
)
def test_what_counts_as_a_valley(residuals, found):
    assert delay._is_valley(np.array(residuals)) is found


@pytest.mark.parametrize("wrong", ["sign", "place"])
def test_events_of_other_frames_are_not_made_to_fit_by_a_far_delay(simulation, wrong):
    events = simulation.events.copy()
    if wrong == "sign":
        events["p"] = ~events["p"]
    else:
        events["x"] = events["x"].max() - events["x"]
    recording = Recording.from_arrays(events, simulation.frames, sensor_size=simulation.frames[0].image.shape)
    found = estimate_delay(recording, CAMERA)
    assert found is None or abs(found.apparent) <= delay.LARGEST


def test_long_exposures_are_no_delay():
    """Over fine texture a mean of the light is not its middle: if it were, events would seem to be 1.8 ms later."""
    noise = np.random.default_rng(0).standard_normal((50, 260))
    noise = (noise + np.roll(noise, 1, 0) + np.roll(noise, 1, 1)) / 3
    share = (noise - noise.min()) / np.ptp(noise)
    scene = photograph_scene(0.02 * 40**share, pan(160), sensor_size=(44, 60), duration=900_000)

    def apparent(exposure):
        sensor = SensorSettings(threshold_on=0.15, threshold_off=0.15, exposure=exposure)
        return estimate_delay(simulate(scene, sensor, seed=1).recording(), CAMERA).apparent

    assert apparent(30_000) == pytest.approx(apparent(3_000), abs=800)


def test_not_all_of_it_is_corrected(simulation):
    """But what is not trailing and half of what is; where that is not known, seven tenths."""
    found = estimate_delay(late(simulation, 4_000), CAMERA)
    assert found.true is None
    assert found.delay == pytest.approx(0.7 * found.apparent, abs=1)
    assert found._replace(true=4_000).delay == pytest.approx(4_000 + 0.5 * (found.apparent - 4_000), abs=1)


def test_a_still_scene_says_nothing(simulation):
    frames = simulation.frames[:1] * 1
    recording = Recording.from_arrays(simulation.events[:0], frames, sensor_size=frames[0].image.shape)
    assert estimate_delay(recording, CAMERA) is None


def test_a_parabola_finds_the_minimum_between_points():
    grid = delays()
    found = best_delay(grid, 0.2 + 1e-9 * (grid - 2_300.0) ** 2, 1_000)
    assert found.apparent == 2_300
    assert found.samples == 1_000
    assert found.improvement == pytest.approx(1 - 0.2 / (0.2 + 1e-9 * 2_300**2), abs=1e-3)


@pytest.mark.parametrize(("depth", "apparent"), [(0.97, 1_000), (0.8, -9_000)])
def test_of_valleys_about_as_deep_the_nearest_to_no_delay(depth, apparent):
    """As at a lamp that flickers 100 times a second; one that is clearly deeper counts wherever it is."""
    grid = delays()
    ripple = 0.25 - 0.05 * np.cos(2 * np.pi * (grid - 1_000) / 10_000)
    far = np.where(grid < -4_000, depth, 1.0)
    assert best_delay(grid, far * ripple, 1_000).apparent == pytest.approx(apparent, abs=300)


@pytest.mark.parametrize("residuals", [np.arange(25.0) + 1, np.arange(25.0, 0, -1), np.full(25, np.nan)])
def test_no_minimum_inside_is_no_delay(residuals):
    assert best_delay(delays(), residuals, 1_000) is None


def valley_with_failures(*failed):
    """Residuals that are least at 2 ms, with fits that failed at these delays, ms."""
    grid = delays()
    residuals = 0.2 + 1e-9 * (grid - 2_000.0) ** 2
    residuals[np.isin(grid, [1_000 * each for each in failed])] = np.nan
    return best_delay(grid, residuals, 1_000)


def test_fits_that_fail_far_from_the_best_delay_do_not_hide_it():
    """Also under no delay: what is gained is then judged by the middle one of the others."""
    found = valley_with_failures(-12, -11, -9, 9, 11, 12)
    assert found == valley_with_failures()
    assert valley_with_failures(0).apparent == 2_000
    assert valley_with_failures(0).improvement == pytest.approx(1 - 0.2 / (0.2 + 1e-9 * 6_000**2), rel=0.2)


@pytest.mark.parametrize("failed", [(1,), (3,), (*range(-12, 0), 4)], ids=["before", "after", "most"])
def test_fits_that_fail_beside_it_or_mostly_leave_no_delay(failed):
    """Of 25 delays 13 are more than half."""
    assert valley_with_failures(*failed) is None


@pytest.mark.parametrize("smooth", [False, True])
def test_a_stated_delay_is_taken_back(simulation, smooth):
    """Late events with their delay stated give the images of the events in time, to the bit."""
    images = []
    for by in (0, 3_500):
        settings = altered(PRESETS["default"], "events", delay=by, threshold_on=0.15, threshold_off=0.15)
        recording = late(simulation, by)
        images.append(list(reconstruct(recording, at="frames", settings=settings, smooth=smooth)))
    for one, other in zip(*images, strict=True):
        np.testing.assert_array_equal(one.intensity, other.intensity)
        np.testing.assert_array_equal(one.variance, other.variance)


@pytest.mark.parametrize("known", [{}, {"threshold_on": 0.15, "threshold_off": 0.15, "refractory_period": 0}])
def test_the_plan_fills_it_in(simulation, known):
    """With what of it is trailing, also where it needs no thresholds."""
    recording = late(simulation, 4_000)
    found = plan(recording, rate_hz=10, settings=altered(PRESETS["default"], "events", **known))
    assert found.settings.events.delay == found.steps.delay.delay
    assert found.steps.delay.true == pytest.approx(4_000, abs=900)
    assert found.steps.delay.true < found.settings.events.delay < found.steps.delay.apparent


def test_a_stated_delay_is_not_looked_for(simulation):
    recording = late(simulation, 4_000)
    assert plan(recording, rate_hz=10, preset="iccv2021").settings.events.delay == 0
    given = altered(PRESETS["default"], "events", delay=-7)
    assert plan(recording, rate_hz=10, settings=given).settings.events.delay == -7
    assert plan(recording, rate_hz=10, settings=given).steps.delay is None


def test_long_recordings_are_not_read_to_the_end(simulation, monkeypatch):
    monkeypatch.setattr(delay, "_MAX_FRAMES", 3)
    read = []

    def watched(frames):
        for frame in frames:
            read.append(frame)
            yield frame

    recording = late(simulation, 0)
    source = dataclasses.replace(recording.source, frames=lambda: watched(simulation.frames))
    watching = Recording(source)
    assert watching.longest_exposure == 10_000  # a plan has been through all exposures before
    read.clear()
    estimate_delay(watching, CAMERA)
    assert len(read) <= 2 * 4 < len(simulation.frames)  # they are looked at twice


def test_a_valley_that_is_found_late_is_looked_at_on_both_sides(monkeypatch):
    """What is tried first is least at 6 ms, what is tried for rivals at -3 ms, in a valley that goes on to -5."""
    valley = {-6_000: 0.9, -5_000: 0.3, -4_000: 0.4, -3_000: 0.5, 6_000: 0.8, 5_000: 0.85, 7_000: 0.85}

    def seen(recording, camera, grid, thresholds):
        return [delay._Samples(*np.full((3, 1_000), float(t))) for t in grid]

    monkeypatch.setattr(delay, "_samples", seen)
    monkeypatch.setattr(delay, "_residual", lambda seen: valley.get(seen.on[0], 1.0))
    found = estimate_delay(late(moving_blocks(), 0), CAMERA)
    assert found.apparent == pytest.approx(-5_000, abs=500)
