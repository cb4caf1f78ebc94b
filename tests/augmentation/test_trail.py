"""How far a pixel is beyond its newest event."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux import PRESETS, Frame, Reconstructor
from kalux.augmentation import trail
from kalux.augmentation.refractory import EventClock
from kalux.event_slices import count_chunks
from kalux.events import make_events
from kalux.settings import altered

SHAPE = (3, 4)


def random_events(seed, count=400, span=200_000):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(1, span + 1, count))
    events = make_events(t, rng.integers(0, 4, count), rng.integers(0, 3, count), rng.random(count) < 0.7)
    return EventClock(SHAPE, 200).weighed(events)


@given(seed=st.integers(0, 100), cuts=st.lists(st.integers(0, 400), max_size=4))
def test_what_is_followed_does_not_depend_on_the_arrays_that_hold_it(seed, cuts):
    events = random_events(seed)
    on, off, after = trail.follow([events], trail.nothing_followed(SHAPE), 0, 200_000)
    parts = np.split(events, sorted(cuts))
    for one, other in zip(
        trail.follow(parts, trail.nothing_followed(SHAPE), 0, 200_000), (on, off, after), strict=True
    ):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)
    for one, other in zip((on, off), count_chunks([events], SHAPE, weighed=True), strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_newest_event_and_its_polarity_are_remembered():
    before = trail.nothing_followed(SHAPE)
    events = make_events([-30, -20, -10], [1, 1, 2], [0, 0, 2], [1, 0, 1])
    _, _, after = trail.follow([events], before, -100, 0)
    assert after.newest[0, 1] >> 1 == -20
    assert after.newest[2, 2] >> 1 == -10
    signed = trail.signed_surety(after.events)
    assert signed[0, 1] == -trail.SURE
    assert signed[2, 2] == trail.SURE
    assert np.count_nonzero(signed) == 2


def test_an_event_is_as_sure_as_its_neighbours_say_until_the_next_one():
    before = trail.nothing_followed(SHAPE)
    first, then = (np.full(SHAPE, share, np.float32) for share in (0.5, 0.25))
    events = make_events([10, 20, 30], [1, 1, 2], [0, 0, 2], [1, 0, 1])
    _, _, after = trail.follow([events], before, 0, 100)
    known = trail.with_surety(before, after, (first, then))
    signed = trail.signed_surety(known.events)
    assert signed[0, 1] == -round(0.5 * trail.SURE)
    assert signed[2, 2] == round(0.5**0.5 * trail.SURE)
    _, _, later = trail.follow([make_events([110], [2], [2], [0])], known, 100, 200)
    again = trail.with_surety(known, later, (np.ones_like(first), np.zeros_like(first)))
    assert again.surety[0, 1] == known.surety[0, 1]  # no newer event
    assert again.surety[2, 2] == 0


def test_the_scale_is_that_of_the_intervals_between_events_of_one_polarity():
    """From the usual one to 1.1 times the mean; pauses and changes of direction are no intervals."""
    known = trail.nothing_followed(SHAPE)
    assert known.scale == pytest.approx(1.1 * trail.USUAL * 1e-6)
    t = np.arange(4_000, 4_000_001, 4_000)
    zeros = np.zeros(len(t), np.int64)
    alternating = make_events(t, zeros, zeros, np.arange(len(t)) % 2)
    assert trail.follow([alternating], known, 0, 4_000_000)[2].scale == known.scale
    for start in range(0, 48_000_000, 4_000_000):
        same = make_events(start + t, zeros, zeros, zeros)
        known = trail.follow([same], known, start, start + 4_000_000)[2]
    # Of a thousand intervals a quarter counts, with half of those before: 500 of 4 ms, and 100 usual ones.
    assert known.scale == pytest.approx(1.1 * (500 * 4e-3 + 100 * 10e-3) / 600, rel=1e-3)


def test_a_pixel_goes_on_and_comes_back():
    code = np.array([[2 * 1_000 + 1, 2 * 1_000, trail.NO_EVENT, 2 * 1_000 + 1]])
    newest = code, np.array([[trail.SURE, trail.SURE, trail.SURE, trail.SURE // 2]], np.int8)
    ages = np.array([0, 3_000, 10_000, 30_000, 1_000_000])
    f = np.array([trail.trail_at(newest, 1_000 + age, (0.01, 0.1, 0.2))[0] for age in ages])
    x = ages / 10_000
    np.testing.assert_allclose(f[:, 0], 0.1 * 2 * x / (1 + x * x), atol=1e-7)
    np.testing.assert_allclose(f[:, 1], -2 * f[:, 0], atol=1e-7)
    np.testing.assert_allclose(f[:, 2], 0, atol=1e-7)
    # Half as sure, half as far.
    np.testing.assert_allclose(f[:, 3], 63 / 127 * f[:, 0], atol=1e-7)


@pytest.mark.parametrize("lookahead", [True, False])
@pytest.mark.parametrize("rate", [12.0, -12.0])
def test_a_steady_change_is_followed_between_its_events(lookahead, rate):
    """log(I + I_0) at a constant speed, a threshold every 17 ms."""
    threshold, span = 0.2, 160_000
    middle = np.log(0.25)
    chosen = altered(PRESETS["default"], "events", noise_rate=0.0)
    chosen = altered(chosen, "camera", log_offset=0.004, reference_exposure=1_000)
    times = np.arange(1, int(abs(rate) * span * 1e-6 / threshold) + 1) * threshold / abs(rate) * 1e6
    zeros = np.zeros(len(times), np.int64)
    events = make_events(times.astype(np.int64), zeros, zeros, zeros + (rate > 0))

    def level(t):
        return middle + rate * (t * 1e-6 - span * 0.5e-6)

    def error(height):
        settings = altered(chosen, "events", trail=height)
        engine = Reconstructor((1, 1), settings=settings, lookahead=lookahead, contrast_threshold=threshold)
        for t in range(0, span, 40_000):
            value = np.exp(level(t + 500)) - 0.004
            engine.push_frame(Frame(np.full((1, 1), value, np.float32), t, t + 1_000, white=1.0))
        engine.push_events(events)
        engine.finish()
        reads = np.arange(42_000, 120_000, 1_000)
        found = np.array([engine.estimate(int(t)).log_intensity[0, 0] for t in reads])
        return np.sqrt(np.mean((found - level(reads)) ** 2))

    assert error(0.4) < 0.75 * error(0.0)
