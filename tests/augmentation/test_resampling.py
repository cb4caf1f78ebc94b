"""Frames read between their pixels."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.augmentation.bridge import UNMEASURED, Latent
from kalux.augmentation.resampling import BORDER, read_row, readable
from kalux.compiled import loop

import naive

HEIGHT, WIDTH = 5, 7


@loop
def read(frame, stride, pixels, fractions, at, apart, out):
    read_row(apart, frame, stride, pixels, fractions, at, apart, out)


def read_at(frame, x, y):
    """Log intensity and variance at places of a frame."""
    made, places = readable(frame), np.concatenate([x, y]).astype(np.float32)
    pixels, found = np.floor(places).astype(np.int32), np.empty_like(places)
    stride, count = np.uint64(made[0].size), np.uint64(len(x))
    read(made.reshape(-1), stride, pixels, places - pixels.astype(np.float32), np.uint64(0), count, found)
    return found.reshape(2, -1)


@pytest.fixture
def frame():
    random = np.random.default_rng(0)
    value, variance = random.normal(size=(2, HEIGHT, WIDTH)).astype(np.float32)
    return Latent(value, np.square(variance))


def test_a_frame_is_read_as_the_oracle_does_up_to_two_pixels_outside(frame):
    random = np.random.default_rng(1)
    x, y = (
        random.uniform(-2, WIDTH, 200).astype(np.float32),
        random.uniform(-2, HEIGHT, 200).astype(np.float32),
    )
    found = read_at(frame, x, y)
    given = frame.value.astype(float), frame.variance.astype(float)
    expected = np.array([naive.resampled(*given, *map(float, place)) for place in zip(x, y, strict=True)])
    np.testing.assert_allclose(found[0], expected[:, 0], atol=3e-6)
    np.testing.assert_allclose(found[1], expected[:, 1], rtol=3e-6)


def test_pixels_are_what_they_are(frame):
    y, x = (places.reshape(-1) for places in np.mgrid[:HEIGHT, :WIDTH])
    np.testing.assert_array_equal(read_at(frame, x, y), [frame.value.reshape(-1), frame.variance.reshape(-1)])


def test_outside_a_frame_its_outermost_pixels_go_on_unmeasured(frame):
    made = readable(frame)
    assert made.shape == (HEIGHT + 2 * BORDER, WIDTH + 2 * BORDER, 2)
    np.testing.assert_array_equal(made[..., 0], np.pad(frame.value, BORDER, mode="edge"))
    np.testing.assert_array_equal(made[..., 1], np.pad(frame.variance, BORDER, constant_values=UNMEASURED))
