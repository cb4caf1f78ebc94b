"""Whether events belong to the frames as they are stored: not mirrored, and not with polarities the wrong way round.

Where light changes, the net count of a pixel's events follows the change of its frames. The correlation of both tells
at once what no fit can mend: files in which x or y of the events counts from the other side than in the images, or in
which an event of value 1 is a darker one.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.intervals import Interval, intervals
from kalux.calibration.neighbours import sum_of_neighbours
from kalux.recording import AS_STORED, EventLayout, Recording
from kalux.settings import CameraSettings

Array = NDArray[np.float64]

_MOST_FRAMES: Final = 60
_ENOUGH: Final = 5_000
"""Pixels with events in well exposed places from which no more frames are looked at."""

_LEAST: Final = 500
"""The same, from which they tell anything."""

_LARGEST_COUNT: Final = 5.0  # of a pixel between two frames: more are those of hot ones
_LARGEST_CHANGE: Final = 1.0  # of the log intensity: more are those of broken ones

_AGREE: Final = 0.5
"""Correlation from which on nothing is doubted: three real recordings have 0.58 to 0.78, 60 simulated ones 0.47 (light
that flickers by 80 %) to 0.98."""

_CERTAIN: Final = 0.4
_TIMES: Final = 2.5
"""Correlation of another layout from which it is the right one, and how many times that of the layout as stored: of
wrong ones it is up to 0.34, as some motion looks much the same in a mirror."""

_NOTHING: Final = 0.1
"""Correlation below which frames and events have nothing to do with each other."""

_COHERENT: Final = 0.3
"""Correlation of pixels with the mean of their neighbours, in counts and changes alike, from which things move: of
noise it is 0."""


class LayoutFit(NamedTuple):
    """How well events lie to the frames.

    Attributes
    ----------
    found
        The layout in which events agree with the frames.
    correlation
        Of net counts of events with changes of frames, in that layout.
    contradicts
        Whether something moves in both, but they have nothing to do with each other.
    """

    found: EventLayout
    correlation: float
    contradicts: bool = False

    @property
    def agrees(self) -> bool:
        """Whether changes of frames and events have anything to do with each other at the same time and place."""
        return self.correlation >= _CERTAIN


def find_layout(recording: Recording, camera: CameraSettings) -> LayoutFit | None:
    """In which layout events agree with the first frames; None where too few tell.

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response and saturation.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    seen, active = list[tuple[Array, Array, NDArray[np.bool_]]](), 0
    for interval in intervals(recording, camera, margin=0, most_frames=_MOST_FRAMES):
        seen.append((*_change_and_count(interval, recording.sensor_size), interval.usable))
        active += int(np.count_nonzero(seen[-1][1][interval.usable]))
        if active >= _ENOUGH:
            break
    if active < _LEAST:
        return None
    stored = _correlation(seen)
    if stored >= _AGREE:
        return LayoutFit(AS_STORED, stored)
    found = {
        (x, y): _correlation((c, n[:: -1 if y else 1, :: -1 if x else 1], u) for c, n, u in seen)
        for x in (False, True)
        for y in (False, True)
    }
    (x, y), best = max(found.items(), key=lambda item: abs(item[1]))
    if abs(best) >= max(_CERTAIN, _TIMES * stored):
        return LayoutFit(EventLayout(x, y, swapped=best < 0), abs(best))
    coherent = (
        _correlation((c, sum_of_neighbours(c), u) for c, _, u in seen),
        _correlation((n, sum_of_neighbours(n), u) for _, n, u in seen),
    )
    apart = abs(best) < _NOTHING and min(coherent) >= _COHERENT
    return LayoutFit(AS_STORED, stored, contradicts=apart)


def _change_and_count(interval: Interval, size: tuple[int, int]) -> tuple[Array, Array]:
    """(H, W) change of the log intensity, less its median, and net count of events."""
    on, off = interval.counts(size)
    usable = interval.usable
    middle = float(np.median(interval.change[usable])) if usable.any() else 0.0
    change = np.clip(interval.change - middle, -_LARGEST_CHANGE, _LARGEST_CHANGE)
    return change, np.clip(on - off, -_LARGEST_COUNT, _LARGEST_COUNT).astype(np.float64)


def _correlation(pairs: Iterable[tuple[Array, Array, NDArray[Any]]]) -> float:
    """Of two images in the pixels of a third, over all intervals, about their means; 0 where one is constant."""
    sums = np.zeros(3)
    for first, second, chosen in pairs:
        a, b = first[chosen], second[chosen]
        if len(a):
            a, b = a - a.mean(), b - b.mean()
            sums += (a * b).sum(), (a * a).sum(), (b * b).sum()
    both, left, right = sums.tolist()
    return both / float(np.sqrt(left * right)) if left * right > 0 else 0.0
