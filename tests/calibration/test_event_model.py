"""I_0 and the variance of an event's step, from recordings whose sensors are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats

import kalux
from kalux import PRESETS, Recording
from kalux.calibration import event_model
from kalux.calibration.event_model import (
    ErrorModel,
    FrameLimits,
    Samples,
    estimate_event_model,
    negative_log_likelihood,
)
from kalux.calibration.frame_noise import UsualNoise
from kalux.datasets import SensorSettings, pan, photograph_scene, simulate
from kalux.datasets.ahdr import ArtificialCamera, artificial_hdr
from kalux.plan_report import plan_report
from kalux.planning import plan
from kalux.settings import CameraSettings, EventSettings, altered

from builders import dark_scene

EVENTS = EventSettings(threshold_on=0.2, threshold_off=0.2)
MODEL = ErrorModel(EVENTS.thresholds, (1e-3, 0.0), 0.02, 1 / 6)


def recorded(**sensor):
    sensor = SensorSettings(threshold_on=0.2, threshold_off=0.2, exposure=2_000, **sensor)
    return simulate(dark_scene(), sensor, seed=1).recording()


@pytest.fixture(scope="module")
def recordings():
    return {offset: recorded(log_offset=offset) for offset in (0.004, 0.03, 0.06)}


@pytest.mark.parametrize(
    ("offset", "allowed"), [(0.004, (0.004, 0.008)), (0.03, (0.024, 0.036)), (0.06, (0.05, 0.06))]
)
def test_the_offset_of_the_events_logarithm_is_found(recordings, offset, allowed):
    found = estimate_event_model(recordings[offset], CameraSettings(), EVENTS)
    assert allowed[0] <= found.log_offset <= allowed[1]
    assert found.samples > 5_000


def changes(offset, error, count=40_000, *, noise=0.0, darkest=0.01):
    """Of pixels from 0.01 to 0.95 in frames with this noise, whose events are steps of 0.2 of log(I + offset), wrong by
    ``error`` each; from ``darkest`` on before."""
    rng = np.random.default_rng(2)
    steps = rng.integers(-12, 13, count)
    before = np.exp(rng.uniform(np.log(darkest), np.log(0.9), count))
    wrong = error * np.sqrt(np.abs(steps)) * rng.standard_normal(count)
    after = (before + offset) * np.exp(0.2 * steps + wrong) - offset
    before, after = np.array([before, after]) + noise * rng.standard_normal((2, count))
    kept = (np.minimum(before, after) > 0.01) & (after < 0.95) & (np.abs(steps) >= 2)
    told = (np.maximum(steps, 0), np.maximum(-steps, 0), np.zeros(count))
    ones = np.ones(int(kept.sum()))
    return Samples(before[kept], after[kept], *(values[kept] * 1.0 for values in told), ones, ones)


@pytest.mark.parametrize(
    ("offset", "error", "allowed"),
    [
        (0.001, 0.05, (0.001, 0.0014)),  # simulators have such
        (0.004, 0.05, (0.0028, 0.0057)),
        (0.001, 0.4, (0.004, 0.03)),  # what noise says of so small ones is not believed
    ],
)
def test_offsets_of_less_than_a_level_need_certainty(offset, error, allowed):
    found = event_model._log_offset(changes(offset, error), None, MODEL)
    assert allowed[0] <= found <= allowed[1]


NOISE = 0.004


def noisy_changes(offset):
    """Some of pixels that are darker than 0.01, whose noise is bright."""
    return changes(offset, 0.05, 80_000, noise=NOISE, darkest=0.004)


@pytest.mark.parametrize("offset", [0.001, 0.004])
def test_samples_that_noise_lifts_do_not_make_the_offset_small(offset):
    """Of pixels darker than the darkest that is chosen only those count whose noise is bright."""
    samples = noisy_changes(offset)
    model = MODEL._replace(frame_noise=(NOISE, 0.0))
    whole, chosen = (
        event_model._least_gain(samples, limits, model)
        for limits in (None, event_model._chosen_limits(samples))
    )
    assert whole > event_model._CERTAIN[1]
    assert (chosen > event_model._CERTAIN[1]) == (offset == 0.001)


@pytest.mark.parametrize(("offset", "allowed"), [(0.001, (0.001, 0.0014)), (0.004, (0.004, 0.0057))])
def test_small_offsets_are_found_though_noise_lifts_samples(offset, allowed):
    found = event_model._log_offset(noisy_changes(offset), None, MODEL._replace(frame_noise=(NOISE, 0.0)))
    assert allowed[0] <= found <= allowed[1]


def test_the_gain_of_small_offsets_is_that_of_an_observation():
    """However many there are; the prior counts less the more there are."""
    many, few = (event_model._least_gain(changes(0.001, 0.05, n), None, MODEL) for n in (400_000, 40_000))
    assert few == pytest.approx(many, abs=0.01)
    assert few > 0.012 > event_model._least_gain(changes(0.004, 0.05), None, MODEL)


@pytest.mark.parametrize("white", [0.25, 4.0])
def test_the_reference_exposure_is_only_a_unit_of_samples(white):
    """Of the noise in the dark, and of what is likely."""
    rng = np.random.default_rng(3)
    level = rng.uniform(0.011, 0.029, (2, 4_000))
    none, ones = np.zeros(4_000), np.ones(4_000)
    dark = Samples(*level, none, none, none, ones, ones)
    brighter = Samples(*(white * level), none, none, none, white * ones, white * ones)
    found = event_model.dark_noise(dark, MODEL, 0.03, 0.1)
    assert event_model.dark_noise(brighter, MODEL, white * 0.03, 0.1) == pytest.approx(found)
    assert found > 0.0
    (_, one), (_, other) = (
        event_model.mismatch_of(samples, MODEL, offset, 0.1)
        for samples, offset in ((dark, 0.03), (brighter, white * 0.03))
    )
    np.testing.assert_allclose(other, one)


@pytest.mark.parametrize("times", [0.5, 1.0, 2.0])
def test_the_slope_is_that_of_the_thresholds(recordings, times):
    """Steps that are taken twice as large as they are explain as much, with half the slope."""
    events = dataclasses.replace(EVENTS, threshold_on=0.2 * times, threshold_off=0.2 * times)
    found = estimate_event_model(recordings[0.03], CameraSettings(log_offset=0.03), events).agreement
    assert found.slope == pytest.approx(1 / times, rel=0.05)
    assert found.explained > 0.9
    assert found.gain == pytest.approx(min(0.5 / 0.88 if times == 2.0 else 1.0, 1.0), rel=0.05)
    assert found.is_usual == (not found.contradicts_thresholds) == (times == 1.0)


def test_events_of_another_scene_explain_nothing(recordings):
    own = recordings[0.03]
    inverted = np.concatenate([chunk.copy() for chunk in own.events()])
    inverted["p"] = ~inverted["p"]
    wrong = Recording.from_arrays(inverted, list(own.frames()), sensor_size=own.sensor_size)
    found = estimate_event_model(wrong, CameraSettings(), EVENTS).agreement
    assert (found.gain, found.explained, found.trust) == (0.0, 0.0, 0.0)
    assert found.slope < 0.0


def test_pixels_that_frames_do_not_measure_say_nothing(recordings):
    """What stands there in the frames is a guess, and the events are right."""
    own = recordings[0.03]
    height, width = own.sensor_size
    valid = np.broadcast_to(np.arange(width) < width // 2, (height, width)).copy()
    masked = [
        dataclasses.replace(frame, image=np.where(valid, frame.image, 90), valid=valid)
        for frame in own.frames()
    ]
    hidden = Recording.from_arrays(np.concatenate(list(own.events())), masked, sensor_size=own.sensor_size)
    found = estimate_event_model(hidden, CameraSettings(log_offset=0.03), EVENTS)
    assert found.agreement.slope == pytest.approx(1.0, rel=0.05)
    assert found.agreement.explained > 0.9
    assert (
        found.step_variance
        == estimate_event_model(own, CameraSettings(log_offset=0.03), EVENTS).step_variance
    )


def test_noise_makes_steps_less_certain(recordings):
    quiet = estimate_event_model(recordings[0.03], CameraSettings(), EVENTS)
    noisy = estimate_event_model(recorded(log_offset=0.03, noise_rate=20.0), CameraSettings(), EVENTS)
    assert quiet.step_variance == 0.07
    assert noisy.step_variance >= 0.2


def test_a_delay_is_taken_into_account(recordings):
    events = next(iter(recordings[0.03].events())).copy()
    events["t"] += 6_000
    late = Recording.from_arrays(events, recordings[0.03].frames(), sensor_size=recordings[0.03].sensor_size)
    assert len(events) == len(recordings[0.03].events())
    known = estimate_event_model(late, CameraSettings(), dataclasses.replace(EVENTS, delay=6_000))
    assert known == estimate_event_model(recordings[0.03], CameraSettings(), EVENTS)


def test_a_refractory_period_would_shift_the_offset():
    """What is lost makes steps near white look larger, as a large I_0 does."""
    lossy = recorded(log_offset=0.004, refractory=2_000.0)
    known = estimate_event_model(
        lossy, CameraSettings(), dataclasses.replace(EVENTS, refractory_period=2_000)
    )
    assert known.log_offset < 0.01
    assert estimate_event_model(lossy, CameraSettings(), EVENTS).log_offset > 2 * known.log_offset


def test_an_offset_between_those_tried_is_found(recordings):
    """A factor of two, between values tried, is 20 % of newton's error."""
    found = estimate_event_model(recorded(log_offset=0.02), CameraSettings(), EVENTS)
    assert found.log_offset == pytest.approx(0.02, rel=0.25)


