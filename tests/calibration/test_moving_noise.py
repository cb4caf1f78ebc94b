"""Noise of frames is told where everything in them moves, textured all over or not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux import EVENT_DTYPE, Frame, Recording
from kalux.calibration import moving_noise
from kalux.calibration.frame_noise import noise_at, usual_noise
from kalux.calibration.moving_noise import MovingNoise, estimate_moving_noise, told_by_motion
from kalux.calibration.noise import calibrate_noise
from kalux.models.camera import Response
from kalux.planning import plan
from kalux.settings import PRESETS, CameraSettings, altered

from builders import busy

CAMERA = CameraSettings()
NOTHING = np.empty(0, EVENT_DTYPE)
LEVEL = 1 / 255 / np.sqrt(12)
SIZE = (120, 160)


def scene(contrast, seed=3):
    """(300, 400) light from 0.05 to 0.8 with a texture, as fine as pixels are, all over."""
    rng = np.random.default_rng(seed)
    height, width = 300, 400
    fine = cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), 1.2)
    coarse = cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), 12.0)
    log = contrast * fine / fine.std() + 0.8 * coarse / coarse.std()
    return (0.22 * np.exp(log)).clip(0.04, 0.85)


def seen_by_frames(frames):
    return Recording.from_arrays(NOTHING, frames, sensor_size=frames[0].image.shape[:2])


def filmed(
    contrast, read, shot, *, pattern=0.0, step=(2.37, 0.71), response=lambda i: i, frames=12, size=SIZE
):
    """A recording of 8 bits that pans by ``step`` pixels from frame to frame, and has no event."""
    rng = np.random.default_rng(1)
    light = scene(contrast)
    offsets = pattern * rng.standard_normal(size)
    made = []
    for k in range(frames):
        where = np.float32([[1, 0, 10 + step[0] * k], [0, 1, 10 + step[1] * k]])
        seen = cv2.warpAffine(light, where, size[::-1], flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
        noise = np.sqrt(shot * seen) * rng.standard_normal(size)
        stored = response((seen + noise).clip(0, 1)) + read * rng.standard_normal(size) + offsets
        made.append(Frame(np.rint(255 * stored.clip(0, 1)).astype(np.uint8), 40_000 * k, 40_000 * k + 10_000))
    return seen_by_frames(made)


@pytest.mark.parametrize("contrast", [0.0, 0.05, 0.1])
@pytest.mark.parametrize(("read", "shot"), [(0.01, 0.0), (0.002, 1 / 5000), (0.004, 1 / 20_000)])
def test_read_and_shot_noise_of_what_pans(contrast, read, shot):
    """Whether the scene is smooth, or its texture is as strong as noise, or several times that."""
    found = estimate_moving_noise(filmed(contrast, read, shot), CAMERA)
    assert found.is_certain
    for level in (0.1, 0.3, 0.6):
        true = np.sqrt(read**2 + LEVEL**2 + shot * level)
        told = np.sqrt(found.read**2 + found.shot * level)
        assert told == pytest.approx(true, rel=0.25 if contrast > 0.05 else 0.1)


def test_what_stands_still_tells_the_same():
    still = estimate_moving_noise(filmed(0.15, 0.005, 0.0, step=(0.0, 0.0)), CAMERA)
    assert still.read == pytest.approx(np.hypot(0.005, LEVEL), rel=0.1)


def test_it_is_not_the_texture_that_smooth_parts_would_take_for_it():
    """Where no part is smooth, what they say is bounded by the usual noise, more or less than there is."""
    recording = filmed(0.15, 0.012, 0.0)
    assert usual_noise(recording, CAMERA).read < 0.75 * 0.012
    assert estimate_moving_noise(recording, CAMERA).read == pytest.approx(0.012, rel=0.1)


def test_a_fixed_pattern_counts_since_it_does_not_move():
    found = estimate_moving_noise(filmed(0.05, 0.004, 0.0, pattern=0.006), CAMERA)
    assert found.read == pytest.approx(np.sqrt(0.004**2 + 0.006**2 + LEVEL**2), rel=0.15)


def test_behind_a_response_that_bends_noise_is_the_same_of_all_stored_values():
    response = Response.named("gamma:2.2")
    camera = CameraSettings(response="gamma:2.2")
    found = estimate_moving_noise(filmed(0.05, 0.006, 0.0, response=response), camera)
    for level in (0.1, 0.3, 0.6):
        true = np.hypot(0.006, LEVEL) * float(response.slope(np.array([level]), 0.005)[0])
        assert np.sqrt(found.read**2 + found.shot * level) == pytest.approx(true, rel=0.2)


def test_no_less_than_the_rounding():
    """Frames without noise: half a level, which the rounding is at most, over the square root of three."""
    found = estimate_moving_noise(filmed(0.0, 0.0, 0.0), CAMERA)
    assert found.read >= 0.99 * LEVEL


def test_nothing_is_told_of_few_parts_or_colours():
    assert estimate_moving_noise(filmed(0.05, 0.004, 0.0, size=(30, 160)), CAMERA) is None
    assert estimate_moving_noise(filmed(0.05, 0.004, 0.0, frames=1), CAMERA) is None
    assert estimate_moving_noise(filmed(0.05, 0.004, 0.0, frames=2, size=(60, 80)), CAMERA) is None
    grey = [*filmed(0.05, 0.004, 0.0).frames()]
    rgb = [
        Frame(np.repeat(frame.image[..., None], 3, axis=2), frame.exposure_start, frame.exposure_end)
        for frame in grey
    ]
    assert estimate_moving_noise(seen_by_frames(rgb), CAMERA) is None


def test_parts_that_are_hidden_in_one_of_the_frames_do_not_count():
    """A bar that passes, brighter than all else: the fit is that of the others."""
    clear = filmed(0.05, 0.006, 0.0)
    frames = []
    for k, frame in enumerate(clear.frames()):
        image = frame.image.copy()
        image[:, 10 * k : 10 * k + 12] = 230
        frames.append(Frame(image, frame.exposure_start, frame.exposure_end))
    found = estimate_moving_noise(seen_by_frames(frames), CAMERA)
    assert found.read == pytest.approx(np.hypot(0.006, LEVEL), rel=0.15)


@given(st.floats(0.0, 0.05), st.floats(0.0, 1e-3), st.floats(1.0, 2.0))
def test_noise_is_contradicted_by_far_less(read, shot, times):
    noise = MovingNoise(read + 1e-3, shot, 0.2, (0.05, 0.5))
    assert noise.contradicts(times * noise.read, times**2 * shot) == (times > 1.4) or times == pytest.approx(
        1.4
    )


def test_what_scatters_counts_only_against_more(monkeypatch):
    """What is left of a texture makes it too large, so that noise which seems to be far more is less."""

    def told(scatter, otherwise, *, is_seen):
        found = MovingNoise(0.002, 0.0, scatter, (0.05, 0.5))
        monkeypatch.setattr(moving_noise, "estimate_moving_noise", lambda *_: found)
        return told_by_motion(None, CAMERA, (otherwise, 0.0), is_seen=is_seen) is not None

    assert not told(0.6, 0.0025, is_seen=True)
    assert not told(0.6, 0.0025, is_seen=False)
    assert not told(0.6, 0.001, is_seen=False)
    assert told(0.6, 0.004, is_seen=True)
    assert told(0.6, 0.004, is_seen=False)
    assert told(0.2, 0.001, is_seen=False)
    assert not told(0.2, 0.001, is_seen=True)


def test_a_strong_texture_that_creeps_is_not_the_noise_of_frames():
    """All that is told of it scatters, and yet is nearer than what parts allow that change smoothly."""
    creeps = filmed(0.5, 0.001, 0.0, step=(0.25, 0.06), frames=24)
    assert not estimate_moving_noise(creeps, CAMERA).is_certain
    usual, true = usual_noise(creeps, CAMERA), np.hypot(0.001, LEVEL)
    told = told_by_motion(creeps, CAMERA, (usual.read, usual.shot), is_seen=False)
    assert noise_at(usual.read, usual.shot, 0.6) > 1.5 * true
    assert 0.75 * true < noise_at(told.read, told.shot, 0.6) < 1.25 * true


@given(st.floats(0.0, 0.999))
def test_interpolation_keeps_the_light_and_takes_some_of_the_noise(fraction):
    weights = moving_noise._weights(fraction)
    assert weights.sum() == pytest.approx(1.0)
    assert weights @ np.arange(-1, 3) == pytest.approx(
        fraction, abs=0.15
    )  # nearly: OpenCV's -0.75 is no -0.5
    left = float(moving_noise._noise_left(np.array([fraction], np.float32))[0])
    assert 0.05 < left <= 1.0 + 1e-6


def test_interpolation_is_that_of_opencv():
    rng = np.random.default_rng(0)
    plane = rng.standard_normal((40, 40)).astype(np.float32)
    rows, columns = np.indices(plane.shape, np.float32)
    seen = cv2.remap(plane, columns + np.float32(0.375), rows, cv2.INTER_CUBIC)
    made = np.stack([plane[20, k - 1 : k + 3] for k in range(5, 30)]) @ moving_noise._weights(0.375)
    np.testing.assert_allclose(seen[20, 5:30], made, atol=1e-5)


def test_calibrate_noise_takes_it_where_nothing_stands_still():
    moves = with_events(filmed(0.05, 0.012, 0.0, step=(5.3, 3.1)))
    found = calibrate_noise(moves, CAMERA)
    assert found.frames is None or not found.frames.is_reliable
    told = found.calibration()
    assert told.settings["camera"]["frame_noise"] == pytest.approx(0.012, rel=0.1)
    assert told.measured["noise_at_half"] == pytest.approx(0.012, rel=0.1)
    assert calibrate_noise(moves, CAMERA, is_compressed=True).moving is None


def with_events(recording):
    """Of every pixel in every interval, so that nothing stands still."""
    frames = [*recording.frames()]
    return Recording.from_arrays(busy(np.ones(SIZE), len(frames)), frames, sensor_size=SIZE)


def planned(recording, **camera):
    settings = altered(
        altered(PRESETS["default"], "camera", **camera), "events", threshold_on=0.2, threshold_off=0.2
    )
    return plan(recording, times=[100_000], settings=settings)


def test_a_plan_takes_it_where_nothing_stands_still_and_there_is_no_pattern():
    moves = filmed(0.15, 0.012, 0.0)
    told = planned(with_events(moves), fixed_pattern=0.0)
    assert isinstance(told.frame_noise, MovingNoise)
    assert told.settings.camera.frame_noise == pytest.approx(0.012, rel=0.1)
    assert not isinstance(planned(with_events(moves), fixed_pattern=0.005).frame_noise, MovingNoise)
    given = planned(with_events(moves), fixed_pattern=0.0, frame_noise=0.02)
    assert given.settings.camera.frame_noise == 0.02
    assert given.frame_noise is None
