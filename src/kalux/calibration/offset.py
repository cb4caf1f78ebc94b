"""The offset between the clocks of frames and events: where both see the same changes at the same time.

Coarsely, by correlation over seconds: of the mean change of coarse cells of the image, with its sign, where frames and
events have the same pixels; of how much changes at all, where they have not. Finely, by `kalux.calibration.alignment`,
pixel by pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.alignment import MOST_FRAMES, Shots, align, intensities, take_shots
from kalux.calibration.intervals import APART_IN_TIME, compared_frames, frames_apart
from kalux.calibration.registration import Registration
from kalux.compiled import event_column, event_is_on, event_row, event_words, loop
from kalux.errors import InputError
from kalux.event_slices import between
from kalux.events import EVENT_DTYPE, EventArray, check_events
from kalux.frames import Frame
from kalux.settings import CameraSettings
from kalux.wording import how_many

Array = NDArray[np.float64]

RANGE: Final = 2_000_000
"""us: how far the clocks may be apart, if nothing is said."""

MARGIN: Final = 300_000
"""us of events before and after the frames that are aligned: longer than any step is spread over."""

SURE: Final = 1.15
"""Least height of the peak of the correlation over the next one: below it the offset may be a period more or less."""

_BIN: Final = 1_000  # us
_CELLS: Final = (12, 16)
_COARSE_FRAMES: Final = 400
LEAST_FRAMES: Final = 6
"""So many are compared at least."""

_LARGEST: Final = 30_000_000  # pixels of all frames that are aligned together: some 700 MB
_LEAST_CORRELATION: Final = 0.25


class Correlation(NamedTuple):
    """Result of the coarse search for the offset, by correlation.

    Attributes
    ----------
    offset
        us, at the peak, refined by a parabola; to be added to the frames' times.
    standard_error
        us, by leaving out one interval at a time.
    peak
        The correlation there.
    ratio
        Over the highest one at least one and a half frame intervals away; infinite where that is not positive.
    grid, curve
        (G,) us and the correlations there.
    per_pixel
        Whether cells of registered images were compared; otherwise the whole image's activity.
    """

    offset: float
    standard_error: float
    peak: float
    ratio: float
    grid: NDArray[np.int64]
    curve: Array
    per_pixel: bool

    @property
    def sure(self) -> bool:
        """Whether there is no other offset that is nearly as good."""
        return self.peak >= _LEAST_CORRELATION and self.ratio >= SURE


class OffsetEstimate(NamedTuple):
    """An offset between clocks.

    Attributes
    ----------
    offset, standard_error
        us, to be added to the frames' times: of the fit pixel by pixel.
    apparent
        us: the offset at which whole event steps explain the frames best. It includes the half threshold by which
        events trail the light, as the delay that `kalux.reconstruct` corrects does.
    coarse
        The search over seconds.
    """

    offset: float
    standard_error: float
    apparent: float
    coarse: Correlation


class Changes(NamedTuple):
    """What changed from each frame to the next: middles (K,) us, changes (K-1, C), and whether they have a sign."""

    middles: NDArray[np.int64]
    changes: Array
    signed: bool


def frame_changes(
    frames: Iterable[Frame], registration: Registration | None, camera: CameraSettings
) -> Changes:
    """Changes of the log intensity between at most 400 frames: of cells, or of the whole image without a sign.

    Frames are those that `kalux.calibration.intervals.frames_apart` leaves.

    Raises
    ------
    InputError
        If there are fewer than six frames.
    """
    middles: list[int] = []
    rows: list[Array] = []
    before: tuple[NDArray[Any], NDArray[Any]] | None = None
    compared = compared_frames(frames, _COARSE_FRAMES, APART_IN_TIME)
    for frame, linear, usable in intensities(compared, camera):
        log, good = np.log(linear + camera.offset).astype(np.float32), usable.astype(np.float32)
        now: tuple[NDArray[Any], NDArray[Any]]
        if registration is None:
            scale = max(1, frame.image.shape[1] // 160)
            size = (frame.image.shape[1] // scale, frame.image.shape[0] // scale)
            now = (
                cv2.resize(log, size, interpolation=cv2.INTER_AREA),
                cv2.resize(good, size, interpolation=cv2.INTER_AREA),
            )
        else:
            inside = registration.maps.inside.astype(np.float32)
            now = registration.resampled(log), registration.resampled(good) * inside
        if before is not None:
            both = (now[1] > 0.98) & (before[1] > 0.98)
            change = np.where(both, now[0] - before[0], 0.0)
            if registration is None:
                rows.append(np.array([np.abs(change).sum() / max(int(both.sum()), 1)]))
            else:
                small = cv2.resize(change, _CELLS[::-1], interpolation=cv2.INTER_AREA)
                rows.append(np.asarray(small, np.float64).ravel())
        before = now
        middles.append(frame.middle)
    if len(middles) < LEAST_FRAMES:
        raise InputError(
            f"offset: {how_many(len(middles), 'frame')}, too few; {LEAST_FRAMES} at least, fifty are good"
        )
    return Changes(np.array(middles, np.int64), np.array(rows), registration is not None)


def correlate(
    changes: Changes,
    chunks: Iterable[EventArray],
    sensor_size: tuple[int, int],
    *,
    centre: float = 0.0,
    reach: int = RANGE,
) -> Correlation:
    """Correlate frame changes with events, for all offsets up to ``reach`` us around ``centre``.

    Raises
    ------
    InputError
        If there are no events in reach, or nothing changes.
    EventError
        If an event lies outside the sensor.
    """
    middles = changes.middles
    shift = round(centre)
    first, last = int(middles[0]) + shift - reach - _BIN, int(middles[-1]) + shift + reach + _BIN
    level = _levels(chunks, sensor_size, first, last, signed=changes.signed)
    if level is None:
        raise InputError(
            f"offset: no events from {reach * 1e-6:g} s before the first frame to {reach * 1e-6:g} s after the last; "
            "are the clocks further apart? A larger range can be given"
        )
    grid = np.arange(-reach, reach + 1, _BIN, dtype=np.int64) + shift
    found = np.empty((len(grid), len(middles) - 1, 3))
    target = changes.changes - changes.changes.mean(axis=0)
    for i, offset in enumerate(grid.tolist()):
        at = (middles + offset - first) // _BIN
        events = np.diff(level[at], axis=0)
        events = events - events.mean(axis=0)
        found[i] = np.stack(
            [(events * target).sum(1), (events * events).sum(1), (target * target).sum(1)], axis=1
        )
    curve = _correlation(found.sum(axis=1))
    best = int(np.argmax(curve))
    if not curve[best] > 0:
        raise InputError(
            "offset: nothing in the frames changes as the events say; do both see the same scene?"
        )
    interval = float(np.median(np.diff(middles)))
    away = np.abs(grid - grid[best]) > 1.5 * interval
    other = float(curve[away].max()) if away.any() else 0.0
    near = slice(max(best - 40, 0), best + 41)
    return Correlation(
        offset=_peak(grid, curve, interval),
        standard_error=max(_jackknifed(grid[near], found[near], interval), _BIN / np.sqrt(12)),
        peak=float(curve[best]),
        ratio=float(curve[best]) / other if other > 0 else float("inf"),
        grid=grid,
        curve=curve,
        per_pixel=changes.signed,
    )


def _levels(
    chunks: Iterable[EventArray], sensor_size: tuple[int, int], first: int, last: int, *, signed: bool
) -> Array | None:
    """Sums of the events of every cell, or of the whole image without a sign, up to every ms; None without events."""
    cells = _CELLS if signed else (1, 1)
    # Of the cells that pixels lie in.
    rows, columns = (np.arange(size) * count // size for size, count in zip(sensor_size, cells, strict=True))
    counts, off = np.zeros(((last - first) // _BIN + 2, cells[0] * cells[1])), -1.0 if signed else 1.0
    total = 0
    for chunk in chunks:
        inside = between(chunk, first, last)
        check_events(inside, sensor_size)
        _add_events(event_words(inside), first, rows * cells[1], columns, off, counts)
        total += len(inside)
        if len(chunk) and chunk["t"][-1] > last:
            break
    if total == 0:
        return None
    return np.concatenate([np.zeros((1, counts.shape[1])), np.cumsum(counts, axis=0)])


@loop
def _add_events(words, first, rows, columns, off, counts):  # type: ignore[no-untyped-def]
    """Add 1 for every on event and ``off`` for every other one to the ``counts`` of its bin and cell."""
    for i in range(len(words)):
        word = words[i, 1]
        place = np.uint64(words[i, 0] - first) // np.uint64(_BIN)
        counts[place, rows[event_row(word)] + columns[event_column(word)]] += (
            1.0 if event_is_on(word) else off
        )


def _jackknifed(grid: NDArray[np.int64], found: Array, interval: float) -> float:
    """Standard error of the peak, us: its spread where one frame interval at a time is left out."""
    left_out = _correlation(found.sum(axis=1, keepdims=True) - found)
    peaks = np.array([_peak(grid, left_out[:, k], interval) for k in range(left_out.shape[1])])
    n = len(peaks)
    return float(np.sqrt((n - 1) / n * np.sum((peaks - np.mean(peaks)) ** 2)))


def _correlation(sums: Array) -> Array:
    product, events, frames = np.moveaxis(sums, -1, 0)
    out: Array = product / np.sqrt(np.maximum(events * frames, 1e-30))
    return out


def _peak(grid: NDArray[np.int64], curve: Array, interval: float) -> float:
    """Where the highest value lies: the top of a parabola through what is within an eighth of a frame interval."""
    best = int(np.argmax(curve))
    near = np.abs(grid - grid[best]) <= max(interval / 8, 2.0 * _BIN)
    x = (grid[near] - grid[best]).astype(np.float64)
    if len(x) < 3:
        return float(grid[best])
    a, b, _ = np.polyfit(x, curve[near], 2)
    return float(grid[best]) + (float(np.clip(-b / (2 * a), x[0], x[-1])) if a < 0 else 0.0)


def busiest(changes: Changes, most: int = MOST_FRAMES) -> slice:
    """The stretch of at most ``most`` frames in which most changes."""
    activity = np.abs(changes.changes).sum(axis=1)
    width = min(most - 1, len(activity))
    sums = np.convolve(activity, np.ones(width), "valid")
    start = int(np.argmax(sums))
    return slice(start, start + width + 1)


def some_frames(frames: Iterable[Frame], chosen: slice) -> Iterator[Frame]:
    """The frames of a stretch."""
    return islice(frames, chosen.start, chosen.stop)


def some_events(chunks: Iterable[EventArray], start: float, end: float) -> EventArray:
    """The events of a stretch, us, in one array."""
    kept: list[EventArray] = [np.empty(0, EVENT_DTYPE)]
    for chunk in chunks:
        if len(chunk) and chunk["t"][0] > end:
            break
        kept.append(between(chunk, round(start), round(end)))
    return np.concatenate(kept)


def aligned_stretch(
    frames: Callable[[], Iterable[Frame]],
    events: Callable[[], Iterable[EventArray]],
    changes: Changes,
    sensor_size: tuple[int, int],
    offset: float,
    camera: CameraSettings,
) -> tuple[Shots, EventArray]:
    """The frames of the busiest stretch, fewer of large ones, and its events.

    ``sensor_size`` is the event camera's (height, width), ``offset`` us.

    Raises
    ------
    InputError
        If there are no events while the frames were taken.
    """
    first = next(iter(frames()))
    most = _LARGEST // max(first.image[..., 0].size if first.image.ndim == 3 else first.image.size, 1)
    most = int(np.clip(min(most, _LARGEST // (2 * sensor_size[0] * sensor_size[1])), 8, MOST_FRAMES))
    shots = take_shots(some_frames(frames_apart(frames(), APART_IN_TIME), busiest(changes, most)), camera)
    begin, end = int(shots.middles[0]) + offset, int(shots.middles[-1]) + offset
    found = some_events(events(), begin - MARGIN, end + MARGIN)
    if not len(between(found, round(begin), round(end))):
        raise InputError(
            f"alignment: no events from {begin * 1e-6:.3f} to {end * 1e-6:.3f} s, while the frames that change most "
            f"were taken (with {offset * 1e-3:.1f} ms added to their times); is that their offset?"
        )
    return shots, found


def estimate_offset(
    frames: Callable[[], Iterable[Frame]],
    events: Callable[[], Iterable[EventArray]],
    registration: Registration,
    *,
    camera: CameraSettings | None = None,
    centre: float = 0.0,
    reach: int = RANGE,
) -> OffsetEstimate:
    """The offset of the frames' clock, from frames that are registered to the events.

    Parameters
    ----------
    frames, events
        Called for fresh iterators.
    registration
        From the event camera's pixels to the frames'; the identity where one sensor gives both.
    camera
        Response and I_0.
    centre, reach
        us: where to look.

    Raises
    ------
    InputError
        If frames or events are too few, or do not go together.
    """
    camera = camera if camera is not None else CameraSettings()
    changes = frame_changes(frames(), registration, camera)
    coarse = correlate(changes, events(), registration.events.sensor_size, centre=centre, reach=reach)
    shots, inside = aligned_stretch(
        frames, events, changes, registration.events.sensor_size, coarse.offset, camera
    )
    fine = align(shots, inside, registration, offset=coarse.offset, free_homography=False)
    whole = align(shots, inside, registration, offset=fine.offset, free_homography=False, spread=False)
    return OffsetEstimate(fine.offset, fine.standard_error, whole.offset, coarse)
