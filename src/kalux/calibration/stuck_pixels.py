"""Pixels of frames that always show the same, while neighbours and their own events show that the light changes."""

from __future__ import annotations

from typing import Any, Final

import cv2
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

_APART: Final = 0.05
"""Or by how much it is darker, or brighter, than each of them in every frame. Of 291 recordings without stuck pixels
none has such a one with `_LEAST_HEARD` events, nor with half as many, nor at 0.02."""

_BLACK: Final = 0.01
_HOLE: Final = 0.1
"""Or it is black, and by so much darker: lenses draw no such hole, so that events are not asked. The same 291 have
none."""

_STUCK_NEIGHBOURS: Final = 2
"""At most so many neighbours may be stuck, too: of more, what they should show cannot be told."""

_LEAST_EVENTS: Final = 8  # of the median neighbour
_LEAST_HEARD: Final = 4  # the same where no neighbour is as dark, or bright
_SHARE: Final = 0.5
"""Share of the events of its median neighbour from which a pixel's light changes as theirs does: a small lamp that is
always on has none."""


class RangeWatch:
    """Sees frames go by, and keeps the darkest and the brightest value of every pixel of the first 80.

    Also by how much each is darker, or brighter, than all its neighbours at least.
    """

    def __init__(self) -> None:
        self._low: NDArray[Any] | None = None
        self._high: NDArray[Any] | None = None
        self._darker = self._brighter = np.empty((0, 0))
        self._scale, self._frames, self._pitch = 1.0, 0, 1
        self._end = 0

    def see(self, frame: Frame) -> None:
        """Look at the next frame. Of RGB, green tells."""
        if self._frames == _FRAMES:
            return
        image = frame.image if frame.image.ndim == 2 else frame.image[..., 1]
        self._pitch = 1 if frame.mosaic is None else 2
        darker, brighter = _beyond_neighbours(image, self._pitch)
        if self._low is None or self._high is None:
            self._low, self._high = image.copy(), image.copy()
            self._darker, self._brighter = darker, brighter
        else:
            np.minimum(self._low, image, out=self._low)
            np.maximum(self._high, image, out=self._high)
            np.minimum(self._darker, darker, out=self._darker)
            np.minimum(self._brighter, brighter, out=self._brighter)
        self._scale, self._end = frame.full_scale, frame.exposure_end
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
        darker, brighter = self._darker / self._scale, self._brighter / self._scale
        hole = still & (high <= _BLACK) & (darker >= _HOLE)
        apart = still & ((darker >= _APART) | (brighter >= _APART))
        unlike = still & alone & moving
        if not (hole | apart | unlike).any():
            return None
        counts = self._counts(recording)
        usual = np.nanmedian(around(counts, self._pitch, np.nan), axis=0)
        heard = counts >= _SHARE * usual
        stuck = hole | (apart & heard & (usual >= _LEAST_HEARD)) | (unlike & heard & (usual >= _LEAST_EVENTS))
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


def _beyond_neighbours(image: NDArray[Any], pitch: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """(H, W) by how much every pixel is darker, and brighter, than all its neighbours; not above 0 where it is not."""
    beside = np.zeros((2 * pitch + 1, 2 * pitch + 1), np.uint8)
    beside[::pitch, ::pitch] = 1
    beside[pitch, pitch] = 0
    darker = cv2.subtract(cv2.erode(image, beside), image)
    return np.asarray(darker), np.asarray(cv2.subtract(image, cv2.dilate(image, beside)))
