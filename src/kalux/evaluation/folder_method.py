"""Any other method, as a folder of its images with their times.

The folder is as `kalux reconstruct` writes one: `timestamps.csv` with a time and a file per image. EXR (channel ``Y``)
and NPY ((H, W), or (2, H, W) with the intensity first) hold linear intensity, 1 = white; PNG and other grey images of 8
and 16-bit levels are taken as they are, 0 to 1, without undoing any tone curve.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.lib.format import read_array
from numpy.typing import NDArray

from kalux.datasets.exr import exr_channels
from kalux.errors import FormatError, FrameError, InputError
from kalux.evaluation.method import Image, Times
from kalux.evaluation.pairs import check_intensity
from kalux.readers.image_lists import read_csv
from kalux.readers.images import read_image
from kalux.readers.source import reading
from kalux.recording import Recording

LISTING: Final = "timestamps.csv"

_WANTED: Final = "a line per image and the columns t_us and file"
"""What a list is, for messages."""

_GREY: Final = (
    "of a recording in colour kalux reconstruct writes it with --grey (RGB frames) or --bayer none (a mosaic)"
)
"""How to get one value for each pixel, for messages."""

TOLERANCE: Final = 1000
"""us from a wanted time to that of the image for it: as EVREAL, 1 ms."""


def images(
    recording: Recording, times: Times, *, folder: Path, tolerance: int = TOLERANCE
) -> Iterator[Image]:
    """The folder's image nearest to each time.

    Parameters
    ----------
    recording
        Whose sensor the images have.
    times
        (N,) int64 us.
    folder
        With `timestamps.csv`.
    tolerance
        us that an image may be away from the time it is taken for.

    Raises
    ------
    InputError
        If there is no image near enough to some time; before the first is read.
    FormatError
        If the list or an image cannot be read.
    FrameError
        If an image has not the size of the sensor.
    """
    stamps, files = listed(folder)
    nearest = _nearest(stamps, times)
    distance = np.abs(stamps[nearest] - times)
    lacking = np.flatnonzero(distance > tolerance)
    if len(lacking):
        worst = lacking[0]
        raise InputError(
            f"{folder}: no image within {tolerance} us of {len(lacking)} of {len(times)} times, the first is "
            f"{times[worst]} us (nearest: {stamps[nearest[worst]]} us); make images at these times, or allow more: "
            "NAME=FOLDER?tolerance=US"
        )
    held, image = -1, np.empty(0, np.float32)
    for index in nearest.tolist():
        if index != held:
            held, image = index, _load(folder, files[index], recording.sensor_size)
        yield image


def listed(folder: Path) -> tuple[Times, list[Path]]:
    """Times, us, ascending, and files of a folder's list.

    Raises
    ------
    InputError
        If there is no folder of this name, or it has no list.
    FormatError
        If the list cannot be read, is empty, or names a file that is not there.
    """
    listing = folder / LISTING
    if not listing.is_file():
        raise InputError(f"{folder}: not a folder of images with a {LISTING}; it needs one with {_WANTED}")
    with reading(listing, UnicodeError):
        rows, _ = read_csv(
            listing, listing.read_text("utf-8-sig"), wanted=f"a CSV with {_WANTED}", signed=True
        )
    if not rows:
        raise FormatError(f"{listing}: lists no images")
    rows.sort(key=lambda row: row.start)
    absent = [row.file for row in rows if not row.file.is_file()]
    if absent:
        raise FormatError(
            f"{listing}: {len(absent)} of {len(rows)} images are missing, the first is {absent[0]}"
        )
    return np.array([row.start for row in rows], np.int64), [row.file for row in rows]


def _nearest(stamps: Times, times: Times) -> NDArray[np.int64]:
    after = np.searchsorted(stamps, times).clip(0, len(stamps) - 1)
    before = (after - 1).clip(0)
    closer = np.abs(stamps[before] - times) <= np.abs(stamps[after] - times)
    return np.where(closer, before, after)


def _load(folder: Path, file: Path, sensor_size: tuple[int, int]) -> Image:
    with reading(file):
        data = file.read_bytes()
    decode = {".exr": _exr, ".npy": _npy}.get(file.suffix.lower(), _display)
    image = decode(folder, file, data)
    if image.ndim != 2:
        raise FrameError(
            f"{file}: is an array of {image.shape}; one intensity for each pixel, {sensor_size}, is needed; {_GREY}"
        )
    if image.shape != sensor_size:
        raise FrameError(
            f"{file}: has {_size(image.shape)} pixels, but the sensor {_size(sensor_size)}; an image has a value for "
            "each pixel of the sensor"
        )
    return image.astype(np.float32)


def _size(shape: tuple[int, ...]) -> str:
    return "x".join(str(length) for length in reversed(shape))


def _display(folder: Path, file: Path, data: bytes) -> NDArray[Any]:
    image = read_image(folder, file.name, data, colour=True)
    if image.dtype not in (np.uint8, np.uint16):
        raise FormatError(
            f"{file}: holds {image.dtype}; images of 8 or 16-bit levels are read, or linear intensity as .npy, or as "
            ".exr with the channel Y"
        )
    grey = image[..., 0]
    if (image != grey[..., np.newaxis]).any():
        raise FormatError(f"{file}: is in colour; one value for each pixel is needed; {_GREY}")
    displayed: NDArray[Any] = grey / np.iinfo(image.dtype).max
    return displayed


def _npy(folder: Path, file: Path, data: bytes) -> NDArray[Any]:
    try:
        image: NDArray[Any] = read_array(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise FormatError(f"{file}: not an .npy file of plain numbers, or damaged") from error
    if image.dtype.kind not in "fiu":
        raise FormatError(f"{file}: holds {image.dtype}; linear intensity is needed")
    image = image[0] if image.ndim == 3 and len(image) == 2 else image
    check_intensity(file, image)
    return image


def _exr(folder: Path, file: Path, data: bytes) -> NDArray[Any]:
    channels = exr_channels(file, data)
    if "Y" not in channels:
        raise FormatError(
            f"{file}: has the channels {', '.join(channels)[:80]}; Y, the intensity, is needed; {_GREY}"
        )
    return channels["Y"]
