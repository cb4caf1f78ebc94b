"""Frames that were JPEG once are told by the zeros that it left, and by nothing else."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalux import Recording
from kalux.calibration.compression import OF_VIDEO, find_compression
from kalux.calibration.levels import LAST_LEVEL
from kalux.datasets import SensorSettings, simulate
from kalux.datasets.motion import pan
from kalux.datasets.scenes import photograph_scene
from kalux.frames import Frame
from kalux.plan_report import compression_text, plan_report
from kalux.planning import plan
from kalux.planning.levels import with_saturation
from kalux.settings import PRESETS, altered

from builders import pixel_events

SIZE = (120, 160)


def scene(seed=0, noise=2.0):
    """(H, W) levels of fine and coarse detail, a part of which is clipped."""
    rng = np.random.default_rng(seed)
    detail = [
        cv2.resize(rng.normal(0, 1, (n, n)), SIZE[::-1], interpolation=cv2.INTER_CUBIC) for n in (7, 23, 61)
    ]
    values = 110 + 60 * detail[0] + 30 * detail[1] + 15 * detail[2] + rng.normal(0, noise, SIZE)
    return np.clip(values, 0, 255).astype(np.uint8)


def compressed(image, quality):
    return cv2.imdecode(
        cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_UNCHANGED
    )


def recorded(images, **options):
    frames = [
        Frame(np.ascontiguousarray(image), 40_000 * i, 40_000 * i + 5_000) for i, image in enumerate(images)
    ]
    return Recording.from_arrays(pixel_events([], []), frames, sensor_size=images[0].shape[:2], **options)


@pytest.mark.parametrize("quality", [97, 90, 75, 50])
def test_jpeg_is_found_and_its_error_about_known(quality):
    images = [scene(seed) for seed in range(4)]
    made = [compressed(image, quality) for image in images]
    found = find_compression(recorded(made))
    assert found is not None
    assert found.zeros > found.elsewhere + 0.1
    off = np.std(np.subtract(made, images, dtype=np.float64)) / 255
    assert 0.4 * found.error < off < 1.2 * found.error


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1_000_000), st.floats(0, 8))
def test_frames_that_were_never_compressed_are_left(seed, noise):
    assert find_compression(recorded([scene(seed + i, noise) for i in range(4)])) is None


def test_frames_of_a_lossy_video_are_what_their_reader_says():
    raw = recorded([scene(seed) for seed in range(4)])
    video = Recording(dataclasses.replace(raw.source, of_lossy_video=True))
    found = find_compression(video)
    assert found is not None
    assert found.of_video
    assert found.error == OF_VIDEO
    jpeg = recorded([compressed(scene(seed), 90) for seed in range(4)])
    shown = find_compression(Recording(dataclasses.replace(jpeg.source, of_lossy_video=True)))
    assert shown is not None
    assert not shown.of_video
    assert "lossy video" in compression_text(found)
    assert "JPEG" in compression_text(shown)


def test_blocks_are_found_wherever_they_begin():
    """Of frames that were cut."""
    made = [compressed(scene(seed), 80)[5:101, 3:131] for seed in range(4)]
    assert find_compression(recorded(made)) is not None


def test_colour_is_looked_at_as_jpeg_does():
    images = [np.stack([scene(seed), scene(seed) // 2, scene(seed) // 3 + 40], axis=-1) for seed in range(4)]
    assert find_compression(recorded(images)) is None
    assert find_compression(recorded([compressed(image, 85) for image in images])) is not None


def test_what_shows_nothing_is_not_known():
    flat = np.full(SIZE, 100, np.uint8)
    assert find_compression(recorded([compressed(flat, 50)])) is None
    assert find_compression(recorded([compressed(scene(), 50).astype(np.uint16) * 257])) is None
    assert find_compression(recorded([compressed(scene(), 50)[:10, :10]])) is None


def test_pixels_count_as_clipped_from_a_lower_level():
    made = [compressed(scene(seed), 75) for seed in range(4)]
    usual = PRESETS["default"]
    levels = with_saturation(recorded(made), usual)
    assert levels.compression is not None
    expected = usual.camera.usual_saturation - 4 * levels.compression.error
    assert levels.settings.camera.saturation == pytest.approx(expected)
    raw = with_saturation(recorded([scene(seed) for seed in range(4)]), usual)
    assert raw.compression is None
    assert raw.settings.camera.saturation == LAST_LEVEL  # and not of frames that JPEG has compressed
    given = with_saturation(recorded(made), altered(usual, "camera", saturation=0.9))
    assert given.compression is None
    assert given.settings.camera.saturation == 0.9


def test_what_jpeg_leaves_clipped_pixels_at_is_clipped_then():
    """Pixels that were clipped in a frame lie below white in its JPEG, and above where pixels count as clipped."""
    images = [scene(seed, noise=0.0) for seed in range(4)]
    made = [compressed(image, 75) for image in images]
    level = with_saturation(recorded(made), PRESETS["default"]).settings.camera.clipped_from
    was = np.array(images) >= 250
    read = np.array(made) / 255
    missed, left = np.mean(read[was] < 0.98), np.mean(read[was] < level)
    assert missed > 0.05
    assert left < 0.15 * missed


def test_the_noise_of_frames_has_what_jpeg_adds():
    wide = cv2.resize(scene(noise=4.0), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC) / 255.0
    seen = photograph_scene(wide, pan(60.0), sensor_size=SIZE, duration=500_000)
    made = simulate(seen, SensorSettings(threshold_on=0.2, threshold_off=0.2, read_noise=0.002), seed=1)
    frames = [dataclasses.replace(frame, image=compressed(frame.image, 75)) for frame in made.frames]
    raw, jpeg = (
        Recording.from_arrays(made.events, each, sensor_size=SIZE, contrast_threshold=0.2)
        for each in (made.frames, frames)
    )
    before, after = plan(raw, rate_hz=50), plan(jpeg, rate_hz=50)
    assert before.mends.compression is None
    assert after.mends.compression is not None
    assert after.settings.camera.noise[0] > 0.6 * after.mends.compression.error
    assert before.settings.camera.noise[0] < 0.5 * after.settings.camera.noise[0]
    stated = altered(PRESETS["default"], "camera", frame_noise=0.004)
    assert plan(jpeg, rate_hz=50, settings=stated).settings.camera.frame_noise == 0.004
    assert ("compression" in dict(plan_report(jpeg, after, PRESETS["default"]))) != (
        "compression" in dict(plan_report(raw, before, PRESETS["default"]))
    )
