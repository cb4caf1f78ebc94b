"""How fast the clock of the frames runs against that of the events, as of two cameras that share none.

In a minute two crystals come apart by some milliseconds, and a video that is said to have 30 images a second, and has
29.97, by 60. At any moment that is a delay of the events like another, but one that grows. So the offset of the clocks
is looked for in short stretches all over the recording, by correlation (`kalux.calibration.offset`), each around that
of the one before, and a line is laid through them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.intervals import APART_IN_TIME, frames_apart
from kalux.calibration.offset import LEAST_FRAMES, MARGIN, Changes, correlate, frame_changes
from kalux.calibration.registration import Registration
from kalux.calibration.regression import huber_weights
from kalux.errors import EventError, InputError
from kalux.events import LATEST, EventArray
from kalux.recording import Recording
from kalux.settings import CameraSettings, chosen_response

Array = NDArray[np.float64]
Times = NDArray[np.int64]

_FRAMES: Final = 24
_LENGTH: Final = 1_000_000
"""Frames of a stretch, or us, whichever is longer: the correlation of fewer has several peaks."""

_SPACING: Final = 1.5
"""Least time from one stretch to the next, in lengths of a stretch, so that the events around them do not overlap."""

_LEAST: Final = 8
_MOST: Final = 24
"""Stretches. Offsets of each are 1 to 2 ms off, so that fewer tell little, and more than so many little more."""

_FASTEST: Final = 3e-3
"""Rate that is looked for: 30 images a second instead of 29.97 are 1e-3, two crystals 1e-4 at most."""

_REACH: Final = 50_000
"""us around the offset of the stretch before, beside what `_FASTEST` adds: farther than delays are looked for."""

_CLEAR: Final = 4_000
"""us, standard error up to which the offset of a stretch is told: 0.3 to 2 ms where a camera is in the hand, or shakes.
In an even pan a change of offset is one of nothing but place, and errors are tens of ms."""

_END: Final = 3
_AGREE: Final = 2_000
"""Stretches at the beginning, and at the end, and us by which the medians of two or more of either's offsets may differ
where there is no rate. `_LEAST_GAIN` over the recording is 4 ms or more between them."""

_LEAST_GAIN: Final = 6_000
"""us from the first to the last stretch below which a rate is left: events trail the light by 1 to 7 ms, the slower it
moves the more, and a scene may slow down."""

_KNOWN: Final = 6.0
"""Least rate, in standard errors."""

_SCATTERED: Final = 5_000
"""us, standard deviation of offsets about the line from which on there is none: 0.3 to 1.5 ms on five recordings."""

_ROUNDS: Final = 10  # of the robust line


class ClockRate(NamedTuple):
    """The clock of the frames against that of the events.

    Attributes
    ----------
    rate
        By how much less the clock of the frames goes on than that of the events: 1e-4 is 100 us a second.
    standard_error
        Of the rate.
    shifts
        (K,) us, what is to be added to the times of each frame; 0 for the first.
    """

    rate: float
    standard_error: float
    shifts: Times

    def of_all(self, exposures: Times) -> ClockRate:
        """Of frames with (K, 2) ``exposures``, us, some of which were not looked at."""
        return self._replace(shifts=_shifts(self.rate, exposures))


class Offsets(NamedTuple):
    """Of stretches of a recording, (N,) each, us: the middles of their times, and what is to be added to these."""

    times: Array
    offsets: Array


def find_clock_rate(recording: Recording, camera: CameraSettings, exposures: Times) -> ClockRate | None:
    """The rate of the frames' clock, where it comes to 6 ms or more over the recording, and is certain; else None.

    Recordings of less than eight stretches of 24 frames or 1 s, and half of that between them, are too short to tell:
    12 s at 25 Hz. Where the first and the last stretches have the same offset there is no rate; else all are looked at.
    All frames are read once, or twice; events as often, where later ones cannot be read without those before them.

    Parameters
    ----------
    recording
        With frames and events of the same pixels.
    camera
        Response and I_0.
    exposures
        (K, 2) starts and ends of all its frames, us.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    stretches = _stretches(exposures)
    if not stretches or _ends_suffice(recording, camera, stretches):
        return None
    found = offsets(recording, camera, stretches)
    if len(found.times) < _LEAST:
        return None
    line = _line(found)
    gain = abs(line.slope) * float(np.ptp(found.times))
    if gain < _LEAST_GAIN or abs(line.slope) < _KNOWN * line.standard_error or line.scatter > _SCATTERED:
        return None
    return ClockRate(line.slope, line.standard_error, _shifts(line.slope, exposures))


def offsets(
    recording: Recording, camera: CameraSettings, stretches: Sequence[slice], *, farthest: int = LATEST
) -> Offsets:
    """Offsets of stretches of the frames, as far as they can be told within ``farthest`` us of those before them."""
    seen = _changes(recording, camera, stretches)
    clear = [*_clear_offsets(recording, seen, farthest)]
    return Offsets(*np.array(clear, np.float64).reshape(-1, 2).T)


