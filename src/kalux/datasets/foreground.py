"""Things that move before the scene: a sprite, with its shape as alpha, on a path of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.datasets.motion import Motion, Pose
from kalux.datasets.scenes import Image, Scene, blurred, checked_pose, overlay
from kalux.errors import InputError

_PAINT: Final = (0.76, 0.11, 0.55, 0.16, 0.87, 0.25)

# Of a sprite: what can be told from nothing and still be a thing before a scene.
_LEAST_SIZE: Final = 0.5
_LARGEST_SIZE: Final = 1e5
_BRIGHTEST: Final = 1e9


class Sprite(NamedTuple):
    """A thing to lay over a scene: (H, W) linear radiance, 1 = frame white, and (H, W) alpha, 0 to 1.

    ``premultiplied``: whether the radiance is already times alpha. So is that of a glow, which hides nothing.
    """

    radiance: NDArray[Any]
    alpha: NDArray[Any]
    premultiplied: bool = False


def ball(
    size: int = 129, margin: float = 2.0, *, segments: Sequence[float] = _PAINT, cap: float = 1.0
) -> Sprite:
    """A beach ball with six segments and a cap, ``size`` pixels wide with its ``margin``; as bright as its paints."""
    middle = (size - 1) / 2
    radius = middle - margin
    y, x = np.mgrid[:size, :size].astype(np.float32) - np.float32(middle)
    distance, angle = np.hypot(x, y), np.arctan2(y, x)
    segment = np.floor((angle + np.pi) / (np.pi / 3)).astype(int) % 6
    paint = np.array(segments, np.float32)[segment]
    paint[distance < 0.22 * radius] = cap
    shade = np.clip(1.0 - 0.6 * (distance / radius) ** 4, 0.2, 1.0)
    return Sprite(paint * shade, np.clip(radius - distance + 0.5, 0.0, 1.0))


def crossing(
    sensor_size: tuple[int, int], reach: float, speed: float, *, turn: float = 0.0, height: float = 0.5
) -> Motion:
    """From one side of the sensor to the other, again and again.

    Parameters
    ----------
    sensor_size
        (height, width), pixels.
    reach
        Radius of the sprite, pixels: it starts and ends outside of the view.
    speed
        Pixels per second, positive to the right.
    turn
        Radians per second, clockwise.
    height
        Where on the sensor, 0 = top, 1 = bottom.

    Returns
    -------
    Where the sprite's middle is on the sensor, and how it is turned.
    """
    rows, columns = sensor_size
    way = columns + 2 * reach

    def pose(t: float) -> Pose:
        gone = speed * t * 1e-6 % way
        return Pose(gone - reach, height * (rows - 1), turn * t * 1e-6)

    return pose


def with_foreground(scene: Scene, sprite: Sprite, path: Motion, *, size: float, level: float = 1.0) -> Scene:
    """A scene with a sprite that moves before it.

    Parameters
    ----------
    scene
        The background.
    sprite
        What is laid over it.
    path
        Position of the sprite's middle on the sensor (x right, y down, pixels), its angle and zoom.
    size
        Its height at zoom 1, sensor pixels.
    level
        Factor of its radiance.

    Raises
    ------
    InputError
        If the sprite is not two equal grey images, or is negative or not finite; if its size or level is out of range,
        or as of `kalux.datasets.scenes.checked_pose`.
    """
    radiance, alpha = np.asarray(sprite.radiance, np.float32), np.asarray(sprite.alpha, np.float32)
    if radiance.ndim != 2 or radiance.shape != alpha.shape or min(radiance.shape) < 2:
        raise InputError(
            f"foreground: radiance {radiance.shape} and alpha {alpha.shape}; two equal (height, width) are needed"
        )
    if not (radiance.min() >= 0 and radiance.max() < np.inf and alpha.min() >= 0 and alpha.max() <= 1):
        raise InputError("foreground: radiance is negative or not finite, or alpha is not from 0 to 1")
    if not _LEAST_SIZE <= size <= _LARGEST_SIZE:
        raise InputError(
            f"foreground: size is {size}; it must be {_LEAST_SIZE:g} to {_LARGEST_SIZE:g} sensor pixels"
        )
    if not 0 <= level <= _BRIGHTEST:
        raise InputError(f"foreground: level is {level}; it must be 0 to {_BRIGHTEST:g}, white = 1")
    scale = radiance.shape[0] / size
    # Premultiplied, so that smoothing and interpolation keep the edge's colour.
    shining = radiance if sprite.premultiplied else radiance * alpha
    paint = blurred(_padded(shining * np.float32(level)), 0.5 * scale)
    shape = blurred(_padded(alpha), 0.5 * scale)
    middle = np.array([(paint.shape[1] - 1) / 2, (paint.shape[0] - 1) / 2])

    def view(t: float) -> Image:
        out = np.array(scene.radiance(t), np.float32)
        x, y, angle, zoom = checked_pose("foreground", path(t))
        step = scale / zoom
        cos, sin = step * np.cos(angle), step * np.sin(angle)
        rotation = np.array([[cos, sin], [-sin, cos]])
        overlay(paint, shape, np.column_stack([rotation, middle - rotation @ np.array([x, y])]), out)
        return out

    return Scene(view, scene.sensor_size, scene.start, scene.end, scene.name)


def _padded(image: Image) -> Image:
    """With an empty border for the edge to fade into."""
    return np.ascontiguousarray(np.pad(image, max(2, image.shape[0] // 16)))
