"""Is a method as sure as it ought to be? Errors of log(I + I_0) against the standard deviations it gives.

With e the error and sigma the given standard deviation, z = e / sigma of a calibrated method has unit variance; if
its errors are Gaussian, |z| < 1 for 68.3 % of the pixels. Where the reference has noise of its own, as a held-out frame
has, its variance is added to that which the method gives: e is the error of both.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from kalux.evaluation.pairs import Pair

LEVELS: Final = np.array([*np.arange(0.05, 0.96, 0.05), 0.99])
"""Shares of errors that bands around the estimate are to hold."""

ONE_SIGMA: Final = float(stats.norm.cdf(1) - stats.norm.cdf(-1))

_MEDIAN: Final = float(stats.norm.ppf(0.75))
"""Of |z| of Gaussian errors."""

_WIDTHS: Final = np.concatenate([stats.norm.ppf((1 + LEVELS) / 2), np.geomspace(3.0, 3e6, 150)])
"""Half widths of bands, in standard deviations: first those that are to hold `LEVELS`; the others are there for the
median of methods that are far too sure."""
_EDGES: Final = np.geomspace(1e-3, 1e1, 25)
"""Of the classes of the given standard deviation: six a decade."""


class Calibration:
    """Collects the errors of some pixels, and says what they amount to.

    Parameters
    ----------
    log_offset
        I_0 of the method.
    """

    def __init__(self, log_offset: float) -> None:
        self._offset = log_offset
        self._pixels = self._unusable = self._within_one = 0
        self._within = np.zeros(len(_WIDTHS), np.int64)
        self._sum_z2 = self._sum_error2 = self._sum_variance = 0.0
        self._class_count = np.zeros(len(_EDGES) + 1, np.int64)
        self._class_error2 = np.zeros(len(_EDGES) + 1)

    def add(
        self,
        test: NDArray[Any],
        reference: NDArray[Any],
        variance: NDArray[Any],
        counted: NDArray[np.bool_],
    ) -> None:
        """Add the counted pixels of one image.

        Parameters
        ----------
        test, reference
            (H, W) linear intensity; negative counts as 0.
        variance
            (H, W) of log(test + I_0). What is not finite or not positive is counted, and left out.
        counted
            (H, W) bool.
        """
        given = np.asarray(variance, np.float64)
        usable = counted & np.isfinite(given) & (given > 0)
        self._unusable += int(np.count_nonzero(counted & ~usable))
        error = _log(test[usable], self._offset) - _log(reference[usable], self._offset)
        sigma = np.sqrt(given[usable])
        z = np.abs(error) / sigma
        self._pixels += len(z)
        self._within_one += int(np.count_nonzero(z <= 1))
        self._within += np.searchsorted(np.sort(z), _WIDTHS, side="right")
        self._sum_z2 += float(np.sum(z**2))
        self._sum_error2 += float(np.sum(error**2))
        self._sum_variance += float(np.sum(sigma**2))
        place = np.searchsorted(_EDGES, sigma)
        self._class_count += np.bincount(place, minlength=len(_EDGES) + 1)
        self._class_error2 += np.bincount(place, error**2, minlength=len(_EDGES) + 1)

    def found(self) -> dict[str, Any] | None:
        """What was found, as plain values; None: no pixel has a variance.

        Keys: ``pixels`` and ``unusable`` (without a finite, positive variance); ``one_sigma``, the share of errors
        within one standard deviation; ``rms_z``, and ``median_z``, the median of |z| over that of Gaussian errors,
        0.674 (interpolated between bands); ``rms_error`` and ``rms_sigma``; ``coverage``, lists of
        ``nominal`` and ``observed`` shares; ``by_sigma``, for classes of the given standard deviation with at least
        100 pixels: ``sigma`` (middle of the class), ``rms_error``, ``pixels``.
        """
        if self._pixels == 0:
            return None
        n = self._pixels
        middles = np.sqrt(_EDGES[1:] * _EDGES[:-1])
        count, error2 = self._class_count[1:-1], self._class_error2[1:-1]
        many = count >= 100
        observed = self._within / n
        return {
            "pixels": n,
            "unusable": self._unusable,
            "one_sigma": self._within_one / n,
            "rms_z": float(np.sqrt(self._sum_z2 / n)),
            "median_z": float(np.interp(0.5, [0.0, *observed], [0.0, *_WIDTHS])) / _MEDIAN,
            "rms_error": float(np.sqrt(self._sum_error2 / n)),
            "rms_sigma": float(np.sqrt(self._sum_variance / n)),
            "coverage": {"nominal": LEVELS.round(2).tolist(), "observed": observed[: len(LEVELS)].tolist()},
            "by_sigma": {
                "sigma": middles[many].tolist(),
                "rms_error": np.sqrt(error2[many] / count[many]).tolist(),
                "pixels": count[many].tolist(),
            },
        }


class Calibrations:
    """`Calibration` of all pixels of a comparison, and of those up to and beyond white.

    All images that are added have the same I_0.
    """

    def __init__(self) -> None:
        self._log_offset = 0.0
        self._parts: dict[str, Calibration] = {}

    def add(self, pair: Pair) -> None:
        """Add an image; pixels whose reference is itself clipped, or was given to the method, are left out."""
        if pair.variance is None:
            return
        if not self._parts:
            self._log_offset = pair.log_offset
            self._parts = {
                name: Calibration(pair.log_offset) for name in ("all", "up_to_white", "beyond_white")
            }
        counted = np.ones(np.shape(pair.test), bool) if pair.mask is None else pair.mask
        if pair.clipped is not None:
            counted = counted & ~pair.clipped
        if pair.given is not None:
            counted = counted & ~pair.given
        variance = np.asarray(pair.variance, np.float64)
        if pair.noise is not None:
            variance = variance + np.where(variance > 0, pair.noise, 0.0)
        bright = np.asarray(pair.reference) > 1
        for name, part in (("all", counted), ("up_to_white", ~bright), ("beyond_white", bright)):
            self._parts[name].add(pair.test, pair.reference, variance, counted & part)

    def found(self) -> dict[str, Any] | None:
        """``log_offset``, and for each part what `Calibration.found` says; None: no pixel has a variance."""
        parts = {name: part.found() for name, part in self._parts.items()}
        return None if parts.get("all") is None else {"log_offset": self._log_offset, **parts}


def _log(intensity: NDArray[Any], offset: float) -> NDArray[np.float64]:
    return np.log(np.maximum(np.asarray(intensity, np.float64), 0.0) + offset)