def _ends_suffice(recording: Recording, camera: CameraSettings, stretches: Sequence[slice]) -> bool:
    """Whether the first and last stretches say that there is no rate to be found.

    They do if their offsets are the same, or if so few of them are clear that too few of all would be.
    """
    ends = [*stretches[:_END], *stretches[-_END:]]
    times, found = offsets(recording, camera, ends, farthest=2 * _REACH)
    if len(stretches) - (len(ends) - len(times)) < _LEAST:
        return True
    if len(times) < 4:
        return False
    late = times > times.mean()
    if min(np.count_nonzero(late), np.count_nonzero(~late)) < 2:
        return False
    return bool(abs(np.median(found[late]) - np.median(found[~late])) <= _AGREE)


def _stretches(exposures: Times) -> list[slice]:
    """Frames of stretches that are spread evenly; none where the recording is too short for enough of them."""
    middles = exposures.mean(axis=1)
    if len(middles) < _LEAST * _FRAMES:
        return []
    interval = max(float(np.median(np.diff(middles))), 1.0)
    length = max(_FRAMES, int(np.ceil(_LENGTH / interval)))
    count = min(int(len(middles) / (_SPACING * length)), _MOST)
    if count < _LEAST:
        return []
    starts = np.linspace(0, len(middles) - length, count).astype(np.int64)
    return [slice(start, start + length) for start in starts.tolist()]


def _changes(recording: Recording, camera: CameraSettings, stretches: Sequence[slice]) -> list[Changes]:
    """What changes between the frames of each stretch."""
    same = Registration.same_pixels(recording.sensor_size)
    response = chosen_response(camera.response, recording.response)
    camera = dataclasses.replace(camera, response=response)
    found, passed = list[Changes](), 0
    frames = iter(recording.frames()) if stretches else iter(())
    for stretch in stretches:
        inside = islice(frames, stretch.start - passed, stretch.stop - passed)
        compared = [*frames_apart(inside, APART_IN_TIME)]
        if len(compared) >= LEAST_FRAMES:
            found.append(frame_changes(compared, same, camera))
        passed = stretch.stop
    return found


def _clear_offsets(
    recording: Recording, seen: Sequence[Changes], farthest: int
) -> Iterator[tuple[float, float]]:
    """Time and offset, us, of each stretch whose offset is clear, looked for around that of the last such one."""
    events_since = _events_since(recording)
    centre, before = 0.0, 0.0
    for changes in seen:
        time = float(changes.middles.mean())
        reach = min(round(_REACH + _FASTEST * (time - before)), farthest) if before else _REACH
        around = events_since(int(changes.middles[0]) + round(centre) - reach - MARGIN)
        try:
            found = correlate(changes, around, recording.sensor_size, centre=centre, reach=reach)
        except EventError:
            raise
        except InputError:  # nothing changes there, or there are no events
            continue
        if found.sure and found.standard_error <= _CLEAR:
            centre, before = found.offset, time
            yield time, found.offset


def _events_since(recording: Recording) -> Callable[[int], Iterator[EventArray]]:
    """Makes of each of some times, us, in order, an iterator over the events since then, and maybe some before it."""
    if recording.is_seekable:
        return recording.events_since
    chunks, kept = iter(recording.events()), list[EventArray]()
    return lambda _: _ahead(chunks, kept)


def _ahead(chunks: Iterator[EventArray], kept: list[EventArray]) -> Iterator[EventArray]:
    """The chunk that was ``kept``, as it may reach into the next stretch, and those after it, of which the last is."""
    yield from kept
    for chunk in chunks:
        kept[:] = [chunk]
        yield chunk


class _Line(NamedTuple):
    """A line through offsets: its slope and that one's standard error, and their standard deviation about it, us."""

    slope: float
    standard_error: float
    scatter: float


def _line(found: Offsets) -> _Line:
    """A robust line through the offsets."""
    times = found.times - found.times.mean()
    weights = np.ones(len(times))
    for _ in range(_ROUNDS):
        centre = np.average(times, weights=weights)
        about = times - centre
        moment = float(weights @ np.square(about))
        slope = float((weights * about) @ found.offsets) / moment
        left = found.offsets - np.average(found.offsets, weights=weights) - slope * about
        scatter = float(np.sqrt(weights @ np.square(left) / (len(times) - 2)))
        weights = huber_weights(left)[0]
    return _Line(slope, scatter / np.sqrt(moment), scatter)


def _shifts(rate: float, exposures: Times) -> Times:
    """(K,) us to be added to the times of frames with (K, 2) ``exposures``, us; the first one stays."""
    middles = exposures.mean(axis=1)
    return np.asarray(np.round(rate * (middles - middles[0])), np.int64)
