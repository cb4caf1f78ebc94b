"""The fixed pattern of a sensor's frames: an offset of each pixel that is the same in all of them.

Differences of frames do not contain it, and no number of frames averages it out. But it stays on the sensor while the
scene moves. Let r be how much brighter a pixel is than the mean of its neighbours. In two frames that show different
parts of the scene there, r has the texture of either part and the same offset: the mean product of both is the variance
of the offset. Textures are far stronger than the pattern, so that smooth surroundings have most of the information.

Offsets are those of stored values: of a response that bends, each is as much light as the curve is steep there.
"""

from __future__ import annotations

import math
from itertools import islice
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.frame_noise import (
    LEAST_READ,
    MAX_FRAMES,
    by_level,
    inner_pixels,
    near,
    smoothest,
)
from kalux.calibration.intervals import camera_of
from kalux.calibration.regression import grid_step, parts, ratio_error
from kalux.compiled import larger, loop, smaller
from kalux.filters.shots import Shot, take_shot
from kalux.models.camera import Response, rounding_error
from kalux.recording import Recording
from kalux.settings import USUAL_PATTERN, CameraSettings

Array = NDArray[np.float64]
Planes = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]

_MOST_PIXELS: Final = 20_000
"""On a grid over the sensor. Of all 90,000 of a DAVIS346 the pattern is the same within 3 %."""

_LEAST_APART: Final = 3  # frames: a soft edge that creeps over a pixel is the same texture in the next one
_LEAST_CHANGE: Final = 1.35
"""Ratio of the light around a pixel in two frames, or of its inverse: what is on it then is something else."""

_DARKEST: Final = 0.01  # two to three levels of 8 bits: below, black cuts the pattern off
_TEXTURE: Final = 0.01  # of the light: the least by which surfaces differ, however smooth they look
_WHITE: Final = 1 + 1 / 8  # variance of white noise, and of what a pixel of it has beyond the mean of eight
_BELIEVED: Final = 6.0
"""Standard errors: 47 simulated scenes without a pattern say at most 4.3, with 0.005 at least 14."""

_TEXTURED: Final = 0.25
"""Share of the variance that pixels some away share, right or down of each other, from which it is texture, as where a
camera shakes over the same pixels again and again: texture has an extent. Where there is a pattern they share 0 to 0.13
(21 simulated DAVIS sensors; 0.04 for the neighbours that both are compared with), on a scene that shakes 0.38."""

_AWAY: Final = 2  # of the distance of a pixel's neighbours
_MOST_FRAMES: Final = 32  # evenly among the first: more pairs say little more
_LEAST_PARTS: Final = 8
_TINY: Final = 1e-300  # weights of which there are none


class FixedPattern(NamedTuple):
    """What frames show of the sensor's pattern.

    Attributes
    ----------
    deviation
        Standard deviation of the pixels' offsets of stored values, white = 1; 0 where there is none to be measured.
    variance, error
        Its square as measured, which chance may make negative, and the standard error of that, infinite where too few
        pixels change.
    """

    deviation: float
    variance: float
    error: float

    @property
    def is_measured(self) -> bool:
        """Whether the recording tells it: there is one, or the usual one would have been found."""
        return self.deviation > 0 or self.variance + _BELIEVED * self.error < USUAL_PATTERN**2


