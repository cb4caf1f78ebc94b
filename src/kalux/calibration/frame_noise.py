"""Read and shot noise of frames, from pixels that see no event: the photon transfer curve of a recording.

Where nothing happens, two frames differ by their noise. What is faint but has an extent (light that flickers, a soft
edge that creeps below the threshold) changes neighbours alike, while noise is each pixel's own: of the difference of
two frames only what a pixel has beyond the mean of its four neighbours counts. On simulated recordings with noise of a
quarter of a level, of which everything moves, that is a quarter of what the differences themselves say.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.intervals import Interval, camera_of, intervals
from kalux.calibration.silences import find_silences, overlaps
from kalux.compiled import empty, event_column, event_row, event_words, loop, smaller, zeros
from kalux.event_slices import all_between
from kalux.filters.shots import Shot
from kalux.frames import Frame
from kalux.models.camera import Response, common_rounding, rounding_error
from kalux.recording import Recording
from kalux.settings import CameraSettings

Array = NDArray[np.float64]

MAX_FRAMES: Final = 80
_MIN_FRAMES: Final = 20
_ENOUGH_PIXELS: Final = 80 * 260 * 346
"""Pixels of all frames that are enough: those of 80 frames of a DAVIS346, whose standard error is well below 1 %."""

_BEYOND_NEIGHBOURS: Final = np.array([[0, -0.25, 0], [-0.25, 1, -0.25], [0, -0.25, 0]])

_BINS: Final = 32  # of the intensity, 1 = saturated
_LEAST: Final = 200  # pixels of a frame pair in a bin
_LEAST_OF_CROSSES: Final = 50
"""The same of pixels that are only known to have no event of their own and of the four beside them.

Of a dark scene with noise of 0.02 and 4 Hz of events log-MSE is 3.1 and not 5.0, rms z 1.3 and not 2.7. Where noise is
less than usual, what else is wrong with frames (blur, time) counts beside it: with 0.002, which is right, MSE of two
scenes is 5 to 8 % larger."""

_DARKEST: Final = 0.01  # two to three levels of 8 bits: below, black cuts the noise off


_FLAT: Final = 5
"""Width of the parts of a frame by whose noise those that are flat are told, pixels."""

_FLATTEST: Final = (0.1, 0.6)
"""Share of these parts that counts as flat, and the mean square in the noisiest of them, of that of all if all are."""

_AROUND: Final = _FLAT + 2
"""Width of the surroundings by whose mean a part is dark, pixels."""

_DARK_PARTS: Final = ((0.015, 0.04), (0.03, 0.06), (0.06, 0.12))
"""Levels from which and up to which it is: the darker, the less is beside noise that changes with the light; but from
`_CUT` standard deviations of the noise on, or black cuts it off."""

_CUT: Final = 2.0
"""Level, in standard deviations of the noise, below which black cuts off a part of it: from here on 2 %."""

_LEAST_PARTS: Final = 100
"""Dark parts of a frame that are enough: each pixel is in the middle of one."""

_CONTRADICTED: Final = 1.5
"""Noise, in units of that of the flattest parts, which these contradict: they say 0.88 to 1.05 of what there is, or
more."""

WITHOUT_SLOPES: Final = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]]) / 6
"""What a pixel has beyond its row and its column, slopes included; white noise keeps its variance. J. Immerkaer, Fast
noise variance estimation, Computer Vision and Image Understanding 64 (1996)."""

PART: Final = 10
"""Width of the parts of a frame by whose noise those that change smoothly are told, pixels."""

_SMOOTHEST: Final = 0.1
"""Quantile of the noise of these parts that counts. It is 0.83 of the noise where there is nothing else; where some
texture moves, 0.85 to 1.22 on nine scenes."""

_NEXT_SMOOTHEST: Final = 0.3
_ALIKE: Final = 1.25
"""Largest ratio of this quantile to that at which it is noise that they say: 1.1 where there is nothing else. Where it
is texture, they differ."""

_MOST_USUAL: Final = 2.0
"""Noise, in units of the usual, beyond which it is not believed, however alike these parts are, if it is not white."""

_WHITE: Final = 2.0
"""Largest ratio of what these parts have at twice the distance between pixels to what they have, for it to be white:
1.2 to 2.0 with noise of 0.03 and 0.06 over 19 photographs, which all move; of their textures, where these are as much,
2.5 to 3.5."""

_LEAST_IN_THE_DARK: Final = 0.1
"""Least variance at black, in units of that at their level."""

_OF_WHITE: Final = 0.84
"""What `_SMOOTHEST` of the parts have of white noise."""

_LEAST_SMOOTH: Final = 20
"""Parts of a frame that are enough."""

_BRIGHTER: Final = 2.0
"""Growth of the variance from black to white, in units of that at black, where its level alone is told: at half of
white the noise is 1.4 times that in the dark. Of three DAVIS sensors it is 1 to 1.85 times."""

_FLAT_LEVEL: Final = (_DARK_PARTS[0][0] + _DARK_PARTS[-1][-1]) / 2
"""Level at which flat parts of the dark are taken to tell the noise: the middle of all that count. Most are from 0.015
to 0.04, but some texture is left in them: with 0.0275, the middle of these, noise in the dark comes out 1.1 to 1.9
times as large, and log-MSE of one scene is 1.38 times what it is so, of others 0.99 to 1.01 times."""

_BRIGHTER_PARTS: Final = 2.0
"""Least level of parts that change smoothly, in units of that of still pixels, from which they tell how noise grows."""

_BEYOND_SMOOTH: Final = 1.4
"""Noise of still pixels, in units of that of parts that change smoothly, from which it is not noise alone. It is 1.2
where there is nothing else, 1.05 to 1.22 on four recordings."""

LEAST_READ: Final = 0.5 / 65535
"""Least read noise of frames in floats, white = 1: the rounding of 16 bits, finer than any camera's."""

