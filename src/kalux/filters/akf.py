"""The asynchronous Kalman filter, equations (14)-(21): one pixel, one event at a time, solved exactly in between.

With J = 1/P and D = L - L^A, the filter between events is

    dJ/dt = 1/R                          (19)
    dD/dt = -D / (J R) - (dL^A/dt - d)   (16), d the part of the motion of L^A that the state shares

whose exact solution is J(t) = J_i + int 1/R and J(t) D(t) = J_i D_i - int (dL^A/dt - d) J: an
information-weighted mean of everything seen. There are two forms. `akf_bridged` is kalux's own: the state takes
the same calibrated steps and the same slope as L^A (d = dL^A/dt), and R changes only at events, so that J D stands
still. `akf_interpolated` is the paper's: nominal steps, d = 0, R linear in time (7), either exact or as printed in (17)
and (20), which is exact only while neither L^A nor R moves.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.compiled import ONE


class State(NamedTuple):
    """The filter at one moment: (H, W) log intensity, its variance P, and the newest event of each pixel.

    float32 and a `Clock` whose origin is that moment in the bridged form; float64 and (H, W) int64 us in the paper's.
    """

    log_intensity: NDArray[np.floating[Any]]
    variance: NDArray[np.floating[Any]]
    newest: NDArray[np.signedinteger[Any]]


# Equations, each once.


@nb.njit(cache=True, inline="always")
def predicted_information(information, rate, seconds):  # type: ignore[no-untyped-def]
    """1/P of equation (20), with a constant 1/R = ``rate``."""
    return information + rate * seconds


@nb.njit(cache=True, inline="always")
def information_kept(information, noise):  # type: ignore[no-untyped-def]
    """Equation (21), P + Q, as the factor by which it lessens J = 1/P; J D is lessened by the same."""
    return ONE / (ONE + noise * information)


@nb.njit(cache=True, inline="always")
def predicted_deviation(deviation, information, predicted):  # type: ignore[no-untyped-def]
    """L - L^A of equation (17): J D stands still."""
    return deviation * (information / predicted)


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
