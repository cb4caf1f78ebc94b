"""A look at a recording before anything is written, so that bad input leaves nothing half-done behind."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from kalux.event_slices import between, events_until
from kalux.frames import exposure_doubt
from kalux.recording import Recording, clock_doubt, no_frames
from kalux.white import WhiteCheck

T = TypeVar("T")

CHECKED_FIRST: Final = 1 << 22
"""Events that are looked at before anything is made of a recording, 4 million: 0.05 s, and what is wrong with a file
mostly begins with its first event. Those of a longer one are checked as they are used: its file is then decoded once,
not twice."""

_LONG_GAP: Final = 10_000_000
"""us without a frame that somebody should hear of: at 100 images/s there are a thousand of them."""

_MANY_INTERVALS: Final = 100
"""As many times longer than usual: pictures of a slow series are not missed."""


class Contents(NamedTuple):
    """What a checked recording holds.

    Attributes
    ----------
    frames, events
        The numbers of those that were checked.
    start, end
        Start of the first exposure and end of the last, us.
    events_between
        The events from start to end, of those.
    colours
        As of `kalux.Frame`: ``"grey"``, ``"RGB"`` or the pattern of a mosaic.
    doubts
        What makes the frames' white value or the end of the last exposure doubtful.
    complete
        Whether these are all events, or only the first ones.
    gap
        (start, end) us of the longest time without a frame, where it is far longer than usual.
    """

    frames: int
    events: int
    start: int
    end: int
    events_between: int
    colours: str
    doubts: tuple[str, ...] = ()
    complete: bool = True
    gap: tuple[int, int] | None = None

    @property
    def seconds(self) -> float:
        """From start to end."""
        return (self.end - self.start) * 1e-6

    def warnings(self) -> Iterator[str]:
        """What is allowed, but probably not meant."""
        yield from self.doubts
        if self.events == 0:
            yield "there are no events; the images show the frames only"
        else:
            doubt = clock_doubt(self.events, self.events_between, CHECKED_FIRST)
            if doubt is not None:
                yield doubt


def check_recording(
    recording: Recording, on_events: Callable[[int], None], most: int | None = None
) -> Contents:
    """Read all frames and the first or all events once, with all checks.

    Parameters
    ----------
    recording
        Any.
    on_events
        Told the number of events of every chunk, for progress.
    most
        Events from the first frame on that are enough; None: all.

    Raises
    ------
    InputError
        Whatever is wrong with the recording, or it has no frames.
    """
    spans, colours = [], "grey"
    white = WhiteCheck()
    for frame in white.watched(recording.frames()):
        spans.append((frame.exposure_start, frame.exposure_end))
        colours = frame.colours
    if not spans:
        raise no_frames(recording)
    exposures = np.array(spans, np.int64)
    start, end = (int(t) for t in (exposures[0, 0], exposures[-1, 1]))
    count = events_between = events_from = 0
    complete = True
    for chunk in recording.events():
        if most is not None and events_from >= most:
            complete = False
            break
        count += len(chunk)
        events_between += len(between(chunk, start - 1, end))
        events_from += len(chunk) - events_until(chunk, start - 1)
        on_events(len(chunk))
    doubts = tuple(filter(None, (white.doubt(), exposure_doubt(exposures))))
    return Contents(
        len(exposures), count, start, end, events_between, colours, doubts, complete, _gap(exposures)
    )


def _gap(exposures: NDArray[np.int64]) -> tuple[int, int] | None:
    """The longest time between two of (K, 2) exposures, where it is far longer than usual."""
    lengths = exposures[1:, 0] - exposures[:-1, 1]
    if not len(lengths):
        return None
    after = int(np.argmax(lengths))
    if lengths[after] <= max(_LONG_GAP, _MANY_INTERVALS * float(np.median(lengths))):
        return None
    return int(exposures[after, 1]), int(exposures[after + 1, 0])


def check_beside(
    recording: Recording, on_events: Callable[[int], None], work: Callable[[], T], threads: int
) -> tuple[Contents, T]:
    """Check the first of a recording, with several ``threads`` while something else is made of it; both results.

    What is wrong with the recording is raised rather than what ``work`` raises, which may be because of it.

    Parameters
    ----------
    recording, on_events
        As of `check_recording`; with several threads called in another one.
    work
        Called in this thread.
    threads
        How many may be used.
    """
    if threads == 1:
        return check_recording(recording, on_events, CHECKED_FIRST), work()
    stopped = threading.Event()

    def counted(events: int) -> None:
        if stopped.is_set():
            raise CancelledError
        on_events(events)

    with ThreadPoolExecutor(1, "kalux-check") as pool:
        checked = pool.submit(check_recording, recording, counted, CHECKED_FIRST)
        try:
            try:
                made = work()
            except Exception:
                checked.result()
                raise
            return checked.result(), made
        finally:
            stopped.set()  # ends the check where the work was interrupted
