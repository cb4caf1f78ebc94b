"""The paper's form against the differential equations (14), (19) that it solves, and single steps by hand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalux.augmentation.interpolation import InterpolatedSegment
from kalux.filters import akf_interpolated
from kalux.filters.akf import State
from single_pixel import ONE, events_at, integrate, levels, variances

PAPER_NOISE = akf_interpolated.Noise(0.0005, 0.03, 0.01, 0.01, printed=False)


def state(value, variance, newest=0):
    return State(ONE * value, ONE * variance, np.full((1, 1), newest, np.int64))


@given(levels, levels, levels, variances, st.tuples(*[variances] * 4), st.integers(1, 30_000))
@settings(max_examples=40, deadline=None)
def test_exact_form_solves_the_equations(value, forward, backward, variance, covariances, t):
    """From the start of an exposure on, through its middle and end: L^A and R both move (7), (13)."""
    before, at, after_frame, after = covariances
    segment = InterpolatedSegment(
        start=0,
        exposure_end=10_000,
        end=30_000,
        previous_middle=-20_000,
        middle=5_000,
        next_middle=35_000,
        forward=ONE * forward,
        backward=ONE * backward,
        scale_before=ONE,
        scale_after=ONE,
        covariance_before=ONE * before,
        covariance_at=ONE * at,
        covariance_from=ONE * after_frame,
        covariance_after=ONE * after,
        step_on=0.2,
        step_off=0.2,
    )

    def rates(now):
        u = min(now / 10_000, 1.0)
        if now < 5_000:
            covariance = before + (at - before) * (now + 20_000) / 25_000
        else:
            covariance = after_frame + (after - after_frame) * (now - 5_000) / 30_000
        return 0.0, (1 - u) * forward + u * backward, covariance

    read = akf_interpolated.read(
        segment, akf_interpolated.begin(segment, state(value, variance)), t, PAPER_NOISE
    )
    y = np.array([value, variance])
    cuts = [0, *[cut for cut in (5_000, 10_000) if cut < t], t]
    for a, b in itertools.pairwise(cuts):
        y = integrate(lambda now, end=b: rates(min(now, np.nextafter(end, 0))), a, b, *y)
    np.testing.assert_allclose([read[0][0, 0], read[1][0, 0]], y, rtol=1e-6, atol=1e-6)


@given(levels, levels, variances, variances, st.integers(1, 30_000))
@settings(max_examples=40, deadline=None)
def test_printed_form_is_exact_where_nothing_moves(value, augmented, variance, covariance, t):
    """(17) and (20) as printed agree with the ODE when L^A and R stand still, and only then in general."""
    segment = still_segment(augmented, covariance)
    noise = PAPER_NOISE._replace(printed=True)
    read = akf_interpolated.read(segment, akf_interpolated.begin(segment, state(value, variance)), t, noise)
    expected = integrate(lambda _: (0.0, augmented, covariance), 0, t, value, variance)
    np.testing.assert_allclose([read[0][0, 0], read[1][0, 0]], expected, rtol=1e-6, atol=1e-6)


def still_segment(augmented, covariance):
    r = ONE * covariance
    a = ONE * augmented
    return InterpolatedSegment(0, 10_000, 30_000, -1, 5_000, 35_000, a, a, ONE, ONE, r, r, r, r, 0.2, 0.3)


@pytest.mark.parametrize("printed", [False, True])
def test_an_event_steps_the_state_by_the_threshold_and_adds_its_noise(printed):
    """(15), (21): R is so large that nothing else happens; Q = proc 10 ms + iso 10 ms + ref."""
    segment = still_segment(0.0, 1e12)
    noise = PAPER_NOISE._replace(printed=printed)
    cursor = akf_interpolated.begin(segment, state(-1.0, 0.09))
    akf_interpolated.advance(segment, cursor, events_at([10_000], [True]), noise)
    value, variance = akf_interpolated.read(segment, cursor, 10_000, noise)
    assert value[0, 0] == pytest.approx(-0.8, abs=1e-9)
    assert variance[0, 0] == pytest.approx(0.09 + 0.0005 * 0.01 + 0.03 * 0.01 + 0.01, abs=1e-9)
    akf_interpolated.advance(segment, cursor, events_at([20_001], [False]), noise)
    value, variance = akf_interpolated.read(segment, cursor, 20_001, noise)
    assert value[0, 0] == pytest.approx(-1.1, abs=1e-9)
    # 10.001 ms after the last event: outside the refractory bound.
    assert variance[0, 0] == pytest.approx(0.100305 + 0.0305 * 0.010001, abs=1e-9)


def test_reading_changes_nothing():
    segment = still_segment(0.5, 0.01)
    cursor = akf_interpolated.begin(segment, state(-1.0, 0.09))
    before = [np.array(part) for part in cursor]
    akf_interpolated.read(segment, cursor, 29_999, PAPER_NOISE)
    for part, kept in zip(cursor, before, strict=True):
        np.testing.assert_array_equal(part, kept)
