"""A frame as the filters see it: linear intensity, weights, and what is clipped or black; in grey or in colour."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.trail import FrameTrail
from kalux.errors import SettingsError
from kalux.frames import Frame
from kalux.models import colour
from kalux.models.camera import (
    BrightTail,
    Camera,
    black_ceiling,
    frame_log_covariance,
    inverse_response,
    rounding_error,
)

Array = NDArray[np.float64]


class Shot(NamedTuple):
    """A frame as the filters see it: what each of its levels says, so that functions of it are taken once per level.

    Attributes
    ----------
    start, middle, end
        Of the exposure, us.
    levels
        (H, W) whole numbers: which level a pixel has. Frames of floating point have one per pixel.
    level_intensity
        (N,) I of equation (3) at the reference exposure; 1 = a saturated pixel there.
    level_weight
        (N,) f^w of the response.
    level_measured_weight
        (N,) f^w as far as it was measured, else 1 (K3).
    level_rounding
        (N,) half of what is rounded to the level, in units of I, where levels differ in that; else 0
        (`kalux.models.camera.Response.rounding`).
    level_clipped
        (N,) bool: saturated, so that the value is no measurement.
    white
        Intensity of a saturated pixel of this frame: the reference exposure over the frame's own times its gain.
    level_ceiling
        (N,) the most that I can be at levels that are black; inf at others.
    chroma, chroma_weight
        Of a frame in RGB: (H, W, 3) float32 ratio of each channel to the luminance, and (H, W) how reliable it is, 0
        where a channel is clipped to 1; else None.
    valid
        (H, W) bool: where the frame says anything at all; None: everywhere.
    trail
        Backward in time: how far the light is ahead of its events at the middle (K14).
    bright_tail
        `BrightTail.scale` of the recording's frames, in a live stream of the first; by default that without white.
    pitch
        Distance of pixels of one colour: 2 in a Bayer mosaic.
    gap
        Between the intensities of two successive levels, if the response is linear; 0 of floating point and of colours.
    """

    start: int
    middle: int
    end: int
    levels: NDArray[np.integer[Any]]
    level_intensity: Array
    level_weight: Array
    level_measured_weight: Array
    level_rounding: Array
    level_clipped: NDArray[np.bool_]
    white: float
    level_ceiling: Array
    chroma: NDArray[np.float32] | None = None
    chroma_weight: NDArray[np.float32] | None = None
    valid: NDArray[np.bool_] | None = None
    trail: FrameTrail | None = None
    bright_tail: float = BrightTail().scale
    pitch: int = 1
    gap: float = 0.0

    @property
    def intensity(self) -> Array:
        """(H, W) I."""
        intensity: Array = self.level_intensity[self.levels]
        return intensity

    @property
    def weight(self) -> Array:
        """(H, W) f^w."""
        weight: Array = self.level_weight[self.levels]
        return weight

    @property
    def clipped(self) -> NDArray[np.bool_]:
        """(H, W) bool."""
        clipped: NDArray[np.bool_] = self.level_clipped[self.levels]
        return clipped

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(H, W) bool: valid, and not clipped."""
        measured = ~self.clipped
        return measured if self.valid is None else measured & self.valid


_CHROMA_FLOOR: Final = 0.006
"""Noise of a pixel, white = 1, below which a ratio of channels says nothing; `CameraSettings.usual_frame_noise`."""


def take_shot(
    frame: Frame, camera: Camera, reference_exposure: float, gains: colour.Gains = (1.0, 1.0, 1.0)
) -> Shot:
    """Invert the response (3), scale to the reference exposure, weigh (5) and mark what is clipped.

    ``gains`` is the white balance of frames in RGB, of which the luminance is taken; mosaics are filtered as recorded.

    Raises
    ------
    SettingsError
        If the camera has a response per colour and the frame is grey.
    """
    ratio = reference_exposure / frame.amplified_exposure
    if frame.image.ndim == 3:
        return _colour_shot(frame, camera, ratio, gains)
    levels, response, of_levels = _leveled(frame, camera, ratio)
    return Shot(
        start=frame.exposure_start,
        middle=frame.middle,
        end=frame.exposure_end,
        levels=levels,
        level_intensity=of_levels.intensity,
        level_weight=of_levels.weight,
        level_measured_weight=of_levels.measured_weight,
        level_rounding=of_levels.rounding,
        level_clipped=response >= camera.saturation,
        white=ratio,
        level_ceiling=of_levels.ceiling,
        valid=_mask(frame),
        pitch=1 if frame.mosaic is None else 2,
        gap=2.0 * rounding_error(frame) * ratio,
    )


def _mask(frame: Frame) -> NDArray[np.bool_] | None:
    """A copy, since the caller's memory may be filled again."""
    return None if frame.valid is None else frame.valid.copy()


def level_variance(shot: Shot, noise: tuple[float, float], log_offset: float) -> Array:
    """(N,) variance of log(I + I_0) of each level, by the noise of the frame alone (K3)."""
    return frame_log_covariance(
        shot.level_intensity,
        shot.level_measured_weight,
        noise,
        shot.white,
        log_offset,
        shot.level_rounding,
    )


