"""The asynchronous Kalman filter, equations (14)-(21): one pixel, one event at a time, solved exactly in between.

With J = 1/P and D = L - L^A, the filter between events is

    dJ/dt = 1/R                          (19)
    dD/dt = -D / (J R) - (dL^A/dt - d)   (16), d the part of the motion of L^A that the state shares

whose exact solution is J(t) = J_i + int 1/R and J(t) D(t) = J_i D_i - int (dL^A/dt - d) J: an
information-weighted mean of everything seen. Two forms of it are here. `bridged` is kalux's own: the state takes
the same calibrated steps and the same slope as L^A (d = dL^A/dt), and R changes only at events, so that J D stands
still. `interpolated` is the paper's: nominal steps, d = 0, R linear in time (7), either exact or as printed in (17)
and (20), which is exact only while neither L^A nor R moves.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.bridge import BridgedSegment
from kalux.augmentation.interpolation import InterpolatedSegment
from kalux.events import EventArray
from kalux.filters.common import MICROSECOND, newest_around
from kalux.models.events import event_noise, signal_probability, threshold_noise

Array = NDArray[np.float64]
Times = NDArray[np.int64]


class State(NamedTuple):
    """The filter at one moment: (H, W) log intensity, its variance P, and the newest event of each pixel (us)."""

    log_intensity: Array
    variance: Array
    newest: Times


# Equations, each once.


@nb.njit(cache=True, inline="always")
def predicted_information(information, rate, seconds):  # type: ignore[no-untyped-def]
    """1/P of equation (20), with a constant 1/R = ``rate``."""
    return information + rate * seconds


@nb.njit(cache=True, inline="always")
def predicted_deviation(deviation, information, predicted):  # type: ignore[no-untyped-def]
    """L - L^A of equation (17): J D stands still."""
    return deviation * (information / predicted)


@nb.njit(cache=True, inline="always")
def added_noise(information, noise):  # type: ignore[no-untyped-def]
    """Equation (21), P + Q, in terms of J = 1/P."""
    return information / (1.0 + noise * information)


@nb.njit(cache=True, inline="always")
def measurement_rate(rate, forward_variance, backward_variance):  # type: ignore[no-untyped-def]
    """1/R of a bridged L^A (docs/equations.md, K4): rate (1/forward + 1/backward), in one division."""
    return rate * (forward_variance + backward_variance) / (forward_variance * backward_variance)


@nb.njit(cache=True, inline="always")
def interpolated_covariance(first, second, fraction):  # type: ignore[no-untyped-def]
    """Equation (7)."""
    return (1.0 - fraction) * first + fraction * second


@nb.njit(cache=True, inline="always")
def linear_covariance_integrals(first, second, seconds):  # type: ignore[no-untyped-def]
    """int 1/R and int int 1/R over a stretch of ``seconds`` in which R moves linearly.

    With x = (second - first) / first these are seconds/first log(1+x)/x and
    seconds^2/first ((1+x) log(1+x) - x)/x^2; near x = 0 their series.
    """
    x = (second - first) / first
    if abs(x) < 1e-4:
        single, double = 1.0 - x / 2.0 + x * x / 3.0, 0.5 - x / 6.0 + x * x / 12.0
    else:
        log = np.log1p(x)
        single, double = log / x, ((1.0 + x) * log - x) / (x * x)
    return seconds / first * single, seconds * seconds / first * double


# The bridged form.


class BridgedCursor(NamedTuple):
    """Working arrays of the bridged form, (H, W); changed in place by `advance_bridged`."""

    information: Array
    deviation: Array
    augmented: Array
    forward_variance: Array
    backward_variance: Array
    since: Times
    newest: Times


class BridgedNoise(NamedTuple):
    """Scalars of the event noise: Hz per pixel, units of c^2, and c^2 itself."""

    noise_rate: float
    step_variance: float
    threshold2: float


def begin_bridged(segment: BridgedSegment, state: State) -> BridgedCursor:
    """The cursor at the start of a segment: L stays, L^A is the segment's."""
    return BridgedCursor(
        information=1.0 / state.variance,
        deviation=state.log_intensity - segment.augmented,
        augmented=segment.augmented.copy(),
        forward_variance=segment.forward_variance.copy(),
        backward_variance=segment.backward_variance.copy(),
        since=np.full(state.newest.shape, segment.start, np.int64),
        newest=state.newest.copy(),
    )


def advance_bridged(
    segment: BridgedSegment, cursor: BridgedCursor, events: EventArray, noise: BridgedNoise
) -> None:
    """Take the cursor over events of the segment, in place."""
    _advance_bridged(segment, cursor, events["t"], events["x"], events["y"], events["p"], noise)


def read_bridged(segment: BridgedSegment, cursor: BridgedCursor, t: int) -> tuple[Array, Array]:
    """L and P at ``t`` (us), which must not lie before an event the cursor has taken. Changes nothing."""
    log_intensity, variance = np.empty_like(cursor.information), np.empty_like(cursor.information)
    _read_bridged(segment, cursor, t, log_intensity, variance)
    if t == segment.end:
        np.maximum(log_intensity, segment.end_bound, out=log_intensity)  # K7
    return log_intensity, variance


