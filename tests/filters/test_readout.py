"""From the state to an intensity, and the prior on highlights."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import lambertw

from kalux.filters.readout import MOST_VARIANCE, HighlightPrior, believed_highlight, intensity

OFF = HighlightPrior(white=0.0, scale2=0.0, stretch=0.0)
excesses = st.floats(0.0, 12.0)
stretches = st.floats(1e-4, 2.0)


def lambert(excess, variance, scale2, stretch):
    shrunk = excess * scale2 / (scale2 + variance)
    return lambertw(stretch * shrunk).real / stretch


@given(excesses, st.floats(0.0, 3.0), st.floats(0.01, 9.0), stretches)
def test_highlights_are_lamberts_w(excess, variance, scale2, stretch):
    found = believed_highlight(excess, variance, scale2, stretch)
    assert found == pytest.approx(lambert(excess, variance, scale2, stretch), rel=1e-6, abs=1e-12)


@given(excesses, st.floats(0.0, 3.0), st.floats(0.01, 9.0), stretches)
def test_the_mode_solves_its_equation(excess, variance, scale2, stretch):
    """K6: d exp(stretch d) is the shrunk excess."""
    d = believed_highlight(excess, variance, scale2, stretch)
    assert d * np.exp(stretch * d) == pytest.approx(excess * scale2 / (scale2 + variance), rel=1e-4, abs=1e-9)


@given(excesses, st.floats(1e-3, 2.0), st.floats(0.0, 3.0), stretches)
def test_more_excess_is_more_highlight_but_never_more_than_it(excess, more, variance, stretch):
    low = believed_highlight(excess, variance, 1.0, stretch)
    high = believed_highlight(excess + more, variance, 1.0, stretch)
    assert 0.0 <= low < high
    assert low <= excess * (1 + 1e-6) + 1e-20


def test_a_sure_estimate_is_believed():
    """No variance and no unknown scale: the estimate itself. Half where prior and noise are alike."""
    assert believed_highlight(1.5, 0.0, 1.0, 0.0) == 1.5
    assert believed_highlight(1.5, 1.0, 1.0, 0.0) == 0.75
    assert believed_highlight(0.0, 1.0, 1.0, 1.7) == pytest.approx(0.0, abs=1e-20)


def test_the_short_cut_for_a_small_stretch_is_seamless():
    below, above = (believed_highlight(1.0, 0.0, 1.0, s) for s in (0.99e-6, 1.01e-6))
    assert below == pytest.approx(above, rel=3e-6)


def test_white_is_one():
    """L = log(1 + I_0) is I = 1, L = log(I_0) is black."""
    value = np.log(np.array([[1.03, 0.53, 0.03]]))
    out = intensity(value, np.zeros((1, 3)), 0.03, OFF)
    np.testing.assert_allclose(out, [[1.0, 0.5, 0.0]], rtol=1e-6, atol=1e-7)
    assert out.dtype == np.float32


@given(st.floats(-30.0, 3.0), st.floats(0.0, 1.0), st.floats(1e-4, 1.0))
def test_intensity_is_never_negative_and_inverts_the_logarithm(value, variance, offset):
    out = intensity(np.array([[value]]), np.array([[variance]]), offset, OFF)[0, 0]
    assert out >= 0.0
    assert out == pytest.approx(max(np.exp(value) - offset, 0.0), rel=1e-5, abs=1e-6)


def test_the_prior_only_concerns_highlights():
    prior = HighlightPrior(white=np.log(1.03), scale2=1.0, stretch=1.0)
    value, variance = np.log(np.array([[0.5, 1.03, 3.0]])), np.full((1, 3), 0.2)
    with_prior, without = intensity(value, variance, 0.03, prior), intensity(value, variance, 0.03, OFF)
    np.testing.assert_array_equal(with_prior[0, :2], without[0, :2])
    believed = believed_highlight(np.log(3.0 / 1.03), 0.2, 1.0, 1.0)
    assert with_prior[0, 2] == pytest.approx(1.03 * np.exp(believed) - 0.03, rel=1e-6)
    assert 1.0 < with_prior[0, 2] < without[0, 2]


def test_a_variance_beyond_what_events_add_shrinks_no_more():
    """A pixel never seen below white has the prior's variance already."""
    prior = HighlightPrior(white=0.0, scale2=1.0, stretch=0.1)
    value = np.ones((1, 3))
    out = intensity(value, np.array([[MOST_VARIANCE, 1.0, np.inf]]), 0.0, prior)
    assert out[0, 0] == out[0, 1] == out[0, 2] > 1


def test_white_is_that_of_the_shortest_exposure():
    """A short exposure measures more than 1: what it can show is no highlight."""
    prior = HighlightPrior(white=np.log(4.03), scale2=1.0, stretch=1.0)
    value, variance = np.log(np.array([[1.03, 2.0, 4.02]])), np.full((1, 3), 0.5)
    np.testing.assert_array_equal(
        intensity(value, variance, 0.03, prior), intensity(value, variance, 0.03, OFF)
    )


def test_the_white_level_is_continuous():
    prior = HighlightPrior(white=0.0, scale2=1.0, stretch=1.7)
    low, high = intensity(np.array([[-1e-7, 1e-7]]), np.ones((1, 2)), 0.03, prior)[0]
    assert high == pytest.approx(low, abs=1e-6)
