"""Thresholds that a reconstruction finds by itself, from recordings whose thresholds are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import kalux
from kalux import Frame, Recording
from kalux.calibration.delay import DelayEstimate, estimate_delay
from kalux.calibration.global_thresholds import (
    Usual,
    estimate_thresholds,
    refine_thresholds,
    with_true_delay,
)
from kalux.calibration.refractory import intervals
from kalux.datasets import SensorSettings, demo_scene, pan, photograph_scene, simulate, static
from kalux.datasets.ahdr import ArtificialCamera, artificial_hdr
from kalux.datasets.scenes import Scene
from kalux.errors import ExposureError
from kalux.events import make_events
from kalux.settings import CameraSettings

from builders import dark_scene, events, moving_blocks, quick_frames, unlabelled
from builders import textured as textured_picture

CAMERA = CameraSettings()
USUAL = Usual(0.25, 0.25, 0.5)


# --- from recordings ------------------------------------------------------------------------------------

SENSORS = {
    "ideal": SensorSettings(),
    "asymmetric": SensorSettings(threshold_on=0.15, threshold_off=0.28),
    "mismatch": SensorSettings(threshold_off=0.25, threshold_mismatch=0.1),
    "noise": SensorSettings(noise_rate=3.0, read_noise=0.006),
    "small": SensorSettings(threshold_on=0.08, threshold_off=0.1),
}
SIZE = (48, 64)


def ratios(found, sensor):
    """Estimated over true thresholds."""
    return [found.on / sensor.threshold_on, found.off / sensor.threshold_off]


@pytest.mark.parametrize("name", SENSORS)
def test_thresholds_of_a_well_lit_recording(name):
    sensor = SENSORS[name]
    found = estimate_thresholds(unlabelled(moving_blocks(0.08, 0.9, sensor=sensor, size=SIZE)), CAMERA, USUAL)
    np.testing.assert_allclose(ratios(found, sensor), 1.0, atol=0.12)


def test_thresholds_by_frames_every_two_milliseconds():
    """In so little time a pixel has an event or none: thresholds came out at twice what they are."""
    found = estimate_thresholds(unlabelled(quick_frames()), CAMERA, USUAL, delay=6_500)
    assert found.on == pytest.approx(0.3, rel=0.08)
    assert found.off == pytest.approx(0.35, rel=0.08)
    assert found.spread < 0.05


def test_thresholds_in_spite_of_saturation():
    """Intervals that begin or end in saturation are left out."""
    sensor = SENSORS["asymmetric"]
    simulation = moving_blocks(0.1, 4.0, sensor=sensor, size=SIZE)
    assert np.mean([frame.image == 255 for frame in simulation.frames]) > 0.15
    found = estimate_thresholds(unlabelled(simulation), CAMERA, USUAL)
    np.testing.assert_allclose(ratios(found, sensor), 1.0, atol=0.12)


def test_the_offset_does_not_bias_the_estimate():
    """I_0 = 0.03 flattens log(I + I_0) in the dark: the paper's model has smaller steps there, the sensor has not."""
    sensor = SENSORS["ideal"]
    recording = unlabelled(moving_blocks(0.02, 0.6, sensor=sensor, size=SIZE))
    np.testing.assert_allclose(ratios(estimate_thresholds(recording, CAMERA, USUAL), sensor), 1.0, atol=0.1)
    of_model = ratios(estimate_thresholds(recording, CAMERA, USUAL, of_log_offset=True), sensor)
    assert min(of_model) > 0.75
    assert max(of_model) < 0.95


def test_varying_exposures_do_not_disturb():
    sensor = SENSORS["ideal"]
    simulation = moving_blocks(0.08, 0.9, sensor=sensor, size=SIZE, exposures=(8_000, 4_000, 12_000) * 4)
    found = estimate_thresholds(unlabelled(simulation), CAMERA, USUAL)
    np.testing.assert_allclose(ratios(found, sensor), 1.0, atol=0.12)


