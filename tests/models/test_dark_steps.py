"""By how much more events of dark pixels vary: read from a setting, and by the light of two frames."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.errors import SettingsError
from kalux.models.dark_steps import BRIGHT, PARTS, dark_step_variance, dark_steps, octave

OFFSET = 0.004
STEPS = (0.1, 0.3, 1.5, 1.2, 2.0, 2.5)
MIDDLES = BRIGHT / 2.0 ** (np.arange(PARTS) + 0.5)


def variance_at(intensity, other=None):
    first, second = (
        np.log(np.atleast_2d(one) + OFFSET) for one in (intensity, intensity if other is None else other)
    )
    return dark_step_variance(first, second, STEPS, OFFSET, 0.04)[0] / 0.04


def test_octaves_have_what_is_stated_in_their_middles():
    np.testing.assert_allclose(variance_at(MIDDLES), STEPS, rtol=1e-4)


def test_bright_light_has_nothing_and_the_darkest_no_more_than_its_octave():
    assert not variance_at([0.46, 1.0, 50.0]).any()
    np.testing.assert_allclose(variance_at([0.0, 1e-4, 0.005]), STEPS[-1], rtol=1e-6)


def test_between_the_middles_it_is_linear_in_the_logarithm():
    between = np.geomspace(0.46, 0.005, 200)
    expected = np.interp(-np.log(between), -np.log([2 * MIDDLES[0], *MIDDLES]), [0.0, *STEPS])
    np.testing.assert_allclose(variance_at(between), expected, atol=1e-4)


def test_what_leaves_the_dark_counts_by_the_mean_of_both_frames():
    np.testing.assert_allclose(variance_at(0.01, 0.07), variance_at(0.04), rtol=1e-4)
    assert variance_at(0.01, 1.0)[0] == 0.0


def test_octaves_are_those_below_bright():
    np.testing.assert_array_equal(octave(MIDDLES), np.arange(PARTS))
    np.testing.assert_array_equal(octave(np.array([0.0, 0.0051, 0.33, 7.0])), [PARTS - 1, PARTS - 1, -1, -1])


def test_steps_are_read_from_a_setting():
    assert dark_steps("auto") is dark_steps("none") is dark_steps("0 0 0 0 0 0") is None
    assert dark_steps("0 0.1 1 2e-1 3 4") == (0.0, 0.1, 1.0, 0.2, 3.0, 4.0)


@pytest.mark.parametrize("text", ["", "dark", "1 2 3", "1 1 1 1 1 -1", "1 1 1 1 1 nan", "1 1 1 1 1 1 1"])
def test_steps_that_are_none_are_an_error(text):
    with pytest.raises(SettingsError, match="6 numbers from 0 to 100"):
        dark_steps(text)
