"""Scenes for the simulator: radiance as a function of time, made without files.

A `Scene` is a function of time that returns the linear radiance seen by every pixel, with its time span.
`photograph_scene` moves a camera over an HDR image; `demo_scene` draws its own; `static`, `log_ramp`,
`linear_ramp` and `moving_edge` have event counts and exposures that can be worked out by hand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from kalux.errors import InputError

Image = NDArray[np.float32]

LOG_OFFSET: Final = 0.004
"""Radiance added before the logarithm, in units of white: an event pixel's dark current keeps the logarithm
of a black pixel finite. 0.4 % of white gives a sensor that still resolves 48 dB below the frames' white."""


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


# --- motion ---------------------------------------------------------------------------------------------


class Pose(NamedTuple):
    """Where the camera looks: ``x`` right and ``y`` down in sensor pixels, ``angle`` in radians clockwise,
    ``zoom`` as a factor (2 shows things twice as large)."""

    x: float = 0.0
    y: float = 0.0
    angle: float = 0.0
    zoom: float = 1.0


Motion = Callable[[float], Pose]
"""Pose of the camera at a time in us."""


def still() -> Motion:
    """A camera on a tripod."""
    return lambda t: Pose()


def pan(vx: float, vy: float = 0.0) -> Motion:
    """Constant velocity, sensor pixels per second."""
    return lambda t: Pose(vx * t * 1e-6, vy * t * 1e-6)


def spin(rate: float) -> Motion:
    """Constant rotation about the optical axis, radians per second."""
    return lambda t: Pose(angle=rate * t * 1e-6)


def dolly(rate: float) -> Motion:
    """Exponential zoom, ``exp(rate * t)``: natural logarithms per second, positive moves closer."""
    return lambda t: Pose(zoom=float(np.exp(rate * t * 1e-6)))


def shake(
    seed: int,
    *,
    amplitude: float = 1.0,
    roll: float = 0.0,
    band: tuple[float, float] = (4.0, 12.0),
) -> Motion:
    """Random vibration: a sum of sinusoids.

    Parameters
    ----------
    seed
        Chooses frequencies and phases.
    amplitude
        Root-mean-square displacement per axis, sensor pixels.
    roll
        Root-mean-square rotation, radians.
    band
        Lowest and highest frequency, Hz. The default is the band of physiological hand tremor.
    """
    rng = np.random.default_rng(seed)
    count = 5
    frequency = rng.uniform(*band, (3, count)) * 2e-6 * np.pi
    phase = rng.uniform(0, 2 * np.pi, (3, count))
    # A sinusoid of amplitude a has the mean square a^2 / 2.
    scale = np.array([amplitude, amplitude, roll]) * np.sqrt(2 / count)

    def pose(t: float) -> Pose:
        x, y, angle = scale * np.sin(frequency * t + phase).sum(axis=1)
        return Pose(float(x), float(y), float(angle))

    return pose


def handheld(seed: int, *, sway: float = 6.0, tremor: float = 0.4, roll: float = 0.01) -> Motion:
    """A camera in the hand: slow sway (0.3 to 2 Hz) with a little tremor (6 to 12 Hz).

    Parameters
    ----------
    seed
        Chooses frequencies and phases.
    sway, tremor
        Root-mean-square displacements per axis, sensor pixels.
    roll
        Root-mean-square rotation of the sway, radians.
    """
    # Two streams of one seed, so that neither repeats the other's phases.
    slow, fast = (int(s) for s in np.random.default_rng(seed).integers(2**32, size=2))
    return combine(
        shake(slow, amplitude=sway, roll=roll, band=(0.3, 2.0)),
        shake(fast, amplitude=tremor, band=(6.0, 12.0)),
    )


