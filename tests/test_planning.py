"""What is settled before a reconstruction begins, and from where."""

from __future__ import annotations

import dataclasses
from functools import reduce

import numpy as np
import pytest

import kalux
from kalux import PRESETS, Frame, Recording, reconstruct
from kalux.datasets import SensorSettings, demo_scene, simulate
from kalux.errors import FrameError, InputError, SettingsError
from kalux.events import EVENT_DTYPE
from kalux.models.camera import BrightTail, Camera, count_bright
from kalux.pipeline import execute
from kalux.plan_report import plan_report
from kalux.planning import plan
from kalux.settings import altered

from builders import events, frame, moving_blocks, passing_by, recording, sky, textured, unlabelled


@pytest.mark.parametrize(
    ("first", "options", "message"),
    [
        ("night.aedat4", {}, "recording is a str; a kalux.Recording is needed, from kalux.open"),
        (None, {}, "recording is a NoneType; a kalux.Recording is needed"),
        (
            recording,
            {"settings": {"filter": {"kind": "cf"}}},
            "settings is a dict; a kalux.Settings is needed",
        ),
        (recording, {"calibration": "c.toml"}, "calibration is a str; a kalux.Calibration is needed"),
    ],
)
def test_arguments_of_the_wrong_type_are_named(first, options, message):
    with pytest.raises(InputError, match=message):
        reconstruct(first() if callable(first) else first, rate_hz=10, **options)


def test_thresholds_of_the_settings_come_first():
    chosen = altered(PRESETS["default"], "events", threshold_on=0.31, threshold_off=0.32)
    made = plan(recording(), rate_hz=10, settings=chosen, preset="cf")
    assert made.threshold_origin == "settings"
    assert made.estimate is None
    assert (made.settings.events.threshold_on, made.settings.events.threshold_off) == (0.31, 0.32)
    assert made.settings.filter.kind == "akf"


def test_then_those_of_the_recording():
    made = plan(recording(), rate_hz=10)
    assert made.threshold_origin == "recording"
    assert (made.settings.events.threshold_on, made.settings.events.threshold_off) == (0.25, 0.2)
    half = plan(recording(), rate_hz=10, settings=altered(PRESETS["default"], "events", threshold_on=0.4))
    assert (half.settings.events.threshold_on, half.settings.events.threshold_off) == (0.4, 0.2)


def stating(simulation, *, times=1.0, aside=0):
    """A recording that states ``times`` the true thresholds, and whose frames are some columns aside."""
    made = simulation.recording()
    frames = [
        dataclasses.replace(shown, image=np.roll(shown.image, aside, axis=1)) for shown in simulation.frames
    ]
    on, off = made.contrast_threshold
    return Recording.from_arrays(
        simulation.events,
        frames,
        sensor_size=made.sensor_size,
        contrast_threshold=(times * on, times * off),
    )


@pytest.mark.parametrize("times", [0.6, 1.0, 1.4])
def test_unless_its_frames_contradict_them(times):
    made = plan(stating(moving_blocks(0.08, 0.9), times=times), rate_hz=10)
    assert made.threshold_origin == ("recording" if times == 1.0 else "estimate")
    assert made.contradicted == (None if times == 1.0 else (0.2 * times, 0.2 * times))
    assert made.settings.events.threshold_on == pytest.approx(0.2, rel=0.12)
    assert made.settings.events.threshold_off == pytest.approx(0.2, rel=0.12)
    assert made.settings.events.extrapolation_gain == 1.0


def test_thresholds_of_the_settings_are_kept_but_believed_less_beyond_white():
    chosen = altered(PRESETS["default"], "events", threshold_on=0.3, threshold_off=0.3)
    made = plan(stating(moving_blocks(0.08, 0.9)), rate_hz=10, settings=chosen)
    assert (made.threshold_origin, made.settings.events.threshold_on) == ("settings", 0.3)
    assert made.event_model.agreement.contradicts_thresholds
    assert made.settings.events.extrapolation_gain == pytest.approx(0.67 / 0.88, rel=0.1)
    given = plan(
        stating(moving_blocks(0.08, 0.9)),
        rate_hz=10,
        settings=altered(chosen, "events", extrapolation_gain=0.4),
    )
    assert given.settings.events.extrapolation_gain == 0.4


