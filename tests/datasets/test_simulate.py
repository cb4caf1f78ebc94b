"""The simulator against sums done by hand."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from kalux.datasets import (
    DEMO_SENSOR,
    Sampling,
    Scene,
    SensorSettings,
    combine,
    demo_scene,
    handheld,
    linear_ramp,
    log_ramp,
    moving_edge,
    pan,
    photograph_scene,
    simulate,
    static,
)
from kalux.datasets.event_stream import draw_thresholds
from kalux.datasets.exposure import mean_radiance
from kalux.datasets.room import pink_noise
from kalux.datasets.scenes import LOG_OFFSET
from kalux.errors import ExposureError, InputError, SettingsError
from kalux.events import EVENT_DTYPE, EventArray, check_events
from kalux.frames import check_frame

SIZE = (8, 10)
PIXELS = SIZE[0] * SIZE[1]


def one_pixel(events: EventArray, x: int, y: int) -> EventArray:
    return events[(events["x"] == x) & (events["y"] == y)]


def pixels(events: EventArray, size: tuple[int, int]) -> Iterator[tuple[int, int, EventArray]]:
    for y, x in np.ndindex(*size):
        yield y, x, one_pixel(events, x, y)


def same(a: EventArray, b: EventArray) -> bool:
    return all(np.array_equal(a[name], b[name]) for name in "txyp")


# --- event times and counts -----------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [1.5, -1.3, 41.0])
@pytest.mark.parametrize(("on", "off"), [(0.2, 0.2), (0.13, 0.31)])
def test_log_ramp_has_exact_count_and_times(rate: float, on: float, off: float) -> None:
    start, seconds = (0.5, 0.1) if rate > 10 else (0.5, 1.0)
    scene = log_ramp(start, rate, duration=round(seconds * 1e6))
    events = simulate(scene, SensorSettings(threshold_on=on, threshold_off=off)).events
    threshold = on if rate > 0 else off
    count = int(abs(rate) * seconds / threshold)
    expected = np.arange(1, count + 1) * threshold / abs(rate) * 1e6
    assert events.dtype == EVENT_DTYPE
    assert len(events) == count * PIXELS
    assert (events["p"] == (rate > 0)).all()
    for _, _, found in pixels(events, SIZE):
        assert np.abs(found["t"] - expected).max() <= 0.5 + 1e-3


def test_several_crossings_within_one_step() -> None:
    coarse = Sampling(threshold_fraction=1e6, min_step=4000, max_step=50_000)
    scene = log_ramp(0.01, 60.0, duration=100_000)
    sensor = SensorSettings(threshold_on=0.17)
    assert same(simulate(scene, sensor, sampling=coarse).events, simulate(scene, sensor).events)
    assert len(simulate(scene, sensor, sampling=coarse).events) == int(6.0 / 0.17) * PIXELS


def test_moving_edge_has_its_count_while_it_crosses() -> None:
    low, high, speed = 0.05, 3.0, 20.0
    scene = moving_edge(low, high, speed=speed)
    events = simulate(scene, SensorSettings(threshold_on=0.15)).events
    count = int(np.log((high + LOG_OFFSET) / (low + LOG_OFFSET)) / 0.15)
    assert events["p"].all()
    for _, x, found in pixels(events, SIZE):
        assert len(found) == count
        # (radiance + offset) at event n, and so the part of the pixel that the edge has passed.
        level = (low + LOG_OFFSET) * np.exp(0.15 * np.arange(1, count + 1)) - LOG_OFFSET
        expected = (x + (level - low) / (high - low)) / speed * 1e6
        assert np.abs(found["t"] - expected).max() < 125


def test_static_scene_without_noise_is_silent() -> None:
    assert len(simulate(static(0.0)).events) == 0


def test_a_scene_may_start_at_any_time() -> None:
    at_zero = simulate(log_ramp(0.1, 2.0)).events
    ramp = log_ramp(0.1, 2.0)
    late = Scene(lambda t: ramp.radiance(t - 7_000_000), SIZE, 7_000_000, 8_000_000)
    events = simulate(late).events
    assert np.array_equal(events["t"], at_zero["t"] + 7_000_000)


def test_timestamps_are_multiples_of_the_resolution() -> None:
    events = simulate(log_ramp(), SensorSettings(timestamp_resolution=1000)).events
    assert (events["t"] % 1000 == 0).all()
    assert np.abs(events["t"] - simulate(log_ramp()).events["t"]).max() <= 500


def test_ties_are_broken_by_row_then_column() -> None:
    events = simulate(log_ramp()).events[:PIXELS]
    assert len(np.unique(events["t"])) == 1
    assert np.array_equal(events["y"].astype(int) * SIZE[1] + events["x"], np.arange(PIXELS))


# --- refractory period ----------------------------------------------------------------------------------


def test_refractory_period_delays_and_loses_change() -> None:
    rate, threshold, refractory = 4.0, 0.2, 20_000
    scene = log_ramp(0.05, rate)
    sensor = SensorSettings(threshold_on=threshold, refractory=refractory)
    rise = threshold / rate * 1e6
    expected = np.arange(rise, 1e6, rise + refractory)
    for _, _, found in pixels(simulate(scene, sensor).events, SIZE):
        assert np.abs(found["t"] - expected).max() <= 0.5 + 1e-3


def test_refractory_period_longer_than_the_scene_leaves_one_event() -> None:
    events = simulate(log_ramp(), SensorSettings(refractory=5e6)).events
    assert len(events) == PIXELS


def piecewise(knots: NDArray[Any], spacing: int) -> tuple[Scene, NDArray[Any]]:
    """A scene of one row whose log intensity is linear between knots (K, width); and the knots' times."""
    times = np.arange(len(knots)) * spacing

    def radiance(t: float) -> NDArray[Any]:
        level = np.array([np.interp(t, times, column) for column in knots.T])
        return np.maximum(np.exp(level) - LOG_OFFSET, 0.0)[None, :]

    return Scene(radiance, (1, knots.shape[1]), 0, int(times[-1])), times


