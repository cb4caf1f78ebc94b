"""Noise of both sensors from a recording: background events, hot and dead pixels, frame noise, clipping levels.

Everything is taken from where nothing happens. A pixel is *quiet* while its eight neighbours have been silent for 10 ms
and stay so for 10 ms; what it says then is noise, and the quiet time itself is known exactly, so that the rate needs no
correction. Frame noise is in `kalux.calibration.frame_noise`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.black_level import with_known_black
from kalux.calibration.delay import estimate_delay
from kalux.calibration.fixed_pattern import FixedPattern, estimate_fixed_pattern
from kalux.calibration.frame_noise import FrameNoise, estimate_frame_noise, noise_at, usual_noise
from kalux.calibration.global_thresholds import Usual, with_true_delay
from kalux.calibration.hot_pixels import find_hot_pixels
from kalux.calibration.levels import ClippingLevels, clipping_levels
from kalux.calibration.moving_noise import MovingNoise, told_by_motion
from kalux.calibration.refractory import dead_time, shortest_interval
from kalux.calibration.region import Region, widened
from kalux.calibration.regression import ratio_error
from kalux.calibration.silences import Silence, find_silences
from kalux.calibration.values import Calibration
from kalux.compiled import inner, larger, loop, smaller
from kalux.event_slices import events_until, first_events
from kalux.events import NEVER, EventArray
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings

Array = NDArray[np.float64]

QUIET: Final = 10_000
"""us around a neighbour's event in which a pixel is not quiet: what an edge at 100 pixels/s takes for a pixel. Slower
ones take longer, so that twice the time and more is tried (`event_noise`)."""

MAX_FRAMES: Final = 400
_WINDOW: Final = 100_000  # us
_BLOCK: Final = 16  # pixels
_NEARLY: Final = 0.85
_LEAST_QUIET: Final = 0.01  # of the sensor's time
_CLEARLY: Final = 2.0  # standard errors by which a rate is less than another one
_UNUSUAL_FACTOR: Final = 10.0  # times the typical rate
_UNUSUAL_SIGNIFICANCE: Final = 8.0  # standard deviations above the typical count
_UNUSUAL_LEAST: Final = 5  # events
_LEAST_IMPROVEMENT: Final = 0.03
"""Share of the residual that a delay must explain. Frames once a second are explained as well by any of some
milliseconds: the best one, 3.7 ms, explains 1 % more than none, where the truth is less than one."""

_DEAD_EXPECTED: Final = 25.0  # events of the neighbours' median, of a pixel that says nothing


class EventNoise(NamedTuple):
    """Background events.

    Attributes
    ----------
    rate
        Hz per pixel, of usual ones: a few that fire ten times as often do not count.
    rate_error
        Standard error from the spread over parts of the sensor and of time, Hz.
    rates
        (H, W) Hz: of every pixel, shrunk towards ``rate`` as far as it was seldom quiet.
    dead
        (H, W) bool: pixels that say nothing where all neighbours do.
    quiet_share
        Share of the sensor's time that was quiet; of a region of interest's.
    """

    rate: float
    rate_error: float
    rates: Array
    dead: NDArray[np.bool_]
    quiet_share: float


@dataclass(frozen=True, eq=False)
class NoiseCalibration:
    """All that is measured of a sensor's noise; None where the recording does not tell it.

    Attributes
    ----------
    hot
        (H, W) bool: pixels that fire without reason (`kalux.calibration.hot_pixels`).
    events
        Background events of the others, dead pixels.
    frames, moving, pattern
        Read and shot noise of frames, of what stands still; of what moves, where that tells it instead; and their fixed
        pattern.
    black_level
        What was taken off the frames, a share of white, given or found; None: nothing, or what they state themselves.
    levels
        Where frames clip.
    delay, apparent_delay
        Of the events, us (`kalux.calibration.delay`); the former only if it explains the frames clearly better.
    refractory_at_most
        Shortest time between two events of a pixel that is not chance, us: no refractory period is longer.
    """

    hot: NDArray[np.bool_]
    events: EventNoise | None
    frames: FrameNoise | None
    moving: MovingNoise | None
    pattern: FixedPattern | None
    black_level: float | None
    levels: ClippingLevels
    delay: int | None
    apparent_delay: int | None
    refractory_at_most: int | None

    def calibration(self) -> Calibration:
        """As settings with standard errors, and maps of the pixels."""
        events: dict[str, float | int] = {}
        camera: dict[str, float] = {}
        errors: dict[str, float] = {}
        measured: dict[str, float | int] = {"hot_pixels": int(self.hot.sum())}
        maps: dict[str, NDArray[np.generic]] = {"hot": self.hot}
        if self.events is not None:
            events["noise_rate"] = self.events.rate
            errors["noise_rate"] = self.events.rate_error
            measured |= {
                "dead_pixels": int(self.events.dead.sum()),
                "quiet_share": self.events.quiet_share,
            }
            maps |= {"dead": self.events.dead, "noise_rate": self.events.rates}
        if self.apparent_delay is not None:
            measured["apparent_delay"] = self.apparent_delay
        if self.delay is not None:
            events["delay"] = self.delay
        if self.refractory_at_most is not None:
            measured["refractory_at_most"] = self.refractory_at_most
        if self.moving is not None:
            camera |= {"frame_noise": self.moving.read, "shot_noise": self.moving.shot}
            measured["noise_at_half"] = noise_at(self.moving.read, self.moving.shot, 0.5)
        elif self.frames is not None:
            if self.frames.is_reliable:
                camera |= {"frame_noise": self.frames.read, "shot_noise": self.frames.shot}
                errors |= {
                    "frame_noise": self.frames.error * self.frames.read,
                    "shot_noise": 2 * self.frames.error * self.frames.shot,
                }
            measured["noise_at_half"] = self.frames.at_half
        if self.pattern is not None and self.pattern.deviation > 0:
            camera["fixed_pattern"] = self.pattern.deviation
            errors["fixed_pattern"] = self.pattern.error / (2 * self.pattern.deviation)
        if self.levels.saturation is not None:
            # No setting: of a sky or a wall pixels pile up, too (`kalux.calibration.levels` asks events).
            measured["white_level"] = self.levels.saturation
        if self.levels.black is not None:
            measured["dark_level"] = self.levels.black
        if self.black_level is not None:
            camera["black_level"] = self.black_level
        settings = {"camera": camera, "events": events}
        return Calibration({g: v for g, v in settings.items() if v}, errors, measured, maps)


def calibrate_noise(
    recording: Recording,
    camera: CameraSettings,
    hot: NDArray[np.bool_] | None = None,
    *,
    is_compressed: bool = False,
) -> NoiseCalibration:
    """Measure the noise of a recording's sensor.

    Parameters
    ----------
    recording
        With frames and exposures; a still camera, or still parts of the scene, tell most.
    camera
        Response, saturation and black level; where that is None and events show one, it is taken off.
    hot
        (H, W): pixels that are hot, whose events may be left out of the recording; None: they are looked for.
    is_compressed
        Whether frames have been compressed, so that what moves has less fine noise than there is.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    hot = find_hot_pixels(recording) if hot is None else hot
    recording, _ = with_known_black(recording, camera, EventSettings())
    delay = estimate_delay(recording, camera)
    if delay is not None:
        period = dead_time(recording)
        delay = with_true_delay(recording, camera, delay, Usual.of(EventSettings()), refractory_period=period)
    frames = estimate_frame_noise(recording, camera, most_frames=MAX_FRAMES)
    pattern = estimate_fixed_pattern(recording, camera)
    moving = None
    if pattern is not None and pattern.is_measured and pattern.deviation == 0 and not is_compressed:
        still = frames if frames is not None and frames.is_reliable else None
        noise = usual_noise(recording, camera) if still is None else still
        moving = told_by_motion(recording, camera, (noise.read, noise.shot), is_seen=still is not None)
    return NoiseCalibration(
        hot=hot,
        events=event_noise(recording, known_hot=hot),
        frames=frames,
        moving=moving,
        pattern=pattern,
        black_level=recording.black_level or camera.black_level,
        levels=clipping_levels(recording, MAX_FRAMES),
        delay=None if delay is None or delay.improvement < _LEAST_IMPROVEMENT else delay.delay,
        apparent_delay=None if delay is None else delay.apparent,
        refractory_at_most=shortest_interval(recording) or None,
    )


