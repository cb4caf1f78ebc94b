"""Calibration of single event pixels: their thresholds, and which of them are hot."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from kalux.errors import InputError
from kalux.settings import Settings

Array = NDArray[np.float64]

CALIBRATION_NEEDED: Final = "a kalux.Calibration is needed, from kalux.load_calibration"
"""Where what was measured of a sensor comes from, for messages."""


@runtime_checkable
class Measured(Protocol):
    """What was measured of a sensor, as a `kalux.Calibration` holds it."""

    def pixels_of(self, spread: float) -> PixelCalibration | None:
        """What is known of single pixels, whose thresholds differ by ``spread`` if not mapped; None: nothing."""

    def apply(self, settings: Settings) -> Settings:
        """The settings with what was measured in place of theirs."""


@dataclass(frozen=True, eq=False)
class PixelCalibration:
    """A calibration of single pixels, as `kalux.Reconstructor` takes it.

    Attributes
    ----------
    on, off
        (H, W) thresholds of every pixel in units of the nominal ones, positive.
    on_variance, off_variance
        (H, W) what is not known of them, in the same units squared.
    hot
        (H, W) bool: pixels whose events say nothing and are left out.

    Raises
    ------
    InputError
        If the maps differ in size, are not finite, factors are not positive, or ``hot`` is not bool.
    """

    on: Array
    off: Array
    on_variance: Array
    off_variance: Array
    hot: NDArray[np.bool_]

    def __post_init__(self) -> None:
        maps = {name: getattr(self, name) for name in ("on", "off", "on_variance", "off_variance", "hot")}
        for name, values in maps.items():
            if values.ndim != 2 or values.shape != self.on.shape:
                raise InputError(f"pixel calibration: {name} is {values.shape}, on is {self.on.shape}")
            if name == "hot" and values.dtype != np.bool_:
                raise InputError(f"pixel calibration: hot is {values.dtype}; True and False are needed")
            if not np.isfinite(values).all():
                raise InputError(f"pixel calibration: {name} is not finite")
            if (values < 0).any() or (name in ("on", "off") and (values == 0).any()):
                raise InputError(f"pixel calibration: {name} holds values that are not positive")

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        height, width = self.on.shape
        return height, width


def with_hot(
    pixels: PixelCalibration | None, hot: NDArray[np.bool_], spread: float
) -> PixelCalibration | None:
    """A calibration in which these pixels, (H, W), are hot, too; the same where none is.

    Where there was none, thresholds are the nominal ones, and pixels differ from them by the relative ``spread``.
    """
    if not hot.any():
        return pixels
    if pixels is not None:
        return dataclasses.replace(pixels, hot=pixels.hot | hot)
    factor, variance = np.ones(hot.shape), np.full(hot.shape, spread**2)
    return PixelCalibration(factor, factor, variance, variance, hot)


def require_size(pixels: PixelCalibration, sensor_size: tuple[int, int]) -> None:
    """Check that a calibration is of a sensor of this (height, width).

    Raises
    ------
    InputError
        If it is not.
    """
    if pixels.shape != sensor_size:
        (height, width), (rows, columns) = sensor_size, pixels.shape
        raise InputError(
            f"the calibration is of {columns}x{rows} pixels, the sensor has {width}x{height}; "
            "calibrate with a recording of the same sensor and region"
        )
