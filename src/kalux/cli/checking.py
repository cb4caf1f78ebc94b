"""One pass over a recording before anything is written, so that bad input leaves nothing half-done behind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from kalux.errors import FrameError
from kalux.recording import Recording


class Contents(NamedTuple):
    """What a checked recording holds.

    Attributes
    ----------
    frames, events
        Their numbers.
    start, end
        Start of the first exposure and end of the last, us.
    events_between
        The events from start to end.
    colours
        As of `kalux.Frame`: ``"grey"``, ``"RGB"`` or the pattern of a mosaic.
    """

    frames: int
    events: int
    start: int
    end: int
    events_between: int
    colours: str

    @property
    def seconds(self) -> float:
        """From start to end."""
        return (self.end - self.start) * 1e-6

    def warnings(self) -> Iterator[str]:
        """What is allowed, but probably not meant."""
        if self.events == 0:
            yield "there are no events; the images show the frames only"
        elif self.events_between == 0:
            yield (
                f"none of the {self.events:,} events lies between the first and the last frame; do events and "
                "frames have the same clock?"
            )


def check_recording(recording: Recording, on_events: Callable[[int], None]) -> Contents:
    """Read all frames and events once, with all checks.

    Parameters
    ----------
    recording
        Any.
    on_events
        Told the number of events of every chunk, for progress.

    Raises
    ------
    InputError
        Whatever is wrong with the recording, or it has no frames.
    """
    exposures, colours = [], "grey"
    for frame in recording.frames():
        exposures.append((frame.exposure_start, frame.exposure_end))
        colours = frame.colours
    if not exposures:
        raise FrameError(f"{recording.source.path}: no frames; kalux needs frames as well as events")
    start, end = exposures[0][0], exposures[-1][1]
    count = between = 0
    for chunk in recording.events():
        count += len(chunk)
        between += int(chunk["t"].searchsorted(end, "right") - chunk["t"].searchsorted(start))
        on_events(len(chunk))
    return Contents(len(exposures), count, start, end, between, colours)
