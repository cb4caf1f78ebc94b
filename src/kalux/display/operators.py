"""The curves that are one formula: a straight line, and those of Reinhard and of Drago."""

from __future__ import annotations

import math

import numpy as np

from kalux.display.intensities import SMALLEST, Float32


def map_linear(intensity: Float32, black: float, white: float) -> Float32:
    """A straight line from ``black`` to ``white``."""
    # An image of one value has no range: it is shown black, not as its amplified rounding errors.
    width = max(white - black, 1e-6 * abs(white), 1e-30)
    stretched = np.clip(intensity, np.float32(black), np.float32(max(white, black)))
    return ((stretched - np.float32(black)) / np.float32(width)).astype(np.float32)


def map_reinhard(intensity: Float32, key: float, average: float, white: float) -> Float32:
    """L_d = L (1 + L / L_white^2) / (1 + L), equation (4), of L = a L_w / average, equation (2)."""
    scale = key / max(average, SMALLEST)
    white = max(white * scale, 1e-3)
    scaled = np.minimum(intensity, np.float32(white / scale)) * np.float32(scale)
    mapped = scaled * (1 + scaled / np.float32(white) / np.float32(white)) / (1 + scaled)
    return mapped.astype(np.float32, copy=False)


def map_drago(intensity: Float32, bias: float, average: float, bright: float) -> Float32:
    """L_d = log(L + 1) / (log10(L_max + 1) log(2 + 8 (L / L_max)^(log b / log 0.5))), equation (4).

    With L the intensity over its log average. L_max is bounded: beyond exp(1 / (0.38 log b / log 0.5)) the
    equation as printed is no longer monotone, the denominator grows faster than the logarithm.
    """
    exponent = math.log(bias) / math.log(0.5)
    average = max(average, SMALLEST)
    bound = math.expm1(1 / (0.38 * exponent))
    largest = min(max(bright / average, 1e-3), bound)
    relative = np.minimum(intensity, np.float32(average * largest)) / np.float32(average)
    ratio = relative / np.float32(largest)
    below = np.log(2 + 8 * np.power(ratio, np.float32(exponent)))
    mapped = np.log1p(relative) / below / np.float32(math.log10(largest + 1))
    return np.asarray(mapped, np.float32)
