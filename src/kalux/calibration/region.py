"""Which part of the sensor has events at all: a region of interest, where pixels beyond it are switched off.

Silence of a pixel that is on says that its light stays. That of one that is off says nothing: neither that there is no
noise, nor that what frames show has no events.
"""

from __future__ import annotations

from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from kalux.events import EventArray
from kalux.recording import Recording

LEAST_MISSED: Final = 100
"""Events that are missing somewhere, or for some time, at the density or rate elsewhere: by chance it is none."""


class Region(NamedTuple):
    """Rows and columns of events, the first ones and those after the last; and how many events there are."""

    top: int
    bottom: int
    left: int
    right: int
    events: int

    @classmethod
    def of(cls, events: EventArray) -> Self:
        """That of some events, of one at least."""
        x, y = events["x"], events["y"]
        return cls(int(y.min()), int(y.max()) + 1, int(x.min()), int(x.max()) + 1, len(events))

    def joined(self, other: Region) -> Region:
        """The least that holds both."""
        return Region(
            min(self.top, other.top),
            max(self.bottom, other.bottom),
            min(self.left, other.left),
            max(self.right, other.right),
            self.events + other.events,
        )

    def is_part_of(self, sensor_size: tuple[int, int]) -> bool:
        """Whether events are missing elsewhere, at the density that they have here."""
        area = (self.bottom - self.top) * (self.right - self.left)
        beyond = sensor_size[0] * sensor_size[1] - area
        return beyond * self.events >= LEAST_MISSED * area

    def mask(self, sensor_size: tuple[int, int]) -> NDArray[np.bool_]:
        """(H, W) bool: the pixels that may have events; all of them where too few are missing elsewhere."""
        if not self.is_part_of(sensor_size):
            return np.ones(sensor_size, np.bool_)
        inside = np.zeros(sensor_size, np.bool_)
        inside[self.top : self.bottom, self.left : self.right] = True
        return inside


def widened(region: Region | None, events: EventArray) -> Region | None:
    """The least that holds a region, None for none, and some events, of which there may be none."""
    if len(events) == 0:
        return region
    here = Region.of(events)
    return here if region is None else region.joined(here)


def event_region(recording: Recording) -> NDArray[np.bool_]:
    """`Region.mask` of all events of a recording; all pixels where there are none."""
    found: Region | None = None
    for chunk in recording.events():
        found = widened(found, chunk)
    size = recording.sensor_size
    return np.ones(size, np.bool_) if found is None else found.mask(size)
