"""A region of interest: which pixels may have events."""

from __future__ import annotations

import numpy as np

from kalux import EVENT_DTYPE, Recording
from kalux.calibration.region import Region, event_region
from kalux.events import make_events

SIZE = (60, 80)


def events_in(rows, columns, count, seed=0):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, 10**6, count))
    return make_events(
        t, rng.integers(*columns, count), rng.integers(*rows, count), rng.integers(0, 2, count)
    )


def test_a_region_is_where_all_events_lie():
    first, second = events_in((10, 30), (5, 60), 5_000), events_in((20, 50), (5, 60), 5_000)
    joined = Region.of(first).joined(Region.of(second))
    assert joined == (10, 50, 5, 60, 10_000)
    inside = event_region(Recording.from_arrays(first, [], sensor_size=SIZE))
    expected = np.zeros(SIZE, np.bool_)
    expected[10:30, 5:60] = True
    np.testing.assert_array_equal(inside, expected)


def test_rows_without_one_of_few_events_may_have_some():
    """Of a hundred events over all pixels the first rows may have none by chance."""
    few = events_in((1, 60), (2, 79), 100)
    assert event_region(Recording.from_arrays(few, [], sensor_size=SIZE)).all()
    assert event_region(Recording.from_arrays(np.empty(0, EVENT_DTYPE), [], sensor_size=SIZE)).all()
