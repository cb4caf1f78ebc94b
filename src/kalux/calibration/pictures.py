"""Pictures to check a registration and an offset by eye, drawn with OpenCV."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.offset import Correlation
from kalux.events import EventArray
from kalux.frames import Frame

_PLOT: Final = (520, 900)  # rows, columns
_INK: Final = (40, 40, 40)
_LINE: Final = (190, 110, 30)
_MARK: Final = (40, 40, 220)


def overlay(frame: Frame, events: EventArray, *, scale: int = 2) -> NDArray[Any]:
    """A registered frame with events on it, (H, W, 3) uint8, BGR: on red, off blue; dim where the frame says nothing.

    ``events`` are those of a few ms around the middle of the exposure: they should lie on the frame's moving edges.
    """
    values = np.clip(frame.normalised(), 0, 1) ** (1 / 2.2)
    grey = values if values.ndim == 2 else values.mean(axis=2)
    if frame.valid is not None:
        grey = np.where(frame.valid, grey, 0.35 * grey)
    picture = np.repeat((grey * 255).astype(np.uint8)[:, :, None], 3, axis=2)
    picture = np.repeat(np.repeat(picture, scale, axis=0), scale, axis=1)
    for p, colour in ((True, (60, 60, 255)), (False, (255, 140, 40))):
        chosen = events[events["p"] == p]
        y, x = chosen["y"].astype(int) * scale, chosen["x"].astype(int) * scale
        picture[y, x] = colour
        picture[y, x + scale - 1] = colour
    return picture


def correlation_plot(found: Correlation, *, offset: float, standard_error: float) -> NDArray[Any]:
    """The correlation over the offset, all of it and around the peak: (H, W, 3) uint8, BGR."""
    height, width = _PLOT
    picture = np.full((height, width, 3), 255, np.uint8)
    half = width // 2
    text = f"offset {offset * 1e-3:.2f} ms +- {standard_error * 1e-3:.2f} ms (add to the frames' times)"
    _write(picture, text, 16, 28, 0.6)
    ratio = "no other peak" if np.isinf(found.ratio) else f"{found.ratio:.2f} times the next peak"
    kind = "registered cells, signed" if found.per_pixel else "activity of the whole image"
    _write(picture, f"correlation {found.peak:.2f}, {ratio}; {kind}", 16, 54, 0.5)
    x: NDArray[np.float64] = found.grid.astype(np.float64) * 1e-3
    near = np.abs(x - found.offset * 1e-3) <= 80
    for left, xs, ys, title in (
        (0, x, found.curve, "whole range, ms"),
        (half, x[near], found.curve[near], "around the peak, ms"),
    ):
        _axes(picture, (left + 60, 80, half - 90, height - 150), xs, ys, offset * 1e-3, title)
    return picture


def _write(picture: NDArray[Any], text: str, x: int, y: int, size: float) -> None:
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, _INK, 1, cv2.LINE_AA)


def _axes(
    picture: NDArray[Any],
    box: tuple[int, int, int, int],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    mark: float,
    title: str,
) -> None:
    """Draw y over x, and a ``mark`` on x, into a box of the picture: left, top, width, height, pixels."""
    left, top, width, height = box
    low, high = min(float(y.min()), 0.0), max(float(y.max()), 0.1) * 1.05
    span = max(float(x[-1] - x[0]), 1e-9)

    def place(a: Any, b: Any) -> NDArray[np.int32]:
        u = left + (np.asarray(a, float) - x[0]) / span * width
        v = top + height - (np.asarray(b, float) - low) / (high - low) * height
        return np.stack([u, v], axis=-1).round().astype(np.int32)

    cv2.rectangle(picture, (left, top), (left + width, top + height), (210, 210, 210), 1)
    if x[0] <= mark <= x[-1]:
        ends = place([mark, mark], [low, high])
        cv2.line(picture, tuple(map(int, ends[0])), tuple(map(int, ends[1])), _MARK, 1, cv2.LINE_AA)
    cv2.polylines(picture, [place(x, y).reshape(-1, 1, 2)], False, _LINE, 1, cv2.LINE_AA)
    for a in np.linspace(x[0], x[-1], 5):
        u, _ = place(a, low)
        label = f"{a:.0f}"
        (wide, _), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)
        cv2.line(picture, (int(u), top + height), (int(u), top + height + 4), _INK, 1)
        _write(picture, label, int(u) - wide // 2, top + height + 18, 0.42)
    for b in np.linspace(low, high, 5):
        _, v = place(x[0], b)
        _write(picture, f"{b:.2f}", left - 48, int(v) + 4, 0.42)
    _write(picture, title, left + width // 2 - 60, top + height + 44, 0.5)
