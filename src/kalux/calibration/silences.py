"""Times without an event in which there should be some: a sensor, or what read it, has dropped events.

Silence of a sensor says that the light stays and that there is no noise; this silence says neither. It is what a
command warns of, and what estimates of noise leave out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.lost import lost_time
from kalux.calibration.region import LEAST_MISSED, Region
from kalux.event_slices import all_between, between, long_waits
from kalux.events import EventArray
from kalux.frames import Frame
from kalux.recording import Recording

_MOST_HELD: Final = 4_000_000
"""Events between two frames that are kept to look at: 64 MB."""

Silence = tuple[int, int]
"""(start, end) us."""

_LEAST_INTERVALS: Final = 2  # between frames: in less of them, little is lost
_ALIKE: Final = 0.25
"""Share of the usual change from frame to frame, where there are events, from which something moved in a silence."""

_BLOCKS: Final = (16, 16)
"""Means of so many blocks of a frame tell how much it changes: of single pixels, noise would."""

_LEAST_BEYOND: Final = 16
"""Blocks without any event, that frames must have: a row of them."""


class FrameChanges:
    """How much each frame differs from the one before: root mean square of the means of blocks, white = 1."""

    def __init__(self) -> None:
        self._spans: list[Silence] = []
        self._blocks: NDArray[np.float32] | None = None
        self._changes: list[float] = []
        self._of_blocks: NDArray[np.float32] = np.zeros(_BLOCKS, np.float32)

    @property
    def exposures(self) -> NDArray[np.int64]:
        """(K, 2) us: start and end of those that were seen."""
        return np.array(self._spans, np.int64).reshape(-1, 2)

    def see(self, frame: Frame) -> None:
        """Look at the next frame."""
        image = frame.image if frame.image.ndim == 2 else frame.image[..., 1]
        resized = cv2.resize(image.astype(np.float32), _BLOCKS, interpolation=cv2.INTER_AREA)
        blocks = np.asarray(resized / frame.white_value, np.float32)
        if self._blocks is not None:
            squares = np.square(blocks - self._blocks)
            self._changes.append(float(np.sqrt(np.mean(squares))))
            self._of_blocks += squares
        self._blocks = blocks
        self._spans.append((frame.exposure_start, frame.exposure_end))

    def go_on(self, silences: Sequence[Silence]) -> list[Silence]:
        """Those of times without events in which frames change about as much as where there are events.

        Where something moves now and then, frames are mostly still, and change by their noise alone.
        """
        exposures, changes = self.exposures, np.array(self._changes)
        parts = [
            slice(
                int(np.searchsorted(exposures[:-1, 1], begin)),
                int(np.searchsorted(exposures[1:, 0], end, side="right")),
            )
            for begin, end in silences
        ]
        moving = np.ones(len(changes), np.bool_)
        for part in parts:
            moving[part] = False
        usual = float(np.median(changes[moving])) if moving.any() else 0.0
        return [
            silence
            for silence, part in zip(silences, parts, strict=True)
            if usual > 0
            and part.stop - part.start >= _LEAST_INTERVALS
            and np.median(changes[part]) >= _ALIKE * usual
        ]

    def go_on_beyond(self, region: Region, sensor_size: tuple[int, int]) -> bool:
        """Whether frames change beyond a region of events about as much as in it."""
        if not region.is_part_of(sensor_size):
            return False
        sides = zip(_BLOCKS, sensor_size, (region[0:2], region[2:4]), strict=True)
        rows, columns = (
            (np.arange(blocks) * size < end * blocks) & ((np.arange(blocks) + 1) * size > begin * blocks)
            for blocks, size, (begin, end) in sides
        )
        inside = rows[:, None] & columns
        if np.count_nonzero(~inside) < _LEAST_BEYOND:
            return False
        usual, beyond = (float(np.sqrt(self._of_blocks[each].mean())) for each in (inside, ~inside))
        return usual > 0 and beyond >= _ALIKE * usual


class EventWaits:
    """Times without an event from the first exposure to the last that are long enough to hold some frames."""

    def __init__(self, exposures: NDArray[np.int64]) -> None:
        self._start, self._end = int(exposures[0, 0]), int(exposures[-1, 1])
        lengths = exposures[_LEAST_INTERVALS:, 0] - exposures[:-_LEAST_INTERVALS, 1]
        self._least = max(int(lengths.min(initial=self._end - self._start)), 1)
        self._last = self._start
        self._found: list[Silence] = []
        self.events = 0

    def see(self, chunk: EventArray) -> None:
        """Look at the next events, of which there is one at least."""
        inside = between(chunk, self._start - 1, self._end)
        self._found += long_waits(inside, self._last, self._least)
        self.events += len(inside)
        if len(inside):
            self._last = int(inside["t"][-1])
        if self._last < self._end < chunk["t"][-1]:
            self._see_end()

    def _see_end(self) -> None:
        """No event is to come until the end."""
        self._found.append((self._last, self._end))
        self._last = self._end

    def lost(self, changes: FrameChanges, *, complete: bool) -> list[Silence]:
        """Those, the longest first, in which events are missing though frames change.

        ``complete``: all events until the end have been seen.
        """
        if complete:
            self._see_end()
        seen = self._last - self._start
        return changes.go_on([*_missing(self._found, seen, self.events)])


class Missing(NamedTuple):
    """Events that are missing between frames (docs/equations.md, K18), after some and before others.

    What has none until the next frame, or since the one before, may have come to stand still.

    Attributes
    ----------
    intervals
        From frame to frame, that were looked at, and
    lossy
        those in which some are.
    time
        us without them, of all these together.
    first
        us: the frame from which on the first ones are.
    """

    intervals: int = 0
    lossy: int = 0
    time: int = 0
    first: int = 0


class MissingWatch:
    """Sees the events go by, and tells between which of the frames some are missing.

    Parameters
    ----------
    exposures
        (K, 2) us: start and end of those of the frames, in order.
    """

    def __init__(self, exposures: NDArray[np.int64]) -> None:
        self._middles: list[int] = (exposures[:, 0] + (exposures[:, 1] - exposures[:, 0]) // 2).tolist()
        self._held: list[EventArray] = []
        self.found = Missing()

    def see(self, chunk: EventArray) -> None:
        """Look at the next events, of which there is one at least."""
        if sum(map(len, self._held)) > _MOST_HELD:
            self._held.clear()  # frames that are far apart: the rest of the interval is looked at
        self._held.append(chunk)
        self._look(int(chunk["t"][-1]))

    def finish(self) -> None:
        """No event is to come."""
        if self._held:
            self._look(self._middles[-1] + 1)

    def _look(self, until: int) -> None:
        """At the intervals that have ended before ``until``, us."""
        while (done := self.found.intervals) + 1 < len(self._middles) and self._middles[done + 1] < until:
            start, end = self._middles[done : done + 2]
            events = all_between(self._held, start, end)
            lost = lost_time(events, int(events[0]["t"][0]), int(events[-1]["t"][-1])) if events else 0
            self.found = Missing(
                done + 1,
                self.found.lossy + (lost > 0),
                self.found.time + lost,
                start if lost and not self.found.lossy else self.found.first,
            )
            self._held = [chunk for chunk in self._held if chunk["t"][-1] > end]


def find_silences(
    recording: Recording, *, most_frames: int | None = None, end: int | None = None
) -> list[Silence]:
    """Times without an event in which events are missing though frames change, the longest first.

    At the rate of the rest 100 events are missing in each, and frames go on to change by a quarter of what they usually
    do where there are events, over two intervals between them at least.

    Parameters
    ----------
    recording
        With frames or without; without, nothing tells.
    most_frames, end
        Only so many frames are looked at, and only those that are exposed by then, us.
    """
    changes = FrameChanges()
    for frame in islice(recording.frames(), most_frames):
        if end is not None and frame.exposure_end > end:
            break
        changes.see(frame)
    exposures = changes.exposures
    if len(exposures) <= _LEAST_INTERVALS:
        return []
    waits, last = EventWaits(exposures), int(exposures[-1, 1])
    for chunk in recording.events():
        waits.see(chunk)
        if chunk["t"][-1] > last:
            break
    return waits.lost(changes, complete=True)


def overlaps(silences: Iterable[Silence], begin: int, end: int) -> bool:
    """Whether some time from ``begin`` to ``end``, us, lies in one of the silences."""
    return any(begin < silent_until and end > silent_from for silent_from, silent_until in silences)


def _missing(silences: list[Silence], seen: int, events: int) -> Iterator[Silence]:
    """Silences, the longest first, in which events are missing at the usual rate of the rest of the time, ``seen``."""
    rest = seen
    for begin, end in sorted(silences, key=lambda silence: silence[0] - silence[1]):
        rest -= end - begin
        if events == 0 or end - begin < LEAST_MISSED * rest / events:
            return
        yield begin, end
