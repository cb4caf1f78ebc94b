"""Pictures side by side with captions, and a colour map for the uncertainty."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.errors import InputError

UInt8 = NDArray[np.uint8]

STRIP = 28
GAP = 6
BACKGROUND = 24
FONT = cv2.FONT_HERSHEY_SIMPLEX
FONT_SCALE = 0.5
INK = (235, 235, 235)


class Panel(NamedTuple):
    """A picture of a contact sheet.

    Attributes
    ----------
    caption
        ASCII, shown above the picture, cut where it is too long.
    picture
        uint8, (height, width) grey or (height, width, 3) RGB.
    limits
        Of a picture by `colour_map`: a labelled colour bar is drawn beside the caption.
    """

    caption: str
    picture: UInt8
    limits: tuple[float, float] | None = None


def contact_sheet(
    panels: Sequence[Panel | tuple[str, UInt8]],
    *,
    columns: int | None = None,
    smallest_height: int = 300,
) -> UInt8:
    """Join pictures of equal size, row by row, with captions.

    Parameters
    ----------
    panels
        One or more.
    columns
        Pictures in a row. Default: all in one row.
    smallest_height
        Pictures lower than this are enlarged by a whole factor, pixels repeated.

    Returns
    -------
    ndarray
        uint8 (height, width, 3), RGB. The size depends on the number and the size of the pictures only, so
        sheets of a video fit each other.

    Raises
    ------
    InputError
        There are no panels, or a picture has another type or size than the first.
    """
    if not panels or (columns is not None and columns < 1):
        raise InputError("contact sheet: at least one panel and one column are needed")
    full = [Panel(*panel) for panel in panels]
    _check_pictures(full)
    height, width = full[0].picture.shape[:2]
    factor = max(1, math.ceil(smallest_height / height), math.ceil(200 / width))
    drawn = [_draw_panel(panel, factor) for panel in full]
    count = columns or len(drawn)
    blank = np.full_like(drawn[0], BACKGROUND)
    drawn += [blank] * (-len(drawn) % count)
    rows = [np.concatenate(drawn[i : i + count], axis=1) for i in range(0, len(drawn), count)]
    return np.concatenate(rows)


def variance_limits(variance: NDArray[Any]) -> tuple[float, float]:
    """Limits for `colour_map`: percentiles 1 and 99 of the finite, positive values.

    For a video or several panels, take them once: colours compare only under the same limits.
    """
    values = np.asarray(variance, np.float64)
    usable = values[np.isfinite(values) & (values > 0)]
    if usable.size == 0:
        return 1e-3, 1.0
    low, high = (float(v) for v in np.percentile(usable, [1, 99]))
    return low, max(high, low * 1.01)


def colour_map(variance: NDArray[Any], limits: tuple[float, float] | None = None) -> UInt8:
    """Show a variance in the colours of matplotlib's inferno, on a logarithmic scale.

    Parameters
    ----------
    variance
        (height, width), 0 or more; infinite is allowed and has the colour of the upper limit.
    limits
        Variances of the darkest and the brightest colour. Default: `variance_limits`.

    Returns
    -------
    ndarray
        uint8 (height, width, 3), RGB.

    Raises
    ------
    InputError
        A variance is NaN, or the limits are not positive and increasing.
    """
    if np.isnan(variance).any():
        raise InputError("colour map: the variance has NaN")
    low, high = limits or variance_limits(variance)
    if not 0 < low < high < math.inf:
        raise InputError(f"colour map: the limits are {low} and {high}; 0 < low < high is needed")
    clipped = np.clip(np.asarray(variance, np.float64), low, high)
    return _inferno(np.log(clipped / low) / math.log(high / low))


def _inferno(unit: NDArray[Any]) -> UInt8:
    levels = np.rint(255 * unit).astype(np.uint8)
    coloured = cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)
    return np.ascontiguousarray(coloured[..., ::-1], np.uint8)


def _check_pictures(panels: list[Panel]) -> None:
    size = panels[0].picture.shape[:2]
    for panel in panels:
        shape = panel.picture.shape
        grey_or_rgb = len(shape) == 2 or (len(shape) == 3 and shape[2] == 3)
        if panel.picture.dtype != np.uint8 or not grey_or_rgb or shape[:2] != size or panel.picture.size == 0:
            raise InputError(
                f"contact sheet: the picture {panel.caption!r} is {panel.picture.dtype} of shape {shape}; "
                f"uint8 of shape {size} or {(*size, 3)} is needed, as of the first"
            )


def _draw_panel(panel: Panel, factor: int) -> UInt8:
    picture = panel.picture if panel.picture.ndim == 3 else np.repeat(panel.picture[..., None], 3, axis=2)
    enlarged = picture.repeat(factor, axis=0).repeat(factor, axis=1)
    strip = np.full((STRIP, enlarged.shape[1], 3), BACKGROUND, np.uint8)
    room = strip.shape[1]
    if panel.limits is not None:
        room = _draw_bar(strip, panel.limits)
    _draw_text(strip, panel.caption, 2, room)
    return np.pad(np.concatenate([strip, enlarged]), ((0, GAP), (0, GAP), (0, 0)), constant_values=BACKGROUND)


def _draw_bar(strip: UInt8, limits: tuple[float, float]) -> int:
    """Draw the bar with its limits at the right end of a strip; returns where it begins."""
    low, high = (f"{value:.1g}" for value in limits)
    width = strip.shape[1]
    length = min(96, width // 5)
    end = width - _text_width(high) - 6
    begin = end - length
    ramp = _inferno(np.linspace(0, 1, length)[None, :])
    strip[9:19, begin:end] = ramp
    _draw_text(strip, high, end + 4, width)
    left: int = begin - _text_width(low) - 4
    _draw_text(strip, low, left, begin)
    return left - 8


def _draw_text(strip: UInt8, text: str, left: int, right: int) -> None:
    while text and left + _text_width(text) > right:
        text = text[:-1]
    cv2.putText(strip, text, (left, 19), FONT, FONT_SCALE, INK, 1, cv2.LINE_AA)


def _text_width(text: str) -> int:
    (width, _), _ = cv2.getTextSize(text, FONT, FONT_SCALE, 1)
    return int(width)
