"""The black level of frames: what every pixel reads in the dark on top of its light, found by what events say.

A floor below which no pixel is may be a camera's black, or the darkest thing of a scene. Events tell which: they are
steps of log(I + I_0), I_0 >= 0, so that frames that show I change as much for an event in the dark as in the light, or
more. Frames that show I above a black level change less in the dark. Taking off the level at which events and frames
agree best leaves log(I + I_0): it is less than the camera's by I_0, never more.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.delay import DelayEstimate, estimate_delay
from kalux.calibration.intervals import WELL_EXPOSED, camera_of, compared_frames, intervals, spread
from kalux.calibration.levels import response_histogram
from kalux.event_slices import between, count_events
from kalux.models.camera import Response
from kalux.recording import Recording, less_black
from kalux.settings import CameraSettings, EventSettings

Array = NDArray[np.float64]

_LEVEL: Final = 1 / 255  # of 8 bits, in which frames of cameras with a black level mostly are

_MAX_FRAMES: Final = 80
_FINE: Final = 4096  # levels of the histogram

_DARKEST: Final = 1e-3
"""Share of the pixels that may be darker than the floor: fewer are broken ones, or noise."""

_LEAST_FLOOR: Final = 1.5 * _LEVEL
"""With a thousandth of the pixels at or below it frames show black where it is, within a level."""

_LARGEST_FLOOR: Final = 0.5  # of white, as the setting

_ABOVE: Final = 2 * _LEVEL
"""Least distance of samples from the floor: below, rounding and noise decide what the logarithm of the rest is."""

_CHANGE: Final = 4 * _LEVEL
"""Least change of samples: several times the noise of frames, so that what events say is compared with a known one.
It is a difference of responses, which no black level changes."""

_LEAST_EVENTS: Final = 1.0
"""Least number of events that the change of frames stands for: of smaller ones many make none."""

_STEP: Final = _LEVEL / 2
"""Of the levels tried."""

_LEAST_SAMPLES: Final = 1000
_PER_INTERVAL: Final = 5000

_MISMATCH: Final = 0.1
"""Variance of a count per square of it, beside that of one event: thresholds differ, and blur is not undone here."""

_FAR: Final = 2.5
"""Standard deviations from which on a difference counts linearly (Huber)."""

_LEAST_GAIN: Final = 0.05
"""Least share of the misfit that a black level explains. Without one, 36 simulated recordings of scenes that have
nothing dark have up to 0.013; with one, scenes with something dark mostly have 0.05 to 0.9 (docs/calibration.md)."""

_LEAST_GAIN_AT_FLOOR: Final = 0.02
"""The same where the floor agrees with the best level: two that say so. Where v2e's pixels explain some of it, too,
they are not two."""

_SURE: Final = 3.0
"""Standard deviations, between parts of the image, by which that gain is more than nothing."""

_PARTS: Final = 6  # of the image along each side
_LEAST_PARTS: Final = 4

_KNEE: Final = 20 / 255
"""Of white, below which the pixels of v2e are linear (its `lin_log`), three times as steep at the knee as above it: in
the dark they have more events than log(I) has, as the light of a camera with a black level seems to have."""

_AT_FLOOR: Final = 4 * _LEVEL
"""How far below the floor of the frames the best level lies at most where that floor is black: the best level is too
low by I_0 and by the blur of dark edges, one to three and a half levels of 255 on simulated scenes."""


class BlackLevel(NamedTuple):
    """What a recording says of black.

    Attributes
    ----------
    floor
        Response below which a thousandth of the pixels lies, white = 1.
    level
        The black level, the same unit; 0: events do not say that there is one.
    gain
        Share of what events and frames differ by that taking ``level`` off removes.
    samples
        Pixels and frame intervals compared.
    delay
        That of the events against the frames as they are, where it was estimated.
    """

    floor: float
    level: float = 0.0
    gain: float = 0.0
    samples: int = 0
    delay: DelayEstimate | None = None


class _Samples(NamedTuple):
    """Pixels that change: (N,) responses before and after, log ratios of what they stand for by their exposures, net
    counts of events, and parts of the image."""

    before: Array
    after: Array
    of_exposures: Array
    net: Array
    part: NDArray[np.int64]

    def change(self, seen: Callable[[Array], Array]) -> Array:
        """(N,) log changes of the light that frames show, where ``seen`` makes its logarithm of responses."""
        return np.asarray(seen(self.after) - seen(self.before) + self.of_exposures)

    def where(self, chosen: NDArray[np.bool_]) -> _Samples:
        """Some of them."""
        before, after, of_exposures, net, part = self
        return _Samples(before[chosen], after[chosen], of_exposures[chosen], net[chosen], part[chosen])


def with_known_black(
    recording: Recording, camera: CameraSettings, events: EventSettings
) -> tuple[Recording, BlackLevel | None]:
    """The recording with its black level taken off: that of the settings, else one known before, else what events say.

    Whatever goes by the intensity of frames has to come after it. `find_black_level` has the parameters and errors.

    Returns
    -------
    The recording, whose ``black_level`` is known from now on, unless its frames state where black is; and what was
    looked for, None where nothing was.
    """
    if camera.black_level is not None:
        return less_black(recording, camera.black_level), None
    if recording.black_level is not None or _states_black(recording):
        return recording, None
    found = find_black_level(recording, camera, events)
    return less_black(recording, 0.0 if found is None else found.level), found


def _states_black(recording: Recording) -> bool:
    first = next(iter(recording.frames()), None)
    return first is not None and first.black > 0


def find_black_level(
    recording: Recording, camera: CameraSettings, events: EventSettings
) -> BlackLevel | None:
    """Compare the first 80 frames with their events, under every black level up to the floor of the frames.

    Parameters
    ----------
    recording
        With frames, in grey or a mosaic, and exposures.
    camera
        The response.
    events
        The delay; None: the apparent one is estimated.

    Returns None where frames show black at 0, or are in RGB, or state where black is.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    floor = _floor(recording)
    if floor is None or not _LEAST_FLOOR <= floor <= _LARGEST_FLOOR:
        return None
    estimate = estimate_delay(recording, camera) if events.delay is None else None
    delay = (events.delay or 0) if estimate is None else estimate.apparent
    response = camera_of(recording, camera).response
    return _decided(_samples(recording, camera, floor, delay), response, floor)._replace(delay=estimate)


