"""What two frames show along the paths of what moves between them (docs/equations.md, K16).

Both frames around an image show what it shows, elsewhere. Read along the paths, which `kalux.augmentation.motion`
finds, they are one more estimate of the image, the better the better they agree with each other. The filter knows the
frame at an image, or near it, itself: there it is the other one that tells more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import cv2
import numba as nb
import numpy as np
from numba.core import types
from numpy.typing import NDArray

from kalux import memory
from kalux.augmentation.bridge import UNMEASURED, Latent, bridge_variance
from kalux.augmentation.resampling import BORDER, read_row
from kalux.compiled import FUSED, ONE, ZERO, empty, exponential, larger, logarithm, loop
from kalux.formulas import Number, Pixels, Row, choose, formula, larger_of, row_formula, squared

Floats = NDArray[np.floating[Any]]
Plane = NDArray[np.float32]

_FINE_RESAMPLING: Final = np.float32(0.05)
"""Variance of a frame that is read between its pixels, in units of the mean square of what 3x3 pixels do not have in
common."""

_STATED: Final = 0.5
"""Weight of a frame's own variance where it is read; the rest has half of the squared difference of both frames, which
is what either errs by if both err alike. Own variances are too large between pixels, where noise is averaged, and too
small where the path is wrong: half-way between frames 0.5 is the likeliest for the errors of 87 scenes, at frames less
(docs/equations.md, K16)."""

_LEAST_WEIGHT: Final = 1e-3
"""Of a frame in the mean of both, so that nothing is seen of what it does not measure (K7): behind a white the other
frame alone would bleach a highlight."""

_LEAST_UNMOVED: Final = np.float32(5e-4)
"""Mean squared difference of the frames, in log intensity^2, below which they are alike wherever they are read."""

_UNSIGNALLED: Final = 0.25
"""Mean squared difference, in c^2, of an image from what is seen that says nothing against it: events tell no less, and
what they miss is alike among neighbours (docs/equations.md, K16)."""

_CONTRADICTED: Final = np.float32(4.0)
"""How steeply less is believed of what an image contradicts, per mean squared difference, in units of its variance,
beyond 1."""

_LEAST_DOUBT: Final = np.float32(0.01)
"""Share of the image's variance that is left at least: where the frames are even, any path explains them. Of 220 scenes
pixels that were left less than a five-hundredth erred by 7.2 standard deviations, up to a two-hundredth by 1.8."""

_DISTRUST: Final = np.float32(0.4)
"""How much less the variance falls where the filter contradicts, per such difference: what looks right is not always,
so that it tells less of its own error than it is worth (docs/equations.md, K16)."""

_LEAST_MOVING: Final = np.float32(1e-6)
"""Share of the frames' difference that motion explains where it explains nothing: a division."""

_EVIDENCE: Final = (5, 5)
"""Pixels over which is averaged what speaks for a path: how far it explains the frames, and the image."""

BESIDE: Final = 2
"""Pixels on either side of a row of sums, so that means need no special case: half of `_EVIDENCE`."""

FIRST: Final = np.uint64(BESIDE)
"""The first pixel of such a row."""

_NOTHING: Final = np.empty(0, np.float32)
"""In place of an image."""

_LEAST: Final = np.float32(1 - BORDER)
"""The least column, or row, of a frame that is read: there as further outside."""

_MARGIN: Final = 4
"""Pixels around a window that what is seen in it depends on: half of `_EVIDENCE`, twice."""

_RING: Final = np.uint64(8)
"""Rows of what is looked at around every pixel that are kept: more than lie between the first and the last in use, so
that they stay in the nearest cache; a power of two."""

Window = tuple[slice, slice]
"""Rows and columns."""


class Places(NamedTuple):
    """Windows as loops take them.

    Attributes
    ----------
    looked_at
        (4 N,) uint64: first and last row and column, by Python's counting, of every window with its margin.
    changed
        (4 N,) uint64: the same of the windows.
    pixels
        Number of all pixels that are looked at.
    """

    looked_at: NDArray[np.uint64]
    changed: NDArray[np.uint64]
    pixels: int


