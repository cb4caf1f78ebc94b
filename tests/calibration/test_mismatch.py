"""The spread of thresholds between pixels and the variance of steps, from recordings whose sensors are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kalux import PRESETS, Frame, Recording
from kalux.calibration.mismatch import BELIEVED_STEPS, SPREADS, _solved, estimate_mismatch
from kalux.datasets import SensorSettings, pan, photograph_scene, simulate
from kalux.events import EVENT_DTYPE
from kalux.planning import plan
from kalux.settings import CameraSettings

from builders import with_noise_events

CAMERA = CameraSettings(log_offset=0.02)
EVENTS = dataclasses.replace(
    PRESETS["default"].events, threshold_on=0.2, threshold_off=0.2, refractory_period=0, delay=0
)


def scene(seed=0, flat=0.0):
    """A pan over texture from 0.02 to 0.8 of white, with a share of rows that have none."""
    noise = np.random.default_rng(seed).standard_normal((50, 130))
    for _ in range(3):
        noise = (noise + np.roll(noise, 1, 0) + np.roll(noise, 1, 1)) / 3
    share = (noise - noise.min()) / np.ptp(noise)
    share[: round(flat * len(share))] = 0.5
    return photograph_scene(0.02 * 40**share, pan(80), sensor_size=(44, 60), duration=900_000)


def found(spread, exposure=1_000, **sensor):
    settings = SensorSettings(
        threshold_on=0.2,
        threshold_off=0.2,
        log_offset=0.02,
        exposure=exposure,
        threshold_mismatch=spread,
        **sensor,
    )
    return estimate_mismatch(simulate(scene(), settings, seed=3).recording(), CAMERA, EVENTS)


@pytest.mark.parametrize("spread", [0.0, 0.05, 0.1, 0.15])
def test_the_spread_is_found(spread):
    estimate = found(spread)
    assert np.sqrt(max(estimate.variance, 0.0)) == pytest.approx(spread, rel=0.2, abs=0.05)
    assert estimate.error < 0.002
    assert SPREADS[0] <= estimate.spread <= SPREADS[1]


def test_pixels_that_frames_do_not_measure_do_not_count():
    """As beyond the view of a frame camera beside the event camera: the frames have some value there, events go on."""
    sensor = SensorSettings(threshold_on=0.2, threshold_off=0.2, log_offset=0.02, threshold_mismatch=0.1)
    made = simulate(scene(), sensor, seed=3).recording()
    half = np.arange(60) < 30
    frames = [
        dataclasses.replace(
            frame, image=np.where(half, frame.image, 90), valid=np.broadcast_to(half, (44, 60)).copy()
        )
        for frame in made.frames()
    ]
    all_events = np.concatenate(list(made.events()))
    kept = all_events[all_events["x"] < 30]
    every, left = (
        estimate_mismatch(Recording.from_arrays(chosen, frames, sensor_size=(44, 60)), CAMERA, EVENTS)
        for chosen in (all_events, kept)
    )
    assert every == left


def test_more_than_usual_is_believed_where_it_is_certain():
    assert found(0.175).spread == pytest.approx(0.175, rel=0.2)


def test_more_than_usual_is_not_believed_where_few_pixels_say_so():
    """As where moving texture is finer than the pixels."""
    products = np.zeros((64, 64, 2, 3, 3))
    products[..., 0, 0], products[..., 1, 0] = 0.1, 1.0
    products[:16, :16, :, 0, 0] = 0.6
    estimate = _solved(products, products.size, usual=0.1)
    assert estimate is not None
    assert estimate.variance > 0.02
    assert estimate.spread == 0.1


def test_blur_is_not_taken_for_it():
    """The camera moves by two to three pixels within an exposure: taken as it is, 0.05 would be found as 0.11."""
    assert np.sqrt(found(0.05, exposure=30_000).variance) == pytest.approx(0.05, abs=0.02)


def test_noise_that_is_new_in_each_interval_is_not_taken_for_it():
    estimate = found(0.0, noise_rate=2.0, read_noise=0.01)
    assert estimate.variance < 0.05**2
    assert found(0.08, noise_rate=2.0, read_noise=0.01).variance == pytest.approx(0.08**2, rel=0.4)


def unsteady(variance, spread=0.0, frames=24, shape=(40, 50), *, offset=CAMERA.offset, scale=1.0):
    """Frames that change by the events between them, whose steps have this variance, in units of c^2.

    Both may differ between pixels: the variance, and the ``scale`` of I + I_0, which is 0.03 to 0.95 otherwise.
    """
    rng = np.random.default_rng(5)
    own = 1.0 + spread * rng.standard_normal(shape)
    level, shown, stream = rng.uniform(np.log(0.1), np.log(0.5), shape), [], []
    for k in range(frames):
        image = np.rint(65535 * (scale * np.exp(level) - offset)).astype(np.uint16)
        shown.append(Frame(image, 40_000 * k, 40_000 * k + 100))
        upward = level < np.log(0.25)
        events = rng.integers(1, 8, shape)
        steps = 0.2 * (events * own + np.sqrt(variance * events) * rng.standard_normal(shape))
        level = np.clip(level + np.where(upward, steps, -steps), np.log(0.03), np.log(0.95))
        y, x = np.repeat(np.argwhere(np.ones(shape)), events.ravel(), axis=0).T
        made = np.zeros(len(x), EVENT_DTYPE)
        made["t"] = np.sort(rng.integers(1_000, 39_000, len(x))) + 40_000 * k
        made["x"], made["y"], made["p"] = x, y, upward[y, x]
        stream.append(made)
    return Recording.from_arrays(np.concatenate(stream), shown, sensor_size=shape)


@pytest.mark.parametrize("spread", [0.0, 0.15])
@pytest.mark.parametrize("variance", [0.05, 0.1, 0.3])
def test_the_variance_of_steps_is_found(variance, spread):
    camera = dataclasses.replace(CAMERA, frame_noise=1e-4, shot_noise=0.0)
    estimate = estimate_mismatch(
        unsteady(variance, spread), camera, dataclasses.replace(EVENTS, quantisation_variance=0.0)
    )
    assert estimate.step_variance(spread) == pytest.approx(variance, rel=0.15, abs=0.01)


def test_dark_pixels_do_not_tell_the_variance_of_steps():
    """They have one of their own, K20; frames that show the dark finely would make it that of all."""
    camera = dataclasses.replace(CAMERA, frame_noise=1e-5, shot_noise=0.0, log_offset=1e-4)
    events = dataclasses.replace(EVENTS, quantisation_variance=0.0)
    dark = np.arange(50) < 40
    made = unsteady(np.where(dark, 1.5, 0.1), offset=1e-4, scale=np.where(dark, 0.01, 1.0))
    assert estimate_mismatch(made, camera, events).step_variance(0.0) == pytest.approx(0.1, rel=0.15)


def test_events_of_noise_are_not_the_steps():
    """Each is a step that the light does not take, of which half is taken off as far as their rate is known."""
    camera = dataclasses.replace(CAMERA, frame_noise=1e-4, shot_noise=0.0)
    events = dataclasses.replace(EVENTS, quantisation_variance=0.0)
    rate = 5.0
    recording = with_noise_events(unsteady(0.1), rate)
    untold, told = (estimate_mismatch(recording, camera, events, known) for known in (0.0, 2.0 * rate))
    assert told.step_variance(0.0) == pytest.approx(0.1, rel=0.15)
    assert untold.step_variance(0.0) > 1.3 * told.step_variance(0.0)
    assert told.variance == untold.variance


def test_the_reference_exposure_is_only_a_unit():
    """Noise of the frames is a share of their own white, which is 4 where the reference is four exposures."""
    recording, camera = unsteady(0.1), dataclasses.replace(CAMERA, frame_noise=0.02, shot_noise=0.001)
    found = estimate_mismatch(recording, camera, EVENTS)
    for white in (0.25, 4.0):
        other = dataclasses.replace(
            camera, reference_exposure=round(100 * white), log_offset=white * CAMERA.offset
        )
        again = estimate_mismatch(recording, other, EVENTS)
        assert again.per_event == pytest.approx(found.per_event, rel=1e-6)
        assert again.variance == pytest.approx(found.variance, rel=1e-6)
        assert again.samples == found.samples


def test_steps_of_an_ideal_sensor_are_surer_than_others():
    """However far its pixels' thresholds are apart; lost events and noise are errors of steps."""

    def step_variance(**sensor):
        settings = SensorSettings(threshold_on=0.2, threshold_off=0.2, log_offset=0.02, **sensor)
        made = plan(simulate(scene(), settings, seed=3).recording(), at="frames")
        return made.settings.events.step_variance

    assert step_variance() < 1.5 * BELIEVED_STEPS[0]
    assert step_variance(threshold_mismatch=0.1) < 1.5 * BELIEVED_STEPS[0]
    assert step_variance(threshold_mismatch=0.1, noise_rate=3.0, refractory=2_000) > 2 * BELIEVED_STEPS[0]


