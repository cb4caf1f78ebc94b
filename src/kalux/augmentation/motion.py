"""The paths of what moves between two frames (docs/equations.md, K16).

Both frames around an image show what it shows, elsewhere. Optical flow tells where. Events tell when: half-way the
filter knows the image, and the path of every pixel is bent so that the frames explain it best. What the frames show
along these paths is in `kalux.augmentation.along`.
"""

from __future__ import annotations

import functools
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.along import (
    Along,
    Motion,
    Window,
    as_seen,
    joined,
    mean_around,
    seen_along,
    unmoved_difference,
)
from kalux.augmentation.bridge import Latent

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

_ENDS: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.25)
"""Steps that are taken for a point, and pixels below which a step is the last: the median of neighbouring points and
the bend leave less than that. With 0.03 flow takes 1.3 times as long, and errors are the same to 0.1 %."""

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

# Where they are followed.

_TILE: Final = (64, 64)
"""Rows and columns that are looked at along the paths, or not."""

_LEAST_GAIN: Final = 0.2
"""Share by which a tile of an image is taken towards what is seen, half-way, below which it is not worth the time."""


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
    followed = mean_around(moved, _WINDOW)[np.ix_(y.astype(int), x.astype(int))].reshape(-1) > _CHANGED
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


class Paths:
    """The paths of what moves between two frames, found when they are first asked for; parameters are those of `bent`.

    Finding them takes about as long as all else that is done for a frame: the filter tells what it knows half-way and
    goes on, and whoever makes an image asks.
    """

    def __init__(self, first: Latent, second: Latent, path: Plane, level: Floats, variance: Floats) -> None:
        self._known = first, second, path, level, variance

    @functools.cached_property
    def motion(self) -> Motion | None:
        """None: nothing is seen along the paths that is not known."""
        return bent(*self._known)


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
    moving = np.abs(path).max(axis=0) > _STILL
    if not moving.any():
        return None
    side = 4 * (path.shape[2] // _columns(path.shape[2])) - 1
    window = _around(moving, side)
    level, variance = np.asarray(level[window], np.float32), np.asarray(variance[window], np.float32)
    first, second = as_seen(first), as_seen(second)
    motion = Motion(first, second, path, np.zeros_like(path), unmoved_difference(first, second), (window,))
    half_way, bend = Along(motion, 0.5), motion.bend[:, *window]
    for _ in range(_BENDS):
        seen, doubt = seen_along(half_way, window)
        bend[:] = _bent_further(bend, seen, level - seen, variance + doubt, (side, side))
    _, left = joined(*seen_along(half_way, window), level, variance, 1.0)
    gain = np.zeros(moving.shape, np.float32)
    gain[window] = np.where(moving[window], 1.0 - left / variance, np.float32(0.0))
    windows = tuple(_windows(gain))
    return motion._replace(windows=windows) if windows else None


def _around(places: NDArray[np.bool_], margin: int) -> Window:
    """The rows and columns that hold all places that are true, and a margin around them."""
    held = (np.flatnonzero(places.any(axis=axis)) for axis in (1, 0))
    rows, columns = (slice(max(int(at[0]) - margin, 0), int(at[-1]) + margin + 1) for at in held)
    height, width = places.shape
    return slice(rows.start, min(rows.stop, height)), slice(columns.start, min(columns.stop, width))


def _windows(gain: Plane) -> list[Window]:
    """Tiles in which what is seen counts for `_LEAST_GAIN` on average; those beside each other are one window."""
    (height, width), (rows, columns) = gain.shape, _TILE
    found: list[Window] = []
    above: dict[tuple[int, int], int] = {}  # of windows that reach down to the strip: first row, by columns
    for top in [*range(0, height, rows), height]:
        strip = gain[top : top + rows]
        lefts = range(0, width, columns)
        counting = [len(strip) > 0 and strip[:, left : left + columns].mean() > _LEAST_GAIN for left in lefts]
        edges = np.flatnonzero(np.diff([False, *counting, False])) * columns
        runs = {
            (int(begin), min(int(end), width)) for begin, end in zip(edges[::2], edges[1::2], strict=True)
        }
        found += [(slice(first, top), slice(*run)) for run, first in above.items() if run not in runs]
        above = {run: above.get(run, top) for run in sorted(runs)}
    return found


def _bent_further(bend: Plane, seen: Plane, error: Plane, variance: Plane, tile: tuple[int, int]) -> Plane:
    """A step of Gauss and Newton: what is seen is shifted, tile by tile, so that its ``error`` becomes least."""
    weight = _ALIKE / (variance * np.square(1.0 + error * error / (_OUTLIER * variance)))
    of_x, of_y = (cv2.Sobel(seen, cv2.CV_32F, *axis, scale=1.0 / 8.0) for axis in ((1, 0), (0, 1)))
    pixels = np.float32(tile[0] * tile[1])
    weighted_x, weighted_y = weight * of_x * pixels, weight * of_y * pixels
    xx = mean_around(weighted_x * of_x, tile) + _BEND_INFORMATION
    yy = mean_around(weighted_y * of_y, tile) + _BEND_INFORMATION
    xy = mean_around(weighted_x * of_y, tile)
    x = mean_around(weighted_x * error, tile) - _BEND_INFORMATION * bend[0]
    y = mean_around(weighted_y * error, tile) - _BEND_INFORMATION * bend[1]
    step = np.stack([yy * x - xy * y, xx * y - xy * x]) / (xx * yy - xy * xy)
    further: Plane = np.clip(bend + step, -_MOST_BENT, _MOST_BENT)
    return further