# --- events ---------------------------------------------------------------------------------------------------


def event_noise(
    recording: Recording,
    most_events: int | None = None,
    known_hot: NDArray[np.bool_] | None = None,
    *,
    enough: float = 0.0,
) -> EventNoise | None:
    """Background rate and dead pixels, from the first ``most_events``, or all; ``known_hot`` ones do not count.

    Single events of slow or faint edges look like noise. The longer their neighbours must have been quiet and stay so,
    the fewer of them count, but the less is quiet: the time is doubled as long as the rate falls by more than two of
    its errors, down to ``enough`` (Hz).

    Pixels beyond a region of interest do not count either, being silent because they are off
    (`kalux.calibration.region`), nor do times in which events have been lost (`kalux.calibration.silences`).

    Returns None without events, or where next to nothing is ever quiet (1 %).
    """
    known = np.zeros(recording.sensor_size, np.bool_) if known_hot is None else known_hot
    first, last, region = _span(recording, most_events, known)
    if first is None or last is None or region is None or last <= first:
        return None
    inside = region.mask(recording.sensor_size)
    silences = sorted(find_silences(recording, end=last))

    def tallied(gap: int, ignored: NDArray[np.bool_]) -> _Tally:
        return _tallied(_chunks(recording, most_events, known), first, last, gap, ignored, silences)

    of_all = tallied(QUIET, known)
    # Where the region is never quiet, the rest may be so because it is still.
    for part in (inside, np.ones_like(inside)):
        tally = of_all
        unusual = _unusual_pixels(tally, part) | known
        if (unusual & ~known).any():  # again without them: their neighbours are quiet after all
            tally = tallied(QUIET, unusual)
        tally = tally._replace(quiet=tally.quiet * part)
        share = _quiet_share(tally, part, last - first)
        if share >= _LEAST_QUIET or part.all():
            break
    if share < _LEAST_QUIET:
        return None
    blocks = _of_blocks(tally, unusual, part)
    quietest = blocks.quietest
    rate, error = _typical_rate(blocks, quietest)
    gap = QUIET
    while rate > enough:
        gap *= 2
        longer = tallied(gap, unusual)
        longer = longer._replace(quiet=longer.quiet * part)
        longer_share = _quiet_share(longer, part, last - first)
        # Of the same blocks: chosen by longer times, those would count that have less noise by chance.
        blocks = _of_blocks(longer, unusual, part)
        if longer_share < _LEAST_QUIET or not blocks.quiet[quietest].any():
            break
        longer_rate, longer_error = _typical_rate(blocks, quietest)
        if longer_rate + _CLEARLY * longer_error >= rate:
            break
        tally, share, rate, error = longer, longer_share, longer_rate, longer_error
    counts = tally.counts.sum(axis=0).astype(np.float64)
    quiet = (tally.quiet.sum(axis=0) * 1e-6).astype(np.float64, copy=False)
    rates = shrunk_rates(counts, quiet, rate, unusual)
    return EventNoise(rate, error, rates, _dead_pixels(tally.all) & ~known, share)


