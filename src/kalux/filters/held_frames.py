"""The complementary filter from frame to frame: each frame is held until the next."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kalux.events import EventArray
from kalux.filters import complementary
from kalux.filters.akf import State
from kalux.filters.method import FAR_FUTURE, Chunks, Method, Segment
from kalux.filters.shots import Shot

Floats = NDArray[np.floating[Any]]


class HeldFrames(Method):
    """The complementary filter on held frames: each from the middle of its exposure, or its end if causal."""

    def node(self, shot: Shot) -> int:
        return shot.middle if self.lookahead else shot.end

    begin_time = node

    def needed_until(self, shot: Shot) -> int:
        return shot.end

    def start(self, shot: Shot, events: Chunks) -> tuple[None, None, State]:
        return None, None, self._state(self.log_frame(shot).astype(np.float32))

    def segment(
        self, memory: None, shot: Shot, following: Shot | None, events: Chunks
    ) -> tuple[Segment, None]:
        end = FAR_FUTURE if following is None else self.node(following)
        gain = np.full(self.shape, 2 * np.pi * self.settings.filter.cutoff, np.float32)
        if shot.valid is not None:
            gain[~shot.valid] = 0.0
        log_frame = self.log_frame(shot).astype(np.float32)
        return complementary.HeldSegment(self.node(shot), end, log_frame, gain, self.on, self.off), None

    def begin(self, segment: Any, state: State) -> complementary.Cursor:
        return complementary.begin(segment, state.log_intensity)

    def advance(self, segment: Any, cursor: complementary.Cursor, events: EventArray) -> None:
        complementary.advance(segment, cursor, events)

    def read(self, segment: Any, cursor: complementary.Cursor, t: int) -> tuple[Floats, Floats]:
        return complementary.read(segment, cursor, t), np.full(self.shape, np.inf, np.float32)

    def end(self, segment: Any, cursor: complementary.Cursor) -> State:
        return self._state(complementary.read(segment, cursor, segment.end))

    def _state(self, log_intensity: Floats) -> State:
        """The filter's state, which has neither a variance nor times of events."""
        return State(log_intensity, np.empty(0), np.empty(0, np.int64))
