"""Frames seen along the paths of what moves between them (docs/equations.md, K16).

Both frames around an image show what it shows, elsewhere. Optical flow tells where. Events tell when: half-way the
filter knows the image, and the path of every pixel is bent so that the frames explain it best. Seen along these paths
both frames are one more estimate of the image, the better the better they agree with each other.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.bridge import UNMEASURED, Latent

Floats = NDArray[np.floating[Any]]
Plane = NDArray[np.float32]

# Flow.

_COLUMNS: Final = 32
"""Of the points whose flow is followed, on any sensor: 11 pixels apart on a DAVIS346, 20 at 640x480."""

_WINDOW: Final = (11, 11)
"""Pixels around a point that are looked for in the other frame."""

_LEAST_SIDE: Final = 32
"""Rows and columns without which there is not much to follow."""

_LEVELS: Final = 3
"""Halvings of the image: flows up to some 50 pixels are found."""

_CHANGED: Final = 2.0
"""Mean squared difference of the frames around a point, in units of its variance by their noise: from there on it is
followed."""

_ENDS: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03)
"""Steps that are taken for a point, and pixels below which a step is the last."""

_STILL: Final = 0.25
"""Pixels of flow up to which both frames say the same at the same place."""

# The bend of the paths.

_BENDS: Final = 2
"""Steps of Gauss and Newton by which the path is bent."""

_MOST_BENT: Final = 4.0
"""Pixels that a path is bent by at most, half-way."""

_ALIKE: Final = np.float32(1.0 / 20.0)
"""Of the pixels of a tile so many tell something of their own, since errors of neighbours are alike."""

_BEND_INFORMATION: Final = np.float32(1.0)
"""1 / pixel^2: what is known of a bend beforehand."""

_OUTLIER: Final = np.float32(4.0)
"""Squared error, in units of its variance, at which a pixel counts for a quarter."""

# What is seen along them.

_RESAMPLING: Final = np.float32(5e-4)
"""Variance, in log intensity^2, of a frame that is read between its pixels."""

_FINE_RESAMPLING: Final = np.float32(0.1)
"""The same, in units of the mean square of what 3x3 pixels do not have in common."""

_DISAGREEMENT: Final = np.float32(0.25)
"""Variance of the mean of both frames, in units of their mean squared difference: of independent errors."""

_DISTRUST: Final = np.float32(0.5)
"""How much less is believed where the filter contradicts, per mean squared difference in units of its variance."""

_LEAST_MOVING: Final = np.float32(1e-6)
"""Share of the frames' difference that motion explains where it explains nothing: a division."""

_TEXTURE: Final = (3, 3)
"""Pixels over which texture and the frames' disagreement are averaged, to tell how uncertain a pixel is."""

_EVIDENCE: Final = (5, 5)
"""Pixels over which is averaged what speaks for a path: how far it explains the frames, and the image."""

_TILE: Final = (64, 64)
"""Rows and columns that are looked at along the paths, or not."""

_LEAST_GAIN: Final = 0.2
"""Share by which a tile of an image is taken towards what is seen, half-way, below which it is not worth the time."""

_MARGIN: Final = 4
"""Pixels around a window that what is seen in it depends on: half of `_EVIDENCE`, twice."""

Window = tuple[slice, slice]
"""Rows and columns."""


class Motion(NamedTuple):
    """Two frames, and the paths of what moves from one to the other.

    Attributes
    ----------
    first, second
        The frames, without blur.
    path
        (2, H, W) float32: columns and rows from ``first`` to ``second`` of what is at a pixel half-way.
    bend
        (2, H, W) float32: how far both ends of the path are shifted for what is at a pixel half-way.
    unmoved
        (H, W) float32: mean squared difference of the frames around every pixel, at the same place.
    windows
        Rows and columns, no pixel twice, outside which nothing is seen that is not known.
    """

    first: Latent
    second: Latent
    path: Plane
    bend: Plane
    unmoved: Plane
    windows: tuple[Window, ...]


class Along(NamedTuple):
    """What moves, at a share of the way from the first frame to the second."""

    motion: Motion
    share: float


