"""One image as the bytes of a file: PNG, EXR, NPY."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any, Literal

import cv2
import numpy as np
import OpenEXR
from numpy.typing import NDArray

from kalux.display import DisplaySettings, ToneState, colour_of, to_uint8, to_uint16, tone_map_next
from kalux.writers.base import ImageLike

Encode = Callable[[ImageLike, ToneState | None], tuple[bytes, ToneState | None]]
"""An image and the state of the display before it, to the file and the state after it."""


def encode_png(display: DisplaySettings, bits: Literal[8, 16]) -> Encode:
    """PNGs of the display-mapped intensity or colour, 0 to 1 as 0 to 65535 (or 255), rounded to nearest."""
    quantise: Callable[[NDArray[Any]], NDArray[Any]] = to_uint16 if bits == 16 else to_uint8

    def encode(image: ImageLike, state: ToneState | None) -> tuple[bytes, ToneState | None]:
        mapped, following = tone_map_next(image, display, state)
        return png_bytes(quantise(mapped)), following

    return encode


def encode_exr(image: ImageLike, state: ToneState | None) -> tuple[bytes, ToneState | None]:
    """OpenEXR, 32-bit float, ZIP: the intensity as Y, or the colour as R, G, B; ``variance``; attribute ``t_us``."""
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "t_us": str(int(image.t)),
    }
    colour = colour_of(image)
    values = (
        {"Y": image.intensity} if colour is None else dict(zip("RGB", np.moveaxis(colour, 2, 0), strict=True))
    )
    channels = {name: np.ascontiguousarray(v) for name, v in {**values, "variance": image.variance}.items()}
    file = io.BytesIO()
    OpenEXR.File(header, channels).write(file)
    return file.getvalue(), state


def encode_npy(image: ImageLike, state: ToneState | None) -> tuple[bytes, ToneState | None]:
    """NumPy's format, float32 (2, height, width): intensity, variance; or (4, ...): red, green, blue, variance."""
    colour = colour_of(image)
    values = [image.intensity] if colour is None else list(np.moveaxis(colour, 2, 0))
    file = io.BytesIO()
    np.save(file, np.stack([*values, image.variance]), allow_pickle=False)
    return file.getvalue(), state


def png_bytes(picture: NDArray[Any]) -> bytes:
    """A grey or RGB uint8 or uint16 picture as PNG."""
    if picture.ndim == 3:
        picture = np.ascontiguousarray(picture[..., ::-1])  # OpenCV's order
    # Without parameters OpenCV takes its fastest way. Asking for a level, even for 1, leaves that way and
    # takes two to three times as long, for files of about the same size.
    done, encoded = cv2.imencode(".png", picture)
    assert done, "OpenCV encodes every uint8 or uint16 picture"
    return encoded.tobytes()
