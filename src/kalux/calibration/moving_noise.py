"""Noise of frames of which everything moves: their photon transfer along the motion.

Where nothing stands still, two frames differ by what has moved. But optical flow tells where it is in the other frame:
put in its place, it differs by noise, and by what is left of its texture, as flow has errors and frames have pixels.
What is left grows with the texture that there was. With x the variance that a part of a frame has beyond rows, columns
and slopes, and y half of that of its difference to the other frame,

    y = n + k (x - n),    n = read^2 + shot I,

since a part without texture has x = y = n: least squares over the parts of several pairs of frames tell read, shot and
k, though no part be smooth. The sensor's fixed pattern does not move, and counts as noise.
"""

from __future__ import annotations

import functools
import itertools
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from kalux.augmentation.motion import steady_flow
from kalux.calibration.frame_noise import (
    PART,
    WITHOUT_SLOPES,
    by_level,
    inner_pixels,
    near,
    noise_at,
    noise_behind,
    possible_read,
    square_parts,
)
from kalux.calibration.intervals import camera_of, is_one_exposure
from kalux.calibration.regression import robust_deviation
from kalux.filters.shots import Shot, take_shot
from kalux.frames import Frame
from kalux.models.camera import Response
from kalux.recording import Recording
from kalux.settings import CameraSettings

Array = NDArray[np.float64]

_PARTS: Final = 4000
"""Of all pairs of frames, clipped ones included; at least `_PAIRS`[0] pairs, and no more than `_PAIRS`[1]."""

_PAIRS: Final = (3, 20)
_LEAST_PARTS: Final = 100
_LEAST_SIDE: Final = 32  # rows and columns without which there is not much to follow

_DARKEST: Final = 0.02
"""Least level of a part, white = 1, and two standard deviations of its noise: below, black cuts that off."""

_BEND: Final = 0.05
"""Intensity, white = 1, below which images that are followed are linear, and beyond logarithmic: light has 8 bits."""

_CUBIC: Final = -0.75
_FRACTIONS: Final = 32
"""OpenCV's cubic interpolation: its parameter, and into how many steps it divides the distance of two pixels."""

_START: Final = 0.2  # quantile of what is left, from which the fit starts
_ROUNDS: Final = 12
_TUNING: Final = 1.5  # robust deviations from which Huber's weights fall
_FAR: Final = 4.0  # the same, from which a part does not count: something hides it in one of the frames
_MOST_TEXTURE: Final = 0.95  # share k beyond which nothing is told apart
_TINY: Final = 1e-9  # variance, white = 1: below the rounding of 14 bits

_SCATTERED: Final = 0.45
"""Relative deviation of parts from the fit from which it is a bound alone: 0.17 to 0.33 where noise is all there is (a
part of 100 pixels has some 60 independent values); beyond 0.45 it is mostly more than there is, up to 12 times."""

_BEYOND: Final = 1.4
"""Noise, in units of this, from which it is contradicted: of 89 recordings without a fixed pattern this is 0.95 to 1.16
of what there is at 0.3 of white (the tenths from below and above)."""


class MovingNoise(NamedTuple):
    """Noise of frames, with the fixed pattern of the sensor; white = 1.

    Attributes
    ----------
    read, shot
        As of `kalux.calibration.frame_noise.FrameNoise`.
    scatter
        Relative deviation of the parts from the fit.
    levels
        From which intensity to which it was seen: the tenth of the parts from below, and from above.
    """

    read: float
    shot: float
    scatter: float
    levels: tuple[float, float]

    @property
    def is_certain(self) -> bool:
        """Whether it is noise and nothing else."""
        return self.scatter < _SCATTERED

    def contradicts(self, read: float, shot: float) -> bool:
        """Whether it is far less than such noise."""
        return any(
            noise_at(read, shot, level) > _BEYOND * noise_at(self.read, self.shot, level)
            for level in self.levels
        )


