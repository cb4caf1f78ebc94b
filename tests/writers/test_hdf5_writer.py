"""kalux's own HDF5: any chunks, and nothing partial is left."""

from __future__ import annotations

import dataclasses
import resource

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kalux import readers
from kalux.errors import FrameError, OutputError
from kalux.frames import Frame
from kalux.writers import hdf5 as writer
from recordings import (
    all_events,
    small_events,
    small_frames,
    write_kalux,
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "recording.h5"


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.integers(0, 300), max_size=6))
def test_any_chunks_give_the_same_events(path, monkeypatch, lengths):
    monkeypatch.setattr(writer, "_EVENTS_PER_CHUNK", 128)
    events = small_events(sum(lengths))
    parts = np.split(events, np.cumsum(lengths))
    write_kalux(path, events=parts, ground_truth=None)
    assert np.array_equal(all_events(readers.read(path)), events)


def test_frames_must_be_alike(path):
    frames = small_frames()
    frames[2] = Frame(frames[2].image.astype(np.uint16), frames[2].exposure_start, frames[2].exposure_end)
    with pytest.raises(FrameError, match="frame 2 has another size, dtype"):
        write_kalux(path, frames=frames)
    assert list(path.parent.iterdir()) == []


def test_gains_come_back(path):
    frames = [
        dataclasses.replace(f, gain=gain)
        for f, gain in zip(small_frames(), (1.0, 2.0, 0.5, 1.0), strict=True)
    ]
    write_kalux(path, frames=frames)
    assert [f.gain for f in readers.read(path).frames()] == [1.0, 2.0, 0.5, 1.0]


@pytest.mark.parametrize("kind", [KeyboardInterrupt, RuntimeError])
def test_an_interruption_leaves_the_old_file(path, kind):
    def interrupted():
        yield small_events()
        raise kind

    write_kalux(path)
    with pytest.raises(kind):
        write_kalux(path, events=interrupted())
    assert list(path.parent.iterdir()) == [path]
    assert readers.read(path).count_events() == 500


def test_unwritable(path):
    with pytest.raises(OutputError, match="No such file or directory"):
        write_kalux(path / "below" / "recording.h5")
    path.mkdir()
    with pytest.raises(OutputError, match="Is a directory"):
        write_kalux(path)
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("room", [0, 3_000, 20_000])
def test_a_full_disk_is_told(path, room):
    # HDF5 itself crashes when a write fails, so kalux keeps the failure from it.
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
    try:
        with pytest.raises(OutputError, match="the file would be larger than allowed"):
            write_kalux(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(path.parent.iterdir()) == []
