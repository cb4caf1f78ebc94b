"""What the light does within an exposure, as its events tell: a frame shows the mean, which is that of no moment.

The filters deblur frames by the same double integral (`kalux.augmentation.deblur`), with the thresholds of every pixel
and a weight for every event. Calibrations look at frames before these are known.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.deblur import between
from kalux.compiled import empty, event_column, event_is_on, event_row, event_words, loop
from kalux.events import EventArray

Array = NDArray[np.float64]


class Bends(NamedTuple):
    """By how much the logarithm of what a frame shows, the mean of the light, is more than others, (H, W) each.

    Attributes
    ----------
    over_mean
        Than the mean of the logarithm.
    over_middle
        Than the logarithm at the middle of the exposure.
    """

    over_mean: Array
    over_middle: Array


def bends(
    events: EventArray, sensor_size: tuple[int, int], start: int, end: int, thresholds: tuple[float, float]
) -> Bends:
    """Of an exposure from ``start`` to ``end`` (us), by the thresholds on and off, log intensity.

    Between events the light is taken to be at the level of the last one. Where nothing happens nothing bends.
    """
    height, width = sensor_size
    words = event_words(between(events, start, end))
    found = np.zeros((2, height * width))
    if len(words) > 0:
        steps = np.array([thresholds[0], -thresholds[1]])
        ends = start, (start + end) // 2, end
        _follow(words, np.uint64(width), ends, steps, np.full(height * width, -1, np.int32), *found)
    return Bends(*found.reshape(2, height, width))


@loop
def _follow(words, width, ends, steps, place, over_mean, over_middle):  # type: ignore[no-untyped-def]
    """``place``: where a pixel's path is kept, -1 as long as it has no event."""
    start, middle, end = ends
    # Level after the last event, us until that, integrals of level and exp(level) until then, level at the middle.
    paths = empty((len(words), 5), np.float64)
    pixels = empty(len(words), np.int64)
    count = 0
    for i in range(len(words)):
        word = words[i, 1]
        at = event_row(word) * width + event_column(word)
        if place[at] < 0:
            place[at] = count
            pixels[count] = at
            for k in range(5):
                paths[count, k] = 0.0
            count += 1
        path = paths[place[at]]
        since = float(words[i, 0] - start)
        held = since - path[1]
        path[2] += path[0] * held
        path[3] += np.exp(path[0]) * held
        path[0] += steps[np.uint64(not event_is_on(word))]
        path[1] = since
        if words[i, 0] <= middle:
            path[4] = path[0]
    length = float(end - start)
    for n in range(count):
        path, at = paths[n], pixels[n]
        rest = length - path[1]
        log_mean = np.log((path[3] + np.exp(path[0]) * rest) / length)
        over_mean[at] = log_mean - (path[2] + path[0] * rest) / length
        over_middle[at] = log_mean - path[4]
