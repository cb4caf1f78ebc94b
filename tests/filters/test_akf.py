"""The closed forms against the differential equations (14), (19) that they solve, and single steps by hand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from kalux.augmentation.bridge import UNMEASURED, BridgedSegment, Latent
from kalux.augmentation.interpolation import InterpolatedSegment
from kalux.augmentation.refractory import EventClock
from kalux.events import make_events
from kalux.filters import akf
from kalux.filters.akf import State
from kalux.filters.common import EPOCH, NEVER, make_clock, newest_around

US = 1e-6
ONE = np.ones((1, 1))
PAPER_NOISE = akf.PaperNoise(0.0005, 0.03, 0.01, 0.01, printed=False)


def state(value, variance, newest=0):
    return State(ONE * value, ONE * variance, np.full((1, 1), newest, np.int64))


def bridged_state(value, variance, newest=0):
    """At time 0, with the newest event of every pixel ``newest`` us before."""
    return State(ONE * value, ONE * variance, make_clock((1, 1), newest))


def events_at(times, polarity):
    zeros = np.zeros(len(times), np.int64)
    events = make_events(np.array(times, np.int64), zeros, zeros, np.array(polarity, bool))
    return EventClock((1, 1), 0).weighed(events)


def integrate(rates, start, end, value, variance):
    """L and P from (14) without events and (19); ``rates(t)`` is dL^A/dt shared by L, L^A and R at t (us)."""

    def derivative(t, y):
        drift, augmented, covariance = rates(t)
        gain = y[1] / covariance  # (18)
        return [(drift - gain * (y[0] - augmented)) * US, -(y[1] ** 2) / covariance * US]

    solution = solve_ivp(
        derivative,
        (start, end),
        [value, variance],
        rtol=1e-11,
        atol=1e-13,
        method="LSODA",
        max_step=(end - start) / 50,
    )
    return solution.y[:, -1]


levels = st.floats(-3, 2)
variances = st.floats(1e-4, 0.5)


@given(levels, levels, variances, variances, variances, st.floats(-5, 5), st.integers(2, 40_000))
@settings(max_examples=40, deadline=None)
def test_bridged_form_solves_the_equations(value, augmented, variance, forward, backward, slope, span):
    """Between events: L takes part in the slope of L^A, and relaxes towards it."""
    segment = BridgedSegment(
        0,
        50_000,
        ONE * augmented,
        ONE * slope,
        ONE * 0.2,
        ONE * 0.2,
        ONE * forward,
        ONE * backward,
        ONE * 0,
        0.01,
        10.0,
        None,
    )
    read = akf.read_bridged(segment, akf.begin_bridged(segment, bridged_state(value, variance)), span)
    covariance = 1 / (10.0 * (1 / forward + 1 / backward))
    expected = integrate(lambda t: (slope, augmented + slope * t * US, covariance), 0, span, value, variance)
    np.testing.assert_allclose([read[0][0, 0], read[1][0, 0]], expected, rtol=2e-6, atol=2e-6)  # float32


@pytest.mark.parametrize(
    ("forward", "backward", "moves"),
    [(0.1, 0.1, False), (0.1, UNMEASURED, False), (UNMEASURED, 0.1, False), (UNMEASURED, UNMEASURED, True)],
)
def test_a_pixel_without_events_moves_if_no_frame_measures_it(forward, backward, moves):
    zero, step = np.zeros((1, 1), np.float32), ONE * 0.2
    covariances = ONE * forward, ONE * backward
    segment = BridgedSegment(50_000, 90_000, zero, zero, step, step, *covariances, zero, 0.01, 10.0, None)
    cursor = akf.begin_bridged(segment._replace(still_since=10_000), bridged_state(0.0, 1.0, 60_000))
    assert akf.moving_bridged(segment, cursor)[0, 0] == moves


@pytest.mark.parametrize("width", [1, 63, 64, 65, 150])
def test_every_pixel_is_read(width):
    """The closed form over images narrower and wider than what is read together; every quantity differs."""
    rng = np.random.default_rng(0)
    shape = (3, width)
    of = [np.float32(np.exp(rng.normal(-2, 1, shape))) for _ in range(8)]
    augmented, slope, step, forward, backward, events, value, variance = of
    segment = BridgedSegment(
        0, 50_000, augmented, slope, step, step, forward, backward, events, 0.1, 10.0, None
    )
    start = State(value, variance, make_clock(shape, 0))
    found = akf.read_bridged(segment, akf.begin_bridged(segment, start), 30_000)
    rate = 10.0 * (1 / forward + 1 / (backward + 0.1 * events))
    information = 1 / variance + 0.03 * rate
    expected = augmented + 0.03 * slope + (value - augmented) / variance / information
    np.testing.assert_allclose(found[0], expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found[1], 1 / information, rtol=1e-5)


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

    read = akf.read_interpolated(
        segment, akf.begin_interpolated(segment, state(value, variance)), t, PAPER_NOISE
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
    read = akf.read_interpolated(segment, akf.begin_interpolated(segment, state(value, variance)), t, noise)
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
    cursor = akf.begin_interpolated(segment, state(-1.0, 0.09))
    akf.advance_interpolated(segment, cursor, events_at([10_000], [True]), noise)
    value, variance = akf.read_interpolated(segment, cursor, 10_000, noise)
    assert value[0, 0] == pytest.approx(-0.8, abs=1e-9)
    assert variance[0, 0] == pytest.approx(0.09 + 0.0005 * 0.01 + 0.03 * 0.01 + 0.01, abs=1e-9)
    akf.advance_interpolated(segment, cursor, events_at([20_001], [False]), noise)
    value, variance = akf.read_interpolated(segment, cursor, 20_001, noise)
    assert value[0, 0] == pytest.approx(-1.1, abs=1e-9)
    # 10.001 ms after the last event: outside the refractory bound.
    assert variance[0, 0] == pytest.approx(0.100305 + 0.0305 * 0.010001, abs=1e-9)


def test_a_doubtful_event_moves_the_augmented_frame_fully_and_the_state_partly():
    """K5: nine pixels at 3 Hz make noise at 27 Hz, so an event 1/27 s after the last is signal by one half."""
    age = round(1e6 / 27)
    segment = drifting_segment(100_000)
    cursor = akf.begin_bridged(segment, bridged_state(0.0, 0.1))
    akf.advance_bridged(segment, cursor, events_at([age], [True]), akf.BridgedNoise(3.0, 0.2, 0.16))
    value, variance = akf.read_bridged(segment, cursor, age)
    assert cursor.pixels["augmented"][1, 1] == pytest.approx(0.4)
    assert value[0, 0] == pytest.approx(0.2, rel=1e-4)
    assert variance[0, 0] == pytest.approx(0.1 + 0.16 * (0.2 + 0.25), rel=1e-4)


def test_reading_changes_nothing():
    segment = still_segment(0.5, 0.01)
    cursor = akf.begin_interpolated(segment, state(-1.0, 0.09))
    before = [np.array(part) for part in cursor]
    akf.read_interpolated(segment, cursor, 29_999, PAPER_NOISE)
    for part, kept in zip(cursor, before, strict=True):
        np.testing.assert_array_equal(part, kept)


@pytest.mark.parametrize("first", [1e-6, 1e-3, 1.0])
@pytest.mark.parametrize("ratio", [1 - 1e-9, 1.0, 1 + 1e-6, 1.00011, 0.5, 2.0, 100.0])
def test_integrals_of_a_linear_covariance(first, ratio):
    """int 1/R and its integral, against quadrature; the series near a constant R joins the logarithm."""
    single, double = akf.linear_covariance_integrals(first, first * ratio, 0.03)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    t = (nodes + 1) / 2
    w = weights / 2
    inner = 1 / (1 + (ratio - 1) * t)
    assert single == pytest.approx(0.03 / first * (w * inner).sum(), rel=1e-7)
    assert double == pytest.approx(0.03**2 / first * (w * inner * (1 - t)).sum(), rel=1e-7)


def test_the_neighbourhood_is_clipped_at_the_border():
    newest = np.arange(12, dtype=np.int64).reshape(3, 4)
    assert newest_around(newest, 0, 0) == 5
    assert newest_around(newest, 2, 3) == 11
    assert newest_around(newest, 1, 1) == 10


def test_a_clipped_frame_lifts_the_state_to_its_bound():
    """K7: where a frame is saturated the state is no darker than white; one that is brighter already stays."""
    segment = drifting_segment(1000, shape=(1, 2))
    segment = segment._replace(bound=Latent(np.full((1, 2), 0.03), np.full((1, 2), UNMEASURED)))
    start = State(np.array([[-1.0, 2.0]]), np.full((1, 2), 0.1), make_clock((1, 2), 0))
    cursor = akf.begin_bridged(segment, start)
    np.testing.assert_allclose(akf.read_bridged(segment, cursor, 999)[0], [[-1.0, 2.0]], atol=1e-7)
    np.testing.assert_allclose(akf.read_bridged(segment, cursor, 1000)[0], [[0.03, 2.0]], atol=1e-7)
    np.testing.assert_allclose(akf.end_bridged(segment, cursor).log_intensity, [[0.03, 2.0]], atol=1e-7)


def test_variances_to_come_are_counted_not_subtracted():
    """After the last of a thousand events 1/R is that of the frame at the end, with nothing left over."""
    q, frame = 0.008, 3.4e-5
    segment = drifting_segment(10**6)._replace(
        forward_variance=ONE * frame, backward_variance=ONE * frame, events=ONE * 1000, step_variance=q
    )
    cursor = akf.begin_bridged(segment, bridged_state(0.0, 0.1))
    times = np.arange(1, 1001) * 100
    akf.advance_bridged(segment, cursor, events_at(times, times % 200 == 0), akf.BridgedNoise(3.0, 0.2, 0.04))
    before, after = (
        akf.read_bridged(segment, cursor, int(t))[1][0, 0] for t in (times[-1], times[-1] + 1000)
    )
    rate = 1 / frame + 1 / (frame + 1000 * q)
    assert 1 / after - 1 / before == pytest.approx(rate * 1e-3, rel=1e-5)


DAYS = 3 * 24 * 3600 * 10**6


@pytest.mark.parametrize("gaps", [(5_000, DAYS, 10), (EPOCH, EPOCH, 1), (EPOCH - 1, 1, EPOCH + 1, 3 * EPOCH)])
def test_clocks_of_32_bits_last_for_days(gaps):
    """The state is that of the closed form in float64, event by event, and so is one read long after."""
    times = np.cumsum(gaps)
    end = int(times[-1]) + 2 * DAYS
    segment = drifting_segment(end)._replace(
        augmented=ONE * 0.5,
        slope=ONE * 1e-6,
        forward_variance=ONE * 0.02,
        backward_variance=ONE * 5e4,
        rate=1e-4,
    )
    noise = akf.BridgedNoise(0.0, 0.2, 0.16)  # every event is signal, however lonely
    cursor = akf.begin_bridged(segment, bridged_state(-1.0, 0.1))
    akf.advance_bridged(segment, cursor, events_at(times, [True] * len(times)), noise)
    value, information, augmented, at = -1.0, 10.0, 0.5, 0
    rate = 1e-4 * (1 / 0.02 + 1 / 5e4)
    for now in [*times.tolist(), end]:
        passed = (now - at) * US
        deviation = (value - augmented) * information / (information + rate * passed)
        information += rate * passed
        augmented += 1e-6 * passed
        if now < end:
            augmented += 0.4
            information = 1 / (1 / information + 0.16 * 0.2)
        value, at = augmented + deviation, now
    found = akf.read_bridged(segment, cursor, end)
    np.testing.assert_allclose([found[0][0, 0], 1 / found[1][0, 0]], [value, information], rtol=1e-5)
    assert (akf.end_bridged(segment, cursor).newest == NEVER).all()


def drifting_segment(end, shape=(1, 1)):
    """Nothing is known of L^A, so that only events move the state."""
    zero, step, unknown = np.zeros(shape), np.full(shape, 0.4), np.full(shape, UNMEASURED)
    return BridgedSegment(0, end, zero, zero, step, step, unknown, unknown, zero, 0.0, 1.0, None)
