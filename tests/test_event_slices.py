"""Slices of an event stream by time, and the numbers of events of every pixel."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kalux.augmentation.refractory import EventClock
from kalux.compiled import event_words
from kalux.event_slices import (
    all_between,
    between,
    count_chunks,
    count_events,
    events_until,
    first_events,
    in_order,
    thinned,
    whole_row_delays,
    with_delay_of_rows,
)
from kalux.events import make_events

from builders import events, pixel_events, random_stream

moments = st.lists(st.tuples(st.integers(900, 2100), st.booleans()), max_size=12).map(sorted)


@given(moments, st.integers(800, 2200))
def test_slices_add_up(rows, cut):
    array = pixel_events([t for t, _ in rows], [p for _, p in rows])
    parts = [between(array, 800, cut), between(array, cut, 2200)]
    np.testing.assert_array_equal(np.concatenate(parts), between(array, 800, 2200))
    total = count_events(between(array, 800, 2200), (1, 1))
    split = [count_events(part, (1, 1)) for part in parts]
    for polarity in (0, 1):
        np.testing.assert_array_equal(split[0][polarity] + split[1][polarity], total[polarity])


def test_slices_are_open_at_the_start_and_closed_at_the_end():
    array = pixel_events([10, 10, 20, 20, 30], [1, 0, 1, 0, 1])
    assert [events_until(array, t) for t in (9, 10, 19, 20, 30)] == [0, 2, 2, 4, 5]
    assert between(array, 10, 20)["t"].tolist() == [20, 20]
    assert [part["t"].tolist() for part in all_between([array[:3], array[3:4], array[4:]], 10, 25)] == [
        [20],
        [20],
    ]


def test_the_first_events_are_read_no_further_than_they_go():
    array = pixel_events([10, 20, 30, 40], [1, 0, 1, 0])

    def chunks():
        yield from (array[:0], array[:3], array[3:])
        raise AssertionError("one chunk too many")

    assert [part["t"].tolist() for part in first_events(chunks(), 2)] == [[10, 20]]
    assert [part["t"].tolist() for part in first_events(chunks(), 4)] == [[10, 20, 30], [40]]
    assert [len(part) for part in first_events([array[:3], array[3:]], None)] == [3, 1]


def test_counts_by_polarity():
    on, off = count_events(events((1, 0, 0, 1), (2, 2, 1, 0), (3, 2, 1, 0), (4, 2, 1, 1)), (2, 3))
    np.testing.assert_array_equal(on, [[1, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(off, [[0, 0, 0], [0, 0, 2]])


def test_chunks_count_together_and_weights_only_where_they_are_asked_for():
    stream = random_stream(5)
    weighed = EventClock(stream.sensor_size, 3_000).weighed(stream.events)
    whole, chunks = [weighed], [weighed[:100], weighed[100:]]
    ones = count_events(stream.events, stream.sensor_size)
    for counted, expected in zip(count_chunks(chunks, stream.sensor_size, weighed=False), ones, strict=True):
        np.testing.assert_array_equal(counted, expected)
    sums = count_chunks(chunks, stream.sensor_size, weighed=True)
    for counted, expected in zip(sums, count_chunks(whole, stream.sensor_size, weighed=True), strict=True):
        np.testing.assert_allclose(counted, expected, rtol=1e-6)
    assert sum(map(np.sum, sums)) > 1.1 * sum(map(np.sum, ones))


@given(st.integers(0, 1000), st.integers(1, 5))
def test_thinned_events_are_those_of_every_nth_pixel(seed, step):
    stream = random_stream(seed).events
    kept = stream[(stream["y"] % step == 0) & (stream["x"] % step == 0)]
    found = thinned(stream, step)
    for name in ("t", "p"):
        np.testing.assert_array_equal(found[name], kept[name])
    for name in ("x", "y"):
        np.testing.assert_array_equal(found[name], kept[name] // step)


def test_rows_are_late_by_their_distance_from_the_middle():
    np.testing.assert_array_equal(whole_row_delays(4, 10.0), [-15, -5, 5, 15])
    np.testing.assert_array_equal(whole_row_delays(3, -7.0), [7, 0, -7])


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(0, 2), st.booleans()), min_size=1, max_size=20))
def test_events_in_the_time_of_their_rows(stream):
    """Sorted, those of one time stay as they were; what else an event carries stays with it."""
    t, y, p = zip(*sorted(stream, key=lambda event: event[0]), strict=True)
    events = make_events(t, np.zeros(len(t), np.int64), y, p)
    words = event_words(events)
    words[:, 1] = (words[:, 1] & ((1 << 40) - 1)) | np.arange(len(t)) << 40  # where weights are
    delays = whole_row_delays(3, 20.0)
    found = in_order(with_delay_of_rows(events, delays))
    order = np.argsort(np.array(t) - delays[list(y)], kind="stable")
    np.testing.assert_array_equal(found["t"], (np.array(t) - delays[list(y)])[order])
    np.testing.assert_array_equal(found["y"], np.array(y)[order])
    np.testing.assert_array_equal(event_words(found)[:, 1] >> 40, order)
    assert events["t"].tolist() == list(t)
