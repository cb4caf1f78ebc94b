"""Scenes: geometry of the moving camera, and what the demonstration promises."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from kalux.datasets import (
    Pose,
    Scene,
    combine,
    demo_scene,
    dolly,
    handheld,
    pan,
    photograph_scene,
    shake,
    spin,
    still,
)
from kalux.datasets.room import pink_noise
from kalux.errors import InputError

SIZE = (20, 30)


def coordinates(height: int = 121, width: int = 161) -> NDArray[Any]:
    """An image whose value tells the position: bilinear sampling of it is exact."""
    y, x = np.mgrid[:height, :width]
    return x + 1000.0 * y


def view(motion: Any, t: float, **changes: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """(x, y) image position that each sensor pixel looks at."""
    arguments = {"sensor_size": SIZE, "duration": 1_000_000, "blur": 0.0} | changes
    y, x = np.mgrid[:121, :161].astype(np.float64)
    return (
        photograph_scene(x, motion, **arguments).at(t).astype(np.float64),
        photograph_scene(y, motion, **arguments).at(t).astype(np.float64),
    )


def test_a_still_camera_sees_the_middle() -> None:
    x, y = view(still(), 0.0)
    assert np.allclose(x, 80 - 14.5 + np.arange(30))
    assert np.allclose(y, (60 - 9.5 + np.arange(20))[:, None])


def test_pan_moves_by_sensor_pixels_at_any_fraction() -> None:
    x0, y0 = view(still(), 0.0, scale=2.0)
    x, y = view(pan(10.0, -4.0), 123_457.0, scale=2.0)
    assert np.allclose(x - x0, 2.0 * 1.23457, atol=1e-4)
    assert np.allclose(y - y0, -2.0 * 0.493828, atol=1e-4)


def test_zoom_and_rotation_turn_about_the_middle() -> None:
    x, y = view(lambda t: Pose(angle=np.pi / 2, zoom=2.0), 0.0, sensor_size=(21, 31))
    assert x[10, 15] == pytest.approx(80)
    assert y[10, 15] == pytest.approx(60)
    assert (x[10, 17], y[10, 17]) == (pytest.approx(80), pytest.approx(61))
    assert (x[12, 15], y[12, 15]) == (pytest.approx(79), pytest.approx(60))


def test_center_is_where_the_axis_points() -> None:
    x, y = view(still(), 0.0, sensor_size=(21, 31), center=(40.25, 50.5))
    assert (x[10, 15], y[10, 15]) == (pytest.approx(40.25), pytest.approx(50.5))


def test_the_image_continues_mirrored() -> None:
    x, _ = view(lambda t: Pose(x=-80.0), 0.0, sensor_size=(21, 31))
    assert np.allclose(x[10], np.abs(np.arange(-15, 16)))
    far, _ = view(lambda t: Pose(x=100.0), 0.0, sensor_size=(21, 31))
    assert np.allclose(far[10], 160 - np.abs(180 + np.arange(-15, 16) - 160))


def test_motions_combine() -> None:
    both = combine(pan(10, 20), pan(1, 2), spin(0.5), dolly(0.1), dolly(0.2))(2e6)
    assert both == pytest.approx(Pose(22, 44, 1.0, np.exp(0.6)))


@pytest.mark.parametrize("make", [shake, handheld])
def test_random_motion_follows_its_seed(make: Any) -> None:
    times = np.linspace(0, 1e6, 7)
    assert [make(3)(t) for t in times] == [make(3)(t) for t in times]
    assert make(3)(5e5) != make(4)(5e5)


def test_shake_has_its_amplitude() -> None:
    motion = shake(1, amplitude=2.0, roll=0.01)
    poses = np.array([motion(t) for t in np.linspace(0, 60e6, 6000)])
    assert poses[:, :2].std(axis=0) == pytest.approx(2.0, rel=0.05)
    assert poses[:, 2].std() == pytest.approx(0.01, rel=0.05)


def test_pink_noise_is_standardised() -> None:
    noise = pink_noise((64, 96), np.random.default_rng(0))
    assert noise.shape == (64, 96)
    assert noise.mean() == pytest.approx(0, abs=1e-6)
    assert noise.std() == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("image", [np.zeros((3, 4, 3)), np.full((5, 5), -1.0), np.full((5, 5), np.inf)])
def test_photographs_must_be_grey_radiance(image: NDArray[Any]) -> None:
    with pytest.raises(InputError):
        photograph_scene(image, still(), sensor_size=SIZE, duration=1000)


def test_an_empty_scene_is_refused() -> None:
    with pytest.raises(InputError, match="not after its start"):
        Scene(lambda t: np.zeros(SIZE), SIZE, 5, 5)
    with pytest.raises(InputError, match="sensor size"):
        Scene(lambda t: np.zeros(SIZE), (0, 5), 0, 5)


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
