"""Deblurring by the event double integral (EDI; Pan et al. 2019, the paper's reference [32]).

A frame is the mean of the intensity over its exposure, and events tell how the intensity moved meanwhile:

    B + I_0 = 1/T int_s^e exp(L(t)) dt = exp(L(s)) 1/T int_s^e exp(E(s, t)) dt

with E(s, t) the sum of the events' steps from the start s of the exposure. So the latent (sharp) image is
L^D(t) = log(B + I_0) - log(mean of exp E(s, .)) + E(s, t). Each interval between two events is weighted by the
level that holds during it, and the mean runs over the whole exposure.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.events import EventArray

Array = NDArray[np.float64]


class ExposureIntegrals(NamedTuple):
    """What the events of one exposure say, per pixel; all (H, W) float64, log intensity.

    Attributes
    ----------
    log_mean
        log of the mean over the exposure of exp(E(s, t)).
    to_middle, to_end
        E(s, tau) and E(s, e).
    peak
        Largest E(s, t) within the exposure, at least 0.
    events
        Number of events within the exposure.
    """

    log_mean: Array
    to_middle: Array
    to_end: Array
    peak: Array
    events: Array


def integrate_exposure(
    events: EventArray, start: int, end: int, step_on: Array, step_off: Array
) -> ExposureIntegrals:
    """The double integral over one exposure.

    Parameters
    ----------
    events
        Time-ordered; those outside (start, end] are ignored.
    start, end
        The exposure, us.
    step_on, step_off
        (H, W) positive log-intensity steps of an event of either polarity.
    """
    inside = between(events, start, end)
    return ExposureIntegrals(
        *_integrate(
            inside["t"],
            inside["x"],
            inside["y"],
            inside["p"],
            start,
            (start + end) // 2,
            end,
            step_on,
            step_off,
        )
    )


def still_exposure(shape: tuple[int, int]) -> ExposureIntegrals:
    """The integrals of an exposure in which nothing is taken to move (deblurring off)."""
    return ExposureIntegrals(*(np.zeros(shape) for _ in range(5)))


def latent_start(log_frame: Array, integrals: ExposureIntegrals) -> Array:
    """L^D at the start of the exposure, from log(B + I_0)."""
    return log_frame - integrals.log_mean


def latent_middle(log_frame: Array, integrals: ExposureIntegrals) -> Array:
    """L^D at the middle of the exposure."""
    return latent_start(log_frame, integrals) + integrals.to_middle


def latent_end(log_frame: Array, integrals: ExposureIntegrals) -> Array:
    """L^D at the end of the exposure."""
    return latent_start(log_frame, integrals) + integrals.to_end


def latent_peak(log_frame: Array, integrals: ExposureIntegrals) -> Array:
    """The largest L^D within the exposure: tells a pixel that clipped for a part of it."""
    return latent_start(log_frame, integrals) + integrals.peak


def between(events: EventArray, start: int, end: int) -> EventArray:
    """The events with start < t <= end."""
    first, last = np.searchsorted(events["t"], [start, end], side="right")
    return events[first:last]


@nb.njit(cache=True, nogil=True)
def _integrate(t, x, y, p, start, middle, end, step_on, step_off):  # type: ignore[no-untyped-def]
    height, width = step_on.shape
    mean = np.zeros((height, width))
    to_middle = np.zeros((height, width))
    level = np.zeros((height, width))
    peak = np.zeros((height, width))
    count = np.zeros((height, width))
    since = np.full((height, width), start, np.int64)
    for i in range(len(t)):
        row, column = y[i], x[i]
        mean[row, column] += np.exp(level[row, column]) * (t[i] - since[row, column])
        since[row, column] = t[i]
        level[row, column] += step_on[row, column] if p[i] else -step_off[row, column]
        peak[row, column] = max(peak[row, column], level[row, column])
        count[row, column] += 1
        if t[i] <= middle:
            to_middle[row, column] = level[row, column]
    for row in range(height):
        for column in range(width):
            mean[row, column] += np.exp(level[row, column]) * (end - since[row, column])
            mean[row, column] = np.log(mean[row, column] / (end - start))
    return mean, to_middle, level, peak, count


@nb.njit(cache=True, nogil=True)
def _count(x, y, p, on, off):  # type: ignore[no-untyped-def]
    for i in range(len(x)):
        if p[i]:
            on[y[i], x[i]] += 1.0
        else:
            off[y[i], x[i]] += 1.0


def count_events(events: EventArray, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Number of on and off events of every pixel, two (H, W) float64."""
    on, off = np.zeros(shape), np.zeros(shape)
    _count(events["x"], events["y"], events["p"], on, off)
    return on, off
