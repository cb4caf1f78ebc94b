"""Lenses, poses and the rig file."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from kalux.calibration.rig import Lens, Rig, load_rig, rig_toml
from kalux.errors import FormatError, InputError
from rig_scene import example_rig

MATRIX = np.array([[300.0, 0, 158], [0, 304, 119], [0, 0, 1]])


@pytest.fixture(scope="module")
def rig():
    return example_rig()


def grid(lens):
    height, width = lens.sensor_size
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(float)


@pytest.mark.parametrize("name", ["events", "frames"])
def test_the_lens_is_that_of_opencv(rig, name):
    lens = getattr(rig, name)
    rays = np.random.default_rng(0).uniform(-0.6, 0.6, (500, 2))
    expected, _ = cv2.projectPoints(
        np.column_stack([rays, np.ones(500)]), np.zeros(3), np.zeros(3), lens.matrix, lens.distortion
    )
    np.testing.assert_allclose(lens.pixels(rays), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("name", ["events", "frames"])
def test_pixels_and_rays_are_inverse(rig, name):
    lens = getattr(rig, name)
    rays = lens.rays
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(lens.pixels(rays), grid(lens), atol=1e-3)


def test_where_the_lens_folds_back_there_is_nothing():
    """With k1 = -0.4 alone the image's radius is largest at r = 0.91: what lies further out must not come in again."""
    lens = Lens((240, 320), MATRIX, np.array([-0.4, 0, 0, 0, 0.0]))
    radius = np.linspace(0, 3, 301)
    pixels = lens.pixels(np.column_stack([radius, np.zeros(301)]))
    known = np.isfinite(pixels[:, 0])
    assert radius[known].max() == pytest.approx(1 / np.sqrt(1.2), abs=0.02)
    assert (np.diff(pixels[known, 0]) > 0).all()


@pytest.mark.parametrize("distance", [2.0, 20.0, None])
def test_the_homography_takes_points_of_the_plane_where_the_cameras_see_them(rig, distance):
    rays = rig.events.rays[::97]
    depth = 1e9 if distance is None else distance
    points = np.column_stack([rays, np.ones(len(rays))]) * depth @ rig.rotation.T + rig.translation
    expected = points[:, :2] / points[:, 2:] @ rig.frames.matrix[:2, :2].T + rig.frames.matrix[:2, 2]
    ours = np.column_stack([rays, np.ones(len(rays))]) @ rig.events.matrix.T @ rig.homography(distance).T
    np.testing.assert_allclose(ours[:, :2] / ours[:, 2:], expected, atol=1e-5)


def test_the_example_is_as_it_says(rig):
    assert rig.angle == pytest.approx(3)
    assert rig.baseline == pytest.approx(0.04)
    with pytest.raises(InputError, match="must be positive"):
        rig.homography(0.0)


def test_the_file_gives_the_rig_back(rig, tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(rig_toml(Rig(rig.events, rig.frames, rig.rotation, rig.translation, {"views": 20})))
    back = load_rig(path)
    assert back.about == {"views": 20}
    for one, other in ((rig.events, back.events), (rig.frames, back.frames)):
        assert one.sensor_size == other.sensor_size
        np.testing.assert_array_equal(one.matrix, other.matrix)
        np.testing.assert_array_equal(one.distortion, other.distortion)
    np.testing.assert_array_equal(rig.rotation, back.rotation)
    np.testing.assert_array_equal(rig.translation, back.translation)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda text: "a = [", "not valid TOML"),
        (lambda text: "b = 1\n", "not a rig file"),
        (lambda text: text.replace("kalux_rig = 1", "kalux_rig = 9"), "version 9"),
        (lambda text: text.replace("translation_m", "translation"), "translation_m' is missing"),
        (lambda text: text.replace("distortion", "d", 1), "distortion' is missing"),
        (
            lambda text: text.replace("sensor_size = [\n    240", "sensor_size = [\n    inf", 1),
            "sensor_size is .inf",
        ),
        (
            lambda text: text.replace("sensor_size = [\n    240", "sensor_size = [\n    9000000", 1),
            "at most 65536",
        ),
        (lambda text: text.replace("sensor_size = [\n    240", "sensor_size = [\n    0", 1), "lens: size"),
    ],
)
def test_files_that_are_none_are_refused(rig, tmp_path, change, told):
    path = tmp_path / "rig.toml"
    path.write_text(change(rig_toml(rig)))
    with pytest.raises(FormatError, match=told) as error:
        load_rig(path)
    assert str(path) in str(error.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        load_rig(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("matrix", "distortion"),
    [
        (np.eye(2), np.zeros(5)),
        (np.eye(3), np.zeros(4)),
        (-np.eye(3), np.zeros(5)),
        (np.eye(3), np.full(5, np.nan)),
        (np.diag([9.0, 9.0, 0.0]), np.zeros(5)),  # of which there is no inverse
        (np.eye(3) + np.eye(3, k=-1), np.zeros(5)),
    ],
)
def test_what_is_no_lens(matrix, distortion):
    with pytest.raises(InputError, match="lens"):
        Lens((4, 5), matrix, distortion)


def test_a_mirror_is_no_rotation(rig):
    with pytest.raises(InputError, match="not a rotation"):
        Rig(rig.events, rig.frames, np.diag([1.0, 1.0, -1.0]), rig.translation, {})