def estimate_fixed_pattern(recording: Recording, camera: CameraSettings) -> FixedPattern | None:
    """Standard deviation of the pixels' offsets, from the first 80 frames.

    With r what a pixel has beyond the mean of its eight neighbours, and s^2 the variance of these and of the frames'
    noise, the sum over pixels and pairs of frames j, k at least 3 apart, between which that mean changes by a third, of
    r_j r_k / (s_j^2 s_k^2) is 9/8 of the pattern's variance times that of 1 / (s_j^2 s_k^2). Standard errors are those
    of a jackknife over 64 parts of the sensor. Of texture r_j and the r_k of a pixel two further on have products, too.

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response, saturation and frame noise.

    Returns None of frames in colour, which have been demosaiced, and of colours that have responses of their own.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    model = camera_of(recording, camera)
    if model.colours is not None:
        return None
    height, width = recording.sensor_size
    step = grid_step(recording.sensor_size, _MOST_PIXELS)
    seen, pitch = [], 1
    for frame in islice(recording.frames(), MAX_FRAMES):
        if frame.image.ndim == 3:
            return None
        shot = take_shot(frame, model, float(frame.exposure))
        pitch = shot.pitch
        around = _around(shot, camera.noise, step)
        seen.append(around if model.response.is_linear else _stored(around, model.response))
    if not seen:
        return None
    every = -(-len(seen) // _MOST_FRAMES)
    part = parts((height, width))[::step, ::step]
    planes = (np.stack(values).reshape(-1, *part.shape) for values in zip(*seen[::every], strict=True))
    apart = -(-_LEAST_APART // every), -(-_AWAY * pitch // step)
    sums: Array = np.zeros((part.max() + 1, 2))
    beside: Array = np.zeros((2, 2))
    _add_products(*planes, apart, part, sums, beside)
    return _solved(sums, beside)


def largest_pattern(recording: Recording, camera: CameraSettings) -> float:
    """Standard deviation of stored values, white = 1, that the pattern does not exceed, whatever stands still.

    The mean of the first 32 frames has all of the pattern, and in its smoothest parts little else: what
    `kalux.calibration.frame_noise.smoothest` finds there, or what rounding may hide. Infinite where too few parts are
    from 0.01 of white on, and not clipped, in all of these frames.

    Parameters
    ----------
    recording
        With frames and exposures, not in colour, nor compressed, which leaves less of what is fine.
    camera
        Response and saturation.
    """
    model = camera_of(recording, camera)
    stored = np.zeros(recording.sensor_size)
    bad = np.zeros(recording.sensor_size, np.bool_)
    count, pitch, hidden = 0, 1, LEAST_READ
    for frame in islice(recording.frames(), _MOST_FRAMES):
        shot = take_shot(frame, model, float(frame.exposure))
        levels, intensity, clipped = by_level(shot)
        unusable, pitch = clipped | (intensity <= _DARKEST), shot.pitch
        count, hidden = count + 1, max(hidden, rounding_error(frame) / 3**0.5)
        stored += np.where(unusable, 0.0, model.response(intensity))[levels]
        bad |= unusable[levels] if shot.valid is None else unusable[levels] | ~shot.valid
    # The filter reaches a pixel of the same colour on either side.
    usable = inner_pixels(~near(bad, pitch), pitch)
    found = smoothest(stored / max(count, 1), usable, pitch)
    return math.inf if found is None else max(found, hidden)


def _stored(around: Planes, response: Response) -> Planes:
    """What `_around` gives, with what pixels have beyond their neighbours, and its variance, of stored values."""
    beyond, light, weight = around
    slope = response.slope(light, USUAL_PATTERN)
    return (beyond / slope).astype(np.float32), light, (weight * slope**2).astype(np.float32)


def _around(shot: Shot, noise: tuple[float, float], step: int) -> Planes:
    """(N,) of every ``step``-th pixel: what it has beyond its neighbours, their mean, and 1 / s^2 (0: not usable)."""
    bad = shot.level_clipped
    intensity = np.where(bad, np.inf, shot.level_intensity / shot.white).astype(np.float32)
    valid = np.ones((1, 1), np.bool_) if shot.valid is None else shot.valid
    rows, columns = (-(-length // step) for length in shot.levels.shape)
    beyond, light, weight = (np.zeros(rows * columns, np.float32) for _ in range(3))
    read, photons = noise
    scalars = tuple(np.float32(value) for value in (read**2, photons, _TEXTURE**2, _DARKEST))
    _look_around(shot.levels, intensity, valid, step, shot.pitch, scalars, beyond, light, weight)
    return beyond, light, weight


@loop
def _look_around(  # type: ignore[no-untyped-def]
    levels, intensity, valid, step, pitch, scalars, beyond, light, weight
):
    read2, photons, texture2, darkest = scalars
    eighth = np.float32(1 / 8)
    height, width = levels.shape
    masked = valid.shape == levels.shape
    place = -1
    for row in range(0, height, step):
        for column in range(0, width, step):
            place += 1
            to_row, to_column = smaller(row, height - 1 - row), smaller(column, width - 1 - column)
            if smaller(to_row, to_column) < pitch:
                continue
            own = intensity[levels[row, column]]
            total, squares, usable = np.float32(0.0), np.float32(0.0), True
            for down in (-pitch, 0, pitch):
                for right in (-pitch, 0, pitch):
                    y, x = row + down, column + right
                    usable &= not masked or valid[y, x]
                    apart = intensity[levels[y, x]] - own
                    total += apart
                    squares += apart * apart
            mean = total * eighth
            around = own + mean
            if usable and np.isfinite(total) and around > darkest:
                spread = larger(squares * eighth - mean * mean, np.float32(0.0))
                beyond[place] = -mean
                light[place] = around
                weight[place] = np.float32(1.0) / (
                    spread + read2 + photons * around + texture2 * around * around
                )


@loop
def _add_products(beyond, light, weight, apart, part, sums, beside):  # type: ignore[no-untyped-def]
    """Of all pairs of frames: per part of the sensor, the weighed products and the weights.

    ``apart``: how many frames, at least. And how many pixels, of the products of each pixel with the one to the right
    of it, and with the one below, which ``beside`` has.
    """
    more, less = np.float32(_LEAST_CHANGE), np.float32(1 / _LEAST_CHANGE)
    frames_apart, away = apart
    rows, columns = part.shape
    for first in range(len(beyond)):
        for second in range(first + frames_apart, len(beyond)):
            for row in range(rows):
                for column in range(columns):
                    i = row, column
                    before, after = light[first][i], light[second][i]
                    both = weight[first][i] * weight[second][i]
                    if not both > 0 or less * before <= after <= more * before:
                        continue
                    sums[part[i], 0] += both * beyond[first][i] * beyond[second][i]
                    sums[part[i], 1] += both
                    for k in range(2):
                        other = row + k * away, column + (1 - k) * away
                        if other[0] < rows and other[1] < columns:
                            both = weight[first][i] * weight[second][other]
                            beside[k, 0] += both * beyond[first][i] * beyond[second][other]
                            beside[k, 1] += both


def _solved(sums: Array, beside: Array) -> FixedPattern:
    used = sums[sums[:, 1] > 0]
    if len(used) < _LEAST_PARTS:
        return FixedPattern(0.0, 0.0, np.inf)
    variance = float(used[:, 0].sum() / used[:, 1].sum()) / _WHITE
    error = ratio_error(used) / _WHITE
    shared = float((beside[:, 0] / np.maximum(beside[:, 1], _TINY)).max()) / _WHITE
    is_found = variance > _BELIEVED * error and shared < _TEXTURED * variance
    return FixedPattern(float(np.sqrt(variance)) if is_found else 0.0, variance, error)
