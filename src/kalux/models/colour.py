"""Colour: luminance, Bayer mosaics, demosaicing, and the chromaticity that frames carry. See docs/colour.md.

Colours are linear RGB, (height, width, 3), in the order red, green, blue; 1.0 = a saturated frame pixel.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.compiled import empty, loop
from kalux.errors import SettingsError
from kalux.frames import Mosaic

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Gains = tuple[float, float, float]

LUMINANCE: Final = (0.2126, 0.7152, 0.0722)
"""Weights of linear red, green and blue in the luminance, ITU-R BT.709 (also sRGB)."""

AS_RECORDED: Final = "as-recorded"
GREY_WORLD: Final = "grey-world"

EDGE: Final = 0.01
"""Squared log-intensity difference below which `demosaic` follows no edge: that of estimates' noise, 0.1. 1e-4 to 1e-2
measure alike without noise, and 1e-2 is best with it (docs/colour.md)."""

DOUBT: Final = 3.0
"""How soon an uncertain highlight loses its colour: least errors of stained glass are at 2 to 6 (docs/colour.md)."""

RELIABLE: Final = 0.9
"""Response up to which colours count in full; from there to saturation less and less."""

CLIPPED_SHARE: Final = 0.2
"""A clipped channel with a smaller share of the luminance (the blue of a sky) is an error of that share where it is
twice as bright as it can show: as little as a few events are off."""

_NEUTRAL: Final = 1e-3
"""Weight of neutral grey among the frames' chromaticities: it decides only where no frame has one."""


def luminance(colour: NDArray[Any]) -> NDArray[Any]:
    """Y of linear RGB (..., 3)."""
    red, green, blue = (np.asarray(w, colour.dtype) for w in LUMINANCE)
    y: NDArray[Any] = red * colour[..., 0] + green * colour[..., 1] + blue * colour[..., 2]
    return y


def white_balance(text: str) -> Gains | None:
    """Gains of red, green and blue from a setting: ``"as-recorded"`` or ``"1.8;1;1.4"``; None for ``"grey-world"``.

    Gains are scaled so that they leave the luminance of white as it is.

    Raises
    ------
    SettingsError
        If it is none of these.
    """
    if text == AS_RECORDED:
        return (1.0, 1.0, 1.0)
    if text == GREY_WORLD:
        return None
    try:
        gains = np.array([float(part) for part in text.split(";")])
    except ValueError:
        gains = np.empty(0)
    if gains.shape != (3,) or not np.isfinite(gains).all() or not (gains > 0).all():
        raise SettingsError(
            f"white_balance: {text!r} is neither {AS_RECORDED}, {GREY_WORLD} nor three positive gains of red, green "
            "and blue, e.g. 1.8;1;1.4"
        )
    return scaled_gains(gains)


def scaled_gains(gains: NDArray[Any]) -> Gains:
    """Positive gains, scaled so that the luminance of white stays 1."""
    red, green, blue = (float(g) for g in gains / (gains @ np.array(LUMINANCE)))
    return red, green, blue


# Mosaics