@dataclass(frozen=True, eq=False)
class Motion:
    """Two frames, and the paths of what moves from one to the other.

    Attributes
    ----------
    first, second
        (H + 6, W + 6, 2) float32: the frames, without blur, from `as_seen` and `readable`.
    path
        (2, H, W) float32: columns and rows from ``first`` to ``second`` of what is at a pixel half-way.
    bend
        (2, H, W) float32: how far both ends of the path are shifted for what is at a pixel half-way.
    unsure
        (H, W) float32: variance of either part of the bend, pixel^2.
    unmoved
        (H, W) float32: mean squared difference of the frames around every pixel, at the same place.
    threshold2
        c^2: what events cannot tell of is measured by it.
    windows
        Rows and columns, no pixel twice, outside which nothing is seen that is not known.
    """

    first: Plane
    second: Plane
    path: Plane
    bend: Plane
    unsure: Plane
    unmoved: Plane
    threshold2: float
    windows: tuple[Window, ...]

    @cached_property
    def places(self) -> Places:
        """Of the windows."""
        return _places([_widened(window, self.unmoved.shape) for window in self.windows], self.windows)


class Along(NamedTuple):
    """What moves, at a share of the way from the first frame to the second."""

    motion: Motion
    share: float

    @property
    def bent(self) -> float:
        """How much of the bend there is: none at a frame, all of it half-way."""
        return bridge_variance(self.share)

    @property
    def weight(self) -> float:
        """Of the second frame in the mean of both, the first one's being what is left of 1.

        Half-way it is the share of the way. At a frame the mean is the other one, but for `_LEAST_WEIGHT`.
        """
        beyond = 1.0 if self.share <= 0.5 else 0.0
        weight = self.share + (beyond - self.share) * (1.0 - self.bent)
        return min(max(weight, _LEAST_WEIGHT), 1.0 - _LEAST_WEIGHT)

    @property
    def disagreement(self) -> float:
        """Part of the variance of the mean of both that they differ by, in units of their mean squared difference."""
        weight = self.weight
        return (1.0 - _STATED) * ((1.0 - weight) ** 2 + weight**2) / 2.0


def as_seen(frame: Latent) -> Latent:
    """A frame in float32 that measures nothing where it is black (K7)."""
    variance = np.ascontiguousarray(frame.variance, np.float32)
    if frame.ceiling is not None:
        variance = np.where(np.isfinite(frame.ceiling), np.float32(UNMEASURED), variance)
    return Latent(np.ascontiguousarray(frame.value, np.float32), variance)


def unmoved_difference(first: Latent, second: Latent) -> Plane:
    """(H, W) float32: mean squared difference of two frames around every pixel, at the same place."""
    return mean_around(np.square(first.value - second.value), _EVIDENCE)


def mean_around(values: Floats, patch: tuple[int, int]) -> Plane:
    """Of the pixels around every pixel."""
    return np.asarray(cv2.blur(values, patch), np.float32)


def seen_along(along: Along, window: Window) -> tuple[Plane, Plane]:
    """What both frames show along the paths, in a window: log intensity, and its variance.

    The mean of both is weighted by `Along.weight`. It is the less certain the more the frames disagree there, the finer
    the texture is that is read between its pixels, and the better they agree where nothing moves.
    """
    seen, doubt = _look(along, _places([window], [window]))
    rows, columns = (part.stop - part.start for part in window)
    return seen.reshape(rows, columns), doubt.reshape(rows, columns)


def join_along(along: Along, level: Plane, variance: Plane) -> None:
    """Join an image with what is seen along the paths, by information, where anything is. In place.

    Parameters
    ----------
    along
        The paths, and the share.
    level, variance
        (H, W) float32: log intensity and its variance.
    """
    joined = joined_along(along, taken(along, level), taken(along, variance))
    for plane, values in zip((level, variance), joined, strict=True):
        put(along, plane, values)


