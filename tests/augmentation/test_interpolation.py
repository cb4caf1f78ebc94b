"""Equations (10)-(12): both interpolations between two deblurred frames."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.augmentation.interpolation import SCALE_INVERSE_BOUNDS, backward, forward, threshold_scale

latents = st.floats(-5.0, 2.0)
differences = st.floats(0.01, 3.0) | st.floats(-3.0, -0.01)
inverses = st.floats(0.61, 99.0)


def one(value):
    return np.array([[float(value)]])


def test_scale_by_hand():
    """(12): the frames differ by 0.45 where three events of 0.1 were seen."""
    np.testing.assert_allclose(threshold_scale(one(0.45), one(0.3)), 1.5, rtol=1e-14)
    np.testing.assert_allclose(threshold_scale(one(-0.45), one(-0.3)), 1.5, rtol=1e-14)
    np.testing.assert_allclose(threshold_scale(one(0.3), one(0.3)), 1.0, rtol=1e-14)


@given(latents, differences, inverses)
def test_both_interpolations_join_both_frames(start, difference, inverse):
    """With the scale of (12), forward ends at the end latent, and backward begins at the start latent."""
    end, integral = start + difference, difference * inverse
    scale = threshold_scale(one(end - start), one(integral))
    np.testing.assert_allclose(forward(one(start), scale, one(integral)), end, atol=1e-12)
    np.testing.assert_allclose(backward(one(end), scale, one(integral)), start, atol=1e-12)


@given(latents, differences, inverses, st.floats(0.0, 1.0))
def test_both_interpolations_agree_in_between(start, difference, inverse, share):
    end, integral = start + difference, difference * inverse
    scale = threshold_scale(one(end - start), one(integral))
    from_start = forward(one(start), scale, one(share * integral))
    from_end = backward(one(end), scale, one((1 - share) * integral))
    np.testing.assert_allclose(from_start, from_end, atol=1e-9)


@pytest.mark.parametrize(
    ("difference", "integral", "why"),
    [
        (0.0, 0.3, "the frames are equal"),
        (0.3, 0.0, "no events"),
        (0.0, 0.0, "nothing at all"),
        (0.3, -0.3, "opposite directions"),
        (-0.3, 0.3, "opposite directions"),
        (1.0, 0.59, "inverse below its bound"),
        (0.01, 1.01, "inverse above its bound"),
    ],
)
def test_nominal_where_the_scale_is_meaningless(difference, integral, why):
    assert threshold_scale(one(difference), one(integral)) == 1.0, why


def test_bounds_are_inclusive():
    assert SCALE_INVERSE_BOUNDS == (0.6, 100.0)
    np.testing.assert_allclose(threshold_scale(one(1.0), one(0.6)), 1 / 0.6, rtol=1e-14)
    np.testing.assert_allclose(threshold_scale(one(0.01), one(1.0)), 0.01, rtol=1e-14)


def test_pixels_are_independent():
    scale = threshold_scale(np.array([[0.2, 0.0, 0.4]]), np.array([[0.2, 0.7, 0.8]]))
    np.testing.assert_allclose(scale, [[1.0, 1.0, 0.5]], rtol=1e-14)


@given(differences | st.just(0.0), st.floats(-300, 300))
def test_scale_is_finite_and_within_its_bounds(difference, integral):
    scale = threshold_scale(one(difference), one(integral))[0, 0]
    assert 0.01 * (1 - 1e-12) <= scale <= 1 / 0.6 * (1 + 1e-12)