def test_the_reference_exposure_is_that_of_the_settings():
    """Half of the intensities with half of the offset are the same logarithms, but for a constant."""
    recording = unlabelled(moving_blocks(0.08, 0.9, sensor=SENSORS["ideal"], size=SIZE))
    one = estimate_thresholds(recording, CameraSettings(log_offset=0.03, reference_exposure=10_000), USUAL)
    half = estimate_thresholds(recording, CameraSettings(log_offset=0.015, reference_exposure=5_000), USUAL)
    np.testing.assert_allclose(half, one, rtol=1e-6)


def test_response_is_inverted():
    """The same with a gamma camera, when it is known to be one; far off when it is taken for linear."""
    sensor = SensorSettings(response=_gamma)
    recording = unlabelled(moving_blocks(0.08, 0.9, sensor=sensor, size=SIZE))
    known = estimate_thresholds(recording, CameraSettings(response="gamma:2.2"), USUAL)
    np.testing.assert_allclose(ratios(known, sensor), 1.0, atol=0.12)
    assert max(ratios(estimate_thresholds(recording, CAMERA, USUAL), sensor)) < 0.6


def _gamma(irradiance):
    return irradiance ** (1 / 2.2)


def test_chunks_do_not_matter(monkeypatch):
    recording = unlabelled(moving_blocks(0.08, 0.9, sensor=SENSORS["ideal"], size=SIZE))
    whole = estimate_thresholds(recording, CAMERA, USUAL)
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", 777)
    assert len(list(recording.events())) > 10
    assert estimate_thresholds(recording, CAMERA, USUAL) == whole


def first(recording, count):
    """The first frames of a recording, and the events until then."""
    frames = [*recording.frames()][:count]
    until = np.concatenate([e[e["t"] <= frames[-1].exposure_end] for e in recording.events()])
    return Recording.from_arrays(until, frames, sensor_size=recording.sensor_size)


def test_thresholds_within_5_percent_and_of_five_frames_within_15():
    """Mismatch of 10 %, noise events, noise of the frames and saturation."""
    sensor = SensorSettings(
        threshold_off=0.25, threshold_mismatch=0.1, noise_rate=3.0, read_noise=0.004, full_well=20_000
    )
    whole = unlabelled(simulate(demo_scene(sensor_size=(90, 120), duration=800_000), sensor))
    found = estimate_thresholds(whole, CAMERA, USUAL, refractory_period=None)
    np.testing.assert_allclose(ratios(found, sensor), 1.0, atol=0.05)
    assert found.refractory_period == 0
    assert found.usual_share < 0.02
    few = estimate_thresholds(first(whole, 5), CAMERA, USUAL, refractory_period=None)
    np.testing.assert_allclose(ratios(few, sensor), 1.0, atol=0.15)


NARROW = SensorSettings(threshold_on=0.3, threshold_off=0.35, threshold_mismatch=0.1, noise_rate=1.0)


@pytest.fixture(scope="module")
def wide():
    """A recording from which the frames of narrow ones are cut."""
    return unlabelled(simulate(demo_scene(sensor_size=(180, 240), duration=600_000), NARROW))


@pytest.mark.parametrize("width", [2, 3, 4])
def test_narrow_frames_tell_thresholds_as_well_as_the_spread_says(wide, width):
    """Of frames that show a range of a few thresholds, both ends of an interval see only what changed little.

    What neighbours' events say of such pixels alone is 0.35, 0.7 and 0.88 of the truth, with a spread of 18 to 4 %.
    """
    cut = ArtificialCamera(float(np.exp(-width * NARROW.threshold_on)), 1.0)
    recording, camera = artificial_hdr(wide, cut), CameraSettings(response=cut.response)
    late = estimate_delay(recording, camera)
    assert late is not None
    assert late.apparent == pytest.approx(2_600, abs=400)
    found = estimate_thresholds(recording, camera, USUAL, delay=late.apparent)
    errors = np.abs(np.log(ratios(found, NARROW)))
    assert (errors < 0.3).all()
    assert (errors < 2 * found.spread).all()
    assert found.spread < 0.2