def combine(*motions: Motion) -> Motion:
    """All motions at once: displacements and angles add, zooms multiply."""

    def pose(t: float) -> Pose:
        x, y, angle, zoom = 0.0, 0.0, 0.0, 1.0
        for motion in motions:
            part = motion(t)
            x, y, angle, zoom = x + part.x, y + part.y, angle + part.angle, zoom * part.zoom
        return Pose(x, y, angle, zoom)

    return pose


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
        If the image is not 2-D, too small, negative or not finite, or the scale is not positive.
    """
    image = np.asarray(image)
    if image.ndim != 2 or min(image.shape) < 2:
        raise InputError(f"{name}: image has shape {image.shape}; a grey image (height, width) is needed")
    if not (image.min() >= 0 and image.max() < np.inf):
        raise InputError(f"{name}: image is negative or not finite somewhere; it must be linear radiance")
    if scale <= 0:
        raise InputError(f"{name}: scale is {scale}; it must be positive, in image pixels per sensor pixel")
    canvas = _blurred(np.ascontiguousarray(image, dtype=np.float32), blur * scale)
    if center is None:
        center = ((image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2)

    def radiance(t: float) -> Image:
        out = np.empty(sensor_size, np.float32)
        _sample(canvas, camera_matrix(motion(t), sensor_size, scale, center), out)
        return out

    return Scene(radiance, sensor_size, 0, duration, name)


def camera_matrix(
    pose: Pose, sensor_size: tuple[int, int], scale: float, center: tuple[float, float]
) -> NDArray[np.float64]:
    """(2, 3) affine map from sensor coordinates (column, row, 1) to image coordinates (x, y)."""
    height, width = sensor_size
    step = scale / pose.zoom
    cos, sin = step * np.cos(pose.angle), step * np.sin(pose.angle)
    u, v = (width - 1) / 2, (height - 1) / 2
    return np.array(
        [
            [cos, -sin, center[0] + scale * pose.x - cos * u + sin * v],
            [sin, cos, center[1] + scale * pose.y - sin * u - cos * v],
        ]
    )


def _blurred(image: Image, sigma: float) -> Image:
    if sigma <= 0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101), np.float32)


# cv2.remap rounds positions to 1/32 pixel, which turns smooth motion into bursts of events.
@numba.njit(cache=True)
def _sample(image: Image, matrix: NDArray[np.float64], out: Image) -> None:
    """Fill ``out`` bilinearly from ``image`` at the affine positions ``matrix``, mirrored at the edges."""
    height, width = image.shape
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            x = _mirrored(matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2], width - 1.0)
            y = _mirrored(matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2], height - 1.0)
            out[v, u] = _bilinear(image, x, y)


@numba.njit(cache=True)
def _mirrored(position: float, last: float) -> float:
    if 0.0 <= position <= last:
        return position
    position = abs(position) % (2.0 * last)
    return position if position <= last else 2.0 * last - position


@numba.njit(cache=True)
def _bilinear(image: Image, x: float, y: float) -> float:
    """Value at (x, y), 0 <= x <= width - 1 and 0 <= y <= height - 1."""
    i, j = min(int(y), image.shape[0] - 2), min(int(x), image.shape[1] - 2)
    fy, fx = y - i, x - j
    top = image[i, j] + fx * (image[i, j + 1] - image[i, j])
    bottom = image[i + 1, j] + fx * (image[i + 1, j + 1] - image[i + 1, j])
    return float(top + fy * (bottom - top))


@numba.njit(cache=True)
def _overlay(sprite: Image, alpha: Image, matrix: NDArray[np.float64], out: Image) -> None:
    """Lay a sprite (radiance times alpha, and alpha) over ``out``, in place; ``matrix`` as in `_sample`."""
    height, width = sprite.shape
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            x = matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]
            y = matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]
            if 0.0 <= x <= width - 1 and 0.0 <= y <= height - 1:
                out[v, u] = out[v, u] * (1.0 - _bilinear(alpha, x, y)) + _bilinear(sprite, x, y)


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


# --- the demonstration scene ------------------------------------------------------------------------------

# Canvas pixels per sensor pixel of a sensor 240 wide: bilinear sampling then adds no blur that shows.
_FINE: Final = 4
_ROOM: Final = (200, 330)  # rows, columns, in pixels of such a sensor
_WINDOW: Final = (118, 16, 222, 116)  # left, top, right, bottom
_BALL_RADIUS: Final = 15.0


def demo_scene(
    *, sensor_size: tuple[int, int] = (180, 240), duration: int = 1_200_000, seed: int = 7
) -> Scene:
    """A dim room with a bright window, seen from a moving camera; a beach ball bounces through.

    Drawn, not photographed. Radiance reaches from 0.01 (text in the shadow) to about 20 times white (the
    sun behind clouds): the frames clip the window, and show little of the dark wall.

    Parameters
    ----------
    sensor_size
        (height, width), pixels; about 4:3. The view is the same at every size.
    duration
        us, from time 0. The ball's path and the camera's take 1.2 s.
    seed
        Of textures and of the camera's shake.
    """
    zoom = sensor_size[1] / 240
    room = _blurred(_draw_room(seed), 0.5 * _FINE / zoom)
    ball, alpha = (_blurred(part, 0.5 * _FINE / zoom) for part in _draw_ball())
    camera = combine(pan(42.0 * zoom), shake(seed, amplitude=0.7 * zoom, roll=0.004, band=(2.0, 9.0)))
    scale = _FINE / zoom
    center = (_FINE * 138.0, _FINE * 98.0)

    def radiance(t: float) -> Image:
        out = np.empty(sensor_size, np.float32)
        matrix = camera_matrix(camera(t), sensor_size, scale, center)
        _sample(room, matrix, out)
        _overlay(ball, alpha, _ball_matrix(t) @ np.vstack([matrix, [0.0, 0.0, 1.0]]), out)
        return out

    return Scene(radiance, sensor_size, 0, duration, "demo")


def _ball_matrix(t: float) -> NDArray[np.float64]:
    """(2, 3) affine map from the room's canvas to the ball's: a spinning ball that bounces to the right."""
    seconds = t * 1e-6
    x = 62.0 + 165.0 * seconds
    bounce, floor, height = 0.62, 168.0, 105.0
    phase = ((seconds + 0.20) % bounce) / bounce
    y = floor - height * 4.0 * phase * (1.0 - phase)
    turn = -5.0 * seconds
    cos, sin = np.cos(turn), np.sin(turn)
    middle = _FINE * (_BALL_RADIUS + 2.0)
    rotation = np.array([[cos, -sin], [sin, cos]])
    shift = middle - rotation @ (_FINE * np.array([x, y]))
    return np.column_stack([rotation, shift])


def _draw_ball() -> tuple[Image, Image]:
    """Radiance times alpha, and alpha, of a beach ball with six segments and a cap."""
    size = int(2 * _FINE * (_BALL_RADIUS + 2.0)) + 1
    middle, radius = (size - 1) / 2, _FINE * _BALL_RADIUS
    y, x = np.mgrid[:size, :size].astype(np.float32) - np.float32(middle)
    distance, angle = np.hypot(x, y), np.arctan2(y, x)
    segment = np.floor((angle + np.pi) / (np.pi / 3)).astype(int) % 6
    paint = np.array([0.42, 0.06, 0.30, 0.09, 0.48, 0.14], np.float32)[segment]
    paint[distance < 0.22 * radius] = 0.55
    shade = 1.0 - 0.6 * (distance / radius) ** 4
    alpha = np.clip(radius - distance + 0.5, 0.0, 1.0).astype(np.float32)
    return (paint * np.clip(shade, 0.2, 1.0) * alpha).astype(np.float32), alpha


def _draw_room(seed: int) -> Image:
    """The room's radiance on the fine canvas."""
    rng = np.random.default_rng(seed)
    shape = (_ROOM[0] * _FINE, _ROOM[1] * _FINE)
    light = _window_light(shape)
    room = light * (0.75 + 0.25 * _wallpaper(shape)) * np.exp(0.12 * pink_noise(shape, rng))
    _draw_floor(room, light, rng)
    _draw_test_chart(room, light)
    _draw_note(room, light)
    _draw_shelf(room, light, rng)
    _draw_window(room, rng)
    _draw_plant(room)
    return np.asarray(room, np.float32)


