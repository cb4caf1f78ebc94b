"""Event pixels, one imperfection at a time, against sums done by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from kalux.datasets import Sampling, Scene, SensorSettings, log_ramp, simulate, static
from kalux.datasets.scenes import LOG_OFFSET
from kalux.events import EventArray

SIZE = (20, 30)
PIXELS = SIZE[0] * SIZE[1]


def events_of(scene: Scene, seed: int = 0, **changes: Any) -> EventArray:
    return simulate(scene, SensorSettings(**changes), seed=seed).events


def per_pixel(events: EventArray, size: tuple[int, int]) -> NDArray[Any]:
    """Number of events of each pixel."""
    return np.bincount(events["y"].astype(int) * size[1] + events["x"], minlength=size[0] * size[1])


def same(a: EventArray, b: EventArray) -> bool:
    return all(np.array_equal(a[name], b[name]) for name in "txyp")


def step(before: float, after: float, at: float = 500_000) -> Scene:
    """Radiance that jumps."""
    return Scene(lambda t: np.full((3, 4), before if t < at else after), (3, 4), 0, 1_000_000, "step")


# --- latency ----------------------------------------------------------------------------------------------


def test_latency_delays_every_time_stamp() -> None:
    scene = log_ramp(0.1, 2.0)
    plain, late = events_of(scene), events_of(scene, latency=123.0)
    assert np.array_equal(late["t"], plain["t"] + 123)
    assert np.array_equal(late["p"], plain["p"])


# --- leak -------------------------------------------------------------------------------------------------


def test_leak_makes_on_events_at_its_rate() -> None:
    """A still pixel has one ON event each 1/rate, the first after 1/rate."""
    found = events_of(static(sensor_size=(3, 4), duration=3_000_000), leak_rate=2.0)
    assert found["p"].all()
    assert sorted(set(found["t"].tolist())) == [
        500_000,
        1_000_000,
        1_500_000,
        2_000_000,
        2_500_000,
        3_000_000,
    ]
    assert (per_pixel(found, (3, 4)) == 6).all()


@pytest.mark.parametrize("rate", [1.5, -1.3])
def test_leak_adds_to_a_ramp(rate: float) -> None:
    """ON events come sooner, OFF events later: the level and the reference approach each other or part."""
    leak, threshold = 0.7, 0.2
    speed = rate + leak * threshold
    found = events_of(log_ramp(0.5, rate), leak_rate=leak)
    count = int(abs(speed) / threshold)
    expected = np.arange(1, count + 1) * threshold / abs(speed) * 1e6
    assert (found["p"] == (speed > 0)).all()
    assert len(found) == count * 80
    assert np.abs(found["t"].reshape(count, 80) - expected[:, None]).max() <= 0.5 + 1e-3


def test_leak_of_a_settled_sensor_is_not_in_step() -> None:
    """References are uniform from -off to +on, so the first ON events come uniformly within (on + off) / leak."""
    scene = static(sensor_size=SIZE, duration=1_000_000)
    found = events_of(scene, leak_rate=2.0, settled=True)
    # A level uniform in (-1, 1) thresholds rises by 2, and falls back by 1 whenever it reaches 1.
    expected = np.mean(np.floor(np.linspace(-1, 1, 100_001) + 2.0))
    assert len(found) / PIXELS == pytest.approx(expected, abs=4 / np.sqrt(PIXELS))
    assert len(np.unique(found["t"])) > 0.9 * len(found)


def test_rates_spread_between_pixels() -> None:
    scene = static(sensor_size=(40, 50), duration=4_000_000)
    found = per_pixel(events_of(scene, leak_rate=10.0, noise_spread=0.2), (40, 50))
    assert np.log10(np.maximum(found, 1)).std() == pytest.approx(0.2, rel=0.05)
    assert np.median(found) == pytest.approx(40, rel=0.05)


def test_hot_pixels_leak_at_their_own_rate() -> None:
    scene = static(sensor_size=(40, 50))
    found = per_pixel(events_of(scene, hot_pixels=0.05, hot_rate=30.0), (40, 50))
    assert set(found.tolist()) == {0, 30}
    assert (found > 0).mean() == pytest.approx(0.05, abs=4 * np.sqrt(0.05 / 2000))


# --- shot noise -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("resets", [False, True])
@pytest.mark.parametrize("radiance", [0.0, 0.4, 1.0, 5.0])
def test_noise_rate_falls_with_light(radiance: float, resets: bool) -> None:
    """v2e's model: linear from the rate in darkness to its part at white, and no less beyond."""
    rate, at_white, seconds = 20.0, 0.25, 2.0
    scene = static(radiance, sensor_size=SIZE, duration=round(seconds * 1e6))
    found = events_of(scene, seed=3, noise_rate=rate, noise_at_white=at_white, noise_resets=resets)
    expected = rate * (1 + (at_white - 1) * min(radiance, 1.0)) * seconds * PIXELS
    assert abs(len(found) - expected) < 4 * np.sqrt(expected)
    assert abs(found["p"].mean() - 0.5) < 4 * 0.5 / np.sqrt(expected)
    counts = per_pixel(found, SIZE)
    assert counts.var() == pytest.approx(counts.mean(), rel=0.25)


