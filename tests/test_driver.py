"""Events are pushed as frames need them, whatever chunks they come in."""

from __future__ import annotations

import numpy as np
import pytest

from kalux import PRESETS
from kalux.driver import EventFeed, engine_of
from kalux.settings import altered

from builders import recording

DELAY = 700
TIMES = np.concatenate(list(recording().events()))["t"]
FRAMES = list(recording().frames())


def driven(chunk, monkeypatch, on_events=None):
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", chunk)
    settings = altered(PRESETS["default"], "events", delay=DELAY)
    engine = engine_of(recording(), settings, None, threshold_is_estimate=True)
    return engine, EventFeed(engine, iter(recording().events()), on_events)


@pytest.mark.parametrize("chunk", [1, 7, 1 << 20])
def test_no_more_is_pushed_than_a_frame_needs_and_the_rest_of_a_chunk(chunk, monkeypatch):
    pushed = []
    engine, feed = driven(chunk, monkeypatch, pushed.append)
    for frame in FRAMES:
        engine.push_frame(frame)
        feed.cover(frame.exposure_end)
        assert engine.covers(frame.exposure_end)
        needed = int(np.searchsorted(TIMES, frame.exposure_end + DELAY, "right"))
        assert feed.count(frame.exposure_end) == needed
        # One more event tells that those at the very end are all there.
        assert needed <= sum(pushed) <= needed + chunk


def test_an_end_is_silence_until_the_frame_ends(monkeypatch):
    engine, feed = driven(7, monkeypatch)
    engine.push_frame(FRAMES[0])
    late = int(TIMES[-1]) + 1_000_000
    feed.cover(late)
    assert feed.ended
    assert engine.covers(late)
    assert feed.count(late) == len(TIMES)


def test_a_feed_goes_on_after_the_last_frame(monkeypatch):
    pushed = []
    engine, feed = driven(7, monkeypatch, pushed.append)
    for frame in FRAMES:
        engine.push_frame(frame)
    while not feed.ended:
        feed.push_next()
    assert sum(pushed) == len(TIMES)