def pink_noise(shape: tuple[int, int], rng: np.random.Generator, *, exponent: float = 1.0) -> Image:
    """Noise whose amplitude falls with ``frequency ** exponent``, as in photographs; mean 0, variance 1.

    (height, width) float32, periodic.
    """
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :]
    amplitude = np.hypot(fx, fy)
    amplitude[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal(shape)) / amplitude**exponent
    noise = np.fft.irfft2(spectrum, shape)
    return np.asarray((noise - noise.mean()) / noise.std(), np.float32)


def _grid(shape: tuple[int, int]) -> tuple[Image, Image]:
    """Coordinates x, y of the canvas in room units."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32) / np.float32(_FINE)
    return x, y


def _window_light(shape: tuple[int, int]) -> Image:
    """Daylight on the wall: it falls off with the distance from the window."""
    x, y = _grid(shape)
    left, top, right, bottom = _WINDOW
    beside = np.maximum(np.maximum(left - x, x - right), 0)
    above = np.maximum(np.maximum(top - y, y - bottom), 0)
    distance = np.hypot(beside, above)
    return np.asarray(0.03 + 0.34 * np.exp(-distance / 28.0), np.float32)


def _wallpaper(shape: tuple[int, int]) -> Image:
    """Diamonds and stripes, -1 to 1."""
    x, y = _grid(shape)
    diamonds = np.sign(np.cos(x * 2 * np.pi / 14) + np.cos(y * 2 * np.pi / 14) - 0.9)
    stripes = np.sign(np.sin(x * 2 * np.pi / 28))
    return np.asarray(0.7 * diamonds + 0.3 * stripes, np.float32)


def _points(points: Any) -> NDArray[np.int32]:
    """Room units to OpenCV's polygon vertices with 4 fractional bits."""
    return np.rint(np.asarray(points, np.float64) * _FINE * 16).astype(np.int32).reshape(-1, 1, 2)


