"""A scene's radiance: an HDR reference, and the files that hold one."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kalux.datasets.brackets import Picture
from kalux.datasets.exr import exr_channels, exr_image
from kalux.errors import FormatError, InputError
from kalux.models.camera import Response
from kalux.models.colour import LUMINANCE
from kalux.readers.images import decoded
from kalux.readers.numpy_files import DAMAGE
from kalux.readers.source import reading

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class HdrReference:
    """A scene's radiance.

    Attributes
    ----------
    radiance
        (H, W) or (H, W, 3) float32, linear; 1 = a saturated pixel at ``exposure``.
    valid
        (H, W) bool: where it was measured: not clipped in every exposure, and settled.
    exposure
        As in `Picture`.
    response
        Of the camera; None where the radiance came as it is.
    said
        What was found, a line each.
    pictures
        The photographs it was made of, aligned, with exposures as measured.
    """

    radiance: Image
    valid: Mask
    exposure: float
    response: Response | None
    said: tuple[str, ...] = ()
    pictures: tuple[Picture, ...] = ()

    @property
    def luminance(self) -> Image:
        """(H, W) float32: of colours, by BT.709."""
        return np.asarray(luminance_of(self.radiance), np.float32)


def luminance_of(image: NDArray[Any]) -> Array:
    """(H, W): of colours, by BT.709."""
    return np.asarray(image if image.ndim == 2 else image @ LUMINANCE, np.float64)


def read_radiance(path: Path) -> HdrReference:
    """A radiance image: ``.exr`` (R, G, B or Y; ``valid`` if there), ``.hdr``, or ``.npz`` (``radiance``, ``valid``).

    Raises
    ------
    InputError
        If the file cannot be read, or holds no radiance.
    """
    readers = {".exr": _read_exr, ".hdr": _read_hdr, ".npz": _read_npz}
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: an .exr, .hdr or .npz is needed")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    radiance, valid = readers[path.suffix.lower()](path)
    if radiance.ndim not in (2, 3) or min(radiance.shape[:2]) < 16:
        raise InputError(f"{path}: an image of {radiance.shape} is no radiance of a scene")
    if valid.shape != radiance.shape[:2]:
        raise FormatError(f"{path}: valid is {valid.shape}, the radiance {radiance.shape}")
    finite = np.isfinite(radiance) & (radiance >= 0)
    valid = valid & (finite if finite.ndim == 2 else finite.all(axis=2))
    return HdrReference(np.where(finite, radiance, 0).astype(np.float32), valid, 1.0, None)


def _read_exr(path: Path) -> tuple[NDArray[Any], Mask]:
    with reading(path):
        channels = exr_channels(path, path.read_bytes())
    radiance = exr_image(path, channels)
    valid = channels["valid"] > 0.5 if "valid" in channels else np.ones(radiance.shape[:2], bool)
    return radiance, valid


def _read_hdr(path: Path) -> tuple[NDArray[Any], Mask]:
    with reading(path):
        image = decoded(path.read_bytes(), path)
    if image is None or image.dtype != np.float32:
        raise FormatError(f"{path}: not a Radiance HDR image, or damaged")
    return np.ascontiguousarray(image[..., ::-1]), np.ones(image.shape[:2], bool)


def _read_npz(path: Path) -> tuple[NDArray[Any], Mask]:
    try:
        with np.load(path, allow_pickle=False) as file:
            radiance = np.asarray(file["radiance"], np.float32)
            valid = np.asarray(file["valid"], bool) if "valid" in file else np.ones(radiance.shape[:2], bool)
    except (*DAMAGE, OSError) as error:
        raise FormatError(f"{path}: not an .npz with the array radiance, or damaged") from error
    return radiance, valid


def encode_radiance(reference: HdrReference, suffix: str) -> bytes:
    """A reference as the bytes of an ``.exr`` (R, G, B, Y, ``valid``) or ``.npz`` file."""
    file = io.BytesIO()
    if suffix == ".npz":
        np.savez_compressed(
            file, radiance=reference.radiance, valid=reference.valid, exposure=np.float64(reference.exposure)
        )
        return file.getvalue()
    import OpenEXR

    channels = {"Y": np.ascontiguousarray(reference.luminance), "valid": reference.valid.astype(np.float32)}
    if reference.radiance.ndim == 3:
        channels |= {n: np.ascontiguousarray(reference.radiance[..., i]) for i, n in enumerate("RGB")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(file)
    return file.getvalue()