def test_noise_says_nothing_of_the_offset(recordings):
    """The frames of one recording with the events of another, whose camera looked elsewhere: the usual I_0."""
    frames = [*recordings[0.004].frames()]
    still = [dataclasses.replace(frame, image=frames[0].image) for frame in frames]
    others = Recording.from_arrays(
        next(iter(recordings[0.06].events())), still, sensor_size=recordings[0.004].sensor_size
    )
    found = estimate_event_model(others, CameraSettings(), EVENTS)
    assert found is None or 0.02 < found.log_offset < 0.045


@pytest.mark.parametrize("read", [0.0, 0.002, 0.004])
def test_dark_pixels_tell_noise_by_what_events_leave(read):
    """No less than there is, with the rounding, and no more than half as much again and half a level."""
    recording, usual = recorded(log_offset=0.03, read_noise=read), CameraSettings()
    assert estimate_event_model(recording, usual, EVENTS).frame_noise is None
    found = estimate_event_model(recording, usual, EVENTS, doubt_noise=True)
    true = np.hypot(read, 1 / 255 / 12**0.5)
    assert found.frame_noise is not None
    dark, shot = found.frame_noise
    assert true <= dark < 1.5 * true + 0.5 / 255
    assert np.sqrt(dark**2 + shot / 2) == pytest.approx(min(2 * dark, usual.usual_frame_noise))


