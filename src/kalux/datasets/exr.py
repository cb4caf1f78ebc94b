"""OpenEXR files that others made, as images."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.wording import one_line

Image = NDArray[np.float32]

_MAGIC: Final = b"\x76\x2f\x31\x01"


def is_exr(data: bytes) -> bool:
    """Whether this is how an OpenEXR file begins."""
    return data.startswith(_MAGIC)


def exr_channels(path: Path, data: bytes) -> dict[str, Image]:
    """Channels of an OpenEXR file by name, (H, W) each; not those of fewer pixels, as chroma has.

    Scan lines or tiles, half or float, any compression; the largest of several resolutions, the first of several parts.

    Raises
    ------
    FormatError
        If it is no OpenEXR image, damaged, or deep; ``path`` is named.
    """
    if not is_exr(data):
        raise FormatError(f"{path}: not an OpenEXR image")
    import OpenEXR

    try:
        with OpenEXR.File(io.BytesIO(data), separate_channels=True) as file:
            deep = file.header()["type"] in (OpenEXR.deepscanline, OpenEXR.deeptile)
            found = {name: channel.pixels for name, channel in file.channels().items()}
    except Exception as error:  # OpenEXR raises whatever its C++ does
        raise FormatError(
            f"{path}: damaged or cut off ({one_line(error)}); copy or download it again"
        ) from error
    if deep:
        raise FormatError(
            f"{path}: a deep image, with values at several depths in a pixel; save it flattened"
        )
    size = max((pixels.shape for pixels in found.values()), default=None)
    return {n: np.asarray(pixels, np.float32) for n, pixels in found.items() if pixels.shape == size}


def exr_image(path: Path, channels: Mapping[str, Image]) -> Image:
    """(H, W, 3) of the channels R, G, B, or (H, W) of Y or L, of luminance and chroma (Y, RY, BY) the luminance.

    Raises
    ------
    FormatError
        If there are none of these in full size; ``path`` is named.
    """
    if {"R", "G", "B"} <= channels.keys():
        return np.stack([channels[name] for name in "RGB"], axis=-1)
    for name in ("Y", "L"):
        if name in channels:
            return channels[name]
    raise FormatError(
        f"{path}: has the channels {', '.join(sorted(channels))[:80] or 'none'}; R, G and B, or Y is needed"
    )
