"""Frames that say nothing of some pixels (`Frame.valid`), in every method."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kalux import PRESETS, Frame, Reconstructor
from kalux.augmentation.bridge import (
    MASKED,
    UNMEASURED,
    BridgeNoise,
    Latent,
    bridge,
    nominal_thresholds,
    raise_to_bound,
)
from kalux.events import make_events
from kalux.filters.methods import make_method
from kalux.filters.shots import take_shot
from kalux.models.camera import Camera, Response
from kalux.settings import altered

from builders import VARIANTS, events, random_stream

THRESHOLD = 0.2
MODES = pytest.mark.parametrize("lookahead", [True, False], ids=["lookahead", "causal"])
ALL = pytest.mark.parametrize("variant", list(VARIANTS))


def images(stream, frames, variant, lookahead):
    engine = Reconstructor(
        stream.sensor_size,
        settings=VARIANTS[variant],
        lookahead=lookahead,
        contrast_threshold=THRESHOLD,
    )
    for frame in frames:
        engine.push_frame(frame)
    engine.push_events(stream.events)
    engine.finish()
    begin = engine.begin_time
    return [engine.read(t) for t in np.linspace(begin, frames[-1].exposure_end, 9).astype(int).tolist()]


def same(one, other):
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.intensity, b.intensity)
        np.testing.assert_array_equal(a.variance, b.variance)


def masked(frames, masks, values=None):
    """The frames with masks, and with other values where these are False."""
    out = []
    for frame, mask in zip(frames, masks, strict=True):
        image = frame.image if values is None else np.where(mask, frame.image, np.uint8(values))
        out.append(dataclasses.replace(frame, image=image, valid=mask))
    return out


@ALL
@MODES
def test_a_mask_of_valid_pixels_only_changes_nothing(variant, lookahead):
    stream = random_stream(1)
    masks = [np.ones(stream.sensor_size, bool)] * len(stream.frames)
    same(
        images(stream, stream.frames, variant, lookahead),
        images(stream, masked(stream.frames, masks), variant, lookahead),
    )


@ALL
@MODES
@pytest.mark.parametrize("seed", range(3))
def test_values_that_are_not_valid_have_no_weight(variant, lookahead, seed):
    """Black, grey or saturated: after the first frame, which starts the filter, they leave the images as they are."""
    stream = random_stream(seed)
    rng = np.random.default_rng(seed)
    masks = [rng.random(stream.sensor_size) < 0.6 for _ in stream.frames]
    masks[0][:] = True
    made = [
        images(stream, masked(stream.frames, masks, value), variant, lookahead) for value in (0, 100, 255)
    ]
    for other in made[1:]:
        for a, b in zip(made[0], other, strict=True):
            np.testing.assert_allclose(a.intensity, b.intensity, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(a.variance, b.variance, rtol=1e-4)


@ALL
@MODES
def test_pixels_that_are_never_valid_follow_their_events(variant, lookahead):
    settings = altered(VARIANTS[variant], "events", noise_rate=0.0, trail=0.0)
    settings = altered(settings, "filter", highlight_scale=0.0, neighbours=0.0)
    frames = [
        Frame(np.full((1, 2), 100, np.uint8), t, t + 10_000, valid=np.array([[True, False]]))
        for t in (0, 40_000, 80_000)
    ]
    engine = Reconstructor((1, 2), settings=settings, lookahead=lookahead, contrast_threshold=THRESHOLD)
    for frame in frames:
        engine.push_frame(frame)
    engine.push_events(events((20_000, 1, 0, 1), (30_000, 1, 0, 1), (60_000, 1, 0, 0), (70_000, 1, 0, 1)))
    engine.finish()
    offset = settings.camera.offset
    estimates = [engine.estimate(t) for t in (15_000, 35_000, 85_000)]
    read = [engine.image(estimate) for estimate in estimates]
    log = [np.log(image.intensity[0, 1] + offset) for image in read]
    np.testing.assert_allclose(np.diff(log), [2 * THRESHOLD, 0.0], atol=1e-4)
    assert log[0] == pytest.approx(np.log(100 / 255 + offset), abs=2e-2)
    if settings.filter.kind == "akf":
        variances = [estimate.variance[0, 1] for estimate in estimates]
        assert variances[0] >= settings.filter.initial_variance * 0.999
        assert variances == sorted(variances)
        assert estimates[-1].variance[0, 0] < 0.5 * variances[-1]


def test_unseen_pixels_start_with_the_variance_of_the_others():
    image = np.array([[1, 250, 100]], np.uint8)
    frames = [Frame(image, t, t + 10_000, valid=np.array([[True, True, False]])) for t in (0, 40_000)]
    engine = Reconstructor((1, 3), contrast_threshold=THRESHOLD)
    for frame in frames:
        engine.push_frame(frame)
    engine.finish()
    logs = np.log(image[0, :2] / 255 + engine.settings.camera.offset)
    assert engine.estimate(20_000).variance[0, 2] == pytest.approx(np.var(logs), rel=1e-5)
    assert np.var(logs) > 1.5  # more than initial_variance


def test_a_masked_pixel_is_no_bound():
    frame = Latent(np.zeros((1, 3)), np.array([[0.1, UNMEASURED, MASKED]]))
    level = np.full((1, 3), -1.0)
    raise_to_bound(level, frame)
    np.testing.assert_array_equal(level, [[-1.0, 0.0, -1.0]])
    clipped = Latent(np.zeros((1, 3)), np.full((1, 3), UNMEASURED))
    thresholds, noise = nominal_thresholds((1, 3), 0.1), BridgeNoise(0.5, 0.5, 0.05, 0.04)
    joined, _ = bridge(clipped, frame, (np.ones((1, 3)), np.zeros((1, 3))), thresholds, noise, 0, 40_000)
    np.testing.assert_allclose(joined.floor, [[-np.inf, -0.5, -np.inf]], atol=1e-6)


# --- black ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lookahead", [True, False])
def test_black_is_a_bound_where_the_response_hides_something(lookahead):
    """On events alone take a pixel up without end; black frames say that it is no brighter than half a level."""
    response = "s-curve:0.1"
    settings = dataclasses.replace(
        PRESETS["default"],
        camera=dataclasses.replace(PRESETS["default"].camera, response=response, log_offset=0.01),
        events=dataclasses.replace(PRESETS["default"].events, threshold_on=0.3, threshold_off=0.3, trail=0.0),
    )
    engine = Reconstructor((1, 1), settings=settings, lookahead=lookahead)
    frames = [Frame(np.zeros((1, 1), np.uint8), t, t + 1000) for t in range(0, 400_000, 40_000)]
    for frame in frames:
        engine.push_frame(frame)
    t = np.arange(2000, 361_000, 4000)
    zeros = np.zeros(len(t), np.int64)
    engine.push_events(make_events(t, zeros, zeros, zeros + 1))
    engine.finish()
    most = float(Response.named(response).inverse(np.array(0.5 / 255)))
    at = frames[-1].middle if lookahead else frames[-1].exposure_end
    assert 0.1 < most < 0.13
    assert engine.read(at).intensity[0, 0] <= most + 1e-5


def test_all_black_frames_together_say_no_more_than_one():
    """P of a pixel that stays black ends at the spread of what black hides, however many frames say it."""
    settings = altered(PRESETS["default"], "camera", response="s-curve:0.1", log_offset=0.01)
    engine = Reconstructor((1, 1), settings=settings, contrast_threshold=THRESHOLD)
    times = range(0, 4_000_000, 40_000)
    for t in times:
        engine.push_frame(Frame(np.zeros((1, 1), np.uint8), t, t + 1000))
    engine.finish()
    most = float(Response.named("s-curve:0.1").inverse(np.array(0.5 / 255)))
    shares = (np.arange(10_000) + 0.5) / 10_000  # nothing but black: the widest distribution there is
    spread = np.mean(np.log((most * shares**2 + 0.01) / (most * np.exp(-2) + 0.01)) ** 2)
    assert engine.estimate(times[-1] + 500).variance[0, 0] == pytest.approx(spread, rel=2e-2)


def test_a_pixel_that_frames_cease_to_measure_may_have_changed_unseen():
    """P grows by half of what is hidden at both ends of a frame interval, once."""
    settings = altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2)
    engine = Reconstructor((1, 1), settings=settings)
    frames = [
        Frame(np.full((1, 1), v, np.uint8), 40_000 * k, 40_000 * k + 10_000)
        for k, v in enumerate((100, 100, 255, 255, 255))
    ]
    for frame in frames:
        engine.push_frame(frame)
    engine.finish()
    before, clipped, after = (float(engine.estimate(frames[k].middle).variance[0, 0]) for k in (1, 2, 4))
    assert clipped == pytest.approx(before + 0.04 / 12, rel=0.01, abs=before)
    assert clipped > 3 * before
    assert after == pytest.approx(clipped, rel=1e-3)


@MODES
def test_a_bound_that_a_frame_sets_anew_has_no_noise_of_events_before(lookahead):
    """Five events up and, a frame later, five down again: the clipped frame after says white, which needs no events."""
    spread = altered(PRESETS["default"], "events", threshold_spread=0.1, noise_rate=0.0, trail=0.0)
    engine = Reconstructor((1, 1), settings=spread, lookahead=lookahead, contrast_threshold=THRESHOLD)
    frames = [Frame(np.full((1, 1), 255, np.uint8), t, t + 1000) for t in range(0, 240_000, 40_000)]
    for frame in frames:
        engine.push_frame(frame)
    ups, downs = (np.arange(first, first + 5_000, 1_000) for first in (50_000, 130_000))
    t, zeros = np.concatenate([ups, downs]), np.zeros(10, np.int64)
    engine.push_events(make_events(t, zeros, zeros, t < 100_000))
    engine.finish()
    found = [engine.estimate(frame.exposure_end + 10_000) for frame in frames]
    noise = [float(estimate.unshown.noise[0]) for estimate in found]
    assert noise[2] > 5 * 0.07 * THRESHOLD**2  # of the events alone
    np.testing.assert_allclose([noise[k] for k in (0, 4, 5)], 0.0, atol=1e-6)
    assert found[2].log_intensity[0, 0] == pytest.approx(found[0].log_intensity[0, 0] + 1.0, abs=0.02)
    assert found[4].log_intensity[0, 0] == pytest.approx(found[0].log_intensity[0, 0], abs=2e-3)


def test_black_of_a_linear_response_is_a_measurement():
    """It hides less than the frame's noise."""
    shot = take_shot(Frame(np.array([[0, 9]], np.uint8), 0, 1000), Camera.named("linear", 0.98), 1000)
    method = make_method(
        altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2), True, (1, 2)
    )
    assert method.crushed(shot) is None
    assert method.latent(shot, [], method._prior).ceiling is None
