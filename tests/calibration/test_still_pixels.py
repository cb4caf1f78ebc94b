"""Pixels of recordings under auto-exposure that see no events are images at several exposures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from kalux import Frame, Recording
from kalux.calibration.response import calibrate_response
from kalux.calibration.still_pixels import still_pixels
from kalux.errors import InputError
from kalux.models.camera import Response

from builders import blocks, events


def picture():
    return cv2.GaussianBlur(blocks(0.5, 300.0, shape=(80, 96)), (0, 0), 1.0)


def test_still_pixels_of_a_recording_under_auto_exposure():
    """The left half sees events and is left out; exposures that hardly differ are taken once."""
    truth = Response.gamma(2.0)
    frames = []
    for k, t in enumerate([1_000, 3_000, 3_100, 10_000, 30_000, 100_000]):
        image = np.rint(255 * truth(np.minimum(picture() * t * 1e-6, 1.0))).astype(np.uint8)
        image[:, :40] = 17 * k
        frames.append(Frame(image, 200_000 * k, 200_000 * k + t))
    rows = [(t, x, y, 1) for t in range(0, 1_100_000, 50_000) for x in range(40) for y in range(80)]
    recording = Recording.from_arrays(events(*rows), frames, sensor_size=(80, 96))
    images, times = still_pixels(recording)
    assert times == pytest.approx([0.001, 0.003, 0.01, 0.03, 0.1])
    assert images[0].shape == (1, 80 * 55)
    found = calibrate_response(images, times)
    assert float(found.curves[0].inverse(np.array([0.5]))[0]) == pytest.approx(0.25, abs=0.03)


def test_gains_and_pixels_that_are_not_valid():
    """A gain counts as so much more exposure; what is not valid has no exposure at all."""
    truth, gains = Response.gamma(2.0), [1.0, 4.0, 1.0, 4.0, 1.0]
    valid = np.broadcast_to(np.arange(96) >= 40, (80, 96)).copy()
    frames = []
    for k, (t, gain) in enumerate(zip([1_000, 800, 10_000, 8_000, 100_000], gains, strict=True)):
        image = np.rint(255 * truth(np.minimum(picture() * gain * t * 1e-6, 1.0))).astype(np.uint8)
        image[~valid] = 128
        frames.append(Frame(image, 200_000 * k, 200_000 * k + t, gain=gain, valid=valid))
    recording = Recording.from_arrays(events((0, 50, 0, 1)), frames, sensor_size=(80, 96))
    images, times = still_pixels(recording)
    assert times == pytest.approx([0.001, 0.0032, 0.01, 0.032, 0.1])
    assert 80 * 56 - 9 <= images[0].size < 80 * 56
    found = calibrate_response(images, times)
    assert float(found.curves[0].inverse(np.array([0.5]))[0]) == pytest.approx(0.25, abs=0.03)


def test_a_fixed_exposure_says_nothing():
    frames = [Frame(np.full((80, 96), 9, np.uint8), t, t + 5_000) for t in range(0, 200_000, 40_000)]
    recording = Recording.from_arrays(events((0, 0, 0, 1)), frames, sensor_size=(80, 96))
    with pytest.raises(InputError, match="at 1 exposure time, three are needed"):
        still_pixels(recording)
