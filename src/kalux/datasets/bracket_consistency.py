"""What moved between the exposures of a bracket, and by how much exposures of the same thing differ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.debevec import CLIPPED_HIGH, CLIPPED_LOW, LEAST_SHARED, LEAST_SPREAD
from kalux.calibration.regression import robust_deviation
from kalux.datasets.brackets import LEVEL_NOISE, Picture, log_ratio
from kalux.models.camera import Response

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

_INCONSISTENT: Final = 4.0  # standard deviations
_QUIET: Final = 40 / 255  # level from which noise is small beside the spread between exposures


class ResponseTable(NamedTuple):
    """The response and its inverse at 4096 equally spaced places, for speed."""

    inverse: Image
    slope: Image  # d irradiance / d level
    response: Image  # over the logarithm of the irradiance
    log_low: float

    @classmethod
    def of(cls, response: Response) -> ResponseTable:
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
    table = ResponseTable.of(response)
    rows = max(1, 2_000_000 // (width * len(pictures)))  # bounds the memory of large photographs
    for top in range(0, height, rows):
        band = slice(top, top + rows)
        levels = np.stack([_as_colour(p.response[band]) for p in pictures])
        seen = np.stack([mask[band] for mask in covered])
        moved[:, band], unsettled[band] = _settle(levels, exposures, seen, table, spread)
    return Consistency(np.stack([_grown(part) for part in moved]), _grown(unsettled))


def _as_colour(image: Image) -> Image:
    return image[..., None] if image.ndim == 2 else image


def _settle(
    levels: Image, exposures: Sequence[float], seen: NDArray[np.bool_], table: ResponseTable, spread: float
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
        relative = LEVEL_NOISE * table.at_level(table.slope, levels[j]) / np.maximum(irradiance, 1e-9)
        against = np.zeros((count, *shape), bool)
        support = np.zeros(shape, np.int64)
        for k in range(count):
            if k == j:
                continue
            ratio = np.float32(exposures[k] / exposures[j])
            agrees, blank = _agrees(levels[k], irradiance * ratio, np.sqrt(relative**2 + spread**2), table)
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


def _agrees(level: Image, irradiance: Image, spread: Image, table: ResponseTable) -> tuple[Mask, Mask]:
    """Whether levels are those of an irradiance of relative standard deviation ``spread``; and as both are clipped."""
    predicted = table.levels(irradiance)
    # How far the prediction may be off: so many standard deviations up and down through the response.
    factor = 1 + _INCONSISTENT * spread
    above, below = table.levels(irradiance * factor), table.levels(irradiance / factor)
    room = _INCONSISTENT * LEVEL_NOISE
    agrees = (level <= above + room) & (level >= below - room)
    # The last levels at either end are compressed, or offset: within them one is like the other.
    white = (predicted > CLIPPED_HIGH) & (level > CLIPPED_HIGH)
    black = np.maximum(predicted, level) < CLIPPED_LOW + room
    clipped = white | black
    return np.asarray((agrees | clipped).all(axis=2)), np.asarray(clipped.all(axis=2))


def _grown(mask: Mask) -> Mask:
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return np.asarray(cv2.dilate(opened, np.ones((5, 5), np.uint8)), bool)


def relative_spread(pictures: Sequence[Picture], response: Response, covered: Sequence[Mask]) -> float:
    """Relative standard deviation between neighbouring exposures of the same thing, robust, at least 3 %."""
    spreads, counts = [], []
    for k in range(len(pictures) - 1):
        logs = log_ratio(pictures[k], pictures[k + 1], response, covered[k] & covered[k + 1], _QUIET)
        if len(logs) >= LEAST_SHARED:
            spreads.append(robust_deviation(logs - np.median(logs)))
            counts.append(len(logs))
    if not spreads:
        return LEAST_SPREAD
    return max(float(np.sqrt(np.average(np.square(spreads), weights=counts))), LEAST_SPREAD)
