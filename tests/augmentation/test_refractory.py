"""Weights of events, for what pixels miss in their refractory period."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.augmentation.deblur import integrate_exposure
from kalux.augmentation.refractory import EventClock, growth_with_period, step_weight
from kalux.compiled import WEIGHT_UNIT, event_words
from kalux.event_slices import count_events
from kalux.events import EVENT_DTYPE, make_events

SIZE = (3, 4)
MOST = 1 + 1 / 0.15  # docs/equations.md, K13


def stream(count, seed=0, span=20_000):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, span, count))
    return make_events(t, rng.integers(0, 4, count), rng.integers(0, 3, count), rng.random(count) < 0.5)


def weights(events):
    """As they are stored."""
    return 1 + ((event_words(events)[:, 1] >> 40) & 0xFFFF) * WEIGHT_UNIT


@given(st.floats(1, 1e6), st.floats(0, 1e6), st.floats(1, 1e5))
def test_a_weight_lies_between_one_and_the_most(since, before, period):
    weight = step_weight(np.float32(since), np.float32(before), np.float32(period))
    assert 1 <= weight <= MOST * (1 + 1e-6)


@pytest.mark.parametrize(
    ("since", "before", "weight"),
    [
        (200, 0, 1),
        (940, 0, 1),
        (940, 1_000, 1),
        (960, 0, 5.903),
        (1_000, 0, 6),
        (1_250, 0, 4.123),
        (2_000, 0, 1.981),
        (2_000, 900, 1.981),
        (2_000, 2_000, 1.989),
        (2_000, 1_000, 4.828),
        (2_000, 11_000, 1.544),
        (1_000, 1_000, 7.667),
        (1_250, 1_250, 4.430),
        (11_000, 11_000, 1.1),
    ],
)
def test_weights_under_a_refractory_period_of_a_millisecond(since, before, weight):
    """What comes earlier than the period allows is noise; else the light goes on at the mean of the paces before and
    after."""
    assert step_weight(np.float32(since), np.float32(before), np.float32(1_000)) == pytest.approx(
        weight, abs=5e-4
    )


@given(slope=st.floats(10, 80), period=st.integers(500, 5_000))
def test_a_pixel_that_is_held_in_reset_is_made_good(slope, period):
    """A ramp of ``slope`` thresholds per s: an event every 1/slope s of looking, after the period of not looking."""
    gap = round(1e6 / slope + period)
    times = gap * np.arange(1, 40)
    events = make_events(times, *np.zeros((2, 39), int), np.ones(39, bool))
    weighed = EventClock((1, 1), period).weighed(events)
    told = count_events(weighed[1:], (1, 1), weighed=True)[0][0, 0]
    doubted = (0.15 * period / (gap - period)) ** 2 / 2  # of a pace that is never quite steady
    assert told == pytest.approx(slope * 1e-6 * (times[-1] - times[0]), rel=2e-3 + doubted)


@pytest.mark.parametrize("polarity", [0, 1])
@pytest.mark.parametrize("pace", [0.1, 0.3, 1.0, 2.5, 4.0])
def test_what_weights_grow_by_with_the_period_is_what_longer_periods_make_of_them(pace, polarity):
    """Events of one pace, against their weights under periods that are 2 % longer and shorter.

    The first two of them tell it less.
    """
    period = 400
    times = round(period * (1 + 1 / pace)) * np.arange(1, 12)
    events = make_events(times, np.full(11, 2), np.ones(11, int), np.full(11, polarity))

    def told(length):
        return weights(EventClock(SIZE, length).weighed(events))[2:].sum()

    expected = (told(1.02 * period) - told(0.98 * period)) / 0.04
    weighed = EventClock(SIZE, period).weighed(events)
    grown = growth_with_period([weighed[2:5], weighed[5:]], SIZE)
    assert grown[1 - polarity][1, 2] == pytest.approx(expected, rel=0.06)
    for plane, expected_sum in zip(grown, (polarity, 1 - polarity), strict=True):
        assert (plane.sum() > 0) == expected_sum


def test_no_period_makes_all_weights_one_whatever_the_padding_held():
    events = stream(50)
    event_words(events)[:, 1] |= np.int64(0x1234) << 40
    np.testing.assert_array_equal(weights(EventClock(SIZE, 0).weighed(events)), 1)


@given(st.lists(st.integers(0, 200), max_size=8).map(sorted))
def test_weights_do_not_depend_on_chunks(cuts):
    events = stream(200)
    clock = EventClock(SIZE, 300)
    parts = [clock.weighed(events[a:b]) for a, b in zip([0, *cuts], [*cuts, 200], strict=True)]
    together = weights(EventClock(SIZE, 300).weighed(events))
    np.testing.assert_array_equal(np.concatenate([weights(part) for part in parts]), together)
    assert together.max() > 2


def test_events_themselves_stay_as_they_are():
    events = stream(100)
    weighed = EventClock(SIZE, 300).weighed(events)
    for name in EVENT_DTYPE.names:
        np.testing.assert_array_equal(weighed[name], events[name])


def test_weights_count_only_where_they_are_asked_for():
    """Calibrations and the paper's own equations count events."""
    events = EventClock(SIZE, 300).weighed(stream(100))
    plain, weighed = (np.sum(count_events(events, SIZE, weighed=flag)) for flag in (False, True))
    assert plain == 100
    assert weighed == pytest.approx(weights(events).sum())
    steps = np.full(SIZE, 0.2)
    assert integrate_exposure(events, -1, 20_000, steps, steps).events.sum() == 100


