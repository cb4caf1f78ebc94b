"""The curve `Auto`: a shoulder for highlights, a power for dark images, and its way straight to levels of 8 bits."""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.compiled import FUSED, ONE, empty, exponential, logarithm, loop
from kalux.display.integers import fill_row, quantise
from kalux.display.intensities import LARGEST, SMALLEST, Float32
from kalux.display.settings import MID_GREY, Auto

_NO_SHOULDER: Final = 1.0 + 1e-3
"""An image whose bright end is no brighter needs none."""


def map_auto(intensity: Float32, curve: Auto, median: float, white: float) -> Float32:
    """Map intensities, which may have any finite value, by the curve `Auto` to 0 to 1.

    ``median`` and ``white`` are the image's statistics: its median and its bright end.
    """
    shown = np.empty(intensity.shape, np.float32)
    values = np.ascontiguousarray(intensity).reshape(-1)
    _show(values, *_tone(curve, median, white), shown.reshape(-1))
    return shown


def fill_auto(
    intensity: Float32,
    curve: Auto,
    median: float,
    white: float,
    levels: tuple[float, float],
    plane: NDArray[np.uint8],
) -> None:
    """`map_auto` and `kalux.display.fill` in one go, of levels as of `kalux.display.fill_levels`."""
    offset, factor = np.float32(levels[0] + 0.5), np.float32(levels[1] - levels[0])  # cut off after the point
    _show_levels(intensity, *_tone(curve, median, white), offset, factor, plane)


def quantise_auto(
    intensity: Float32, curve: Auto, median: float, white: float, integers: NDArray[Any]
) -> None:
    """`map_auto` and `kalux.display.to_uint8` or `to_uint16` in one go, as the integers are."""
    _show_integers(
        intensity, *_tone(curve, median, white), np.float32(np.iinfo(integers.dtype).max), integers
    )


def _tone(curve: Auto, median: float, white: float) -> tuple[_Shoulder, bool, np.float32]:
    """The shoulder, whether there is one, and the power."""
    shoulder = _shoulder(curve.knee, white)
    middle = max(float(_rolled(np.float32(median), shoulder)), SMALLEST)
    power = min(max(math.log(min(middle, 0.99)) / math.log(MID_GREY), 1.0), curve.lift)
    return shoulder, white > _NO_SHOULDER, np.float32(1 / power)


class _Shoulder(NamedTuple):
    """Where the shoulder begins, how far it goes, and a (``gain``) and ``scale`` of scale log(1 + a x), all float32."""

    knee: np.float32
    room: np.float32
    gain: np.float32
    scale: np.float32


def _shoulder(knee: float, white: float) -> _Shoulder:
    """The shoulder from ``knee`` to ``white``; of an image without highlights it begins beyond every intensity."""
    if white <= _NO_SHOULDER:
        return _Shoulder(np.float32(2 * LARGEST), np.float32(0), np.float32(0), np.float32(0))
    gain = _shoulder_gain(1 - knee, white - knee)
    scale = (1 - knee) / math.log1p(gain * (white - knee))
    return _Shoulder(np.float32(knee), np.float32(white - knee), np.float32(gain), np.float32(scale))


def _shoulder_gain(height: float, width: float) -> float:
    """The a > 0 with slope 1 at the knee: a height = log(1 + a width), for width > height > 0."""
    # Newton from the right of the root of a convex function: every step lands right of it.
    a = 4 * math.log(1 + width / height) / height + 1
    for _ in range(60):
        step = (a * height - math.log1p(a * width)) / (height - width / (1 + a * width))
        a -= step
        if abs(step) <= 1e-12 * a:
            break
    return a


@nb.njit(cache=True, inline="always")
def _rolled(intensity, shoulder):  # type: ignore[no-untyped-def]
    """The shoulder: the intensity up to the knee, then a logarithm up to 1."""
    knee, room, gain, scale = shoulder
    above = intensity - knee
    above = above if above > np.float32(0.0) else np.float32(0.0)
    above = above if above < room else room
    low = intensity if intensity < knee else knee
    return low + scale * logarithm(ONE + gain * above)


@loop(fastmath=FUSED)
def _show(values, shoulder, rolled, power, shown):  # type: ignore[no-untyped-def]
    """Shoulder and power, each where there is one, limited to 0 to 1."""
    zero, largest = np.float32(0.0), np.float32(LARGEST)
    for i in range(len(values)):
        value = values[i]
        value = value if value > zero else zero
        value = value if value < largest else largest
        value = _rolled(value, shoulder) if rolled else value
        shown[i] = value if value < ONE else ONE
    if power != ONE:
        for i in range(len(values)):
            value = shown[i]
            lifted = exponential(power * logarithm(value))
            lifted = lifted if lifted < ONE else ONE
            shown[i] = lifted if value > zero else zero


@loop(fastmath=FUSED)
def _show_levels(values, shoulder, rolled, power, offset, factor, plane):  # type: ignore[no-untyped-def]
    """`_show` and `fill_row`, a row at a time."""
    height, width = values.shape
    shown = empty((1, width), np.float32)
    for row in range(len(plane)):
        if row < height:
            _show(values[row], shoulder, rolled, power, shown[0])
        fill_row(shown[0], offset, factor, plane[row])


@loop(fastmath=FUSED)
def _show_integers(values, shoulder, rolled, power, top, integers):  # type: ignore[no-untyped-def]
    """`_show` and `quantise`, a row at a time."""
    shown = empty(values.shape[1], np.float32)
    for row in range(len(values)):
        _show(values[row], shoulder, rolled, power, shown)
        quantise(shown, top, integers[row])
