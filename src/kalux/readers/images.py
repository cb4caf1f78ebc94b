"""Image files of frames: whole, grey or in colour, 8 or 16 bits."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.readers.source import natural_order, reading

IMAGES: Final = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp"})
"""Suffixes of the files that count as images where nothing lists them."""

RADIANCE: Final = frozenset({".hdr", ".pic", ".exr"})
"""Of radiance images."""

_PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_RADIANCE_START: Final = b"#?"


T = TypeVar("T")


def images_in(folder: Path, suffixes: Collection[str] = IMAGES) -> list[Path]:
    """The images in a folder, in the order of the numbers in their names; not those that are hidden.

    Raises
    ------
    InputError
        If the folder cannot be read.
    """
    with reading(folder):
        found = [f for f in folder.iterdir() if f.suffix.lower() in suffixes and not f.name.startswith(".")]
    return sorted(found, key=natural_order)


def read_image(path: Path, name: str, data: bytes, *, colour: bool) -> NDArray[Any]:
    """Decode an image file.

    Parameters
    ----------
    path, name
        The recording and the file in it, for messages.
    data
        The file.
    colour
        Whether the frames are in colour; grey images that are stored in colour count as grey otherwise.

    Returns
    -------
    numpy.ndarray
        (height, width), or (height, width, 3), red, green, blue; uint8 or uint16.

    Raises
    ------
    FormatError
        If it is damaged, no image, or in colour where frames are grey.
    """
    image = _decoded(path, name, data)
    if colour:
        return np.ascontiguousarray(image[..., 2::-1]) if image.ndim == 3 else np.stack([image] * 3, axis=-1)
    if image.ndim == 3:
        if not _is_grey(image):
            raise FormatError(
                f"{path}: {name!r} is in colour, but the images before it are grey; convert all to one of both"
            )
        image = np.ascontiguousarray(image[..., 0])
    return image


def in_colour(path: Path, images: Sequence[T], load: Callable[[T], tuple[str, bytes]]) -> bool:
    """Whether any of the first, the middle and the last image is in colour: one alone may be black.

    ``load`` gives an image's name and file.

    Raises
    ------
    FormatError
        If one is damaged or no image.
    """
    places = {0, len(images) // 2, len(images) - 1} if images else set()
    samples = (load(images[place]) for place in sorted(places))
    return any(not _is_grey(_decoded(path, name, data)) for name, data in samples)


def load_image(place: Path, file: Path, *, colour: bool) -> NDArray[Any]:
    """As `read_image`, of a file; ``place`` is the recording, for messages."""
    return read_image(place, file.name, _bytes(file), colour=colour)


def files_in_colour(place: Path, files: Sequence[Path]) -> bool:
    """As `in_colour`, of files; ``place`` is the recording, for messages."""
    return in_colour(place, files, lambda file: (file.name, _bytes(file)))


def _bytes(file: Path) -> bytes:
    with reading(file):
        return file.read_bytes()


def _is_grey(image: NDArray[Any]) -> bool:
    return image.ndim == 2 or bool((image[..., :3] == image[..., :1]).all())


def _decoded(path: Path, name: str, data: bytes) -> NDArray[Any]:
    """The image as stored: (H, W), or (H, W, 3 or 4) in the order blue, green, red."""
    image = decoded(data)
    if image is None:
        raise FormatError(f"{path}: {name!r} is not an image, or damaged; copy or download it again")
    return image


def decoded(data: bytes, file: Path | None = None) -> NDArray[Any] | None:
    """An image as stored: (H, W), or (H, W, 3 or 4) in the order blue, green, red; None if it is none or damaged.

    With the ``file`` that has the data, OpenCV need not copy a Radiance image to ``/tmp``, which may be full. Of a name
    that is not UTF-8 it would crash.
    """
    if not _is_whole(data):
        return None
    try:
        if file is not None and data.startswith(_RADIANCE_START) and str(file).isprintable():
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        else:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image)


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