def _quiet_share(tally: _Tally, part: NDArray[np.bool_], duration: int) -> float:
    """Of the time of ``part`` (H, W), ``duration`` us, beyond which nothing is quiet."""
    return float(tally.quiet.sum() / (np.count_nonzero(part) * duration))


def _chunks(
    recording: Recording, most_events: int | None, ignored: NDArray[np.bool_]
) -> Iterator[EventArray]:
    chunks: Iterator[EventArray] = iter(recording.events())
    if ignored.any():
        chunks = (chunk[~ignored[chunk["y"], chunk["x"]]] for chunk in recording.events())
    return first_events(chunks, most_events)


def _span(
    recording: Recording, most_events: int | None, known: NDArray[np.bool_]
) -> tuple[int | None, int | None, Region | None]:
    """When events begin and end, us, and where they lie."""
    first = last = region = None
    for chunk in _chunks(recording, most_events, known):
        first = int(chunk["t"][0]) if first is None else first
        last = int(chunk["t"][-1])
        region = widened(region, chunk)
    return first, last, region


class _Tally(NamedTuple):
    """Per window of time and pixel (N, H, W): events while quiet, quiet time (us); (H, W) all events."""

    counts: NDArray[np.int32]
    quiet: NDArray[np.int64]
    all: NDArray[np.int64]


_MOST_WINDOWS: Final = 32