def _floor(recording: Recording) -> float | None:
    """The response that a thousandth of the pixels of the first frames do not exceed.

    None: there are no frames, or they are in RGB, or state where black is.
    """
    first = next(iter(recording.frames()), None)
    if first is None or first.image.ndim == 3 or first.black > 0:
        return None
    below = np.cumsum(response_histogram(compared_frames(recording.frames(), _MAX_FRAMES), _FINE))
    return float(np.searchsorted(below, max(_DARKEST * below[-1], 1))) / (_FINE - 1)


def _samples(recording: Recording, camera: CameraSettings, floor: float, delay: int) -> _Samples:
    """At most 5000 of every interval between two of the first frames, spread evenly over its pixels that change.

    The frames have the same exposure but for a tenth: of others a difference of responses is no change of the light.
    """
    height, width = recording.sensor_size
    row, column = (np.arange(n) * _PARTS // n for n in (height, width))
    parts = _PARTS * row[:, None] + column
    margin = recording.longest_exposure + abs(delay)
    none = np.empty(0)
    found = [_Samples(none, none, none, none, np.empty(0, np.int64))]
    for interval in intervals(recording, camera, margin=margin, most_frames=_MAX_FRAMES):
        if not interval.has_one_exposure:
            continue
        before, after = (end.frame.normalised() for end in interval.ends)
        low, high = np.minimum(before, after), np.maximum(before, after)
        usable = (low >= floor + _ABOVE) & (high < WELL_EXPOSED[1]) & (high - low >= _CHANGE)
        for end in interval.ends:
            usable &= end.shot.measured
        chosen = spread(usable, _PER_INTERVAL)
        inside = between(interval.events, interval.start + delay, interval.end + delay)
        on, off = count_events(inside, recording.sensor_size)
        net = np.asarray(on, np.float64) - off
        of_exposures = np.full(len(chosen), np.log(interval.second.white / interval.first.white))
        values = (before.ravel()[chosen], after.ravel()[chosen], of_exposures, net.ravel()[chosen])
        found.append(_Samples(*values, parts.ravel()[chosen]))
    before, after, of_exposures, net = (
        np.concatenate([samples[field] for samples in found]) for field in range(4)
    )
    return _Samples(before, after, of_exposures, net, np.concatenate([samples.part for samples in found]))


def _decided(samples: _Samples, response: Response, floor: float) -> BlackLevel:
    """The black level that the samples say is there: the best one, or the floor where that is near."""

    def above(level: float) -> Callable[[Array], Array]:
        return lambda values: np.log(response.inverse((values - level) / (1.0 - level)))

    change = samples.change(above(0.0))
    extent = float(np.abs(change).sum())
    rate = float((np.sign(change) * samples.net).sum()) / extent if extent > 0 else 0.0
    enough = rate * np.abs(change) >= _LEAST_EVENTS
    samples, expected = samples.where(enough), rate * change[enough]
    if rate <= 0 or len(samples.net) < _LEAST_SAMPLES:
        return BlackLevel(floor)
    # The same weights under every level, so that their misfits can be compared.
    weight = 1 / (1 + _MISMATCH * np.square(expected))

    def misfit(seen: Callable[[Array], Array]) -> Array:
        return _misfit(samples.change(seen), samples.net, weight)

    tried = np.arange(0.0, floor, _STEP)
    best = float(tried[np.argmin([misfit(above(level)).mean() for level in tried])])
    without, least = misfit(above(0.0)), misfit(above(best))
    of_v2e = float((without - misfit(_seen_by_v2e)).mean())
    gain = float((without - least).mean())
    share = gain / max(float(without.mean()), 1e-12)
    at_floor = floor - best <= _AT_FLOOR
    least_gain = _LEAST_GAIN_AT_FLOOR if at_floor and of_v2e <= 0 else _LEAST_GAIN
    if gain < of_v2e or share < least_gain or not _is_sure(without - least, samples.part):
        return BlackLevel(floor, samples=len(samples.net))
    return BlackLevel(floor, floor if at_floor else best, share, len(samples.net))


def _seen_by_v2e(values: Array) -> Array:
    """(N,) what v2e's pixels make of responses, log intensity from the knee."""
    linear, logarithm = (values / _KNEE - 1) * np.log(20), np.log(np.maximum(values, _KNEE) / _KNEE)
    return np.where(values > _KNEE, logarithm, linear)


def _misfit(change: Array, net: Array, weight: Array) -> Array:
    """(N,) Huber losses of a straight line from log changes to counts of events, for each sign of the change."""
    lost = np.zeros_like(net)
    for same in (change > 0, change <= 0):
        if np.count_nonzero(same) < 2:
            continue
        x, y, w = change[same], net[same], weight[same]
        dx, dy = x - np.average(x, weights=w), y - np.average(y, weights=w)
        slope = float((w * dx * dy).sum() / max(float((w * dx * dx).sum()), 1e-12))
        away = np.abs(dy - slope * dx) * np.sqrt(w)
        lost[same] = np.where(away < _FAR, np.square(away), _FAR * (2 * away - _FAR))
    return lost


def _is_sure(gain: Array, part: NDArray[np.int64]) -> bool:
    """Whether the sum of the gains is far above 0, given how much those of parts of the image differ."""
    sums = np.bincount(part, gain)[np.unique(part)]
    if len(sums) < _LEAST_PARTS:
        return False
    return bool(sums.sum() > _SURE * np.sqrt(len(sums)) * sums.std(ddof=1))
