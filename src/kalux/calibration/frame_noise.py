"""Read and shot noise of frames, from pixels that see no event: the photon transfer curve of a recording.

Where nothing happens, two frames differ by their noise. What is faint but has an extent (light that flickers, a soft
edge that creeps below the threshold) changes neighbours alike, while noise is each pixel's own: of the difference of
two frames only what a pixel has beyond the mean of its four neighbours counts. On simulated recordings with noise of a
quarter of a level, of which everything moves, that is a quarter of what the differences themselves say.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.deblur import between, count_events
from kalux.calibration.intervals import Interval, intervals
from kalux.frames import Frame
from kalux.recording import Recording
from kalux.settings import CameraSettings

Array = NDArray[np.float64]

MAX_FRAMES: Final = 80

_BEYOND_NEIGHBOURS: Final = np.array([[0, -0.25, 0], [-0.25, 1, -0.25], [0, -0.25, 0]])

_BINS: Final = 32  # of the intensity, 1 = saturated
_LEAST: Final = 200  # pixels of a frame pair in a bin
_DARKEST: Final = 0.01  # two to three levels of 8 bits: below, black cuts the noise off


_SPAN: Final = 3.0
_BELIEVED: Final = 0.3


class FrameNoise(NamedTuple):
    """Photon transfer: variance = read^2 + shot * intensity, white = 1.

    Attributes
    ----------
    read, shot
        Standard deviation in the dark, and variance per intensity: `kalux.settings.CameraSettings.frame_noise` and
        ``shot_noise``.
    error
        Relative standard error of the standard deviation, from the scatter of the points. Larger than 0.3, and the
        curve is not one: something else changes the frames.
    levels, variances
        The points of the curve; of a response that is not linear, variances times f^w (5), by which (6) divides again.
    """

    read: float
    shot: float
    error: float
    levels: Array
    variances: Array

    @property
    def believed(self) -> bool:
        """Whether the points lie on a line well enough to be taken as settings."""
        return self.error < _BELIEVED

    @property
    def at_half(self) -> float:
        """Standard deviation at half of white."""
        return float(np.sqrt(self.read**2 + self.shot / 2))


def estimate_frame_noise(
    recording: Recording, camera: CameraSettings, *, most_frames: int = MAX_FRAMES
) -> FrameNoise | None:
    """Photon transfer curve of pixels without events nearby from one exposure's start to the next one's end.

    In units of the intensity of a saturated pixel of the frames, by levels; the median over frame pairs, so that pairs
    with faint motion do not count. Read noise is no less than `rounding_error`. None where fewer than two
    levels are seen, each by 200 pixels of a frame pair.

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response and saturation.
    most_frames
        Only so many frames from the start are looked at.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    # Where noise leaves no pixel without events in 5x5 around it, 3x3 must do; it lets more faint motion in.
    points = _points(recording, camera, most_frames)
    chosen = next((found for found in points if sum(map(bool, found)) >= 2), None)
    if chosen is None:
        return None
    seen = [np.array(found) for found in chosen if found]
    levels, variances = (np.array([np.median(found[:, i]) for found in seen]) for i in range(2))
    weights = np.array([np.sqrt(found[:, 2].sum()) for found in seen])
    found = photon_transfer(levels, variances, weights)
    first = next(iter(recording.frames()))
    return found._replace(read=max(found.read, rounding_error(first)))


def rounding_error(frame: Frame) -> float:
    """Half a level, white = 1; 0 for images of floating point.

    The most that rounding can change, not its standard deviation, 1 / sqrt(12): where noise is less than a level it is
    the same error in every frame, which no mean takes away.
    """
    return 0.0 if frame.image.dtype.kind == "f" else 0.5 / frame.white_value


_Points = list[list[tuple[float, float, int]]]


