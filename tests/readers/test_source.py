"""Errors of reading: damage, files that the system refuses, and too little memory are told apart."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.errors import FormatError, InputError
from kalux.events import make_events
from kalux.readers.source import SeekableEvents, changed, events_since, reading

FILE = Path("night.h5")


@pytest.mark.parametrize("error", [ValueError("truncated\nfile"), OSError("unable to open")])
def test_damage_is_told_on_one_line(error):
    told = r"night.h5: damaged or incomplete \((truncated f|unable to open)"
    with pytest.raises(FormatError, match=told), reading(FILE, ValueError):
        raise error


def test_what_the_system_refuses_is_no_damage():
    told = "night.h5: cannot be read: Permission denied"
    with pytest.raises(InputError, match=told) as caught, reading(FILE, ValueError):
        raise PermissionError(errno.EACCES, "")
    assert not isinstance(caught.value, FormatError)


def test_too_little_memory_is_told_as_it_is():
    """Where damage can ask for too much, too: an intact file may need more than `ulimit -v` leaves."""
    with (
        pytest.raises(
            FormatError, match=r"needs more memory than there is \(Unable to allocate .*allow more"
        ),
        reading(FILE, MemoryError),
    ):
        np.empty(1 << 60, np.uint8)


def test_other_errors_are_left_alone():
    with pytest.raises(KeyError), reading(FILE, ValueError):
        raise KeyError


@given(
    st.lists(st.integers(0, 30), max_size=40), st.lists(st.integers(0, 40), max_size=6), st.integers(-1, 32)
)
def test_events_since_a_time_are_those_of_all_from_then_on(times, cuts, t):
    """Of a source that must be read from its beginning: chunks that end before are left out."""
    times = np.sort(np.array(times, np.int64))
    events = make_events(times, np.zeros_like(times), np.zeros_like(times), np.zeros_like(times))
    chunks = np.split(events, sorted(min(cut, len(events)) for cut in cuts))
    since = [*events_since(lambda: iter(chunks), t)]
    left_out, read = (
        np.concatenate([events[:0], *part]) for part in (chunks[: len(chunks) - len(since)], since)
    )
    assert np.array_equal(np.concatenate([left_out, read]), events)
    assert (left_out["t"] < t).all()
    assert not since or since[0]["t"][-1] >= t


def test_a_change_of_chunks_leaves_events_seekable():
    events = make_events([1, 2, 3], [0, 0, 0], [4, 5, 6], [0, 0, 0])

    def raised(chunks):
        for chunk in chunks:
            higher = chunk.copy()
            higher["y"] += 1
            yield higher

    seekable = SeekableEvents(lambda: iter([events]), lambda t: iter([events[events["t"] >= t]]))
    for before, is_seekable in ((seekable, True), (seekable.whole, False)):
        made = changed(before, raised)
        assert isinstance(made, SeekableEvents) == is_seekable
        assert [[*chunk["y"]] for chunk in made()] == [[5, 6, 7]]
        assert next(events_since(made, 3))["y"][-1] == 7
