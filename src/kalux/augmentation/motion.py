"""The paths of what moves between two frames (docs/equations.md, K16).

Both frames around an image show what it shows, elsewhere. Optical flow tells where. Events tell when: half-way the
filter knows the image, and the path of every pixel is bent so that the frames explain it best. What the frames show
along these paths is in `kalux.augmentation.along`.
"""

from __future__ import annotations

import dataclasses
import threading
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.along import (
    BESIDE,
    FIRST,
    Along,
    Motion,
    Window,
    as_seen,
    join_along,
    mean_around,
    mirror_ends,
    mirrored,
    seen_along,
    unmoved_difference,
)
from kalux.augmentation.bridge import Latent
from kalux.augmentation.resampling import readable
from kalux.compiled import FUSED, ONE, empty, loop, smaller
from kalux.formulas import Number, Pixels, row_formula

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

_LOOKS: Final = (400.0, 400.0, 16.0, 4.0)
"""Steps of Gauss and Newton by which the path is bent: the squared error, in units of its variance, at which a pixel
counts for a quarter. Where a camera shakes all that tells of it is far off at first."""

_SETTLED: Final = 0.5
"""Pixels by which a step changes the bend at most anywhere for the last step to come at once."""

_MOST_BENT: Final = 4.0
"""Pixels that a path is bent by at most, half-way."""

_CELLS: Final = 9
"""Of a tile's side: sums over pixels are taken of cells first, and the bend is linear between them."""

_ALIKE: Final = np.float32(1.0 / 20.0)
"""Of the pixels of a tile so many tell something of their own, since errors of neighbours are alike."""

_BEND_INFORMATION: Final = np.float32(1.0)
"""1 / pixel^2: what is known beforehand of the bend of all that moves together."""

_COMMON: Final = np.float32(32.0)
"""1 / pixel^2: what is known of a tile's bend once that one is, since it is most often the camera that moves."""

_SILENT: Final = 1.0
"""Variance, in c^2, that the level of a pixel without events has more in the fit: it stays where it is while what it
shows changes by less than a threshold."""

_ACCELERATION: Final = 500.0
"""pixels/s^2, in either direction: of what moves, by which its path bends, as far as the image does not tell by how
much (docs/equations.md, K16)."""

_LEAST_TOLD: Final = np.float32(1e-6)
"""1 / pixel^2, added where nothing may be told: a division."""

_BEHIND: Final = 0.08
"""Time by which an image half-way is behind the light, in units of the s of K14: so much is left of how events trail it
once they are shifted (K8) and that is taken off. 0.075 to 0.088 under pans of 60 to 500 pixels/s."""

_MOST_BEHIND: Final = 0.055
"""The same as a share of the way at most, since both frames hold the image: under the slowest pans and at 50 frames/s
it is 0.054 to 0.059, at 100 0.03."""

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
    x, y = _grid(height, width)
    moved = np.square(first.value - second.value) / (first.variance + second.variance)
    followed = mean_around(moved, _WINDOW)[np.ix_(y.astype(int), x.astype(int))].reshape(-1) > _CHANGED
    if not followed.any():
        return None
    flow = steady_flow(first.value, second.value, dark, white, followed)
    return flow if float(np.abs(flow).max()) >= _STILL else None


def steady_flow(
    first: Floats, second: Floats, dark: float, white: float, followed: NDArray[np.bool_] | None = None
) -> Plane:
    """By how much what a frame shows has moved in the second, as of `find_path`.

    Parameters
    ----------
    first, second
        (H, W) log intensities.
    dark, white
        Those of black and of white.
    followed
        (N,) which points of the grid are looked for, others being still; None: all.

    Returns
    -------
    (2, H, W) in x and y, pixels.
    """
    height, width = first.shape
    x, y = _grid(height, width)
    image, following = (_octets(value, dark, white) for value in (first, second))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
    chosen = np.ones(len(points), np.bool_) if followed is None else followed
    flow = np.zeros_like(points)
    flow[chosen] = _flow(image, following, points[chosen]) - _flow(following, image, points[chosen])
    grid = np.ascontiguousarray(np.moveaxis(flow.reshape(len(y), len(x), 2) / np.float32(2.0), -1, 0))
    steady = (cv2.medianBlur(part, 5) for part in grid)
    parts = (cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR) for part in steady)
    return np.stack([np.asarray(part, np.float32) for part in parts])