_AT_HALF: Final = 2.0
"""Noise at half of white in units of that in the dark, where only the latter is told."""

_STORED: Final = 0.005
"""Of stored values: over so much to either side of one the slope of a response is taken."""

_LEAST_BEHIND: Final = 0.5 / 255 / 3**0.5
"""Least read noise there: the rounding of 8 bits of light. Frames that bend show the dark finer than events tell how it
goes on: with less, rms z of three scenes is 1.1 to 1.7 instead of 0.9 to 1.35."""

_SPAN: Final = 3.0  # largest over smallest level, below which read and shot noise cannot be told apart
_LARGEST_ERROR: Final = 0.3  # relative: beyond it the points are no photon transfer curve


class FrameNoise(NamedTuple):
    """Photon transfer: variance = read^2 + shot * intensity, white = 1.

    Attributes
    ----------
    read, shot
        Standard deviation in the dark, and variance per intensity: `kalux.settings.CameraSettings.frame_noise` and
        ``shot_noise``.
    error
        Relative standard error of the standard deviation, from the scatter of the points. Larger than 0.3, and the
        curve is not one: something else changes the frames.
    levels, variances
        The points of the curve.
    """

    read: float
    shot: float
    error: float
    levels: Array
    variances: Array

    @property
    def is_reliable(self) -> bool:
        """Whether the points lie on a line well enough to be taken as settings."""
        return self.error < _LARGEST_ERROR

    @property
    def at_half(self) -> float:
        """Standard deviation at half of white."""
        return self.at(0.5)

    def at(self, level: float) -> float:
        """Standard deviation at a level of intensity, white = 1."""
        return noise_at(self.read, self.shot, level)


def noise_at(read: float, shot: float, level: float) -> float:
    """Standard deviation of noise with this read and shot part at a level of intensity, white = 1."""
    return float(np.sqrt(read**2 + shot * level))


