"""What two frames show along the paths of what moves between them (docs/equations.md, K16).

Both frames around an image show what it shows, elsewhere. Read along the paths, which `kalux.augmentation.motion`
finds, they are one more estimate of the image, the better the better they agree with each other.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.bridge import UNMEASURED, Latent
from kalux.compiled import FUSED, larger, loop

Floats = NDArray[np.floating[Any]]
Plane = NDArray[np.float32]

_FINE_RESAMPLING: Final = np.float32(0.1)
"""Variance of a frame that is read between its pixels, in units of the mean square of what 3x3 pixels do not have in
common."""

_DISAGREEMENT: Final = np.float32(0.15)
"""Variance of the mean of both frames, in units of their mean squared difference. With independent errors it is a
quarter; errors of the path, by which one frame is read too far on and the other not far enough, cancel in the mean.
Measured: 0.09 to 0.12 (docs/equations.md, K16)."""

_LEAST_UNMOVED: Final = np.float32(5e-4)
"""Mean squared difference of the frames, in log intensity^2, below which they are alike wherever they are read."""

_DISTRUST: Final = np.float32(0.5)
"""How much less is believed where the filter contradicts, per mean squared difference in units of its variance."""

_LEAST_MOVING: Final = np.float32(1e-6)
"""Share of the frames' difference that motion explains where it explains nothing: a division."""

_TEXTURE: Final = (3, 3)
"""Pixels over which texture and the frames' disagreement are averaged, to tell how uncertain a pixel is."""

_EVIDENCE: Final = (5, 5)
"""Pixels over which is averaged what speaks for a path: how far it explains the frames, and the image."""

_MARGIN: Final = 4
"""Pixels around a window that what is seen in it depends on: half of `_EVIDENCE`, twice."""

Window = tuple[slice, slice]
"""Rows and columns."""


class Motion(NamedTuple):
    """Two frames, and the paths of what moves from one to the other.

    Attributes
    ----------
    first, second
        The frames, without blur, float32: from `as_seen`.
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

    @property
    def between(self) -> float:
        """0 at a frame, 1 half-way."""
        return 4.0 * self.share * (1.0 - self.share)


def as_seen(frame: Latent) -> Latent:
    """A frame in float32 that measures nothing where it is black (K7)."""
    variance = np.ascontiguousarray(frame.variance, np.float32)
    if frame.ceiling is not None:
        variance = np.where(np.isfinite(frame.ceiling), np.float32(UNMEASURED), variance)
    return Latent(np.ascontiguousarray(frame.value, np.float32), variance)


def unmoved_difference(first: Latent, second: Latent) -> Plane:
    """(H, W) float32: mean squared difference of two frames around every pixel, at the same place."""
    return mean_around(np.square(first.value - second.value), _EVIDENCE)


def seen_along(along: Along, window: Window) -> tuple[Plane, Plane]:
    """What both frames show along the paths, in a window: log intensity, and its variance.

    With s the share, the mean of both is weighted by 1 - s and s. It is the less certain the more the frames disagree
    there, the finer the texture is that is read between its pixels, and the better they agree where nothing moves.
    """
    motion, share = along.motion, np.float32(along.share)
    rows, columns = (part.stop - part.start for part in window)
    flat = np.empty((7, rows * columns), np.float32)
    x, other_x, y, other_y, seen, difference, doubt = flat.reshape(7, rows, columns)
    here = _places(*motion.path.shape[1:])
    for axis in (0, 1):
        paths = (_flat(plane[axis][window]) for plane in (here, motion.path, motion.bend))
        _follow(*paths, *flat[2 * axis : 2 * axis + 2], share, np.float32(along.between))
    frames = *_read(motion.first, x, y), *_read(motion.second, other_x, other_y)
    _see(*map(_flat, frames), *flat[4:], share)
    fine = np.square(seen - mean_around(seen, _TEXTURE))
    local = mean_around(_DISAGREEMENT * difference + _FINE_RESAMPLING * fine, _TEXTURE)
    _doubt(*map(_flat, (local, mean_around(difference, _EVIDENCE), motion.unmoved[window])), flat[6])
    return seen, doubt


@functools.lru_cache(maxsize=4)
def _places(height: int, width: int) -> Plane:
    """(2, H, W): column and row of every pixel."""
    places = np.stack(np.meshgrid(np.arange(width), np.arange(height))).astype(np.float32)
    places.flags.writeable = False
    return places


def _flat(plane: Plane) -> Plane:
    """As loops take it."""
    return np.ascontiguousarray(plane).reshape(-1)


@loop(fastmath=FUSED)
def _follow(here, path, bend, first, second, share, between):  # type: ignore[no-untyped-def]
    """Columns, or rows, at which what is at a pixel is in either frame."""
    rest = np.float32(1.0) - share
    for i in range(np.uint64(len(first))):
        shifted = here[i] + between * bend[i]
        first[i] = shifted - share * path[i]
        second[i] = shifted + rest * path[i]


def _read(frame: Latent, columns: Plane, rows: Plane) -> tuple[Plane, Plane]:
    """Log intensity of a frame between its pixels, and its variance: nothing is known outside."""
    level = cv2.remap(frame.value, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    variance = cv2.remap(
        frame.variance,
        columns,
        rows,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=UNMEASURED,
    )
    return np.asarray(level, np.float32), np.asarray(variance, np.float32)


@loop(fastmath=FUSED)
def _see(first, first_variance, second, second_variance, seen, difference, doubt, share):  # type: ignore[no-untyped-def]
    """The mean of both frames, their squared difference, and the variance of the mean by the frames' own."""
    rest = np.float32(1.0) - share
    for i in range(np.uint64(len(seen))):
        seen[i] = rest * first[i] + share * second[i]
        error = first[i] - second[i]
        difference[i] = error * error
        doubt[i] = rest * rest * first_variance[i] + share * share * second_variance[i]


