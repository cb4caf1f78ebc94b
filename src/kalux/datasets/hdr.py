"""HDR reference images: photographs of one scene at several exposure times, joined in radiance.

The order of things::

    files -> pictures with exposures (`brackets`) -> alignment (`bracket_alignment`) -> response
    (`kalux.calibration.response`) -> true exposures -> what moved (`bracket_consistency`)
    -> merge (radiance, weighted by its noise)

The three channels of a colour camera share one response: a camera applies one tone curve to all, and grey stays grey.

References
----------
.. [1] M. Robertson, S. Borman, R. Stevenson, "Estimation-theoretic approach to dynamic range enhancement using
   multiple exposures", J. Electronic Imaging 12(2), 2003.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.debevec import CLIPPED_HIGH, CLIPPED_LOW, LEAST_SHARED, LEAST_SPREAD
from kalux.calibration.response import CalibrationName, fit_response, side_by_side
from kalux.datasets.bracket_alignment import Aligned, align
from kalux.datasets.bracket_consistency import Consistency, ResponseTable, consistency, relative_spread
from kalux.datasets.brackets import TAPER, Picture, best_exposed, check_bracket, log_ratio
from kalux.datasets.radiance import HdrReference
from kalux.errors import InputError
from kalux.models.camera import Response

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]


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
        logs = log_ratio(pictures[neighbour], pictures[index], response, covered[neighbour] & covered[index])
        if len(logs) >= LEAST_SHARED:
            ratio = float(np.exp(np.median(logs)))
        found[index] = found[neighbour] * ratio
    return [found[index] for index in range(len(pictures))]


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
    table = ResponseTable.of(response)
    for k, picture in enumerate(pictures):
        level = picture.response
        irradiance = table.at_level(table.inverse, level).astype(np.float64)
        slope = np.maximum(table.at_level(table.slope, level).astype(np.float64), 1e-6)
        ends = np.minimum(level - CLIPPED_LOW, CLIPPED_HIGH - level) / TAPER
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
    photographs, covered = [a.picture for a in placed], [a.covered for a in placed]
    curve = response if isinstance(response, Response) else recover_response(photographs, response)
    exposures = measured_exposures(photographs, curve, covered)
    stated = [picture.exposure for picture in photographs]
    photographs = [Picture(p.name, p.levels, e) for p, e in zip(photographs, exposures, strict=True)]
    spread = relative_spread(photographs, curve, covered)
    found = consistency(photographs, curve, covered, spread) if ghosts else None
    reference = float(np.median(exposures))
    radiance, valid = merge(photographs, curve, covered, None if found is None else found.moved, reference)
    if found is not None:
        valid &= ~found.unsettled
    said = [_described(placed, stated, exposures, found, k) for k in range(len(photographs))]
    said.append(_agreement(spread))
    return HdrReference(radiance, valid, reference, curve, tuple(said), tuple(photographs))


def _agreement(spread: float) -> str:
    if spread <= LEAST_SPREAD:  # or nothing tells how well
        return f"exposures are taken to agree within {100 * LEAST_SPREAD:.0f} %, the least (one standard deviation)"
    return f"exposures agree within {100 * spread:.1f} % (one standard deviation)"


def _described(
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