def test_frames_beside_the_events_change_no_thresholds():
    """Estimated ones explain such frames no better than those that are stated."""
    made = plan(stating(moving_blocks(0.08, 0.9), aside=6), rate_hz=10)
    assert (made.threshold_origin, made.contradicted) == ("recording", None)
    assert made.event_model.agreement.explained < 0.5
    assert made.settings.events.extrapolation_gain < 0.7


def test_then_an_estimate():
    made = plan(unlabelled(moving_blocks(0.08, 0.9)), rate_hz=10)
    assert made.threshold_origin == "estimate"
    assert made.settings.events.threshold_on == made.estimate.on == pytest.approx(0.2, rel=0.12)
    assert made.settings.events.threshold_off == made.estimate.off == pytest.approx(0.2, rel=0.12)


def test_and_last_an_assumption():
    made = plan(recording(0, None), rate_hz=10)
    assert made.threshold_origin == "assumed"
    assert made.estimate is None
    assert made.settings.events.threshold_on == made.settings.events.threshold_off == 0.25
    assert (made.settings.events.threshold_spread, made.settings.events.delay) == (0.5, 0)


def test_of_a_sensor_the_usual_is_assumed():
    """One frame tells no threshold, no delay and no step."""
    frames = [frame(100, 0, 10_000)]
    alone = Recording.from_arrays(events(), frames, sensor_size=(1, 1))
    made = plan(alone, at="frames", preset="davis346")
    usual = PRESETS["davis346"].events
    found = made.settings.events
    assert made.threshold_origin == "assumed"
    assert (found.threshold_on, found.threshold_off) == (usual.usual_threshold_on, usual.usual_threshold_off)
    assert (found.delay, found.step_variance) == (usual.usual_delay, usual.usual_step_variance)
    assert found.threshold_spread == 0.2


def test_a_sensors_usual_thresholds_give_way_to_the_recordings():
    known = plan(recording(), at="frames", preset="davis346")
    assert known.threshold_origin == "recording"
    assert (known.settings.events.threshold_on, known.settings.events.threshold_off) == (0.25, 0.2)
    told = plan(unlabelled(moving_blocks(0.08, 0.9)), at="frames", preset="davis240c")
    assert told.threshold_origin == "estimate"
    assert told.settings.events.threshold_on == pytest.approx(0.2, rel=0.12)


@pytest.mark.parametrize(
    ("name", "preset", "part"),
    [("newton_davis346.aedat4", "davis346", 0.6), ("slider_depth", "davis240c", 1.05)],
)
def test_a_sensors_preset_helps_where_there_is_one_frame(shared_data, name, preset, part):
    """The next frame is nearer to what is made of the frame before it and of the events."""
    unknown = {} if "aedat4" in name else {"exposure": 10_000}
    whole = kalux.open(shared_data / name, **unknown)
    shown, wanted = list(whole.frames())[2:4]
    near = [e[(e["t"] >= shown.exposure_start) & (e["t"] <= wanted.exposure_end)] for e in whole.events()]
    alone = Recording.from_arrays(np.concatenate(near), [shown], sensor_size=whole.sensor_size)

    def error(preset: str) -> float:
        (image,) = reconstruct(alone, times=[wanted.middle], preset=preset)
        return float(np.mean((image.intensity - wanted.normalised()) ** 2))

    assert error(preset) < part * error("default")


