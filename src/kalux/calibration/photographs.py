"""Photographs: their pixels, and what their EXIF says of the exposure."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError, InputError, MissingDependencyError
from kalux.readers.source import reading


class Exposure(NamedTuple):
    """How a photograph was exposed.

    Attributes
    ----------
    seconds
        Exposure time.
    sensitivity
        ISO / 100; 1 where it is not stated.
    aperture
        f-number; 1 where it is not stated.
    """

    seconds: float
    sensitivity: float = 1.0
    aperture: float = 1.0

    @property
    def gain(self) -> float:
        """By what the level of a pixel depends on the same light and time."""
        return self.sensitivity / self.aperture**2


def read_exposure(path: Path) -> Exposure:
    """The exposure of a photograph from its EXIF.

    The exposure time in EXIF is what a camera's display shows, 1/30 or 1/125; shutters make powers of two, 1/32
    and 1/128, which is what the APEX value ``ShutterSpeedValue`` says. It is taken where the two agree within a
    quarter of a stop (docs/datasets.md has the measurement).

    Raises
    ------
    InputError
        If there is no exposure time.
    FormatError
        If the file is no image, or its EXIF data damaged.
    MissingDependencyError
        If Pillow is not installed.
    """
    try:
        from PIL import ExifTags
        from PIL import Image as Pillow
    except ImportError as error:
        raise MissingDependencyError(
            f"{path}: reading exposure times from EXIF needs Pillow; pip install 'kalux[hdr]', or give the times "
            "(--times)"
        ) from error
    try:
        with Pillow.open(path) as file:
            tags = file.getexif().get_ifd(ExifTags.IFD.Exif)
    except (OSError, SyntaxError) as error:  # Pillow's word for EXIF data without a TIFF header
        raise FormatError(f"{path}: not an image, or damaged; copy it again") from error
    seconds = _positive(tags.get(ExifTags.Base.ExposureTime))
    exact = _from_apex(tags.get(ExifTags.Base.ShutterSpeedValue))
    if seconds is None or (exact is not None and abs(np.log2(exact / seconds)) < 0.25):
        seconds = exact
    if seconds is None:
        raise InputError(f"{path}: no exposure time in its EXIF data; give the exposure times (--times)")
    iso = _positive(tags.get(ExifTags.Base.ISOSpeedRatings)) or 100.0
    aperture = _positive(tags.get(ExifTags.Base.FNumber)) or 1.0
    return Exposure(seconds, iso / 100, aperture)


def _from_apex(value: Any) -> float | None:
    try:
        return _positive(2.0 ** -float(value))
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None


def _positive(value: Any) -> float | None:
    if isinstance(value, tuple):
        value = value[0] if value else None
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) and number > 0 else None


def read_photograph(path: Path) -> NDArray[Any]:
    """The levels of an image of 8 or 16 bits: (H, W), or (H, W, 3) red, green, blue.

    Raises
    ------
    InputError
        If it cannot be read.
    FormatError
        If it is damaged, or has other levels.
    """
    # Not turned as EXIF says: a bracket is compared as the sensor saw it.
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    with reading(path):
        data = np.frombuffer(path.read_bytes(), np.uint8)
    image = cv2.imdecode(data, flags) if len(data) else None
    if image is None or image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3):
        raise FormatError(f"{path}: not an image of 8 or 16 bits, or damaged; copy it again")
    return np.asarray(image) if image.ndim == 2 else np.ascontiguousarray(image[..., 2::-1])


def parse_seconds(text: str) -> float:
    """An exposure time in seconds, as ``2``, ``0.125`` or ``1/8``.

    Raises
    ------
    ValueError
        If it is neither a number nor a fraction.
    """
    over, slash, under = text.partition("/")
    if slash and float(under) == 0:
        raise ValueError(f"{text} has no value")
    return float(over) / float(under) if slash else float(over)
