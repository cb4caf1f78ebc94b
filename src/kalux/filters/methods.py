"""Choice of the method that settings name."""

from __future__ import annotations

from kalux.filters.bridged_frames import BridgedFrames
from kalux.filters.held_frames import HeldFrames
from kalux.filters.interpolated_frames import InterpolatedFrames
from kalux.filters.method import Method
from kalux.models.pixels import PixelCalibration
from kalux.settings import Settings


def make_method(
    settings: Settings, lookahead: bool, shape: tuple[int, int], pixels: PixelCalibration | None = None
) -> Method:
    """The method that the settings, which must have thresholds, name.

    ``pixels`` is the calibration of single pixels; only the bridge uses it.
    """
    if settings.filter.kind == "cf":
        return HeldFrames(settings, lookahead, shape)
    if settings.filter.augmentation == "bridge":
        return BridgedFrames(settings, lookahead, shape, pixels)
    return InterpolatedFrames(settings, lookahead, shape)
