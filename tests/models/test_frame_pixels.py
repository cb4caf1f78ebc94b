"""Neighbours of one colour, and the medians that stand for stuck pixels."""

from __future__ import annotations

import numpy as np

from kalux.models.frame_pixels import around, without_stuck


def test_neighbours_are_those_of_a_pitch():
    values = np.arange(25.0).reshape(5, 5)
    assert sorted(around(values, 1, -1.0)[:, 2, 2]) == [6, 7, 8, 11, 13, 16, 17, 18]
    assert sorted(around(values, 2, -1.0)[:, 2, 2]) == [0, 2, 4, 10, 14, 20, 22, 24]
    assert sorted(around(values, 1, -1.0)[:, 0, 0]) == [-1] * 5 + [1, 5, 6]


def test_the_median_of_good_neighbours_stands_for_a_stuck_pixel():
    image = np.full((3, 4), 10, np.uint8)
    image[0, 0], image[1, 1], image[0, 1] = 200, 255, 255
    stuck = image == 255
    mended = without_stuck(image, stuck, 1)
    assert mended.dtype == np.uint8
    assert mended.tolist() == [[200, 10, 10, 10], [10, 10, 10, 10], [10, 10, 10, 10]]
    assert image[1, 1] == 255


def test_channels_have_medians_of_their_own():
    image = np.zeros((3, 3, 3), np.float32)
    image[..., 1], image[1, 1] = 0.25, 1.0
    assert without_stuck(image, image[..., 0] == 1, 1)[1, 1].tolist() == [0, 0.25, 0]


def test_without_a_good_neighbour_it_stays():
    image = np.full((2, 2), 7, np.uint8)
    assert without_stuck(image, np.ones((2, 2), np.bool_), 1).tolist() == [[7, 7], [7, 7]]
