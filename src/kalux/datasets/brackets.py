"""Photographs of one scene at several exposure times, a bracket: reading them, and what two say of each other.

Values of pixels are called levels, 0 to 1.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.debevec import CLIPPED_HIGH, CLIPPED_LOW
from kalux.calibration.photographs import parse_seconds, read_exposure, read_photograph
from kalux.errors import FormatError, InputError
from kalux.models.camera import Response
from kalux.readers.images import images_in
from kalux.wording import how_many

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

TAPER: Final = 10 / 255
"""Levels over which a weight rises from 0 at a clipped end: merging has no seams."""

LEVEL_NOISE: Final = 1 / 255
"""Standard deviation of a level: quantisation, and the losses of JPEG."""


@dataclass(frozen=True, eq=False)
class Picture:
    """One photograph of a bracket.

    Attributes
    ----------
    name
        Of its file, for messages.
    levels
        (H, W) or (H, W, 3; red, green, blue) uint8 or uint16, as in the file.
    exposure
        What the level is a function of, for the same light: seconds, or seconds times ISO / 100 / f-number^2.
    """

    name: str
    levels: NDArray[Any]
    exposure: float

    @property
    def response(self) -> Image:
        """Levels as float32, 0 to 1 = saturated."""
        return np.asarray(self.levels / np.float32(np.iinfo(self.levels.dtype).max), np.float32)

    def irradiance(self, response: Response) -> Array:
        """The irradiance that the levels stand for, 1 = saturated."""
        return response.inverse(np.asarray(self.response, np.float64))


def read_bracket(folder: Path, exposures: Path | Sequence[float] | None = None) -> list[Picture]:
    """The photographs of a folder, by exposure, longest first.

    Parameters
    ----------
    folder
        Of images, all of one size.
    exposures
        A CSV with the columns ``file`` and ``exposure_s`` (seconds; other images are left out), or seconds for the
        images in the order of the numbers in their names. None: from the images' EXIF data.

    Raises
    ------
    InputError
        If there are fewer than two images, exposures are missing or equal, or sizes differ.
    FormatError
        If an image cannot be read.
    MissingDependencyError
        If EXIF data are needed, and Pillow is not installed.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a folder of photographs")
    paths = images_in(folder)
    if isinstance(exposures, Path):
        seconds = _listed_exposures(exposures)
        missing = sorted(set(seconds) - {path.name for path in paths})
        if missing:
            raise InputError(f"{exposures}: lists {missing[0]}, which is not an image in {folder}")
        paths = [path for path in paths if path.name in seconds]
        found = [seconds[path.name] for path in paths]
    elif exposures is not None:
        if len(exposures) != len(paths):
            raise InputError(
                f"{folder}: {len(exposures)} exposure times for {len(paths)} images; give one for each"
            )
        found = [float(value) for value in exposures]
    else:
        stated = [read_exposure(path) for path in paths]
        found = [one.seconds * one.gain for one in stated]
    pictures = [Picture(p.name, read_photograph(p), e) for p, e in zip(paths, found, strict=True)]
    check_bracket(pictures, str(folder))
    return sorted(pictures, key=lambda picture: -picture.exposure)


def check_bracket(pictures: Sequence[Picture], where: str = "bracket") -> None:
    """Whether photographs can be merged.

    Raises
    ------
    InputError
        If there are fewer than two, exposures are not positive or all equal, or sizes or types differ.
    """
    if len(pictures) < 2:
        raise InputError(
            f"{where}: {how_many(len(pictures), 'photograph')}; at least two exposures are needed"
        )
    for picture in pictures:
        if not (np.isfinite(picture.exposure) and picture.exposure > 0):
            raise InputError(
                f"{where}: {picture.name} has an exposure of {picture.exposure}; it must be positive"
            )
    first = pictures[0]
    for picture in pictures:
        if (picture.levels.shape, picture.levels.dtype) != (first.levels.shape, first.levels.dtype):
            raise InputError(
                f"{where}: {picture.name} is {picture.levels.shape} {picture.levels.dtype}, {first.name} is "
                f"{first.levels.shape} {first.levels.dtype}; all must be alike"
            )
    if max(p.exposure for p in pictures) < 1.2 * min(p.exposure for p in pictures):
        raise InputError(f"{where}: all exposures are equal; a bracket needs different ones")


def _listed_exposures(path: Path) -> dict[str, float]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(line for line in file if line.strip() and not line.startswith("#")))
            listed = [(row["file"].strip(), parse_seconds(row["exposure_s"])) for row in rows]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (KeyError, ValueError, AttributeError, TypeError, csv.Error) as error:
        raise FormatError(
            f"{path}: not a CSV with the columns file and exposure_s (seconds, or 1/30)"
        ) from error
    twice = [name for name, times in Counter(name for name, _ in listed).items() if times > 1]
    if twice:
        raise FormatError(f"{path}: lists {twice[0]} twice; give each photograph one line")
    return dict(listed)


def best_exposed(pictures: Sequence[Picture]) -> int:
    """Index of the photograph with the most pixels that are neither dark nor bright."""
    shares = [np.mean(_well_exposed(picture.response)) for picture in pictures]
    return int(np.argmax(shares))


def _well_exposed(response: Image) -> Mask:
    """Levels away from both ends, in all channels: (H, W)."""
    inside = (response > 10 / 255) & (response < 245 / 255)
    return inside if inside.ndim == 2 else np.asarray(inside.all(axis=2))


def log_ratio(
    first: Picture, second: Picture, response: Response, covered: Mask, lowest: float = CLIPPED_LOW + TAPER
) -> Array:
    """log of the second's irradiance over the first's, where both are exposed well: (N,)."""
    a, b = first.response, second.response
    low, high = lowest, CLIPPED_HIGH - TAPER
    both = (a > low) & (a < high) & (b > low) & (b < high)
    both &= covered if a.ndim == 2 else covered[..., None]
    return np.asarray(
        np.log(second.irradiance(response)[both]) - np.log(first.irradiance(response)[both]), np.float64
    )
