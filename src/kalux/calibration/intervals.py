"""Pairs of frames with the events around them: what every calibration from a recording looks at."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.lost import lost_time
from kalux.augmentation.refractory import EventClock
from kalux.calibration.exposures import Exposures
from kalux.event_slices import all_between, between, count_chunks, count_events, joined_events
from kalux.events import EventArray
from kalux.filters.shots import Shot, take_shot
from kalux.frames import Frame
from kalux.models.camera import Camera, log_intensity
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings, chosen_response

Array = NDArray[np.float64]

WELL_EXPOSED: Final = (0.05, 0.95)
"""Of the response: away from black, noise and saturation. No less than the lower one of the intensity, too, which a
response that is steep in the dark shows at several times the level."""

SOON: Final = 18_000
"""us from a frame to the next below which that comes too soon to compare the change with events, so that frames are
passed over. In a few ms a pixel has an event or none, which tells little of its step and nothing of when it was. Every
frame of a camera of 50 frames a second counts."""

SOON_FOR_THRESHOLDS: Final = 28_000
"""The same where thresholds are looked for: by frames at 40 and 50 Hz those of simulated scenes are 5 and 7 % off, by
every second one 2 and 3 %. What else is found, as the variance of an event's step, is to hold from frame to frame.
Every frame of a camera of 35 frames a second counts."""

APART: Final = 38_000
"""us between two of the frames that are left then: what frames at 25 Hz have, and a little less, as clocks are not that
exact. Thresholds of seven simulated scenes are 3 % off in the root mean square; by frames 20 ms apart 6 %
(docs/calibration.md)."""

APART_IN_TIME: Final = 18_000
"""The same where delays are looked for, which are to the point where light is fast: the MSE of a pan by 400 pixels a
second is 40 % less than with `APART`. Longer than any delay that a sensor has."""


@dataclass(frozen=True, eq=False)
class End:
    """A frame where one interval ends and the next begins. Values of pixels are taken when they are asked for.

    Attributes
    ----------
    frame, shot
        As recorded, and as the filters see it.
    log_offset
        I_0, white = 1.
    """

    frame: Frame
    shot: Shot
    log_offset: float

    @cached_property
    def intensity(self) -> Array:
        """(H, W) I."""
        return self.shot.intensity

    @cached_property
    def log_intensity(self) -> Array:
        """(H, W) log(I + I_0)."""
        levels: Array = log_intensity(self.shot.level_intensity, self.log_offset)[self.shot.levels]
        return levels

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """(H, W): valid and well exposed, also where a stated saturation lies below what that usually is."""
        low, high = WELL_EXPOSED
        level = self.frame.normalised()
        inside = (level > low) & (level < high)
        usable = np.asarray(inside.all(axis=-1) if inside.ndim == 3 else inside, np.bool_)
        return usable & (self.intensity > low * self.shot.white) & self.shot.measured


def camera_of(recording: Recording, camera: CameraSettings) -> Camera:
    """The frame camera, with the response of the settings, or that which the recording states."""
    return Camera.named(chosen_response(camera.response, recording.response), camera.clipped_from)


def is_one_exposure(first: float, second: float) -> bool:
    """Whether two exposure times, or what goes with them, are the same but for a tenth: then so is frames' noise."""
    return 0.9 < first / second < 1.1


