"""Event noise, equations (1)-(2) of the paper, and kalux's own in units of the contrast threshold.

Scalar functions, compiled by numba: the filter loops call them once per event. Times are in seconds here. They work
in the type of their arguments; a plain 1.0 would make float64 of float32.
"""

from __future__ import annotations

from typing import Any, Final

import numba as nb
import numpy as np

_ONE: Final = np.float32(1.0)
_NEIGHBOURHOOD: Final = np.float32(9.0)


@nb.njit(cache=True, inline="always")
def process_noise(sigma_proc2: float, since_pixel: float) -> float:
    """Q^proc (section 3.1.1): grows with the time since the last event of the same pixel.

    Parameters are sigma_proc^2 (1/s) and t^i - t^{i-1} (s); the result is a variance of log intensity.
    """
    return sigma_proc2 * since_pixel


@nb.njit(cache=True, inline="always")
def isolated_noise(sigma_iso2: float, since_neighbour: float) -> float:
    """Q^iso (section 3.1.1): grows with the time since the newest event in the neighbourhood.

    Parameters are sigma_iso^2 (1/s) and t^i - t*_N(p) (s); the result is a variance of log intensity.
    """
    return sigma_iso2 * since_neighbour


@nb.njit(cache=True, inline="always")
def refractory_noise(sigma_ref2: float, since_pixel: float, bound: float) -> float:
    """Q^ref (section 3.1.1): constant when the pixel's previous event is at most ``bound`` (s) old."""
    return 0.0 if since_pixel > bound else sigma_ref2


@nb.njit(cache=True, inline="always")
def event_noise(
    sigma_proc2: float,
    sigma_iso2: float,
    sigma_ref2: float,
    bound: float,
    since_pixel: float,
    since_neighbour: float,
) -> float:
    """Q of one event, equation (2): the sum of its three contributions, a variance of log intensity."""
    return (
        process_noise(sigma_proc2, since_pixel)
        + isolated_noise(sigma_iso2, since_neighbour)
        + refractory_noise(sigma_ref2, since_pixel, bound)
    )


@nb.njit(cache=True, inline="always")
def signal_probability(noise_rate: Any, since_any: Any) -> Any:
    """Probability that an event is signal, given the age of the newest event in its 3x3 pixels.

    Not in the paper (docs/equations.md, K5). Nine pixels together emit noise at 9 x ``noise_rate`` (Hz per
    pixel), at any time; the ages of signal fall off with the square of ``since_any`` (s). The odds of noise are
    the square of the number of noise events that are expected in that time.
    """
    expected = _NEIGHBOURHOOD * noise_rate * since_any
    return _ONE / (_ONE + expected * expected)


@nb.njit(cache=True, inline="always")
def threshold_noise(step_variance: Any, threshold2: Any, signal: Any) -> Any:
    """Q of one event in kalux's own model: what is not known of its step.

    ``step_variance`` is the variance of a real event's step in units of the squared threshold
    ``threshold2``; an event that is signal with probability ``signal`` adds the variance of a Bernoulli step.
    """
    return threshold2 * (step_variance + signal * (_ONE - signal))
