"""How often frames show light that their noise hides (docs/equations.md, K3)."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kalux import Frame, Recording
from kalux.calibration.dark_shares import estimate_dark_shares
from kalux.events import EVENT_DTYPE
from kalux.models.dark_levels import LIGHT_EDGES
from kalux.settings import CameraSettings

NOISE = 0.01
GAP = 1 / 255
CAMERA = CameraSettings(frame_noise=float(np.hypot(NOISE, GAP / 12**0.5)))


def frames_of(light, count=20, levels=255, dtype=np.uint8, seed=0, **properties):
    """Frames of a still scene, (H, W) with white = 1, with the noise of the camera."""
    rng = np.random.default_rng(seed)
    read = (np.clip(light + rng.normal(0, NOISE, light.shape), 0, 1) * levels for _ in range(count))
    read = (np.rint(image) if np.issubdtype(dtype, np.integer) else image for image in read)
    return [
        Frame(image.astype(dtype), t, t + 4000, white=levels, **properties)
        for t, image in zip(range(0, 40_000 * count, 40_000), read, strict=True)
    ]


def shares_of(frames, camera=CAMERA):
    size = frames[0].image.shape[:2]
    recording = Recording.from_arrays(np.empty(0, EVENT_DTYPE), frames, sensor_size=size)
    return estimate_dark_shares(recording, camera)


def half_black(other=0.06):
    light = np.zeros((60, 80))
    light[:, 40:] = other
    return light


def between(shares, low, high):
    """The share of light from ``low`` to ``high`` deviations of the noise, both of them edges of parts."""
    return sum(shares[LIGHT_EDGES.index(low) : LIGHT_EDGES.index(high)])


@pytest.mark.parametrize(
    ("levels", "dtype"), [(255, np.uint8), (4095, np.uint16), (65535, np.uint16), (1.0, np.float32)]
)
def test_half_of_a_scene_is_black(levels, dtype):
    camera = CAMERA if levels == 255 else CameraSettings(frame_noise=NOISE)
    shares = shares_of(frames_of(half_black(), levels=levels, dtype=dtype), camera)
    assert sum(shares) == pytest.approx(1.0)
    assert between(shares, 0.0, 0.375) == pytest.approx(0.5, abs=0.06)
    assert between(shares, 4.0, 10.0) == pytest.approx(0.5, abs=0.06)
    assert between(shares, 1.25, 2.5) < 0.05


def test_light_of_a_deviation_is_not_black():
    shares = shares_of(frames_of(half_black(0.06) + 0.01))
    assert between(shares, 0.375, 1.75) > 0.4
    assert between(shares, 0.0, 0.375) < 0.1


def test_bright_pixels_do_not_count():
    black = shares_of(frames_of(half_black()))
    light = half_black()
    light[:, 60:] = 0.5
    mixed = shares_of(frames_of(light))
    ratios = (between(one, 0.0, 0.375) / between(one, 4.0, 10.0) for one in (black, mixed))
    assert next(ratios) == pytest.approx(next(ratios) / 2, rel=0.2)


def test_all_colours_of_a_mosaic_count():
    """On a sensor so large that only some of its pixels are looked at: those of one colour are black."""
    light = np.full((260, 346), 0.06)
    light[::2, ::2] = 0.0
    shares = shares_of(frames_of(light, count=4))
    assert between(shares, 0.0, 0.375) == pytest.approx(0.25, abs=0.05)
    large = np.tile(light, (2, 2))
    assert between(shares_of(frames_of(large, count=4)), 0.0, 0.375) == pytest.approx(0.25, abs=0.05)


def test_pixels_that_say_nothing_do_not_count():
    """Of a frame that is put together from others, say."""
    valid = half_black() > 0
    shares = shares_of(frames_of(half_black(), valid=valid))
    assert between(shares, 0.0, 0.375) < 0.05
    assert between(shares, 4.0, 10.0) > 0.9


@pytest.mark.parametrize(
    "camera",
    [
        CameraSettings(),
        CameraSettings(frame_noise=0.3 * GAP),
        CameraSettings(frame_noise=NOISE, response="gamma:2.2"),
    ],
    ids=["noise not known", "levels only", "bends"],
)
def test_nothing_is_said_where_dark_means_are_not_corrected(camera):
    assert shares_of(frames_of(half_black()), camera) is None


def test_nothing_is_said_of_colours_and_of_scenes_without_dark_pixels():
    colours = [
        Frame(np.repeat(frame.image[..., None], 3, axis=2), frame.exposure_start, frame.exposure_end)
        for frame in frames_of(half_black())
    ]
    assert shares_of(colours) is None
    assert shares_of(frames_of(half_black() + 0.5)) is None


def test_what_a_sensor_has_in_all_frames_is_not_light():
    """Offsets of pixels twice as large as the noise, which spread the light: some of it seems black, and none is."""
    pattern = np.random.default_rng(1).normal(0, 2 * NOISE, (60, 80))
    frames = frames_of(np.full((60, 80), 2 * NOISE) + pattern)
    unknown, known = (
        shares_of(frames, dataclasses.replace(CAMERA, fixed_pattern=one)) for one in (0.0, 2 * NOISE)
    )
    assert between(unknown, 0.0, 0.375) > 0.15
    assert between(known, 0.0, 0.375) < 0.06