@dataclass(frozen=True, eq=False)
class Interval:
    """From the middle of one exposure to that of the next.

    Attributes
    ----------
    ends
        The frames before and after.
    chunks
        The events between their middles, and those of the margin before and after, in a few arrays.
    """

    ends: tuple[End, End]
    chunks: list[EventArray]

    @property
    def first(self) -> Shot:
        """The frame before, as the filters see it."""
        return self.ends[0].shot

    @property
    def second(self) -> Shot:
        """The frame after."""
        return self.ends[1].shot

    @property
    def start(self) -> int:
        """The middle of the exposure before, us."""
        return self.first.middle

    @property
    def end(self) -> int:
        """The middle of the exposure after, us."""
        return self.second.middle

    @property
    def seconds(self) -> float:
        """From the one middle to the other."""
        return (self.end - self.start) * 1e-6

    @property
    def has_one_exposure(self) -> bool:
        """Whether the exposure times of both frames are the same but for a tenth, so that their noise is, too."""
        return is_one_exposure(self.first.white, self.second.white)

    @cached_property
    def events(self) -> EventArray:
        """Those of ``chunks`` in one array."""
        return joined_events(self.chunks)

    def counts(self, sensor_size: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(H, W) each, of a sensor of ``sensor_size``: on and off events between the middles, each counted once."""
        return count_chunks(all_between(self.chunks, self.start, self.end), sensor_size, weighed=False)

    @cached_property
    def change(self) -> Array:
        """(H, W) difference of log(I + I_0)."""
        return self.ends[1].log_intensity - self.ends[0].log_intensity

    @cached_property
    def level(self) -> Array:
        """(H, W) mean of I at both ends."""
        return (self.ends[1].intensity + self.ends[0].intensity) / 2

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """(H, W): valid and well exposed at both ends."""
        return self.ends[0].usable & self.ends[1].usable


def frames_apart(frames: Iterable[Frame], apart: int, soon: int = SOON) -> Iterator[Frame]:
    """Frames without those that follow another in less than ``soon`` us, too soon for events between them to tell much.

    Of these the first is left that comes ``apart`` us after the last one that is left, by the middles of the exposures.
    """
    before: int | None = None
    latest = 0
    for frame in frames:
        middle = frame.middle
        if before is None or middle - before >= soon or middle - latest >= apart:
            latest = middle
            yield frame
        before = middle


def compared_frames(
    frames: Iterable[Frame], most: int, apart: int = APART, soon: int = SOON
) -> Iterator[Frame]:
    """The first ``most`` of the frames whose changes are compared with events: those that `frames_apart` leaves."""
    return islice(frames_apart(frames, apart, soon), most)


def intervals(
    recording: Recording,
    camera: CameraSettings,
    *,
    margin: int,
    most_frames: int,
    apart: int = APART,
    soon: int = SOON,
) -> Iterator[Interval]:
    """The intervals between the first ``most_frames`` frames, with the events up to ``margin`` us around each.

    Frames are those of `compared_frames`; all with an ``apart`` of 0.
    """
    model = camera_of(recording, camera)
    chunks = iter(recording.events())
    held: list[EventArray] = []
    previous: End | None = None
    reference = float(camera.reference_exposure or 0)
    for frame in compared_frames(recording.frames(), most_frames, apart, soon):
        reference = reference or float(frame.exposure)
        shot = take_shot(frame, model, reference)
        while not held or held[-1]["t"][-1] <= shot.middle + margin:
            chunk = next(chunks, None)
            if chunk is None:
                break
            if previous is None:  # only the margin before the first interval needs to be kept
                held = _later(held, shot.middle - margin)
            held.append(chunk)
        end = End(frame, shot, camera.offset)
        if previous is not None:
            around = all_between(held, previous.shot.middle - margin, shot.middle + margin)
            yield Interval((previous, end), around)
        held = _later(held, shot.middle - margin)
        previous = end


class Counted(NamedTuple):
    """An interval, and what its events tell of every pixel, (H, W) each.

    Attributes
    ----------
    on, off
        Weighed (K13) events of either polarity between the middles of the exposures.
    bend
        By how much more the logs of the frames differ than the log intensities at these middles (`Bends.over_middle`).
    """

    interval: Interval
    on: Array
    off: Array
    bend: Array


def counted_intervals(
    recording: Recording, camera: CameraSettings, events: EventSettings, *, most_frames: int
) -> Iterator[Counted]:
    """As `intervals`, with the events of every pixel counted, without those in which events are missing (K18).

    Of ``events``, thresholds, delay and refractory period are used.
    """
    delay = events.lateness
    clock = EventClock(recording.sensor_size, events.refractory)
    exposures = Exposures(recording.sensor_size, delay, events.thresholds)
    margin = recording.longest_exposure + abs(delay)
    for interval in intervals(recording, camera, margin=margin, most_frames=most_frames):
        start, end = interval.start + delay, interval.end + delay
        inside = clock.weighed(between(interval.events, start, end))
        if lost_time([inside], start, end):
            continue
        on, off = count_events(inside, recording.sensor_size, weighed=True)
        before, after = exposures.of(interval.first, interval.second, interval.events)
        yield Counted(interval, on, off, after.over_middle - before.over_middle)


def _later(chunks: list[EventArray], t: int) -> list[EventArray]:
    """Those that have events after ``t`` (us)."""
    return [chunk for chunk in chunks if chunk["t"][-1] > t]


def spread(chosen: NDArray[np.bool_], most: int) -> NDArray[np.int64]:
    """Flat indices of the pixels chosen, at most ``most`` of them, spread evenly."""
    indices = np.flatnonzero(chosen)
    count = len(indices)
    return indices if count <= most else indices[np.arange(most) * count // most]
