"""Scenes for the simulator: radiance as a function of time, made without files.

A `Scene` is a function of time that returns the linear radiance seen by every pixel, with its time span.
`photograph_scene` moves a camera over an HDR image; `static`, `log_ramp`, `linear_ramp` and `moving_edge` have
event counts and exposures that can be worked out by hand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from kalux.datasets.motion import Motion, Pose
from kalux.errors import InputError

Image = NDArray[np.float32]

LOG_OFFSET: Final = 0.004
"""Radiance added before the logarithm, in units of white: an event pixel's dark current keeps the logarithm
of a black pixel finite. 0.4 % of white gives a sensor that still resolves 48 dB below the frames' white."""


_LEAST_SCALE: Final = 1e-6
"""Image pixels per sensor pixel: with less, neighbouring sensor pixels see the same in single precision."""

_FARTHEST: Final = 1e9
"""Sensor pixels, and radians: as far as double precision keeps a millionth of a pixel apart."""

_LARGEST_ZOOM: Final = 1e6


@dataclass(frozen=True, eq=False)
class Scene:
    """What the sensor looks at.

    Attributes
    ----------
    radiance
        Called with a time in us (float), returns the radiance of every pixel at that moment: (height, width)
        float32 or float64, linear, finite, not negative; 1.0 saturates a frame of the reference exposure.
        The same time must always give the same image. It may return the same buffer changed: the simulator
        keeps no reference to it.
    sensor_size
        (height, width), pixels.
    start, end
        First and last moment, int us.
    name
        Names the recording in messages.

    Raises
    ------
    InputError
        If the size or the time span is empty.
    """

    radiance: Callable[[float], NDArray[Any]]
    sensor_size: tuple[int, int]
    start: int
    end: int
    name: str = "scene"

    def __post_init__(self) -> None:
        if min(self.sensor_size) < 1:
            raise InputError(
                f"{self.name}: sensor size is {self.sensor_size}; give (height, width) in pixels"
            )
        if self.end <= self.start:
            raise InputError(f"{self.name}: ends at {self.end} us, not after its start at {self.start} us")

    @property
    def duration(self) -> int:
        """Length, us."""
        return self.end - self.start

    def at(self, t: float) -> NDArray[Any]:
        """The radiance at time ``t`` (us), checked: (height, width), finite and not negative.

        Raises
        ------
        InputError
            If the scene's function returns anything else.
        """
        radiance = np.asarray(self.radiance(t))
        if radiance.shape != self.sensor_size:
            raise InputError(
                f"{self.name}: radiance at {t:.0f} us has shape {radiance.shape}, "
                f"the sensor is {self.sensor_size}"
            )
        if not (radiance.min() >= 0 and radiance.max() < np.inf):
            raise InputError(f"{self.name}: radiance at {t:.0f} us is negative or not finite")
        return radiance


# --- a camera over an image -------------------------------------------------------------------------------