@settings(max_examples=60, deadline=None)
@given(
    levels=st.lists(
        st.lists(st.floats(np.log(0.02), np.log(20.0)), min_size=3, max_size=3), min_size=3, max_size=6
    ),
    on=st.floats(0.06, 0.5),
    off=st.floats(0.06, 0.5),
    refractory=st.sampled_from([0.0, 700.0, 9000.0]),
)
def test_replayed_events_explain_the_signal(
    levels: list[list[float]], on: float, off: float, refractory: float
) -> None:
    """One pixel at a time: each event is where the signal reaches the threshold, and none is missing."""
    spacing = 20_000
    knots = np.array(levels)
    scene, times = piecewise(knots, spacing)
    sensor = SensorSettings(threshold_on=on, threshold_off=off, refractory=refractory)
    events = simulate(scene, sensor).events
    tolerance = 1e-6 + 2.0 * np.abs(np.diff(knots, axis=0)).max() / spacing  # of two microseconds
    for _, x, found in pixels(events, scene.sensor_size):
        reference, since, summed = knots[0, x], 0.0, knots[0, x]
        for t, p in [*zip(found["t"].tolist(), found["p"].tolist(), strict=True), (scene.end, None)]:
            inside = times[(times > since) & (times < t)]
            at_corners = np.interp(np.append(inside, t), times, knots[:, x]) - reference
            if t >= since:
                assert at_corners.max() <= on + tolerance * len(levels)
                assert -at_corners.min() <= off + tolerance * len(levels)
            if p is None:
                break
            assert t >= since - 1
            summed += on if p else -off
            assert at_corners[-1] == pytest.approx(on if p else -off, abs=tolerance * len(levels))
            since = t + refractory
            # Without a refractory period the reference is exactly the sum of the events.
            reference = np.interp(since, times, knots[:, x]) if refractory else summed


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**31), on=st.floats(0.1, 0.4), off=st.floats(0.1, 0.4))
def test_summed_events_stay_within_a_threshold_of_the_truth(seed: int, on: float, off: float) -> None:
    rng = np.random.default_rng(seed)
    image = np.exp(1.2 * pink_noise((64, 80), rng))
    size = (12, 16)
    scene = photograph_scene(
        image,
        combine(pan(60, -20), handheld(seed, sway=3)),
        sensor_size=size,
        duration=200_000,
        scale=2.0,
    )
    simulation = simulate(scene, SensorSettings(threshold_on=on, threshold_off=off))
    start = np.log(scene.at(0) + LOG_OFFSET)
    for t in (50_000, 120_000, 200_000):
        until = simulation.events[simulation.events["t"] <= t]
        step = np.where(until["p"], on, -off)
        summed = np.zeros(size)
        np.add.at(summed, (until["y"], until["x"]), step)
        error = np.log(scene.at(t) + LOG_OFFSET) - (start + summed)
        assert error.max() < on + 0.02
        assert -error.min() < off + 0.02


