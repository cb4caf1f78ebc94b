"""The fixed pattern of sensors where it is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from kalux import EVENT_DTYPE, Frame, Recording
from kalux.calibration.fixed_pattern import FixedPattern, estimate_fixed_pattern, largest_pattern
from kalux.models.camera import Response
from kalux.settings import CameraSettings

CAMERA = CameraSettings(frame_noise=0.003)
SIZE = (120, 160)
NOTHING = np.empty(0, EVENT_DTYPE)


def scene(rows, columns):
    """Broad light and dark with texture, 0.03 to 0.7."""
    rng = np.random.default_rng(3)
    broad, fine = (cv2.GaussianBlur(rng.standard_normal((rows, columns)), (0, 0), s) for s in (12, 2))
    level = broad / broad.std() + 0.1 * fine / fine.std()
    return (0.15 * np.exp(0.7 * level)).clip(0.03, 0.7)


def recorded(offset, *, step=(3, 7), frames=20, noise=0.003, image=None, **fields):
    """A pan over the scene by ``step`` pixels a frame; ``offset`` (H, W) is the sensor's own."""
    rng = np.random.default_rng(4)
    (down, right), (height, width) = step, SIZE
    whole = scene(height + 20 * abs(down), width + 20 * abs(right)) if image is None else image
    made = []
    for k in range(frames):
        seen = whole[k * down : k * down + height, k * right : k * right + width] + offset
        values = np.rint(255 * (seen + noise * rng.standard_normal(SIZE)).clip(0, 1)).astype(np.uint8)
        made.append(Frame(values, 40_000 * k, 40_000 * k + 10_000, **fields))
    return Recording.from_arrays(NOTHING, made, sensor_size=SIZE)


def pattern(deviation):
    return deviation * np.random.default_rng(5).standard_normal(SIZE)


@pytest.mark.parametrize("deviation", [0.004, 0.01])
def test_offsets_that_stay_while_the_scene_moves_are_found(deviation):
    found = estimate_fixed_pattern(recorded(pattern(deviation)), CAMERA)
    assert found.deviation == pytest.approx(deviation, rel=0.1)
    assert found.variance == pytest.approx(found.deviation**2)
    assert found.variance > 6 * found.error


def test_texture_and_noise_that_move_are_none():
    found = estimate_fixed_pattern(recorded(0.0, noise=0.01), CAMERA)
    assert found.deviation == 0
    assert found.is_measured


def test_less_than_chance_makes_is_no_answer_where_the_usual_would_be_as_little():
    assert FixedPattern(0.0, 0.001**2, 0.0018**2).is_measured
    assert not FixedPattern(0.0, 0.0047**2, 0.0019**2).is_measured


def test_what_stands_still_may_be_the_scene():
    """Its texture is the same in all frames, as a pattern is: nothing is said."""
    found = estimate_fixed_pattern(recorded(pattern(0.01), step=(0, 0)), CAMERA)
    assert found.deviation == 0
    assert not found.is_measured


@pytest.mark.parametrize("name", ["linear", "srgb"])
@pytest.mark.parametrize("deviation", [0.0, 0.002, 0.006])
def test_smooth_parts_of_a_still_scene_say_what_the_pattern_is_at_most(name, deviation):
    """As stored, whatever the response; of no pattern it is no less than rounding, which may hide one."""
    smooth = cv2.GaussianBlur(scene(300, 300), (0, 0), 4)
    stored = Response.named(name)(smooth)
    still = recorded(pattern(deviation), step=(0, 0), image=stored)
    most = largest_pattern(still, CameraSettings(response=name))
    rounding = 1 / 255 / np.sqrt(12)
    left = np.sqrt((0.003**2 + rounding**2) / 20)
    assert most == pytest.approx(max(np.hypot(deviation, left), rounding), rel=0.15)


def test_a_texture_bounds_the_pattern_by_less_than_itself_or_not_at_all():
    assert largest_pattern(recorded(pattern(0.003), step=(0, 0)), CAMERA) > 0.9 * 0.003
    few = Recording.from_arrays(
        NOTHING, [Frame(np.full((30, 40), 90, np.uint8), 0, 10_000)], sensor_size=(30, 40)
    )
    assert largest_pattern(few, CAMERA) == np.inf


def test_rounding_may_hide_a_pattern():
    flat = [Frame(np.full(SIZE, 90, np.uint8), 40_000 * k, 40_000 * k + 10_000) for k in range(3)]
    found = largest_pattern(Recording.from_arrays(NOTHING, flat, sensor_size=SIZE), CAMERA)
    assert found == pytest.approx(1 / 255 / np.sqrt(12))


