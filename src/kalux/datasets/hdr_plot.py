"""A picture of the response by which photographs were joined, to check it by eye."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.debevec import CLIPPED_HIGH, CLIPPED_LOW
from kalux.datasets.brackets import TAPER, Picture
from kalux.models.camera import Response

Array = NDArray[np.float64]

_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX


def response_plot(pictures: Iterable[Picture], response: Response) -> NDArray[np.uint8]:
    """The response over the logarithm of the exposure, with what every photograph says of it: (480, 640, 3) RGB.

    A dot is the median of a photograph's levels where the merged irradiance, per octave and a third, is alike.
    """
    height, width, left, bottom = 480, 640, 50, 40
    octaves = 12.0
    canvas = np.full((height, width, 3), 255, np.uint8)

    def place(irradiance: Array, level: Array) -> NDArray[np.int32]:
        x = left + (np.log2(np.maximum(irradiance, 1e-12)) + octaves) / octaves * (width - left - 15)
        y = height - bottom - level * (height - bottom - 15)
        return np.stack([x, y], axis=-1).round().astype(np.int32)

    for octave in range(13):
        x = int(place(np.array([2.0**-octave]), np.zeros(1))[0, 0])
        cv2.line(canvas, (x, 15), (x, height - bottom), (225, 225, 225), 1)
        cv2.putText(
            canvas, str(-octave), (x - 10, height - bottom + 16), _FONT, 0.4, (60, 60, 60), 1, cv2.LINE_AA
        )
    for value in (0, 64, 128, 192, 255):
        y = int(place(np.ones(1), np.array([value / 255]))[0, 1])
        cv2.line(canvas, (left, y), (width - 15, y), (225, 225, 225), 1)
        cv2.putText(canvas, str(value), (14, y + 4), _FONT, 0.4, (60, 60, 60), 1, cv2.LINE_AA)
    label = "log2 of the irradiance, 0 = white"
    cv2.putText(canvas, label, (200, height - 8), _FONT, 0.45, (60, 60, 60), 1, cv2.LINE_AA)
    irradiance = np.exp2(np.linspace(-octaves, 0, 600))
    for curve, colour, thickness in ((Response.srgb(), (170, 170, 170), 1), (response, (190, 60, 30), 2)):
        cv2.polylines(canvas, [place(irradiance, curve(irradiance))], False, colour, thickness, cv2.LINE_AA)
    cv2.putText(canvas, "response", (70, 40), _FONT, 0.5, (190, 60, 30), 1, cv2.LINE_AA)
    cv2.putText(canvas, "sRGB", (70, 60), _FONT, 0.5, (140, 140, 140), 1, cv2.LINE_AA)
    for observed, level in _observed(list(pictures), response):
        x, y = place(np.array(observed), np.array(level)).tolist()
        cv2.circle(canvas, (x, y), 3, (40, 90, 160), -1, cv2.LINE_AA)
    return canvas


def _observed(pictures: list[Picture], response: Response) -> Iterator[tuple[float, float]]:
    """Irradiance that a neighbour measures, and the median level of a photograph there."""
    for k, picture in enumerate(pictures):
        for other in pictures[max(k - 1, 0) : k] + pictures[k + 1 : k + 2]:
            level = other.response
            inside = (level > CLIPPED_LOW + TAPER) & (level < CLIPPED_HIGH - TAPER)
            irradiance = other.irradiance(response)[inside] * (picture.exposure / other.exposure)
            bins = np.floor(3 * np.log2(np.maximum(irradiance, 1e-12))).astype(np.int64)
            for number in np.unique(bins):
                members = bins == number
                if number < 0 and np.count_nonzero(members) >= 50:
                    seen = picture.response[inside][members]
                    yield float(np.median(irradiance[members])), float(np.median(seen))