@pytest.mark.parametrize(("bright_tail", "less"), [(0.3, True), (1.0, False)])
def test_highlights_are_believed_less_where_the_threshold_is_an_estimate(bright_tail, less):
    """The same numbers, known and estimated; but not less where frames show that the scene goes on beyond white."""
    simulation = moving_blocks(0.1, 4.0)
    settings = altered(PRESETS["default"], "filter", bright_tail=bright_tail)
    guessed = plan(unlabelled(simulation), at="frames", settings=settings)
    known = plan(unlabelled(simulation), at="frames", settings=guessed.settings)
    assert (guessed.threshold_origin, known.threshold_origin) == ("estimate", "settings")
    sums = []
    for made in (guessed, known):
        images = [image.intensity for image in execute(unlabelled(simulation), made)]
        sums.append(sum(image[image > 1].sum() for image in images))
    assert sums[0] < sums[1] if less else sums[0] == sums[1]


def test_white_is_the_median_exposure_unless_set():
    frames = [frame(100, 40_000 * k, 40_000 * k + e) for k, e in enumerate((2_000, 8_000, 4_000))]
    rec = Recording.from_arrays(events(), frames, sensor_size=(1, 1), contrast_threshold=0.2)
    assert plan(rec, at="frames").settings.camera.reference_exposure == 4_000
    images = list(reconstruct(rec, at="frames"))
    found = [image.intensity[0, 0] for image in images]
    np.testing.assert_allclose(found, np.array([2.0, 0.5, 1.0]) * 100 / 255, rtol=0.1)
    doubled = altered(PRESETS["default"], "camera", reference_exposure=8_000)
    twice = [image.intensity[0, 0] for image in reconstruct(rec, at="frames", settings=doubled)]
    assert twice[1] == pytest.approx(100 / 255, rel=0.1)


def test_a_recording_without_frames():
    rec = Recording.from_arrays(events((1, 0, 0, 1)), [], sensor_size=(1, 1), name="dark.aedat4")
    with pytest.raises(
        FrameError,
        match=r"dark\.aedat4: no frames; kalux needs frames .* join images or a video with --frames",
    ):
        reconstruct(rec, rate_hz=10)


def test_a_recording_without_events():
    frames = [frame(100, 40_000 * k, 40_000 * k + 4_000) for k in range(3)]
    rec = Recording.from_arrays(events(), frames, sensor_size=(1, 1))
    for image in reconstruct(rec, rate_hz=100):
        assert image.intensity[0, 0] == pytest.approx(100 / 255, rel=1e-4)


def test_unknown_preset():
    with pytest.raises(SettingsError, match="unknown preset 'iccv'"):
        reconstruct(recording(), rate_hz=10, preset="iccv")


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


@pytest.mark.parametrize("stated", [True, False], ids=["thresholds stated", "estimated"])
@pytest.mark.parametrize("cut", [102, 240])
def test_a_camera_that_ends_below_full_scale_saturates_there(cut, stated):
    source = passing_by(textured(3 * cut / 255), cut)
    settings = altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2)
    made = plan(source, at="frames", settings=settings if stated else None)
    assert made.settings.camera.saturation == pytest.approx(0.98 * cut / 255)
    assert made.ceiling.level == pytest.approx(cut / 255)
    given = plan(source, at="frames", settings=altered(settings, "camera", saturation=0.9))
    assert (given.settings.camera.saturation, given.ceiling) == (0.9, None)


@pytest.mark.parametrize("picture", [sky(0.5), sky(0.9), textured(0.6)], ids=["sky", "bright sky", "texture"])
def test_a_scene_that_ends_below_white_does_not_saturate(picture):
    """Nor does the paper's filter, whatever it sees."""
    made = plan(passing_by(picture), at="frames")
    assert (made.settings.camera.saturation, made.ceiling) == (0.98, None)
    paper = plan(passing_by(textured(1.2), 102), at="frames", preset="iccv2021")
    assert (paper.settings.camera.saturation, paper.ceiling) == (0.98, None)


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


