"""An engine for a recording, and its events, pushed as its frames need them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from typing import Final

import numpy as np

from kalux.events import EVENT_DTYPE, EventArray
from kalux.models.pixels import PixelCalibration
from kalux.reconstructor import Reconstructor
from kalux.recording import Recording
from kalux.settings import Settings

_NONE: Final = np.empty(0, EVENT_DTYPE)


def engine_of(
    recording: Recording,
    settings: Settings,
    pixels: PixelCalibration | None,
    *,
    threshold_is_estimate: bool,
    lookahead: bool = True,
    opener: Executor | None = None,
) -> Reconstructor:
    """The engine for a recording, whose doubts have been told. See `Reconstructor` for the parameters and errors."""
    return Reconstructor(
        recording.sensor_size,
        settings=settings,
        lookahead=lookahead,
        threshold_is_estimate=threshold_is_estimate,
        inverse_covariance=recording.source.inverse_covariance,
        pixels=pixels,
        tells_doubts=False,
        opener=opener,
    )


class EventFeed:
    """Chunks of events, pushed one after the other.

    Attributes
    ----------
    ended
        Whether there is none left.
    """

    def __init__(
        self,
        engine: Reconstructor,
        chunks: Iterator[EventArray],
        on_events: Callable[[int], None] | None = None,
    ) -> None:
        """``on_events`` is called with the number of events of every chunk."""
        self.ended = False
        self._engine, self._chunks, self._on_events = engine, chunks, on_events
        self._latest, self._before = _NONE, 0  # the latest chunk, and how many events came before it

    def push_next(self) -> None:
        """Push the next chunk, or find out that there is none."""
        chunk = next(self._chunks, None)
        if chunk is None:
            self.ended = True
            return
        self._before, self._latest = self._before + len(self._latest), chunk
        self._engine.push_events(chunk)
        if self._on_events is not None:
            self._on_events(len(chunk))

    def cover(self, t: int) -> None:
        """Push until the engine has all events up to ``t``, us in the clock of the frames."""
        while not self.ended and not self._engine.covers(t):
            self.push_next()
        if self.ended:
            self._engine.advance(self._in_events(t))

    def count(self, t: int) -> int:
        """How many events lie up to ``t``, us in the clock of the frames, that `cover` has gone to last."""
        return self._before + int(np.searchsorted(self._latest["t"], self._in_events(t), "right"))

    def _in_events(self, t: int) -> int:
        return t + self._engine.settings.events.lateness