def _tallied(
    chunks: Iterator[EventArray],
    first: int,
    last: int,
    gap: int,
    ignored: NDArray[np.bool_],
    silences: list[Silence],
) -> _Tally:
    """Count events in quiet time; those of ignored pixels do not end their neighbours' quiet.

    What lies in the ``silences``, which follow one another, is no quiet time.
    """
    height, width = ignored.shape
    windows = int(np.clip((last - first) // _WINDOW, 1, _MOST_WINDOWS))
    length = (last - first) / windows
    counts = np.zeros((windows, height, width), np.int32)
    quiet = np.zeros((windows, height, width), np.int64)
    total = np.zeros((height, width), np.int64)
    busy_until = np.full((height, width), first, np.int64)  # silence before the first event is not known
    # An event in quiet time, until its future is quiet, too.
    pending = np.full((height, width), NEVER, np.int64)
    left = deque(silences)
    for chunk in chunks:
        while left and chunk["t"][-1] >= left[0][1]:
            begin, end = left.popleft()
            place = events_until(chunk, end - 1)
            before, chunk = chunk[:place], chunk[place:]
            _tally(*_columns(before), first, length, gap, ignored, busy_until, pending, counts, quiet, total)
            _close(begin, first, length, gap, busy_until, pending, counts, quiet)
            busy_until.fill(end)  # as before the first event
            pending.fill(NEVER)
        _tally(*_columns(chunk), first, length, gap, ignored, busy_until, pending, counts, quiet, total)
    _close(last, first, length, gap, busy_until, pending, counts, quiet)
    return _Tally(counts, quiet, total)


def _columns(events: EventArray) -> tuple[NDArray[np.generic], ...]:
    """Times, columns and rows."""
    return tuple(events[name] for name in ("t", "x", "y"))


@inner
def _add_quiet(start, end, first, length, row, column, quiet):  # type: ignore[no-untyped-def]
    """Spread the quiet time from start to end over the windows."""
    while start < end:
        window = smaller(np.int64((start - first) / length), quiet.shape[0] - 1)
        stop = (
            end if window == quiet.shape[0] - 1 else smaller(end, first + np.int64((window + 1) * length) + 1)
        )
        stop = larger(stop, start + 1)  # over hundreds of years a float's step is more than 1 us
        quiet[window, row, column] += stop - start
        start = stop


@nb.njit(cache=True, nogil=True, inline="always")
def _count_pending(pending, row, column, first, length, counts):  # type: ignore[no-untyped-def]
    """Count a pixel's pending event, if it has one, in the window of its time."""
    if pending[row, column] != NEVER:
        window = smaller(np.int64((pending[row, column] - first) / length), counts.shape[0] - 1)
        counts[window, row, column] += 1


@loop
def _tally(t, x, y, first, length, gap, ignored, busy_until, pending, counts, quiet, total):  # type: ignore[no-untyped-def]
    height, width = total.shape
    for i in range(len(t)):
        now, row, column = t[i], y[i], x[i]
        total[row, column] += 1
        # The pixel's own event is noise if it is in quiet time before, and no neighbour follows: of one that waits for
        # that it is known now.
        if now >= busy_until[row, column]:
            _count_pending(pending, row, column, first, length, counts)
            pending[row, column] = now
        if ignored[row, column]:
            continue
        for r in range(larger(0, row - 1), smaller(height, row + 2)):
            for c in range(larger(0, column - 1), smaller(width, column + 2)):
                if r == row and c == column:
                    continue
                # Quiet until `gap` before this event.
                end = now - gap
                if end > busy_until[r, c]:
                    _add_quiet(busy_until[r, c], end, first, length, r, c, quiet)
                if pending[r, c] <= end:
                    _count_pending(pending, r, c, first, length, counts)
                pending[r, c] = NEVER
                busy_until[r, c] = larger(busy_until[r, c], now + gap)


@loop
def _close(last, first, length, gap, busy_until, pending, counts, quiet):  # type: ignore[no-untyped-def]
    """Add the quiet time up to the end of the recording, and count pending events that lie in it."""
    end = last - gap
    for row in range(busy_until.shape[0]):
        for column in range(busy_until.shape[1]):
            if end > busy_until[row, column]:
                _add_quiet(busy_until[row, column], end, first, length, row, column, quiet)
            if pending[row, column] <= end:
                _count_pending(pending, row, column, first, length, counts)


def _unusual_pixels(tally: _Tally, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels that fire in quiet time ten times as often as is typical ``inside``, and far more often than by chance.

    They say nothing of the typical rate. That does not make them hot: it may be far below what harms.
    """
    counts, quiet = tally.counts.sum(axis=0), tally.quiet.sum(axis=0) * inside
    unusual = np.zeros(counts.shape, np.bool_)
    for _ in range(5):
        rate = int(counts[~unusual].sum()) / max(int(quiet[~unusual].sum()), 1)
        expected = rate * quiet
        excess = counts - expected
        found = (
            (counts >= _UNUSUAL_LEAST)
            & (counts > _UNUSUAL_FACTOR * expected)
            & (excess > _UNUSUAL_SIGNIFICANCE * np.sqrt(expected + 0.25))
        )
        if (found == unusual).all():
            break
        unusual = found
    return unusual


class _Blocks(NamedTuple):
    """Of every window of time and block of pixels, (N, M) each: events while quiet, quiet time and all time, s."""

    counts: Array
    quiet: Array
    possible: Array

    @property
    def quietest(self) -> NDArray[np.bool_]:
        """(N, M): those that are nearly (85 %) as quiet as any.

        Where something moves, faint edges make single events, too, so that the busier blocks say little. Noise itself
        makes all of them less quiet alike.
        """
        share = self.quiet / np.maximum(self.possible, 1)
        there = self.possible > 0
        return there & (self.quiet > 0) & (share >= _NEARLY * np.quantile(share[there], 0.95))


def _of_blocks(tally: _Tally, unusual: NDArray[np.bool_], inside: NDArray[np.bool_]) -> _Blocks:
    """Sums over blocks of usual pixels; they begin where the region does that is ``inside``."""
    height, width = unusual.shape
    rows, columns = -(-height // _BLOCK), -(-width // _BLOCK)
    top, left = (int(np.argmax(inside.any(axis=axis))) for axis in (1, 0))
    row, column = (np.arange(height) - top) // _BLOCK, (np.arange(width) - left) // _BLOCK
    index = row[:, None] * columns + column
    good = ~unusual & inside
    size = rows * columns
    counts = np.array([np.bincount(index[good], c[good], size) for c in tally.counts])
    quiet = np.array([np.bincount(index[good], q[good], size) for q in tally.quiet]) * 1e-6
    full = np.bincount(index[good], minlength=size)
    return _Blocks(counts, quiet, np.tile(full, (len(tally.counts), 1)).astype(np.float64))


def _typical_rate(blocks: _Blocks, used: NDArray[np.bool_]) -> tuple[float, float]:
    """Hz per pixel, and its standard error, of the ``used`` blocks and windows of time, (N, M) bool."""
    counts, quiet = blocks.counts * used, blocks.quiet * used
    rate = counts.sum() / quiet.sum()
    by_block = np.array([counts.sum(axis=0), quiet.sum(axis=0)]).T
    return float(rate), ratio_error(by_block[by_block[:, 1] > 0])


def shrunk_rates(counts: Array, quiet: Array, rate: float, unusual: NDArray[np.bool_]) -> Array:
    """Noise rate of every pixel, Hz, by a gamma prior whose spread is that of the pixels (method of moments).

    Parameters
    ----------
    counts, quiet
        (H, W) events in quiet time, and that time, s.
    rate
        The typical one, Hz.
    unusual
        (H, W) bool: pixels that neither widen the prior nor are shrunk.
    """
    good = ~unusual & (quiet > 0)
    expected = rate * quiet[good]
    if rate <= 0 or not good.any():
        return np.full(counts.shape, rate)
    extra = ((counts[good] - expected) ** 2 - expected).sum() / max((expected**2).sum(), 1e-12)
    shape = 1.0 / min(max(float(extra), 1e-3), 10.0)
    rates = (counts + shape) / (quiet + shape / rate)
    return np.asarray(np.where(unusual & (quiet > 0), counts / np.maximum(quiet, 1e-9), rates), np.float64)


def _dead_pixels(total: NDArray[np.int64]) -> NDArray[np.bool_]:
    around = cv2.medianBlur(total.clip(0, 65535).astype(np.uint16), 5)
    return np.asarray((total == 0) & (around >= _DEAD_EXPECTED), np.bool_)