def test_the_refractory_period_comes_from_noise_and_can_be_given():
    """`iccv2021` knows none, and is not given any."""
    sensor = SensorSettings(noise_rate=20.0, noise_resets=True, refractory=600.0)
    seen = simulate(demo_scene(sensor_size=(90, 120)), sensor).recording()
    found, given = plan(seen, at="frames"), plan(seen, at="frames", settings=refractory(700))
    assert found.dead_time == found.settings.events.refractory_period == pytest.approx(600, rel=0.02)
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


def test_the_bright_tail_comes_from_the_frames_and_can_be_given():
    doubted = recording(0, None)
    made = plan(doubted, at="frames").settings
    counts = [count_bright(Camera.named("linear", 0.98), f.normalised()) for f in doubted.frames()]
    expected = reduce(BrightTail.joined, counts).scale
    assert made.filter.bright_tail == expected
    given = altered(PRESETS["default"], "filter", bright_tail=0.7)
    assert plan(doubted, at="frames", settings=given).settings.filter.bright_tail == 0.7


def test_the_bright_tail_is_not_looked_for_where_nothing_asks_for_it():
    """Thresholds are stated, and no highlight is expected above its bound."""
    chosen = altered(PRESETS["default"], "filter", unshown_tail=0.0)
    assert plan(recording(), at="frames", settings=chosen).settings.filter.bright_tail is None
    assert plan(recording(), at="frames").settings.filter.bright_tail is not None
    assert plan(recording(), at="frames", preset="iccv2021").settings.filter.bright_tail is None


def test_highlights_are_believed_less_where_thresholds_are_estimated():
    """A pixel that events take beyond white: by a prior of the tail's scale, rather than 1.5."""
    frames = [Frame(np.full((4, 4), 200, np.uint8), t, t + 1000) for t in (0, 50_000)]
    rise = np.zeros(8, EVENT_DTYPE)
    rise["t"], rise["p"] = np.arange(60_000, 68_000, 1000), True
    with pytest.warns(UserWarning, match="none of the 8 events lies between"):
        source = Recording.from_arrays(rise, frames, sensor_size=(4, 4))
    stated = altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2)
    seen = []
    for origin in ("settings", "estimate"):
        chosen = dataclasses.replace(plan(source, times=[67_000], settings=stated), threshold_origin=origin)
        (image,) = execute(source, chosen)
        seen.append(image.intensity[0, 0])
    assert seen[0] > seen[1] > 1


def leaking_scene(pixels=0.005):
    """A room, seen by a camera of which some pixels leak."""
    scene = demo_scene(sensor_size=(48, 64), duration=500_000)
    return simulate(scene, SensorSettings(hot_pixels=pixels, hot_rate=200.0), seed=3)


def test_pixels_that_leak_are_found_and_left_out():
    """Where frames are clipped nothing contradicts their events: they would grow to many times what is there."""
    made = leaking_scene()
    seen = made.recording()
    settled = plan(seen, at="frames")
    clean = plan(leaking_scene(0.0).recording(), at="frames")
    assert clean.pixels is None
    assert clean.hot_pixels == 0
    assert settled.pixels is not None
    assert settled.hot_pixels == settled.pixels.hot.sum() > 3
    assert dict(plan_report(seen, settled, PRESETS["default"]))["hot pixels"] == (
        f"{settled.hot_pixels} pixels whose events are left out (measured)"
    )
    assert "hot pixels" not in dict(plan_report(seen, clean, PRESETS["default"]))
    truth = made.truth()
    worst = max(
        float((image.intensity[settled.pixels.hot] / image_truth[settled.pixels.hot]).max())
        for image, image_truth in zip(reconstruct(seen, times=truth.times), truth.images, strict=True)
    )
    assert worst < 3


def test_the_paper_has_no_hot_pixels_and_who_says_so_neither():
    seen = leaking_scene().recording()
    assert plan(seen, at="frames", preset="iccv2021").pixels is None
    kept = altered(PRESETS["default"], "events", leave_out_hot=False)
    assert plan(seen, at="frames", settings=kept).pixels is None
