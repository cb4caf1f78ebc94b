"""Times in which events are missing are found, and no others; what they hide is told by the events around."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.augmentation.bridge import MASKED, UNMEASURED, Latent
from kalux.augmentation.lost import (
    Loss,
    add_lost_change,
    loss_between,
    lost_change,
    lost_time,
    unheard_change,
)
from kalux.events import make_events

START, END = 1_000_000, 1_040_000


def events_at(t):
    t = np.sort(np.asarray(t, np.int64))
    return make_events(t, np.zeros_like(t), np.zeros_like(t), np.zeros_like(t))


def any_time(number, seed=0):
    return np.random.default_rng(seed).integers(START + 1, END + 1, number)


def without(t, begin, end):
    return t[(t <= begin) | (t > end)]


@given(st.integers(0, 2**32 - 1), st.integers(0, 5_000))
def test_nothing_is_missing_of_events_at_random(seed, number):
    assert lost_time([events_at(any_time(number, seed))], START, END) == 0


@given(st.integers(0, 2**32 - 1), st.integers(START, END - 6_000), st.integers(6_000, 25_000))
def test_what_is_missing_is_found_wherever_it_begins(seed, begin, time):
    """Also before the first event, and after the last; to a few of the mean waits of 13 us."""
    end = min(begin + time, END)
    found = lost_time([events_at(without(any_time(3_000, seed), begin, end))], START, END)
    assert found == pytest.approx(end - begin, abs=200)


def test_two_losses_add_up():
    t = without(without(any_time(5_000), START + 3_000, START + 8_000), START + 20_000, START + 30_000)
    assert lost_time([events_at(t)], START, END) == pytest.approx(15_000, abs=100)


@given(st.lists(st.integers(0, 2_000), max_size=4))
def test_it_does_not_matter_how_events_are_cut_into_chunks(cuts):
    events = events_at(without(any_time(2_000), START + 9_000, START + 17_000))
    chunks = [part for part in np.split(events, sorted(min(cut, len(events)) for cut in cuts)) if len(part)]
    assert lost_time(chunks, START, END) == lost_time([events], START, END) > 0


def test_stamps_that_come_in_bunches_are_no_loss():
    """As of simulators that make all events of a frame at once; a bunch that is left out is."""
    bunches = np.arange(START, END, 2_500)
    assert lost_time([events_at(np.repeat(bunches, 500))], START, END) == 0
    left = without(np.arange(START, END, 500), START + 10_000, START + 20_000)
    assert lost_time([events_at(np.repeat(left, 100))], START, END) == 10_500


@given(st.integers(1, 60), st.integers(1, 5))
def test_there_is_room_for_all_waits_of_any_time(duration, every):
    """However short it is: an event of every microsecond or so waits for a twentieth of 20 us."""
    t = np.arange(START + 1, START + duration + 1, every)
    assert lost_time([events_at(t)], START, START + duration) == 0


def test_a_flash_is_no_loss():
    """All events of 2 ms, and nothing before and after."""
    flash = np.random.default_rng(1).integers(START + 19_000, START + 21_000, 5_000)
    assert lost_time([events_at(flash)], START, END) == 0


def test_few_events_tell_nothing():
    assert lost_time([], START, END) == 0
    assert lost_time([events_at(without(any_time(100), START, START + 20_000))], START, END) == 0


def test_frames_have_to_tell_where_hardly_an_event_comes():
    few = events_at(any_time(100)[:3])
    flash = events_at(np.random.default_rng(1).integers(START + 19_000, START + 21_000, 5_000))
    for events in ([], [few], [flash]):
        assert loss_between(events, START, END) == Loss(0, unheard=True)
    assert not loss_between([events_at(any_time(3_000))], START, END).unheard
    assert not loss_between([events_at(without(any_time(3_000), START, START + 30_000))], START, END).unheard


def shown(value, variance=1e-4):
    return Latent(np.asarray(value, np.float32), np.full_like(value, variance, np.float32))


def test_what_frames_show_without_events_is_what_is_missing():
    """Less their noise, around each pixel, and less what the events that come tell."""
    rng = np.random.default_rng(2)
    first = np.zeros((40, 60), np.float32)
    change = np.where(np.arange(60) < 30, 0.5, 0.05) * rng.choice([-1, 1], (40, 60))
    noise = rng.normal(0.0, 0.1, (40, 60))
    told = np.zeros((40, 60), np.float32)
    variance = unheard_change(shown(first, 0.005), shown(first + change + noise, 0.005), told, 0.04)
    assert variance is not None
    np.testing.assert_allclose(variance[:, :20], 0.25, rtol=0.25)
    assert variance[:, 40:].mean() == pytest.approx(0.0025, abs=0.001)
    assert variance.min() >= 0
    told = change.astype(np.float32)
    assert unheard_change(shown(first, 0.005), shown(first + change, 0.005), told, 0.04) is None


@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-6, 1e-4, 0.01, 1.0]))
def test_nothing_is_missing_where_frames_differ_by_noise(seed, variance):
    """Nor where they change by less than two thresholds, or where a few pixels are broken."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(0.0, np.sqrt(2 * variance), (40, 60))
    noise.ravel()[:10] = 3.0
    told = np.zeros((40, 60), np.float32)
    assert unheard_change(shown(np.zeros((40, 60)), variance), shown(noise, variance), told, 0.04) is None
    slow = rng.uniform(-0.39, 0.39, (40, 60))
    assert unheard_change(shown(np.zeros((40, 60)), 1e-6), shown(slow, 1e-6), told, 0.04) is None


def test_where_no_frame_measures_the_rest_of_the_image_tells():
    change = np.full((40, 60), 0.8, np.float32)
    clipped = np.full((40, 60), 1e-4, np.float32)
    clipped[:, 30:] = UNMEASURED
    first, second = Latent(0 * change, np.full_like(clipped, 1e-4)), Latent(change, clipped)
    variance = unheard_change(first, second, 0 * change, 0.04)
    np.testing.assert_allclose(variance, 0.64 - 2e-4, rtol=1e-5)


def test_what_is_lost_goes_with_the_time_and_with_what_events_around_tell():
    told = np.zeros((30, 40), np.float32)
    told[10, 10] = 0.9
    variance = lost_change(told, 10_000, 40_000)
    assert variance[10, 10] == pytest.approx(0.9**2 / 81 / 3, rel=1e-5)
    assert variance[14, 14] == pytest.approx(variance[10, 10], rel=1e-4)
    assert variance[20, 20] == pytest.approx(0, abs=1e-7)
    np.testing.assert_allclose(lost_change(told, 20_000, 40_000), 3 * variance, rtol=1e-5)


def test_p_grows_by_what_frames_do_not_tell_of_the_loss():
    """Of pixels that both measure little, of those that one clips or masks by all of it."""
    grown = np.full((1, 4), 0.001)
    first = Latent(np.zeros((1, 4)), np.array([[1e-4, 1.0, UNMEASURED, 1e-4]]))
    second = Latent(np.zeros((1, 4)), np.array([[1e-4, 1.0, 1e-4, MASKED]]))
    add_lost_change(grown, first, second, np.full((1, 4), 0.3), np.full((1, 4), 0.25))
    part = 2e-4 / 0.3002, 2.0 / 2.3
    np.testing.assert_allclose(
        grown[0] - 0.001, [0.3 * part[0] ** 2, 0.3 * part[1] ** 2, 0.25, 0.25], rtol=1e-6
    )
