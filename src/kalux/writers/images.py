"""One image as the bytes of a file: PNG, EXR, NPY.

What depends on the images before is done at once, the rest, most of the work, whenever there is a thread for it.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Literal

import numpy as np

from kalux.display import DisplaySettings, ToneState, colour_of, next_state, quantised, shown_of
from kalux.writers.base import ImageLike
from kalux.writers.exr import exr_file
from kalux.writers.png import png_bytes

Bytes = Callable[[], bytes]
"""Makes a file; in any thread, and in any order."""

Encode = Callable[[ImageLike, ToneState | None], tuple[Bytes, ToneState | None]]
"""An image and the state of the display before it, to what makes the file, and the state after it."""


def encode_png(display: DisplaySettings, bits: Literal[8, 16]) -> Encode:
    """PNGs of the display-mapped intensity or colour, 0 to 1 as 0 to 65535 (or 255), rounded to nearest."""
    kind = np.uint16 if bits == 16 else np.uint8

    def encode(image: ImageLike, state: ToneState | None) -> tuple[Bytes, ToneState | None]:
        following = next_state(image, display, state, checked=True)
        shown = shown_of(image)
        return lambda: png_bytes(quantised(shown, display, following.statistics, kind)), following

    return encode


def encode_exr(image: ImageLike, state: ToneState | None) -> tuple[Bytes, ToneState | None]:
    """See `exr_bytes`."""
    return lambda: exr_bytes(image), state


def encode_npy(image: ImageLike, state: ToneState | None) -> tuple[Bytes, ToneState | None]:
    """See `npy_bytes`."""
    return lambda: npy_bytes(image), state


def exr_bytes(image: ImageLike) -> bytes:
    """OpenEXR, 32-bit float, ZIP: the intensity as Y, or the colour as R, G, B; ``variance``; attribute ``t_us``."""
    colour = colour_of(image)
    values = (
        {"Y": image.intensity} if colour is None else dict(zip("RGB", np.moveaxis(colour, 2, 0), strict=True))
    )
    return exr_file({**values, "variance": image.variance}, {"t_us": str(int(image.t))})


def npy_bytes(image: ImageLike) -> bytes:
    """NumPy's format, float32 (2, height, width): intensity, variance; or (4, ...): red, green, blue, variance."""
    colour = colour_of(image)
    values = [image.intensity] if colour is None else list(np.moveaxis(colour, 2, 0))
    file = io.BytesIO()
    np.save(file, np.stack([*values, image.variance]), allow_pickle=False)
    return file.getvalue()
