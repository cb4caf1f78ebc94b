"""HDR reference images: photographs of one scene at several exposure times, joined in radiance.

The order of things, each a function::

    files -> pictures with exposures -> alignment (features, homography) -> response (`kalux.calibration.response`)
    -> true exposures -> consistency (what moved) -> merge (radiance, weighted by its noise)

Values of pixels are called levels, 0 to 1. The three channels of a colour camera share one response: a camera applies
one tone curve to all, and grey stays grey.

References
----------
.. [1] M. Robertson, S. Borman, R. Stevenson, "Estimation-theoretic approach to dynamic range enhancement using
   multiple exposures", J. Electronic Imaging 12(2), 2003.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.debevec import CLIPPED_HIGH, CLIPPED_LOW, LEAST_SHARED, LEAST_SPREAD
from kalux.calibration.homography import find_features
from kalux.calibration.photographs import read_exposure, read_photograph
from kalux.calibration.regression import robust_deviation
from kalux.calibration.response import CalibrationName, fit_response, side_by_side
from kalux.datasets.registration import (
    Match,
    displacement,
    match_features,
    tone_compressed,
    warped,
    warped_mask,
)
from kalux.errors import FormatError, InputError
from kalux.models.camera import Response
from kalux.models.colour import LUMINANCE
from kalux.readers.images import images_in
from kalux.readers.numpy_files import DAMAGE

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

_TAPER: Final = 10 / 255  # levels over which a weight rises from 0 at a clipped end: merging has no seams
_LEVEL_NOISE: Final = 1 / 255  # standard deviation of a level: quantisation, and the losses of JPEG
_INCONSISTENT: Final = 4.0  # standard deviations
_ALIGNED: Final = 0.3  # pixels: less is not worth the blur of resampling, and features know it no better
_LEAST_COMMON: Final = 40  # features: with fewer, the corners of a homography are a guess
_QUIET: Final = 40 / 255  # level from which noise is small beside the spread between exposures


# --- pictures ---------------------------------------------------------------------------------------------


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
        raise InputError(f"{where}: {len(pictures)} photographs; at least two exposures are needed")
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
        with path.open(newline="") as file:
            rows = list(csv.DictReader(line for line in file if line.strip() and not line.startswith("#")))
            return {row["file"].strip(): parse_seconds(row["exposure_s"]) for row in rows}
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (KeyError, ValueError, AttributeError, TypeError, csv.Error) as error:
        raise FormatError(
            f"{path}: not a CSV with the columns file and exposure_s (seconds, or 1/30)"
        ) from error


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


# --- alignment --------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Aligned:
    """A photograph in the pixels of the reference.

    Attributes
    ----------
    picture
        Resampled where it had moved; levels as before.
    covered
        (H, W) bool: where it shows anything.
    moved
        Largest movement of a corner, pixels of the reference, that was found; None: could not be found.
    said
        What was done, in words.
    """

    picture: Picture
    covered: Mask
    moved: float | None
    said: str


def align(pictures: Sequence[Picture]) -> list[Aligned]:
    """Bring photographs, sorted by exposure, into the pixels of the one that is best exposed.

    Each is registered to its neighbour on the way to the reference, where most is well exposed in both; one that
    cannot be, for want of common features, is taken to have moved as its neighbour did, and that is told.
    """
    reference = best_exposed(pictures)
    size = pictures[0].levels.shape[:2]
    everywhere = np.ones(size, bool)
    done: dict[int, tuple[Array, Aligned]] = {
        reference: (
            np.eye(3),
            Aligned(pictures[reference], everywhere, 0.0, "the reference of the alignment"),
        )
    }
    for index in [*range(reference + 1, len(pictures)), *range(reference - 1, -1, -1)]:
        neighbour = index - 1 if index > reference else index + 1
        to_neighbour, match = _between(pictures[neighbour], pictures[index])
        known = to_neighbour is not None
        matrix = done[neighbour][0] if to_neighbour is None else to_neighbour @ done[neighbour][0]
        moved = displacement(matrix, np.eye(3), size)
        if moved < _ALIGNED:
            aligned = Aligned(pictures[index], everywhere, moved if known else None, "in place")
        else:
            picture = pictures[index]
            levels = np.nan_to_num(warped(picture.levels, matrix, size))
            kept = Picture(picture.name, np.rint(levels).astype(picture.levels.dtype), picture.exposure)
            said = f"moved by up to {moved:.1f} pixels, aligned"
            aligned = Aligned(kept, warped_mask(everywhere, matrix, size), moved if known else None, said)
        if not known:
            told = f"{match.inliers} common features with {pictures[neighbour].name} are too few to align it"
            aligned = Aligned(aligned.picture, aligned.covered, None, f"{told}: taken to lie as that one")
        done[index] = matrix, aligned
    return [done[index][1] for index in range(len(pictures))]


def best_exposed(pictures: Sequence[Picture]) -> int:
    """Index of the photograph with the most pixels that are neither dark nor bright."""
    shares = [np.mean(_well_exposed(picture.response)) for picture in pictures]
    return int(np.argmax(shares))


def _well_exposed(response: Image) -> Mask:
    """Levels away from both ends, in all channels: (H, W)."""
    inside = (response > 10 / 255) & (response < 245 / 255)
    return inside if inside.ndim == 2 else np.asarray(inside.all(axis=2))


def _between(fixed: Picture, moving: Picture) -> tuple[Array | None, Match]:
    """From the pixels of one photograph to those of the next, by what both of them expose well."""
    # The response is not known before they are aligned; sRGB is near enough for features.
    curve = Response.srgb()
    first, second = (np.log(_luminance(p.irradiance(curve)) / p.exposure + 1e-9) for p in (fixed, moving))
    masks = tuple(
        np.asarray(_luminance(p.response) > 4 / 255) & (p.response.reshape(*first.shape, -1).max(2) < 0.97)
        for p in (fixed, moving)
    )
    if min(np.count_nonzero(mask) for mask in masks) < LEAST_SHARED:
        return None, Match(None, 0, 0)
    low = max(np.percentile(log[mask], 1) for log, mask in zip((first, second), masks, strict=True))
    high = min(np.percentile(log[mask], 99.5) for log, mask in zip((first, second), masks, strict=True))
    if high <= low:
        return None, Match(None, 0, 0)
    match = match_features(
        *(
            find_features(tone_compressed(log, low, high), mask)
            for log, mask in zip((first, second), masks, strict=True)
        )
    )
    return (match.matrix if match.inliers >= _LEAST_COMMON else None), match


def _luminance(image: NDArray[Any]) -> Array:
    return np.asarray(image if image.ndim == 2 else image @ LUMINANCE, np.float64)


# --- response ---------------------------------------------------------------------------------------------


def recover_response(pictures: Sequence[Picture], method: CalibrationName = "debevec") -> Response:
    """The camera's response from aligned photographs of 8 bits, as `kalux.calibration.response` fits it.

    Parameters
    ----------
    pictures
        Sorted by exposure.
    method
        Of `kalux.calibration.response.fit_response`; ``"auto"``: the one that it prefers, as `kalux calibrate response`
        does. Here it is Debevec's: it is judged by the ratios of exposures, which make the radiance.

    Raises
    ------
    InputError
        If the photographs have more than 8 bits, or nothing is exposed well in two of them.
    """
    if any(picture.levels.dtype != np.uint8 for picture in pictures):
        raise InputError(
            "the response of photographs of 16 bits cannot be recovered; state it: linear where they are raw"
        )
    # Shortest first, as the response is fitted.
    stack = np.stack([np.atleast_3d(picture.levels) for picture in reversed(pictures)])
    times = np.array([picture.exposure for picture in reversed(pictures)])
    try:
        return Response.curve(fit_response(side_by_side(stack), times, method)[0].knots)
    except InputError as error:
        raise InputError(f"{error}; or state the response") from None


def measured_exposures(
    pictures: Sequence[Picture], response: Response, covered: Sequence[Mask]
) -> list[float]:
    """Exposures as the photographs themselves say, the best exposed one's as stated.

    Each by the median ratio to its neighbour over what both expose well; as stated where that is too little. A
    shutter's time is rounded in EXIF and inexact itself, and lamps flicker.
    """
    reference = best_exposed(pictures)
    found = {reference: pictures[reference].exposure}
    for index in [*range(reference + 1, len(pictures)), *range(reference - 1, -1, -1)]:
        neighbour = index - 1 if index > reference else index + 1
        ratio = pictures[index].exposure / pictures[neighbour].exposure
        logs = _log_ratio(pictures[neighbour], pictures[index], response, covered[neighbour] & covered[index])
        if len(logs) >= LEAST_SHARED:
            ratio = float(np.exp(np.median(logs)))
        found[index] = found[neighbour] * ratio
    return [found[index] for index in range(len(pictures))]


def _log_ratio(
    first: Picture, second: Picture, response: Response, covered: Mask, lowest: float = CLIPPED_LOW + _TAPER
) -> Array:
    """log of the second's irradiance over the first's, where both are exposed well: (N,)."""
    a, b = first.response, second.response
    low, high = lowest, CLIPPED_HIGH - _TAPER
    both = (a > low) & (a < high) & (b > low) & (b < high)
    both &= covered if a.ndim == 2 else covered[..., None]
    return np.asarray(
        np.log(second.irradiance(response)[both]) - np.log(first.irradiance(response)[both]), np.float64
    )


# --- consistency ------------------------------------------------------------------------------------------


class Consistency(NamedTuple):
    """What moved between the exposures.

    Attributes
    ----------
    moved
        (K, H, W) bool: where photograph k shows something else than most.
    unsettled
        (H, W) bool: where there is no majority.
    """

    moved: NDArray[np.bool_]
    unsettled: Mask


def consistency(
    pictures: Sequence[Picture], response: Response, covered: Sequence[Mask], spread: float
) -> Consistency:
    """Test every photograph against every other, pixel by pixel, with the response and the noise.

    The irradiance that photograph j measures predicts the level in photograph k, clipped where the camera clips: so
    what is too bright or too dark for one exposure testifies, too. They agree within 4 standard deviations, of the
    level's noise in both, carried through the response, and of ``spread``. The irradiance is settled that
    contradicts the fewest photographs; what contradicts it has moved. Where as many contradict it as agree, nothing
    is settled. Single pixels and lines are noise and remainders of the alignment, and count as still; what moved is
    grown by two pixels, for its soft edge.

    Parameters
    ----------
    pictures
        Aligned.
    response
        Of the camera.
    covered
        (H, W) bool each: where the photograph shows anything.
    spread
        Relative standard deviation between exposures of the same thing, from `relative_spread`.
    """
    height, width = pictures[0].levels.shape[:2]
    moved = np.zeros((len(pictures), height, width), bool)
    unsettled = np.zeros((height, width), bool)
    exposures = [picture.exposure for picture in pictures]
    table = _Table.of(response)
    rows = max(1, 2_000_000 // (width * len(pictures)))  # bounds the memory of large photographs
    for top in range(0, height, rows):
        band = slice(top, top + rows)
        levels = np.stack([_as_colour(p.response[band]) for p in pictures])
        seen = np.stack([mask[band] for mask in covered])
        moved[:, band], unsettled[band] = _settle(levels, exposures, seen, table, spread)
    return Consistency(np.stack([_grown(part) for part in moved]), _grown(unsettled))


def _as_colour(image: Image) -> Image:
    return image[..., None] if image.ndim == 2 else image


class _Table(NamedTuple):
    """The response and its inverse at 4096 equally spaced places, for speed."""

    inverse: Image
    slope: Image  # d irradiance / d level
    response: Image  # over the logarithm of the irradiance
    log_low: float

    @classmethod
    def of(cls, response: Response) -> _Table:
        level = np.linspace(0.0, 1.0, 4097)
        inverse = response.inverse(level)
        low = float(np.log(max(response.inverse(np.array([0.5 / 255]))[0], 1e-9)))
        over_log = response(np.exp(np.linspace(low, 0.0, 4097)))
        slope = np.gradient(inverse, level)
        curves = (np.asarray(curve, np.float32) for curve in (inverse, slope, over_log))
        return cls(next(curves), next(curves), next(curves), low)

    def at_level(self, table: Image, level: Image) -> Image:
        return table[np.rint(level * 4096).astype(np.int32)]

    def levels(self, irradiance: NDArray[Any]) -> Image:
        place = (np.log(np.maximum(irradiance, 1e-12)) - self.log_low) * (4096 / -self.log_low)
        found: Image = self.response[np.clip(np.rint(place), 0, 4096).astype(np.int32)]
        return found


def _settle(
    levels: Image, exposures: Sequence[float], seen: NDArray[np.bool_], table: _Table, spread: float
) -> tuple[NDArray[np.bool_], Mask]:
    """For (K, rows, W, C) levels: (K, rows, W) what contradicts the settled irradiance, and what is not settled."""
    count = len(exposures)
    shape = levels.shape[1:3]
    measured = ((levels > CLIPPED_LOW) & (levels < CLIPPED_HIGH)).all(axis=3) & seen
    best_score = np.full(shape, -np.inf)
    contradicts = np.zeros((count, *shape), bool)
    balance = np.zeros(shape, np.int64)
    for j in range(count):
        if not measured[j].any():
            continue
        irradiance = table.at_level(table.inverse, levels[j])
        relative = _LEVEL_NOISE * table.at_level(table.slope, levels[j]) / np.maximum(irradiance, 1e-9)
        against = np.zeros((count, *shape), bool)
        support = np.zeros(shape, np.int64)
        for k in range(count):
            if k == j:
                continue
            ratio = np.float32(exposures[k] / exposures[j])
            predicted = table.levels(irradiance * ratio)
            # How far the prediction may be off: one standard deviation up and down through the response.
            factor = np.sqrt(relative**2 + spread**2)
            above = table.levels(irradiance * ratio * (1 + _INCONSISTENT * factor))
            below = table.levels(irradiance * ratio / (1 + _INCONSISTENT * factor))
            room = _INCONSISTENT * _LEVEL_NOISE
            agrees = (levels[k] <= above + room) & (levels[k] >= below - room)
            # The last levels at either end are compressed, or offset: within them one is like the other.
            white = (predicted > CLIPPED_HIGH) & (levels[k] > CLIPPED_HIGH)
            black = np.maximum(predicted, levels[k]) < CLIPPED_LOW + room
            blank = (white | black).all(axis=2)
            agrees = (agrees | white | black).all(axis=2)
            against[k] = ~agrees & seen[k]
            support += (agrees & ~blank & seen[k]).astype(np.int64)
        opposed = against.sum(axis=0)
        # Where two explain as much, the longer exposure, which comes first, is less noisy.
        score = np.where(measured[j], support - 1.0 * opposed, -np.inf)
        better = score > best_score
        best_score = np.where(better, score, best_score)
        contradicts = np.where(better, against, contradicts)
        balance = np.where(better, support + 1 - opposed, balance)
    return contradicts, (balance <= 0) & measured.any(axis=0)


def _grown(mask: Mask) -> Mask:
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return np.asarray(cv2.dilate(opened, np.ones((5, 5), np.uint8)), bool)


def relative_spread(pictures: Sequence[Picture], response: Response, covered: Sequence[Mask]) -> float:
    """Relative standard deviation between neighbouring exposures of the same thing, robust, at least 3 %."""
    spreads, counts = [], []
    for k in range(len(pictures) - 1):
        logs = _log_ratio(pictures[k], pictures[k + 1], response, covered[k] & covered[k + 1], _QUIET)
        if len(logs) >= LEAST_SHARED:
            spreads.append(robust_deviation(logs - np.median(logs)))
            counts.append(len(logs))
    if not spreads:
        return LEAST_SPREAD
    return max(float(np.sqrt(np.average(np.square(spreads), weights=counts))), LEAST_SPREAD)


# --- merge ------------------------------------------------------------------------------------------------


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
        return np.asarray(_luminance(self.radiance), np.float32)


def merge(
    pictures: Sequence[Picture],
    response: Response,
    covered: Sequence[Mask],
    moved: NDArray[np.bool_] | None,
    exposure: float,
) -> tuple[Image, Mask]:
    """Radiance of aligned photographs, and where it was measured.

    The mean of each exposure's estimate E = CRF^-1(level) / t, weighted by the inverse of its variance,
    (t dlevel/dE)^2 for noise of the level (Robertson [1]_), and nothing at clipped levels, tapered over ten levels.

    Parameters
    ----------
    pictures, response, covered
        As for `consistency`.
    moved
        (K, H, W) bool: left out; None: nothing.
    exposure
        At which a saturated pixel is to be 1.

    Returns
    -------
    (H, W) or (H, W, 3) float32, and (H, W) bool. Where nothing was measured the radiance is that of the best
    exposure for it: the shortest where all are clipped at white, the longest where all are black.
    """
    shape = pictures[0].levels.shape
    total, weights = np.zeros(shape), np.zeros(shape)
    table = _Table.of(response)
    for k, picture in enumerate(pictures):
        level = picture.response
        irradiance = table.at_level(table.inverse, level).astype(np.float64)
        slope = np.maximum(table.at_level(table.slope, level).astype(np.float64), 1e-6)
        ends = np.minimum(level - CLIPPED_LOW, CLIPPED_HIGH - level) / _TAPER
        weight = np.clip(ends, 0.0, 1.0) * (picture.exposure / exposure / slope) ** 2
        left_out = ~covered[k] if moved is None else ~covered[k] | moved[k]
        weight[left_out] = 0.0
        total += weight * irradiance * (exposure / picture.exposure)
        weights += weight
    measured = weights > 0
    radiance = total / np.where(measured, weights, 1.0)
    shortest, longest = (pick(pictures, key=lambda p: p.exposure) for pick in (min, max))
    for extreme, chosen in ((shortest, shortest.response >= 0.5), (longest, longest.response < 0.5)):
        fill = ~measured & chosen
        radiance[fill] = table.at_level(table.inverse, extreme.response[fill]) * (exposure / extreme.exposure)
    valid = measured if measured.ndim == 2 else measured.all(axis=2)
    return radiance.astype(np.float32), np.asarray(valid)


def hdr_reference(
    pictures: Sequence[Picture],
    *,
    response: CalibrationName | Response = "debevec",
    aligned: bool = True,
    ghosts: bool = True,
) -> HdrReference:
    """The radiance of a scene from photographs at several exposures.

    Parameters
    ----------
    pictures
        Of one scene, sorted by exposure, as from `read_bracket`.
    response
        How the camera's response is recovered, or the response.
    aligned
        Whether photographs are aligned; False: they are taken as they lie (a tripod).
    ghosts
        Whether things that moved are left out.

    Raises
    ------
    InputError
        If the photographs cannot be merged, or the response not recovered.
    """
    check_bracket(pictures)
    everywhere = np.ones(pictures[0].levels.shape[:2], bool)
    placed = align(pictures) if aligned else [Aligned(p, everywhere, None, "as it lies") for p in pictures]
    shown, covered = [a.picture for a in placed], [a.covered for a in placed]
    curve = response if isinstance(response, Response) else recover_response(shown, response)
    exposures = measured_exposures(shown, curve, covered)
    stated = [picture.exposure for picture in shown]
    shown = [Picture(p.name, p.levels, e) for p, e in zip(shown, exposures, strict=True)]
    spread = relative_spread(shown, curve, covered)
    found = consistency(shown, curve, covered, spread) if ghosts else None
    reference = float(np.median(exposures))
    radiance, valid = merge(shown, curve, covered, None if found is None else found.moved, reference)
    if found is not None:
        valid &= ~found.unsettled
    said = [_told(placed, stated, exposures, found, k) for k in range(len(shown))]
    said.append(f"exposures agree within {100 * spread:.1f} % (one standard deviation)")
    return HdrReference(radiance, valid, reference, curve, tuple(said), tuple(shown))


def _told(
    placed: Sequence[Aligned],
    stated: Sequence[float],
    exposures: Sequence[float],
    found: Consistency | None,
    k: int,
) -> str:
    said = f"{placed[k].picture.name}: {placed[k].said}"
    off = exposures[k] / stated[k]
    if abs(off - 1) > 0.02:
        said += f"; {off:.2f} times as bright as its exposure says"
    if found is not None and found.moved[k].any():
        said += f"; {100 * found.moved[k].mean():.1f} % of it contradicts the others and is left out"
    return said


# --- files ------------------------------------------------------------------------------------------------


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
    import OpenEXR

    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
    except (RuntimeError, ValueError, OSError) as error:
        raise FormatError(f"{path}: not an EXR file, or damaged") from error
    planes = {name: np.asarray(channel.pixels, np.float32) for name, channel in channels.items()}
    if {"R", "G", "B"} <= planes.keys():
        radiance = np.stack([planes[name] for name in "RGB"], axis=2)
    elif "Y" in planes:
        radiance = planes["Y"]
    else:
        raise FormatError(f"{path}: has no channels R, G, B or Y")
    valid = planes["valid"] > 0.5 if "valid" in planes else np.ones(radiance.shape[:2], bool)
    return radiance, valid


def _read_hdr(path: Path) -> tuple[NDArray[Any], Mask]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
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
    import io

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


def response_plot(pictures: Iterable[Picture], response: Response) -> NDArray[np.uint8]:
    """The response over the logarithm of the exposure, with what every photograph says of it: (480, 640, 3) RGB.

    A dot is the median of a photograph's levels where the merged irradiance, per octave and a third, is alike.
    """
    height, width, left, bottom = 480, 640, 50, 40
    octaves = 12.0
    canvas = np.full((height, width, 3), 255, np.uint8)

    def place(irradiance: Array, level: Array) -> NDArray[np.int32]:
        x = left + (np.log2(np.maximum(irradiance, 1e-12)) + octaves) / octaves * (width - left - 15)
        y = height - bottom - level * (height - bottom - 15)
        return np.stack([x, y], axis=-1).round().astype(np.int32)

    for octave in range(13):
        x = int(place(np.array([2.0**-octave]), np.zeros(1))[0, 0])
        cv2.line(canvas, (x, 15), (x, height - bottom), (225, 225, 225), 1)
        cv2.putText(
            canvas, str(-octave), (x - 10, height - bottom + 16), _FONT, 0.4, (60, 60, 60), 1, cv2.LINE_AA
        )
    for level in (0, 64, 128, 192, 255):
        y = int(place(np.ones(1), np.array([level / 255]))[0, 1])
        cv2.line(canvas, (left, y), (width - 15, y), (225, 225, 225), 1)
        cv2.putText(canvas, str(level), (14, y + 4), _FONT, 0.4, (60, 60, 60), 1, cv2.LINE_AA)
    label = "log2 of the irradiance, 0 = white"
    cv2.putText(canvas, label, (200, height - 8), _FONT, 0.45, (60, 60, 60), 1, cv2.LINE_AA)
    for octave, srgb in ((False, True), (True, False)):
        curve = Response.srgb() if srgb else response
        irradiance = np.exp2(np.linspace(-octaves, 0, 600))
        colour = (170, 170, 170) if srgb else (190, 60, 30)
        cv2.polylines(canvas, [place(irradiance, curve(irradiance))], False, colour, 1 + octave, cv2.LINE_AA)
    cv2.putText(canvas, "response", (70, 40), _FONT, 0.5, (190, 60, 30), 1, cv2.LINE_AA)
    cv2.putText(canvas, "sRGB", (70, 60), _FONT, 0.5, (140, 140, 140), 1, cv2.LINE_AA)
    for picture, irradiance in _observed(list(pictures), response):
        cv2.circle(
            canvas,
            tuple(int(v) for v in place(irradiance[:1], picture)[0]),
            3,
            (40, 90, 160),
            -1,
            cv2.LINE_AA,
        )
    return canvas


_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX


def _observed(pictures: list[Picture], response: Response) -> Iterator[tuple[Array, Array]]:
    """Median level of a photograph by the irradiance that its neighbour measures."""
    for k, picture in enumerate(pictures):
        for other in pictures[max(k - 1, 0) : k] + pictures[k + 1 : k + 2]:
            level = other.response
            inside = (level > CLIPPED_LOW + _TAPER) & (level < CLIPPED_HIGH - _TAPER)
            irradiance = other.irradiance(response)[inside] * (picture.exposure / other.exposure)
            bins = np.floor(3 * np.log2(np.maximum(irradiance, 1e-12))).astype(np.int64)
            for number in np.unique(bins):
                members = bins == number
                if number < 0 and np.count_nonzero(members) >= 50:
                    yield (
                        np.array([float(np.median(picture.response[inside][members]))]),
                        np.array([float(np.median(irradiance[members]))]),
                    )
