"""Whether the rows of frames are exposed one after the other, and how much later each is (docs/equations.md, K19)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from itertools import islice
from typing import Final

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.delay import estimate_delay
from kalux.frames import Frame
from kalux.recording import Recording, with_frames
from kalux.settings import CameraSettings

_BANDS: Final = 4
"""Parts of an image, one above the other, of which each has a delay of its own."""

_FEWEST: Final = 3  # of them: two always lie on a line

_MOST_FRAMES: Final = 40

_LEAST: Final = 4_000
"""us from the first row to the last from which a shutter is taken to be rolling. Pixels are later the darker they are,
so that a sky above dark ground looks like one: one of 148 simulated recordings without is taken for it, of 8 ms."""

_OFF_LINE: Final = 1 / 8
"""Of this time: how far the bands may be off a line, root mean square. It is up to 0.06 with rolling shutters."""


def estimate_row_time(recording: Recording, camera: CameraSettings) -> float | None:
    """How much later than the row above each row is exposed, us: by the delay of the events in parts of the image.

    To within a tenth on six simulated scenes of 12 ms from the first row to the last. Negative if the lowest row is the
    first.

    Parameters
    ----------
    recording
        With frames and exposures, less its black level.
    camera
        Response and saturation.

    Returns
    -------
    None where too little moves to tell, where delays do not grow evenly from row to row, and where there are less than
    4 ms from the first row to the last.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    height = recording.sensor_size[0]
    told = list[tuple[float, int]]()
    for band in range(_BANDS):
        top, bottom = (k * height // _BANDS for k in (band, band + 1))
        found = estimate_delay(_band(recording, top, bottom), camera)
        if found is not None:
            told.append(((top + bottom - 1) / 2, found.apparent))
    if len(told) < _FEWEST:
        return None
    rows, delays = np.array(told).T
    slope, level = np.polyfit(rows, delays, 1)
    off = float(np.sqrt(np.mean(np.square(delays - slope * rows - level))))
    span = abs(float(slope)) * height
    return float(slope) if span >= _LEAST and off <= _OFF_LINE * span else None


def _band(recording: Recording, top: int, bottom: int) -> Recording:
    """The recording whose first frames say something in some of their rows alone."""

    def frames() -> Iterator[Frame]:
        for frame in islice(recording.frames(), _MOST_FRAMES):
            inside: NDArray[np.bool_] = np.zeros(frame.image.shape[:2], np.bool_)
            inside[top:bottom] = True if frame.valid is None else frame.valid[top:bottom]
            yield dataclasses.replace(frame, valid=inside)

    return with_frames(recording, frames)
