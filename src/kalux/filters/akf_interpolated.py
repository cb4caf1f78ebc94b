"""The asynchronous Kalman filter on an interpolated L^A: the paper's form, float64, exact or as printed.

Nominal steps, and R linear in time (7). As printed, (17) and (20) are exact only while neither L^A nor R moves.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.interpolation import InterpolatedSegment
from kalux.compiled import apart, empty, loop
from kalux.events import EventArray
from kalux.filters.akf import (
    State,
    interpolated_covariance,
    linear_covariance_integrals,
    predicted_deviation,
    predicted_information,
)
from kalux.filters.common import MICROSECOND, newest_around
from kalux.models.events import event_noise

Array = NDArray[np.float64]
Times = NDArray[np.int64]


class Cursor(NamedTuple):
    """Working arrays of the paper's form, (H, W); changed in place by `advance`."""

    log_intensity: Array
    variance: Array
    forward: Array
    backward: Array
    since: Times
    newest: Times


class Noise(NamedTuple):
    """Parameters of equation (2), s and 1/s, and whether (17) and (20) are taken as printed."""

    sigma_proc2: float
    sigma_iso2: float
    sigma_ref2: float
    refractory_bound: float
    printed: bool


def begin(segment: InterpolatedSegment, state: State) -> Cursor:
    """The cursor at the start of a segment."""
    return Cursor(
        log_intensity=state.log_intensity.astype(np.float64),
        variance=state.variance.astype(np.float64),
        forward=segment.forward.astype(np.float64),
        backward=segment.backward.astype(np.float64),
        since=np.full(state.newest.shape, segment.start, np.int64),
        newest=state.newest.astype(np.int64),
    )


def advance(segment: InterpolatedSegment, cursor: Cursor, events: EventArray, noise: Noise) -> None:
    """Take the cursor over events of the segment, in place."""
    _advance_interpolated(segment, cursor, events["t"], events["x"], events["y"], events["p"], noise)


def read(segment: InterpolatedSegment, cursor: Cursor, t: int, noise: Noise) -> tuple[Array, Array]:
    """L and P at ``t`` (us), which must not lie before an event the cursor has taken. Changes nothing."""
    out = apart(2, cursor.variance.shape, np.float64)
    (_read_printed if noise.printed else _read_exact)(segment, cursor, t, *out)
    return out[0], out[1]


@nb.njit(cache=True, inline="always")
def _exposure(segment):  # type: ignore[no-untyped-def]
    """Start and length of the exposure, us; of one that has ended when the segment begins, the us before."""
    length = segment.exposure_end - segment.start
    return (segment.start, length) if length > 0 else (segment.start - 1, 1)


@nb.njit(cache=True, inline="always")
def _exposure_fraction(exposure, t):  # type: ignore[no-untyped-def]
    """The weight of L^{A+} in equation (13): 0 at the start of the exposure, 1 from its end."""
    start, length = exposure
    return min((t - start) / length, 1.0)


@nb.njit(cache=True, inline="always")
def _blend(forward, backward, fraction):  # type: ignore[no-untyped-def]
    return (1.0 - fraction) * forward + fraction * backward


@nb.njit(cache=True, inline="always")
def _blended(segment, forward, backward, t):  # type: ignore[no-untyped-def]
    """L^A(t) of equation (13)."""
    return _blend(forward, backward, _exposure_fraction(_exposure(segment), t))


@nb.njit(cache=True, inline="always")
def _covariance_fraction(segment, t, after):  # type: ignore[no-untyped-def]
    """How far ``t`` is between the two middles; ``after`` picks the interval that follows tau^k."""
    if after:
        return (t - segment.middle) / (segment.next_middle - segment.middle)
    return (t - segment.previous_middle) / (segment.middle - segment.previous_middle)


@nb.njit(cache=True, inline="always")
def _covariance(segment, row, column, t, after):  # type: ignore[no-untyped-def]
    """R(t), equations (7) and (9)."""
    fraction = _covariance_fraction(segment, t, after)
    if after:
        return interpolated_covariance(
            segment.covariance_from[row, column], segment.covariance_after[row, column], fraction
        )
    return interpolated_covariance(
        segment.covariance_before[row, column], segment.covariance_at[row, column], fraction
    )


