"""Scenes: geometry of the moving camera."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from kalux.datasets import Pose, Scene, pan, photograph_scene, still
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


@pytest.mark.parametrize("image", [np.zeros((3, 4, 3)), np.full((5, 5), -1.0), np.full((5, 5), np.inf)])
def test_photographs_must_be_grey_radiance(image: NDArray[Any]) -> None:
    with pytest.raises(InputError):
        photograph_scene(image, still(), sensor_size=SIZE, duration=1000)


@pytest.mark.parametrize("scale", [0.0, -1.0, 1e-300, 1e300, math.inf, math.nan])
def test_scales_without_a_view_are_refused(scale: float) -> None:
    with pytest.raises(InputError, match=r"scale is .* must be positive, 1e-06 to 50"):
        photograph_scene(np.ones((40, 50)), still(), sensor_size=SIZE, duration=1000, scale=scale)


@pytest.mark.parametrize(
    "pose",
    [
        Pose(x=1e300),
        Pose(y=math.nan),
        Pose(angle=math.nan),
        Pose(angle=math.inf),
        Pose(zoom=0.0),
        Pose(zoom=1e300),
    ],
)
def test_poses_without_a_view_are_refused(pose: Pose) -> None:
    scene = photograph_scene(np.ones((40, 50)), lambda t: pose, sensor_size=SIZE, duration=1000)
    with pytest.raises(InputError, match="camera: its motion leads to"):
        scene.at(0.0)


def test_an_empty_scene_is_refused() -> None:
    with pytest.raises(InputError, match="not after its start"):
        Scene(lambda t: np.zeros(SIZE), SIZE, 5, 5)
    with pytest.raises(InputError, match="sensor size"):
        Scene(lambda t: np.zeros(SIZE), (0, 5), 0, 5)