def estimate_frame_noise(
    recording: Recording,
    camera: CameraSettings,
    *,
    most_frames: int | None = None,
    delay: int = 0,
) -> FrameNoise | None:
    """Photon transfer curve of pixels without events nearby from one exposure's start to the next one's end.

    In units of the intensity of a saturated pixel of the frames, by levels; the median over frame pairs, so that pairs
    with faint motion do not count. Read noise is no less than `common_rounding`, or that of 16 bits. None where fewer
    than two levels are seen, each by 200 pixels of a frame pair. Where noise leaves no such pixels, 50 without events
    of their own and of the four beside are enough, if they have more noise than usual: of less, they say too little;
    and if the flattest parts of the dark do not say that it is less (`flat_noise`). In any case parts that change
    smoothly may say that it is less (`smooth_noise`), and where all pixels are about as bright, these or flat parts
    how it grows.

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response and saturation.
    most_frames
        Only so many frames from the start are looked at. Default: as many as it takes, at most 80.
    delay
        How late the events are known to be, us.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    most_frames = most_frames or _enough_frames(recording.sensor_size)
    # Where noise leaves no pixel without events in 5x5 around it, 3x3 must do, or those beside it; they let more faint
    # motion in.
    points = _points(recording, camera, most_frames, delay)
    chosen = next((k for k, found in enumerate(points) if _is_curve(found)), None)
    if chosen is None:
        return None
    seen = [np.array(found) for found in points[chosen] if found]
    levels, variances = (np.array([np.median(found[:, i]) for found in seen]) for i in range(2))
    weights = np.array([np.sqrt(found[:, 2].sum()) for found in seen])
    frame, response = next(iter(recording.frames())), _response(recording, camera)
    rounding = common_rounding(frame, response)
    # Noise of much less than a level shows as none, or as any.
    least = _rounding(levels, frame, response)
    moves, points_of = _SURROUNDINGS[chosen].moves, (levels, np.maximum(variances, least**2), weights)
    found = photon_transfer(*points_of, motion=moves)
    whole = levels >= _CUT * found.read  # where black cuts nothing off
    if 2 <= np.count_nonzero(whole) < len(whole):
        found = photon_transfer(*(values[whole] for values in points_of), motion=moves)
    if moves and found.read <= camera.usual_frame_noise:
        return None
    flat, smooth = _noise_of_parts(recording, camera)
    if moves and flat is not None and found.read > _CONTRADICTED * flat:  # what moves, and not noise
        return None
    if _are_alike(found.levels):
        found = _with_growth(found, flat, smooth, camera, response)
    if smooth is not None:
        found = _bounded(found, smooth, float(_rounding(np.array([smooth.level]), frame, response)[0]))
    read = max(found.read, rounding, LEAST_READ)
    return found._replace(read=read, shot=found.shot if found.shot > LEAST_READ**2 else 0.0)


def _rounding(levels: Array, frame: Frame, response: Response) -> Array:
    """Standard deviation of rounding at levels of the intensity."""
    half = np.maximum(
        common_rounding(frame, response), response.rounding(response(levels), rounding_error(frame))
    )
    return np.asarray(half / 3**0.5, np.float64)


def _noise_of_parts(recording: Recording, camera: CameraSettings) -> tuple[float | None, SmoothNoise | None]:
    """That of flat parts of the dark, and that of parts that change smoothly where it is noise; None: nothing tells."""
    changes = (_beyond_neighbours(i.first, i.second) for i in _comparable(recording, camera, _MIN_FRAMES))
    seen = [(flat_noise(change), smooth_noise(change)) for change in changes]
    flat = typical_flat_noise([one for one, _ in seen])
    smooth = typical_smooth_noise([one for _, one in seen])
    return flat, smooth if smooth is not None and smooth.is_noise else None


def _bounded(found: FrameNoise, smooth: SmoothNoise, rounding: float) -> FrameNoise:
    """The noise scaled to that of ``smooth`` parts, or to ``rounding`` at their level, if it is far more.

    What seems still changes all the same then, as fine texture does that moves below the threshold.
    """
    beyond = found.at(smooth.level) / max(smooth.deviation, rounding, LEAST_READ)
    if beyond <= _BEYOND_SMOOTH:
        return found
    return found._replace(read=found.read / beyond, shot=found.shot / beyond**2)


def _with_growth(
    found: FrameNoise,
    flat: float | None,
    smooth: SmoothNoise | None,
    camera: CameraSettings,
    response: Response,
) -> FrameNoise:
    """How the noise grows with the light, where still pixels, whose levels are alike, do not tell it.

    Of bright ones by the flattest parts of the dark, if these have less noise. Of dark ones by brighter parts that
    change smoothly, at most as the noise of other cameras grows. Else, behind a response that bends, it is the same of
    all stored values.
    """
    level, variance = float(np.mean(found.levels)), found.read**2
    is_bright = level > _DARK_PARTS[-1][-1]
    if not response.is_linear and (flat is None or not is_bright):
        read, shot = _of_stored(response, [(level, found.read)])
        variance = read**2 + shot * level
    elif is_bright:
        shot = 0.0 if flat is None else max(variance - flat**2, 0.0) / (level - _FLAT_LEVEL)
    else:
        shot = max(_most_at_half(found.read, camera) ** 2 - variance, 0.0) / (0.5 - level)
    if not is_bright and smooth is not None and smooth.level > _BRIGHTER_PARTS * level:
        shot = min(shot, max(smooth.deviation**2 - variance, 0.0) / (smooth.level - level))
    return found._replace(read=float(np.sqrt(max(variance - shot * level, 0.0))), shot=shot)


def _of_stored(response: Response, told: list[tuple[float, float]]) -> tuple[float, float]:
    """Read and shot noise behind a response that bends, where noise is the same of all stored values.

    ``told``: levels and the standard deviation at each, of which the least counts, as stored.
    """
    levels, deviations = np.array(told).T
    return noise_behind(response, float((deviations / response.slope(levels, _STORED)).min()))


def noise_behind(response: Response, stored: float) -> tuple[float, float]:
    """Read and shot noise behind a ``response`` of noise with one standard deviation, as ``stored``, at all levels.

    The variance of I is nearly in proportion to the light behind gamma: the line is that through the dark and half of
    white.
    """
    dark, half = (stored * response.slope(np.array([_DARKEST, 0.5]), _STORED)) ** 2
    shot = float(max(half - dark, 0.0)) / (0.5 - _DARKEST)
    return max(float(np.sqrt(max(dark - shot * _DARKEST, 0.0))), _LEAST_BEHIND), shot


class UsualNoise(NamedTuple):
    """Noise of frames where no photon transfer tells it, white = 1.

    Attributes
    ----------
    read, shot
        As of `FrameNoise`.
    silent
        Whether ``read`` is what pixels without events change by: those with events, or none, say too much.
    """

    read: float
    shot: float
    silent: bool

    @property
    def is_doubtful(self) -> bool:
        """Whether events may contradict, by pixels of up to 0.03 of white: not where black cuts these off."""
        return not self.silent and self.read <= 2 * _DARKEST


def usual_noise(recording: Recording, camera: CameraSettings, *, delay: int = 0) -> UsualNoise:
    """Read and shot noise where no photon transfer tells them: the usual at half of white, in the dark what it allows.

    Whatever moves, pixels change by their noise at least: from 0.01 to 0.02 of white it is no more than those do that
    see no event, nor the four beside, or than all do where these are too few. And it is no more than in the flattest
    parts of the dark (`flat_noise`). Where nothing is so dark, it is what parts have that change smoothly
    (`smooth_noise`), or the usual; where something is, such parts bound it at their level. Where nothing is still the
    rounding is another one in every frame, so that its standard deviation is the least. Behind a response that bends
    noise is the same of all stored values: that of smooth parts where it is as fine as noise, else the least of these.

    Parameters
    ----------
    recording
        With known exposures.
    camera
        Response, saturation, and ``usual_frame_noise``.
    delay
        How late the events are known to be, us.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    usual, seen = camera.usual_frame_noise, _see_what_moves(recording, camera, delay)
    response = _response(recording, camera)
    if not response.is_linear:
        read, shot = _usual_of_stored(response, seen, usual)
        return UsualNoise(possible_read(recording, camera, read), shot, silent=seen.silent)
    flat, smooth = seen.flat, seen.smooth
    if smooth is not None and seen.is_of_smooth(usual):
        black = smooth.in_the_dark(usual)
        if flat is not None:
            black = flat if _CUT * flat <= _DARK_PARTS[-1][0] else max(flat, black)
        read = possible_read(recording, camera, black)
        return UsualNoise(read, smooth.shot(read, usual), silent=False)
    most = seen.in_the_dark if flat is not None else [usual, *seen.in_the_dark]
    read = possible_read(recording, camera, min(most))
    shot = _shot(read, usual)
    if smooth is not None:
        shot = min(shot, smooth.most_shot(read))
    return UsualNoise(read, shot, silent=seen.silent)


