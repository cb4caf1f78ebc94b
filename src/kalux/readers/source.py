"""What a reader returns: a description of the recording, and ways to stream it."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from itertools import dropwhile
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError, InputError, KaluxError
from kalux.events import EventArray
from kalux.frames import Frame, GroundTruth, Mosaic
from kalux.wording import one_line

CHUNK_EVENTS: Final = 1 << 19
"""Events in a chunk, at most, where a format leaves the choice to the reader: 8 MiB, of which threads hold a few."""

TRIGGER_DTYPE: Final = np.dtype([("t", "<i8"), ("id", "u1"), ("rising", "?")], align=True)
"""Dtype of an edge on a camera's trigger input: ``t`` int64 microseconds, ``id`` of the input, ``rising``."""

TriggerArray = NDArray[np.void]
"""A 1-D array of `TRIGGER_DTYPE`, sorted by ``t``."""


class Lost(NamedTuple):
    """How many ``packets`` of events a recording lacks, and the time of the first that came after one, us."""

    packets: int
    first: int


@dataclass(frozen=True)
class SeekableEvents:
    """For `Source.events`: events that need not be read from the first one on.

    Attributes
    ----------
    whole
        Called for all of them, as `Source.events`.
    since
        Called with a time, us: chunks with all events that are not before it, in order; some before it may come first.
    """

    whole: Callable[[], Iterator[EventArray]]
    since: Callable[[int], Iterator[EventArray]]

    def __call__(self) -> Iterator[EventArray]:
        return self.whole()


def events_since(events: Callable[[], Iterator[EventArray]], t: int) -> Iterator[EventArray]:
    """As `SeekableEvents.since`, of any `Source.events`: what is not seekable is read from its beginning."""
    if isinstance(events, SeekableEvents):
        return events.since(t)
    return dropwhile(lambda chunk: not len(chunk) or chunk["t"][-1] < t, events())


def changed(
    events: Callable[[], Iterator[EventArray]],
    change: Callable[[Iterator[EventArray]], Iterator[EventArray]],
) -> Callable[[], Iterator[EventArray]]:
    """The events with a ``change`` to their chunks that leaves times and order; seekable if they were."""
    if isinstance(events, SeekableEvents):
        return SeekableEvents(lambda: change(events.whole()), lambda t: change(events.since(t)))
    return lambda: change(events())


@dataclass(frozen=True, kw_only=True)
class Source:
    """A recording as a reader found it, before any check of its contents.

    Attributes
    ----------
    path
        The file or folder.
    format
        Short name of the format, e.g. ``"aedat4"``.
    sensor_size
        (height, width), pixels.
    events
        Called for a fresh iterator over time-ordered, bounded chunks of `EVENT_DTYPE`; `SeekableEvents` where a later
        part can be read without what is before it.
    count_events, count_frames
        Number of events and frames; may read through the file.
    frames
        Called for a fresh iterator over frames; by default there are none. Where ``exposure_known`` is False, start and
        end of the exposure both hold the frame's stamp.
    exposure_known
        Whether the recording stores the exposure times of its frames.
    contrast_threshold
        (on, off) thresholds in log intensity, both positive, if the recording states them.
    inverse_covariance
        (256,) the released datasets' ``f_Q``: 1 / R_bar for each 8-bit value, 1/s; None if absent.
    ground_truth
        Called for the reference images; None if there are none.
    response
        The frame camera's response, named as in `kalux.settings.CameraSettings`, if the recording states it.
    triggers
        Called for a fresh iterator over bounded chunks of `TRIGGER_DTYPE`; None where the format has none.
    missing
        What the recording lacks, one sentence each, for the user.
    sensor_size_known
        Whether the recording states its sensor size; otherwise it is one that holds all events.
    mosaic
        The Bayer pattern of the sensor, if the recording states one. Frames are given as stored all the same: a mosaic,
        or RGB that was made of it.
    rows_from_below
        Whether the file counts rows from the bottom: events of a sensor that turns out to be taller than
        ``sensor_size`` lie as many rows lower (`on_sensor`).
    lost
        Called with two times, us: the packets of events that their numbers show to be missing before those from one to
        the other, or None; reads through them. None where the format has no such numbers.
    of_lossy_video
        Whether the frames are pictures of a video whose codec does not keep them as they were.
    """

    path: Path
    format: str
    sensor_size: tuple[int, int]
    events: Callable[[], Iterator[EventArray]]
    count_events: Callable[[], int]
    frames: Callable[[], Iterator[Frame]] = lambda: iter(())
    count_frames: Callable[[], int] = lambda: 0
    exposure_known: bool = True
    contrast_threshold: tuple[float, float] | None = None
    inverse_covariance: NDArray[np.float64] | None = None
    ground_truth: Callable[[], GroundTruth] | None = None
    response: str | None = None
    triggers: Callable[[], Iterator[TriggerArray]] | None = None
    missing: tuple[str, ...] = field(default=())
    sensor_size_known: bool = True
    mosaic: Mosaic | None = None
    rows_from_below: bool = False
    lost: Callable[[int, int], Lost | None] | None = None
    of_lossy_video: bool = False