@loop(error_model="python")
def _predict_printed(segment, cursor, row, column, t):  # type: ignore[no-untyped-def]
    """L and P by (17) and (20) as printed."""
    since = cursor.since[row, column]
    forward, backward = cursor.forward[row, column], cursor.backward[row, column]
    information = 1.0 / cursor.variance[row, column]
    covariance = _covariance(segment, row, column, t, t >= segment.middle)
    predicted = predicted_information(information, 1.0 / covariance, (t - since) * MICROSECOND)
    deviation = cursor.log_intensity[row, column] - _blended(segment, forward, backward, since)
    predicted_value = predicted_deviation(deviation, information, predicted)
    return predicted_value + _blended(segment, forward, backward, t), 1.0 / predicted


@loop(error_model="python")
def _predict_exact(segment, cursor, row, column, t):  # type: ignore[no-untyped-def]
    """L and P by the exact solution, over stretches in which L^A and R are linear."""
    now = cursor.since[row, column]
    forward, backward = cursor.forward[row, column], cursor.backward[row, column]
    information = 1.0 / cursor.variance[row, column]
    augmented = _blended(segment, forward, backward, now)
    # J D
    weighted = (cursor.log_intensity[row, column] - augmented) * information
    for k in range(3):
        until = t
        if k == 0:
            until = min(t, segment.middle)
        elif k == 1:
            until = min(t, segment.exposure_end)
        if until <= now:
            continue
        seconds = (until - now) * MICROSECOND
        single, double = linear_covariance_integrals(
            _covariance(segment, row, column, now, now >= segment.middle),
            _covariance(segment, row, column, until, now >= segment.middle),
            seconds,
        )
        end_value = _blended(segment, forward, backward, until)
        weighted -= (end_value - augmented) / seconds * (information * seconds + double)
        information += single
        augmented = end_value
        now = until
    return weighted / information + augmented, 1.0 / information


@loop
def _advance_interpolated(segment, cursor, t, x, y, p, noise):  # type: ignore[no-untyped-def]
    for i in range(len(t)):
        row, column, now = y[i], x[i], t[i]
        if noise.printed:
            value, variance = _predict_printed(segment, cursor, row, column, now)
        else:
            value, variance = _predict_exact(segment, cursor, row, column, now)
        q = event_noise(
            noise.sigma_proc2,
            noise.sigma_iso2,
            noise.sigma_ref2,
            noise.refractory_bound,
            (now - cursor.newest[row, column]) * MICROSECOND,
            (now - newest_around(cursor.newest, row, column)) * MICROSECOND,
        )
        step = segment.step_on if p[i] else -segment.step_off
        cursor.log_intensity[row, column] = value + step  # (15)
        cursor.variance[row, column] = variance + q  # (21)
        cursor.forward[row, column] += segment.scale_before[row, column] * step  # (10)
        cursor.backward[row, column] += segment.scale_after[row, column] * step  # (11)
        cursor.since[row, column] = now
        cursor.newest[row, column] = now


@loop
def _read_printed(segment, cursor, t, log_intensity, variance):  # type: ignore[no-untyped-def]
    """`_predict_printed` of all pixels, a row at a time and few arrays a loop: vector code."""
    height, width = variance.shape
    fraction, deviation, rate, seconds = empty((4, width), np.float64)
    after, exposure = t >= segment.middle, _exposure(segment)
    now, share = _exposure_fraction(exposure, t), _covariance_fraction(segment, t, after)
    for row in range(height):
        first = segment.covariance_from[row] if after else segment.covariance_before[row]
        second = segment.covariance_after[row] if after else segment.covariance_at[row]
        since, value, known = cursor.since[row], cursor.log_intensity[row], cursor.variance[row]
        forward, backward = cursor.forward[row], cursor.backward[row]
        out, spread = log_intensity[row], variance[row]
        for i in range(np.uint64(width)):
            fraction[i] = _exposure_fraction(exposure, since[i])
        for i in range(np.uint64(width)):
            seconds[i] = (t - since[i]) * MICROSECOND
        for i in range(np.uint64(width)):
            deviation[i] = value[i] - _blend(forward[i], backward[i], fraction[i])
        for i in range(np.uint64(width)):
            rate[i] = 1.0 / interpolated_covariance(first[i], second[i], share)
        for i in range(np.uint64(width)):
            information = 1.0 / known[i]
            predicted = predicted_information(information, rate[i], seconds[i])
            deviation[i] = predicted_deviation(deviation[i], information, predicted)
            spread[i] = 1.0 / predicted
        for i in range(np.uint64(width)):
            out[i] = deviation[i] + _blend(forward[i], backward[i], now)


@loop
def _read_exact(segment, cursor, t, log_intensity, variance):  # type: ignore[no-untyped-def]
    height, width = variance.shape
    for row in range(height):
        for column in range(width):
            value = _predict_exact(segment, cursor, row, column, t)
            log_intensity[row, column], variance[row, column] = value