class _Seen(NamedTuple):
    """What frames of which everything may move say of their noise, as standard deviations.

    Attributes
    ----------
    flat
        Of flat parts of the dark; None: there are none.
    changed
        Of pixels from 0.01 to 0.02 of white; None: too few, or black cuts too much of it off.
    silent
        Whether these have no events.
    smooth
        Of parts that change smoothly; None: there are none.
    is_quiet
        Whether flat parts of the dark of some frames have less than twice the usual.
    """

    flat: float | None
    changed: float | None
    silent: bool
    smooth: SmoothNoise | None
    is_quiet: bool

    @property
    def in_the_dark(self) -> list[float]:
        """All that is known of the dark: each is what there is, or more."""
        return [value for value in (self.flat, self.changed) if value is not None]

    def is_of_smooth(self, usual: float) -> bool:
        """Whether smooth parts have the noise: where the dark does not tell it, or it is far more than the usual."""
        if self.smooth is None:
            return False
        alone = not self.in_the_dark and self.smooth.is_told(usual)
        return alone or (self.smooth.is_all_noise(usual) and not self.is_quiet)


def _see_what_moves(recording: Recording, camera: CameraSettings, delay: int) -> _Seen:
    cross = _SURROUNDINGS[-1]
    of_silent: list[float] = []
    of_all: list[float] = []
    of_flat: list[list[float | None]] = []
    of_smooth: list[SmoothNoise | None] = []
    for interval in _comparable(recording, camera, _MIN_FRAMES, delay):
        change = _beyond_neighbours(interval.first, interval.second)
        level, difference, usable, dark, *_ = change
        low = usable & ~dark & (level < 2 * _DARKEST)
        busy = _busy(interval, delay)
        silent = low & (cv2.dilate(busy, cross.shape) == 0)
        for chosen, least, into in (
            (low & ~near(dark), _LEAST, of_all),
            (silent, cross.least, of_silent),
        ):
            if np.count_nonzero(chosen) >= least:
                into.append(trimmed_variance(difference[chosen]) / 2)
        of_flat.append(flat_noise(change))
        of_smooth.append(smooth_noise(change))
    flat, changes = typical_flat_noise(of_flat), of_silent or of_all
    if flat is not None and flat > 2 * _DARKEST:  # black cuts off half of what pixels have that are so dark
        changes = []
    quiet = _MOST_USUAL * camera.usual_frame_noise
    return _Seen(
        flat,
        float(np.sqrt(np.median(changes))) if changes else None,
        bool(of_silent and changes),
        typical_smooth_noise(of_smooth),
        any(darkest is not None and darkest < quiet for darkest, *_ in of_flat),
    )


def _usual_of_stored(response: Response, seen: _Seen, usual: float) -> tuple[float, float]:
    """Read and shot noise behind a response that bends: of smooth parts if that is as fine as noise, else the least."""
    told = [] if seen.smooth is None else [(seen.smooth.level, seen.smooth.deviation)]
    if seen.smooth is None or not seen.smooth.is_white:
        told += [(0.5, usual), *((2 * _DARKEST, deviation) for deviation in seen.in_the_dark)]
    return _of_stored(response, told)


