"""Frames of one camera in the pixels of another: undistorted, turned by a homography, distorted again, resampled.

Events have whole coordinates, and keep them: frames are warped into the event camera's own, distorted pixels. Both
lenses are undistorted on the way: a pixel of the event camera goes through its lens, through a homography between both
undistorted images, and through the other lens to a place in the frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.rig import Lens, Rig
from kalux.errors import FrameError, InputError
from kalux.frames import Frame
from kalux.models.camera import Camera, Response
from kalux.settings import CameraSettings

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_APERTURE: Final = 0.4
"""Sigma of a pixel's aperture, in its own pixels. What a pixel of the frame lacks of one of the event camera is blurred
in before it is resampled, so that fine detail does not alias."""

_EDGE: Final = 0.01  # pixels that count as inside beyond the outermost centres: rounding

_LEAST_OVERLAP: Final = 0.05
_PART: Final = 0.02
"""Share of clipped frame pixels from which a resampled one is no measurement; from 1 less it, it is clipped."""


class Maps(NamedTuple):
    """Where each pixel of the event camera lies in the frame: x and y (H, W) float32, and whether it does (H, W)."""

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    inside: Mask


@dataclass(frozen=True, eq=False)
class Registration:
    """How frames are brought into the event camera's pixels.

    Attributes
    ----------
    events, frames
        Lenses; without calibration `Lens.pinhole`.
    homography
        (3, 3), from undistorted pixels of the event camera to those of the frame camera.
    """

    events: Lens
    frames: Lens
    homography: Array

    @classmethod
    def same_pixels(cls, sensor_size: tuple[int, int]) -> Registration:
        """That of frames which have the events' pixels; (height, width)."""
        lens = Lens.pinhole(sensor_size)
        return cls(lens, lens, np.eye(3))

    @classmethod
    def of_rig(cls, rig: Rig, distance: float | None = None) -> Registration:
        """The registration of a rig, for a scene at a distance (m), or infinitely far."""
        return cls(rig.events, rig.frames, rig.homography(distance))

    @cached_property
    def is_identity(self) -> bool:
        """Whether both cameras are one, so that there is nothing to resample."""
        return self.events is self.frames and np.array_equal(self.homography, np.eye(3))

    @cached_property
    def maps(self) -> Maps:
        """Where each pixel of the event camera lies in the frame."""
        height, width = self.events.sensor_size
        if self.is_identity:
            own = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
            return Maps(*own, np.ones((height, width), np.bool_))
        x, y = self.places(self.undistorted).T.reshape(2, height, width)
        rows, columns = self.frames.sensor_size
        with np.errstate(invalid="ignore"):
            inside = (x >= -_EDGE) & (x <= columns - 1 + _EDGE) & (y >= -_EDGE) & (y <= rows - 1 + _EDGE)
        # A pixel outside shows the nearest that is inside: a guess, for the filter to start with.
        return Maps(
            np.clip(np.nan_to_num(x), 0, columns - 1).astype(np.float32),
            np.clip(np.nan_to_num(y), 0, rows - 1).astype(np.float32),
            inside,
        )

    @property
    def undistorted(self) -> Array:
        """Undistorted pixels of the event camera, (H * W, 2)."""
        rays = self.events.rays
        return rays @ self.events.matrix[:2, :2].T + self.events.matrix[:2, 2]

    def places(self, undistorted: Array) -> Array:
        """Pixels in the frame of undistorted pixels of the event camera, both (N, 2); NaN where there is none."""
        points = np.column_stack([undistorted, np.ones(len(undistorted))]) @ self.homography.T
        with np.errstate(all="ignore"):
            points = np.where(points[:, 2:] > 0, points / points[:, 2:], np.nan)
            rays = points @ np.linalg.inv(self.frames.matrix).T
            return self.frames.pixels(rays[:, :2])

    @cached_property
    def scale(self) -> float:
        """Pixels of the frame per pixel of the event camera, where they overlap."""
        x, y, inside = self.maps
        dx = np.hypot(np.diff(x, axis=1)[:-1], np.diff(y, axis=1)[:-1])
        dy = np.hypot(np.diff(x, axis=0)[:, :-1], np.diff(y, axis=0)[:, :-1])
        area = (dx * dy)[inside[1:, 1:]]
        return float(np.sqrt(np.median(area))) if area.size else 1.0

    @property
    def overlap(self) -> float:
        """Share of the event camera's pixels that lie in the frame, 0 to 1."""
        return float(self.maps.inside.mean())

    def filtered(self, image: NDArray[Any]) -> NDArray[np.float32]:
        """An image of the frame camera, blurred to the event camera's pixels where these are larger; float32."""
        sigma = _APERTURE * np.sqrt(max(self.scale**2 - 1.0, 0.0))
        source = np.asarray(image, np.float32)
        if sigma < 0.1:
            return source
        return np.asarray(
            cv2.GaussianBlur(source, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE), np.float32
        )

    def sampled(self, filtered: NDArray[np.float32]) -> NDArray[np.float32]:
        """A filtered image at the event camera's pixels, (H, W) or (H, W, channels) float32."""
        if self.is_identity:
            return filtered
        x, y, _ = self.maps
        return np.asarray(
            cv2.remap(filtered, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
        )

    def resampled(self, image: NDArray[Any]) -> NDArray[np.float32]:
        """An image (H', W') or (H', W', channels) of the frame camera at the event camera's pixels, float32."""
        return self.sampled(self.filtered(image))

    def frame(self, frame: Frame, *, index: int = 0, camera: Camera | None = None) -> Frame:
        """A frame in the event camera's pixels, with the mask of those that are measured.

        Light is averaged, not what the response of the ``camera`` (None: linear) makes of it, which is put on again.
        Integer images become uint16 with white at 65535, because the mean of several pixels has more levels than they;
        floats stay floats. Not measured is what lies outside the frame, and what was resampled from clipped and
        unclipped pixels together: its value is too dark, by how much nobody knows.

        Raises
        ------
        FrameError
            If the frame has another size than its camera, or is a raw mosaic of colours.
        """
        if frame.image.shape[:2] != self.frames.sensor_size:
            height, width = frame.image.shape[:2]
            raise FrameError(
                f"frame {index} is {width}x{height} pixels, the frame camera {self.frames.sensor_size[1]}x"
                f"{self.frames.sensor_size[0]}; the rig must be calibrated with frames of the same size"
            )
        if frame.mosaic is not None:
            raise FrameError(
                f"frame {index} is a raw mosaic, which cannot be resampled; demosaic the frames first"
            )
        response = frame.normalised()
        values = self.resampled(response) if camera is None else self._resampled_light(response, camera)
        clipped = np.asarray(response >= CameraSettings.usual_saturation)
        if clipped.ndim == 3:
            clipped = np.asarray(clipped.any(axis=2))
        share = self.resampled(clipped)
        valid = self.maps.inside & ((share < _PART) | (share > 1 - _PART))
        if frame.valid is not None:
            valid &= self.resampled(~frame.valid) < _PART
        if frame.image.dtype.kind == "f":
            image: NDArray[Any] = values * np.float32(frame.white_value)
            return Frame(
                image, frame.exposure_start, frame.exposure_end, frame.white, valid=valid, gain=frame.gain
            )
        image = np.rint(np.clip(values, 0.0, 1.0) * 65535).astype(np.uint16)
        return Frame(image, frame.exposure_start, frame.exposure_end, valid=valid, gain=frame.gain)

    def _resampled_light(self, values: Array, camera: Camera) -> NDArray[Any]:
        """Coded values, resampled as the light that they stand for, and coded again."""
        if all(_is_linear(response) for response in camera.colours or (camera.response,)):
            return self.resampled(values)
        if values.ndim == 2:
            return _coded(self.resampled(camera.of_channel(1).response.inverse(values)), camera.of_channel(1))
        light = [camera.of_channel(c).response.inverse(values[..., c]) for c in range(3)]
        mixed = self.resampled(np.stack(light, axis=2))
        return np.stack([_coded(mixed[..., c], camera.of_channel(c)) for c in range(3)], axis=2)


def _is_linear(response: Response) -> bool:
    return bool(np.array_equal(response.irradiance, response.response))


def _coded(light: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    # Floats may be brighter than white, where the inverse is continued with a slope of 1.
    exact = light.astype(np.float64)
    return np.asarray(camera.response(exact) + np.maximum(exact - 1.0, 0.0), np.float32)


def undistortion_maps(lens: Lens) -> Maps:
    """For a picture without distortion, with the lens's camera matrix: where each of its pixels lies in the image."""
    pinhole = Lens(lens.sensor_size, lens.matrix, np.zeros(5))
    straight = Registration(pinhole, lens, np.eye(3))
    return straight.maps


def require_overlap(registration: Registration) -> None:
    """Refuse a registration by which the cameras hardly see anything in common.

    Raises
    ------
    InputError
        If less than a twentieth of the event camera's pixels lie in the frame.
    """
    if registration.overlap < _LEAST_OVERLAP:
        raise InputError(
            f"registration: {100 * registration.overlap:.1f} % of the event camera's pixels lie in the frames; do the "
            "cameras look the same way, and is the rig file theirs?"
        )
