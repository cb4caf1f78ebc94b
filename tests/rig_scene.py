"""A simulated pair of cameras, side by side: what both see of a distant scene, and of a blinking board.

An event camera and a frame camera with other pixels, another lens (both distort) and another clock look at the same
world. Everything is rendered through the full geometry (lens, pose, plane), not through the homography that
`kalux register` fits, so that what it finds can be checked against the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.rig import Lens, Rig
from kalux.datasets.event_stream import all_events, event_chunks
from kalux.datasets.exposure import frame_stream, plan_exposures
from kalux.datasets.motion import Motion
from kalux.datasets.room import pink_noise
from kalux.datasets.scenes import Image, Scene, bilinear, blurred, mirrored
from kalux.datasets.sensors import Sampling, SensorSettings
from kalux.events import EventArray
from kalux.frames import Frame

Array = NDArray[np.float64]

_RAYS: Final = 3  # either way through a pixel: edges of the board have more than two levels
_APERTURE: Final = 0.5  # sigma of lens and pixel, in pixels, as in `photograph_scene`


class RigRecording(NamedTuple):
    """What both cameras record; the frames' times are in their own clock.

    Attributes
    ----------
    scene
        As the event camera sees it.
    events
        Of the event camera.
    frames
        Of the frame camera.
    """

    scene: Scene
    events: EventArray
    frames: list[Frame]


def example_rig(
    events_size: tuple[int, int] = (240, 320),
    frames_size: tuple[int, int] = (480, 640),
    *,
    angle: float = 3.0,
    baseline: float = 0.04,
) -> Rig:
    """Two cameras of 56 and 60 degrees, ``angle`` (degrees) and ``baseline`` (m) apart, with barrel distortion."""
    height, width = events_size
    f = 0.94 * width
    matrix = np.array([[f, 0, 0.507 * width], [0, 1.002 * f, 0.488 * height], [0, 0, 1]])
    events = Lens(events_size, matrix, np.array([-0.21, 0.06, 0.0008, -0.0006, 0.0]))
    height, width = frames_size
    f = 0.87 * width
    matrix = np.array([[f, 0, 0.494 * width], [0, f, 0.509 * height], [0, 0, 1]])
    frames = Lens(frames_size, matrix, np.array([-0.28, 0.09, -0.0005, 0.0007, 0.0]))
    axis = np.array([0.45, 0.8, 0.4])
    rotation = _rotation(np.deg2rad(angle) * axis / np.linalg.norm(axis))
    direction = np.array([1.0, 0.08, 0.05])
    return Rig(events, frames, rotation, -baseline * direction / np.linalg.norm(direction), {})


def patchwork(shape: tuple[int, int], seed: int = 0) -> Image:
    """Rectangles and small lamps on a rough ground: (height, width) float32 radiance, 0.02 to 4 (lamps saturate)."""
    rng = np.random.default_rng(seed)
    height, width = shape
    picture = np.asarray(0.25 * np.exp(0.35 * pink_noise(shape, rng)), np.float32)
    for _ in range(height * width // 4000):
        w, h = (int(n) for n in rng.integers(12, 90, 2))
        x, y = int(rng.integers(-20, width)), int(rng.integers(-20, height))
        value = float(np.exp(rng.uniform(np.log(0.03), np.log(0.75))))
        corners = np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]], np.float64)
        turned = cv2.transform(
            corners[None], cv2.getRotationMatrix2D((x + w / 2, y + h / 2), rng.uniform(-12, 12), 1)
        )
        mask = np.zeros(shape, np.uint8)
        cv2.fillPoly(mask, [np.rint(turned * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
        share = mask.astype(np.float32) / 255
        picture += share * (value - picture)
    for _ in range(height * width // 30000):  # lamps
        x, y, size = int(rng.integers(0, width)), int(rng.integers(0, height)), int(rng.integers(3, 9))
        picture[max(y, 0) : y + size, max(x, 0) : x + 2 * size] = float(rng.uniform(1.5, 4.0))
    return np.asarray(np.clip(picture, 0.02, 4.0), np.float32)


def distant_scenes(
    rig: Rig, picture: NDArray[Any], motion: Motion, *, distance: float, duration: int, fine: float = 2.0
) -> tuple[Scene, Scene]:
    """A flat picture at a distance, as the event camera and as the frame camera see it.

    Parameters
    ----------
    rig
        The cameras.
    picture
        (H, W) radiance, ``fine`` of its pixels to a pixel of the event camera at the image's centre.
    motion
        Of the rig, about the event camera: x and y as the pixels by which its centre looks right and down, and the
        angle about its axis. Zooms are ignored.
    distance
        Of the picture from the event camera, m; it stands square to the camera's axis at rest.
    duration
        us, from time 0.
    """
    focal = float(rig.events.matrix[0, 0])
    canvas = np.ascontiguousarray(picture, np.float32)
    centre = -rig.rotation.T @ rig.translation  # of the frame camera, from the event camera

    def scene(lens: Lens, turn: Array, position: Array, name: str) -> Scene:
        soft = blurred(canvas, _APERTURE * fine * focal / float(lens.matrix[0, 0]))
        height, width = lens.sensor_size
        rays = lens.rays.reshape(height, width, 2)

        def radiance(t: float) -> Image:
            pose = motion(t)
            world = _rotation(np.array([-pose.y / focal, pose.x / focal, pose.angle]))
            matrix = _canvas_matrix(world @ turn, world @ position, distance, fine * focal, canvas.shape)
            out = np.empty(lens.sensor_size, np.float32)
            _sample_rays(soft, rays, matrix, out)
            return out

        return Scene(radiance, lens.sensor_size, 0, duration, name)

    return (
        scene(rig.events, np.eye(3), np.zeros(3), "distant scene, event camera"),
        scene(rig.frames, rig.rotation.T, centre, "distant scene, frame camera"),
    )


def _canvas_matrix(
    turn: Array, position: Array, distance: float, scale: float, shape: tuple[int, ...]
) -> Array:
    """(3, 3), from a ray of the camera to homogeneous positions in the picture."""
    middle = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    rows = [
        scale / distance * (position[i] * turn[2] + (distance - position[2]) * turn[i]) + middle[i] * turn[2]
        for i in (0, 1)
    ]
    return np.stack([*rows, turn[2]])


@numba.njit(cache=True)
def _sample_rays(image: Image, rays: Array, matrix: Array, out: Image) -> None:
    """Fill ``out`` bilinearly where its rays (H, W, 2) meet the image, mirrored at the edges."""
    height, width = image.shape
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            a, b = rays[v, u, 0], rays[v, u, 1]
            z = matrix[2, 0] * a + matrix[2, 1] * b + matrix[2, 2]
            x = mirrored((matrix[0, 0] * a + matrix[0, 1] * b + matrix[0, 2]) / z, width - 1.0)
            y = mirrored((matrix[1, 0] * a + matrix[1, 1] * b + matrix[1, 2]) / z, height - 1.0)
            out[v, u] = bilinear(image, x, y)


def record(
    scenes: tuple[Scene, Scene],
    settings: SensorSettings,
    *,
    clock_offset: int,
    seed: int = 0,
    sampling: Sampling | None = None,
) -> RigRecording:
    """Record scenes of both cameras.

    Parameters
    ----------
    scenes
        Of the event camera and of the frame camera.
    settings
        Event pixels and frame pixels.
    clock_offset
        us: what has to be added to the frames' times to have those of the events.
    seed, sampling
        As for `kalux.datasets.simulate`.
    """
    sampling = sampling if sampling is not None else Sampling()
    events = all_events(event_chunks(scenes[0], settings, seed=seed, sampling=sampling))
    exposures = plan_exposures(scenes[1], settings)
    frames = [
        Frame(f.image, f.exposure_start - clock_offset, f.exposure_end - clock_offset, f.white)
        for f in frame_stream(scenes[1], settings, exposures, seed=seed, sampling=sampling)
    ]
    return RigRecording(scenes[0], events, frames)


# --- a blinking board -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BlinkingBoard:
    """A board on a screen that is switched on and off.

    Attributes
    ----------
    picture
        (H, W) float32, 0 to 1: the board with its white margin.
    metres
        Size of a pixel of the picture, m.
    rate
        Blinks per second.
    pause
        us of darkness at the beginning and the end of every pose, while the screen moves.
    """

    picture: Image
    metres: float
    rate: float = 10.0
    pause: int = 60_000


def checkerboard_picture(columns: int, rows: int, pixels: int = 24) -> Image:
    """A board with ``columns`` x ``rows`` inner corners and a margin of one square: (H, W) float32, 0 or 1."""
    y, x = np.mgrid[: (rows + 1) * pixels, : (columns + 1) * pixels] // pixels
    return np.pad(((x + y) % 2 == 1).astype(np.float32), pixels, constant_values=1.0)


def board_poses(count: int, *, distance: float, seed: int = 0) -> list[tuple[Array, Array]]:
    """Poses (rotation vector, translation in m) of a board before the event camera: tilted, and all over the image."""
    rng = np.random.default_rng(seed)
    poses = []
    for k in range(count):
        tilt = np.deg2rad(rng.uniform(15, 38))
        toward = 2 * np.pi * (k / count + rng.uniform(-0.1, 0.1))
        vector = np.array([tilt * np.cos(toward), tilt * np.sin(toward), rng.uniform(-0.25, 0.25)])
        z = distance * rng.uniform(0.85, 1.25)
        place = np.array([0.27 * np.cos(2.4 * k), 0.19 * np.sin(2.4 * k)]) * np.sqrt((k + 0.5) / count)
        poses.append((vector, np.array([*(place * z), z])))
    return poses


def board_scenes(
    rig: Rig, board: BlinkingBoard, poses: list[tuple[Array, Array]], *, pose_time: int = 400_000
) -> tuple[Scene, Scene]:
    """The board in one pose after the other, each for ``pose_time`` us, as both cameras see it."""

    def scene(lens: Lens, rotation: Array, translation: Array, name: str) -> Scene:
        views, rays = [], _fine_rays(lens)
        for vector, place in poses:
            turn, shift = rotation @ _rotation(vector), rotation @ place + translation
            views.append(_seen_board(lens, rays, board, turn, shift))

        def radiance(t: float) -> Image:
            k = min(int(t // pose_time), len(views) - 1)
            inside = t - k * pose_time
            light = 0.0
            if board.pause < inside < pose_time - board.pause:
                phase = (inside - board.pause) * 1e-6 * board.rate % 1.0
                ramp = 0.02  # of a period: pixels of a screen take their time
                light = float(np.clip(min(phase / ramp, (0.5 - phase) / ramp), 0.0, 1.0))
            return np.asarray(0.03 + views[k] * (0.02 + 0.65 * light), np.float32)

        return Scene(radiance, lens.sensor_size, 0, pose_time * len(poses), name)

    return (
        scene(rig.events, np.eye(3), np.zeros(3), "blinking board, event camera"),
        scene(rig.frames, rig.rotation, rig.translation, "blinking board, frame camera"),
    )


def _fine_rays(lens: Lens) -> list[Array]:
    """Rays through `_RAYS` x `_RAYS` points of every pixel."""
    height, width = lens.sensor_size
    y, x = np.mgrid[:height, :width].astype(np.float64)
    steps = (np.arange(_RAYS) + 0.5) / _RAYS - 0.5
    return [lens.normalised(np.stack([x.ravel() + j, y.ravel() + i], axis=1)) for i in steps for j in steps]


def _seen_board(lens: Lens, fine_rays: list[Array], board: BlinkingBoard, turn: Array, shift: Array) -> Image:
    """The board's picture as a lens sees it, averaged over several rays of every pixel; 0 beside it."""
    height, width = lens.sensor_size
    total = np.zeros((height, width), np.float32)
    rows, columns = board.picture.shape
    to_board = np.linalg.inv(np.column_stack([turn[:, 0], turn[:, 1], shift]))
    for rays in fine_rays:
        points = np.column_stack([rays, np.ones(len(rays))]) @ to_board.T
        u = points[:, 0] / points[:, 2] / board.metres + (columns - 1) / 2
        v = points[:, 1] / points[:, 2] / board.metres + (rows - 1) / 2
        total += cv2.remap(
            board.picture,
            u.reshape(height, width).astype(np.float32),
            v.reshape(height, width).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        )
    return blurred(total / np.float32(len(fine_rays)), _APERTURE)


def _rotation(vector: Array) -> Array:
    """(3, 3) of a rotation vector."""
    return np.asarray(cv2.Rodrigues(np.asarray(vector, np.float64))[0], np.float64)
