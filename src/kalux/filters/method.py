"""The interface of the methods that drive a filter from frame to frame.

A method cuts time at one moment per frame, its ``node``. Between two nodes lies a segment, whose augmentation
follows from the frames at both ends and the events in between; a memory value carries what later segments need.
`kalux.Reconstructor` is the only caller. The methods are `bridged_frames`, `interpolated_frames` and `held_frames`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.highlights import Unshown
from kalux.augmentation.motion import Paths, Plane
from kalux.event_slices import all_between, count_chunks
from kalux.events import EventArray
from kalux.filters.akf import State
from kalux.filters.shots import Shot
from kalux.filters.surfaces import Unmeasured
from kalux.filters.uncertainty import Around
from kalux.models.camera import log_intensity
from kalux.settings import Settings

Array = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]

Chunks = Sequence[EventArray]
"""Events in time order, in a few arrays."""

USUAL_INTERVAL: Final = 40_000
"""us between frames, over which the information of the first one is spread until a second one is known."""

FAR_FUTURE: Final = 1 << 61
"""End of a segment that has no next frame, us."""


class Segment(Protocol):
    """What all segments have: their span in us."""

    @property
    def start(self) -> int: ...
    @property
    def end(self) -> int: ...


class Method(ABC):
    """A method to filter from frame to frame. Memory, segments and cursors are opaque to its caller.

    Queries that a method does not support return None, or 0.
    """

    def __init__(self, settings: Settings, lookahead: bool, shape: tuple[int, int]) -> None:
        self.settings, self.lookahead, self.shape = settings, lookahead, shape
        self.on, self.off = settings.events.thresholds
        self.offset = settings.camera.offset

    @abstractmethod
    def node(self, shot: Shot) -> int:
        """The moment, us, at which a frame's segment begins."""

    @abstractmethod
    def begin_time(self, shot: Shot) -> int:
        """The first moment, us, that can be read when ``shot`` is the first frame."""

    def needed_from(self, shot: Shot) -> int:
        """Events after this time, us, are needed when ``shot`` is the first frame."""
        return shot.start

    @abstractmethod
    def needed_until(self, shot: Shot) -> int:
        """Events up to this time, us, are needed before the segment that ends at the frame is final."""

    @abstractmethod
    def start(self, shot: Shot, events: Chunks) -> tuple[Any, Segment | None, State]:
        """From the first frame: memory, the segment before its node if there is one, and the first state."""

    @abstractmethod
    def segment(self, memory: Any, shot: Shot, following: Shot | None, events: Chunks) -> tuple[Segment, Any]:
        """The segment from a frame to the next (None: not known, or none comes), and the memory after it.

        ``events`` are those after the frame's node, as far as known.
        """

    @abstractmethod
    def begin(self, segment: Any, state: State) -> Any:
        """A cursor at the segment's start."""

    @abstractmethod
    def advance(self, segment: Any, cursor: Any, events: EventArray) -> None:
        """Take the cursor over events, in place."""

    @abstractmethod
    def read(self, segment: Any, cursor: Any, t: int) -> tuple[Floats, Floats]:
        """L and P at ``t``; P is infinite where the method has none."""

    @abstractmethod
    def end(self, segment: Any, cursor: Any) -> State:
        """The state at the end of the segment. The cursor must not be used after it."""

    def moving(self, segment: Any, cursor: Any) -> NDArray[np.bool_] | None:
        """(H, W): pixels with an event in this frame interval or the one before, or that neither frame measures."""
        return None

    def silent_change(self, segment: Any) -> Floats | None:
        """(H, W): `kalux.augmentation.subthreshold.silent_change` of the segment, if known."""
        return None

    def texture(self, segment: Any) -> Floats | None:
        """(H, W): the variance by which neighbours one apart differ (K12); None: by no more than usual."""
        return None

    def turns(self, segment: Any) -> float:
        """How often the intensity of a pixel with events reverses in a frame interval, on average."""
        return 0.0

    def around(self, segment: Any, t: int) -> Around | None:
        """Variances and event counts between the two frames that a segment joins, for K11 at ``t``."""
        return None

    def path(self, segment: Any) -> Plane | None:
        """(2, H, W) by how much pixels move between the frames of a segment (K16); None: not told, or nothing does."""
        return None

    def paths(self, segment: Any, path: Plane, level: Floats, variance: Floats) -> Paths | None:
        """The same bent to L and P half-way; None: not told."""
        return None

    def unmeasured(self, segment: Any, cursor: Any) -> Unmeasured | None:
        """Pixels that neither frame of a segment measures."""
        return None

    def trail(self, segment: Any, cursor: Any, t: int) -> Floats | None:
        """(H, W): how far, in log intensity, the light is ahead of its events at ``t`` (K14)."""
        return None

    def unshown(self, segment: Any, variance: Floats) -> Unshown | None:
        """Pixels that no frame has measured so far (K15), given P."""
        return None

    def log_frame(self, shot: Shot) -> Array:
        """(H, W) log(I + I_0)."""
        log_frame: Array = log_intensity(shot.level_intensity, self.offset)[shot.levels]
        return log_frame

    def counts(self, events: Chunks, start: int, end: int) -> tuple[Floats, Floats]:
        """Number of on and off events of every pixel with start < t <= end."""
        return count_chunks(all_between(events, start, end), self.shape, weighed=True)

    def masked(self, shot: Shot) -> NDArray[np.bool_]:
        """(H, W) bool: pixels that the frame masks out."""
        return np.zeros(self.shape, bool) if shot.valid is None else ~shot.valid

    def masked_variance(self, shot: Shot) -> float:
        """P of a pixel that the first frame masks out: at least the variance of the others' log intensities."""
        seen = self.log_frame(shot)[shot.valid]
        return max(self.settings.filter.initial_variance, float(np.var(seen)) if seen.size else 0.0)