def test_blur_does_not_bias_the_estimate():
    """Exposures of three quarters of the frame interval, and of an eighth."""
    sensor = SENSORS["asymmetric"]
    blurred, sharp = (
        unlabelled(moving_blocks(0.08, 0.9, sensor=sensor, size=SIZE, exposures=(exposure,) * 12))
        for exposure in (30_000, 5_000)
    )
    one, other = (estimate_thresholds(recording, CAMERA, USUAL) for recording in (blurred, sharp))
    assert one.on == pytest.approx(other.on, rel=0.03)
    assert one.off == pytest.approx(other.off, rel=0.03)


@pytest.mark.parametrize("speed", [12.0, 15.0, 20.0, 30.0])
def test_slow_edges_do_not_bias_the_estimate(speed):
    """An edge is at one pixel for one or two frames: its neighbours see it at other times."""
    sensor = SENSORS["ideal"]
    recording = unlabelled(moving_blocks(0.08, 0.9, sensor=sensor, size=SIZE, speed=speed))
    found = estimate_thresholds(recording, CameraSettings(log_offset=0.004), USUAL)
    np.testing.assert_allclose(ratios(found, sensor), 1.0, atol=0.06)


def test_noise_that_neighbours_share_is_not_taken_for_small_thresholds():
    """Every event of a flicker is seen by 5x5 pixels; least squares, and neighbours' counts alone, would say 0.05."""
    sensor = SENSORS["ideal"]
    whole = moving_blocks(0.08, 0.9, sensor=sensor, size=SIZE, speed=15.0)
    rng = np.random.default_rng(0)
    height, width = SIZE
    bursts = 12_000
    t = rng.integers(0, 500_000, bursts)[:, None, None]
    y = rng.integers(2, height - 2, bursts)[:, None, None] + np.arange(-2, 3)[:, None]
    x = rng.integers(2, width - 2, bursts)[:, None, None] + np.arange(-2, 3)
    p = (rng.random(bursts) < 0.5)[:, None, None]
    flicker = make_events(*(v.ravel() for v in np.broadcast_arrays(t, x, y, p)))
    both = np.concatenate([*unlabelled(whole).events(), flicker])
    both = both[np.argsort(both["t"], kind="stable")]
    noisy = Recording.from_arrays(both, whole.frames, sensor_size=SIZE)
    found = estimate_thresholds(noisy, CAMERA, USUAL)
    np.testing.assert_allclose(ratios(found, sensor), 1.0, atol=0.25)
    assert found.spread > 0.08


def test_what_tells_nothing_leaves_the_usual(shared_data):
    """A bench before which nothing moves, its events noise and flicker: once 0.05 and 0.18 were found."""
    bench = kalux.open(shared_data / "bench_davis346.aedat4")
    found = estimate_thresholds(bench, CAMERA, USUAL)
    assert 0.2 < found.on < 0.4
    assert 0.2 < found.off < 0.5
    assert found.spread > 0.1
    sure = estimate_thresholds(bench, CAMERA, Usual(0.31, 0.37, 0.05))
    assert sure.usual_share > 0.5
    assert (sure.on, sure.off) == (pytest.approx(0.31, rel=0.05), pytest.approx(0.37, rel=0.05))


