"""By how much more the steps of events vary in the dark, where pixels are slow (docs/equations.md, K20)."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.compiled import ONE, ZERO, exponential, larger, logarithm, loop, smaller
from kalux.errors import SettingsError
from kalux.models.stated import stated_numbers
from kalux.settings import AUTO, NO_DARK_STEPS

BRIGHT: Final = 0.32
"""Intensity, white = 1, from which nothing is dark: events have the variance of `EventSettings.step_variance`."""

PARTS: Final = 6
"""Octaves below `BRIGHT` that are told apart: the last one is of all that is darker than 0.01, two to three levels of 8
bits, where frames tell little."""

_MOST: Final = 100.0
"""Largest variance that can be stated, c^2: as of `EventSettings.step_variance`."""

_LOG_BRIGHT: Final = float(np.log(BRIGHT))
_PER_OCTAVE: Final = 1.0 / float(np.log(2.0))
_LEAST: Final = 1e-6  # intensity, white = 1: far below the darkest octave, and has a logarithm

DarkSteps = tuple[float, ...]
"""Variance of an event's step beyond `EventSettings.step_variance`, c^2, in the middles of the octaves below `BRIGHT`,
from the brightest on."""


def dark_steps(text: str) -> DarkSteps | None:
    """The variances from a setting, numbers with spaces between; None: ``"auto"``, ``"none"``, or all of them 0.

    Raises
    ------
    SettingsError
        If it is none of these.
    """
    if text in (AUTO, NO_DARK_STEPS):
        return None
    steps = stated_numbers(text, PARTS, _MOST)
    if steps is None:
        raise SettingsError(
            f"dark_steps: {text!r} is neither {AUTO}, {NO_DARK_STEPS} nor {PARTS} numbers from 0 to {_MOST:g}"
        )
    return steps if any(steps) else None


def octave(intensity: NDArray[Any]) -> NDArray[np.int64]:
    """The octave of an intensity, white = 1: -1 where it is not dark, up to `PARTS` - 1."""
    below = (_LOG_BRIGHT - np.log(np.maximum(intensity, _LEAST))) * _PER_OCTAVE
    octaves: NDArray[np.int64] = np.clip(np.floor(below), -1, PARTS - 1).astype(np.int64)
    return octaves


def dark_step_variance(
    first: NDArray[Any], second: NDArray[Any], steps: DarkSteps, log_offset: float, threshold2: float
) -> NDArray[np.float32]:
    """Variance that an event of each pixel has in addition, log intensity^2, between two frames.

    Linear in log I between the middles of octaves, 0 half an octave above the brightest of these, and the same below
    the darkest. I is the mean of both frames, as where it is measured (`kalux.calibration.dark_steps`); a clipped pixel
    counts as its bound, so that what goes beyond white has nothing.

    Parameters
    ----------
    first, second
        (H, W) log(I + I_0) of the frames before and after.
    steps
        From `dark_steps`.
    log_offset
        I_0.
    threshold2
        c^2.
    """
    variance = np.empty(first.shape, np.float32)
    # What each octave has more than the one above it, of which that above `BRIGHT` has nothing.
    rises = tuple(np.diff(np.array([0.0, *steps], np.float32) * np.float32(threshold2)))
    planes = (np.ascontiguousarray(plane, np.float32).reshape(-1) for plane in (first, second))
    _fill(*planes, rises, np.float32(log_offset), variance.reshape(-1))
    return variance


@loop
def _fill(first, second, rises, log_offset, variance):  # type: ignore[no-untyped-def]
    # A sum over the octaves, since looking two of them up takes seven times as long.
    half, bright, per_octave = np.float32(0.5), np.float32(_LOG_BRIGHT), np.float32(_PER_OCTAVE)
    for i in range(np.uint64(len(variance))):
        mean = half * (exponential(first[i]) + exponential(second[i])) - log_offset
        below = (bright - logarithm(larger(mean, np.float32(_LEAST)))) * per_octave + half
        total = ZERO
        for k in range(PARTS):
            total += rises[k] * smaller(larger(below - np.float32(k), ZERO), ONE)
        variance[i] = total
