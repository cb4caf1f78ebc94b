"""At which levels a sensor's pixels end: where they pile up, and where events say that the light goes on.

A pile at the end of a histogram may be a bright sky. Where pixels become as bright as the brightest, what events say of
the change is compared with what frames show of it: of a sky as at other levels, of clipped pixels more, since events do
not clip. Comparing with other levels makes up for thresholds that are a little wrong.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.intervals import camera_of, compared_frames, counted_intervals
from kalux.frames import Frame
from kalux.models.camera import Camera, clipping_level
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings
from kalux.white import BRIGHTEST, sharp_end

Array = NDArray[np.float64]

_AT_TOP: Final = 0.9
"""Share of the brightest level from which a pixel may be clipped: uneven sensors clip within 5 % (slider_depth)."""

_BELOW: Final = (0.6, 0.85)
"""Shares of the brightest level between which lie the pixels for comparison."""

_LEAST_NET: Final = 2  # a net count of one may be noise
_LEAST_PIXELS: Final = 100
_MAX_FRAMES: Final = 80
_FINE: Final = 4096  # levels of the histogram

_EXCESS: Final = 0.15
"""Least log intensity by which the change by events exceeds that of frames more at the brightest than at other levels.
slider_depth has 0.2, street 0.3, simulated scenes 0.26 to 0.7; eight that frames show wholly, two of them with
thresholds a third too large, -0.2 to 0.07."""

_EXPLAINED: Final = 0.5
"""Largest difference of the changes by events and by frames at other levels; beyond it events do not explain frames."""

_LARGEST_SPREAD: Final = 0.1
"""Largest interquartile range of the brightest levels, over their median: sensors that end at one level have 0 to
0.05, newton, whose highlights are thin, 0.2."""


_SHARP: Final = 0.99
"""Share of a level from which nearly all pixels must saturate for it to count as one level."""


class Ceiling(NamedTuple):
    """Where a sensor's pixels saturate.

    Attributes
    ----------
    level
        Response at which the middle one of the pixels does, white = 1.
    least
        Response from which on nearly all that is seen is clipped: as far below ``level`` as a twentieth lies above.
    excess
        How much brighter than the level pixels become there by their events, median, log intensity.
    pixels
        How many, in all frame intervals, say so.
    """

    level: float
    least: float
    excess: float
    pixels: int

    def is_at(self, level: float) -> bool:
        """Whether nearly all pixels saturate at this one level."""
        return self.least >= _SHARP * level

    @property
    def saturation(self) -> float:
        """A response from which none of these pixels is taken for measured."""
        return _SHARP * self.least


def find_ceiling(
    recording: Recording,
    camera: CameraSettings,
    events: EventSettings,
    *,
    below: float = np.inf,
    most_frames: int = _MAX_FRAMES,
) -> Ceiling | None:
    """The level at which pixels of the first frames end while their events go on.

    Parameters
    ----------
    recording
        With frames and exposures; of RGB the channel counts by which a pixel is clipped (`clipping_level`).
    camera
        Response and I_0.
    events
        With both thresholds, the delay and the refractory period.
    below
        Not looked for where the frames reach this response.
    most_frames
        So many frames are looked at, and the events between them.

    Returns None where events do not go on, or too few pixels tell, or the brightest end at different levels.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    model = camera_of(recording, camera)
    brightest = _brightest(recording, model, most_frames)
    if brightest is None or brightest >= below:
        return None
    found = [*_changes(recording, camera, model, events, _BELOW[0] * brightest, most_frames)]
    if not found:
        return None
    ends, mismatches = np.concatenate(found, axis=1)
    top, below = ends >= _AT_TOP * brightest, ends < _BELOW[1] * brightest
    if min(np.count_nonzero(top), np.count_nonzero(below)) < _LEAST_PIXELS:
        return None
    usual = float(np.median(mismatches[below]))
    excess = float(np.median(mismatches[top])) - usual
    low, level, high, most = (float(value) for value in np.quantile(ends[top], [0.25, 0.5, 0.75, 0.95]))
    if excess < _EXCESS or abs(usual) > _EXPLAINED or high - low > _LARGEST_SPREAD * level:
        return None
    return Ceiling(level, 2 * level - most, excess, int(np.count_nonzero(top)))


def _brightest(recording: Recording, model: Camera, most_frames: int) -> float | None:
    """The response that a thousandth of the pixels of the first frames reach; None: all are black."""
    compared = (_in_grey(frame, model) for frame in compared_frames(recording.frames(), most_frames))
    histogram = response_histogram(compared, _FINE)
    reached = np.cumsum(histogram[::-1])[::-1] >= max(BRIGHTEST * histogram.sum(), 1)
    brightest = int(np.flatnonzero(reached)[-1]) if reached.any() else 0
    return brightest / (_FINE - 1) if brightest > 0 else None


def _in_grey(frame: Frame, model: Camera) -> Frame:
    """A frame of the channel by which each pixel is clipped, (H, W), where it is in RGB."""
    if frame.image.ndim == 2:
        return frame
    level = clipping_level(model, frame.image, frame.white_value, frame.black)
    return dataclasses.replace(frame, image=level)