# --- thresholds and noise -------------------------------------------------------------------------------


def test_mismatch_has_its_spread_and_bound() -> None:
    sensor = SensorSettings(threshold_on=0.2, threshold_off=0.3, threshold_mismatch=0.1)
    on, off = draw_thresholds((200, 200), sensor, seed=1)
    for thresholds, mean in ((on, 0.2), (off, 0.3)):
        assert thresholds.mean() == pytest.approx(mean, rel=0.005)
        assert thresholds.std() == pytest.approx(0.1 * mean, rel=0.03)
    assert abs(np.corrcoef(on.ravel(), off.ravel())[0, 1]) < 0.03
    wide, _ = draw_thresholds((200, 200), SensorSettings(threshold_mismatch=2.0), seed=1)
    assert wide.min() == pytest.approx(0.2 * 0.2)


def test_each_pixel_fires_at_its_own_threshold() -> None:
    simulation = simulate(log_ramp(0.1, 3.0), SensorSettings(threshold_mismatch=0.15), seed=3)
    for y, x, found in pixels(simulation.events, SIZE):
        assert len(found) == int(3.0 / simulation.threshold_on[y, x])


def test_noise_rate_is_poisson() -> None:
    size, rate, seconds = (60, 80), 4.0, 2.0
    scene = static(sensor_size=size, duration=round(seconds * 1e6))
    events = simulate(scene, SensorSettings(noise_rate=rate), seed=5).events
    expected = rate * seconds * size[0] * size[1]
    assert abs(len(events) - expected) < 4 * np.sqrt(expected)
    assert abs(events["p"].mean() - 0.5) < 4 * 0.5 / np.sqrt(expected)
    per_pixel = np.bincount(events["y"].astype(int) * size[1] + events["x"], minlength=size[0] * size[1])
    assert per_pixel.var() == pytest.approx(rate * seconds, rel=0.1)
    check_events(events, size)


def test_noise_is_added_without_touching_the_signal() -> None:
    scene = log_ramp(0.1, 2.0)
    clean = simulate(scene, SensorSettings()).events
    noisy = simulate(scene, SensorSettings(noise_rate=20.0)).events
    check_events(noisy, SIZE)
    assert len(noisy) > len(clean)
    assert set(clean.tolist()) <= set(noisy.tolist())


def test_noise_that_resets_is_an_event_of_the_pixel() -> None:
    rate, threshold, refractory = 2.0, 0.2, 3000.0
    sensor = SensorSettings(threshold_on=threshold, noise_rate=20.0, noise_resets=True, refractory=refractory)
    scene = log_ramp(0.1, rate)
    events = simulate(scene, sensor, seed=2).events
    rise = threshold / rate * 1e6
    assert not events["p"].all()
    for _, _, found in pixels(events, SIZE):
        gaps = np.diff(found["t"])
        # The reference is reset at the end of each reset phase, whatever caused the event.
        assert gaps.min() >= refractory
        assert gaps.max() <= refractory + rise + 1


def test_noise_that_resets_moves_the_reference() -> None:
    sensor = SensorSettings(noise_rate=20.0, noise_resets=True)
    noise = simulate(static(), sensor, seed=2).events
    assert same(noise, simulate(static(), SensorSettings(noise_rate=20.0), seed=2).events)
    rate = 2.0
    events = simulate(log_ramp(0.1, rate), sensor, seed=2).events
    rise = sensor.threshold_on / rate * 1e6
    for y, x, found in pixels(events, SIZE):
        # From any event a full threshold away: what comes sooner can only be noise.
        gaps = np.diff(found["t"], prepend=0)
        assert gaps.max() <= rise + 1
        assert (gaps < rise - 1).sum() == len(one_pixel(noise, x, y))


