"""How sensitive the eye is: to luminance, which sets the response of cones and rods, and to contrast."""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from kalux.evaluation.hdr_vdp import constants as c

Array = NDArray[np.float64]

LOG_LUMINANCE: Final = (-5.0, 5.0)
"""Range of the tables of this module, log10 of cd/m2."""

_RESPONSE_SAMPLES: Final = 2048
_CSF_SAMPLES: Final = 256


class ResponseTables(NamedTuple):
    """Response, in just noticeable differences, at equal steps of log10 luminance over `LOG_LUMINANCE`."""

    cones: Array
    rods: Array


def modulation_transfer(frequency: Array) -> Array:
    """Share of a grating's contrast that the eye's optics let through."""
    total = np.zeros(np.shape(frequency))
    for amplitude, decay in zip(c.MTF_AMPLITUDE, c.MTF_DECAY, strict=True):
        total += amplitude * np.exp(-decay * frequency)
    return total


def joint_sensitivity(luminance: Array) -> Array:
    """Sensitivity of cones and rods together."""
    peak, drop, slope, exponent = c.JOINT_SENSITIVITY
    return peak * ((drop / luminance) ** slope + 1) ** -exponent


def rod_sensitivity(luminance: Array) -> Array:
    """Sensitivity of the rods alone."""
    log_ratio = np.log10(luminance / c.ROD_PEAK)
    bright = log_ratio > 0
    scale = np.where(bright, c.ROD_ABOVE[0], c.ROD_BELOW[0])
    exponent = np.where(bright, c.ROD_ABOVE[1], c.ROD_BELOW[1])
    return np.exp(-(np.abs(log_ratio) ** exponent) / scale) * 10**c.ROD_LOG_GAIN


def responses_from_sensitivity(log_luminance: Array, sensitivity: Array) -> Array:
    """Integral of dL / threshold over luminance, with L / threshold the sensitivity."""
    return np.asarray(cumulative_trapezoid(sensitivity * np.log(10), log_luminance, initial=0))


@lru_cache(maxsize=1)
def response_tables() -> ResponseTables:
    """Response of one class of cones (L and M are alike) and of the rods."""
    luminance = np.logspace(*LOG_LUMINANCE, _RESPONSE_SAMPLES)
    rods = rod_sensitivity(luminance)
    both_classes = np.maximum(joint_sensitivity(luminance) - rods, 1e-3)
    cones = 0.5 * np.interp(np.minimum(2 * luminance, luminance[-1]), luminance, both_classes)
    gain = 10**c.SENSITIVITY_CORRECTION
    log_luminance = np.log10(luminance)
    return ResponseTables(
        responses_from_sensitivity(log_luminance, cones) * gain,
        responses_from_sensitivity(log_luminance, rods) * gain,
    )


def contrast_sensitivity(frequency: float, log_luminance: Array) -> Array:
    """Neural sensitivity to a grating: the measured one without the loss in the eye's optics.

    Parameters
    ----------
    frequency
        Cycles per degree; a sensitivity of 0 at 0.
    log_luminance
        Log10 of the adapting luminance.
    """
    if frequency <= 1e-4:
        return np.zeros_like(log_luminance)
    lookup = np.log10(c.CSF_LUMINANCE)
    p1, p2, p3, peak = (np.interp(log_luminance, lookup, column) for column in np.transpose(c.CSF_PARAMETERS))
    low_fall = (1 - np.exp(-((frequency / 7) ** 2))) ** p3
    measured = peak / np.sqrt((1 + (p1 * frequency) ** p2) / low_fall)
    return np.asarray(measured / modulation_transfer(np.asarray(frequency)))


@lru_cache(maxsize=64)
def contrast_sensitivity_table(frequency: float) -> Array:
    """`contrast_sensitivity` at equal steps of log10 luminance over `LOG_LUMINANCE`."""
    return contrast_sensitivity(frequency, np.linspace(*LOG_LUMINANCE, _CSF_SAMPLES))