def photograph_scene(
    image: NDArray[Any],
    motion: Motion,
    *,
    sensor_size: tuple[int, int],
    duration: int,
    scale: float = 1.0,
    center: tuple[float, float] | None = None,
    blur: float = 0.5,
    name: str = "photograph",
) -> Scene:
    """A camera that moves over an HDR image.

    Parameters
    ----------
    image
        (H, W) linear radiance, 1.0 = frame white. Beyond its edges it continues mirrored.
    motion
        Pose of the camera, e.g. ``combine(pan(80), handheld(1))``.
    sensor_size
        (height, width), pixels.
    duration
        us, from time 0.
    scale
        Image pixels per sensor pixel at zoom 1.
    center
        (x, y) image position of the optical axis in the resting pose. Default: the middle.
    blur
        Sigma of the Gaussian that stands for lens and pixel aperture, sensor pixels. 0.5 keeps a photograph
        sampled at ``scale`` free of aliasing; 0 takes the image as it is.

    Raises
    ------
    InputError
        If the image is not 2-D, too small, negative or not finite, or as of `check_scale`.
    """
    image = np.asarray(image)
    if image.ndim != 2 or min(image.shape) < 2:
        raise InputError(f"{name}: image has shape {image.shape}; a grey image (height, width) is needed")
    if not (image.min() >= 0 and image.max() < np.inf):
        raise InputError(f"{name}: image is negative or not finite somewhere; it must be linear radiance")
    check_scale(name, scale, image.shape)
    canvas = blurred(np.ascontiguousarray(image, dtype=np.float32), blur * scale)
    if center is None:
        center = ((image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2)

    def radiance(t: float) -> Image:
        out = np.empty(sensor_size, np.float32)
        sample(canvas, camera_matrix(motion(t), sensor_size, scale, center), out)
        return out

    return Scene(radiance, sensor_size, 0, duration, name)


def check_scale(name: str, scale: float, image_size: tuple[int, ...]) -> None:
    """Refuse scales with which a sensor pixel sees all of the image, or no part of it.

    Raises
    ------
    InputError
        If it is outside of 1e-6 to the image's longer side.
    """
    if not _LEAST_SCALE <= scale <= max(image_size):
        raise InputError(
            f"{name}: scale is {scale}; it must be positive, {_LEAST_SCALE:g} to {max(image_size)}, in image "
            "pixels per sensor pixel"
        )


def camera_matrix(
    pose: Pose, sensor_size: tuple[int, int], scale: float, center: tuple[float, float]
) -> NDArray[np.float64]:
    """(2, 3) affine map from sensor coordinates (column, row, 1) to image coordinates (x, y).

    Raises
    ------
    InputError
        As of `checked_pose`.
    """
    height, width = sensor_size
    pose = checked_pose("camera", pose)
    step = scale / pose.zoom
    cos, sin = step * np.cos(pose.angle), step * np.sin(pose.angle)
    u, v = (width - 1) / 2, (height - 1) / 2
    return np.array(
        [
            [cos, -sin, center[0] + scale * pose.x - cos * u + sin * v],
            [sin, cos, center[1] + scale * pose.y - sin * u - cos * v],
        ]
    )


def checked_pose(what: str, pose: Pose) -> Pose:
    """The pose of ``what``, if positions in an image can still be told apart there.

    Raises
    ------
    InputError
        If it is not finite, further away than 1e9 sensor pixels, turned by more than 1e9 radians, or its zoom is not
        1e-6 to 1e6.
    """
    near = all(abs(value) <= _FARTHEST for value in (pose.x, pose.y, pose.angle))  # not NaN either
    if not near or not 1 / _LARGEST_ZOOM <= pose.zoom <= _LARGEST_ZOOM:
        raise InputError(
            f"{what}: its motion leads to x {pose.x:g}, y {pose.y:g}, angle {pose.angle:g}, zoom {pose.zoom:g}, too "
            "far to see anything; make the motion slower or the duration shorter"
        )
    return pose


def blurred(image: Image, sigma: float) -> Image:
    """Smoothed by a Gaussian of the standard deviation ``sigma``, pixels; from 0 down, the image itself."""
    if sigma <= 0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101), np.float32)


# cv2.remap rounds positions to 1/32 pixel, which turns smooth motion into bursts of events.
@numba.njit(cache=True)
def sample(image: Image, matrix: NDArray[np.float64], out: Image) -> None:
    """Fill ``out`` bilinearly from ``image`` at the affine positions ``matrix``, mirrored at the edges."""
    height, width = image.shape
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            x = mirrored(matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2], width - 1.0)
            y = mirrored(matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2], height - 1.0)
            out[v, u] = bilinear(image, x, y)


@numba.njit(cache=True)
def mirrored(position: float, last: float) -> float:
    """A place beyond 0 or ``last``, mirrored there."""
    if 0.0 <= position <= last:
        return position
    position = abs(position) % (2.0 * last)
    return position if position <= last else 2.0 * last - position