# --- determinism ----------------------------------------------------------------------------------------


def imperfect(**changes: Any) -> SensorSettings:
    values: dict[str, Any] = {
        "threshold_mismatch": 0.1,
        "noise_rate": 3.0,
        "refractory": 500.0,
        "read_noise": 0.01,
        "full_well": 5000.0,
    }
    return SensorSettings(**(values | changes))


def test_a_seed_decides_every_bit() -> None:
    first, again, other = (simulate(moving_edge(), imperfect(), seed=seed) for seed in (4, 4, 5))
    assert same(first.events, again.events)
    assert all(np.array_equal(a.image, b.image) for a, b in zip(first.frames, again.frames, strict=True))
    assert not same(first.events, other.events)
    assert not all(np.array_equal(a.image, b.image) for a, b in zip(first.frames, other.frames, strict=True))


def test_causes_of_noise_are_independent() -> None:
    first = simulate(moving_edge(), imperfect(), seed=4)
    quiet = simulate(moving_edge(), imperfect(noise_rate=0.0), seed=4)
    assert np.array_equal(first.threshold_on, quiet.threshold_on)
    assert all(np.array_equal(a.image, b.image) for a, b in zip(first.frames, quiet.frames, strict=True))


def test_global_random_state_is_left_alone() -> None:
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    simulate(moving_edge(), imperfect())
    assert np.random.get_state()[1].tolist() == before  # noqa: NPY002


# --- frames ---------------------------------------------------------------------------------------------


def test_exposure_of_a_linear_ramp_is_its_middle() -> None:
    scene = linear_ramp(0.2, 0.5)
    simulation = simulate(scene, SensorSettings(bits=16, exposure=30_000))
    assert len(simulation.frames) == 24
    for frame in simulation.frames:
        middle = (frame.exposure_start + frame.exposure_end) / 2
        assert frame.image.dtype == np.uint16
        assert np.allclose(frame.normalised(), 0.2 + 0.5 * middle * 1e-6, atol=0.5 / 65535 + 1e-12)


def test_exposure_of_an_exponential_is_its_integral() -> None:
    start, rate = 0.1, 8.0
    scene = log_ramp(start, rate)
    a, b = 0.1, 0.14
    integral = (start + LOG_OFFSET) * (np.exp(rate * b) - np.exp(rate * a)) / (rate * (b - a)) - LOG_OFFSET
    assert np.allclose(mean_radiance(scene, 100_000, 140_000, 500), integral, rtol=1e-5)


def test_frames_are_evenly_spaced_and_pass_the_checks() -> None:
    frames = simulate(static(), SensorSettings(frame_rate=25, exposure=15_000)).frames
    assert [frame.middle for frame in frames] == [20_000 + 40_000 * k for k in range(25)]
    for k, frame in enumerate(frames):
        check_frame(frame, SIZE, index=k, previous=frames[k - 1] if k else None)


@pytest.mark.parametrize(
    ("bits", "dtype", "white"),
    [(1, np.uint8, 1), (8, np.uint8, 255), (10, np.uint16, 1023), (16, np.uint16, 65535)],
)
def test_quantisation_and_saturation(bits: int, dtype: type, white: int) -> None:
    for radiance in (0.0, 0.3, 0.5001, 0.999, 1.0, 7.0):
        frame = simulate(static(radiance), SensorSettings(bits=bits)).frames[0]
        assert frame.image.dtype == dtype
        assert frame.white_value == white
        assert (frame.image == round(min(radiance, 1.0) * white)).all()


def test_varying_exposures_scale_the_frames() -> None:
    exposures = [2000, 4000, 8000, 16_000, 4000]
    sensor = SensorSettings(bits=16, frame_rate=5)
    frames = simulate(static(0.2), sensor, exposures=exposures).frames
    assert [frame.exposure for frame in frames] == exposures
    # 1.0 is white at the median exposure, 4 ms.
    expected = [min(0.2 * e / 4000, 1.0) for e in exposures]
    assert np.allclose([frame.normalised().mean() for frame in frames], expected, atol=1e-5)
    fixed = SensorSettings(bits=16, frame_rate=5, reference_exposure=8000)
    half = simulate(static(0.2), fixed, exposures=exposures).frames
    assert half[0].normalised().mean() == pytest.approx(0.2 / 4, abs=1e-5)