def test_noise_follows_light_that_changes() -> None:
    """Radiance rises from 0 to 1 within a second: half of the events come in the first 2/5.236 of it."""
    scene = Scene(lambda t: np.full(SIZE, t * 1e-6), SIZE, 0, 1_000_000)
    found = events_of(
        scene, noise_rate=40.0, noise_at_white=0.0, threshold_on=100.0, threshold_off=100.0, log_offset=1.0
    )
    # Of a rate 1 - s, the part until s is 2 s - s^2.
    seconds = found["t"] * 1e-6
    for s in (0.2, 0.5, 0.8):
        part = 2 * s - s**2
        assert (seconds < s).mean() == pytest.approx(part, abs=4 * np.sqrt(part * (1 - part) / len(found)))
    assert len(found) == pytest.approx(20 * PIXELS, abs=4 * np.sqrt(20 * PIXELS))


def test_noise_does_not_depend_on_how_time_is_cut() -> None:
    scene = static(0.3, sensor_size=SIZE)
    found = [
        simulate(
            scene, SensorSettings(noise_rate=9.0, noise_at_white=0.5), sampling=Sampling(max_step=step_us)
        ).events
        for step_us in (200.0, 4000.0, 77_777.0)
    ]
    assert len(found[0]) > 3000
    for other in found[1:]:
        assert np.abs(other["t"] - found[0]["t"]).max() <= 1
        assert np.array_equal(np.sort(other["x"]), np.sort(found[0]["x"]))


# --- low pass ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("before", "after"), [(0.05, 0.5), (0.5, 0.05), (0.01, 4.0)])
def test_step_through_the_low_pass(before: float, after: float) -> None:
    """Event n of a step of height h comes tau ln(h / (h - n threshold)) after it, tau that of the light after it."""
    cutoff, threshold = 30.0, 0.2
    fine = Sampling(min_step=5.0)
    found = simulate(step(before, after), SensorSettings(cutoff=cutoff), sampling=fine).events
    height = abs(np.log((after + LOG_OFFSET) / (before + LOG_OFFSET)))
    tau = 1e6 / (2 * np.pi * cutoff * (after + LOG_OFFSET))
    # Within half a second, the level comes this near to the end.
    count = int(height * (1 - np.exp(-500_000 / tau)) / threshold)
    expected = 500_000 + tau * np.log(height / (height - threshold * np.arange(1, count + 1)))
    assert (found["p"] == (after > before)).all()
    assert len(found) == 12 * count
    # The simulator sees the jump as a ramp of 8 us, most of it in bright light, where the low pass is quick.
    assert np.abs(found["t"].reshape(count, 12) - expected[:, None]).max() < 30


