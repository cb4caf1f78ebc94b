"""The simulated rig: what both cameras see is the same world."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.datasets import pan, still
from rig_scene import (
    BlinkingBoard,
    board_poses,
    board_scenes,
    checkerboard_picture,
    distant_scenes,
    patchwork,
)
from rigs import DISTANCE, small_rig


def spot(radius=3):
    picture = np.zeros((400, 500), np.float32)
    picture[200 - radius : 201 + radius, 250 - radius : 251 + radius] = 1
    return picture


def centroid(image):
    y, x = np.indices(image.shape)
    return np.array([(x * image).sum(), (y * image).sum()]) / image.sum()


@pytest.mark.parametrize("distance", [1.0, DISTANCE])
def test_a_point_is_seen_where_lens_and_pose_put_it(distance):
    """The picture's middle, (199.5, 249.5) from 0, on the event camera's axis; the spot half a picture pixel off it."""
    rig = small_rig()
    scenes = distant_scenes(rig, spot(), still(), distance=distance, duration=1000)
    step = 0.5 / (
        2 * rig.events.matrix[0, 0]
    )  # half a pixel of the picture, two of which are one of the event camera
    point = np.array([step, step, 1.0]) * distance
    np.testing.assert_allclose(
        centroid(scenes[0].at(0.0)), rig.events.pixels(point[None, :2] / point[2])[0], atol=0.05
    )
    moved = rig.rotation @ point + rig.translation
    np.testing.assert_allclose(
        centroid(scenes[1].at(0.0)), rig.frames.pixels(moved[None, :2] / moved[2])[0], atol=0.1
    )


def test_a_pan_moves_the_picture_by_pixels():
    """30 pixels/s to the right: after 0.1 s things lie 3 pixels to the left in the middle of the event image."""
    scenes = distant_scenes(small_rig(), spot(), pan(30), distance=DISTANCE, duration=200_000)
    before, after = (centroid(scenes[0].at(t)) for t in (0.0, 100_000.0))
    np.testing.assert_allclose(after - before, [-3, 0], atol=0.1)


def test_the_board_blinks_and_rests_between_poses():
    board = BlinkingBoard(checkerboard_picture(6, 5), 0.04 / 24, rate=10, pause=50_000)
    scenes = board_scenes(small_rig(), board, board_poses(2, distance=0.5), pose_time=300_000)
    assert scenes[0].duration == 600_000
    for scene in scenes:
        lit = scene.at(75_000.0)
        dark = scene.at(120_000.0)
        assert lit.max() == pytest.approx(0.70, abs=0.01)
        assert dark.max() < 0.06
        assert scene.at(290_000.0).max() < 0.06
        np.testing.assert_array_equal(lit, scene.at(175_000.0))
        assert not np.array_equal(scene.at(175_000.0), scene.at(475_000.0))


def test_the_board_has_so_many_inner_corners():
    picture = checkerboard_picture(6, 5, 10)
    assert picture.shape == (80, 90)
    edges = np.abs(np.diff(picture[15:75:10], axis=1)).sum(axis=1)
    assert edges[2] == 8  # seven squares in a row, and the margin beside the first or the last


def test_the_picture_is_reproducible_and_in_range():
    one, other = patchwork((90, 120), 1), patchwork((90, 120), 1)
    np.testing.assert_array_equal(one, other)
    assert one.min() >= 0.02
    assert one.max() <= 4
    assert not np.array_equal(one, patchwork((90, 120), 2))