def test_few_steps_tell_nothing():
    recording = unsteady(0.1, frames=5, shape=(12, 16))
    estimate = estimate_mismatch(recording, CAMERA, EVENTS)
    assert estimate.step_variance(0.1) is None


def test_the_plan_settles_it():
    """The spread as found; the noise as found, or without lookahead where there is more of it than usual."""
    for rate in (1.0, 6.0):
        sensor = SensorSettings(threshold_on=0.2, threshold_off=0.2, threshold_mismatch=0.05, noise_rate=rate)
        recording = simulate(scene(flat=0.5), sensor, seed=3).recording()
        made, causal = (plan(recording, at="frames", lookahead=ahead) for ahead in (True, False))
        assert made.mismatch.spread == made.settings.events.threshold_spread < 0.08
        measured = made.mismatch.step_variance(made.mismatch.spread)
        assert made.settings.events.step_variance == pytest.approx(measured, abs=1e-3)
        assert made.background_rate == pytest.approx(rate, rel=0.6)
        assert made.settings.events.noise_rate == made.background_rate
        assert causal.settings.events.noise_rate == max(made.background_rate, 3.0)
    recording = simulate(scene(flat=0.5), sensor, seed=3).recording()
    given = dataclasses.replace(made.settings.events, threshold_spread=0.07, noise_rate=2.0)
    again = plan(recording, at="frames", settings=dataclasses.replace(made.settings, events=given))
    assert (again.mismatch, again.background_rate) == (None, None)
    assert (again.settings.events.threshold_spread, again.settings.events.noise_rate) == (0.07, 2.0)
    assert again.settings.events.step_variance == made.settings.events.step_variance
    unsure = dataclasses.replace(given, step_variance=None)
    again = plan(recording, at="frames", settings=dataclasses.replace(made.settings, events=unsure))
    assert again.settings.events.threshold_spread == 0.07
    assert again.settings.events.step_variance == pytest.approx(again.mismatch.step_variance(0.07), abs=1e-3)


def test_two_frames_tell_nothing():
    """There are no two intervals without a common frame: the usual spread stays."""
    whole = simulate(scene(), SensorSettings(threshold_on=0.2, threshold_off=0.2), seed=3).recording()
    frames, stream = list(whole.frames())[:2], next(iter(whole.events()))
    some = stream[stream["t"] <= frames[1].exposure_end]
    short = Recording.from_arrays(some, frames, sensor_size=whole.sensor_size, contrast_threshold=(0.2, 0.2))
    assert estimate_mismatch(short, CAMERA, EVENTS) is None
    assert plan(short, at="frames").settings.events.threshold_spread == 0.1