NO_EVENTS: Final = "The file has no events."
NO_FRAMES: Final = "The file has no frames."
EXPOSURE_UNKNOWN: Final = "The exposure times of the frames are not recorded."
"""For `Source.missing`, where `Source.exposure_known` is False."""

SIZE_NOT_STATED: Final = "The sensor size is not recorded; "
"""How every sentence of ``missing`` begins that says what size is taken instead."""

SIZE_UNKNOWN: Final = SIZE_NOT_STATED + "the smallest that holds all events is taken."
"""For `Source.missing`, where the size comes from `smallest_size`."""


def counted(events: Callable[[], Iterable[EventArray]]) -> Callable[[], int]:
    """For `Source.count_events`: counts by reading through the chunks, once."""
    return cache(lambda: sum(len(chunk) for chunk in events()))


def smallest_size(path: Path, chunks: Iterable[EventArray]) -> tuple[int, int]:
    """(height, width) of the smallest sensor that holds all events.

    Raises
    ------
    FormatError
        If there are no events.
    """
    height = width = 0
    for chunk in chunks:
        height = max(height, int(chunk["y"].max(initial=0)) + 1)
        width = max(width, int(chunk["x"].max(initial=0)) + 1)
    if not height:
        raise FormatError(f"{path}: has no events, and does not say how large the sensor is")
    return height, width


def with_rows_turned(source: Source) -> Source:
    """A recording whose file counts rows from the bottom, with row 0 at the top. An event that lies outside stays."""
    height = source.sensor_size[0]
    return dataclasses.replace(
        source,
        events=changed(
            source.events, lambda chunks: (_with_rows(chunk, _turned(chunk["y"], height)) for chunk in chunks)
        ),
        rows_from_below=True,
    )


def on_sensor(source: Source, size: tuple[int, int]) -> Source:
    """A recording that does not state its sensor size, on a sensor of ``size``, (height, width), that holds it."""
    lower = size[0] - source.sensor_size[0] if source.rows_from_below else 0
    moved = dataclasses.replace(source, sensor_size=size)
    if not lower:
        return moved
    return dataclasses.replace(
        moved,
        events=changed(
            source.events,
            lambda chunks: (_with_rows(chunk, chunk["y"] + np.uint16(lower)) for chunk in chunks),
        ),
    )


def _turned(rows: NDArray[np.uint16], height: int) -> NDArray[Any]:
    return np.where(rows < height, height - 1 - rows.astype(np.int32), rows)


def _with_rows(chunk: EventArray, rows: NDArray[Any]) -> EventArray:
    events = chunk.copy()
    events["y"] = rows
    return events


def size_needed(source: Source, size: tuple[int, int]) -> tuple[int, int] | None:
    """The (height, width) that a recording's events need, where a sensor of ``size`` does not hold them all; else None.

    For recordings that do not state their sensor size.
    """
    if _holds(size, source.sensor_size):
        return None
    if source.rows_from_below:  # in the file they go up to this
        return source.sensor_size
    # What was assumed, as of DSEC's layout, may be more than the events need.
    least = smallest_size(source.path, source.events())
    return None if _holds(size, least) else least


def _holds(size: tuple[int, int], least: tuple[int, int]) -> bool:
    return size[0] >= least[0] and size[1] >= least[1]


def checked_inverse_covariance(path: Path, name: str, values: NDArray[Any]) -> NDArray[np.float64]:
    """The released datasets' ``f_Q``, (256,), 1/s, which the file holds as ``name``.

    Raises
    ------
    FormatError
        If it is not a value for each of 256 levels, finite and none negative.
    """
    if values.shape != (256,) or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise FormatError(f"{path}: {name} is {values.dtype} {values.shape}; 256 finite numbers are needed")
    if values.min() < 0:
        raise FormatError(f"{path}: {name} has a value of {values.min():g}; none may be negative")
    return values.astype(np.float64)


def begins_with(path: Path, *beginnings: bytes) -> bool:
    """Whether it is a file, and one of these, equally long, is how it begins."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(beginnings[0])) in beginnings


def natural_order(path: Path) -> list[tuple[int, str]]:
    """A key for sorting that puts 2.png before 10.png."""
    return [
        (int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name) if part
    ]


@contextmanager
def reading(path: Path, *damage: type[Exception]) -> Iterator[None]:
    """Turn what other libraries raise inside the block into kalux errors.

    Parameters
    ----------
    path
        The file, for the message.
    damage
        Exceptions that mean that the content is damaged. An ``OSError`` without an error number means that
        too: that is how HDF5 reports it.

    Raises
    ------
    FormatError
        For damage.
    InputError
        Where the operating system refuses to read.
    """
    try:
        yield
    except KaluxError:
        raise
    except OSError as error:
        if error.errno is not None:
            raise InputError(f"{path}: cannot be read: {os.strerror(error.errno)}") from error
        raise _damaged(path, error) from error
    except damage as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> FormatError:
    if isinstance(error, MemoryError):  # a damaged size, or a limit such as of `ulimit -v`
        return FormatError(
            f"{path}: needs more memory than there is ({one_line(error)}); allow more, or, if it should need little, "
            "copy or download it again"
        )
    return FormatError(f"{path}: damaged or incomplete ({one_line(error)}); copy or download it again")
