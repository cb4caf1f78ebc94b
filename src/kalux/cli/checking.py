"""A look at a recording before anything is written, so that bad input leaves nothing half-done behind."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.region import Region, widened
from kalux.calibration.silences import EventWaits, FrameChanges, Missing, MissingWatch
from kalux.event_slices import events_until
from kalux.frames import Frame, exposure_doubt
from kalux.readers.source import Lost
from kalux.recording import Recording, clock_doubt, no_frames
from kalux.settings import CameraSettings
from kalux.white import CheckedWhite, WhiteCheck
from kalux.wording import how_many

T = TypeVar("T")

CHECKED_FIRST: Final = 1 << 22
"""Events that are looked at before anything is made of a recording, 4 million: 0.05 s, and what is wrong with a file
mostly begins with its first event. Those of a longer one are checked as they are used: its file is then decoded once,
not twice."""

_LONG_GAP: Final = 10_000_000
"""us without a frame that somebody should hear of: at 100 images/s there are a thousand of them."""

_MANY_INTERVALS: Final = 100
"""As many times longer than usual: pictures of a slow series are not missed."""


_MUCH_MISSING: Final = 0.01
"""Share of the time from the first frame to the last: a moment between two frames is no matter, the images say how
uncertain they are there."""

_LEAST_EVENTS: Final = 1_000  # of one polarity, without the other: fewer may be noise


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
    silence
        (start, end) us of the longest time without an event, where events are missing.
    more_silences
        How many other times without an event there are, where events are missing.
    on_share
        Share of ON events; None without events.
    exposed
        Whether a pixel of any frame lies between black and white.
    region
        Where all events lie, if frames change elsewhere as well.
    white
        What is taken for it; None where nothing was checked.
    lost
        Packets of events that are missing from the first exposure on, of those that were checked.
    missing
        Events that are, by the times between them.
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
    silence: tuple[int, int] | None = None
    more_silences: int = 0
    on_share: float | None = None
    exposed: bool = True
    region: Region | None = None
    white: CheckedWhite | None = None
    lost: Lost | None = None
    missing: Missing = Missing()

    @property
    def seconds(self) -> float:
        """From start to end."""
        return (self.end - self.start) * 1e-6

    def warnings(self, *, of_images: bool = True) -> Iterator[str]:
        """What is allowed, but probably not meant; ``of_images``: and what becomes of the images."""
        yield from self.doubts
        yield from self.stream_warnings(of_images=of_images)

    def stream_warnings(self, *, of_images: bool = True) -> Iterator[str]:
        """`warnings` without the doubts."""
        if not self.exposed and not self.doubts:
            yield "no pixel of the frames lies between black and white: they show nothing but the end of their range"
        if self.events == 0:
            yield "there are no events" + ("; the images show the frames only" if of_images else "")
            return
        if self.one_sided and self.events >= _LEAST_EVENTS:
            yield (
                f"all {self.events:,} events are {'ON' if self.on_share else 'OFF'}: is their polarity read rightly, "
                "or were the others lost?"
            )
        doubt = clock_doubt(self.frames, self.events, self.events_between, CHECKED_FIRST)
        if doubt is not None:
            yield doubt
        if self.lost is not None:
            yield self._lost_packets(*self.lost) + (
                "; what their events told is not in the images" if of_images else ""
            )
        if doubt is None and self.silence is not None:
            yield self._silence_doubt(*self.silence) + (
                "? Images between the frames do not move there" if of_images else "?"
            )
        elif doubt is None and self.lost is None and self.missing.time > _MUCH_MISSING * 1e6 * self.seconds:
            yield self._missing_events(self.missing) + (
                "; what changed then is told by the frames alone" if of_images else ""
            )
        if self.region is not None:
            top, bottom, left, right, _ = self.region
            yield (
                f"there is no event outside rows {top} to {bottom - 1} and columns {left} to {right - 1}, though the "
                "frames change there, too: was only a part of the sensor read out"
                + ("? Images do not move there, and their uncertainty is too small" if of_images else "?")
            )

    def _lost_packets(self, packets: int, first: int) -> str:
        return (
            f"{how_many(packets, 'packet')} of events {'is' if packets == 1 else 'are'} missing by their numbers, the "
            f"first before {(first - self.start) * 1e-6:.3f} s: lost between camera and recorder"
        )

    def _missing_events(self, missing: Missing) -> str:
        return (
            f"events are missing for {missing.time * 1e-6:.3f} s in all, in {missing.lossy} of "
            f"{how_many(missing.intervals, 'interval')} between frames, the first after "
            f"{(missing.first - self.start) * 1e-6:.3f} s: were they lost between camera and recorder"
        )

    @property
    def one_sided(self) -> bool:
        """Whether all events have the same polarity."""
        return self.on_share in (0.0, 1.0)

    def _silence_doubt(self, begin: int, end: int) -> str:
        first, last = ((t - self.start) * 1e-6 for t in (begin, end))
        more = f", nor in {how_many(self.more_silences, 'more such time')}" if self.more_silences else ""
        return (
            f"there is no event from {first:.3f} to {last:.3f} s{more}, though the frames change there as elsewhere: "
            "were events lost"
        )


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
    colours = "grey"
    white, changes, exposed = WhiteCheck(), FrameChanges(), False
    for frame in white.watched(recording.frames()):
        colours = frame.colours
        exposed = exposed or _is_exposed(frame)
        changes.see(frame)
    exposures = changes.exposures
    if not len(exposures):
        raise no_frames(recording)
    start, end = (int(t) for t in (exposures[0, 0], exposures[-1, 1]))
    count = on = events_from = 0
    complete, last_event = True, start
    waits, missing = EventWaits(exposures), MissingWatch(exposures)
    region: Region | None = None
    for chunk in recording.events():
        if most is not None and events_from >= most:
            complete = False
            break
        count += len(chunk)
        on += int(np.count_nonzero(chunk["p"]))
        region = widened(region, chunk)
        waits.see(chunk)
        missing.see(chunk)
        last_event = max(last_event, min(int(chunk["t"][-1]), end))
        events_from += len(chunk) - events_until(chunk, start - 1)
        on_events(len(chunk))
    if complete:
        missing.finish()
    doubts = tuple(filter(None, (white.doubt(), exposure_doubt(exposures))))
    silent = waits.lost(changes, complete=complete)
    return Contents(
        len(exposures),
        count,
        start,
        end,
        waits.events,
        colours,
        doubts,
        complete,
        _gap(exposures),
        silent[0] if silent else None,
        max(len(silent) - 1, 0),
        on / count if count else None,
        exposed,
        region if region is not None and changes.go_on_beyond(region, recording.sensor_size) else None,
        white.found(),
        recording.source.lost(start, last_event) if recording.source.lost is not None else None,
        missing.found,
    )


def _is_exposed(frame: Frame) -> bool:
    """Whether any pixel lies between black and white."""
    image = frame.image if frame.valid is None else frame.image[frame.valid]
    white = frame.black + CameraSettings.usual_saturation * frame.full_scale
    return bool(((image > frame.black) & (image < white)).any())


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