def _fill(image: Image, points: Any, value: Any) -> None:
    """Paint a polygon (room units), its edge smoothed; ``value`` is a number or an image."""
    mask = np.zeros(image.shape, np.uint8)
    cv2.fillPoly(mask, [_points(points)], 255, cv2.LINE_AA, 4)
    _blend(image, mask, value)


def _blend(image: Image, mask: NDArray[np.uint8], value: Any) -> None:
    share = mask.astype(np.float32) / 255
    image += share * (value - image)


def _box(left: float, top: float, right: float, bottom: float) -> list[tuple[float, float]]:
    return [(left, top), (right, top), (right, bottom), (left, bottom)]


def _write(image: Image, text: str, x: float, y: float, size: float, value: Any, weight: float = 1.0) -> None:
    """Letters with their baseline's left end at (x, y); ``size`` is the height of capitals, room units."""
    mask = np.zeros(image.shape, np.uint8)
    scale = size * _FINE / 21.0  # Hershey capitals are 21 pixels high
    position = (round(x * _FINE), round(y * _FINE))
    thickness = max(1, round(weight * _FINE))
    cv2.putText(mask, text, position, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, thickness, cv2.LINE_AA)
    _blend(image, mask, value)


def _draw_window(room: Image, rng: np.random.Generator) -> None:
    """Sky with clouds and a veiled sun, hills, trees, and the frame with its bars before it."""
    left, top, right, bottom = _WINDOW
    x, y = _grid(room.shape)
    billows = pink_noise((room.shape[0] // 3, room.shape[1] // 3), rng, exponent=1.5)
    smooth = cv2.resize(billows, room.shape[::-1], interpolation=cv2.INTER_CUBIC)
    clouds = 1.0 / (1.0 + np.exp(-5.0 * (smooth + 0.2)))
    sky = 3.5 + 9.0 * clouds + 14.0 * np.exp(-(((x - 196) / 13) ** 2 + ((y - 40) / 13) ** 2))
    view = sky.astype(np.float32)
    hill = 84 + 5 * np.sin(x / 17) + 2 * np.sin(x / 5.3)
    view = np.where(y > hill, 2.3 + 0.3 * clouds, view)
    leaves = pink_noise(room.shape, rng, exponent=0.8)
    crowns = 93 + 5 * np.sin(x / 6.1) + 4 * np.sin(x / 2.7 + 1) + 1.5 * leaves
    view = np.where(y > crowns, 1.3 * np.exp(0.45 * leaves), view).astype(np.float32)
    frame = 0.16
    _fill(room, _box(left - 5, top - 5, right + 5, bottom + 5), frame)
    _fill(room, _box(left, top, right, bottom), view)
    for bar in (left + (right - left) / 3, left + 2 * (right - left) / 3):
        _fill(room, _box(bar - 1.5, top, bar + 1.5, bottom), frame)
    _fill(room, _box(left, 51, right, 54), frame)
    _fill(room, _box(left - 8, bottom + 4, right + 8, bottom + 9), 0.85)  # the sill, in the light
    _fill(room, _box(left - 8, bottom + 9, right + 8, bottom + 11), 0.10)


def _draw_plant(room: Image) -> None:
    """A potted plant on the sill, a silhouette before the sky."""
    stem_x, pot_top = 139.0, 106.0
    angles, lengths = np.deg2rad([-64, -40, -18, 4, 24, 46, 66]), (17, 24, 29, 32, 28, 23, 16)
    for angle, length in zip(angles, lengths, strict=True):
        direction = np.array([np.sin(angle), -np.cos(angle)])
        side = np.array([direction[1], -direction[0]])
        along = np.linspace(0, 1, 24)[:, None]
        width = 3.0 * np.sin(np.pi * along**0.8)
        droop = np.array([0.0, 7.0 * abs(np.sin(angle))]) * along**2
        spine = np.array([stem_x, pot_top]) + along * length * direction + droop
        leaf = np.concatenate([spine + width * side, (spine - width * side)[::-1]])
        _fill(room, leaf, 0.10 + 0.05 * np.cos(angle))
    _fill(room, [(132, 105), (146, 105), (144, 120), (134, 120)], 0.22)
    _fill(room, _box(131, 104, 147, 107.5), 0.30)


def _draw_test_chart(room: Image, light: Image) -> None:
    """A framed chart: a Siemens star, gratings that grow finer, and a name."""
    _fill(room, _box(36, 24, 108, 100), 0.25 * light)
    _fill(room, _box(39, 27, 105, 97), 1.5 * light)
    ink = 0.15 * light
    center, radius, spokes = np.array([61.0, 50.0]), 19.0, 16
    for k in range(spokes):
        a, b = 2 * np.pi * k / spokes, 2 * np.pi * (k + 0.5) / spokes
        arc = np.array([[np.cos(v), np.sin(v)] for v in np.linspace(a, b, 5)])
        _fill(room, np.concatenate([[center], center + radius * arc]), ink)
    top = 32.0
    for pitch in (6.0, 4.0, 3.0, 2.0):
        for k in range(int(20 / pitch)):
            _fill(room, _box(83 + k * pitch, top, 83 + (k + 0.5) * pitch, top + 7), ink)
        top += 9.5
    _write(room, "KALUX", 45, 89, 12, ink, 1.8)


def _draw_note(room: Image, light: Image) -> None:
    """A dark poster in the shadow below the chart."""
    _fill(room, _box(28, 112, 110, 150), 0.35 * light)
    for k, line in enumerate(("EVENTS SEE", "IN THE DARK")):
        _write(room, line, 33, 127 + 15 * k, 8, 1.6 * light, 1.2)


def _draw_shelf(room: Image, light: Image, rng: np.random.Generator) -> None:
    """Three boards of books."""
    left, right = 238.0, 324.0
    _fill(room, _box(left, 8, right, 158), 0.25 * light)
    for row in range(3):
        floor = 54.0 + 49.0 * row
        x = left + 3.0
        while x < right - 10.0:
            width, height = rng.uniform(5.0, 10.0), rng.uniform(28.0, 40.0)
            cover = rng.choice([0.25, 0.5, 0.8, 1.2, 1.7])
            _fill(room, _box(x, floor - height, x + width - 0.6, floor), cover * light)
            band = 0.3 if cover > 0.6 else 2.2
            for y in (floor - height + 4, floor - height + 7, floor - 7):
                _fill(room, _box(x + 0.8, y, x + width - 1.4, y + 1.3), band * light)
            x += width
        _fill(room, _box(left, floor, right, floor + 4), 0.7 * light)


def _draw_floor(room: Image, light: Image, rng: np.random.Generator) -> None:
    """Floorboards, and the window's light on them."""
    x, y = _grid(room.shape)
    horizon = 160.0
    depth = 60.0 / np.maximum(y - horizon + 12.0, 1.0)
    across = (x - 165.0) * depth
    boards = 0.75 + 0.25 * np.sign(np.sin(across * 0.12))
    grain = np.exp(0.25 * cv2.GaussianBlur(pink_noise(room.shape, rng), (0, 0), sigmaX=10, sigmaY=0.8))
    _fill(room, _box(-10, horizon - 4, 400, horizon), 1.1 * light)
    _fill(room, _box(-10, horizon, 400, 210), 1.2 * light * boards * grain)
    for k in range(3):
        edge = 112.0 + 40.0 * k
        near = edge + 0.4 * (edge - 145)
        _fill(room, [(edge, 168), (edge + 34, 168), (near + 36, 196), (near - 2, 196)], 1.5 * boards * grain)
