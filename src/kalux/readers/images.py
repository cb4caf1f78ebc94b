"""Image files of frames: whole, grey, 8 or 16 bits."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError

SUFFIXES: Final = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm"})
"""Of the files that count as images where nothing lists them."""

_PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"


def grey_image(
    path: Path, name: str, data: bytes, *, hint: str = "convert the images to grey"
) -> NDArray[Any]:
    """Decode an image file.

    Parameters
    ----------
    path, name
        The recording and the file in it, for messages.
    data
        The file.
    hint
        What to do about an image in colour.

    Returns
    -------
    numpy.ndarray
        (height, width), uint8 or uint16.

    Raises
    ------
    FormatError
        If it is damaged, no image, or in colour.
    """
    image = None
    if _is_whole(data):
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            image = None
    if image is None:
        raise FormatError(f"{path}: {name!r} is not an image, or damaged; copy or download it again")
    if image.ndim == 3:
        if not (image[..., :3] == image[..., :1]).all():
            raise FormatError(f"{path}: {name!r} is in colour, which kalux does not read yet; {hint}")
        image = np.ascontiguousarray(image[..., 0])
    return image


def _is_whole(data: bytes) -> bool:
    """Whether an image file has its end and its checksums are right.

    Checked before decoding, because decoders fill a truncated image with grey, or print to the terminal.
    """
    if data.startswith(_JPEG_START):
        return _JPEG_END in data[-64:]
    if not data.startswith(_PNG_SIGNATURE):
        return len(data) > 0
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        kind_and_content = data[position + 4 : position + 8 + length]
        checksum = data[position + 8 + length : position + 12 + length]
        if zlib.crc32(kind_and_content) != int.from_bytes(checksum, "big") or len(checksum) < 4:
            return False
        if kind_and_content.startswith(b"IEND"):
            return True
        position += 12 + length
    return False