@loop(fastmath=FUSED)
def _doubt(local, difference, unmoved, doubt):  # type: ignore[no-untyped-def]
    """The variance of what is seen, in place of that by the frames' own: the larger the less the motion explains."""
    for i in range(np.uint64(len(doubt))):
        explained = np.float32(1.0) - difference[i] / larger(unmoved[i], _LEAST_UNMOVED)
        doubt[i] = (doubt[i] + local[i]) / larger(explained, _LEAST_MOVING)


def mean_around(values: Floats, patch: tuple[int, int]) -> Plane:
    """Of the pixels around every pixel."""
    return np.asarray(cv2.blur(values, patch), np.float32)


def joined(seen: Plane, doubt: Plane, level: Plane, variance: Plane, between: float) -> tuple[Plane, Plane]:
    """An image joined with what is seen along the paths, by information: log intensity, and its variance.

    What is seen counts ``between`` times (`Along.between`): at a frame the filter knows the frame itself.
    """
    flat = np.empty((2, seen.size), np.float32)
    both = flat.reshape(2, *seen.shape)
    planes = [_flat(plane) for plane in (seen, doubt, level, variance)]
    _contradict(*planes, flat[0])
    _join(_flat(mean_around(both[0], _EVIDENCE)), *planes, *flat, np.float32(between))
    return both[0], both[1]


@loop(fastmath=FUSED)
def _contradict(seen, doubt, level, variance, contradiction):  # type: ignore[no-untyped-def]
    """Squared difference of an image and what is seen, in units of its variance."""
    for i in range(np.uint64(len(seen))):
        error = level[i] - seen[i]
        contradiction[i] = error * error / (variance[i] + doubt[i])


@loop(fastmath=FUSED)
def _join(contradiction, seen, doubt, level, variance, joined, left, between):  # type: ignore[no-untyped-def]
    one = np.float32(1.0)
    for i in range(np.uint64(len(seen))):
        distrust = one + _DISTRUST * contradiction[i]
        doubted = doubt[i] * (distrust * distrust)
        told = between * variance[i]
        joined[i] = level[i] + (seen[i] - level[i]) * (told / (told + doubted))
        left[i] = variance[i] * (doubted / (told + doubted))


def joined_along(along: Along, level: Plane, variance: Plane) -> Iterator[tuple[Window, Plane, Plane]]:
    """An image joined with what is seen along the paths, where anything is: log intensity, and its variance.

    Parameters
    ----------
    along
        The paths, and the share.
    level, variance
        (H, W): log intensity and its variance.
    """
    for window in along.motion.windows:
        wider, inside = _widened(window, level.shape)
        found, left = joined(*seen_along(along, wider), level[wider], variance[wider], along.between)
        yield window, found[inside], left[inside]


def _widened(window: Window, shape: tuple[int, ...]) -> tuple[Window, Window]:
    """A window with its margin, as far as the image goes, and the window within that."""
    wider = [
        slice(max(s.start - _MARGIN, 0), min(s.stop + _MARGIN, n)) for s, n in zip(window, shape, strict=True)
    ]
    inside = [slice(s.start - w.start, s.stop - w.start) for s, w in zip(window, wider, strict=True)]
    return (wider[0], wider[1]), (inside[0], inside[1])