def joined_along(along: Along, level: Plane, variance: Plane) -> tuple[Plane, Plane]:
    """Log intensity and its variance where they are `taken`, joined with what is seen along the paths."""
    return _look(along, along.motion.places, level, variance)


def taken(along: Along, plane: Plane) -> Plane:
    """(N,) float32: the pixels of the windows with their margins, one window after the other; some may come twice."""
    places = along.motion.places
    values = memory.empty((places.pixels,))
    _take(plane.reshape(-1), np.uint64(plane.shape[1]), places.looked_at, values)
    return values


def put(along: Along, plane: Plane, values: Plane) -> None:
    """Fill the windows of a plane with values that were `taken`. In place."""
    places = along.motion.places
    _put(plane.reshape(-1), np.uint64(plane.shape[1]), places.looked_at, places.changed, values)


def log_taken(along: Along, intensity: Plane, log_offset: float) -> Plane:
    """log(I + I_0) of what is `taken` from an image."""
    places = along.motion.places
    values = memory.empty((places.pixels,))
    width, offset = np.uint64(intensity.shape[1]), np.float32(log_offset)
    _take_log(intensity.reshape(-1), width, places.looked_at, offset, values)
    return values


def put_intensity(along: Along, intensity: Plane, log_intensity: Plane, log_offset: float) -> None:
    """Fill the windows of an image with what was `log_taken`, which becomes the light that it is, at least black. In
    place."""
    places = along.motion.places
    width, offset = np.uint64(intensity.shape[1]), np.float32(log_offset)
    _put_intensity(intensity.reshape(-1), width, places.looked_at, places.changed, offset, log_intensity)


def _look(
    along: Along, places: Places, level: Plane = _NOTHING, variance: Plane = _NOTHING
) -> tuple[Plane, Plane]:
    """What is seen in windows, one after the other, joined with an image where there is one."""
    motion = along.motion
    height, width = motion.unmoved.shape
    seen, doubt = memory.empty((2, places.pixels))
    planes = motion.first, motion.second, motion.path, motion.bend, motion.unsure, motion.unmoved
    _look_along(
        *(plane.reshape(-1) for plane in planes),
        level,
        variance,
        places.looked_at,
        (np.uint64(height), np.uint64(width)),
        np.float32(along.share),
        np.float32(along.bent),
        np.float32(along.weight),
        np.float32(along.disagreement),
        np.float32(_UNSIGNALLED * motion.threshold2),
        np.arange(width, dtype=np.float32),
        seen,
        doubt,
    )
    return seen, doubt


def _places(looked_at: Sequence[Window], changed: Sequence[Window]) -> Places:
    pixels = sum((rows.stop - rows.start) * (columns.stop - columns.start) for rows, columns in looked_at)
    return Places(_ends(looked_at), _ends(changed), pixels)


def _ends(windows: Sequence[Window]) -> NDArray[np.uint64]:
    """First and last row and column of every window."""
    ends = [end for window in windows for part in window for end in (part.start, part.stop)]
    return np.array(ends, np.uint64)


_ZERO, _ONE, _TWO, _THREE, _FOUR = (np.uint64(number) for number in range(5))