class _OfLevels(NamedTuple):
    """Of every level I, f^w, both of its kinds, half of what is rounded to it, and, where black, the most it can be."""

    intensity: Array
    weight: Array
    measured_weight: Array
    rounding: Array
    ceiling: Array


class _Leveled(NamedTuple):
    """Which level every pixel has, every level's response, and what that says."""

    levels: NDArray[np.integer[Any]]
    response: Array
    of_levels: _OfLevels


def _leveled(frame: Frame, camera: Camera, ratio: float) -> _Leveled:
    """The levels of a grey frame or a mosaic; where colours have responses of their own, theirs follow each other."""
    levels: NDArray[np.integer[Any]]
    if frame.image.dtype.kind == "f":
        levels = np.arange(frame.image.size, dtype=np.int32).reshape(frame.image.shape)
        response = frame.normalised().ravel()
    else:
        levels = frame.image.copy()  # the caller's memory may be filled again
        values = np.arange(int(levels.max(initial=0)) + 1, dtype=levels.dtype)
        response = Frame(values, 0, 1, frame.white, black=frame.black).normalised()
    if camera.colours is None:
        return _Leveled(levels, response, _by_response(camera, response, ratio, rounding_error(frame)))
    if frame.mosaic is None:
        raise SettingsError("response: three responses are for frames in colour or mosaics; these are grey")
    levels = levels.astype(np.int32)
    for row, column in np.ndindex(2, 2):
        levels[row::2, column::2] += "RGB".index(frame.mosaic[2 * row + column]) * len(response)
    half = rounding_error(frame)
    of_colours = zip(
        *(_by_response(camera.of_channel(c), response, ratio, half) for c in range(3)), strict=True
    )
    return _Leveled(
        levels, np.tile(response, 3), _OfLevels(*(np.concatenate(values) for values in of_colours))
    )


def _by_response(camera: Camera, response: Array, ratio: float, half_level: float) -> _OfLevels:
    inside = np.clip(response, 0.0, 1.0)
    return _OfLevels(
        inverse_response(camera, response, ratio),
        camera.weight(inside),
        camera.measured_weight(inside),
        camera.response.rounding(inside, half_level) * ratio,
        black_ceiling(camera, response, ratio),
    )


def _colour_shot(frame: Frame, camera: Camera, ratio: float, gains: colour.Gains) -> Shot:
    """The luminance of an RGB frame, and its chromaticity (docs/colour.md).

    Errors of the channels are taken as common to them, as demosaicing and compression make them: standard deviations
    add. A pixel is clipped where clipped channels carry more than `colour.CLIPPED_SHARE` of the luminance.
    """
    parts, clipped = zip(*(_channel(frame, camera, ratio, c) for c in range(3)), strict=True)
    rgb = np.stack([gain * part.intensity for gain, part in zip(gains, parts, strict=True)], axis=-1)
    y = colour.luminance(rgb)
    shares = [w * g for w, g in zip(colour.LUMINANCE, gains, strict=True)]

    def summed(values: Iterable[Array]) -> Array:
        total: Array = np.sum([s * value for s, value in zip(shares, values, strict=True)], axis=0)
        return total

    def weight(values: Iterable[Array]) -> Array:
        return 1 / np.square(summed(1 / np.sqrt(np.maximum(value, 1e-6)) for value in values))

    of_clipped = summed(part.intensity * ends for part, ends in zip(parts, clipped, strict=True))
    brightest = (np.max(frame.image, axis=-1) - frame.black) / frame.full_scale
    room = max(camera.saturation - colour.RELIABLE, 1e-6)
    reliable = np.clip((camera.saturation - brightest) / room, 0, 1).astype(np.float32)
    valid = _mask(frame)
    return Shot(
        start=frame.exposure_start,
        middle=frame.middle,
        end=frame.exposure_end,
        levels=np.arange(y.size, dtype=np.int32).reshape(y.shape),
        level_intensity=y.ravel(),
        level_weight=weight(part.weight for part in parts).ravel(),
        level_measured_weight=weight(part.measured_weight for part in parts).ravel(),
        level_rounding=summed(part.rounding for part in parts).ravel(),
        level_clipped=(of_clipped > colour.CLIPPED_SHARE * np.maximum(y, 0)).ravel(),
        white=ratio,
        level_ceiling=colour.luminance(
            np.stack([g * part.ceiling for g, part in zip(gains, parts, strict=True)], -1)
        ).ravel(),
        chroma=colour.chromaticity(rgb, _CHROMA_FLOOR * ratio),
        chroma_weight=reliable if valid is None else np.where(valid, reliable, np.float32(0.0)),
        valid=valid,
    )


def _channel(frame: Frame, camera: Camera, ratio: float, channel: int) -> tuple[_OfLevels, NDArray[np.bool_]]:
    """What the levels of one channel of an RGB frame say, and where it is clipped, (H, W) each."""
    own = dataclasses.replace(frame, image=np.ascontiguousarray(frame.image[..., channel]))
    levels, response, of_levels = _leveled(own, camera.of_channel(channel), ratio)
    return _OfLevels(*(values[levels] for values in of_levels)), (response >= camera.saturation)[levels]
