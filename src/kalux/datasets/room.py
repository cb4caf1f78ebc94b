"""The demonstration scene: a dim room with a bright window, drawn."""

from __future__ import annotations

import functools
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.datasets.foreground import ball
from kalux.datasets.motion import combine, pan, shake
from kalux.datasets.scenes import Image, Scene, blurred, camera_matrix, overlay, sample

# Canvas pixels per sensor pixel of a sensor 240 wide: bilinear sampling then adds no blur that shows.
_FINE: Final = 4
_ROOM: Final = (200, 330)  # rows, columns, in pixels of such a sensor
_WINDOW: Final = (118, 16, 222, 116)  # left, top, right, bottom
_CENTRE: Final = _FINE * 17.0  # of the ball in its image, canvas pixels
_PAINT: Final = (0.42, 0.06, 0.30, 0.09, 0.48, 0.14)  # of its segments


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
    room = blurred(_draw_room(seed), 0.5 * _FINE / zoom)
    drawn = ball(int(2 * _CENTRE) + 1, 2.0 * _FINE, segments=_PAINT, cap=0.55)
    weighed, alpha = (
        blurred(part, 0.5 * _FINE / zoom) for part in (drawn.radiance * drawn.alpha, drawn.alpha)
    )
    camera = combine(pan(42.0 * zoom), shake(seed, amplitude=0.7 * zoom, roll=0.004, band=(2.0, 9.0)))
    scale = _FINE / zoom
    center = (_FINE * 138.0, _FINE * 98.0)

    def radiance(t: float) -> Image:
        out = np.empty(sensor_size, np.float32)
        matrix = camera_matrix(camera(t), sensor_size, scale, center)
        sample(room, matrix, out)
        overlay(weighed, alpha, _ball_matrix(t) @ np.vstack([matrix, [0.0, 0.0, 1.0]]), out)
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
    rotation = np.array([[cos, -sin], [sin, cos]])
    shift = _CENTRE - rotation @ (_FINE * np.array([x, y]))
    return np.column_stack([rotation, shift])


@functools.lru_cache(maxsize=1)
def _draw_room(seed: int) -> Image:
    """The room's radiance on the fine canvas, 4 MB; kept, since drawing it takes a second. Not to be changed."""
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
    drawn = np.asarray(room, np.float32)
    drawn.flags.writeable = False
    return drawn


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
