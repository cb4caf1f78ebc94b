"""The events that the engine holds: nothing lost, nothing twice, nothing kept."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.augmentation.refractory import EventClock
from kalux.compiled import event_words
from kalux.events import EVENT_DTYPE
from kalux.filters import buffer
from kalux.filters.buffer import EventBuffer

from builders import events

SIZE = (4, 5)


def stream(count, seed=0, span=1000):
    rng = np.random.default_rng(seed)
    out = np.zeros(count, EVENT_DTYPE)
    out["t"] = np.sort(rng.integers(0, span, count))
    out["x"], out["y"] = rng.integers(0, SIZE[1], count), rng.integers(0, SIZE[0], count)
    out["p"] = rng.random(count) < 0.5
    return out


def joined(chunks):
    return np.concatenate([np.empty(0, EVENT_DTYPE), *chunks])


@given(
    cuts=st.lists(st.integers(0, 300), max_size=10).map(sorted),
    drops=st.lists(st.integers(-10, 1010), max_size=10),
    block=st.sampled_from([1, 7, 64, 1000]),
    data=st.data(),
)
def test_against_one_array(cuts, drops, block, data):
    """Appended in any pieces, dropped in between: what is held is what an array would hold."""
    whole = stream(300)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(buffer, "_BLOCK", block)
        patch.setattr(buffer, "_SPARE", block)
        held, dropped = EventBuffer(EventClock(SIZE, 0)), 0
        for first, last in zip([0, *cuts], [*cuts, 300], strict=True):
            assert held.append(whole[first:last], SIZE, earliest=None, delay=0)
            if drops:
                until = drops.pop()
                held.drop(until)
                dropped = max(dropped, min(int(np.searchsorted(whole["t"], until, "right")), last))
            np.testing.assert_array_equal(joined(held.chunks), whole[dropped:last])
            assert len(held) == last - dropped
            assert held.first == dropped
    t, number = data.draw(st.integers(-5, 1005)), data.draw(st.integers(0, 300))
    end = max(int(np.searchsorted(whole["t"], t, "right")), dropped)
    assert held.number(t) == end
    np.testing.assert_array_equal(joined(held.after(number, t)), whole[max(number, dropped) : end])
    np.testing.assert_array_equal(
        joined(pickle.loads(pickle.dumps(held)).after(number, t)), joined(held.after(number, t))
    )


def test_times_are_moved_by_the_delay_and_the_callers_events_are_not():
    held, pushed = EventBuffer(EventClock(SIZE, 0)), events((10, 0, 0, 1), (20, 4, 3, 0))
    assert held.append(pushed, SIZE, earliest=10, delay=7)
    assert held.chunks[0]["t"].tolist() == [3, 13]
    assert pushed["t"].tolist() == [10, 20]
    pushed["x"] = 1
    assert held.chunks[0]["x"].tolist() == [0, 4]


@pytest.mark.parametrize(
    "rows",
    [
        [(9, 0, 0, 1)],
        [(10, 0, 0, 1), (12, 0, 0, 1), (11, 0, 0, 1)],
        [(10, 5, 0, 1)],
        [(10, 0, 4, 1), (11, 0, 0, 1)],
    ],
    ids=["too early", "unsorted", "right of the sensor", "below it"],
)
def test_what_is_refused_leaves_nothing_behind(rows):
    held = EventBuffer(EventClock(SIZE, 0))
    assert held.append(events((10, 1, 1, 1)), SIZE, earliest=None, delay=0)
    assert not held.append(events(*rows), SIZE, earliest=10, delay=0)
    assert len(held) == 1
    assert held.append(events((10, 2, 2, 0)), SIZE, earliest=10, delay=0)
    assert joined(held.chunks)["x"].tolist() == [1, 2]


def test_single_events_share_memory():
    held = EventBuffer(EventClock(SIZE, 0))
    for t in range(1000):
        held.append(events((t, 0, 0, 1)), SIZE, earliest=None, delay=0)
    assert len(held.chunks) == 1


def test_a_small_rest_of_a_large_block_is_copied_out_of_it():
    held, many = EventBuffer(EventClock(SIZE, 0)), np.zeros(3 << 20, EVENT_DTYPE)
    many["t"] = np.arange(len(many))
    held.append(many, SIZE, earliest=None, delay=0)
    held.drop(len(many) - 3)
    assert len(held) == 2
    assert held.chunks[0].base is None or held.chunks[0].base.nbytes < 1000
    assert held.number(len(many)) == len(many)


def words(chunks):
    return np.concatenate([np.empty((0, 2), np.int64), *map(event_words, chunks)])


@given(cuts=st.lists(st.integers(0, 300), max_size=10).map(sorted), until=st.integers(-10, 1010))
def test_weights_are_those_of_the_whole_stream_and_stay(cuts, until):
    """In any pieces; after dropping, which may copy what is left, after pickling, and as ``weighed`` events again."""
    whole = stream(300)
    weighed = EventClock(SIZE, 20).weighed(whole)
    assert len(np.unique(event_words(weighed)[:, 1] >> 40)) > 5
    held, again = EventBuffer(EventClock(SIZE, 20)), EventBuffer(EventClock(SIZE, 20))
    for first, last in zip([0, *cuts], [*cuts, 300], strict=True):
        assert held.append(whole[first:last], SIZE, earliest=None, delay=0)
        assert again.append(weighed[first:last], SIZE, earliest=None, delay=0, weighed=True)
    np.testing.assert_array_equal(words(held.chunks), event_words(weighed))
    for either in (held, again):
        either.drop(until)
        expected = event_words(weighed)[weighed["t"] > until]
        np.testing.assert_array_equal(words(either.chunks), expected)
        np.testing.assert_array_equal(words(pickle.loads(pickle.dumps(either)).chunks), expected)
