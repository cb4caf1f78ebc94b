"""The images of a video, one after the other: statistics that are smoothed over time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from kalux.display.intensities import Float32, Statistics, checked_image
from kalux.display.mapping import apply, statistics_of
from kalux.display.settings import DisplaySettings
from kalux.errors import InputError


class TimedImage(Protocol):
    """What `tone_map_next` needs of an image."""

    @property
    def t(self) -> int:
        """Time, us."""

    @property
    def intensity(self) -> Float32:
        """(height, width), linear, 1.0 = a saturated frame pixel."""


@dataclass(frozen=True, eq=False)
class ToneState:
    """What `tone_map_next` hands from one image to the next.

    Attributes
    ----------
    t
        Time of the image, us.
    statistics
        As of `measure`, smoothed over time.
    """

    t: int
    statistics: Statistics


def colour_of(image: object) -> Float32 | None:
    """The attribute ``colour`` of an image, (height, width, 3) linear RGB, or None where it has none."""
    colour: Float32 | None = getattr(image, "colour", None)
    return colour


def tone_map_next(
    image: TimedImage, settings: DisplaySettings | None = None, state: ToneState | None = None
) -> tuple[Float32, ToneState]:
    """Map the next image of a video, without flicker.

    The statistics are a moving average, s <- s + (1 - exp(-dt / smoothing)) (s_image - s), with dt the time
    since the previous image: of the logarithms of intensities, except for the limits of `Percentile`. An
    image no later than the state leaves it as it is.

    Parameters
    ----------
    image
        With ``t``, us, and ``intensity``, (height, width), linear; or with ``colour``, (height, width, 3), which is
        then shown.
    settings
        Default: ``DisplaySettings()``.
    state
        Of the previous image; None for the first, which is mapped by its own statistics.

    Returns
    -------
    mapped : ndarray
        (height, width) or (height, width, 3) float32, 0 to 1.
    state : ToneState
        For the next image.

    Raises
    ------
    InputError
        The intensity is not two-dimensional, is empty, or is not finite; or the state is of other settings.
    """
    settings = settings or DisplaySettings()
    intensity = checked_image(shown_of(image))
    following = _following(intensity, image.t, settings, state)
    return apply(intensity, settings, following.statistics, checked=True), following


def next_state(
    image: TimedImage,
    settings: DisplaySettings | None = None,
    state: ToneState | None = None,
    *,
    checked: bool = False,
) -> ToneState:
    """The part of `tone_map_next` that must go from image to image: its state. `apply` with its statistics is the rest.

    What is ``checked``, float32, finite and of a shape that can be shown, is not looked through again.

    Raises
    ------
    InputError
        As of `tone_map_next`.
    """
    shown = shown_of(image)
    return _following(
        shown if checked else checked_image(shown), image.t, settings or DisplaySettings(), state
    )


def _following(intensity: Float32, t: int, settings: DisplaySettings, state: ToneState | None) -> ToneState:
    statistics = statistics_of(intensity, settings.curve)
    if state is not None:
        statistics = _smoothed(state, statistics, t, settings.smoothing)
    return ToneState(int(t), statistics)


def _smoothed(state: ToneState, statistics: Statistics, t: int, smoothing: float) -> Statistics:
    if state.statistics.shape != statistics.shape:
        raise InputError("display: the state is of another curve; start a video without one")
    if smoothing == 0:
        return statistics
    seconds = max(0, int(t) - state.t) * 1e-6
    return state.statistics - math.expm1(-seconds / smoothing) * (statistics - state.statistics)


def shown_of(image: TimedImage) -> Float32:
    """What of an image is shown: its colour, or else its intensity."""
    colour = colour_of(image)
    return image.intensity if colour is None else colour
