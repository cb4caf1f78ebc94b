"""Recordings on disk: read backward they are the same, and a full disk is told."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kalux import Recording
from kalux.augmentation.refractory import EventClock
from kalux.compiled import event_words
from kalux.errors import OutputError
from kalux.events import make_events
from kalux.spill import Spill, temporary_folder
from mirrored import SIZE, mirrored, recording


def test_the_spilled_recording_is_the_recording_reversed(tmp_path):
    source, expected = recording(5), mirrored(recording(5))
    spill = Spill(source, tmp_path)
    events = [spill.reversed_events(first) for first in range(0, spill.count, 10**6)]
    np.testing.assert_array_equal(np.concatenate(events), np.concatenate(list(expected.events())))
    for index, frame in enumerate(expected.frames()):
        found = spill.reversed_frame(index)
        assert (found.exposure_start, found.exposure_end) == (frame.exposure_start, frame.exposure_end)
        np.testing.assert_array_equal(found.image, frame.image)
    assert len(spill.reversed_events(spill.count)) == 0


def test_weights_of_spilled_events_are_those_of_time_going_forward(tmp_path):
    source = recording(5)
    spill = Spill(source, tmp_path, 2_000)
    backward = [event_words(spill.reversed_events(first)) for first in range(0, spill.count, 10**6)]
    clock = EventClock(source.sensor_size, 2_000)
    forward = np.concatenate([event_words(clock.weighed(chunk)) for chunk in source.events()])
    weights = forward[:, 1] >> 40
    assert len(np.unique(weights)) > 3
    np.testing.assert_array_equal(np.concatenate(backward)[::-1, 1] >> 40, weights)


def test_the_spill_keeps_masks(tmp_path):
    mask = np.arange(48).reshape(SIZE) % 3 == 0
    whole = recording()
    frames = [
        dataclasses.replace(frame, valid=mask if i == 1 else None) for i, frame in enumerate(whole.frames())
    ]
    spill = Spill(
        Recording.from_arrays(make_events(*[np.empty(0, int)] * 4), frames, sensor_size=SIZE), tmp_path
    )
    found = [spill.reversed_frame(i).valid for i in range(len(spill))]
    assert [valid is None for valid in found] == [True, True, True, False, True]
    np.testing.assert_array_equal(found[3], mask)


def test_a_full_disk_is_one_line(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(OutputError, match="backward pass: No space left"):
        Spill(recording(), tmp_path)


def test_without_a_folder_for_temporary_files_one_line_says_what_to_do(monkeypatch):
    def none(**options):
        raise FileNotFoundError(2, "No usable temporary directory found in ['/tmp']")

    monkeypatch.setattr("tempfile.TemporaryDirectory", none)
    with (
        pytest.raises(OutputError, match=r"No usable temporary directory .*; set TMPDIR to"),
        temporary_folder(),
    ):
        pass


def test_the_folder_is_removed():
    with temporary_folder() as folder:
        (folder / "file").touch()
    assert not folder.exists()
