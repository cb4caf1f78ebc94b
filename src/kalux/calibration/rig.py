"""Two cameras side by side: their lenses, the pose between them, and the TOML file that holds both.

Coordinates are those of OpenCV: x right, y down, z forward, pixel centres at whole numbers. A lens maps the normalised
point (X/Z, Y/Z) to a pixel through five coefficients of distortion (k1, k2, p1, p2, k3; Brown 1971) and a camera
matrix; the pose takes a point from the event camera to the frame camera, X_frames = R X_events + t.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError, InputError
from kalux.events import LARGEST_SIDE
from kalux.settings import read_toml

Array = NDArray[np.float64]

VERSION: Final = 1
"""Of the rig file. Files of a greater version are refused."""

_ROUNDS: Final = 60  # of the fixed point in `Lens.normalised`; 20 are enough at 0.01 pixel for a strong lens
_CONVERGED: Final = 0.01  # pixel


@dataclass(frozen=True, eq=False)
class Lens:
    """Intrinsics of a camera.

    Attributes
    ----------
    sensor_size
        (height, width), pixels.
    matrix
        (3, 3) camera matrix: focal lengths and principal point, pixels.
    distortion
        (5,) k1, k2, p1, p2, k3.

    Raises
    ------
    InputError
        If shapes or values make no lens.
    """

    sensor_size: tuple[int, int]
    matrix: Array
    distortion: Array

    def __post_init__(self) -> None:
        if min(self.sensor_size) < 1 or self.matrix.shape != (3, 3) or self.distortion.shape != (5,):
            raise InputError(
                f"lens: size {self.sensor_size}, matrix {self.matrix.shape}, distortion {self.distortion.shape}; "
                "(height, width), (3, 3) and (5,) are needed"
            )
        if max(self.sensor_size) > LARGEST_SIDE:
            raise InputError(
                f"lens: size {self.sensor_size}; at most {LARGEST_SIDE} pixels a side are possible"
            )
        if not (np.isfinite(self.matrix).all() and np.isfinite(self.distortion).all()):
            raise InputError("lens: the camera matrix or the distortion is not finite")
        if min(self.matrix[0, 0], self.matrix[1, 1]) <= 0:
            raise InputError("lens: the focal lengths must be positive, in pixels")
        if self.matrix[1, 0] != 0 or self.matrix[2].tolist() != [0, 0, 1]:
            raise InputError("lens: below its diagonal the camera matrix must be 0, and its last number 1")

    @classmethod
    def pinhole(cls, sensor_size: tuple[int, int], focal: float | None = None) -> Lens:
        """A lens without distortion, its axis in the middle; ``focal`` in pixels, by default the image's width."""
        height, width = sensor_size
        f = float(width if focal is None else focal)
        matrix = np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]])
        return cls((height, width), matrix, np.zeros(5))

    def pixels(self, points: Array) -> Array:
        """Pixels (N, 2) of normalised points (N, 2); NaN where the lens model folds back on itself."""
        x, y = points.T
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        dx = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        out = np.stack([dx, dy, np.ones_like(dx)], axis=1) @ self.matrix.T
        out[r2 >= self._largest_r2] = np.nan
        return out[:, :2]

    def normalised(self, pixels: Array) -> Array:
        """Normalised points (N, 2) of pixels (N, 2), by a fixed-point iteration; NaN where the model has none."""
        x0, y0 = (np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(self.matrix).T).T[:2]
        k1, k2, p1, p2, k3 = self.distortion
        x, y = x0.copy(), y0.copy()
        with np.errstate(all="ignore"):
            for _ in range(_ROUNDS):
                r2 = x * x + y * y
                radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
                x, y = (
                    (x0 - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial,
                    (y0 - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial,
                )
            points = np.stack([x, y], axis=1)
            off = np.hypot(*(self.pixels(points) - pixels).T)
        points[~(off < _CONVERGED)] = np.nan
        return points

    @cached_property
    def rays(self) -> Array:
        """Normalised points of all pixels, (height * width, 2), row by row."""
        height, width = self.sensor_size
        y, x = np.mgrid[:height, :width].astype(np.float64)
        return self.normalised(np.stack([x.ravel(), y.ravel()], axis=1))

    @property
    def _largest_r2(self) -> float:
        """Square of the radius up to which the radial distortion grows with the radius."""
        k1, k2, _, _, k3 = self.distortion
        roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
        real = roots[(abs(roots.imag) < 1e-9) & (roots.real > 0)].real
        return float(real.min()) if len(real) else np.inf


@dataclass(frozen=True, eq=False)
class Rig:
    """An event camera and a frame camera, fixed to each other.

    Attributes
    ----------
    events, frames
        Their lenses.
    rotation, translation
        (3, 3) and (3,) m: X_frames = rotation X_events + translation.
    about
        What is known of the calibration (errors in pixels, number of views, coverage), for the file.
    """

    events: Lens
    frames: Lens
    rotation: Array
    translation: Array
    about: dict[str, Any]

    def __post_init__(self) -> None:
        r = self.rotation
        if r.shape != (3, 3) or self.translation.shape != (3,) or not np.isfinite(self.translation).all():
            raise InputError("rig: a rotation (3, 3) and a translation (3,) in metres are needed")
        if not (np.allclose(r @ r.T, np.eye(3), atol=1e-6) and np.linalg.det(r) > 0):
            raise InputError("rig: the rotation is not a rotation matrix")

    @property
    def angle(self) -> float:
        """Angle between the cameras, degrees."""
        return float(np.degrees(np.arccos(np.clip((np.trace(self.rotation) - 1) / 2, -1.0, 1.0))))

    @property
    def baseline(self) -> float:
        """Distance between the cameras, m."""
        return float(np.linalg.norm(self.translation))

    def homography(self, distance: float | None = None) -> Array:
        """(3, 3), from undistorted pixels of the event camera to those of the frame camera.

        Parameters
        ----------
        distance
            m along the event camera's axis, of a scene that is taken as flat and facing it. None: infinitely far, where
            only the rotation counts.

        Raises
        ------
        InputError
            If the distance is not positive.
        """
        if distance is not None and not distance > 0:
            raise InputError(f"rig: the distance is {distance} m; it must be positive")
        pose = self.rotation.copy()
        if distance is not None:
            pose[:, 2] += self.translation / distance
        h = self.frames.matrix @ pose @ np.linalg.inv(self.events.matrix)
        return np.asarray(h / h[2, 2], np.float64)


def rig_toml(rig: Rig) -> str:
    """A rig as the text of its file."""
    import tomli_w

    def lens(one: Lens) -> dict[str, Any]:
        return {
            "sensor_size": list(one.sensor_size),
            "camera_matrix": one.matrix.tolist(),
            "distortion": one.distortion.tolist(),
        }

    described = {
        "kalux_rig": VERSION,
        "events": lens(rig.events),
        "frames": lens(rig.frames),
        "pose": {"rotation": rig.rotation.tolist(), "translation_m": rig.translation.tolist()},
        "about": rig.about,
    }
    return tomli_w.dumps(described)


def load_rig(path: Path) -> Rig:
    """Read a rig file.

    Raises
    ------
    InputError
        If it cannot be read.
    FormatError
        If it is not a rig file, or of a newer version.
    """
    table = read_toml(path, damaged=FormatError)
    version = table.get("kalux_rig")
    if not isinstance(version, int):
        raise FormatError(f"{path}: not a rig file (kalux_rig is missing); kalux calibrate rig makes one")
    if version > VERSION:
        raise FormatError(
            f"{path}: a rig file of version {version}, this kalux reads {VERSION}; update kalux"
        )
    try:
        return Rig(
            events=_lens(table["events"]),
            frames=_lens(table["frames"]),
            rotation=np.array(table["pose"]["rotation"], np.float64),
            translation=np.array(table["pose"]["translation_m"], np.float64),
            about=dict(table.get("about", {})),
        )
    except KeyError as error:
        raise FormatError(f"{path}: {error} is missing; see docs/rig.md for what a rig file holds") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{path}: {error}") from error


def _lens(table: dict[str, Any]) -> Lens:
    height, width = table["sensor_size"]
    if not (isinstance(height, int) and isinstance(width, int)):
        raise ValueError(f"sensor_size is {[height, width]}; whole numbers, height and width, are needed")
    matrix = np.array(table["camera_matrix"], np.float64)
    return Lens((height, width), matrix, np.array(table["distortion"], np.float64))