@pytest.mark.parametrize("silent", [False, True])
def test_a_plan_takes_it_where_nothing_else_tells_noise(monkeypatch, recordings, silent):
    """Stated noise stays, and so does what pixels without events tell."""
    usual = UsualNoise(0.006, 0.0, silent=silent)
    monkeypatch.setattr("kalux.planning.sensor_noise.estimate_frame_noise", lambda *_, **__: None)
    monkeypatch.setattr("kalux.planning.sensor_noise.usual_noise", lambda *_, **__: usual)
    made = plan(recordings[0.03], at="frames", settings=PRESETS["default"])
    assert made.frame_noise is None
    if silent:
        assert made.steps.model.frame_noise is None
        assert made.settings.camera.noise == usual[:2]
    else:
        assert made.settings.camera.noise == made.steps.model.frame_noise < usual[:2]
        told = dict(plan_report(recordings[0.03], made, PRESETS["default"]))["noise"]
        assert "as much as events do not explain" in told
    stated = altered(PRESETS["default"], "camera", shot_noise=1e-4)
    kept = plan(recordings[0.03], at="frames", settings=stated)
    assert kept.settings.camera.noise == (0.006, 1e-4)


def test_noise_that_is_usual_stays():
    noisy = recorded(log_offset=0.03, read_noise=0.012)
    assert estimate_event_model(noisy, CameraSettings(), EVENTS, doubt_noise=True).frame_noise is None


def test_a_still_scene_says_nothing():
    still = photograph_scene(np.full((40, 60), 0.5), pan(0), sensor_size=(36, 48), duration=300_000)
    recording = simulate(still, SensorSettings(noise_rate=1.0), seed=0).recording()
    assert estimate_event_model(recording, CameraSettings(), EVENTS) is None