def _changes(
    recording: Recording,
    camera: CameraSettings,
    model: Camera,
    events: EventSettings,
    least: float,
    most_frames: int,
) -> Iterator[Array]:
    """(2, N) of pixels that become brighter from one frame of an interval to the other, forward or backward in time.

    First the response at the bright end, where that is ``least`` or more, then by how much more than the frames events
    say that it changed, log(I + I_0).
    """
    threshold_on, threshold_off = events.thresholds
    for interval, on, off, bend in counted_intervals(recording, camera, events, most_frames=most_frames):
        beyond = threshold_on * on - threshold_off * off + bend - interval.change
        frames = [end.frame for end in interval.ends]
        for sign, frame in zip((-1, 1), frames, strict=True):
            ends = _in_grey(frame, model).normalised()
            chosen = (sign * (on - off) >= _LEAST_NET) & (ends >= least)
            for each in frames:
                chosen &= True if each.valid is None else each.valid
            yield np.stack([ends[chosen], sign * beyond[chosen]])


LAST_LEVEL: Final = 0.999
"""Share of a clean end from which a pixel is at it: the last level of 8 bits, two of 10, five of 12."""

_LEAST_ODDS: Final = 0.1
"""Least ratio of pixels from the usual saturation on to those at the end, among pixels between four at it, by which
pixels end unevenly. Of 863 simulated scenes that end cleanly most have 0 to 0.01, skies of about white up to 0.09, four
real and long ones up to 0.05. It is 0.4 to 1 where half of the clipped pixels are a little below the end, 0.08 to 0.2
where 16 % are."""


class FramesEnd(NamedTuple):
    """The level at which frames end.

    Attributes
    ----------
    level
        Response that a thousandth of the pixels have and none exceeds, white = 1.
    is_clean
        Whether clipped pixels are all at that level, so that those just below it are measured.
    """

    level: float
    is_clean: bool


def frames_end(recording: Recording) -> FramesEnd | None:
    """At which level the first 80 frames end, and how; None where they do not end at one (`kalux.white.sharp_end`).

    A pixel between four that are clipped is clipped, too, but for fine texture: where pixels end at levels of their
    own, or noise comes after clipping, such pixels are often a little below the end.
    """
    end = sharp_end(_measured(frame) for frame in _first_frames(recording))
    if end is None:
        return None
    near, at_end = np.sum([_between_clipped(frame, end) for frame in _first_frames(recording)], axis=0)
    return FramesEnd(end, bool(at_end >= _LEAST_PIXELS and near < _LEAST_ODDS * at_end))


def _between_clipped(frame: Frame, end: float) -> tuple[int, int]:
    """How many pixels between four at the ``end`` are a little below it, and at it."""
    image = _above_black(frame)
    seen = True if frame.valid is None else frame.valid.reshape(frame.valid.shape + (1,) * (image.ndim - 2))
    at_end, close = (
        (image >= share * end * frame.full_scale) & seen
        for share in (LAST_LEVEL, CameraSettings.usual_saturation)
    )
    between = at_end[:-2, 1:-1] & at_end[2:, 1:-1] & at_end[1:-1, :-2] & at_end[1:-1, 2:]
    clipped, of_both = (int(np.count_nonzero(pixels[1:-1, 1:-1] & between)) for pixels in (at_end, close))
    return of_both - clipped, clipped


def _first_frames(recording: Recording) -> Iterator[Frame]:
    return islice(recording.frames(), _MAX_FRAMES)


def _measured(frame: Frame) -> tuple[NDArray[Any], float]:
    """Valid pixels above black, and what they are divided by."""
    image = _above_black(frame)
    return (image if frame.valid is None else image[frame.valid]), frame.full_scale


def _above_black(frame: Frame) -> NDArray[Any]:
    return frame.image - frame.black if frame.black > 0 else frame.image


class ClippingLevels(NamedTuple):
    """Where the frames clip, share of white; None where no pile of pixels is seen."""

    black: float | None
    saturation: float | None


_PILE: Final = 4.0  # times as many pixels as in the levels beside it


def clipping_levels(recording: Recording, most_frames: int) -> ClippingLevels:
    """Where pixels of the first ``most_frames`` pile up at either end of their histogram: the inner edge of the pile.

    A pile ends the histogram in its upper (lower) quarter and is at least four times as frequent as the levels
    inside it. Where the sensor has fixed pattern noise it spreads over some levels.
    """
    histogram = response_histogram(islice(recording.frames(), most_frames), 256)
    if not histogram.any():
        return ClippingLevels(None, None)
    bottom, top = (_pile(values) for values in (histogram[::-1], histogram))
    return ClippingLevels(
        None if bottom is None else (255 - bottom + 0.5) / 255, None if top is None else (top - 0.5) / 255
    )


_PILE_REACH: Final = 64  # levels: a quarter
_BESIDE: Final = 20  # levels, just inside a pile


def _pile(histogram: NDArray[np.int64]) -> int | None:
    """The innermost level of a pile at the upper end; None where there is none."""
    present = np.flatnonzero(np.cumsum(histogram[::-1])[::-1] > 1e-4 * histogram.sum())
    end = int(present[-1])
    if end < len(histogram) - _PILE_REACH:
        return None
    edge = end
    while edge > _BESIDE:
        beside = max(float(np.median(histogram[edge - _BESIDE : edge])), 1.0)
        if histogram[edge] < 1.5 * beside:
            break
        edge -= 1
    inside = max(float(np.median(histogram[max(edge - _BESIDE, 0) : edge + 1])), 1.0)
    return edge + 1 if edge < end and histogram[edge + 1 :].max() >= _PILE * inside else None


def response_histogram(frames: Iterable[Frame], levels: int) -> NDArray[np.int64]:
    """(levels,) how many valid pixels have each response from 0 to 1."""
    histogram = np.zeros(levels, np.int64)
    for frame in frames:
        values = np.rint((levels - 1) * np.clip(frame.normalised(), 0, 1)).astype(np.int64)
        values = values if frame.valid is None else values[frame.valid]
        histogram += np.bincount(values.ravel(), minlength=levels)
    return histogram