def _grid(height: int, width: int) -> tuple[Plane, Plane]:
    """The columns and the rows of the points whose flow is followed."""
    columns = _columns(width)
    return _centres(columns, width), _centres(max(round(columns * height / width), 1), height)


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


class HalfWay(NamedTuple):
    """What the filter knows of the image half-way between two frames.

    Attributes
    ----------
    level, variance
        (H, W): L, and its variance.
    behind
        By how much it is behind the light: a share of the way from one frame to the other, from `behind`.
    threshold2
        c^2.
    interval
        Time from one frame to the other, s.
    events
        (H, W) between both frames.
    """

    level: Floats
    variance: Floats
    behind: float
    threshold2: float
    interval: float
    events: Floats


def behind(scale: float, interval: float) -> float:
    """By how much an image half-way is behind the light: a share of the ``interval`` between both frames.

    ``scale`` is the s of K14, in the same unit. What events tell comes late, and what shifts them for all pixels alike
    (K8) and adds to them (K14) does not make up for all of it.
    """
    return min(_BEHIND * scale / interval, _MOST_BEHIND)


class Paths:
    """The paths of what moves between two frames, found when they are first asked for; parameters are those of `bent`.

    Finding them takes about as long as all else that is done for a frame: the filter tells what it knows half-way and
    goes on, and whoever makes an image asks. Several threads may.
    """

    def __init__(self, first: Latent, second: Latent, path: Plane, image: HalfWay) -> None:
        self._lock = threading.Lock()
        self._known: tuple[Latent, Latent, Plane, HalfWay] | None = (first, second, path, image)
        self._motion: Motion | None = None

    @property
    def motion(self) -> Motion | None:
        """None: nothing is seen along the paths that is not known."""
        with self._lock:
            if self._known is not None:
                self._motion = bent(*self._known)
                self._known = None
            return self._motion


