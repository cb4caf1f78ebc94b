"""One pass over a recording for all that tells of slow pixels: its frames and events are read and counted once."""

from __future__ import annotations

from typing import Final, Protocol

from kalux.calibration.intervals import Counted, counted_intervals
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings

_MAX_FRAMES: Final = 40


class Observer(Protocol):
    """What looks at intervals, one after the other, until it has seen enough of them."""

    @property
    def enough(self) -> bool:
        """Whether it needs no more."""
        ...

    def add(self, counted: Counted) -> None:
        """Take the next interval in."""
        ...


def observe(
    recording: Recording, camera: CameraSettings, events: EventSettings, *observers: Observer
) -> None:
    """Show the ``observers`` the intervals between the first 40 frames, each as many as it needs.

    Parameters
    ----------
    recording
        With frames and exposures.
    camera, events
        As of `counted_intervals`.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    for counted in counted_intervals(recording, camera, events, most_frames=_MAX_FRAMES):
        for observer in observers:
            if not observer.enough:
                observer.add(counted)
        if all(observer.enough for observer in observers):
            return
