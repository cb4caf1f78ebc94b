"""Where sensors saturate: cameras that clip below white, scenes that merely end below it, and piles of a histogram."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import kalux
from kalux import EVENT_DTYPE, Frame, Recording
from kalux.calibration.levels import clipping_levels, find_ceiling, frames_end
from kalux.settings import PRESETS

from builders import passing_by, sky, textured

SETTINGS = PRESETS["default"]
EVENTS = dataclasses.replace(SETTINGS.events, threshold_on=0.2, threshold_off=0.2)


@pytest.mark.parametrize("cut", [100, 235, 255])
@pytest.mark.parametrize("noise_rate", [0.0, 3.0])
def test_a_camera_that_clips_is_found(cut, noise_rate):
    found = find_ceiling(
        passing_by(textured(3 * cut / 255), cut, noise_rate=noise_rate), SETTINGS.camera, EVENTS
    )
    assert found is not None
    assert 255 * found.level == pytest.approx(cut, abs=0.5)
    assert 255 * found.least == pytest.approx(cut, abs=0.5)
    assert found.excess > 0.3


def in_light(recording, light):
    """In RGB frames whose channels are clipped as those of a sensor in coloured light."""
    frames = [
        dataclasses.replace(frame, image=np.rint(np.multiply.outer(frame.image, light)).astype(np.uint8))
        for frame in recording.frames()
    ]
    events = np.concatenate(list(recording.events()))
    return Recording.from_arrays(events, frames, sensor_size=recording.sensor_size)


@pytest.mark.parametrize("light", [(1, 1, 1), (1, 1, 0.4), (0.5, 1, 1)])
def test_a_camera_in_colour_that_clips_is_found(light):
    """By the channels that clip; a scene that merely ends there is none in colour, either."""
    clips, ends = (in_light(passing_by(picture, 235), light) for picture in (textured(2.8), sky(0.9)))
    found = find_ceiling(clips, SETTINGS.camera, EVENTS)
    assert found is not None
    assert 255 * found.level == pytest.approx(235, abs=0.5)
    assert find_ceiling(ends, SETTINGS.camera, EVENTS) is None


@pytest.mark.parametrize("picture", [sky(0.5), sky(0.9), textured(0.6)], ids=["sky", "bright sky", "texture"])
@pytest.mark.parametrize("wrong", [0.75, 1.0, 1.3])
def test_a_scene_that_ends_below_white_is_no_camera_that_clips(picture, wrong):
    """A third of the image is a sky at one level, and thresholds may be a quarter off."""
    events = dataclasses.replace(EVENTS, threshold_on=0.2 * wrong, threshold_off=0.2 * wrong)
    assert find_ceiling(passing_by(picture), SETTINGS.camera, events) is None


def recorded(*images, **options):
    frames = [Frame(image, 1000 * i, 1000 * i + 500, **options) for i, image in enumerate(images)]
    size = images[0].shape if images else (10, 10)
    return Recording.from_arrays(np.empty(0, EVENT_DTYPE), frames, sensor_size=size)


def with_frames(*levels, white=None):
    """(10, 10) frames of one level each."""
    return recorded(*(np.full((10, 10), level, np.uint8) for level in levels), white=white)


def level_of(recording):
    end = frames_end(recording)
    return None if end is None else end.level


def test_the_end_is_that_of_all_frames():
    assert level_of(with_frames(100, 200, 90)) == pytest.approx(200 / 255)
    assert level_of(with_frames(100, 200, 90, white=210)) == pytest.approx(200 / 210)
    assert level_of(with_frames(100, 255, 90)) == 1
    assert level_of(with_frames(0, 0)) is None
    assert level_of(with_frames()) is None


def test_glints_are_no_end():
    """Fewer than a thousandth of the pixels are as bright as the brightest."""
    dark = np.full((50, 50), 9, np.uint8)
    few, enough = dark.copy(), dark.copy()
    few.flat[:4], enough.flat[:5] = 99, 99
    assert level_of(recorded(dark, few)) is None
    assert level_of(recorded(dark, enough)) == pytest.approx(99 / 255)


def test_pixels_that_a_frame_does_not_see_end_nowhere():
    image = np.full((10, 10), 90, np.uint8)
    image[0] = 255
    assert level_of(recorded(image, valid=image < 255)) == pytest.approx(90 / 255)


def passing_white(white, ends=1.0, noise=0.0, seed=0):
    """(80, 80) frames of light up to twice white that moves by, clipped where each pixel ends; in levels."""
    rng = np.random.default_rng(seed)
    x = np.arange(80) / 80
    light = 2 * np.outer(0.2 + 0.8 * x, 0.2 + 0.8 * np.roll(x, 7 * seed))
    clipped = np.minimum(light, ends) + noise * rng.standard_normal(light.shape)
    return np.rint(white * np.clip(clipped, 0, 1)).astype(np.uint16)


@pytest.mark.parametrize("white", [255, 1023, 4095])
@pytest.mark.parametrize("end", [1.0, 0.94, 0.5])
def test_pixels_that_all_end_at_one_level_end_cleanly(white, end):
    """Also where that is below what frames can hold, or noise lies over the light before it is clipped."""
    frames = [np.minimum(passing_white(white, 9, 0.003, k), int(end * white)) for k in range(6)]
    found = frames_end(recorded(*frames, white=white))
    assert found is not None
    assert found.level == pytest.approx(int(end * white) / white)
    assert found.is_clean


@pytest.mark.parametrize(
    ("mean", "spread", "noise"), [(1, 0.01, 0), (1, 0.004, 0), (1.005, 0.01, 0), (1, 0, 0.004)]
)
def test_pixels_that_end_a_little_unevenly_do_not(mean, spread, noise):
    """Those that end below white are as clipped as those at it; noise that is added after clipping looks the same."""
    ends = mean + spread * np.random.default_rng(9).standard_normal((80, 80))
    found = frames_end(recorded(*(passing_white(255, ends, noise, k) for k in range(6)), white=255))
    assert found is not None
    assert found.level == 1
    assert not found.is_clean


def test_without_events_or_light_nothing_is_told():
    recording = passing_by(textured(3.0))
    silent = Recording.from_arrays(
        next(iter(recording.events()))[:0], list(recording.frames()), sensor_size=recording.sensor_size
    )
    black = [dataclasses.replace(frame, image=0 * frame.image) for frame in recording.frames()]
    dark = Recording.from_arrays(
        np.concatenate(list(recording.events())), black, sensor_size=recording.sensor_size
    )
    assert find_ceiling(silent, SETTINGS.camera, EVENTS) is None
    assert find_ceiling(dark, SETTINGS.camera, EVENTS) is None


def test_slider_depth_ends_at_110_to_124(shared_data):
    """Unevenly, far below full scale: the pile of its histogram (docs/datasets.md)."""
    recording = kalux.open(shared_data / "slider_depth", exposure=10_000)
    events = dataclasses.replace(EVENTS, threshold_on=0.7, threshold_off=0.44, delay=1_600)
    found = find_ceiling(recording, SETTINGS.camera, events)
    assert found is not None
    assert 114 <= 255 * found.level <= 120
    assert 107 <= 255 * found.least <= 114


def with_levels(values):
    frames = [Frame(values.astype(np.uint8).reshape(100, 200), 0, 5_000)]
    return Recording.from_arrays(np.empty(0, EVENT_DTYPE), frames, sensor_size=(100, 200))


def test_piles_at_both_ends_are_clipping():
    rng = np.random.default_rng(2)
    values = rng.integers(0, 256, 20_000)
    values[:2000] = rng.integers(250, 254, 2000)  # fixed pattern noise spreads the top
    values[values > 253] = 100
    values[2000:5000] = 0
    found = clipping_levels(with_levels(values), 400)
    assert found.saturation == pytest.approx(249.5 / 255)
    assert found.black == pytest.approx(0.5 / 255)


def test_a_bright_wall_in_a_dark_picture_is_not_clipping():
    rng = np.random.default_rng(2)
    values = rng.integers(20, 90, 20_000)
    values[:5000] = 100
    assert clipping_levels(with_levels(values), 400) == (None, None)