def test_ramp_through_the_low_pass_is_late_by_its_time_constant() -> None:
    """Where light hardly changes tau, a ramp comes out as late as tau, once it has settled."""
    cutoff, rate, threshold = 8.0, 0.05, 0.001
    scene = log_ramp(0.5, rate, sensor_size=(2, 2))
    found = events_of(scene, cutoff=cutoff, threshold_on=threshold)
    tau = 1 / (2 * np.pi * cutoff * (0.5 + LOG_OFFSET))
    n = np.arange(1, len(found) // 4 + 1)
    late = found["t"].reshape(-1, 4)[:, 0] * 1e-6 - n * threshold / rate
    assert late[20:] == pytest.approx(np.full(len(n) - 20, tau), rel=0.06)


def test_dark_pixels_are_later() -> None:
    scene = Scene(
        lambda t: np.array([[0.02, 0.2, 2.0]]) * (1.0 if t < 200_000 else 1.5), (1, 3), 0, 1_000_000, "steps"
    )
    found = events_of(scene, cutoff=20.0, threshold_on=0.3)
    delay = np.array([found["t"][found["x"] == x][0] - 200_000 for x in range(3)])
    light = np.array([0.02, 0.2, 2.0]) * 1.5 + LOG_OFFSET
    assert (np.diff(delay) < 0).all()
    height = np.log(light / (np.array([0.02, 0.2, 2.0]) + LOG_OFFSET))
    expected = 1e6 / (2 * np.pi * 20.0 * light) * np.log(height / (height - 0.3))
    assert np.abs(delay - expected).max() < 140


def test_fast_flicker_is_smoothed_away() -> None:
    """Far above its cutoff, the low pass leaves less than a threshold of a strong flicker."""
    scene = Scene(
        lambda t: np.full((2, 2), 0.5 * np.exp(0.5 * np.sin(2 * np.pi * 400e-6 * t))),
        (2, 2),
        0,
        200_000,
        "flicker",
    )
    fine = Sampling(max_step=250.0)
    seen = simulate(scene, SensorSettings(), sampling=fine).events
    smoothed = simulate(scene, SensorSettings(cutoff=20.0), sampling=fine).events
    assert len(seen) > 1000
    assert len(smoothed) == 0


def test_a_bright_low_pass_is_none() -> None:
    scene = log_ramp(0.5, 3.1)
    assert np.abs(events_of(scene, cutoff=1e7)["t"] - events_of(scene)["t"]).max() <= 1


@settings(max_examples=25)
@given(
    levels=st.lists(st.floats(np.log(0.02), np.log(5.0)), min_size=3, max_size=6),
    cutoff=st.floats(3.0, 300.0),
    leak=st.sampled_from([0.0, 3.0]),
    refractory=st.sampled_from([0.0, 3000.0]),
)
def test_low_pass_with_everything_against_small_steps(
    levels: list[float], cutoff: float, leak: float, refractory: float
) -> None:
    """The exact solution against a naive integration in steps of 2 us."""
    spacing, threshold = 8000, 0.2
    knots = np.arange(len(levels)) * spacing
    scene = Scene(
        lambda t: np.full((1, 1), max(np.exp(np.interp(t, knots, levels)) - LOG_OFFSET, 0.0)),
        (1, 1),
        0,
        knots[-1],
    )
    sensor = SensorSettings(cutoff=cutoff, leak_rate=leak, refractory=refractory)
    found = simulate(
        scene, sensor, sampling=Sampling(threshold_fraction=0.05, max_step=100.0, min_step=20.0)
    ).events
    dt = 2.0
    t = np.arange(0, knots[-1], dt)
    target = np.interp(t + dt / 2, knots, levels)
    share = -np.expm1(-dt * 2 * np.pi * cutoff * np.exp(target) * 1e-6)
    level = reference = levels[0]
    release, expected = -1.0, []
    for now, goal, part in zip((t + dt).tolist(), target.tolist(), share.tolist(), strict=True):
        level += part * (goal - level)
        reference -= leak * threshold * 1e-6 * dt
        if now < release:
            reference = level
            continue
        if abs(level - reference) >= threshold:
            up = level > reference
            expected.append((now, up))
            reference += threshold if up else -threshold
            release = now + refractory
    # An event at the very end, or a level that only just touches its threshold, may go either way.
    assert abs(len(found) - len(expected)) <= 1
    common = min(len(found), len(expected))
    if abs(len(found) - len(expected)) == 0 and common:
        late = found["t"] - np.array([now for now, _ in expected])
        assert np.array_equal(found["p"], [up for _, up in expected])
        assert np.median(np.abs(late)) < 30