@loop(fastmath=FUSED)
def _look_along(  # type: ignore[no-untyped-def]
    first,
    second,
    path,
    bend,
    unsure,
    unmoved,
    level,
    variance,
    windows,
    shape,
    share,
    bent,
    weight,
    disagreement,
    unsignalled,
    numbers,
    seen,
    doubt,
):
    """Fill ``seen`` and ``doubt``, window after window; ``windows`` holds the first and last row and column of each.

    The rows around another one come before what is made of them, and that at once, while they are in the nearest cache.
    ``numbers`` are those of all columns.
    """
    height, width = shape
    stride, down, joins = _TWO * (width + np.uint64(2 * BORDER)), height * width, len(level) > 0
    begin = _ZERO
    for window in range(_ZERO, np.uint64(len(windows)), _FOUR):
        top, left = windows[window], windows[window + _TWO]
        rows, count = windows[window + _ONE] - top, windows[window + _THREE] - left
        # Of both frames, one after the other: columns, or log intensity; then rows, or variance.
        pixels, fractions = empty(_FOUR * count, np.int32), empty(_FOUR * count, np.float32)
        read, apart = empty(_FOUR * count, np.float32), _TWO * count
        sums, wider = empty(count + _FOUR, np.float32), empty(count + _FOUR, np.float32)
        difference, local = empty(_RING * count, np.float32), empty(_RING * count, np.float32)
        contradiction, strayed = empty(_RING * count, np.float32), empty(_RING * count, np.float32)
        for step in range(rows + _FOUR):
            if step < rows:
                here, place = begin + step * count, (top + step) * width + left
                # fmt: off
                for frame in range(_TWO):
                    x, y = frame * count, frame * count + apart
                    _follow(
                        count, pixels, x, fractions, x, pixels, y, fractions, y, numbers, left,
                        path, place, bend, place, path, place + down, bend, place + down,
                        np.float32(top + step), share - np.float32(frame), bent,
                        np.float32(width), np.float32(height),
                    )
                read_row(count, first, stride, pixels, fractions, _ZERO, apart, read)
                read_row(count, second, stride, pixels, fractions, count, apart, read)
                _compare(
                    count, seen, here, difference, step % _RING * count, doubt, here,
                    read, _ZERO, read, count, read, apart, read, apart + count, weight,
                )
                # fmt: on
            if _ONE <= step < rows + _ONE:
                row = step - _ONE
                at = row % _RING * count
                _add_three(seen, begin, row, rows, rows, count, sums)
                _roughen(
                    count, local, at, seen, begin + row * count, difference, at, sums, FIRST, disagreement
                )
                if joins:
                    above = begin + mirrored(row - _ONE, rows) * count
                    below, place = begin + mirrored(row + _ONE, rows) * count, (top + row) * width + left
                    _stray(
                        count, strayed, at, sums, FIRST, seen, above, seen, below, unsure, place, bent * bent
                    )
            if _TWO <= step < rows + _TWO:
                row = step - _TWO
                here, place = begin + row * count, (top + row) * width + left
                _add_three(local, _ZERO, row, rows, _RING, count, sums)
                _add_five(difference, row, rows, count, wider)
                _doubt(count, doubt, here, sums, FIRST, wider, FIRST, unmoved, place)
                if joins:
                    at = row % _RING * count
                    # fmt: off
                    _contradict(
                        count, contradiction, at, seen, here, doubt, here, level, here, variance, here, unsignalled,
                    )
                    # fmt: on
            if step >= _FOUR and joins:
                row = step - _FOUR
                here, at = begin + row * count, row % _RING * count
                _add_five(contradiction, row, rows, count, sums)
                _join(count, seen, here, doubt, here, sums, FIRST, strayed, at, level, here, variance, here)
        begin += rows * count


@row_formula
def _follow(
    left: Pixels,
    from_left: Pixels,
    above: Pixels,
    from_above: Pixels,
    column: Pixels,
    path_x: Pixels,
    bend_x: Pixels,
    path_y: Pixels,
    bend_y: Pixels,
    row: Number,
    back: Number,
    bent: Number,
    width: Number,
    height: Number,
) -> None:
    """Where what is at a pixel is in a frame: the pixels left and above, and how far beyond them."""
    across, down = bend_x[0] * bent - path_x[0] * back, bend_y[0] * bent - path_y[0] * back
    left[0], from_left[0] = _place(across + column[0], width)
    above[0], from_above[0] = _place(down + row, height)


def _place(at: Number, most: Number) -> tuple[Number, Number]:
    """The last pixel up to a place, and how far that is beyond it; far outside it is like there."""
    at = choose(at < most, at, most)
    at = choose(at > _LEAST, at, at.like(_LEAST))
    below = (at - _LEAST).to(types.int32) + np.int32(_LEAST)
    # A little before a pixel at - _LEAST may be rounded to it. A negative share of a variance of `UNMEASURED` would be
    # less than all that is known of its neighbour.
    return below, larger_of(at - below.to(types.float32), np.float32(0.0))


