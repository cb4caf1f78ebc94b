"""The pictures of the report: intensities through one tone curve, errors and uncertainties in one colour scale."""

from __future__ import annotations

import base64
import struct
import zlib
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.display import DisplaySettings, Reinhard, apply, measure, to_uint8
from kalux.evaluation.scores import LOG_OFFSET
from kalux.writers import colour_map

MAP_LIMITS: Final = (0.01, 1.0)
"""Of errors and standard deviations of log(I + 0.02): a hundredth is hardly seen, 1 is a factor of e."""

_LEVELS: Final = 32
"""Shades of a map: enough to see, and the pictures stay small."""

_DISPLAY: Final = DisplaySettings(Reinhard())


def shown(images: dict[str, NDArray[Any]], reference: NDArray[Any]) -> dict[str, str]:
    """Pictures (H, W), all with the reference's tone curve, as data URIs; NaN is shown black."""
    statistics = measure(np.nan_to_num(reference).astype(np.float32), _DISPLAY.curve)
    pictures = {}
    for name, image in images.items():
        finite = np.nan_to_num(np.asarray(image, np.float32))
        pictures[name] = _data_uri(_grey_png(to_uint8(apply(finite, _DISPLAY, statistics))))
    return pictures


def error_map(test: NDArray[Any], reference: NDArray[Any]) -> str:
    """|log(test + 0.02) - log(reference + 0.02)| in colours; black where nothing is compared."""
    lit = np.maximum(np.asarray(test, np.float64), 0) + LOG_OFFSET
    error = np.abs(np.log(lit / (np.asarray(reference, np.float64) + LOG_OFFSET)))
    return coloured(np.nan_to_num(error))


def uncertainty_map(variance: NDArray[Any], test: NDArray[Any], log_offset: float) -> str:
    """Standard deviation of log(I + 0.02), from the variance of log(I + I_0) to first order, in the same colours."""
    lit = np.maximum(np.asarray(test, np.float64), 0)
    sigma = np.sqrt(np.asarray(variance, np.float64)) * (lit + log_offset) / (lit + LOG_OFFSET)
    return coloured(sigma)


def coloured(values: NDArray[Any]) -> str:
    """Values within `MAP_LIMITS` in a few shades of one colour map, light is large, as a data URI."""
    low, high = MAP_LIMITS
    place = np.log(np.clip(values, low, high) / low) / np.log(high / low)
    return _data_uri(indexed_png(np.rint(place * (_LEVELS - 1)).astype(np.uint8), _palette()))


def gradient() -> str:
    """The colours of `coloured`, low to high, as a CSS gradient."""
    return f"linear-gradient(to right,{','.join('#' + bytes(c).hex() for c in _palette())})"


def _palette() -> NDArray[np.uint8]:
    """(levels, 3) RGB."""
    colours: NDArray[np.uint8] = colour_map(np.geomspace(1, 2, _LEVELS)[None], (1, 2))[0]
    return colours


def indexed_png(indices: NDArray[np.uint8], palette: NDArray[np.uint8]) -> bytes:
    """A PNG of (H, W) indices into (n, 3) colours: a third of the bytes of the same picture in RGB.

    OpenCV writes no palettes. The format: PNG, W3C recommendation, sections 5 and 11.
    """
    height, width = indices.shape
    rows = np.pad(indices, ((0, 0), (1, 0)))  # every row begins with its filter: 0, none
    return b"".join(
        (
            b"\x89PNG\r\n\x1a\n",
            _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)),
            _chunk(b"PLTE", palette.tobytes()),
            _chunk(b"IDAT", zlib.compress(rows.tobytes(), 9)),
            _chunk(b"IEND", b""),
        )
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _grey_png(picture: NDArray[np.uint8]) -> bytes:
    done, encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert done, "OpenCV encodes every grey uint8 picture"
    return encoded.tobytes()


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()
