"""One image: its statistics for a curve, and the picture by given ones."""

from __future__ import annotations

from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from kalux.display.auto import fill_auto, map_auto, quantise_auto
from kalux.display.clahe import map_clahe, measure_clahe
from kalux.display.integers import fill, to_uint8, to_uint16
from kalux.display.intensities import Float32, Statistics, bounded, checked_image, intensities_of, log_of
from kalux.display.operators import map_drago, map_linear, map_reinhard
from kalux.display.percentiles import percentiles, sampled
from kalux.display.settings import (
    BINS,
    Auto,
    Clahe,
    Curve,
    DisplaySettings,
    Drago,
    Linear,
    Percentile,
    Reinhard,
    encoding_of,
)
from kalux.display.srgb import encode_srgb, in_colour
from kalux.errors import InputError
from kalux.models.colour import luminance


def tone_map(intensity: NDArray[Any], settings: DisplaySettings | None = None) -> Float32:
    """Map one image by its own statistics.

    Parameters
    ----------
    intensity
        (height, width), or (height, width, 3) RGB, linear, 1.0 = a saturated frame pixel. Values below 0 count as 0,
        above 1e30 as 1e30.
    settings
        Default: ``DisplaySettings()``.

    Returns
    -------
    ndarray
        float32 of the same shape, 0 to 1.

    Raises
    ------
    InputError
        The intensity is of another shape, is empty, or is not finite.
    """
    settings = settings or DisplaySettings()
    checked = checked_image(intensity)
    return _apply(checked, settings, statistics_of(checked, settings.curve))


def measure(intensity: NDArray[Any], curve: Curve) -> Statistics:
    """The statistics of an image that a curve needs, as a float64 vector (empty for `Linear`).

    Images of more than 65536 pixels are sampled on a regular grid (all pixels for `Clahe`).

    Raises
    ------
    InputError
        The intensity is of another shape than `tone_map` takes, is empty, or is not finite.
    """
    return statistics_of(checked_image(intensity), curve)


def apply(
    intensity: NDArray[Any], settings: DisplaySettings, statistics: Statistics, *, checked: bool = False
) -> Float32:
    """Map an image by given statistics, for instance those of one image for a whole video.

    Parameters
    ----------
    intensity
        (height, width), or (height, width, 3) RGB, linear.
    settings
        Of which ``smoothing`` is not used.
    statistics
        From `measure` with the same curve.
    checked
        As of `next_state`.

    Returns
    -------
    ndarray
        float32 of the same shape, 0 to 1.

    Raises
    ------
    InputError
        The intensity is of another shape, is empty, or is not finite; or the statistics are of another curve.
    """
    return _apply(intensity if checked else checked_image(intensity), settings, statistics)


def fill_levels(
    intensity: Float32,
    settings: DisplaySettings,
    statistics: Statistics,
    levels: tuple[float, float],
    plane: NDArray[np.uint8],
) -> None:
    """Map an image as `apply` does, and fill a plane with the ``levels`` from 0 to 1, rounded.

    Parameters
    ----------
    intensity
        (height, width) float32, finite: it is not checked.
    settings, statistics
        As of `apply`.
    levels
        Of black and of white.
    plane
        (rows, columns), no smaller; where it is larger, the last row and column are repeated.
    """
    if _is_auto_alone(settings.curve, settings):
        _check_statistics(settings.curve, statistics)
        fill_auto(intensity, settings.curve, *intensities_of(statistics), levels, plane)
    else:
        fill(_apply(intensity, settings, statistics), levels[0], levels[1] - levels[0], plane)


def quantised(
    intensity: Float32, settings: DisplaySettings, statistics: Statistics, kind: type[np.uint8 | np.uint16]
) -> NDArray[Any]:
    """Map an image as `apply` does, as the whole numbers of `kalux.display.to_uint8` or `to_uint16`.

    Parameters
    ----------
    intensity
        (height, width) or (height, width, 3) float32, finite: it is not checked.
    settings, statistics
        As of `apply`.
    kind
        numpy.uint8 or numpy.uint16.
    """
    if intensity.ndim == 2 and _is_auto_alone(settings.curve, settings):
        _check_statistics(settings.curve, statistics)
        integers = np.empty(intensity.shape, kind)
        quantise_auto(intensity, settings.curve, *intensities_of(statistics), integers)
        return integers
    return (to_uint8 if kind is np.uint8 else to_uint16)(_apply(intensity, settings, statistics))


def _is_auto_alone(curve: Curve, settings: DisplaySettings) -> TypeGuard[Auto]:
    """Whether all that is done to intensities is the curve `Auto`, which goes straight to whole numbers."""
    return isinstance(curve, Auto) and encoding_of(settings) == "none"


def statistics_of(intensity: Float32, curve: Curve) -> Statistics:
    """`measure` of an image that is checked."""
    if isinstance(curve, Linear):
        return np.empty(0)
    if isinstance(curve, Auto) and intensity.ndim == 2:
        return log_of(percentiles(sampled(intensity), [50, curve.high]))
    values = bounded(intensity if isinstance(curve, Clahe) else sampled(intensity))
    if values.ndim == 3:
        values = luminance(values)
    match curve:
        case Percentile():
            return percentiles(values, [curve.low, curve.high])
        case Auto():
            return log_of(percentiles(values, [50, curve.high]))
        case Reinhard() | Drago():
            bright = log_of(percentiles(values, [curve.high]))
            return np.append(log_of(values).mean(), bright)
        case Clahe():
            return measure_clahe(values, curve)


def _apply(intensity: Float32, settings: DisplaySettings, statistics: Statistics) -> Float32:
    if intensity.ndim == 3:
        colour = bounded(intensity)
        y = luminance(colour)
        return in_colour(colour, y, _apply(y, settings, statistics))
    if isinstance(settings.curve, Auto):  # limits its values itself
        return _encoded(_curved(intensity, settings.curve, statistics), settings)
    mapped = _curved(bounded(intensity), settings.curve, statistics)
    return _encoded(np.clip(mapped, 0, 1, out=mapped), settings)


def _curved(intensity: Float32, curve: Curve, statistics: Statistics) -> Float32:
    _check_statistics(curve, statistics)
    match curve:
        case Linear():
            return map_linear(intensity, curve.black, curve.white)
        case Percentile():
            return map_linear(intensity, float(statistics[0]), float(statistics[1]))
        case Auto():
            return map_auto(intensity, curve, *intensities_of(statistics))
        case Reinhard():
            average, bright = intensities_of(statistics)
            return map_reinhard(intensity, curve.key, average, curve.white or bright)
        case Drago():
            return map_drago(intensity, curve.bias, *intensities_of(statistics))
        case Clahe():
            return map_clahe(intensity, curve, statistics)


def _check_statistics(curve: Curve, statistics: Statistics) -> None:
    expected = {Linear: 0, Clahe: 2 + getattr(curve, "tiles", 0) ** 2 * (BINS + 1)}.get(type(curve), 2)
    if statistics.shape != (expected,):
        raise InputError("display: the statistics are of another curve than that of the settings")


def _encoded(mapped: Float32, settings: DisplaySettings) -> Float32:
    encoding = encoding_of(settings)
    if encoding == "srgb":
        return encode_srgb(mapped)
    if encoding == "gamma":
        return np.power(mapped, np.float32(1 / settings.gamma))
    return mapped