def find_path(first: Latent, second: Latent, dark: float, white: float) -> Plane | None:
    """(2, H, W) float32: columns and rows by which what is at a pixel half-way moves from one frame to the next.

    Lucas and Kanade's flow with pyramids, of a grid of points and in either direction (OpenCV): half of the difference
    of both, its median over 5x5 points, linear between the points.

    Parameters
    ----------
    first, second
        The frames.
    dark, white
        Log intensities of black and of white.

    Returns
    -------
    The path; None: nothing moves, or the sensor has less than 32 rows or columns.
    """
    height, width = first.value.shape
    if min(height, width) < _LEAST_SIDE:
        return None
    columns = _columns(width)
    rows = max(round(columns * height / width), 1)
    x, y = _centres(columns, width), _centres(rows, height)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
    moved = np.square(first.value - second.value) / (first.variance + second.variance)
    followed = _mean(moved, _WINDOW)[np.ix_(y.astype(int), x.astype(int))].reshape(-1) > _CHANGED
    if not followed.any():
        return None
    image, following = (_octets(frame.value, dark, white) for frame in (first, second))
    flow = np.zeros_like(points)
    flow[followed] = _flow(image, following, points[followed]) - _flow(following, image, points[followed])
    grid = np.ascontiguousarray(np.moveaxis(flow.reshape(rows, columns, 2) / np.float32(2.0), -1, 0))
    steady = [cv2.medianBlur(part, 5) for part in grid]
    if float(np.abs(steady).max()) < _STILL:
        return None
    parts = (cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR) for part in steady)
    return np.stack([np.asarray(part, np.float32) for part in parts])