def test_both_halves_of_slider_depth_have_the_same_thresholds(shared_data):
    """Within a tenth."""
    whole = kalux.open(shared_data / "slider_depth", exposure=10_000)
    frames, stream = [*whole.frames()], np.concatenate([*whole.events()])
    middle = frames[len(frames) // 2].exposure_start
    halves = [
        Recording.from_arrays(
            stream[(stream["t"] < middle) == early],
            [frame for frame in frames if (frame.exposure_end < middle) == early],
            sensor_size=whole.sensor_size,
        )
        for early in (True, False)
    ]
    one, other = (estimate_thresholds(half, CAMERA, USUAL, delay=1_550) for half in halves)
    assert one.on == pytest.approx(other.on, rel=0.1)
    assert one.off == pytest.approx(other.off, rel=0.1)


# --- refractory period ----------------------------------------------------------------------------------


def textured(**sensor):
    return unlabelled(
        simulate(dark_scene(), SensorSettings(exposure=2_000, log_offset=0.004, **sensor), seed=1)
    )


@pytest.mark.parametrize("period", [600.0, 2_000.0])
@pytest.mark.parametrize("known", [True, False])
def test_a_refractory_period_is_found(period, known):
    """Edges that pass in a few milliseconds. Without, thresholds seem a fifth to a half larger; where they are not
    known, a part of that is left."""
    lossy = textured(refractory=period)
    camera = CameraSettings(log_offset=0.004)
    usual = Usual(0.2, 0.2, 0.0) if known else USUAL
    found = estimate_thresholds(lossy, camera, usual, delay=1_500, refractory_period=None)
    assert found.refractory_period == pytest.approx(period, rel=0.3)
    np.testing.assert_allclose([found.on, found.off], 0.2, rtol=1e-3 if known else 0.25)
    assert abs(found.refractory_period / period - 1) < 2 * found.refractory_spread < 0.6
    ignored = estimate_thresholds(lossy, camera, USUAL, delay=1_500)
    assert ignored.on > 1.15 * 0.2
    assert ignored.refractory_spread == 0


@pytest.mark.parametrize("delay", [1_500, 3_000])
def test_what_is_wrongly_taken_for_a_delay_makes_the_period_no_longer(delay):
    """Weights of events near the period have no bound: a third too long does far more harm than a third too short."""
    known = Usual(0.2, 0.2, 0.0)
    camera = CameraSettings(log_offset=0.004)
    found = estimate_thresholds(
        textured(refractory=1_000.0), camera, known, delay=delay, refractory_period=None
    )
    assert 500 < found.refractory_period < 1_100


def test_a_period_is_no_longer_than_light_leaves_possible(monkeypatch):
    """Neither at first, nor with another I_0."""
    known, camera = Usual(0.2, 0.2, 0.0), CameraSettings(log_offset=0.004)
    lossy = textured(refractory=1_000.0)
    found = estimate_thresholds(lossy, camera, known, delay=1_500, refractory_period=None)
    assert 744 < found.refractory_period <= found.longest_period
    monkeypatch.setattr(
        "kalux.calibration.global_thresholds.intervals", lambda *of: intervals(*of)._replace(of_light=800)
    )
    bounded = estimate_thresholds(lossy, camera, known, delay=1_500, refractory_period=None)
    assert bounded.refractory_period == bounded.longest_period == 744
    refined = refine_thresholds(lossy, camera, known, bounded, refractory_period=None)
    assert refined.refractory_period == 744


def test_no_refractory_period_is_found_where_nothing_is_lost():
    """Nor on edges of surfaces without texture, where the first event of each tells less than the others."""
    for recording in (textured(), unlabelled(moving_blocks(0.08, 0.9, size=SIZE))):
        assert estimate_thresholds(recording, CAMERA, USUAL, refractory_period=None).refractory_period == 0


def textured_and_fast(**sensor):
    """Surfaces of four pixels that pass at 500 pixels/s."""
    scene = photograph_scene(textured_picture(0.8), pan(500.0), sensor_size=(48, 64), duration=400_000)
    settings = SensorSettings(threshold_on=0.15, threshold_off=0.15, exposure=2_000, frame_rate=30, **sensor)
    return unlabelled(simulate(scene, settings, seed=1))


def test_known_thresholds_tell_the_period_where_no_event_is_late():
    """Late events have lost nearly as much as others here: by these alone 0.88 ms are found."""
    lossy, camera = textured_and_fast(refractory=1_000.0), CameraSettings(log_offset=0.004)
    known = Usual(0.15, 0.15, 0.0)
    found = estimate_thresholds(lossy, camera, known, refractory_period=None)
    assert found.refractory_period == pytest.approx(1_030, rel=0.04)
    assert 0 < found.refractory_spread < 0.05
    refined = refine_thresholds(lossy, camera, known, found, refractory_period=None)
    assert refined.refractory_period == pytest.approx(found.refractory_period, rel=0.03)
    unknown = estimate_thresholds(lossy, camera, USUAL, refractory_period=None)
    assert unknown.refractory_period < 950


@pytest.mark.parametrize("share", [0.5, 0.8])
def test_thresholds_that_are_known_wrongly_are_not_taken_for_a_period(share):
    """Events seem to tell too little then, too, but no period explains what the frames show."""
    recording, camera = textured_and_fast(), CameraSettings(log_offset=0.004)
    known = Usual(share * 0.15, share * 0.15, 0.0)
    assert estimate_thresholds(recording, camera, known, refractory_period=None).refractory_period == 0


def test_hot_pixels_hide_no_refractory_period():
    """Twelve of them make half of all events; each pollutes what its neighbours see."""
    lossy, rng = textured(refractory=600.0), np.random.default_rng(0)
    stream, (height, width) = np.concatenate([*lossy.events()]), lossy.sensor_size
    at = rng.choice(rng.choice(height * width, 12, replace=False), len(stream))
    t = rng.integers(stream["t"][0], stream["t"][-1], len(stream))
    both = np.concatenate([stream, make_events(t, at % width, at // width, rng.random(len(t)) < 0.5)])
    both = both[np.argsort(both["t"], kind="stable")]
    hot = Recording.from_arrays(both, [*lossy.frames()], sensor_size=lossy.sensor_size)
    camera = CameraSettings(log_offset=0.004)
    found = estimate_thresholds(hot, camera, USUAL, delay=1_500, refractory_period=None)
    assert found.refractory_period == pytest.approx(600, rel=0.1)
    np.testing.assert_allclose([found.on, found.off], 0.2, rtol=0.06)


# --- delay ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("late", [-1_000, 0, 2_000])
def test_the_half_threshold_by_which_events_trail_is_not_taken_for_delay(late):
    """The delay of a reconstruction has it in it; thresholds do not depend on how much of it."""
    whole = textured()
    moved = np.concatenate([*whole.events()])
    moved["t"] += late
    recording = Recording.from_arrays(moved, [*whole.frames()], sensor_size=whole.sensor_size)
    camera = CameraSettings(log_offset=0.004)
    for seeming in (late, late + 1_000, late + 2_500, late + 5_000):
        found = estimate_thresholds(recording, camera, USUAL, delay=seeming)
        assert found.delay == pytest.approx(late, abs=400)
        np.testing.assert_allclose([found.on, found.off], 0.2, rtol=0.04)


def slowed(recording, times):
    """The recording of the same light that takes so many times as long."""
    moved = np.concatenate([*recording.events()])
    moved["t"] *= times
    frames = [
        dataclasses.replace(
            frame, exposure_start=times * frame.exposure_start, exposure_end=times * frame.exposure_end
        )
        for frame in recording.frames()
    ]
    return Recording.from_arrays(moved, frames, sensor_size=recording.sensor_size)


@pytest.mark.parametrize("times", [1, 3])
def test_events_of_slow_light_trail_it_for_longer(times):
    recording, camera = slowed(textured(), times), CameraSettings(log_offset=0.004)
    apparent = estimate_delay(recording, camera)
    assert apparent.apparent > 1_500 * times
    found = with_true_delay(recording, camera, apparent, USUAL)
    assert found.true == pytest.approx(0, abs=400 * times)


def test_where_no_delay_explains_the_frames_none_is_taken_for_the_true_one():
    """Events of other pixels."""
    whole = textured()
    moved = np.concatenate([*whole.events()])
    moved["x"] = moved["x"][np.random.default_rng(0).permutation(len(moved))]
    recording = Recording.from_arrays(moved, [*whole.frames()], sensor_size=whole.sensor_size)
    apparent = DelayEstimate(3_000, 0.1, 5_000)
    found = with_true_delay(recording, CameraSettings(log_offset=0.004), apparent, USUAL)
    assert found.true is None
    assert found.delay == pytest.approx(0.7 * 3_000, abs=1)


def test_of_a_rough_estimate_delay_and_period_are_kept(monkeypatch):
    """With another I_0 the same is found as from the start, without looking for the shortest interval again."""
    lossy = textured(refractory=600.0)
    rough = estimate_thresholds(lossy, CAMERA, USUAL, delay=1_500, refractory_period=None, most=2_000)
    camera = CameraSettings(log_offset=0.004)
    whole = estimate_thresholds(lossy, camera, USUAL, delay=1_500, refractory_period=None)
    monkeypatch.delattr("kalux.calibration.global_thresholds.intervals")
    refined = refine_thresholds(lossy, camera, USUAL, rough, refractory_period=None)
    assert refined.shortest_interval == whole.shortest_interval > 0
    assert refined.delay == rough.delay
    np.testing.assert_allclose([refined.on, refined.off], [whole.on, whole.off], rtol=0.02)
    assert refined.refractory_period == pytest.approx(whole.refractory_period, rel=0.1)
    assert refined.refractory_spread == pytest.approx(whole.refractory_spread, rel=0.2)


# --- lamps ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("speed", [40.0, 120.0])
def test_a_flickering_lamp_does_not_disturb(speed):
    """100 Hz, 30 % of the light; pixels/s of what moves."""
    pattern = np.repeat(np.repeat(np.random.default_rng(1).uniform(0.1, 0.8, (9, 12)), 4, 0), 4, 1)

    def radiance(t):
        light = 1 + 0.3 * np.sin(2 * np.pi * 100 * t * 1e-6)
        return np.roll(pattern * light, int(t * 1e-6 * speed), 1)

    scene = Scene(radiance, pattern.shape, 0, 400_000)
    recording = unlabelled(simulate(scene, SensorSettings(noise_rate=1.0)))
    found = estimate_thresholds(recording, CameraSettings(log_offset=0.004), USUAL)
    np.testing.assert_allclose([found.on, found.off], 0.2, rtol=0.05)


# --- nothing to tell ------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise_rate", [0.0, 1.0])
def test_a_still_scene_tells_nothing(noise_rate):
    scene = static(0.4, sensor_size=(32, 40), duration=300_000)
    recording = unlabelled(simulate(scene, SensorSettings(noise_rate=noise_rate)))
    assert estimate_thresholds(recording, CAMERA, USUAL) is None


def test_what_clips_everywhere_and_one_sign_alone_tell_nothing():
    """A threshold that no event tells of is not made up."""
    recording = unlabelled(moving_blocks(0.08, 0.9, size=SIZE))
    stream, frames = np.concatenate([*recording.events()]), [*recording.frames()]
    white = np.full(SIZE, 255, np.uint8)
    clipped = [Frame(white, frame.exposure_start, frame.exposure_end) for frame in frames]
    for some, shown in (
        (stream, clipped),
        (stream[stream["p"]], frames),
        (stream[:: len(stream) // 10], frames),
    ):
        one = Recording.from_arrays(some, shown, sensor_size=SIZE)
        assert estimate_thresholds(one, CAMERA, USUAL) is None


def test_frames_alone_tell_nothing():
    frames = [Frame(np.full((32, 40), v, np.uint8), t, t + 5000) for t, v in ((0, 90), (40_000, 120))]
    assert (
        estimate_thresholds(Recording.from_arrays(events(), frames, sensor_size=(32, 40)), CAMERA, USUAL)
        is None
    )


def test_unknown_exposures_are_an_error():
    recording = unlabelled(moving_blocks(0.08, 0.9, sensor=SENSORS["ideal"], size=SIZE))
    recording.exposure_known = False
    with pytest.raises(ExposureError, match="no exposure times"):
        estimate_thresholds(recording, CAMERA, USUAL)
