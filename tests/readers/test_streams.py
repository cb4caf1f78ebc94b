"""Streams of readers: packets are joined and cut, late frames put in order, and what is cut short is refused."""

from __future__ import annotations

import numpy as np
import pytest
import zstandard

from kalux.readers import streams
from kalux.readers.streams import in_order, rechunk, unzstd

from builders import frame, random_stream


def test_packets_are_joined_to_chunks_and_long_ones_cut(monkeypatch):
    monkeypatch.setattr(streams, "CHUNK_EVENTS", 40)
    events = random_stream(0).events[:200]
    packets = [events[:0], events[:30], events[30:35], events[35:60], events[60:190], events[190:]]
    chunks = list(rechunk(packets))
    assert max(map(len, chunks)) <= 40
    assert len(chunks) < 10
    assert np.array_equal(np.concatenate(chunks), events)
    assert not list(rechunk([events[:0]]))


def test_frames_that_are_eight_places_late_are_put_in_order():
    frames = [frame(100, t, t + 5) for t in (90, 10, 20, 30, 40, 50, 60, 70, 80, 100)]
    assert [shot.exposure_start for shot in in_order(frames)] == [*range(10, 101, 10)]
    late = [*frames[1:], frame(100, 5, 6)]
    assert next(in_order(late)).exposure_start == 10


def test_zstandard_that_is_cut_short_is_refused():
    data = np.random.default_rng(0).bytes(100_000)
    packed = zstandard.ZstdCompressor().compress(data)
    assert unzstd(packed) == data
    with pytest.raises(EOFError):
        unzstd(packed[:-1])