def _columns(width: int) -> int:
    """Of the points whose flow is followed."""
    return min(_COLUMNS, width // 4)


def _centres(count: int, side: int) -> Plane:
    """Of ``count`` parts of a side, in pixels."""
    return np.asarray((np.arange(count) + 0.5) * (side / count) - 0.5, np.float32)


def _octets(value: Floats, dark: float, white: float) -> NDArray[np.uint8]:
    levels: NDArray[np.uint8] = np.clip((value - dark) * (255.0 / (white - dark)), 0.0, 255.0).astype(
        np.uint8
    )
    return levels


def _flow(image: NDArray[np.uint8], other: NDArray[np.uint8], points: Plane) -> Plane:
    """(N, 1, 2): by how much points of an image have moved in another; 0 where that is not found."""
    ends, found, _ = cv2.calcOpticalFlowPyrLK(
        image, other, points, np.empty_like(points), winSize=_WINDOW, maxLevel=_LEVELS, criteria=_ENDS
    )
    return np.where(found[..., None] == 1, ends - points, np.float32(0.0))


def bent(first: Latent, second: Latent, path: Plane, level: Floats, variance: Floats) -> Motion | None:
    """The paths between two frames, bent to the image half-way.

    What moves need not go straight on, nor at one pace. The bend of a tile, 4 points of the grid wide, is the one by
    which the frames explain the image best: two steps of Gauss and Newton, of overlapping tiles.

    Parameters
    ----------
    first, second, path
        The frames, and the path from `find_path`.
    level, variance
        (H, W): L half-way, and its variance.

    Returns
    -------
    The motion; None: nothing is seen along the paths that is not known.
    """
    height, width = path.shape[1:]
    level, variance = np.asarray(level, np.float32), np.asarray(variance, np.float32)
    side = 4 * (width // _columns(width)) - 1
    whole = slice(0, height), slice(0, width)
    unmoved = _mean(np.square(first.value - second.value), _EVIDENCE)
    motion = Motion(first, second, path, np.zeros_like(path), unmoved, (whole,))
    for _ in range(_BENDS):
        seen, doubt = seen_along(Along(motion, 0.5), whole)
        motion = motion._replace(
            bend=_bent_further(motion.bend, seen, level - seen, variance + doubt, (side, side))
        )
    gain = _gain(*seen_along(Along(motion, 0.5), whole), level, variance, 1.0)
    windows = tuple(_windows(np.where(np.abs(path).max(axis=0) > _STILL, gain, np.float32(0.0))))
    return motion._replace(windows=windows) if windows else None


def _windows(gain: Plane) -> Iterator[Window]:
    """Tiles in which what is seen counts for `_LEAST_GAIN` on average, those beside each other together."""
    (height, width), (rows, columns) = gain.shape, _TILE
    for top in range(0, height, rows):
        strip = slice(top, min(top + rows, height))
        lefts = range(0, width, columns)
        means = np.array([gain[strip, left : left + columns].mean() for left in lefts])
        tiles = np.flatnonzero(means > _LEAST_GAIN)
        for run in np.split(tiles, np.flatnonzero(np.diff(tiles) > 1) + 1):
            if len(run):
                yield strip, slice(int(run[0]) * columns, min((int(run[-1]) + 1) * columns, width))


def _bent_further(bend: Plane, seen: Plane, error: Plane, variance: Plane, tile: tuple[int, int]) -> Plane:
    """A step of Gauss and Newton: what is seen is shifted, tile by tile, so that its ``error`` becomes least."""
    weight = _ALIKE / (variance * np.square(1.0 + error * error / (_OUTLIER * variance)))
    of_x, of_y = (cv2.Sobel(seen, cv2.CV_32F, *axis, scale=1.0 / 8.0) for axis in ((1, 0), (0, 1)))
    pixels = np.float32(tile[0] * tile[1])
    weighted_x, weighted_y = weight * of_x * pixels, weight * of_y * pixels
    xx = _mean(weighted_x * of_x, tile) + _BEND_INFORMATION
    yy = _mean(weighted_y * of_y, tile) + _BEND_INFORMATION
    xy = _mean(weighted_x * of_y, tile)
    x = _mean(weighted_x * error, tile) - _BEND_INFORMATION * bend[0]
    y = _mean(weighted_y * error, tile) - _BEND_INFORMATION * bend[1]
    step = np.stack([yy * x - xy * y, xx * y - xy * x]) / (xx * yy - xy * xy)
    further: Plane = np.clip(bend + step, -_MOST_BENT, _MOST_BENT)
    return further


def seen_along(along: Along, window: Window) -> tuple[Plane, Plane]:
    """What both frames show along the paths, in a window: log intensity, and its variance.

    With s the share, the mean of both is weighted by 1 - s and s. It is the less certain the more the frames disagree
    there, the finer the texture is that is read between its pixels, and the better they agree where nothing moves.
    """
    motion = along.motion
    share, rest = np.float32(along.share), np.float32(1.0 - along.share)
    both = (slice(0, 2), *window)
    straight, bend = motion.path[both], motion.bend[both] * (np.float32(4.0) * share * rest)
    here = _places(*motion.path.shape[1:])[both] + bend
    first, first_variance = _read(motion.first, here - share * straight)
    second, second_variance = _read(motion.second, here + rest * straight)
    seen = rest * first + share * second
    apart = np.square(first - second)
    doubt = _DISAGREEMENT * _mean(apart, _TEXTURE) + _RESAMPLING
    doubt += _FINE_RESAMPLING * _mean(np.square(seen - _mean(seen, _TEXTURE)), _TEXTURE)
    doubt += rest * rest * first_variance + share * share * second_variance
    unexplained = _mean(apart, _EVIDENCE) / np.maximum(motion.unmoved[window], _RESAMPLING)
    doubt /= np.maximum(np.float32(1.0) - unexplained, _LEAST_MOVING)
    return seen, doubt


@functools.lru_cache(maxsize=4)
def _places(height: int, width: int) -> Plane:
    """(2, H, W): column and row of every pixel."""
    places = np.stack(np.meshgrid(np.arange(width), np.arange(height))).astype(np.float32)
    places.flags.writeable = False
    return places


def _read(frame: Latent, places: Plane) -> tuple[Plane, Plane]:
    """Log intensity of a frame between its pixels, and its variance: nothing is known outside, or of black (K7)."""
    value, variance = np.asarray(frame.value, np.float32), np.asarray(frame.variance, np.float32)
    if frame.ceiling is not None:
        variance = np.where(np.isfinite(frame.ceiling), np.float32(UNMEASURED), variance)
    columns, rows = places
    levels = cv2.remap(value, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    doubt = cv2.remap(
        variance, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=UNMEASURED
    )
    return np.asarray(levels, np.float32), np.asarray(doubt, np.float32)


def _mean(values: Floats, patch: tuple[int, int]) -> Plane:
    """Of the pixels around every pixel."""
    return np.asarray(cv2.blur(values, patch), np.float32)


def _gain(seen: Plane, doubt: Plane, level: Plane, variance: Plane, between: float) -> Plane:
    """How far an image is taken towards what is seen along the paths, 0 to 1."""
    contradiction = _mean(np.square(level - seen) / (variance + doubt), _EVIDENCE)
    trust = np.float32(between) * variance / (doubt * np.square(np.float32(1.0) + _DISTRUST * contradiction))
    gain: Plane = trust / (np.float32(1.0) + trust)
    return gain


def joined_along(along: Along, level: Plane, variance: Plane) -> Iterator[tuple[Window, Plane, Plane]]:
    """An image joined with what is seen along the paths, where anything is: log intensity, and its variance.

    With s the share, what is seen counts 4 s (1 - s) times: at a frame the filter knows the frame itself.

    Parameters
    ----------
    along
        The paths, and the share.
    level, variance
        (H, W): log intensity and its variance.
    """
    between = 4.0 * along.share * (1.0 - along.share)
    for window in along.motion.windows:
        wider, inside = _widened(window, level.shape)
        seen, doubt = seen_along(along, wider)
        before, unsure = level[wider], variance[wider]
        gain = _gain(seen, doubt, before, unsure, between)[inside]
        yield (
            window,
            before[inside] + gain * (seen - before)[inside],
            unsure[inside] * (np.float32(1.0) - gain),
        )


def _widened(window: Window, shape: tuple[int, ...]) -> tuple[Window, Window]:
    """A window with its margin, as far as the image goes, and the window within that."""
    wider = [
        slice(max(s.start - _MARGIN, 0), min(s.stop + _MARGIN, n)) for s, n in zip(window, shape, strict=True)
    ]
    inside = [slice(s.start - w.start, s.stop - w.start) for s, w in zip(window, wider, strict=True)]
    return (wider[0], wider[1]), (inside[0], inside[1])