def test_smooth_parts_of_a_mosaic_are_those_of_one_colour_and_none_that_clip():
    colours = np.tile([[0.2, 0.4], [0.3, 0.6]], (60, 80))
    offset = pattern(0.003)
    masked = np.arange(SIZE[1]) >= 20
    frames = []
    for k in range(10):
        values = np.rint(255 * (colours + offset)).astype(np.uint8)
        values[100:] = (255 * np.random.default_rng(k).random((20, 160))).astype(np.uint8)
        values[::7, 150:] = 255
        frames.append(Frame(values, 40_000 * k, 40_000 * k + 10_000, mosaic="RGGB"))
    found = largest_pattern(Recording.from_arrays(NOTHING, frames, sensor_size=SIZE), CAMERA)
    assert found == pytest.approx(np.hypot(0.003, 1 / 255 / np.sqrt(12)), rel=0.15)
    spoilt = [
        Frame(
            np.where(masked, f.image, np.random.default_rng(9).integers(20, 200, SIZE)).astype(np.uint8),
            f.exposure_start,
            f.exposure_end,
            mosaic="RGGB",
            valid=np.broadcast_to(masked, SIZE),
        )
        for f in frames
    ]
    with_mask = largest_pattern(Recording.from_arrays(NOTHING, spoilt, sensor_size=SIZE), CAMERA)
    assert with_mask == pytest.approx(found, rel=0.1)


def test_clipped_and_masked_pixels_do_not_count():
    """White stays, whatever the offset; of masked pixels anything may stand in the frame."""
    valid = np.arange(SIZE[1]) >= 40
    spoilt = pattern(0.005) + np.where(valid, 0, 0.2 * np.random.default_rng(6).standard_normal(SIZE))
    found = estimate_fixed_pattern(recorded(spoilt, valid=np.broadcast_to(valid, SIZE)), CAMERA)
    assert found.deviation == pytest.approx(0.005, rel=0.1)
    bright = estimate_fixed_pattern(recorded(pattern(0.005), image=3 * scene(180, 300)), CAMERA)
    assert bright.deviation == pytest.approx(0.005, rel=0.1)


def test_colours_of_a_mosaic_are_no_pattern():
    """Neighbours of the same colour are asked: green ones see twice the light."""
    filters = np.tile([[1.0, 2.0], [2.0, 1.0]], (90, 150))[:180, :300]
    rng = np.random.default_rng(4)
    whole, offset = 0.4 * scene(180, 300), pattern(0.004)
    frames = []
    for k in range(20):
        light = whole[3 * k : 3 * k + 120, 7 * k : 7 * k + 160] * filters[:120, :160] + offset
        values = np.rint(255 * (light + 0.003 * rng.standard_normal(SIZE)).clip(0, 1)).astype(np.uint8)
        frames.append(Frame(values, 40_000 * k, 40_000 * k + 10_000, mosaic="RGGB"))
    found = estimate_fixed_pattern(Recording.from_arrays(NOTHING, frames, sensor_size=SIZE), CAMERA)
    assert found.deviation == pytest.approx(0.004, rel=0.1)


@pytest.mark.parametrize("name", ["srgb", "gamma:2.2"])
def test_behind_a_curve_offsets_are_those_of_stored_values(name):
    """Dark or bright, as much of what is stored; in light a tenth as much in the dark."""
    response = Response.named(name)
    stored = response(scene(180, 300))
    camera = CameraSettings(response=name, frame_noise=0.003)
    found = estimate_fixed_pattern(recorded(pattern(0.005), image=stored), camera)
    assert found.deviation == pytest.approx(0.005, rel=0.1)
    none = estimate_fixed_pattern(recorded(0.0, image=stored, noise=0.01), camera)
    assert none.deviation == 0
    assert none.is_measured


def test_colours_have_been_demosaiced():
    source = recorded(pattern(0.01))
    rgb = [
        Frame(np.repeat(f.image[..., None], 3, 2), f.exposure_start, f.exposure_end) for f in source.frames()
    ]
    assert estimate_fixed_pattern(Recording.from_arrays(NOTHING, rgb, sensor_size=SIZE), CAMERA) is None
    three = CameraSettings(response="linear;gamma:2;linear")
    assert estimate_fixed_pattern(source, three) is None


@pytest.mark.parametrize("name", ["linear", "srgb"])
def test_edges_that_a_camera_shakes_over_the_same_pixels_are_none(name):
    """Where dark and bright meet softly a pixel is on the dark side of the edge again and again, nearer and farther."""
    rows = np.arange(400)[:, None]
    edges = 0.03 + 0.4 * cv2.GaussianBlur(
        (rows // 40 % 2 * np.ones((1, 300))).astype(np.float64), (0, 0), 2.5
    )
    made, rng = [], np.random.default_rng(4)
    stored = Response.named(name)(edges)
    for k in range(40):
        down = 100 + (0, 1, 2, 3, 2, 1)[k % 6]
        seen = stored[down : down + SIZE[0], :160] + 0.003 * rng.standard_normal(SIZE)
        values = np.rint(255 * seen).astype(np.uint8)
        made.append(Frame(values, 40_000 * k, 40_000 * k + 10_000))
    recording = Recording.from_arrays(NOTHING, made, sensor_size=SIZE)
    found = estimate_fixed_pattern(recording, CameraSettings(response=name, frame_noise=0.001))
    assert found.variance > 6 * found.error
    assert found.deviation == 0
