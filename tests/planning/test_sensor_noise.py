"""Noise of frames and events, from the recording or given."""

from __future__ import annotations

import numpy as np
import pytest

from kalux import PRESETS, Frame, Recording, reconstruct
from kalux.calibration.compression import Compression
from kalux.calibration.refractory import counted_period
from kalux.datasets import SensorSettings, demo_scene, simulate
from kalux.events import EVENT_DTYPE
from kalux.models.dark_levels import dark_shares
from kalux.models.dark_steps import dark_steps
from kalux.plan_report import plan_report
from kalux.planning import plan
from kalux.planning.sensor_noise import with_fixed_pattern
from kalux.settings import altered

from builders import passing_by, recording, slow_scene, textured


def test_the_frame_noise_comes_from_the_frames_and_can_be_given():
    rng = np.random.default_rng(0)
    ramp = np.broadcast_to(np.linspace(20, 200, 80), (60, 80))
    frames = [
        Frame((ramp + rng.normal(0, 2, ramp.shape)).round().astype(np.uint8), t, t + 1000)
        for t in range(0, 400_000, 50_000)
    ]
    source = Recording.from_arrays(np.empty(0, EVENT_DTYPE), frames, sensor_size=ramp.shape)
    made = plan(source, at="frames")
    assert made.frame_noise.read == made.settings.camera.frame_noise == pytest.approx(2 / 255, rel=0.1)
    assert made.frame_noise.shot == made.settings.camera.shot_noise
    for given, expected in (
        ({"frame_noise": 0.004}, (0.004, 0.0)),
        ({"frame_noise": 0.004, "shot_noise": 1e-4}, (0.004, 1e-4)),
        ({"shot_noise": 1e-4}, (made.frame_noise.read, 1e-4)),
    ):
        settings = altered(PRESETS["default"], "camera", **given)
        assert plan(source, at="frames", settings=settings).settings.camera.noise == expected
    unknown = plan(recording(), at="frames")  # its pixels are too few to tell
    assert unknown.frame_noise is None
    assert unknown.settings.camera.noise == (unknown.settings.camera.usual_frame_noise, 0.0)
    paper = plan(source, at="frames", preset="iccv2021").settings
    assert paper.camera.frame_noise is None  # it has a confidence instead


def still_frames(deviation):
    """A slope, with offsets of so many levels."""
    offset = np.random.default_rng(0).normal(0, deviation, (60, 80))
    image = (np.linspace(20, 150, 60)[:, None] + offset).round().astype(np.uint8)
    frames = [Frame(image, 50_000 * k, 50_000 * k + 1000) for k in range(10)]
    return Recording.from_arrays(np.empty(0, EVENT_DTYPE), frames, sensor_size=offset.shape)


def test_where_nothing_moves_the_pattern_is_the_usual_one_or_less_where_smooth_parts_show_less():
    usual = plan(still_frames(4.0), at="frames")
    assert (usual.settings.camera.fixed_pattern, usual.fixed_pattern) == (0.005, None)
    less = plan(still_frames(0.6), at="frames")
    assert less.settings.camera.fixed_pattern == pytest.approx(np.hypot(0.6, 0.29) / 255, rel=0.2)
    assert less.fixed_pattern is None
    report = dict(plan_report(still_frames(0.6), less, PRESETS["default"]))
    assert report["pattern"].endswith("(nothing moves that could tell it; no more is in smooth parts)")


def test_smooth_parts_of_compressed_frames_bound_no_pattern():
    settings = altered(PRESETS["default"], "camera", frame_noise=0.002)
    for compression, expected in ((Compression(0.004), 0.005), (None, 0.0026)):
        found, _ = with_fixed_pattern(still_frames(0.6), settings, compression)
        assert found.camera.fixed_pattern == pytest.approx(expected, rel=0.1)


def test_the_fixed_pattern_comes_from_the_frames_and_can_be_given():
    rng = np.random.default_rng(0)
    ramp, offset = np.linspace(20, 150, 60), rng.normal(0, 2, (60, 80))
    frames = [
        Frame(
            (np.roll(ramp, 9 * k)[:, None] + offset).round().astype(np.uint8), 50_000 * k, 50_000 * k + 1000
        )
        for k in range(10)
    ]
    source = Recording.from_arrays(np.empty(0, EVENT_DTYPE), frames, sensor_size=offset.shape)
    made = plan(source, at="frames")
    assert (
        made.settings.camera.fixed_pattern == made.fixed_pattern.deviation == pytest.approx(2 / 255, rel=0.1)
    )
    none = altered(PRESETS["default"], "camera", fixed_pattern=0.0)
    assert plan(source, at="frames", settings=none).settings.camera.fixed_pattern == 0
    few = plan(recording(), at="frames")  # its pixels are too few to tell: the usual one
    assert (few.settings.camera.fixed_pattern, few.fixed_pattern) == (0.005, None)
    assert plan(source, at="frames", preset="iccv2021").settings.camera.fixed_pattern is None


