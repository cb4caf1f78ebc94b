"""What the demonstration promises."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.datasets import demo_scene
from kalux.datasets.room import pink_noise


def test_pink_noise_is_standardised() -> None:
    noise = pink_noise((64, 96), np.random.default_rng(0))
    assert noise.shape == (64, 96)
    assert noise.mean() == pytest.approx(0, abs=1e-6)
    assert noise.std() == pytest.approx(1, abs=1e-5)


def test_demo_is_what_it_says() -> None:
    scene = demo_scene()
    assert scene.sensor_size == (180, 240)
    images = np.array([scene.at(t) for t in np.linspace(scene.start, scene.end, 4)])
    assert images.dtype == np.float32
    assert np.percentile(images, 99.9) > 10
    assert np.percentile(images, 1) < 0.03
    assert 0.15 < (images > 1).mean() < 0.35
    assert np.array_equal(images[0], demo_scene().at(0.0))


def test_demo_shows_the_same_view_at_every_size() -> None:
    large, small = demo_scene(), demo_scene(sensor_size=(90, 120))
    for t in (0.0, 700_000.0):
        halved = large.at(t).reshape(90, 2, 120, 2).mean(axis=(1, 3))
        assert np.corrcoef(np.log(halved).ravel(), np.log(small.at(t)).ravel())[0, 1] > 0.98


def test_the_ball_hides_a_part_of_the_window() -> None:
    scene = demo_scene()
    bright = [int((scene.at(t) > 2.0).sum()) for t in (0.0, 720_000.0)]
    ball = np.pi * 15.0**2
    assert 0.6 * ball < bright[0] - bright[1] < 1.1 * ball
