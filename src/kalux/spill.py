"""Recordings on disk while both ways in time are gone: there they can be read backward, whatever their format."""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.refractory import EventClock
from kalux.compiled import event_words
from kalux.errors import OutputError
from kalux.event_slices import between
from kalux.events import EVENT_DTYPE, EventArray
from kalux.frames import Frame
from kalux.recording import Recording

_BLOCK_EVENTS: Final = 1 << 18
"""Events that are read at a time, 4 MB."""


@contextlib.contextmanager
def spilling(folder: Path) -> Iterator[None]:
    """Writes to ``folder``; what goes wrong is told in one line.

    Raises
    ------
    OutputError
        The disk is full or the folder cannot be written.
    """
    try:
        yield
    except OSError as error:
        why = error.strerror or "no space is left on the disk"  # NumPy reports a full disk without saying so
        raise OutputError(
            f"{folder}: the recording cannot be spilled for the backward pass: {why}; set TMPDIR to a folder with more"
        ) from error


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """An empty folder for a spill, removed at the end.

    Raises
    ------
    OutputError
        There is no folder for temporary files that can be written.
    """
    try:
        folder = tempfile.TemporaryDirectory(prefix="kalux-")
    except OSError as error:
        raise OutputError(
            f"no folder for the backward pass can be made: {error.strerror or error}; set TMPDIR to a folder that can "
            "be written"
        ) from error
    with folder as name:
        yield Path(name)


class Spill:
    """A recording on disk, in a form that can be read backward: events in one file, every frame in one.

    Parameters
    ----------
    recording
        Copied when the spill is made.
    refractory_period
        us; the events are weighed as time goes forward (`kalux.augmentation.refractory`).
    folder
        An existing folder, the caller's to remove.
    on_events
        Told the number of events of every chunk that is copied.

    Raises
    ------
    OutputError
        The disk is full or the folder cannot be written.
    """

    def __init__(
        self,
        recording: Recording,
        folder: Path,
        refractory_period: float = 0.0,
        on_events: Callable[[int], None] | None = None,
    ) -> None:
        self._folder = folder
        self._events = folder / "events.bin"
        self._frames: list[Frame] = []  # without their pixels
        self.sensor_size = recording.sensor_size
        self.count = 0
        with spilling(folder):
            self._write(recording, refractory_period, on_events)

    def _write(
        self, recording: Recording, refractory_period: float, on_events: Callable[[int], None] | None
    ) -> None:
        with self._events.open("wb") as file:
            clock = EventClock(recording.sensor_size, refractory_period)
            for chunk in recording.events():
                event_words(clock.weighed(chunk)).tofile(file)
                if on_events is not None:
                    on_events(len(chunk))
                self.count += len(chunk)
        for index, frame in enumerate(recording.frames()):
            np.save(self._frame_path(index), frame.image)
            if frame.valid is not None:
                np.save(self._mask_path(index), frame.valid)
            none = np.empty(0, np.bool_)
            valid = None if frame.valid is None else none
            self._frames.append(dataclasses.replace(frame, image=none, valid=valid))

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._frames)

    @property
    def start(self) -> int:
        """Start of the first exposure, us."""
        return self._frames[0].exposure_start

    @property
    def end(self) -> int:
        """End of the last exposure, us: before it, reversed, the backward pass knows nothing."""
        return self._frames[-1].exposure_end

    def reversed_frame(self, index: int) -> Frame:
        """The frame ``index`` of the reversed recording."""
        forward = len(self) - 1 - index
        frame = self._frames[forward]
        return dataclasses.replace(
            frame,
            image=np.load(self._frame_path(forward)),
            exposure_start=-frame.exposure_end,
            exposure_end=-frame.exposure_start,
            valid=None if frame.valid is None else np.load(self._mask_path(forward)),
        )

    def reversed_events(self, first: int) -> EventArray:
        """A block of the reversed recording's events, from its event ``first`` on; empty at the end."""
        last = min(first + _BLOCK_EVENTS, self.count)
        words = np.fromfile(
            self._events,
            np.int64,
            count=2 * (last - first),
            offset=(self.count - last) * EVENT_DTYPE.itemsize,
        ).reshape(-1, 2)
        block: EventArray = words[::-1].copy().reshape(-1).view(EVENT_DTYPE)  # as words, with their weights
        block["t"] = -block["t"]
        block["p"] = ~block["p"]
        return block

    def middle(self, index: int) -> int:
        """The middle of a frame's exposure, us."""
        return self._frames[index].middle

    def events_between(self, start: int, end: int, without: NDArray[np.bool_] | None) -> Iterator[EventArray]:
        """The events with ``start`` < t <= ``end`` (us), in blocks, without those of some pixels, (H, W) bool.

        They carry their weights.
        """
        if self.count == 0:
            return
        inside = between(np.memmap(self._events, EVENT_DTYPE, "r"), start, end)
        for first in range(0, len(inside), _BLOCK_EVENTS):
            events = inside[first : first + _BLOCK_EVENTS]
            words = event_words(events).copy()  # NumPy does not copy what lies between the fields
            if without is not None:
                words = words[~without[events["y"], events["x"]]]
            yield words.reshape(-1).view(EVENT_DTYPE)

    def save_newest_events(self, index: int, newest: NDArray[np.int64], surety: NDArray[np.int8]) -> None:
        """Keep the pixels' newest events at the middle of a frame, (H, W) as in `kalux.augmentation.trail.Followed`.

        Raises
        ------
        OutputError
            The disk is full.
        """
        with spilling(self._folder):
            np.savez(self._newest_path(index), newest=newest, surety=surety)

    def newest_events(self, index: int) -> tuple[NDArray[np.int64], NDArray[np.int8]]:
        """What `save_newest_events` has kept of a frame."""
        with np.load(self._newest_path(index)) as kept:
            return kept["newest"], kept["surety"]

    def _newest_path(self, index: int) -> Path:
        return self._folder / f"newest_{index:06d}.npz"

    def _frame_path(self, index: int) -> Path:
        return self._folder / f"frame_{index:06d}.npy"

    def _mask_path(self, index: int) -> Path:
        return self._folder / f"valid_{index:06d}.npy"
