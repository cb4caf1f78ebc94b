"""What pixels and their neighbours saw between two frames: the events, and by how much the frames changed.

Frames show means over their exposures. To first order a mean of logarithms is the logarithm of the mean, so that an
event within the first exposure has changed the first frame by the share of the exposure that was still to come, and
counts for the rest; one within the second counts for the share that was still to come of that. No threshold has to be
known for it, unlike for deblurring (EDI), and it takes out as much: left out, thresholds come out 5 to 8 % too small
where exposures last for two thirds of the frame interval.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.deblur import between
from kalux.augmentation.refractory import step_weight
from kalux.calibration.intervals import Interval, intervals
from kalux.compiled import ONE, event_column, event_is_on, event_row, event_words
from kalux.recording import Recording
from kalux.settings import CameraSettings

Array = NDArray[np.float64]

MAX_SAMPLES: Final = 100_000
"""Pixels that are enough: the standard error of thresholds is then below 1 %."""

_MAX_OF_INTERVAL: Final = (
    25_000  # evenly from all of the image: several intervals differ more than pixels of one
)
_MAX_FRAMES: Final = 200
_LEAST_AROUND: Final = 8.0  # events of the eight neighbours: where less happens it may be noise
_LEAST_NEIGHBOURS: Final = 4  # that frames show well

_ALIKE: Final = 0.3
"""Log intensity by which the changes of neighbours that see the same edge differ, as in `filter.neighbours`: others are
weighed down. A slow edge is at one pixel after the other; without, it makes thresholds a quarter too large."""

_NEVER: Final = -(1 << 60)


class Steps(NamedTuple):
    """Pixels of frame intervals, (N,), for several refractory periods, P.

    Attributes
    ----------
    change
        Of log(I + I_0) between the frames.
    change_around
        Mean of the same of the neighbours, weighed by how alike these change.
    level
        Mean I of both frames.
    events, events_around
        (N, P, 2, 2): sums of the weights (K13) of the pixel's own events, and such means of its neighbours'; those that
        come late after their predecessors first and those that follow soon second, of either on first and off second.
    turned, turned_around
        Change of the sign of the pixel's newest event, halved, and such a mean of its neighbours'.
    pixel
        Index of the pixel.
    """

    change: Array
    change_around: Array
    level: Array
    events: Array
    events_around: Array
    turned: Array
    turned_around: Array
    pixel: NDArray[np.int64]


def steps(
    recording: Recording, camera: CameraSettings, *, delay: int, periods: tuple[int, ...], late: float
) -> Steps:
    """Well exposed pixels around which something happens, of the first 200 frames or as many as it takes.

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response and I_0.
    delay
        How much later than the frames' clock events are stamped, us.
    periods
        (P,) refractory periods, us.
    late
        us after its predecessor from which on an event is late.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    longest = max((frame.exposure for frame in recording.frames()), default=0)
    passing = _Passing(recording.sensor_size, periods, late)
    found: list[Steps] = []
    count = 0
    for interval in intervals(recording, camera, margin=longest + abs(delay), most_frames=_MAX_FRAMES):
        found.append(passing.of(interval, delay))
        count += len(found[-1].change)
        if count >= MAX_SAMPLES:
            break
    if not found:
        none = np.empty(0)
        counts = np.empty((0, len(periods), 2, 2))
        return Steps(none, none, none, counts, counts, none, none, np.empty(0, np.int64))
    return Steps(*(np.concatenate(values) for values in zip(*found, strict=True)))


