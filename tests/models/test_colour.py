"""Mosaics, demosaicing, white balance and chromaticity."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.errors import SettingsError
from kalux.frames import MOSAICS
from kalux.models.colour import (
    LUMINANCE,
    calm_highlights,
    channels,
    chromaticity,
    demosaic,
    joined_chromaticity,
    luminance,
    sample_mosaic,
    white_balance,
)

OFFSET = 0.03


def test_the_letters_are_the_first_four_pixels_by_rows():
    assert channels("RGGB", (2, 4)).tolist() == [[0, 1, 0, 1], [1, 2, 1, 2]]
    assert channels("GBRG", (3, 3)).tolist() == [[1, 2, 1], [0, 1, 0], [1, 2, 1]]


@pytest.mark.parametrize("mosaic", MOSAICS)
@pytest.mark.parametrize("colour", [(0.9, 0.02, 0.02), (0.02, 0.9, 0.02), (0.02, 0.02, 0.9), (0.7, 0.5, 5.0)])
@pytest.mark.parametrize("shape", [(2, 2), (5, 4), (8, 9)])
def test_an_even_colour_comes_back(mosaic, colour, shape):
    """A red wall is red, for every phase of the mosaic, up to its borders."""
    wall = np.broadcast_to(np.array(colour, np.float32), (*shape, 3))
    np.testing.assert_allclose(
        demosaic(sample_mosaic(wall, mosaic), mosaic, OFFSET), wall, rtol=1e-4, atol=1e-5
    )


@given(st.integers(0, 99), st.sampled_from(MOSAICS))
def test_measured_values_stay(seed, mosaic):
    measured = np.random.default_rng(seed).uniform(0, 20, (6, 7)).astype(np.float32)
    np.testing.assert_array_equal(sample_mosaic(demosaic(measured, mosaic, OFFSET), mosaic), measured)


@given(st.integers(0, 99), st.sampled_from(MOSAICS))
def test_results_are_finite_and_not_negative(seed, mosaic):
    measured = np.exp(np.random.default_rng(seed).uniform(-20, 20, (9, 8))).astype(np.float32)
    measured[::4] = 0
    shown = demosaic(measured, mosaic, OFFSET)
    assert np.isfinite(shown).all()
    assert shown.min() >= 0


@pytest.mark.parametrize("turn", [0, 1])
@pytest.mark.parametrize("mosaic", MOSAICS)
def test_a_grey_edge_of_one_to_a_hundred_has_no_fringe(mosaic, turn):
    """Straight edges along rows and columns: no zipper, no colours, on either side."""
    edge = np.full((12, 12), 0.2, np.float32)
    edge[:, 7:] = 20.0
    edge = np.rot90(edge, turn)
    shown = demosaic(np.ascontiguousarray(edge), mosaic, OFFSET)
    np.testing.assert_allclose(shown, np.stack([edge] * 3, axis=-1), rtol=0.05)


def test_gains_balance_the_white_before_colours_are_joined():
    """A grey edge under red light: balanced, it is grey without a fringe."""
    grey = np.full((10, 10), 0.1, np.float32)
    grey[:, 5:] = 3.0
    light = np.array([2.0, 1.0, 0.5], np.float32)
    measured = sample_mosaic(grey[..., None] * light, "RGGB")
    shown = demosaic(measured, "RGGB", OFFSET, tuple(float(g) for g in 1 / light))
    np.testing.assert_allclose(shown, np.stack([grey] * 3, axis=-1), rtol=0.05)


def test_highlights_lose_their_colour_where_they_are_doubtful():
    colour = np.array([[[8.0, 1.0, 1.0], [8.0, 1.0, 1.0], [0.9, 0.1, 0.1]]], np.float32)
    calmed = calm_highlights(colour, np.array([[1e-6, 2.0, 2.0]], np.float32))
    np.testing.assert_allclose(calmed[0, 0], colour[0, 0], rtol=1e-3)  # known
    ratio = calmed[0, 1, 0] / calmed[0, 1, 1]
    assert 1.0 < ratio < 1.5
    np.testing.assert_array_equal(calmed[0, 2], colour[0, 2])  # not as bright as white
    np.testing.assert_allclose(luminance(calmed), luminance(colour), rtol=1e-5)


def test_highlights_begin_at_the_white_of_the_frames():
    colour = np.array([[[8.0, 1.0, 1.0], [0.9, 0.1, 0.1], [0.2, 0.1, 0.1]]], np.float32)
    variance = np.array([[2.0, 2.0, 2.0]], np.float32)
    calmed = calm_highlights(colour, variance, (2.0, 1.0, 1.0))
    for white in (0.25, 4.0):
        scaled = calm_highlights(np.float32(white) * colour, variance, (2.0, 1.0, 1.0), white)
        np.testing.assert_allclose(scaled, white * calmed, rtol=1e-6)


def test_white_balance_leaves_the_luminance_of_white():
    assert white_balance("as-recorded") == (1, 1, 1)
    assert white_balance("grey-world") is None
    gains = white_balance("1.8; 1 ;1.4")
    assert gains[0] / gains[1] == pytest.approx(1.8)
    assert gains[2] / gains[1] == pytest.approx(1.4)
    assert np.dot(gains, LUMINANCE) == pytest.approx(1)


@pytest.mark.parametrize("text", ["", "1;2", "1;2;3;4", "a;b;c", "1;-1;1", "1;0;1", "nan;1;1", "gray"])
def test_white_balances_that_are_none(text):
    with pytest.raises(
        SettingsError, match=r"white_balance.*as-recorded, grey-world nor three positive gains"
    ):
        white_balance(text)


@given(st.integers(0, 99))
def test_chromaticity_has_the_luminance_one_and_gives_the_colour_back(seed):
    colour = np.random.default_rng(seed).uniform(0.05, 2, (4, 5, 3))
    chroma = chromaticity(colour, 1e-9)
    np.testing.assert_allclose(luminance(chroma), 1, rtol=1e-5)
    np.testing.assert_allclose(chroma * luminance(colour)[..., None], colour, rtol=1e-4)


def test_black_is_grey():
    np.testing.assert_allclose(chromaticity(np.zeros((1, 2, 3)), 0.006), 1)


def test_chromaticities_are_joined_by_weight_and_reliability():
    red = np.broadcast_to(np.array([3.0, 0.4, 0.4], np.float32), (1, 3, 3))
    blue = np.broadcast_to(np.array([0.5, 0.8, 4.0], np.float32), (1, 3, 3))
    known = np.array([[1, 0, 0]], np.float32)
    also = np.array([[1, 1, 0]], np.float32)
    joined = joined_chromaticity([(0.75, red, known), (0.25, blue, also)])
    np.testing.assert_allclose(joined[0, 0], 0.75 * red[0, 0] + 0.25 * blue[0, 0], rtol=5e-3)
    np.testing.assert_allclose(joined[0, 1], blue[0, 1], rtol=2e-2)  # clipped in the first
    np.testing.assert_allclose(joined[0, 2], 1)  # clipped in both: neutral, not magenta