def test_shares_of_dark_light_come_from_the_frames_and_can_be_given():
    rng = np.random.default_rng(0)
    light = np.broadcast_to(np.where(np.arange(80) < 40, 0.0, 60.0), (60, 80))
    frames = [
        Frame(np.clip(light + rng.normal(0, 5, light.shape), 0, 255).round().astype(np.uint8), t, t + 1000)
        for t in range(0, 400_000, 50_000)
    ]
    source = Recording.from_arrays(np.empty(0, EVENT_DTYPE), frames, sensor_size=light.shape)
    noisy = altered(PRESETS["default"], "camera", frame_noise=0.02)
    made = plan(source, at="frames", settings=noisy)
    shares = dark_shares(made.settings.filter.dark_shares)
    assert sum(shares[:2]) > 0.3
    told = dict(plan_report(source, made, noisy))["dark"]
    assert told.endswith("of light up to 14 times the noise is less than three quarters of it (measured)")
    for given in ("even", made.settings.filter.dark_shares):
        stated = altered(noisy, "filter", dark_shares=given)
        planned = plan(source, at="frames", settings=stated)
        assert planned.settings.filter.dark_shares == given
        assert ("dark" in dict(plan_report(source, planned, stated))) == (given != "even")
    assert plan(source, at="frames", preset="iccv2021").settings.filter.dark_shares == "auto"
    black, even = (
        next(iter(reconstruct(source, at="frames", settings=one))).intensity[:, :30].mean()
        for one in (noisy, altered(noisy, "filter", dark_shares="even"))
    )
    assert black < 0.8 * even  # half of the scene is
    quiet = altered(PRESETS["default"], "camera", frame_noise=0.001)
    assert plan(source, at="frames", settings=quiet).settings.filter.dark_shares == "even"


def test_the_refractory_period_comes_from_noise_and_can_be_given():
    """`iccv2021` knows none, and is not given any."""
    sensor = SensorSettings(noise_rate=20.0, noise_resets=True, refractory=600.0)
    seen = simulate(demo_scene(sensor_size=(60, 80), duration=600_000), sensor).recording()
    found, given = plan(seen, at="frames"), plan(seen, at="frames", settings=refractory(700))
    assert found.dead_time == pytest.approx(600, rel=0.02)
    assert found.settings.events.refractory_period == counted_period(found.dead_time)
    assert (given.dead_time, given.settings.events.refractory_period) == (0, 700)
    assert not plan(seen, at="frames", preset="iccv2021").settings.events.refractory_period
    told = dict(plan_report(seen, found, PRESETS["default"]))
    assert told["refractory"].endswith("ms (measured: noise follows other events no sooner)")


def test_the_background_is_measured_and_at_least_the_least():
    """With lookahead neighbours tell what is noise, by its rate; else ages do, and the usual rate is the least."""
    quiet = passing_by(textured(1.2), 102, noise_rate=0.0)
    loud = passing_by(textured(1.2), 102, noise_rate=6.0)
    made = plan(quiet, at="frames")
    assert made.background_rate < made.settings.events.noise_rate == 0.5
    told = dict(plan_report(quiet, made, PRESETS["default"]))["background"]
    assert "the least that is assumed; measured" in told
    assert plan(quiet, at="frames", lookahead=False).settings.events.noise_rate == 3.0
    for lookahead in (True, False):
        rate = plan(loud, at="frames", lookahead=lookahead).settings.events.noise_rate
        assert rate == pytest.approx(6.0, rel=0.2)


def refractory(period):
    return altered(PRESETS["default"], "events", refractory_period=period)


def test_what_slow_pixels_do_comes_from_frames_and_can_be_given():
    """How far they are behind, and how steps vary in the dark: none in causal mode, and of a filter that has no use for
    either."""
    slow = slow_scene(200.0)
    found = plan(slow, at="frames")
    told = dict(plan_report(slow, found, PRESETS["default"]))
    lag, steps = found.settings.events.lag_variance, dark_steps(found.settings.events.dark_steps)
    assert lag == pytest.approx(found.lag.believed, abs=1e-3)
    assert found.lag.believed > 0.5
    assert told["lag"] == f"of slow pixels at a moment {lag:g} c^2 at 0.02 of white (measured)"
    assert max(steps) > 0.3
    assert (
        told["dark steps"]
        == f"variance of one event up to {max(steps):g} c^2 more below 0.32 of white (measured)"
    )
    causal = plan(slow, at="frames", lookahead=False).settings.events
    assert (causal.lag_variance, causal.dark_steps) == (0.0, "none")
    paper = plan(slow, at="frames", preset="iccv2021").settings.events
    assert (paper.lag_variance, paper.dark_steps) == (None, "auto")
    given = altered(PRESETS["default"], "events", lag_variance=0.7, dark_steps="0 0 0 0 1 2")
    kept = plan(slow, at="frames", settings=given)
    assert (kept.settings.events.lag_variance, kept.lag) == (0.7, None)
    assert kept.settings.events.dark_steps == "0 0 0 0 1 2"
    told = dict(plan_report(slow, kept, given))
    assert told["lag"].endswith("0.7 c^2 at 0.02 of white (given)")
    assert told["dark steps"].endswith("2 c^2 more below 0.32 of white (given)")
    without = altered(PRESETS["default"], "events", dark_steps="none")
    assert "dark steps" not in dict(plan_report(slow, plan(slow, at="frames", settings=without), without))