class _Passing:
    """What is known of every pixel as the intervals pass."""

    def __init__(self, sensor_size: tuple[int, int], periods: tuple[int, ...], late: float) -> None:
        height, width = sensor_size
        self._shape = sensor_size
        self._periods, self._late = np.array(periods, np.float32), np.float32(late)
        self._latest = np.full(height * width, _NEVER, np.int64)
        self._sign_before = np.zeros(height * width, np.float32)
        self._sign = np.zeros(height * width, np.float32)
        self._seen_until = _NEVER

    def of(self, interval: Interval, delay: int) -> Steps:
        """The pixels of the next interval."""
        height, width = self._shape
        first, second = interval.first, interval.second
        times = np.array([first.start, first.end, interval.start, interval.end, second.start, second.end])
        every = np.zeros((height * width, len(self._periods), 2, 2), np.float32)
        # The second exposure is the next interval's first: what was known at its start is kept for that.
        apart = second.start + delay
        for start, end in ((self._seen_until, apart), (apart, second.end + delay)):
            latest = self._latest if end == apart else self._latest.copy()
            words = event_words(between(interval.events, start, end))
            _count(
                words,
                np.uint64(width),
                times + delay,
                latest,
                self._sign_before,
                self._sign,
                self._periods,
                self._late,
                every,
            )
        self._seen_until = apart
        turned = (self._sign - self._sign_before) / 2
        self._sign_before[:] = self._sign
        counts = every.reshape(height, width, 4 * len(self._periods))
        usable, change = interval.usable, interval.change
        candidates = np.flatnonzero(_something_happens(counts, usable))
        chosen = candidates[:: max(-(-len(candidates) // _MAX_OF_INTERVAL), 1)]
        shape = len(chosen), len(self._periods), 2, 2
        own, around, turned_around, change_around = _looked_at(
            counts, turned.reshape(self._shape), change, usable, chosen
        )
        return Steps(
            change.ravel()[chosen],
            change_around,
            interval.level.ravel()[chosen],
            own.reshape(shape),
            around.reshape(shape),
            turned.ravel()[chosen].astype(np.float64),
            turned_around,
            chosen,
        )


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _count(words, width, times, latest, sign_before, sign, periods, late, counts):  # type: ignore[no-untyped-def]
    begin, first_end, before, after, second_start, end = times
    for i in range(len(words)):
        t, word = words[i, 0], words[i, 1]
        at = event_row(word) * width + event_column(word)
        since = np.float32(t - latest[at])
        latest[at] = t
        on = event_is_on(word)
        if t <= before:
            sign_before[at] = sign[at] = ONE if on else -ONE
        elif t <= after:
            sign[at] = ONE if on else -ONE
        if t <= begin:
            continue
        share = ONE
        if t < first_end:
            share = np.float32(t - begin) / np.float32(first_end - begin)
        if t > second_start:
            share *= np.float32(end - t) / np.float32(end - second_start)
        soon, off = np.uint64(since < late), np.uint64(not on)
        for k in range(len(periods)):
            counts[at, k, soon, off] += share * step_weight(since, periods[k])


@nb.njit(cache=True, nogil=True)
def _something_happens(counts, usable):  # type: ignore[no-untyped-def]
    """(H, W): well exposed pixels not at the border whose neighbours have enough events."""
    height, width, _ = counts.shape
    total = np.empty((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            total[row, column] = counts[row, column, :4].sum()
    found = np.zeros((height, width), np.bool_)
    for row in range(1, height - 1):
        for column in range(1, width - 1):
            if usable[row, column]:
                around = -total[row, column]
                neighbours = -1
                for i in range(row - 1, row + 2):
                    for j in range(column - 1, column + 2):
                        around += total[i, j]
                        neighbours += usable[i, j]
                found[row, column] = around >= _LEAST_AROUND and neighbours >= _LEAST_NEIGHBOURS
    return found


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _looked_at(counts, turned, change, usable, chosen):  # type: ignore[no-untyped-def]
    """Counts of the chosen pixels, and of their neighbours the mean counts, turns and changes."""
    width, size = counts.shape[1:]
    own, around = np.empty((len(chosen), size)), np.zeros((len(chosen), size))
    turned_around, change_around = np.zeros(len(chosen)), np.zeros(len(chosen))
    for n in range(len(chosen)):
        row, column = chosen[n] // width, chosen[n] % width
        own[n] = counts[row, column]
        total = 0.0
        for i in range(row - 1, row + 2):
            for j in range(column - 1, column + 2):
                if usable[i, j] and not (i == row and j == column):
                    weight = 1.0 / (1.0 + ((change[i, j] - change[row, column]) / _ALIKE) ** 2)
                    around[n] += weight * counts[i, j]
                    turned_around[n] += weight * turned[i, j]
                    change_around[n] += weight * change[i, j]
                    total += weight
        around[n] /= total
        turned_around[n] /= total
        change_around[n] /= total
    return own, around, turned_around, change_around