class SmoothNoise(NamedTuple):
    """Noise of the parts of two frames that change most smoothly; white = 1.

    Attributes
    ----------
    deviation
        Standard deviation of one frame.
    level
        Their mean intensity.
    next_deviation
        The same of those that come next.
    coarser
        What the smoothest parts have if pixels twice as far apart are compared, in units of ``deviation``: 1 of white
        noise, more of texture.
    growth
        By how much the variance of the smoothest of the brighter half of all parts is more than that of the darker
        half's, over the difference of their levels, in units of ``deviation``^2.
    """

    deviation: float
    level: float
    next_deviation: float
    coarser: float
    growth: float

    @property
    def is_noise(self) -> bool:
        """Whether both are so much alike that texture has no part in them."""
        return self.next_deviation <= _ALIKE * self.deviation

    def is_told(self, usual: float) -> bool:
        """Whether it counts in place of the usual noise.

        Where it is no less, parts must be alike, and texture as fine as noise may be all over the frame.
        """
        return self.deviation < usual or (self.is_noise and self.deviation < _MOST_USUAL * usual)

    @property
    def is_white(self) -> bool:
        """Whether it is as fine as noise, and no texture."""
        return self.coarser <= _WHITE

    def is_all_noise(self, usual: float) -> bool:
        """Whether it is far more than the ``usual``, and noise all the same."""
        return self.is_noise and self.is_white and self.deviation >= _MOST_USUAL * usual

    def of_level(self, usual: float) -> float:
        """Standard deviation of all pixels at the level: where it is all noise, these parts have the least of it."""
        return self.deviation / (_OF_WHITE if self.is_all_noise(usual) else 1.0)

    def in_the_dark(self, usual: float) -> float:
        """Standard deviation at black; where it is all noise, by how it grows from darker parts to brighter ones."""
        if not self.is_all_noise(usual):
            return self.deviation / float(np.sqrt(1.0 + _BRIGHTER * self.level))
        most = (1.0 - _LEAST_IN_THE_DARK) / self.level
        return self.of_level(usual) * float(np.sqrt(1.0 - min(max(self.growth, 0.0), most) * self.level))

    def shot(self, read: float, usual: float) -> float:
        """Shot noise with which the noise at the level is this, with ``read`` in the dark; none if that is more."""
        return max(self.of_level(usual) ** 2 - read**2, 0.0) / self.level

    def most_shot(self, read: float) -> float:
        """The most shot noise that these parts allow, with ``read`` in the dark: they have the least of the noise."""
        return max((self.deviation / _OF_WHITE) ** 2 - read**2, 0.0) / self.level


def smooth_noise(change: FrameChange) -> SmoothNoise | None:
    """The noise of two frames where they change smoothly, whatever moves.

    Of every part of 10x10 pixels, the root mean square of what its pixels' changes have beyond rows and columns:
    neither slopes nor what the sensor's pixels always have count. The tenth of these from below is noise, or more.
    None: fewer than 20 parts are from 0.12 of white on and not clipped; frames are in RGB, as in `flat_noise`.
    """
    if not change.is_own:
        return None
    levels = square_parts(change.level).mean(1)
    whole = square_parts(change.usable).all(1) & (levels > _DARK_PARTS[-1][-1])
    if np.count_nonzero(whole) < _LEAST_SMOOTH:
        return None
    levels = levels[whole]
    fine, coarse = (_beyond_slopes(change.change, k * change.pitch)[whole] / 2 for k in (1, 2))
    found = np.sqrt(fine)
    first, after = (float(value) for value in np.quantile(found, (_SMOOTHEST, _NEXT_SMOOTHEST)))
    smoothest = found <= first
    ratio = coarse[smoothest].mean() / max(fine[smoothest].mean(), LEAST_READ**2)
    growth = _growth(levels, fine) / max(first, LEAST_READ) ** 2
    return SmoothNoise(first, float(levels[smoothest].mean()), after, float(np.sqrt(ratio)), growth)


def _beyond_slopes(plane: Array, apart: int) -> NDArray[Any]:
    """(N,) variance of every part beyond rows, columns and slopes, by `WITHOUT_SLOPES` over pixels ``apart``."""
    beyond = cv2.filter2D(plane, cv2.CV_64F, _of_one_colour(WITHOUT_SLOPES, apart))
    return np.asarray(square_parts(beyond * beyond).mean(1))


def _growth(levels: Array, squares: Array) -> float:
    """By how much the smoothest brighter parts have more than the smoothest darker ones, over their difference."""
    brighter = levels > np.median(levels)
    if brighter.all() or not brighter.any():
        return 0.0
    (dark, less), (bright, more) = (
        (levels[half].mean(), np.quantile(squares[half], _SMOOTHEST)) for half in (~brighter, brighter)
    )
    return float((more - less) / (bright - dark))


def typical_smooth_noise(found: list[SmoothNoise | None]) -> SmoothNoise | None:
    """The median of `smooth_noise` of several pairs of frames; None: none has such parts."""
    known = [one for one in found if one is not None]
    return SmoothNoise(*np.median(np.array(known), axis=0).tolist()) if known else None


def smoothest(plane: Array, usable: NDArray[np.bool_], pitch: int) -> float | None:
    """Standard deviation of the white noise that the smoothest parts of a plane would have, or more.

    As of `smooth_noise`, of one plane, of which the parts count that are ``usable``. None: fewer than 20 parts are.
    """
    whole = square_parts(usable).all(1)
    if np.count_nonzero(whole) < _LEAST_SMOOTH:
        return None
    return float(np.sqrt(np.quantile(_beyond_slopes(plane, pitch)[whole], _SMOOTHEST))) / _OF_WHITE