def estimate_moving_noise(recording: Recording, camera: CameraSettings) -> MovingNoise | None:
    """Read and shot noise from frames that move, and the variance of the sensor's fixed pattern with it.

    Behind a response that bends, it is the same of all stored values. None: fewer than a hundred parts are well
    exposed; the sensor has less than 32 rows or columns; or frames are in colour, whose neighbouring pixels do not show
    the same light.

    Parameters
    ----------
    recording
        With frames and exposures, of which those that differ by less than a tenth are compared.
    camera
        Response and saturation.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    height, width = recording.sensor_size
    model = camera_of(recording, camera)
    if min(height, width) < _LEAST_SIDE or model.colours is not None:
        return None
    frames = [*itertools.islice(recording.frames(), _PAIRS[1] + 1)]
    if not all(map(_is_grey, frames)):
        return None
    pairs = min(max(-(-_PARTS * PART**2 // (height * width)), _PAIRS[0]), _PAIRS[1])
    found = []
    for frame, following in itertools.islice(itertools.pairwise(frames), 0, None, _PAIRS[1] // pairs):
        if is_one_exposure(frame.amplified_exposure, following.amplified_exposure):
            first, second = (take_shot(each, model, float(each.exposure)) for each in (frame, following))
            found.append(_compare(first, second, model.response))
    if not found:
        return None
    parts = _Parts(*(np.concatenate(values) for values in zip(*found, strict=True)))
    noise = _fitted(parts, model.response)
    return None if noise is None else noise._replace(read=possible_read(recording, camera, noise.read))


def _is_grey(frame: Frame) -> bool:
    """Whether all its pixels show light of one colour."""
    return frame.image.ndim == 2 and frame.mosaic is None


def told_by_motion(
    recording: Recording, camera: CameraSettings, otherwise: tuple[float, float], *, is_seen: bool
) -> MovingNoise | None:
    """The noise of what moves, where it counts, of a sensor without a fixed pattern.

    It does where nothing else has been seen of the noise and it is certain; and where it is far less than what counts
    otherwise, however much it scatters: what is left of a texture makes it too large.

    Parameters
    ----------
    recording, camera
        As of `estimate_moving_noise`.
    otherwise
        Read and shot noise that count otherwise.
    is_seen
        Whether these are of what stands still, and not the usual.
    """
    moving = estimate_moving_noise(recording, camera)
    if moving is None:
        return None
    counts = moving.contradicts(*otherwise) or (moving.is_certain and not is_seen)
    return moving if counts else None


class _Parts(NamedTuple):
    """The well exposed parts of pairs of frames: (N,) intensity, and the variances x and y, of stored values."""

    level: Array
    own: Array
    left: Array

    def above(self, level: float) -> _Parts:
        """Those that are brighter."""
        chosen = self.level > level
        return _Parts(*(values[chosen] for values in self))


def _compare(first: Shot, second: Shot, response: Response) -> _Parts:
    """The parts of a frame, in the place of which the second is put by its motion."""
    (intensity, bad), (following, bad_after) = _seen(first), _seen(second)
    stored, after = (np.asarray(response(light), np.float32) for light in (intensity, following))
    bent, bent_after = (np.log1p(light.clip(0.0, 1.0) / _BEND) for light in (intensity, following))
    moved_x, moved_y = steady_flow(bent, bent_after, 0.0, float(np.log1p(1.0 / _BEND)))
    rows, columns = np.indices(stored.shape, np.float32)
    x, y = columns + moved_x, rows + moved_y
    put = np.asarray(cv2.remap(after, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.float32)
    hidden = cv2.remap(
        bad_after.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0
    )
    usable = inner_pixels(~(bad | near(near(hidden > 0))))
    noise = 1.0 + square_parts(_noise_left(x) * _noise_left(y)).mean(1)
    whole = square_parts(usable).all(1)
    parts = _Parts(square_parts(intensity).mean(1), _fine(stored), _fine(put - stored) / noise)
    return _Parts(*(values[whole] for values in parts))


def _seen(shot: Shot) -> tuple[Array, NDArray[np.bool_]]:
    """(H, W) intensity, white = 1, and beside what no value is one."""
    levels, intensity, clipped = by_level(shot)
    bad = clipped[levels] if shot.valid is None else clipped[levels] | ~shot.valid
    return intensity[levels], near(bad)


def _fine(plane: NDArray[np.float32]) -> Array:
    """(N,) variance that parts have beyond rows, columns and slopes."""
    beyond = cv2.filter2D(plane, cv2.CV_32F, WITHOUT_SLOPES)
    return np.asarray(square_parts(beyond * beyond).mean(1, dtype=np.float64))


def _noise_left(places: NDArray[np.float32]) -> Array:
    """The variance of `_fine` that interpolation leaves of white noise at such places, in one direction."""
    return np.asarray(np.interp(np.mod(places, 1.0), *_noise_of_steps()))


@functools.cache
def _noise_of_steps() -> tuple[Array, Array]:
    """The same of the places between two pixels that interpolation tells apart."""
    steps = np.arange(_FRACTIONS + 1) / _FRACTIONS
    left = [np.square(np.convolve(_weights(step), WITHOUT_SLOPES[0])).sum() for step in steps]
    return steps, np.array(left) / left[0]


def _weights(fraction: float) -> Array:
    """(4,) of the pixels around a place, a ``fraction`` right of the second: R. Keys, Cubic convolution interpolation
    for digital image processing, IEEE Transactions on Acoustics, Speech, and Signal Processing 29 (1981)."""
    a = _CUBIC
    near_by, far = (np.array([fraction + k, 1 + k - fraction]) for k in (0, 1))
    inner = (a + 2) * near_by**3 - (a + 3) * near_by**2 + 1
    outer = a * (far**3 - 5 * far**2 + 8 * far - 4)
    return np.array([outer[0], inner[0], inner[1], outer[1]])


def _fitted(parts: _Parts, response: Response) -> MovingNoise | None:
    """The noise that the parts have, from where black cuts nothing off."""
    least = _DARKEST
    for _ in range(2):
        parts = parts.above(least)
        if len(parts.level) < _LEAST_PARTS:
            return None
        read, shot, scatter = _line(parts, with_shot=response.is_linear)
        least = 2.0 * read
    if not response.is_linear:
        read, shot = noise_behind(response, read)
    darkest, brightest = (float(level) for level in np.quantile(parts.level, (0.1, 0.9)))
    return MovingNoise(read, shot, scatter, (darkest, brightest))


def _line(parts: _Parts, *, with_shot: bool) -> tuple[float, float, float]:
    """Read noise, shot noise and scatter: weighed least squares of parts, whose errors are in proportion to y."""
    one = np.ones_like(parts.own)
    columns = np.stack([one, *([parts.level] if with_shot else []), parts.own], 1)
    expected, weights = np.full(len(one), np.quantile(parts.left, _START)), one
    for _ in range(_ROUNDS):
        scaled = weights / np.maximum(expected, _TINY)
        terms, _ = nnls(columns * scaled[:, None], parts.left * scaled)
        expected = np.maximum(columns @ terms, _TINY)
        errors = parts.left / expected - 1.0
        away, scatter = np.abs(errors), robust_deviation(errors)
        weights = np.sqrt(np.minimum(1.0, _TUNING * scatter / np.maximum(away, _TINY)))
        weights[away > _FAR * scatter] = 0.0
    variances = terms[:-1] / (1.0 - min(float(terms[-1]), _MOST_TEXTURE))
    return float(np.sqrt(variances[0])), float(variances[1]) if with_shot else 0.0, scatter