@row_formula
def _compare(
    seen: Pixels,
    difference: Pixels,
    doubt: Pixels,
    first: Pixels,
    second: Pixels,
    first_variance: Pixels,
    second_variance: Pixels,
    weight: Number,
) -> None:
    """The mean of both frames, their squared difference, and the part of the mean's variance by the frames' own."""
    rest = np.float32(1.0) - weight
    error = first[0] - second[0]
    seen[0] = rest * first[0] + weight * second[0]
    difference[0] = error * error
    of_both = rest * rest * first_variance[0] + weight * weight * second_variance[0]
    doubt[0] = np.float32(_STATED) * of_both


@row_formula
def _roughen(
    local: Pixels, seen: Pixels, difference: Pixels, seen_around: Pixels, disagreement: Number
) -> None:
    """What the frames disagree by, and what texture loses between its pixels."""
    fine = seen[0] - _mean_of_three(seen_around)
    local[0] = disagreement * difference[0] + _FINE_RESAMPLING * (fine * fine)


@row_formula
def _stray(
    strayed: Pixels, seen_around: Pixels, above: Pixels, below: Pixels, unsure: Pixels, bent: Number
) -> None:
    """The variance that slopes have of a bend that is not known: both frames are read too far to one side.

    ``bent`` is the square of how much of it there is.
    """
    across = (seen_around[1] - seen_around[-1]) * np.float32(1 / 6)
    down = (below[0] - above[0]) * np.float32(1 / 2)
    strayed[0] = bent * unsure[0] * (across * across + down * down)


@row_formula
def _doubt(doubt: Pixels, local_around: Pixels, difference_around: Pixels, unmoved: Pixels) -> None:
    """The variance of what is seen, in place of the frames' own part: the larger the less the motion explains."""
    explained = ONE - _mean_of_five(difference_around) / larger_of(unmoved[0], _LEAST_UNMOVED)
    doubt[0] = (doubt[0] + _mean_of_three(local_around)) / larger_of(explained, _LEAST_MOVING)


@row_formula
def _contradict(
    contradiction: Pixels,
    seen: Pixels,
    doubt: Pixels,
    level: Pixels,
    variance: Pixels,
    unsignalled: Number,
) -> None:
    """Squared difference of an image and what is seen, in units of its variance."""
    error = level[0] - seen[0]
    contradiction[0] = error * error / (variance[0] + doubt[0] + unsignalled)


@row_formula
def _join(
    seen: Pixels,
    doubt: Pixels,
    contradiction_around: Pixels,
    strayed: Pixels,
    level: Pixels,
    variance: Pixels,
) -> None:
    """The image joined with what is seen, and its variance, in place of this."""
    contradicted = _mean_of_five(contradiction_around)
    believed = doubt[0] * squared(ONE + _CONTRADICTED * larger_of(contradicted - ONE, np.float32(0.0)))
    kept = believed / (variance[0] + believed)
    seen[0] = seen[0] + kept * (level[0] - seen[0])
    doubted = (doubt[0] + strayed[0]) * squared(ONE + _DISTRUST * contradicted)
    doubt[0] = larger_of(doubted / (variance[0] + doubted), _LEAST_DOUBT) * variance[0]


def _mean_of_three(sums: Pixels) -> Number:
    """Around a pixel, of sums of three rows."""
    return (sums[-1] + sums[0] + sums[1]) * np.float32(1 / 9)


def _mean_of_five(sums: Pixels) -> Number:
    return (sums[-2] + sums[-1] + sums[0] + sums[1] + sums[2]) * np.float32(1 / 25)


@nb.njit(cache=True, inline="always", error_model="numpy")
def _add_three(plane, begin, row, rows, kept, count, sums):  # type: ignore[no-untyped-def]
    """The sum of three rows around one, of a plane that holds each row at its number modulo ``kept``."""
    above, below = mirrored(row - _ONE, rows) % kept * count, mirrored(row + _ONE, rows) % kept * count
    here = row % kept * count
    _three(count, sums, FIRST, plane, begin + above, plane, begin + here, plane, begin + below)
    mirror_ends(sums, count)