@nb.njit(cache=True, nogil=True)
def _advance_bridged(segment, cursor, t, x, y, p, noise):  # type: ignore[no-untyped-def]
    for i in range(len(t)):
        row, column, now = y[i], x[i], t[i]
        seconds = (now - cursor.since[row, column]) * MICROSECOND
        rate = measurement_rate(
            segment.rate, cursor.forward_variance[row, column], cursor.backward_variance[row, column]
        )
        before = cursor.information[row, column]
        information = predicted_information(before, rate, seconds)
        deviation = predicted_deviation(cursor.deviation[row, column], before, information)
        age = (now - newest_around(cursor.newest, row, column)) * MICROSECOND
        signal = signal_probability(noise.noise_rate, age)
        step = segment.step_on[row, column] if p[i] else -segment.step_off[row, column]
        # The state moves by the expected step, L^A by the whole one: the frames have told which it was.
        cursor.deviation[row, column] = deviation - (1.0 - signal) * step
        cursor.information[row, column] = added_noise(
            information, threshold_noise(noise.step_variance, noise.threshold2, signal)
        )
        cursor.augmented[row, column] += segment.slope[row, column] * seconds + step
        cursor.forward_variance[row, column] += segment.step_variance
        # Subtraction may leave a rounding error where the last event has been taken.
        cursor.backward_variance[row, column] = max(
            cursor.backward_variance[row, column] - segment.step_variance, 1e-9
        )
        cursor.since[row, column] = now
        cursor.newest[row, column] = now


@nb.njit(cache=True, nogil=True)
def _read_bridged(segment, cursor, t, log_intensity, variance):  # type: ignore[no-untyped-def]
    height, width = variance.shape
    for row in range(height):
        for column in range(width):
            seconds = (t - cursor.since[row, column]) * MICROSECOND
            rate = measurement_rate(
                segment.rate, cursor.forward_variance[row, column], cursor.backward_variance[row, column]
            )
            before = cursor.information[row, column]
            information = predicted_information(before, rate, seconds)
            log_intensity[row, column] = (
                cursor.augmented[row, column]
                + segment.slope[row, column] * seconds
                + predicted_deviation(cursor.deviation[row, column], before, information)
            )
            variance[row, column] = 1.0 / information


# The paper's form.


class InterpolatedCursor(NamedTuple):
    """Working arrays of the paper's form, (H, W); changed in place by `advance_interpolated`."""

    log_intensity: Array
    variance: Array
    forward: Array
    backward: Array
    since: Times
    newest: Times


class PaperNoise(NamedTuple):
    """Parameters of equation (2), s and 1/s, and whether (17) and (20) are taken as printed."""

    sigma_proc2: float
    sigma_iso2: float
    sigma_ref2: float
    refractory_bound: float
    printed: bool


def begin_interpolated(segment: InterpolatedSegment, state: State) -> InterpolatedCursor:
    """The cursor at the start of a segment."""
    return InterpolatedCursor(
        log_intensity=state.log_intensity.copy(),
        variance=state.variance.copy(),
        forward=segment.forward.copy(),
        backward=segment.backward.copy(),
        since=np.full(state.newest.shape, segment.start, np.int64),
        newest=state.newest.copy(),
    )


def advance_interpolated(
    segment: InterpolatedSegment, cursor: InterpolatedCursor, events: EventArray, noise: PaperNoise
) -> None:
    """Take the cursor over events of the segment, in place."""
    _advance_interpolated(segment, cursor, events["t"], events["x"], events["y"], events["p"], noise)


def read_interpolated(
    segment: InterpolatedSegment, cursor: InterpolatedCursor, t: int, noise: PaperNoise
) -> tuple[Array, Array]:
    """L and P at ``t`` (us), which must not lie before an event the cursor has taken. Changes nothing."""
    out = np.empty_like(cursor.variance), np.empty_like(cursor.variance)
    _read_interpolated(segment, cursor, t, noise.printed, *out)
    return out


@nb.njit(cache=True, inline="always")
def _exposure_fraction(segment, t):  # type: ignore[no-untyped-def]
    """The weight of L^{A+} in equation (13): 0 at the start of the exposure, 1 from its end."""
    if t >= segment.exposure_end:
        return 1.0
    return (t - segment.start) / (segment.exposure_end - segment.start)


@nb.njit(cache=True, inline="always")
def _blended(segment, forward, backward, t):  # type: ignore[no-untyped-def]
    """L^A(t) of equation (13)."""
    fraction = _exposure_fraction(segment, t)
    return (1.0 - fraction) * forward + fraction * backward


@nb.njit(cache=True, inline="always")
def _covariance(segment, row, column, t, after):  # type: ignore[no-untyped-def]
    """R(t), equations (7) and (9); ``after`` picks the interval that follows tau^k."""
    if after:
        fraction = (t - segment.middle) / (segment.next_middle - segment.middle)
        return interpolated_covariance(
            segment.covariance_from[row, column], segment.covariance_after[row, column], fraction
        )
    fraction = (t - segment.previous_middle) / (segment.middle - segment.previous_middle)
    return interpolated_covariance(
        segment.covariance_before[row, column], segment.covariance_at[row, column], fraction
    )


@nb.njit(cache=True)
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


@nb.njit(cache=True)
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


@nb.njit(cache=True, nogil=True)
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


@nb.njit(cache=True, nogil=True)
def _read_interpolated(segment, cursor, t, printed, log_intensity, variance):  # type: ignore[no-untyped-def]
    height, width = variance.shape
    for row in range(height):
        for column in range(width):
            if printed:
                value = _predict_printed(segment, cursor, row, column, t)
            else:
                value = _predict_exact(segment, cursor, row, column, t)
            log_intensity[row, column], variance[row, column] = value
