"""The shortest time between events of a pixel, and the refractory periods that it allows."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.calibration.refractory import intervals, possible_periods, shortest_interval
from kalux.datasets import SensorSettings, demo_scene, simulate
from kalux.events import make_events
from kalux.recording import Recording

SIZE = (5, 6)


def test_the_shortest_interval_is_not_that_of_noise():
    """Noise follows an event at any time; with a refractory period of 400 us others do not follow before."""
    sensor = SensorSettings(refractory=400.0, noise_rate=3.0)
    recording = simulate(demo_scene(sensor_size=(90, 120)), sensor).recording()
    assert 400 <= shortest_interval(recording) < 900
    assert shortest_interval(recording, most_events=20_000) >= 400


def test_times_may_be_negative():
    """Of a clock that is set to zero later, as that of the frames may be."""
    t, pixel = np.arange(0, 400_000, 500), np.arange(800) % 4
    made = [make_events(t - shift, pixel, pixel, pixel % 2 == 0) for shift in (0, 10**9)]
    found = [shortest_interval(Recording.from_arrays(events, [], sensor_size=SIZE)) for events in made]
    assert found[0] == found[1] > 0


def alternating(gaps):
    """Events of 100 pixels that follow one another after these times, us."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.permuted(np.tile(gaps, (100, 1)), axis=1), axis=1)
    pixel = np.broadcast_to(np.arange(100)[:, None], t.shape).ravel()
    order = np.argsort(t.ravel(), kind="stable")
    events = make_events(t.ravel()[order], pixel[order] % 10, pixel[order] // 10, np.ones(t.size, bool))
    return Recording.from_arrays(events, [], sensor_size=(10, 10))


SMOOTH = np.arange(500, 4_000, 7)


@pytest.mark.parametrize(
    ("gaps", "pile_up"),
    [
        (SMOOTH, False),
        (np.concatenate([SMOOTH, np.full(100, 503)]), True),
        (np.concatenate([SMOOTH, np.full(100, 900)]), False),
        (np.arange(1, 9).repeat(60) * 500, False),
    ],
    ids=["after a reset", "waiting", "flicker", "coarse times"],
)
def test_events_that_wait_pile_up_at_the_shortest_interval(gaps, pile_up):
    found = intervals(alternating(gaps))
    assert found.pile_up == pile_up
    assert 390 <= found.shortest <= 510


def test_events_that_nothing_follows_have_no_shortest_interval():
    lonely = make_events(np.arange(5), np.arange(5), np.zeros(5, int), np.ones(5, bool))
    assert shortest_interval(Recording.from_arrays(lonely, [], sensor_size=SIZE)) == 0


def test_no_period_is_longer_than_the_shortest_interval_may_be():
    """Which is the lower edge of a bin that ends a quarter higher."""
    assert possible_periods(1_000) == (0, 350, 600, 850, 1_100)
    assert possible_periods(1) == (0, 1)
    assert possible_periods(0) == (0,)