def test_of_what_the_next_period_hides_a_part_is_counted_before_where_two_looks_agree():
    """Up four times, down twice, up. One look alone may be noise; where the direction turns nothing is added, and what
    has been counted stays: the light went on before it turned."""
    t = 1_500 * np.arange(7)
    zeros = np.zeros(7, np.int64)
    events = make_events(t, zeros, zeros, np.array([1, 1, 1, 1, 0, 0, 1], bool))
    found = weights(EventClock((1, 1), 1_000).weighed(events))
    once, pace = 1 + 1 / np.hypot(0.5, 0.2), 1 / np.hypot(0.5, 0.15)
    np.testing.assert_allclose(found, [1, once, 1 + 1.25 * pace, 1 + pace, 1, once, 1], rtol=1e-4)


def test_it_is_the_slower_of_both_paces_that_is_counted_before():
    """A short look after a long one may be noise."""
    t = np.array([0, 3_000, 4_500, 7_500])
    zeros = np.zeros(4, np.int64)
    found = weights(EventClock((1, 1), 1_000).weighed(make_events(t, zeros, zeros, np.ones(4, bool))))
    alone, slow, fast = 1 / np.hypot(2, 0.2), 1 / np.hypot(2, 0.15), 1 / np.hypot(0.5, 0.15)
    mean = (slow + fast) / 2
    np.testing.assert_allclose(found, [1, 1 + alone, 1 + mean + slow / 4, 1 + mean], rtol=1e-4)


def test_behind_a_low_pass_nothing_is_counted_before():
    """A period of half a millisecond is no longer than a photoreceptor lags."""
    t, zeros = 1_000 * np.arange(6), np.zeros(6, np.int64)
    found = weights(EventClock((1, 1), 500).weighed(make_events(t, zeros, zeros, np.ones(6, bool))))
    np.testing.assert_allclose(found[2:], 1 + 1 / np.hypot(1, 0.15), rtol=1e-4)


@given(st.integers(0, 1_000), st.integers(100, 3_000))
def test_nothing_is_counted_twice(seed, period):
    """The weights of a run add up to what lies between its events and a part of the slower pace at its end."""
    part = max(1 - 500 / period, 0) / 2
    events = stream(120, seed)
    events["x"], events["y"] = 0, 0
    found = weights(EventClock((1, 1), period).weighed(events)) - 1
    runs = np.split(np.arange(120), np.flatnonzero(np.diff(events["p"].astype(int))) + 1)
    for run in runs:
        since = np.diff(events["t"][run]).astype(np.float32)
        before = np.concatenate([[np.float32(0)], since[:-1]])[: len(since)]
        between, counted = 0.0, 0.0
        for now, last in zip(since, before, strict=True):
            if now <= np.float32(0.95) * np.float32(period):  # noise, which what was counted is left at
                between, counted = between + counted, 0.0
                continue
            between += step_weight(now, last, np.float32(period)) - 1
            counted = 0.0
            if last > np.float32(0.95) * np.float32(period):
                counted = part * min(period / np.hypot(look - period, 0.15 * period) for look in (now, last))
        assert found[run].sum() == pytest.approx(between + counted, abs=2e-3 * len(run))


def test_an_early_event_says_nothing_of_the_pace():
    """It is noise: the next one is weighed as if it had been the first."""
    t = np.array([0, 500, 2_000, 3_500])
    zeros = np.zeros(4, np.int64)
    events = make_events(t, zeros, zeros, np.ones(4, bool))
    found = weights(EventClock((1, 1), 1_000).weighed(events))
    once, twice = 1 + 1 / np.hypot(0.5, 0.2), 1 + 1 / np.hypot(0.5, 0.15)
    np.testing.assert_allclose(found, [1, 1, once, twice + 0.25 / np.hypot(0.5, 0.15)], rtol=1e-4)