@nb.njit(cache=True, inline="always", error_model="numpy")
def _add_five(plane, row, rows, count, sums):  # type: ignore[no-untyped-def]
    """The sum of five rows around one, of the `_RING` latest."""
    far, above = mirrored(row - _TWO, rows) % _RING * count, mirrored(row - _ONE, rows) % _RING * count
    below, beyond = mirrored(row + _ONE, rows) % _RING * count, mirrored(row + _TWO, rows) % _RING * count
    here = row % _RING * count
    _five(count, sums, FIRST, plane, far, plane, above, plane, here, plane, below, plane, beyond)
    mirror_ends(sums, count)


@row_formula
def _three(sums: Pixels, above: Pixels, here: Pixels, below: Pixels) -> None:
    sums[0] = above[0] + here[0] + below[0]


@row_formula
def _five(sums: Pixels, far: Pixels, above: Pixels, here: Pixels, below: Pixels, beyond: Pixels) -> None:
    sums[0] = far[0] + above[0] + here[0] + below[0] + beyond[0]


@formula(types.uint64)
def mirrored(row: Number, rows: Number) -> Number:
    """The row of a plane that stands for one a little outside, as if it were mirrored at its outermost pixels."""
    row, last = row.to(types.int64), rows.to(types.int64) - np.int64(1)
    row = choose(row < np.int64(0), np.int64(0) - row, row)
    return choose(row > last, last + last - row, row)


@formula()
def mirror_ends(row: Row, count: Number) -> None:
    """Two pixels on either side of a row that begins at `FIRST`: the same."""
    for aside in (1, 2):
        first, last = count.like(FIRST), count + (FIRST - _ONE)
        row[first - np.uint64(aside)] = row[first + np.uint64(aside)]
        row[last + np.uint64(aside)] = row[last - np.uint64(aside)]


@loop
def _take(plane, width, windows, values):  # type: ignore[no-untyped-def]
    at = _ZERO
    for window in range(_ZERO, np.uint64(len(windows)), _FOUR):
        count = windows[window + _THREE] - windows[window + _TWO]
        for row in range(windows[window], windows[window + _ONE]):
            place = row * width + windows[window + _TWO]
            for i in range(count):
                values[at + i] = plane[place + i]
            at += count


@loop
def _take_log(intensity, width, windows, log_offset, values):  # type: ignore[no-untyped-def]
    _take(intensity, width, windows, values)
    for i in range(np.uint64(len(values))):
        values[i] = logarithm(values[i] + log_offset)


@loop
def _put_intensity(intensity, width, windows, changed, log_offset, log_intensity):  # type: ignore[no-untyped-def]
    for i in range(np.uint64(len(log_intensity))):
        log_intensity[i] = larger(exponential(log_intensity[i]) - log_offset, ZERO)
    _put(intensity, width, windows, changed, log_intensity)


@loop
def _put(plane, width, windows, changed, values):  # type: ignore[no-untyped-def]
    begin = _ZERO
    for window in range(_ZERO, np.uint64(len(windows)), _FOUR):
        top, left = windows[window], windows[window + _TWO]
        rows, count = windows[window + _ONE] - top, windows[window + _THREE] - left
        first, last = changed[window + _TWO], changed[window + _THREE]
        for row in range(changed[window], changed[window + _ONE]):
            at, place = begin + (row - top) * count + first - left, row * width + first
            for i in range(last - first):
                plane[place + i] = values[at + i]
        begin += rows * count


def _widened(window: Window, shape: tuple[int, ...]) -> Window:
    """A window with its margin, as far as the image goes."""
    rows, columns = (
        slice(max(s.start - _MARGIN, 0), min(s.stop + _MARGIN, n)) for s, n in zip(window, shape, strict=True)
    )
    return rows, columns
