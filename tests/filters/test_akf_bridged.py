"""The bridged form against the differential equations (14), (19) that it solves, and single steps by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalux import memory
from kalux.augmentation.bridge import UNMEASURED, BridgedSegment, Latent, UntiedSteps
from kalux.augmentation.refractory import EventClock
from kalux.events import make_events
from kalux.filters import akf_bridged
from kalux.filters.akf import State
from kalux.filters.common import EPOCH, NEVER, make_clock
from single_pixel import ONE, US, events_at, integrate, levels, variances


def bridged_state(value, variance, newest=0):
    """At time 0, with the newest event of every pixel ``newest`` us before."""
    return State(ONE * value, ONE * variance, make_clock((1, 1), newest))


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
    read = akf_bridged.read(segment, akf_bridged.begin(segment, bridged_state(value, variance)), span)
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
    cursor = akf_bridged.begin(segment._replace(still_since=10_000), bridged_state(0.0, 1.0, 60_000))
    assert akf_bridged.moving_pixels(segment, cursor)[0, 0] == moves


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
    found = akf_bridged.read(segment, akf_bridged.begin(segment, start), 30_000)
    rate = 10.0 * (1 / forward + 1 / (backward + 0.1 * events))
    information = 1 / variance + 0.03 * rate
    expected = augmented + 0.03 * slope + (value - augmented) / variance / information
    np.testing.assert_allclose(found[0], expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found[1], 1 / information, rtol=1e-5)


def test_a_doubtful_event_moves_the_augmented_frame_fully_and_the_state_partly():
    """K5: nine pixels at 3 Hz make noise at 27 Hz, so an event 1/27 s after the last is signal by one half."""
    age = round(1e6 / 27)
    segment = drifting_segment(100_000)
    cursor = akf_bridged.begin(segment, bridged_state(0.0, 0.1))
    akf_bridged.advance(segment, cursor, events_at([age], [True]), akf_bridged.Noise(3.0, 0.2, 0.16))
    value, variance = akf_bridged.read(segment, cursor, age)
    assert cursor.pixels["augmented"][1, 1] == pytest.approx(0.4)
    assert value[0, 0] == pytest.approx(0.2, rel=1e-4)
    assert variance[0, 0] == pytest.approx(0.1 + 0.16 * (0.2 + 0.25), rel=1e-4)


def test_a_clipped_frame_lifts_the_state_to_its_bound():
    """K7: where a frame is saturated the state is no darker than white; one that is brighter already stays."""
    segment = drifting_segment(1000, shape=(1, 2))
    segment = segment._replace(bound=Latent(np.full((1, 2), 0.03), np.full((1, 2), UNMEASURED)))
    start = State(np.array([[-1.0, 2.0]]), np.full((1, 2), 0.1), make_clock((1, 2), 0))
    cursor = akf_bridged.begin(segment, start)
    np.testing.assert_allclose(akf_bridged.read(segment, cursor, 999)[0], [[-1.0, 2.0]], atol=1e-7)
    np.testing.assert_allclose(akf_bridged.read(segment, cursor, 1000)[0], [[0.03, 2.0]], atol=1e-7)
    np.testing.assert_allclose(akf_bridged.end(segment, cursor).log_intensity, [[0.03, 2.0]], atol=1e-7)


def test_variances_to_come_are_counted_not_subtracted():
    """After the last of a thousand events 1/R is that of the frame at the end, with nothing left over."""
    q, frame = 0.008, 3.4e-5
    segment = drifting_segment(10**6)._replace(
        forward_variance=ONE * frame, backward_variance=ONE * frame, events=ONE * 1000, step_variance=q
    )
    cursor = akf_bridged.begin(segment, bridged_state(0.0, 0.1))
    times = np.arange(1, 1001) * 100
    akf_bridged.advance(
        segment, cursor, events_at(times, times % 200 == 0), akf_bridged.Noise(3.0, 0.2, 0.04)
    )
    before, after = (
        akf_bridged.read(segment, cursor, int(t))[1][0, 0] for t in (times[-1], times[-1] + 1000)
    )
    rate = 1 / frame + 1 / (frame + 1000 * q)
    assert 1 / after - 1 / before == pytest.approx(rate * 1e-3, rel=1e-5)


def test_steps_that_are_all_wrong_alike_count_until_they_have_come():
    """Where the frame before does not measure a pixel, 1/R is that of the way back from the next one (K4)."""
    q, frame, wrong = 0.008, 3.4e-5, 0.002
    segment = drifting_segment(10**6)._replace(
        backward_variance=ONE * frame, events=ONE * 3, step_variance=q, wrong=ONE * wrong
    )
    cursor = akf_bridged.begin(segment, bridged_state(0.0, 0.1))
    for come in range(4):
        start = 200_000 * come
        if come:
            akf_bridged.advance(
                segment, cursor, events_at([start], [True]), akf_bridged.Noise(3.0, 0.2, 0.04)
            )
        before, after = (akf_bridged.read(segment, cursor, start + wait)[1][0, 0] for wait in (0, 100))
        left = 3 - come
        expected = 1e-4 / (frame + q * left + wrong * left**2)
        assert 1 / after - 1 / before == pytest.approx(expected, rel=1e-2)


def test_events_add_what_wrong_thresholds_add_to_those_pixels_that_they_are_wrong_for():
    """K10: of the second of two pixels, an on event 0.05 and an off event 0.03, times their weights."""
    segment = drifting_segment(10**6, shape=(1, 2))
    untied = UntiedSteps(np.array([1]), np.array([0.05], np.float32), np.array([0.03], np.float32))
    events = make_events(np.array([100, 200, 300]), np.ones(3, int), np.zeros(3, int), np.array([1, 0, 0]))
    weighed = EventClock((1, 2), 0).weighed(events)
    variances = []
    for of_steps in (None, untied):
        state = State(np.zeros((1, 2)), np.full((1, 2), 0.1), make_clock((1, 2), 0))
        cursor = akf_bridged.begin(segment._replace(untied=of_steps), state)
        akf_bridged.advance(segment, cursor, weighed, akf_bridged.Noise(3.0, 0.2, 0.04))
        variances.append(akf_bridged.read(segment, cursor, 400)[1])
    np.testing.assert_allclose(variances[1] - variances[0], [[0, 0.05 + 2 * 0.03]], rtol=1e-3, atol=1e-6)


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
    noise = akf_bridged.Noise(0.0, 0.2, 0.16)  # every event is signal, however lonely
    cursor = akf_bridged.begin(segment, bridged_state(-1.0, 0.1))
    akf_bridged.advance(segment, cursor, events_at(times, [True] * len(times)), noise)
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
    found = akf_bridged.read(segment, cursor, end)
    np.testing.assert_allclose([found[0][0, 0], 1 / found[1][0, 0]], [value, information], rtol=1e-5)
    assert (akf_bridged.end(segment, cursor).newest == NEVER).all()


def drifting_segment(end, shape=(1, 1)):
    """Nothing is known of L^A, so that only events move the state."""
    zero, step, unknown = np.zeros(shape), np.full(shape, 0.4), np.full(shape, UNMEASURED)
    return BridgedSegment(0, end, zero, zero, step, step, unknown, unknown, zero, 0.0, 1.0, None)


def test_memory_that_is_used_again_does_not_show(monkeypatch):
    """A cursor in the memory of another reads as one in its own (`kalux.memory`)."""
    monkeypatch.setattr(memory, "_free", memory._Free())  # what other tests left might be too much to keep
    rng = np.random.default_rng(1)
    shape = (60, 300)
    used = akf_bridged.begin(drifting_segment(100_000, shape), random_state(rng, shape))
    times = np.arange(1, 400) * 100
    events = make_events(times, rng.integers(0, 70, 399), rng.integers(0, 5, 399), rng.integers(0, 2, 399))
    akf_bridged.advance(drifting_segment(100_000, shape), used, events, akf_bridged.Noise(3.0, 0.2, 0.04))
    start = random_state(rng, shape)
    segment = drifting_segment(100_000, shape)
    fresh, place = akf_bridged.begin(segment, start), used.pixels.ctypes.data
    del used
    again = akf_bridged.begin(segment, start)
    assert again.pixels.ctypes.data == place
    for cursor in (fresh, again):
        akf_bridged.advance(segment, cursor, events, akf_bridged.Noise(3.0, 0.2, 0.04))
    for one, other in zip(*(akf_bridged.read(segment, c, 50_000) for c in (fresh, again)), strict=True):
        np.testing.assert_array_equal(one, other)


def random_state(rng, shape):
    value, variance = rng.normal(size=shape), rng.uniform(0.01, 0.1, shape)
    return State(value.astype(np.float32), variance.astype(np.float32), make_clock(shape, 0))
