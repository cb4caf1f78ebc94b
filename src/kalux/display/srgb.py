"""The sRGB transfer function, and colours on a display that has it."""

from __future__ import annotations

import numpy as np

from kalux.display.intensities import Float32


def encode_srgb(linear: Float32) -> Float32:
    """The sRGB transfer function (IEC 61966-2-1) of values 0 to 1."""
    curved = 1.055 * np.power(linear, np.float32(1 / 2.4)) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curved).astype(np.float32)


def decode_srgb(encoded: Float32) -> Float32:
    """The inverse of `encode_srgb`."""
    curved = np.power((encoded + np.float32(0.055)) / np.float32(1.055), np.float32(2.4))
    return np.where(encoded <= 0.04045, encoded / np.float32(12.92), curved).astype(np.float32)


def in_colour(colour: Float32, y: Float32, grey: Float32) -> Float32:
    """The picture that has the luminance of ``grey`` on an sRGB display, and the chromaticity of ``colour``.

    Where a channel would exceed 1, all are drawn towards grey of that luminance, which at its brightest is white.
    """
    light = decode_srgb(grey)
    ratio = light / np.maximum(y, np.float32(1e-12))
    wanted = colour * ratio[..., None]
    # Black has no chromaticity, but may be mapped to something brighter.
    wanted = np.where((y > 1e-12)[..., None], wanted, light[..., None])
    excess = wanted.max(axis=-1) - light
    saturation = np.minimum(np.float32(1), (1 - light) / np.maximum(excess, np.float32(1e-12)))
    shown = light[..., None] + saturation[..., None] * (wanted - light[..., None])
    return encode_srgb(np.clip(shown, 0, 1))
