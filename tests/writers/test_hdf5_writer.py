"""kalux's own HDF5: any chunks, and nothing partial is left."""

from __future__ import annotations

import dataclasses
import resource
import signal

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


@pytest.mark.parametrize("call", ["first", "middle", "last"])
def test_an_interrupt_while_hdf5_writes_waits_and_leaves_the_old_file(path, monkeypatch, call):
    """Raised in what HDF5 calls, it would crash the process, or be lost and leave a damaged file."""
    write_kalux(path, frames=small_frames()[:1])
    calls, write = [], writer._Sink.write

    def counting(sink, data):
        calls.append(len(calls))
        return write(sink, data)

    def interrupted(sink, data):
        if next(numbers) == chosen:
            signal.raise_signal(signal.SIGINT)
        return write(sink, data)

    monkeypatch.setattr(writer._Sink, "write", counting)
    write_kalux(path.with_name("other.h5"))
    path.with_name("other.h5").unlink()
    chosen, numbers = {"first": 0, "middle": len(calls) // 2, "last": len(calls) - 1}[call], iter(calls)
    monkeypatch.setattr(writer._Sink, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_kalux(path)
    assert list(path.parent.iterdir()) == [path]
    assert len(list(readers.read(path).frames())) == 1


def test_an_interrupt_waits_for_the_chunk_at_work_only(path, monkeypatch):
    made, interrupts, write = [], [], writer._Sink.write

    def interrupted(sink, data):
        if made and not interrupts:
            interrupts.append(len(made))
            signal.raise_signal(signal.SIGINT)
        return write(sink, data)

    def many():
        for _ in range(10_000):
            made.append(small_events())
            yield made[-1]

    monkeypatch.setattr(writer, "_EVENTS_PER_CHUNK", 500)
    monkeypatch.setattr(writer._Sink, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_kalux(path, events=many())
    assert interrupts == [len(made)]
    assert len(made) < 10_000
    assert list(path.parent.iterdir()) == []


def test_an_interrupt_comes_at_once_while_events_are_made(path):
    def slow():
        yield small_events()
        signal.raise_signal(signal.SIGINT)
        pytest.fail("not interrupted")

    with pytest.raises(KeyboardInterrupt):
        write_kalux(path, events=slow())
    assert list(path.parent.iterdir()) == []


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
