"""HDR-VDP 3.0.6: visible difference and quality of an image against a reference, in absolute luminance.

Written anew from the published model and its authors' BSD-licensed MATLAB source, for luminance images, task
"side-by-side", and the outputs Q and Q_JOD. Stages: `pathway` (light in the eye, adaptation, photoreceptors),
`pyramid` (frequency bands), `sensitivity` (to luminance and to contrast), `differences` (masking, pooling).

References
----------
.. [1] R. Mantiuk, K. J. Kim, A. G. Rempel, W. Heidrich, "HDR-VDP-2: a calibrated visual metric for visibility and
   quality predictions in all luminance conditions", ACM Transactions on Graphics 30(4), 2011.
.. [2] R. K. Mantiuk, D. Hammou, P. Hanji, "HDR-VDP-3: a multi-metric for predicting image differences, quality and
   contrast distortions in high dynamic range and regular content", arXiv:2304.13625, 2023.
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from kalux.errors import InputError
from kalux.evaluation.hdr_vdp import constants as c
from kalux.evaluation.hdr_vdp import pyramid
from kalux.evaluation.hdr_vdp.differences import band_errors
from kalux.evaluation.pairs import Array, check_none, checked_pair

__all__ = ["PAPER_PIXELS_PER_DEGREE", "HdrVdp", "hdrvdp"]

PAPER_PIXELS_PER_DEGREE: Final = 26.398591232
"""A display of 21 inch and 640 x 480 pixels seen from 1 m."""


@dataclass(frozen=True)
class HdrVdp:
    """Quality of an image by HDR-VDP 3.0.6.

    Attributes
    ----------
    Q
        Quality: 10 for no visible difference, lower for more of it, without end below.
    Q_JOD
        The same in just objectionable differences: 1 less is chosen by 25 % of observers against 75 %.
    """

    Q: float
    Q_JOD: float


def hdrvdp(
    test: ArrayLike, reference: ArrayLike, *, pixels_per_degree: float = PAPER_PIXELS_PER_DEGREE
) -> HdrVdp:
    """HDR-VDP 3.0.6 for two luminance images, task "side-by-side" [1]_ [2]_.

    Nothing is clipped or scaled: both images must be in cd/m2 as the observer would see them. The paper's evaluation
    shows a reconstruction of 1.0 at 255 cd/m2. Computed in float64.

    Parameters
    ----------
    test, reference
        (H, W) luminance, cd/m2, not negative; at least 9 pixels either way.
    pixels_per_degree
        Pixels of the image in one degree of the visual field, more than 2, at most 1000; by default those of the
        paper's set-up, a 21 inch display of 640 x 480 pixels seen from 1 m.

    Raises
    ------
    InputError
        If the images differ in shape, are not 2-D or too small, or hold values that are negative or not finite.

    Notes
    -----
    The values of the original run in GNU Octave are met within 1e-9. MATLAB's ``imresize`` normalises its weights and
    Octave's does not, which shows only where the sides of the image cannot be halved often enough without a rest.

    References
    ----------
    .. [1] R. Mantiuk, K. J. Kim, A. G. Rempel, W. Heidrich, "HDR-VDP-2", ACM Transactions on Graphics 30(4), 2011.
    .. [2] R. K. Mantiuk, D. Hammou, P. Hanji, "HDR-VDP-3", arXiv:2304.13625, 2023.

    Examples
    --------
    >>> import numpy as np
    >>> image = np.full((48, 64), 100.0)
    >>> hdrvdp(image, image)
    HdrVdp(Q=10.0, Q_JOD=10.0)
    """
    if not (
        isinstance(pixels_per_degree, Real)
        and pyramid.LOWEST_RESOLUTION < pixels_per_degree <= pyramid.HIGHEST_RESOLUTION
    ):
        raise InputError(
            f"pixels_per_degree is {pixels_per_degree!r}; more than 2 and at most 1000 is needed, e.g. 26.4"
        )
    first, second, _ = checked_pair(test, reference)
    _check_luminance(first, "test")
    _check_luminance(second, "reference")
    q = quality(float(np.sum(band_errors(first, second, float(pixels_per_degree)))))
    return HdrVdp(q, just_objectionable_differences(q))


def quality(error: float) -> float:
    """Q of a pooled error."""
    floor = np.exp(c.QUALITY_FLOOR)
    return float(c.QUALITY_BEST + c.QUALITY_FLOOR - np.log(floor + error))


def just_objectionable_differences(q: float) -> float:
    """Q in JOD."""
    return float(c.QUALITY_BEST - c.JOD_SLOPE * max(c.QUALITY_BEST - q, 0.0) ** c.JOD_EXPONENT)


def _check_luminance(image: Array, name: str) -> None:
    if image.ndim != 2:
        raise InputError(f"{name}: a luminance image (H, W) is needed, not shape {image.shape}")
    if min(image.shape) < pyramid.SMALLEST_SIDE:
        raise InputError(
            f"{name}: {image.shape} is too small for HDR-VDP; {pyramid.SMALLEST_SIDE} pixels either way"
        )
    check_none(image < 0, name, "negative, which luminance cannot be")
