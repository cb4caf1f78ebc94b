"""Where sensors saturate: cameras that clip below white, scenes that merely end below it, and piles of a histogram."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import kalux
from kalux import EVENT_DTYPE, Frame, Recording
from kalux.calibration.levels import clipping_levels, find_ceiling
from kalux.datasets import SensorSettings, pan, photograph_scene, simulate
from kalux.settings import PRESETS

SETTINGS = PRESETS["default"]
EVENTS = dataclasses.replace(SETTINGS.events, threshold_on=0.2, threshold_off=0.2)


def sky(brightest: float) -> np.ndarray:
    """Dark and bright surfaces with texture, a third of it a sky without any, at ``brightest``."""
    rng = np.random.default_rng(2)
    blocks = np.kron(np.exp(rng.uniform(np.log(0.05), np.log(1.0), (16, 24))), np.ones((5, 5)))
    blocks[blocks > np.quantile(blocks, 0.67)] = 1.0
    return brightest * blocks


def recorded(picture: np.ndarray, cut: int = 255, **sensor) -> Recording:
    scene = photograph_scene(picture, pan(60.0), sensor_size=(48, 64), duration=500_000)
    made = simulate(
        scene, SensorSettings(threshold_on=0.2, threshold_off=0.2, exposure=2_000, **sensor), seed=1
    ).recording()
    frames = [dataclasses.replace(frame, image=np.minimum(frame.image, cut)) for frame in made.frames()]
    return Recording.from_arrays(
        np.concatenate(list(made.events())), frames, sensor_size=made.sensor_size, name="cut"
    )


def textured(brightest: float) -> np.ndarray:
    rng = np.random.default_rng(3)
    return brightest * np.kron(np.exp(rng.uniform(np.log(0.05), 0.0, (20, 30))), np.ones((4, 4)))


@pytest.mark.parametrize("cut", [100, 235, 255])
@pytest.mark.parametrize("noise_rate", [0.0, 3.0])
def test_a_camera_that_clips_is_found(cut, noise_rate):
    found = find_ceiling(
        recorded(textured(3 * cut / 255), cut, noise_rate=noise_rate), SETTINGS.camera, EVENTS
    )
    assert found is not None
    assert 255 * found.level == pytest.approx(cut, abs=0.5)
    assert 255 * found.least == pytest.approx(cut, abs=0.5)
    assert found.excess > 0.3


@pytest.mark.parametrize("picture", [sky(0.5), sky(0.9), textured(0.6)], ids=["sky", "bright sky", "texture"])
@pytest.mark.parametrize("wrong", [0.75, 1.0, 1.3])
def test_a_scene_that_ends_below_white_is_no_camera_that_clips(picture, wrong):
    """A third of the image is a sky at one level, and thresholds may be a quarter off."""
    events = dataclasses.replace(EVENTS, threshold_on=0.2 * wrong, threshold_off=0.2 * wrong)
    assert find_ceiling(recorded(picture), SETTINGS.camera, events) is None


def test_without_events_or_light_nothing_is_told():
    recording = recorded(textured(3.0))
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