def _points(recording: Recording, camera: CameraSettings, most_frames: int) -> tuple[_Points, _Points]:
    """By bins of the level: level, variance and number of pixels of every frame pair; for 5x5 and 3x3 pixels."""
    found: tuple[_Points, _Points] = ([[] for _ in range(_BINS)], [[] for _ in range(_BINS)])
    longest = max((frame.exposure for frame in recording.frames()), default=0)
    for interval in intervals(recording, camera, margin=longest, most_frames=most_frames):
        if not 0.9 < interval.first.white / interval.second.white < 1.1:
            continue
        level, difference, usable = _beyond_neighbours(interval)
        events = between(interval.events, interval.first.start, interval.second.end)
        on, off = count_events(events, recording.sensor_size)
        busy = (on + off > 0).astype(np.uint8)
        for points, size in zip(found, (5, 3), strict=True):
            still = cv2.dilate(busy, np.ones((size, size), np.uint8)) == 0
            _add(points, level[still & usable], difference[still & usable])
    return found


def _beyond_neighbours(interval: Interval) -> tuple[Array, Array, NDArray[np.bool_]]:
    """(H, W): mean intensity, the part of its change that neighbours do not share, and where these tell the noise.

    The part has the variance of the change where that is white noise. Frames in RGB have been demosaiced, most of them
    compressed too, so that neighbours share their noise: the whole change is taken.
    """
    first, second = interval.first, interval.second
    before, after = first.intensity / first.white, second.intensity / second.white
    level = (before + after) / 2
    weight = np.sqrt((first.weight + second.weight) / 2)
    change = np.ascontiguousarray((after - before) * weight)
    beyond = change
    if first.chroma is None:
        beyond = cv2.filter2D(change, cv2.CV_64F, _BEYOND_NEIGHBOURS) / np.linalg.norm(_BEYOND_NEIGHBOURS)
    bad = first.clipped | second.clipped | (level <= _DARKEST)
    for shot in (first, second):
        if shot.valid is not None:
            bad |= ~shot.valid
    usable = cv2.dilate(bad.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
    usable[[0, -1]] = False  # of pixels at the border a neighbour counts twice
    usable[:, [0, -1]] = False
    return level, np.asarray(beyond, np.float64), usable


def _add(points: _Points, level: Array, difference: Array) -> None:
    index = np.minimum((level * _BINS).astype(np.int64), _BINS - 1)
    order = np.argsort(index, kind="stable")
    level, difference = level[order], difference[order]
    stops = np.searchsorted(index[order], np.arange(_BINS + 1))
    for found, start, stop in zip(points, stops, stops[1:], strict=False):
        if stop - start >= _LEAST:
            variance = trimmed_variance(difference[start:stop]) / 2
            found.append((float(level[start:stop].mean()), variance, int(stop - start)))


def trimmed_variance(values: Array) -> float:
    """Variance without what lies beyond four standard deviations (edges that move), about the mean."""
    kept = values
    for _ in range(5):
        centre, spread = kept.mean(), kept.std()
        inside = values[np.abs(values - centre) <= 4 * spread]
        if len(inside) == len(kept):
            break
        kept = inside
    return float(kept.var())


def photon_transfer(levels: Array, variances: Array, weights: Array) -> FrameNoise:
    """Fit variance = read^2 + shot * level, neither negative; relative errors alike at all levels.

    Levels that are alike (up to a factor of three) do not tell the two apart: all of it is then taken as read noise,
    which in log intensity errs on the safe side.
    """
    from scipy.optimize import nnls

    relative = weights / np.maximum(variances, 1e-10)
    design = np.column_stack([np.ones_like(levels), levels]) * relative[:, None]
    if levels.max() < _SPAN * levels.min():
        design[:, 1] = 0.0
    solution, _ = nnls(design, variances * relative)
    fitted = solution[0] + solution[1] * levels
    scatter = float(
        np.sqrt(np.mean((variances / np.maximum(fitted, 1e-12) - 1) ** 2) / max(len(levels) - 2, 1))
    )
    return FrameNoise(float(np.sqrt(solution[0])), float(solution[1]), scatter / 2, levels, variances)
