"""Photographs of a bracket, brought into the pixels of one of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.debevec import LEAST_SHARED
from kalux.calibration.homography import find_features
from kalux.datasets.brackets import Picture, best_exposed
from kalux.datasets.radiance import luminance_of
from kalux.datasets.warping import Match, displacement, match_features, tone_compressed, warped, warped_mask
from kalux.models.camera import Response

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ALIGNED: Final = 0.3  # pixels: less is not worth the blur of resampling, and features know it no better
_LEAST_COMMON: Final = 40  # features: with fewer, the corners of a homography are a guess


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


def _between(fixed: Picture, moving: Picture) -> tuple[Array | None, Match]:
    """From the pixels of one photograph to those of the next, by what both of them expose well."""
    # The response is not known before they are aligned; sRGB is near enough for features.
    curve = Response.srgb()
    first, second = (np.log(luminance_of(p.irradiance(curve)) / p.exposure + 1e-9) for p in (fixed, moving))
    masks = tuple(
        np.asarray(luminance_of(p.response) > 4 / 255) & (p.response.reshape(*first.shape, -1).max(2) < 0.97)
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
