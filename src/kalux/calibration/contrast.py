"""Contrast thresholds from a recording: log frame differences against event counts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.deblur import between, count_events
from kalux.augmentation.refractory import EventClock
from kalux.calibration.intervals import intervals
from kalux.recording import Recording
from kalux.settings import CameraSettings

Array = NDArray[np.float64]

MAX_SAMPLES: Final = 400_000
"""Pixels that are enough: the standard error of the fit is then below 0.1 %."""

_MIN_SAMPLES: Final = 200
_UNEXPLAINED: Final = 0.8  # of the typical change; 0.3 to 0.6 on recordings of moving scenes, 3 on flicker
NORMAL_MAD: Final = 1.4826  # standard deviation over median absolute deviation, of a normal distribution
HUBER: Final = 1.345  # 95 % efficiency for normal residuals (Huber 1981)
_MAX_FRAMES: Final = 200


class ThresholdEstimate(NamedTuple):
    """Fitted contrast thresholds.

    Attributes
    ----------
    on, off
        Thresholds, log intensity, both positive.
    residual
        Robust standard deviation of the fit, log intensity.
    samples
        Pixels and frame intervals used.
    """

    on: float
    off: float
    residual: float
    samples: int


def estimate_thresholds(
    recording: Recording,
    camera: CameraSettings,
    *,
    of_log_offset: bool = False,
    delay: int = 0,
    refractory_period: int = 0,
) -> ThresholdEstimate | None:
    """Global on and off thresholds, by robust regression of log frame differences on event counts.

    For every pixel that is well exposed in two successive frames and saw two events more of one kind than of the
    other between the middles of their exposures: log(I' + I_0) - log(I + I_0) = s (c_on n_on - c_off n_off), with
    s = I / (I + I_0) the share of a step of log I that shows in log(I + I_0), fitted with Huber's weights. A net
    count of one says little: it may be noise, and the rest of the threshold that it leaves over is as large as its
    step. Looks at the first 200 frames, or at fewer when those give enough pixels.

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response and I_0.
    of_log_offset
        Steps of log(I + I_0) instead of log I, s = 1, as in the paper's model.
    delay
        How much later than the frames' clock events are stamped, us.
    refractory_period
        Of the pixels, us: what is lost in it is added to the events (docs/equations.md, K13).

    Returns None where the recording has too few such pixels (200), e.g. because nothing moves, or where the
    events hardly explain how the frames change (residual above 0.8 of the change), e.g. because they are flicker.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    differences: list[Array] = []
    ons: list[Array] = []
    offs: list[Array] = []
    count = 0
    for difference, on, off in _samples(recording, camera, of_log_offset, delay, refractory_period):
        differences.append(difference)
        ons.append(on)
        offs.append(off)
        count += len(difference)
        if count >= MAX_SAMPLES:
            break
    if count < _MIN_SAMPLES:
        return None
    difference = np.concatenate(differences)
    fit = fit_thresholds(difference, np.concatenate(ons), np.concatenate(offs))
    typical = NORMAL_MAD * float(np.median(np.abs(difference)))
    return None if fit is None or fit.residual > _UNEXPLAINED * typical else fit


def fit_thresholds(difference: Array, on: Array, off: Array) -> ThresholdEstimate | None:
    """The regression itself, by iteratively reweighted least squares; None if a threshold is not determined.

    ``difference`` (N,) log intensity; ``on``, ``off`` (N,) event counts.
    """
    design = np.column_stack([on, -off])
    weights = np.ones(len(difference))
    solution: Array = np.zeros(2)
    scale = 0.0
    for _ in range(20):
        weighted = design * weights[:, None]
        normal = weighted.T @ design
        if np.linalg.cond(normal) > 1e8:
            return None
        previous = solution
        solution = np.linalg.solve(normal, weighted.T @ difference).astype(np.float64)
        residual = difference - design @ solution
        scale = NORMAL_MAD * float(np.median(np.abs(residual)))
        if scale < 1e-9:
            break  # an exact fit: nothing to weigh down
        weights = np.minimum(1.0, HUBER * scale / np.maximum(np.abs(residual), 1e-12))
        if np.abs(solution - previous).max() < 1e-5:
            break
    if not (solution > 0).all():
        return None
    return ThresholdEstimate(float(solution[0]), float(solution[1]), scale, len(difference))


def _samples(
    recording: Recording, camera: CameraSettings, of_log_offset: bool, delay: int, refractory_period: int
) -> Iterator[tuple[Array, Array, Array]]:
    """Log difference and on and off counts (times s) of the usable pixels, one frame interval at a time."""
    clock = EventClock(recording.sensor_size, refractory_period)
    for interval in intervals(recording, camera, margin=abs(delay), most_frames=_MAX_FRAMES):
        inside = clock.weighed(between(interval.events, interval.start + delay, interval.end + delay))
        on, off = count_events(inside, recording.sensor_size, weighed=True)
        chosen = interval.usable & (np.abs(on - off) >= 2)
        level = interval.level[chosen]
        share = np.ones_like(level) if of_log_offset else level / (level + camera.offset)
        yield interval.change[chosen], share * on[chosen], share * off[chosen]