def test_likelihood_compares_densities_of_the_intensity():
    """Without events and with little noise in the frames, log(I + I_0) alone would favour a large I_0."""
    rng = np.random.default_rng(0)
    steps = rng.integers(-6, 7, 20_000)
    before = np.exp(rng.uniform(np.log(0.02), np.log(0.9), 20_000))
    after = (before + 0.03) * np.exp(0.2 * steps + 0.05 * rng.standard_normal(20_000)) - 0.03
    kept = after > 0
    samples = Samples(
        before[kept],
        after[kept],
        np.maximum(steps, 0)[kept] * 1.0,
        np.maximum(-steps, 0)[kept] * 1.0,
        np.zeros(int(kept.sum())),
        *np.ones((2, int(kept.sum()))),
    )
    losses = [negative_log_likelihood(samples, MODEL, offset, 0.05) for offset in event_model.LOG_OFFSETS]
    assert event_model.LOG_OFFSETS[int(np.argmin(losses))] == 0.03


def test_a_plan_fills_in_what_is_not_given(recordings):
    recording = recordings[0.06]
    made = plan(recording, at="frames")
    assert made.settings.camera.log_offset == made.steps.model.log_offset >= 0.05
    assert made.steps.model.step_variance in event_model.STEP_VARIANCES
    assert made.settings.events.refractory_period == made.steps.thresholds.refractory_period == 0
    default = PRESETS["default"]
    given = dataclasses.replace(
        default,
        camera=dataclasses.replace(default.camera, log_offset=0.02),
        events=dataclasses.replace(
            default.events,
            step_variance=0.3,
            refractory_period=700,
            extrapolation_gain=0.9,
            extrapolation_trust=0.5,
        ),
    )
    kept = plan(recording, at="frames", settings=given)
    assert kept.steps.model is None
    assert (kept.settings.camera.log_offset, kept.settings.events.step_variance) == (0.02, 0.3)
    assert kept.settings.events.refractory_period == 700


def test_where_it_cannot_be_told_the_usual_is_written_down(recordings):
    recording = recordings[0.03]
    silent = Recording.from_arrays(
        next(iter(recording.events()))[:0], recording.frames(), sensor_size=recording.sensor_size
    )
    made = plan(silent, at="frames")
    assert made.steps.model is None
    assert (made.settings.camera.log_offset, made.settings.events.step_variance) == (0.03, 0.2)


def test_what_frames_cannot_show_says_nothing_of_the_offset():
    """Cut at both ends, changes look smaller than events say, most of all near white: as if I_0 were small."""
    rng = np.random.default_rng(1)
    steps = rng.integers(-6, 7, 40_000)
    before = np.exp(rng.uniform(np.log(0.17), np.log(0.98), 40_000))
    after = (before + 0.12) * np.exp(0.2 * steps + 0.3 * rng.standard_normal(40_000)) - 0.12
    kept = (after > 0.17) & (after < 0.98)
    samples = Samples(
        before[kept],
        after[kept],
        np.maximum(steps, 0)[kept] * 1.0,
        np.maximum(-steps, 0)[kept] * 1.0,
        np.zeros(int(kept.sum())),
        *np.ones((2, int(kept.sum()))),
    )
    shown = FrameLimits(np.full(int(kept.sum()), 0.17), np.full(int(kept.sum()), 0.98))
    found = []
    for limits in (None, shown):
        losses = [
            negative_log_likelihood(samples, MODEL, offset, 0.4, limits) for offset in event_model.LOG_OFFSETS
        ]
        found.append(event_model.LOG_OFFSETS[int(np.argmin(losses))])
    assert found[0] < found[1] == 0.12


def test_the_share_of_students_t():
    """Against SciPy's."""
    t = np.array([-np.inf, -30.0, -1.3, 0.0, 0.4, 5.0, np.inf])
    np.testing.assert_allclose(event_model._student_t_share(t), stats.t.cdf(t, 4), atol=1e-6)


def test_dark_current_is_found_behind_a_camera_that_crushes_the_dark(shared_data):
    """slider_depth has 0.03 of white: of a white at 60 of 255 that is 0.13, though nothing below 10 is shown.

    Found were 0.06 to 0.12, as thresholds are found; 0.015 where what cannot be shown was taken for unchanged.
    """
    recording = kalux.open(shared_data / "slider_depth", exposure=10_000)
    artificial = artificial_hdr(recording, ArtificialCamera(10 / 255, 60 / 255))
    found = plan(artificial, at="frames").settings.camera.log_offset
    assert 0.05 <= found <= 0.15