@numba.njit(cache=True)
def bilinear(image: Image, x: float, y: float) -> float:
    """Value at (x, y), 0 <= x <= width - 1 and 0 <= y <= height - 1."""
    i, j = min(int(y), image.shape[0] - 2), min(int(x), image.shape[1] - 2)
    fy, fx = y - i, x - j
    top = image[i, j] + fx * (image[i, j + 1] - image[i, j])
    bottom = image[i + 1, j] + fx * (image[i + 1, j + 1] - image[i + 1, j])
    return float(top + fy * (bottom - top))


@numba.njit(cache=True)
def overlay(sprite: Image, alpha: Image, matrix: NDArray[np.float64], out: Image) -> None:
    """Lay a sprite (radiance times alpha, and alpha) over ``out``, in place; ``matrix`` as in `sample`."""
    height, width = sprite.shape
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            x = matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]
            y = matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]
            if 0.0 <= x <= width - 1 and 0.0 <= y <= height - 1:
                out[v, u] = out[v, u] * (1.0 - bilinear(alpha, x, y)) + bilinear(sprite, x, y)


# --- scenes that can be worked out by hand ----------------------------------------------------------------


def static(level: float = 0.5, *, sensor_size: tuple[int, int] = (8, 10), duration: int = 1_000_000) -> Scene:
    """The same radiance everywhere and always. No events, but those of noise."""
    image = np.full(sensor_size, level)
    return Scene(lambda t: image, sensor_size, 0, duration, "static")


def linear_ramp(
    start: float = 0.2,
    rate: float = 0.5,
    *,
    sensor_size: tuple[int, int] = (8, 10),
    duration: int = 1_000_000,
) -> Scene:
    """Radiance ``start + rate * seconds`` in every pixel. An exposure sees the radiance at its middle."""
    return Scene(
        lambda t: np.full(sensor_size, start + rate * t * 1e-6), sensor_size, 0, duration, "linear_ramp"
    )


def log_ramp(
    start: float = 0.1,
    rate: float = 1.5,
    *,
    log_offset: float = LOG_OFFSET,
    sensor_size: tuple[int, int] = (8, 10),
    duration: int = 1_000_000,
) -> Scene:
    """``log(radiance + log_offset)`` changes by ``rate`` per second in every pixel.

    Event n of a pixel comes at ``n * threshold / abs(rate)`` seconds.

    Parameters
    ----------
    start
        Radiance at time 0.
    rate
        1/s, negative for a scene that grows darker (it must not fall below zero radiance).
    log_offset
        That of the sensor, for which the ramp is to be straight.
    sensor_size, duration
        (height, width) in pixels, and us.
    """

    def radiance(t: float) -> NDArray[np.float64]:
        return np.full(sensor_size, (start + log_offset) * np.exp(rate * t * 1e-6) - log_offset)

    return Scene(radiance, sensor_size, 0, duration, "log_ramp")


def moving_edge(
    low: float = 0.1,
    high: float = 2.0,
    *,
    speed: float = 20.0,
    sensor_size: tuple[int, int] = (8, 10),
    duration: int = 1_000_000,
) -> Scene:
    """A vertical edge that moves to the right, bright on its left; it starts at the left border.

    A pixel that the edge passes has ``floor(log((high + log_offset) / (low + log_offset)) / threshold)``
    positive events, while the edge crosses it (``1 / speed`` seconds from ``column / speed``).

    Parameters
    ----------
    low, high
        Radiance right and left of the edge.
    speed
        Pixels per second. Each pixel sees the average of its area.
    sensor_size, duration
        (height, width) in pixels, and us.
    """
    columns = np.arange(sensor_size[1], dtype=np.float64)

    def radiance(t: float) -> NDArray[np.float64]:
        covered = np.clip(speed * t * 1e-6 - columns, 0.0, 1.0)
        return np.tile(low + (high - low) * covered, (sensor_size[0], 1))

    return Scene(radiance, sensor_size, 0, duration, "moving_edge")