def test_response_is_applied_to_irradiance() -> None:
    sensor = SensorSettings(bits=16, response=lambda i: i**0.5)
    frame = simulate(static(0.25), sensor).frames[0]
    assert frame.normalised().mean() == pytest.approx(0.5, abs=1e-5)


def test_read_noise_and_shot_noise_have_their_spread() -> None:
    size = (100, 100)
    read = simulate(static(0.5, sensor_size=size), SensorSettings(bits=16, read_noise=0.01)).frames[0]
    assert read.normalised().std() == pytest.approx(0.01, rel=0.03)
    shot = simulate(static(0.5, sensor_size=size), SensorSettings(bits=16, full_well=10_000.0)).frames[0]
    assert shot.normalised().std() == pytest.approx(np.sqrt(0.5 / 10_000), rel=0.03)
    assert shot.normalised().mean() == pytest.approx(0.5, rel=0.001)


def test_read_noise_leaves_highlights_saturated() -> None:
    frames = simulate(static(1.5), SensorSettings(read_noise=0.01)).frames
    assert all((frame.image == 255).all() for frame in frames)


# --- truth and recording --------------------------------------------------------------------------------


def test_truth_is_at_the_middles_and_halfway() -> None:
    simulation = simulate(linear_ramp(0.2, 0.5), SensorSettings(frame_rate=10))
    assert simulation.truth_times().tolist() == list(range(150_000, 850_001, 50_000))
    truth = simulation.truth()
    assert truth.images.dtype == np.float32
    assert truth.images.shape == (15, *SIZE)
    assert np.allclose(truth.images[:, 0, 0], 0.2 + 0.5 * truth.times * 1e-6)
    assert simulation.truth([1000]).images.shape == (1, *SIZE)


def test_recording_carries_everything() -> None:
    simulation = simulate(moving_edge(), SensorSettings(threshold_on=0.15, threshold_off=0.25))
    recording = simulation.recording()
    assert recording.sensor_size == SIZE
    assert recording.contrast_threshold == (0.15, 0.25)
    assert same(np.concatenate(list(recording.events())), simulation.events)
    assert len(recording.frames()) == len(simulation.frames)
    truth = recording.ground_truth()
    assert truth is not None
    assert np.array_equal(truth.times, simulation.truth_times())


def test_demo_makes_a_recording() -> None:
    scene = demo_scene(sensor_size=(45, 60), duration=200_000)
    recording = simulate(scene, DEMO_SENSOR).recording()
    assert len(recording.events()) > 1000
    assert len(recording.frames()) == 5


# --- what is refused ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {"threshold_on": 0.0},
        {"threshold_off": -0.1},
        {"threshold_mismatch": -1.0},
        {"log_offset": 0.0},
        {"refractory": -1.0},
        {"noise_rate": float("nan")},
        {"full_well": 0.0},
        {"bits": 17},
        {"timestamp_resolution": 0},
    ],
)
def test_settings_out_of_range_are_named(change: dict[str, Any]) -> None:
    with pytest.raises(SettingsError, match=next(iter(change))):
        SensorSettings(**change)


def test_sampling_out_of_range_is_named() -> None:
    with pytest.raises(SettingsError, match="max_step"):
        Sampling(min_step=500, max_step=400)


def test_negative_seed_is_refused() -> None:
    with pytest.raises(SettingsError, match="seed"):
        simulate(static(), seed=-1)


def test_exposures_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ExposureError, match="do not fit"):
        simulate(static(), SensorSettings(exposure=50_000))
    with pytest.raises(ExposureError, match="3 exposures for 24 frames"):
        simulate(static(), exposures=[1000] * 3)
    with pytest.raises(ExposureError, match="positive"):
        simulate(static(), exposures=[0] * 24)


@pytest.mark.parametrize("image", [np.zeros((2, 2)), np.full(SIZE, -0.1), np.full(SIZE, np.nan)])
def test_a_scene_must_return_radiance(image: NDArray[Any]) -> None:
    with pytest.raises(InputError, match="radiance"):
        simulate(Scene(lambda t: image, SIZE, 0, 100_000))
