"""Event noise, equations (1)-(2), and the model in units of the threshold."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.models.events import (
    event_noise,
    isolated_noise,
    process_noise,
    refractory_noise,
    signal_probability,
    threshold_noise,
)

seconds = st.floats(0.0, 1e3)
rates = st.floats(0.0, 1e3)


def test_event_noise_by_hand():
    """(2) with the paper's parameters: 2 ms after the pixel's last event, 0.5 ms after a neighbour's."""
    q = event_noise(0.0005, 0.03, 0.01, 0.010, 0.002, 0.0005)
    assert q == pytest.approx(0.0005 * 0.002 + 0.03 * 0.0005 + 0.01, rel=1e-12)


def test_after_the_refractory_bound_only_two_terms_are_left():
    assert event_noise(0.0005, 0.03, 0.01, 0.010, 2.0, 0.5) == pytest.approx(0.001 + 0.015, rel=1e-12)


@given(rates, rates, rates, st.floats(0.0, 1.0), seconds, seconds)
def test_event_noise_is_the_sum_of_its_three_parts(proc, iso, ref, bound, pixel, neighbour):
    parts = process_noise(proc, pixel) + isolated_noise(iso, neighbour) + refractory_noise(ref, pixel, bound)
    assert event_noise(proc, iso, ref, bound, pixel, neighbour) == pytest.approx(parts, rel=1e-12)


@pytest.mark.parametrize(("since", "expected"), [(0.0, 0.01), (0.0099, 0.01), (0.01, 0.01), (0.0100001, 0.0)])
def test_refractory_bound_is_inclusive(since, expected):
    """Section 3.1.1: nothing only where the time is *more* than the bound."""
    assert refractory_noise(0.01, since, 0.01) == expected


def test_no_time_no_noise():
    assert process_noise(0.0005, 0.0) == 0.0
    assert isolated_noise(0.03, 0.0) == 0.0
    assert event_noise(0.0, 0.0, 0.0, 0.01, 1.0, 1.0) == 0.0


@given(st.floats(1e-3, 100.0), st.floats(0.0, 100.0), st.floats(1e-3, 100.0))
def test_older_neighbours_make_an_event_less_likely_signal(noise_rate, since, more):
    near, far = signal_probability(noise_rate, since), signal_probability(noise_rate, since + more)
    assert 0.0 < far < near <= 1.0


def test_signal_probability_limits():
    """Certain with a neighbour at the same moment or without noise; even odds at the age where rates are equal."""
    assert signal_probability(3.0, 0.0) == 1.0
    assert signal_probability(0.0, 1e9) == 1.0
    assert signal_probability(3.0, 1 / 27) == pytest.approx(0.5, rel=1e-12)
    assert signal_probability(3.0, 0.5 / 27) == pytest.approx(0.8, rel=1e-12)
    assert signal_probability(3.0, 1e9) < 1e-9


def test_threshold_noise_by_hand():
    """A sure event has its own variance; an even chance adds that of a coin, a quarter; sure noise nothing."""
    assert threshold_noise(0.2, 0.04, 1.0) == pytest.approx(0.008, rel=1e-12)
    assert threshold_noise(0.2, 0.04, 0.5) == pytest.approx(0.018, rel=1e-12)
    assert threshold_noise(0.2, 0.04, 0.0) == pytest.approx(0.008, rel=1e-12)


@given(st.floats(0.0, 2.0), st.floats(1e-3, 1.0), st.floats(0.0, 1.0))
def test_doubt_is_largest_at_even_odds(step_variance, threshold2, signal):
    q = threshold_noise(step_variance, threshold2, signal)
    assert threshold2 * step_variance <= q <= threshold_noise(step_variance, threshold2, 0.5) * (1 + 1e-12)
    assert q == pytest.approx(threshold_noise(step_variance, threshold2, 1.0 - signal), rel=1e-9)
