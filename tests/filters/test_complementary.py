"""The complementary filter against a numerical solution of its equation."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from kalux.filters.common import EPOCH
from kalux.filters.complementary import HeldSegment, advance, begin, read

from builders import events, pixel_events

ON, OFF = 0.3, 0.2


def held(log_frame=0.0, gain=6.0, start=1000, shape=(1, 1)):
    frame, gains = np.full(shape, log_frame, np.float32), np.full(shape, gain, np.float32)
    return HeldSegment(start, 10**9, frame, gains, ON, OFF)


def solved(value, target, gain, times, polarities, start, t):
    """dL/dt = -gain (L - target), with a jump at every event, by Runge and Kutta."""
    edges = [start, *times, t]
    for i, (a, b) in enumerate(pairwise(edges)):
        if b > a:
            solution = solve_ivp(
                lambda _, y: -gain * (y - target), (a * 1e-6, b * 1e-6), [value], rtol=1e-10, atol=1e-12
            )
            value = float(solution.y[0, -1])
        if i < len(times):
            value += ON if polarities[i] else -OFF
    return value


@given(
    value=st.floats(-4, 2),
    target=st.floats(-4, 2),
    gain=st.floats(0.1, 60.0),
    rows=st.lists(st.tuples(st.integers(1001, 300_000), st.booleans()), max_size=6).map(sorted),
    later=st.integers(0, 300_000),
)
def test_one_pixel_against_runge_kutta(value, target, gain, rows, later):
    times, polarities = [t for t, _ in rows], [p for _, p in rows]
    segment = held(target, gain)
    cursor = begin(segment, np.full((1, 1), value, np.float32))
    advance(segment, cursor, pixel_events(times, polarities))
    t = (times[-1] if times else 1000) + later
    expected = solved(value, target, gain, times, polarities, 1000, t)
    np.testing.assert_allclose(read(segment, cursor, t), expected, rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize(("polarity", "step"), [(1, ON), (0, -OFF)])
def test_an_event_is_a_jump_by_its_threshold(polarity, step):
    segment = held(0.0, gain=0.0)
    cursor = begin(segment, np.full((1, 1), -1.0, np.float32))
    advance(segment, cursor, pixel_events([2000], [polarity]))
    np.testing.assert_allclose(read(segment, cursor, 2000), -1.0 + step, rtol=1e-6)
    np.testing.assert_allclose(read(segment, cursor, 9000), -1.0 + step, rtol=1e-6)


def test_frames_are_held():
    """On its frame the state stays, and off it comes back by 1/e in one time constant, for ever."""
    segment = held(-0.7, gain=10.0)
    on_it = begin(segment, np.full((1, 1), -0.7, np.float32))
    np.testing.assert_allclose(read(segment, on_it, 10**8), -0.7, rtol=1e-6)
    off_it = begin(segment, np.full((1, 1), 0.3, np.float32))
    np.testing.assert_allclose(read(segment, off_it, 1000 + 100_000), -0.7 + np.exp(-1), rtol=1e-6)
    np.testing.assert_allclose(read(segment, off_it, 10**8), -0.7, atol=1e-6)


def test_reading_changes_nothing_and_begin_copies():
    segment, state = held(0.0), np.ones((1, 1), np.float32)
    cursor = begin(segment, state)
    first = read(segment, cursor, 50_000)
    read(segment, cursor, 90_000)
    np.testing.assert_array_equal(read(segment, cursor, 50_000), first)
    advance(segment, cursor, pixel_events([60_000], [1]))
    np.testing.assert_array_equal(state, np.ones((1, 1), np.float32))


def test_each_event_goes_to_its_own_pixel():
    segment = held(0.0, gain=0.0, shape=(2, 3))
    cursor = begin(segment, np.zeros((2, 3), np.float32))
    advance(segment, cursor, events((2000, 2, 0, 1), (3000, 0, 1, 0)))
    np.testing.assert_allclose(read(segment, cursor, 4000), [[0, 0, ON], [-OFF, 0, 0]], atol=1e-6)


def test_days_pass():
    """Times are 32 bits from an origin that moves on with the events."""
    day = 24 * 3600 * 10**6
    segment = HeldSegment(1000, 10**12, np.zeros((1, 1), np.float32), 1e-6, ON, OFF)
    times = [1000 + EPOCH, 1001 + EPOCH, day, 5 * day]
    cursor = begin(segment, np.ones((1, 1), np.float32))
    advance(segment, cursor, pixel_events(times, [1, 0, 1, 1]))
    expected = solved(1.0, 0.0, 1e-6, times, [1, 0, 1, 1], 1000, 9 * day)
    np.testing.assert_allclose(read(segment, cursor, 9 * day), expected, rtol=2e-6)
