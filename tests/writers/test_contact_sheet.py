"""Contact sheets and the colours of the uncertainty."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.errors import InputError
from kalux.writers import Panel, colour_map, contact_sheet, variance_limits

GREY = np.full((60, 80), 200, np.uint8)


def test_pictures_are_enlarged_by_a_whole_factor_and_kept():
    picture = np.random.default_rng(0).integers(0, 255, (60, 80), dtype=np.uint8)
    sheet = contact_sheet([("frame", picture), ("AKF", np.repeat(picture[..., None], 3, 2))])
    assert sheet.dtype == np.uint8
    assert sheet.shape == (28 + 300 + 6, 2 * (400 + 6), 3)
    for left in (0, 406):
        region = sheet[28:328, left : left + 400]
        np.testing.assert_array_equal(region[::5, ::5, 1], picture)


def test_rows():
    sheet = contact_sheet([("a", GREY)] * 5, columns=3, smallest_height=60)
    one = contact_sheet([("a", GREY)], smallest_height=60)
    assert sheet.shape == (2 * one.shape[0], 3 * one.shape[1], 3)


def test_the_caption_and_the_bar_are_drawn_above_the_picture():
    plain = contact_sheet([("", GREY)])
    captioned = contact_sheet([("uncertainty", GREY)])
    barred = contact_sheet([Panel("uncertainty", GREY, (1e-3, 0.5))])
    assert (plain[:28] != captioned[:28]).any()
    assert (captioned[:28] != barred[:28]).any()
    np.testing.assert_array_equal(plain[28:], barred[28:])
    assert contact_sheet([("a very long caption" * 20, GREY)]).shape == plain.shape


@pytest.mark.parametrize(
    "panels",
    [
        [],
        [("a", GREY), ("b", GREY[1:])],
        [("a", GREY.astype(float))],
        [("a", np.zeros((4, 4, 4), np.uint8))],
        [("a", np.zeros((0, 4), np.uint8))],
    ],
)
def test_other_pictures_are_refused(panels):
    with pytest.raises(InputError, match="contact sheet"):
        contact_sheet(panels)


def test_colours_are_logarithmic_and_ordered():
    variance = np.geomspace(1e-4, 1, 9).astype(np.float32)[None]
    coloured = colour_map(variance, (1e-4, 1))
    assert coloured.shape == (1, 9, 3)
    brightness = coloured.astype(int).sum(axis=2)[0]
    assert (np.diff(brightness) > 0).all()
    middle = colour_map(np.array([[1e-2]]), (1e-4, 1))[0, 0]
    np.testing.assert_allclose(coloured[0, 4].astype(int), middle.astype(int), atol=3)
    # inferno is dark violet to yellow: red before blue at the top
    assert coloured[0, 7, 0] > coloured[0, 7, 2]


def test_infinite_and_zero_variances_have_the_colours_of_the_limits():
    coloured = colour_map(np.array([[0, 0.1, 1, np.inf]], np.float32), (0.1, 1))
    np.testing.assert_array_equal(coloured[0, 0], coloured[0, 1])
    np.testing.assert_array_equal(coloured[0, 2], coloured[0, 3])


def test_limits_of_odd_variances():
    assert variance_limits(np.array([[np.inf, 0]])) == (1e-3, 1.0)
    low, high = variance_limits(np.full((3, 3), 0.2))
    assert low < high
    colour_map(np.full((3, 3), 0.2))


@pytest.mark.parametrize("limits", [(0, 1), (1, 1), (1, np.inf)])
def test_other_limits_are_refused(limits):
    with pytest.raises(InputError, match="limits"):
        colour_map(np.ones((2, 2)), limits)


def test_nan_is_refused():
    with pytest.raises(InputError, match="NaN"):
        colour_map(np.array([[np.nan]]))