def bent(first: Latent, second: Latent, path: Plane, image: HalfWay) -> Motion | None:
    """The paths between two frames, bent to the image half-way.

    What moves need not go straight on, nor at one pace. The bend of a tile, 4 points of the grid wide, is the one by
    which the frames explain the image best, near that of all that moves: steps of Gauss and Newton, of overlapping
    tiles.

    Parameters
    ----------
    first, second, path
        The frames, and the path from `find_path`.
    image
        What is known half-way.

    Returns
    -------
    The motion; None: nothing is seen along the paths that is not known.
    """
    moving = np.abs(path).max(axis=0) > _STILL
    if not moving.any():
        return None
    side = 4 * (path.shape[2] // _columns(path.shape[2])) - 1
    window = _around(moving, side)
    level, variance = (np.ascontiguousarray(plane, np.float32) for plane in image[:2])
    first, second = as_seen(first), as_seen(second)
    frames, unmoved = (readable(first), readable(second)), unmoved_difference(first, second)
    bends, unsure = np.zeros_like(path), np.zeros_like(path[0])
    motion = Motion(*frames, path, bends, unsure, unmoved, image.threshold2, (window,))
    # Where the light was then that the image shows; what would be bent otherwise is no bend.
    shown, cell = Along(motion, 0.5 - image.behind), max(round((side + 1) / _CELLS), 1)
    rows, columns = (part.stop - part.start for part in window)
    bend = np.zeros((2, -(-rows // cell), -(-columns // cell)), np.float32)
    whole = cell * bend.shape[2], cell * bend.shape[1]
    common = _mostly(moving[window], bend.shape[1:])
    silent = np.where(image.events[window] > 0, np.float32(0.0), np.float32(_SILENT * image.threshold2))
    known = level[window], variance[window] + silent

    def fill(plane: Plane, of_cells: Plane) -> None:
        plane[window] = cv2.resize(of_cells, whole, interpolation=cv2.INTER_LINEAR)[:rows, :columns]

    settled = False
    for outlier in _LOOKS:
        if settled and outlier != _LOOKS[-1]:
            continue
        further, told = _bent_further(bend, *seen_along(shown, window), *known, cell, common, outlier)
        settled, bend = float(np.abs(further - bend).max()) < _SETTLED, further
        for plane, of_cells in zip(bends, bend, strict=True):
            fill(plane, of_cells)
    left = variance.copy()
    join_along(Along(motion, 0.5), level.copy(), left)
    gain = np.where(moving, 1.0 - left / variance, np.float32(0.0))
    windows = tuple(_windows(gain))
    if not windows:
        return None
    fill(unsure, unknown_bend(told, image.interval))  # only now, as it changes nothing of the image
    return dataclasses.replace(motion, windows=windows)


def _mostly(places: NDArray[np.bool_], cells: tuple[int, ...]) -> Plane:
    """1 in cells of which most are true, and 0 in others; ``cells`` are their rows and columns."""
    rows, columns = cells
    share = cv2.resize(places.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
    return np.where(share > 0.5, np.float32(1.0), np.float32(0.0))


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
    tops, lefts = (np.arange(0, length, side) for length, side in ((height, rows), (width, columns)))
    sums = np.add.reduceat(np.add.reduceat(gain, tops, axis=0), lefts, axis=1)
    pixels = np.outer(np.minimum(rows, height - tops), np.minimum(columns, width - lefts))
    counting = np.zeros((len(tops) + 1, len(lefts) + 2), np.bool_)
    counting[:-1, 1:-1] = sums > _LEAST_GAIN * pixels
    for top, strip in zip([*tops.tolist(), height], counting, strict=True):
        edges = np.flatnonzero(np.diff(strip)) * columns
        runs = {
            (int(begin), min(int(end), width)) for begin, end in zip(edges[::2], edges[1::2], strict=True)
        }
        found += [(slice(first, top), slice(*run)) for run, first in above.items() if run not in runs]
        above = {run: above.get(run, top) for run in sorted(runs)}
    return found


def unknown_bend(told: Plane, interval: float) -> Plane:
    """Variance of a bend in the direction of the slopes of what is seen, pixel^2, on average.

    Beforehand it is that of what accelerates, half-way through the ``interval``, s, between both frames; ``told`` is
    what the image tells, (3, ...) 1 / pixel^2: across, down, and of both together.
    """
    before = np.float32((_ACCELERATION * interval**2 / 8) ** -2)
    across, down, both = told
    product, slopes = both * both, across + down
    determinant = (across + before) * (down + before) - product
    along_slopes = (across * (down + before) + down * (across + before) - 2 * product) / determinant
    return np.asarray((along_slopes + _LEAST_TOLD / before) / (slopes + _LEAST_TOLD), np.float32)


def _bent_further(
    bend: Plane,
    seen: Plane,
    doubt: Plane,
    level: Plane,
    variance: Plane,
    cell: int,
    common: Plane,
    outlier: float,
) -> tuple[Plane, Plane]:
    """A step of Gauss and Newton: what is seen is shifted, tile by tile, so that its error becomes least.

    ``bend`` is that of every cell of ``cell`` x ``cell`` pixels, ``common`` 1 where it is near that of all cells, and 0
    where near none. Also returned is what the image tells of it, as `unknown_bend` takes it.
    """
    sums = np.zeros((5, *bend.shape[1:]), np.float32)
    _sum_cells(
        *(np.ascontiguousarray(plane).reshape(-1) for plane in (seen, doubt, level, variance)),
        (np.uint64(seen.shape[0]), np.uint64(seen.shape[1])),
        np.uint64(cell),
        np.float32(outlier),
        sums.reshape(-1),
    )
    of_all = _least_squares(_of_whole_bend(sums, bend).sum(axis=(1, 2)), _BEND_INFORMATION)
    tiles = np.stack([np.float32(_CELLS**2) * mean_around(part, (_CELLS, _CELLS)) for part in sums])
    near_that = _of_whole_bend(tiles, bend)
    near_that[3:] += _COMMON * of_all[:, None, None] * common
    further: Plane = np.clip(_least_squares(near_that, _COMMON), -_MOST_BENT, _MOST_BENT)
    return further, tiles[:3]


def _of_whole_bend(sums: Plane, bend: Plane) -> Plane:
    """(5, ...) sums of `_sum_cells`, whose last two are of what is left beyond ``bend``: of all of it instead."""
    xx, yy, xy, x, y = sums
    across, down = bend
    return np.stack([xx, yy, xy, x + xx * across + xy * down, y + xy * across + yy * down])


def _least_squares(sums: Plane, information: np.float32) -> Plane:
    """(2, ...): the bend by sums of `_of_whole_bend`, and ``information`` that is known beforehand, 1 / pixel^2."""
    xx, yy, xy, x, y = sums
    xx, yy = xx + information, yy + information
    solved: Plane = np.stack([yy * x - xy * y, xx * y - xy * x]) / (xx * yy - xy * xy)
    return solved


@loop(fastmath=FUSED)
def _sum_cells(seen, doubt, level, variance, shape, cell, outlier, sums):  # type: ignore[no-untyped-def]
    """Add up, cell by cell, the weighted products of slopes across and down, and of slopes with the error.

    ``sums`` are those of all cells, one product after the other.
    """
    rows, count = shape
    smooth, steep = (
        empty(count + np.uint64(2 * BESIDE), np.float32),
        empty(count + np.uint64(2 * BESIDE), np.float32),
    )
    products = empty(np.uint64(5) * count, np.float32)
    across = (count + cell - np.uint64(1)) // cell
    cells = np.uint64(len(sums)) // np.uint64(5)
    xx = np.uint64(0)
    yy, xy, x, y = count, count + count, np.uint64(3) * count, np.uint64(4) * count
    for row in range(rows):
        at = row * count
        above, below = mirrored(row - np.uint64(1), rows) * count, mirrored(row + np.uint64(1), rows) * count
        _blend(count, smooth, FIRST, steep, FIRST, seen, above, seen, at, seen, below)
        mirror_ends(smooth, count)
        mirror_ends(steep, count)
        # fmt: off
        _multiply(
            count, products, xx, products, yy, products, xy, products, x, products, y,
            smooth, FIRST, steep, FIRST, seen, at, doubt, at, level, at, variance, at, outlier,
        )
        # fmt: on
        for part in range(np.uint64(5)):
            place = part * cells + row // cell * across
            for first in range(np.uint64(0), count, cell):
                for k in range(first, smaller(first + cell, count)):
                    sums[place] += products[part * count + k]
                place += np.uint64(1)


@row_formula
def _blend(smooth: Pixels, steep: Pixels, above: Pixels, here: Pixels, below: Pixels) -> None:
    """Sobel's, of three rows: for slopes across, and down."""
    smooth[0] = above[0] + np.float32(2.0) * here[0] + below[0]
    steep[0] = below[0] - above[0]


@row_formula
def _multiply(
    xx: Pixels,
    yy: Pixels,
    xy: Pixels,
    x: Pixels,
    y: Pixels,
    smooth: Pixels,
    steep: Pixels,
    seen: Pixels,
    doubt: Pixels,
    level: Pixels,
    variance: Pixels,
    outlier: Number,
) -> None:
    """Of weighted slopes, and with the error, at every pixel of a row."""
    across = (smooth[1] - smooth[-1]) * np.float32(1 / 8)
    down = (steep[-1] + np.float32(2.0) * steep[0] + steep[1]) * np.float32(1 / 8)
    error, doubted = level[0] - seen[0], variance[0] + doubt[0]
    outlying = ONE + error * error / (outlier * doubted)
    weight = _ALIKE / (doubted * (outlying * outlying))
    weighted_x, weighted_y = weight * across, weight * down
    xx[0], yy[0], xy[0] = weighted_x * across, weighted_y * down, weighted_x * down
    x[0], y[0] = weighted_x * error, weighted_y * error
