"""The shortest time between events of a pixel, and counts under several refractory periods at once."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.augmentation.deblur import count_events
from kalux.augmentation.refractory import EventClock
from kalux.calibration.refractory import Counts, possible_periods, shortest_interval
from kalux.datasets import SensorSettings, demo_scene, simulate
from kalux.events import make_events
from kalux.recording import Recording

SIZE = (5, 6)


def stream(count=400, seed=0):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, 30_000, count))
    return make_events(t, rng.integers(0, 6, count), rng.integers(0, 5, count), rng.random(count) < 0.5)


def test_the_shortest_interval_is_not_that_of_noise():
    """Noise follows an event at any time; with a refractory period of 400 us others do not follow before."""
    sensor = SensorSettings(refractory=400.0, noise_rate=3.0)
    recording = simulate(demo_scene(sensor_size=(90, 120)), sensor).recording()
    assert 400 <= shortest_interval(recording) < 900
    assert shortest_interval(recording, most_events=20_000) >= 400


def test_events_that_nothing_follows_have_no_shortest_interval():
    lonely = make_events(np.arange(5), np.arange(5), np.zeros(5, int), np.ones(5, bool))
    assert shortest_interval(Recording.from_arrays(lonely, [], sensor_size=SIZE)) == 0


def test_no_period_is_longer_than_the_shortest_interval():
    assert possible_periods(1_000) == (0, 300, 500, 700, 900, 1_000)
    assert possible_periods(1) == (0, 1)
    assert possible_periods(0) == (0,)


@pytest.mark.parametrize("late", [2_000.0, np.inf])
def test_counts_are_those_of_events_with_weights(late):
    events, periods = stream(), (0, 300, 900)
    counts = Counts(SIZE, periods, late)
    parts = [counts.add(events[a:b]) for a, b in ((0, 150), (150, 400))]
    every, latecomers = (np.sum(values, axis=0) for values in zip(*parts, strict=True))
    for k, period in enumerate(periods):
        expected = count_events(EventClock(SIZE, period).weighed(events), SIZE, weighed=True)
        np.testing.assert_allclose(every[k], expected, atol=1e-2)
    if late == np.inf:
        assert not latecomers.any()
    else:
        assert 0 < latecomers[0].sum() < 400
        assert (latecomers <= every).all()
