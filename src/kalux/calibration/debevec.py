"""The camera response function by the equations of Debevec and Malik, from all pixels at once.

Their unknown irradiance of a pixel is eliminated between neighbouring exposures: what is left depends only on how often
which two levels meet in a pixel, a table of 256 by 256, so all pixels take part, and it is solved robustly.

References
----------
.. [1] P. Debevec, J. Malik, "Recovering High Dynamic Range Radiance Maps from Photographs", SIGGRAPH 1997.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from kalux.errors import InputError
from kalux.models.camera import Response

Array = NDArray[np.float64]

CLIPPED_LOW: Final = 8 / 255
CLIPPED_HIGH: Final = 250 / 255
"""Levels beyond which a picture says only that the scene is darker or brighter: processed pictures compress the last
few levels before white, and have an offset and noise of a few levels at black."""

LEAST_SPREAD: Final = 0.03
"""Relative standard deviation between exposures of the same thing, never less: shutters, lamps."""

LEAST_SHARED: Final = 500
"""Values measured in two exposures, for anything that is estimated from them."""

_LOW, _HIGH = round(255 * CLIPPED_LOW) + 1, round(255 * CLIPPED_HIGH) - 1
_STIFFNESS: Final = 3.0  # of a recovered response: chosen on simulated photographs (docs/datasets.md)
_FIT_NOISE: Final = 2.0  # levels
_FITS: Final = 8


def debevec_response(planes: Sequence[NDArray[Any]], exposures: Sequence[float]) -> Response:
    """The response that explains pixels at several exposures, in all 256 levels.

    Levels that are clipped are left out, so that the curve goes on straight from them to 0 and 1.

    Parameters
    ----------
    planes
        uint8, alike in shape, in ascending or descending order of exposure.
    exposures
        Of each, in any unit.

    Raises
    ------
    InputError
        If nothing is exposed well in two of them.
    """
    counts = _level_pairs(planes)
    if sum(int(count.sum()) for count in counts) < LEAST_SHARED:
        raise InputError(
            "response: too little is exposed well in two neighbouring exposures; take exposures closer to each other"
        )
    return _extended(_log_response(counts, exposures))


def _level_pairs(planes: Sequence[NDArray[Any]]) -> list[Array]:
    """For neighbouring exposures, (256, 256): how often which levels meet in a pixel, of those that are not clipped."""
    counts = []
    for first, second in pairwise(planes):
        joint = np.bincount(first.ravel().astype(np.int64) * 256 + second.ravel(), minlength=1 << 16)
        count = joint.reshape(256, 256).astype(np.float64)
        count[:_LOW], count[_HIGH + 1 :], count[:, :_LOW], count[:, _HIGH + 1 :] = 0, 0, 0, 0
        counts.append(count)
    return counts


def _log_response(counts: Sequence[Array], exposures: Sequence[float]) -> Array:
    """log irradiance g of the levels that are not clipped, up to a constant.

    Minimises the sum over pixels of rho((g(z_a) - g(z_b) - log(t_a / t_b)) / sigma), plus the curvature of g, where
    sigma is the noise of both levels times the slope of g; rho is Huber's.
    """
    size = _HIGH + 1 - _LOW
    rows, columns, weights, changes = [], [], [], []
    for count, (first, second) in zip(counts, pairwise(exposures), strict=True):
        a, b = np.nonzero(count)
        rows.append(a - _LOW)
        columns.append(b - _LOW)
        # Equal total weight of all pairs: dark exposures of a dark scene have few pixels, and the upper levels.
        weights.append(count[a, b] / max(count.sum(), 1.0))
        changes.append(np.full(len(a), np.log(first / second)))
    a, b, n, change = (np.concatenate(part) for part in (rows, columns, weights, changes))
    n *= size / n.sum()
    g = np.log(Response.srgb().inverse(np.arange(_LOW, _HIGH + 1) / 255))
    stiffness = _stiffness()
    for _ in range(_FITS):
        slope = np.maximum(np.gradient(g), 1e-4)
        sigma = np.sqrt((slope[a] ** 2 + slope[b] ** 2) * _FIT_NOISE**2 + LEAST_SPREAD**2)
        residual = np.abs(g[a] - g[b] - change) / sigma
        w = n * np.minimum(1.0, 1.5 / np.maximum(residual, 1e-9)) / sigma**2
        normal = np.zeros((size, size))
        for i, j, sign in ((a, a, 1.0), (b, b, 1.0), (a, b, -1.0), (b, a, -1.0)):
            np.add.at(normal, (i, j), sign * w)
        right = np.zeros(size)
        np.add.at(right, a, w * change)
        np.add.at(right, b, -w * change)
        normal += stiffness
        normal[128 - _LOW, 128 - _LOW] += 1.0  # the constant
        g = _increasing(np.linalg.solve(normal, right))
    return g


def _stiffness() -> Array:
    """The quadratic form of the curvature of g over the logarithm of the level, in which power laws are straight.

    Exposures with equal ratios leave every ripple of that period in g undetermined; only this decides there.
    """
    level = np.arange(_LOW + 1, _HIGH, dtype=np.float64)
    size, row = _HIGH + 1 - _LOW, np.arange(len(level))
    bend = np.zeros((len(level), size))
    bend[row, row], bend[row, row + 1], bend[row, row + 2] = (
        level**2 - level / 2,
        -2 * level**2,
        level**2 + level / 2,
    )
    return _STIFFNESS * (bend.T / level) @ bend


def _increasing(g: NDArray[Any]) -> Array:
    """The nearest curve whose neighbouring levels differ by at least a tenth of the mean step."""
    step = 0.1 * (g[-1] - g[0]) / len(g)
    ramp = step * np.arange(len(g))
    return np.asarray(isotonic_regression(g - ramp).x + ramp, np.float64)


def _extended(g: Array) -> Response:
    """A response from the logarithm of the irradiance of the levels that are not clipped."""
    inner = np.exp(g)
    slope = (inner[-1] - inner[-11]) / 10
    irradiance = np.empty(256)
    irradiance[_LOW : _HIGH + 1] = inner
    irradiance[_HIGH + 1 :] = inner[-1] + slope * np.arange(1, 256 - _HIGH)
    irradiance[: _LOW + 1] = inner[0] * np.arange(_LOW + 1) / _LOW
    return Response.tabulated(irradiance)