def channels(mosaic: Mosaic, shape: tuple[int, int]) -> NDArray[np.intp]:
    """Which colour every pixel sees, (H, W): 0 red, 1 green, 2 blue."""
    found = np.empty(shape, np.intp)
    for place, letter in enumerate(mosaic):
        found[place // 2 :: 2, place % 2 :: 2] = "RGB".index(letter)
    return found


def sample_mosaic(colour: NDArray[Any], mosaic: Mosaic) -> NDArray[Any]:
    """Every pixel's own channel of an RGB image (H, W, 3): (H, W).

    Of a mosaic that was demosaiced this is the mosaic itself, as usual methods leave measured values as they are.
    """
    chosen = channels(mosaic, (colour.shape[0], colour.shape[1]))
    return np.ascontiguousarray(np.take_along_axis(colour, chosen[..., None], axis=2)[..., 0])


def demosaic(
    intensity: Float32, mosaic: Mosaic, log_offset: float, gains: Gains = (1.0, 1.0, 1.0)
) -> Float32:
    """RGB of a mosaic of linear intensities without an upper end.

    Hamilton and Adams (US patent 5,629,734, 1997) with soft decisions, on log(I + I_0): green first, along rows and
    columns in proportion to how little they change, with the second difference of the pixel's own channel; then red and
    blue from the mean of log ratios to green around. In the logarithm an edge of 1:100 is no other than one of 1:2, and
    ratios keep their hue across it, where in linear values bright sides spill over (docs/colour.md).

    Parameters
    ----------
    intensity
        (H, W), both at least 2; never negative.
    mosaic
        Its pattern.
    log_offset
        I_0.
    gains
        White balance: factors of red, green and blue.

    Returns
    -------
    numpy.ndarray
        (H, W, 3) float32. Every pixel's own channel is its intensity times the gain.
    """
    scale = np.array(gains, np.float32)
    chosen = channels(mosaic, (intensity.shape[0], intensity.shape[1]))
    balanced = intensity * scale[chosen]
    out = np.empty((*intensity.shape, 3), np.float32)
    state = np.log(balanced + np.float32(log_offset))
    _demosaic(_mirrored(state, 3), chosen[:2, :2].copy(), np.float32(EDGE), out)
    np.exp(out, out=out)
    out -= np.float32(log_offset)
    np.maximum(out, np.float32(0), out=out)
    np.put_along_axis(out, chosen[..., None], balanced[..., None], axis=2)
    return out


def _mirrored(image: Float32, width: int) -> Float32:
    """With a border mirrored at the outermost pixels, which keeps the phase of a mosaic."""
    return np.pad(image, width, mode="reflect")


@loop(error_model="python")
def _demosaic(padded, pattern, edge, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` from the log mosaic with a border of 3; ``pattern`` is the 2x2 of `channels`."""
    height, width = out.shape[0], out.shape[1]
    half, quarter = np.float32(0.5), np.float32(0.25)
    green = empty((height + 2, width + 2), np.float32)
    for i in range(height + 2):
        for j in range(width + 2):
            r, c = i + 2, j + 2
            here = padded[r, c]
            if pattern[(i - 1) & 1, (j - 1) & 1] == 1:
                green[i, j] = here
                continue
            left, right, up, down = padded[r, c - 1], padded[r, c + 1], padded[r - 1, c], padded[r + 1, c]
            bend_h = here + here - padded[r, c - 2] - padded[r, c + 2]
            bend_v = here + here - padded[r - 2, c] - padded[r + 2, c]
            change_h = abs(left - right) + abs(bend_h)
            change_v = abs(up - down) + abs(bend_v)
            weight_h = change_v * change_v + edge
            weight_v = change_h * change_h + edge
            value_h = half * (left + right) + quarter * bend_h
            value_v = half * (up + down) + quarter * bend_v
            green[i, j] = (weight_h * value_h + weight_v * value_v) / (weight_h + weight_v)
    for y in range(height):
        for x in range(width):
            own = pattern[y & 1, x & 1]
            g = green[y + 1, x + 1]
            out[y, x, 1] = g
            if own != 1:
                out[y, x, own] = padded[y + 3, x + 3]
                total = np.float32(0)
                for dy in (-1, 1):
                    for dx in (-1, 1):
                        total += padded[y + 3 + dy, x + 3 + dx] - green[y + 1 + dy, x + 1 + dx]
                out[y, x, 2 - own] = g + quarter * total
                continue
            along = padded[y + 3, x + 2] - green[y + 1, x] + padded[y + 3, x + 4] - green[y + 1, x + 2]
            across = padded[y + 2, x + 3] - green[y, x + 1] + padded[y + 4, x + 3] - green[y + 2, x + 1]
            beside = pattern[y & 1, (x + 1) & 1]
            out[y, x, beside] = g + half * along
            out[y, x, 2 - beside] = g + half * across


def calm_highlights(
    colour: Float32, variance: Float32, gains: Gains = (1.0, 1.0, 1.0), white: float = 1.0
) -> Float32:
    """Draw the colour of highlights towards neutral where it is not known.

    Beyond white each channel of a Bayer sensor is its own extrapolation by events, and an error of one is a colour; at
    white, where all are clipped, the white balance is. Where a channel, before its gain, is as bright as white, the
    ratios to the luminance are raised to the power 1 / (1 + `DOUBT` P), and less so from `RELIABLE` of white on. The
    luminance stays. P is small where frames or events of a time below white tell the channel.

    Parameters
    ----------
    colour
        (H, W, 3) linear, white balanced.
    variance
        (H, W) P of the log intensity.
    gains
        The white balance that ``colour`` has.
    white
        Level of a saturated pixel, in units of ``colour``.
    """
    out = colour.copy()
    _calm(out, variance, np.array(gains, np.float32) * np.float32(white))
    return out


@loop(error_model="python")
def _calm(colour, variance, whites):  # type: ignore[no-untyped-def]
    """``whites``: levels of the channels' saturated pixels."""
    for y in range(colour.shape[0]):
        for x in range(colour.shape[1]):
            red, green, blue = colour[y, x, 0], colour[y, x, 1], colour[y, x, 2]
            brightest = max(red / whites[0], green / whites[1], blue / whites[2])
            if brightest <= RELIABLE:
                continue
            share = min((brightest - RELIABLE) / (1.0 - RELIABLE), 1.0)
            power = 1.0 / (1.0 + share * DOUBT * variance[y, x])
            least = 1e-6 * max(red, green, blue)
            red_, green_, blue_ = (
                max(red, least) ** power,
                max(green, least) ** power,
                max(blue, least) ** power,
            )
            before = LUMINANCE[0] * red + LUMINANCE[1] * green + LUMINANCE[2] * blue
            after = LUMINANCE[0] * red_ + LUMINANCE[1] * green_ + LUMINANCE[2] * blue_
            colour[y, x, 0] = red_ * before / after
            colour[y, x, 1] = green_ * before / after
            colour[y, x, 2] = blue_ * before / after


# Frames in colour over events without


def chromaticity(colour: Array, epsilon: float) -> Float32:
    """(RGB + epsilon) / (Y + epsilon), (H, W, 3): 1 for grey, and towards it in the dark; epsilon is the noise."""
    lit = np.maximum(colour, 0) + epsilon
    ratio: Float32 = (lit / luminance(lit)[..., None]).astype(np.float32)
    return ratio


def joined_chromaticity(parts: list[tuple[float, Float32, Float32]]) -> Float32:
    """The mean of frames' chromaticities, neutral where none is reliable: (H, W, 3), its luminance 1.

    Parameters
    ----------
    parts
        Weight of the frame, its chromaticity (H, W, 3), and how reliable each pixel's is (H, W), 0 to 1.
    """
    total = np.full(parts[0][2].shape, _NEUTRAL, np.float32)
    mean = np.full(parts[0][1].shape, _NEUTRAL, np.float32)
    for weight, chroma, reliable in parts:
        share = np.float32(weight) * reliable
        total += share
        mean += share[..., None] * chroma
    mean /= total[..., None]
    return mean
