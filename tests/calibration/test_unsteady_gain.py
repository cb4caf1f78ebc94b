"""Most probable gains of frames from uncertain steps between them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.calibration.unsteady_gain import likely_log_gains


def test_exact_steps_give_the_gains_about_their_mean():
    logs = 0.1 * np.sin(0.7 * np.arange(40))
    found = likely_log_gains(np.diff(logs), np.full(39, 1e-5))
    np.testing.assert_allclose(found, logs - logs.mean(), atol=1e-5)


def test_errors_of_steps_do_not_add_up():
    """Sums of steps whose errors are 0.02 are wrong by 0.3 after 500 frames."""
    rng = np.random.default_rng(3)
    logs = 0.1 * np.sin(0.7 * np.arange(500))
    steps = np.diff(logs) + rng.normal(0.0, 0.02, 499)
    added_up = np.cumsum([0.0, *steps])
    found = likely_log_gains(steps, np.full(499, 0.02))
    assert np.std(found - logs) < 0.35 * np.std(added_up - logs)
    assert np.std(found - logs) < 0.06


def test_a_step_that_is_not_known_is_none():
    """Both sides of it are about 0, as nothing tells more."""
    errors = np.full(9, 1e-4)
    errors[4] = np.inf
    steps = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    found = likely_log_gains(steps, errors)
    np.testing.assert_allclose(found[:5].mean(), 0.0, atol=1e-6)
    np.testing.assert_allclose(found[5:].mean(), 0.0, atol=1e-6)
    np.testing.assert_allclose(np.diff(found)[[0, 5]], 0.1, atol=1e-3)


def test_nothing_known_is_a_steady_gain():
    assert not likely_log_gains(np.zeros(3), np.full(3, np.inf)).any()


@given(st.lists(st.floats(-0.5, 0.5), min_size=1, max_size=12), st.floats(0.001, 0.1))
def test_what_steps_leave_pulls_at_each_gain_as_much_as_the_prior(steps, error):
    """D' W (d - D g) = g / S^2, for one S."""
    d = np.array(steps)
    gains = likely_log_gains(d, np.full(len(d), error))
    left = d - np.diff(gains)
    pulls = (np.concatenate([[0.0], left]) - np.concatenate([left, [0.0]])) / error**2
    assert gains.mean() == pytest.approx(0.0, abs=1e-9)
    if np.abs(gains).max() > 1e-6:
        precision = float(pulls @ gains / (gains @ gains))
        assert precision > 0
        np.testing.assert_allclose(pulls, precision * gains, atol=1e-6 * max(1.0, precision))
