"""Registration: known homographies and radiance of simulated recordings, frames that cannot be registered."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

import kalux
from kalux.datasets import SensorSettings, combine, handheld, pan, photograph_scene, simulate, spin
from kalux.datasets.registration import register_frames
from kalux.datasets.scenes import camera_matrix
from kalux.datasets.warping import (
    displacement,
    transformed,
    warped_mask,
)
from kalux.errors import InputError

from builders import blocks, lifted

SIZE = (100, 130)
SCALE = 1.15  # below what is smoothed for the pixels' size, so that the truth is sampled as the scene is
BLUR = 0.5
MOTION = combine(pan(60.0, 20.0), handheld(3), spin(0.1))


@pytest.fixture(scope="module")
def photograph():
    fine = blocks(0.02, 6.0, shape=(260, 340), count=900)
    return cv2.GaussianBlur(fine, (0, 0), 0.8).astype(np.float32)


@pytest.fixture(scope="module")
def simulation(photograph):
    """Frames with noise and blur; hardly any events, which take the time."""
    scene = photograph_scene(photograph, MOTION, sensor_size=SIZE, duration=700_000, scale=SCALE, blur=BLUR)
    sensor = SensorSettings(
        threshold_on=9, threshold_off=9, frame_rate=10.0, exposure=8_000, read_noise=0.005, full_well=20_000
    )
    return simulate(scene, sensor)


@pytest.fixture(scope="module")
def registered(simulation, photograph):
    unit = 7.3  # of the reference, which is not the frames'
    everywhere = np.ones(photograph.shape, bool)
    return register_frames(unit * photograph, everywhere, simulation.recording(), blur=BLUR), unit


def true_matrix(photograph, t):
    centre = ((photograph.shape[1] - 1) / 2, (photograph.shape[0] - 1) / 2)
    return np.vstack([camera_matrix(MOTION(t), SIZE, SCALE, centre), [0, 0, 1]])


def test_frames_are_placed_to_a_tenth_of_a_pixel(registered, photograph):
    found, _ = registered
    assert [frame.failure for frame in found.frames] == [""] * 7
    for frame in found.frames:
        apart = displacement(frame.matrix, true_matrix(photograph, frame.time), SIZE) / SCALE
        assert apart < 0.5, frame  # at the worst corner
        middle = np.array([[SIZE[1] / 2, SIZE[0] / 2]])
        truth = transformed(true_matrix(photograph, frame.time), middle)
        assert np.abs(transformed(frame.matrix, middle) - truth).max() / SCALE < 0.1


def test_the_truth_is_the_scene(registered, simulation):
    found, unit = registered
    assert found.scale * unit == pytest.approx(1.0, abs=0.01)
    truth = simulation.truth(found.truth.times).images
    assert found.truth.times.tolist() == [frame.middle for frame in simulation.frames]
    off = np.log((found.truth.images + 0.02) / (truth + 0.02))[found.masks]
    assert 1.4826 * np.median(np.abs(off)) < 0.03
    assert found.masks.mean() > 0.8
    assert (found.truth.images[~found.masks] == 0).all()
    assert found.truth.images.max() > 2.0


def test_what_is_not_valid_stays_so(simulation, photograph):
    valid = np.ones(photograph.shape, bool)
    valid[:, 150:160] = False
    changed = np.where(valid, photograph, 1e6)
    found = register_frames(changed, valid, simulation.recording())
    for frame, image, mask in zip(found.frames, found.truth.images, found.masks, strict=True):
        seen = warped_mask(valid, frame.matrix, SIZE)
        assert not mask[~seen].any()
        assert image.max() < 100


def test_frames_that_show_something_else_are_left_out_and_told(simulation, photograph):
    frames = list(simulation.frames)
    rng = np.random.default_rng(0)
    other = cv2.GaussianBlur(rng.integers(0, 256, SIZE).astype(np.uint8), (0, 0), 1.5)
    frames[2] = dataclasses.replace(frames[2], image=other)
    frames[4] = dataclasses.replace(frames[4], image=np.zeros(SIZE, np.uint8))
    frames[5] = dataclasses.replace(frames[5], image=(frames[5].image // 2).astype(np.uint8))
    recording = kalux.Recording.from_arrays(simulation.events, frames, sensor_size=SIZE)
    found = register_frames(photograph, np.ones(photograph.shape, bool), recording)
    failures = {frame.number: frame.failure for frame in found.frames if frame.failure}
    assert set(failures) == {2, 4, 5}
    assert "exposed well" in failures[4]
    assert "as bright" in failures[5]
    assert len(found.truth.times) == len(found.masks) == 4


def test_frames_of_which_none_is_as_bright_as_the_others_are_an_error(simulation, photograph):
    """Of two, one half as bright: neither is near their median."""
    frames = list(simulation.frames[:2])
    frames[1] = dataclasses.replace(frames[1], image=(frames[1].image // 2).astype(np.uint8))
    recording = kalux.Recording.from_arrays(simulation.events, frames, sensor_size=SIZE)
    with pytest.raises(InputError, match=r"any of 2 frames \(0.6. times as bright as the other frames; 1.3"):
        register_frames(photograph, np.ones(photograph.shape, bool), recording)


def test_a_black_level_that_events_tell_is_taken_off():
    """It would be taken for light: the scale would come out several times as large."""
    picture = cv2.GaussianBlur(blocks(0.003, 2.0, shape=(220, 300), count=900), (0, 0), 0.8).astype(
        np.float32
    )
    scene = photograph_scene(picture, pan(60.0), sensor_size=SIZE, duration=700_000, scale=SCALE)
    made = simulate(scene, SensorSettings(frame_rate=12.0)).recording()
    everywhere = np.ones(picture.shape, bool)
    assert register_frames(picture, everywhere, lifted(made, 20)).scale == pytest.approx(1.0, rel=0.05)


def test_frames_in_rgb_are_registered_by_their_luminance(simulation, photograph):
    """And only where they measure anything: a quarter of each is a guess here."""
    valid = np.ones(SIZE, bool)
    valid[:, : SIZE[1] // 4] = False
    frames = [
        dataclasses.replace(f, image=np.stack([np.where(valid, f.image, 200)] * 3, axis=-1), valid=valid)
        for f in simulation.frames
    ]
    recording = kalux.Recording.from_arrays(simulation.events, frames, sensor_size=SIZE)
    everywhere = np.ones(photograph.shape, bool)
    found = register_frames(photograph, everywhere, recording)
    grey = register_frames(photograph, everywhere, simulation.recording())
    for one, other in zip(found.frames, grey.frames, strict=True):
        assert not one.failure
        assert displacement(one.matrix, other.matrix, SIZE) < 0.5


def test_another_scene_is_an_error(simulation):
    other = blocks(0.02, 6.0, shape=(260, 340), seed=5)
    with pytest.raises(InputError, match="cannot be registered to any of 7 frames"):
        register_frames(other, np.ones(other.shape, bool), simulation.recording())
