"""Pixels of frames that always show the same, while neighbours and their own events show that the light changes."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.event_slices import count_events, events_until
from kalux.events import EventArray
from kalux.frames import Frame
from kalux.models.frame_pixels import around
from kalux.recording import Recording

_FRAMES: Final = 80
_LEAST_FRAMES: Final = 10
_MOST_EVENTS: Final = 4_000_000

_STILL: Final = 0.02
"""Largest range of the response over all frames of a pixel that is stuck: five levels of 255."""

_MOVING: Final = 0.5
"""Least range of each of its neighbours. In 63 recordings without stuck pixels it is up to 0.45 around pixels that are
clipped, or black, all the time though their light changes; around stuck ones of two others it is 0.74 and more."""

_APART: Final = 0.3
"""Or by how much it is always darker, or always brighter, than all of them ever are."""

_STUCK_NEIGHBOURS: Final = 2
"""At most so many neighbours may be stuck, too: of more, what they should show cannot be told."""

_LEAST_EVENTS: Final = 8  # of the median neighbour
_SHARE: Final = 0.5
"""Share of the events of its median neighbour from which a pixel's light changes as theirs does: a small lamp that is
always on has none."""


class RangeWatch:
    """Sees frames go by, and keeps the darkest and the brightest value of every pixel of the first 80."""

    def __init__(self) -> None:
        self._low: NDArray[Any] | None = None
        self._high: NDArray[Any] | None = None
        self._scale, self._frames, self._pitch = 1.0, 0, 1
        self._end = 0

    def see(self, frame: Frame) -> None:
        """Look at the next frame. Of RGB, green tells."""
        if self._frames == _FRAMES:
            return
        image = frame.image if frame.image.ndim == 2 else frame.image[..., 1]
        if self._low is None or self._high is None:
            self._low, self._high = image.copy(), image.copy()
        else:
            np.minimum(self._low, image, out=self._low)
            np.maximum(self._high, image, out=self._high)
        self._scale, self._end = frame.full_scale, frame.exposure_end
        self._pitch = 1 if frame.mosaic is None else 2
        self._frames += 1

    def stuck(self, recording: Recording) -> NDArray[np.bool_] | None:
        """(H, W) which pixels of frames are stuck; None: none. Events are read only where frames show any."""
        if self._low is None or self._high is None or self._frames < _LEAST_FRAMES:
            return None
        low, high = (values.astype(np.float64) / self._scale for values in (self._low, self._high))
        still = high - low <= _STILL
        if still.all() or not still.any():
            return None
        still_beside = around(still, self._pitch, False)
        beside = around(high - low, self._pitch, np.inf)
        moving = np.where(still_beside, np.inf, beside).min(axis=0) >= _MOVING
        alone = still_beside.sum(axis=0) <= _STUCK_NEIGHBOURS
        dark = around(low, self._pitch, np.inf).min(axis=0) - high >= _APART
        bright = low - around(high, self._pitch, -np.inf).max(axis=0) >= _APART
        suspects = still & ((alone & moving) | dark | bright)
        if not suspects.any():
            return None
        counts = self._counts(recording)
        usual = np.nanmedian(around(counts, self._pitch, np.nan), axis=0)
        stuck = suspects & (usual >= _LEAST_EVENTS) & (counts >= _SHARE * usual)
        return stuck if stuck.any() else None

    def _counts(self, recording: Recording) -> NDArray[np.float64]:
        """(H, W) events during these frames, of the first 4 million."""
        total: NDArray[np.float64] = np.zeros(recording.sensor_size)
        seen = 0
        for chunk in recording.events():
            inside: EventArray = chunk[: events_until(chunk, self._end)]
            on, off = count_events(inside, recording.sensor_size)
            total += on + off
            seen += len(inside)
            if len(inside) < len(chunk) or seen >= _MOST_EVENTS:
                break
        return total