def square_parts(plane: NDArray[Any]) -> NDArray[Any]:
    """(N, 100) the pixels of every part; what is left over on the right and below is in none."""
    rows, columns = (length // PART for length in plane.shape)
    cut = plane[: rows * PART, : columns * PART].reshape(rows, PART, columns, PART)
    return np.asarray(cut.swapaxes(1, 2).reshape(rows * columns, PART**2))


def flat_noise(change: FrameChange) -> list[float | None]:
    """Standard deviation of the noise of two frames in their flattest dark parts, white = 1, by how dark they are.

    Whatever moves, pixels change by their noise at least. Of every part of 5x5 pixels, of which the mean of those
    around is between two levels over both frames (0.015 and 0.04, 0.03 and 0.06, 0.06 and 0.12 of white), the mean
    square of what its pixels change beyond the mean of their four neighbours; of these the tenth from below, which is
    less than the mean where all is noise. Neighbours are those of a pixel's own colour. None: too little is so dark;
    frames are in RGB, whose neighbours share their noise.
    """
    if not change.is_own:
        return [None] * len(_DARK_PARTS)
    beyond = change.beyond if change.pitch == 1 else _beyond_four(change.change, change.pitch)
    squares = cv2.boxFilter(beyond * beyond, cv2.CV_64F, (_FLAT, _FLAT)) / 2
    around = cv2.boxFilter(change.level, cv2.CV_64F, (_AROUND, _AROUND))
    whole = cv2.erode(change.usable.astype(np.uint8), np.ones((_FLAT, _FLAT), np.uint8)) > 0
    share, of_mean = _FLATTEST

    def noise(darkest: float, brightest: float) -> float | None:
        found = squares[whole & (around > darkest) & (around < brightest)]
        if len(found) < _LEAST_PARTS:
            return None
        least = max(float(np.quantile(found, share)), 0.0)  # the filter adds and subtracts, and rounds
        return float(np.sqrt(least / of_mean))

    return [noise(*limits) for limits in _DARK_PARTS]


def typical_flat_noise(found: list[list[float | None]]) -> float | None:
    """The median of `flat_noise` of several pairs of frames, of the darkest parts from which black cuts nothing off.

    None: no parts are of the darkest kind.
    """
    noise = None
    for (darkest, _), of_parts in zip(_DARK_PARTS, zip(*found, strict=True), strict=False):
        known = [value for value in of_parts if value is not None]
        if not known:
            break
        noise = float(np.median(known))
        if darkest >= _CUT * noise:
            break
    return noise


def quiet_noise(recording: Recording, camera: CameraSettings, dark: float) -> tuple[float, float]:
    """Read and shot noise of frames that have less than was taken in the dark: ``dark``, white = 1.

    At half of white it is taken to be twice that, but no more than the usual: three DAVIS sensors have 1 to 1.85 times.
    Behind a response that bends it is the same of all stored values, no more than the usual at half of white.
    """
    response = _response(recording, camera)
    if not response.is_linear:
        told = [(2 * _DARKEST, dark), (0.5, camera.usual_frame_noise)]
        read, shot = _of_stored(response, told)
        return possible_read(recording, camera, read), shot
    read = possible_read(recording, camera, dark)
    return read, _shot(read, _most_at_half(read, camera))


def _most_at_half(dark: float, camera: CameraSettings) -> float:
    """Standard deviation at half of white, where only that in the dark is told."""
    return min(_AT_HALF * dark, camera.usual_frame_noise)


def _shot(read: float, at_half: float) -> float:
    """Shot noise with which the standard deviation at half of white is ``at_half``: none where ``read`` is more."""
    return max(at_half**2 - read**2, 0.0) / 0.5


def possible_read(recording: Recording, camera: CameraSettings, dark: float) -> float:
    """Noise in the dark: no less than the standard deviation of rounding."""
    rounding = common_rounding(next(iter(recording.frames())), _response(recording, camera)) / 3**0.5
    return max(dark, rounding, LEAST_READ)


def _response(recording: Recording, camera: CameraSettings) -> Response:
    """The camera's, or that of its green pixels."""
    return camera_of(recording, camera).response


def _comparable(
    recording: Recording, camera: CameraSettings, most_frames: int, delay: int = 0
) -> Iterator[Interval]:
    """The intervals whose frames differ by noise alone where there is no event.

    Not those in which events have been lost: there all that moves is without.
    """
    silences = find_silences(recording, most_frames=most_frames)
    margin = recording.longest_exposure + abs(delay)
    for interval in intervals(recording, camera, margin=margin, most_frames=most_frames, apart=0):
        begin, end = interval.first.start, interval.second.end
        if interval.has_one_exposure and not overlaps(silences, begin + delay, end + delay):
            yield interval


def _enough_frames(sensor_size: tuple[int, int]) -> int:
    height, width = sensor_size
    return min(max(-(-_ENOUGH_PIXELS // (height * width)), _MIN_FRAMES), MAX_FRAMES)


_Points = list[list[tuple[float, float, int]]]


class _Surroundings(NamedTuple):
    """Which pixels around one must be without events for it to count as still.

    Attributes
    ----------
    shape
        The pixels: a mask with the pixel in its middle.
    least
        How many still pixels are enough in a bin of a frame pair.
    moves
        Whether the mask is so small that faint motion passes it.
    """

    shape: NDArray[np.uint8]
    least: int
    moves: bool


_SURROUNDINGS: Final = (
    _Surroundings(np.ones((5, 5), np.uint8), _LEAST, False),
    _Surroundings(np.ones((3, 3), np.uint8), _LEAST, False),
    _Surroundings(np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8), _LEAST_OF_CROSSES, True),
)


def _is_curve(points: _Points) -> bool:
    """Whether there are points at two levels, the least that a line can be fitted to."""
    return sum(map(bool, points)) >= 2


def _points(
    recording: Recording, camera: CameraSettings, most_frames: int, delay: int
) -> tuple[_Points, ...]:
    """By bins of the level: level, variance and number of pixels of every frame pair; for each of `_SURROUNDINGS`.

    Those of the smaller end where the larger are enough.
    """
    found: tuple[_Points, ...] = tuple([[] for _ in range(_BINS)] for _ in _SURROUNDINGS)
    for interval in _comparable(recording, camera, most_frames, delay):
        level, difference, usable, dark, *_ = _beyond_neighbours(interval.first, interval.second)
        busy = _busy(interval, delay)
        near_dark = near(dark)
        for points, around in zip(found, _SURROUNDINGS, strict=True):
            still = cv2.dilate(busy, around.shape) == 0
            too_dark = dark if around.moves else near_dark  # of a neighbour's noise a quarter counts
            _add(points, level, difference, still & usable & ~too_dark, around.least)
            if _is_curve(points):
                break
    return found


def _busy(interval: Interval, delay: int) -> NDArray[np.uint8]:
    """(H, W): 1 where there is an event from the start of one exposure to the end of the next; ``delay`` us late."""
    first, second = interval.first, interval.second
    busy = np.zeros(first.levels.shape, np.uint8)
    for events in all_between(interval.chunks, first.start + delay, second.end + delay):
        _mark(event_words(events), busy)
    return busy


@loop
def _mark(words, busy):  # type: ignore[no-untyped-def]
    for i in range(len(words)):
        busy[event_row(words[i, 1]), event_column(words[i, 1])] = 1


def near(dark: NDArray[np.bool_], reach: int = 1) -> NDArray[np.bool_]:
    """(H, W): pixels with a marked one no more than ``reach`` rows and columns away: among the 3x3 around them."""
    around = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.dilate(dark.astype(np.uint8), around) > 0, np.bool_)


class FrameChange(NamedTuple):
    """By how much two frames differ, (H, W) each; white = 1.

    Attributes
    ----------
    level
        Mean intensity.
    beyond
        The part of its change that neighbours do not share. It has the variance of the change where that is white
        noise. Frames in RGB have been demosaiced, most of them compressed too, so that neighbours share their noise:
        the whole change is taken.
    usable
        Pixels in whose surroundings nothing clips, or is masked.
    dark
        What is too dark.
    pitch
        How far apart pixels of one colour are: 2 in a Bayer mosaic.
    is_own
        Whether every pixel has a noise of its own: not of frames in RGB.
    change
        The whole change.
    """

    level: Array
    beyond: Array
    usable: NDArray[np.bool_]
    dark: NDArray[np.bool_]
    pitch: int
    is_own: bool
    change: Array


def _beyond_neighbours(first: Shot, second: Shot) -> FrameChange:
    """The change from one frame to another."""
    level, change = np.empty((2, *first.levels.shape))
    bad = np.empty(level.shape, np.bool_)
    _compare(*by_level(first), *by_level(second), level, change, bad)
    dark = level <= _DARKEST
    is_own = first.chroma is None
    beyond = _beyond_four(change, 1) if is_own else change
    for shot in (first, second):
        if shot.valid is not None:
            bad |= ~shot.valid
    usable = inner_pixels(~near(bad))
    return FrameChange(level, beyond, usable, dark, first.pitch, is_own, change)


def inner_pixels(usable: NDArray[np.bool_], reach: int = 1) -> NDArray[np.bool_]:
    """(H, W): those that do not lie at the border, where a neighbour up to ``reach`` pixels away counts twice."""
    inside = np.zeros_like(usable)
    inside[reach:-reach, reach:-reach] = usable[reach:-reach, reach:-reach]
    return inside


def _beyond_four(change: Array, pitch: int) -> Array:
    """What a pixel's change has beyond the mean of four, ``pitch`` from it; with the variance of white noise."""
    kernel = _of_one_colour(_BEYOND_NEIGHBOURS, pitch)
    return np.asarray(cv2.filter2D(change, cv2.CV_64F, kernel) / np.linalg.norm(kernel), np.float64)


def _of_one_colour(kernel: Array, pitch: int) -> Array:
    """A filter's ``kernel`` that reaches for the pixels of its own colour, which are ``pitch`` apart."""
    spread = np.zeros((pitch * (len(kernel) - 1) + 1,) * 2)
    spread[::pitch, ::pitch] = kernel
    return spread


def by_level(shot: Shot) -> tuple[NDArray[np.integer[Any]], Array, NDArray[np.bool_]]:
    """Levels of the pixels; of each level I in units of white, and whether it is clipped."""
    return shot.levels, shot.level_intensity / shot.white, shot.level_clipped


@loop
def _compare(  # type: ignore[no-untyped-def]
    before, intensity, clipped, after, next_intensity, next_clipped, level, change, bad
):
    """Of two frames: mean intensity, its change, and what clips."""
    for row in range(level.shape[0]):
        for column in range(level.shape[1]):
            a, b = before[row, column], after[row, column]
            mean = (intensity[a] + next_intensity[b]) / 2
            level[row, column] = mean
            change[row, column] = next_intensity[b] - intensity[a]
            bad[row, column] = clipped[a] | next_clipped[b]


def _add(points: _Points, level: Array, difference: Array, chosen: NDArray[np.bool_], least: int) -> None:
    """Add the points of the pixels chosen of a frame pair, of bins with so many at least."""
    kept = np.flatnonzero(chosen)
    ordered, sums, stops = _in_bins(level.ravel(), difference.ravel(), kept)
    for found, total, start, stop in zip(points, sums, stops, stops[1:], strict=False):
        if stop - start >= least:
            variance = trimmed_variance(ordered[start:stop]) / 2
            found.append((float(total / (stop - start)), variance, int(stop - start)))


@loop
def _in_bins(level, difference, kept):  # type: ignore[no-untyped-def]
    """Differences of the pixels that are kept, one bin of the level after the other; sum of the levels, and limits."""
    index = empty(len(kept), np.uint8)
    sums, stops = zeros(_BINS, np.float64), zeros(_BINS + 1, np.int64)
    for i in range(len(kept)):
        value = level[kept[i]]
        k = smaller(np.int64(value * _BINS), _BINS - 1)
        index[i] = k
        sums[k] += value
        stops[k + 1] += 1
    for k in range(_BINS):
        stops[k + 1] += stops[k]
    ordered, free = empty(len(kept), np.float64), stops.copy()
    for i in range(len(kept)):
        ordered[free[index[i]]] = difference[kept[i]]
        free[index[i]] += 1
    return ordered, sums, stops


def trimmed_variance(values: Array) -> float:
    """Variance without what lies beyond four standard deviations (edges that move), about the mean."""
    return float(_trimmed_variance(np.ascontiguousarray(values, np.float64)))


@loop
def _trimmed_variance(values):  # type: ignore[no-untyped-def]
    low, high = -np.inf, np.inf
    before, variance = -1, 0.0
    for _ in range(6):
        count, total = 0, 0.0
        for value in values:
            if low <= value <= high:
                count += 1
                total += value
        if count == before:
            break
        mean, squares = total / count, 0.0
        for value in values:
            if low <= value <= high:
                squares += (value - mean) * (value - mean)
        before, variance = count, squares / count
        spread = np.sqrt(variance)
        low, high = mean - 4 * spread, mean + 4 * spread
    return variance


def photon_transfer(levels: Array, variances: Array, weights: Array, *, motion: bool = False) -> FrameNoise:
    """Fit variance = read^2 + shot * level, neither negative; relative errors alike at all levels.

    Levels that are alike (up to a factor of three) do not tell the two apart: all of it is then taken as read noise,
    which in log intensity errs on the safe side. With ``motion`` a term in level^2 is fitted as well, and left out of
    what is found: what moves unseen changes the light by a share of it.
    """
    relative = weights / np.maximum(variances, 1e-10)
    alike = _are_alike(levels)
    powers = 1 if alike else 3 if motion else 2
    design = levels[:, None] ** np.arange(powers)
    found = _not_negative(design * relative[:, None], variances * relative)
    fitted = design @ found
    scatter = float(
        np.sqrt(np.mean((variances / np.maximum(fitted, 1e-12) - 1) ** 2) / max(len(levels) - 2, 1))
    )
    read2, shot = float(found[0]), 0.0 if alike else float(found[1])
    return FrameNoise(float(np.sqrt(read2)), shot, scatter / 2, levels, variances)


def _are_alike(levels: Array) -> bool:
    """Whether levels are too near to one another to tell read and shot noise apart."""
    return bool(levels.max() < _SPAN * levels.min())


def _not_negative(design: Array, values: Array) -> Array:
    """Least squares of a few coefficients, none negative: of those of some of them the best.

    SciPy's takes longer to import than all else here to run.
    """
    count = design.shape[1]
    best, least = np.zeros(count), np.inf
    for chosen in itertools.product((False, True), repeat=count):
        used = np.flatnonzero(chosen)
        found = np.zeros(count)
        found[used] = np.linalg.lstsq(design[:, used], values, rcond=None)[0]
        left = float(np.sum((design @ found - values) ** 2))
        if left < least and (found >= 0).all():
            best, least = found, left
    return best
