"""Gains of a camera whose gain is never steady, from what each frame shows beyond the events since the one before.

Steps have errors, and gains that are added up from them drift with time. But a camera's gain stays about where it is:
with a normal prior of gains about their mean, whose variance the steps themselves tell, what is left is the most
probable gain of each frame (a posteriori).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

Array = NDArray[np.float64]

_WALK: Final = 6.0
"""Sums of n independent errors, about their mean, have on average n/6 of the variance of one."""

_LEAST_SPREAD: Final = 0.01
"""Standard deviation of log gains that is assumed at least."""


def likely_log_gains(steps: Array, errors: Array) -> Array:
    """The most probable log gain of each frame; their mean is about 0.

    Parameters
    ----------
    steps
        (K - 1,) of the log gain from each frame to the next, log intensity; what is not known is 0, with
    errors
        (K - 1,) standard errors, above 0: infinite where a step is not known.

    Returns
    -------
    Array
        (K,): the solution of (1 / S^2 + D' W D) g = D' W d with the steps d, the differences D between frames,
        weights W of one over the squared errors, and S, the gains' standard deviation.
    """
    weights = 1.0 / np.square(errors)
    matrix = np.zeros((2, len(steps) + 1))  # the diagonal, and the one beside it
    matrix[0] = 1.0 / _variance(steps, errors)
    matrix[0, :-1] += weights
    matrix[0, 1:] += weights
    matrix[1, :-1] = -weights
    pulls = np.zeros(len(steps) + 1)
    pulls[:-1] -= weights * steps
    pulls[1:] += weights * steps
    return np.asarray(solveh_banded(matrix, pulls, lower=True), np.float64)


def _variance(steps: Array, errors: Array) -> float:
    """Of log gains: that of the added up steps less what errors make of it, or what steps of unrelated gains have."""
    known = np.isfinite(errors)
    squares = np.square(errors[known])
    added_up = float(np.var(np.cumsum([0.0, *steps]))) - float(squares.sum()) / _WALK
    unrelated = 0.5 * float((np.square(steps[known]) - squares).mean()) if known.any() else 0.0
    return max(added_up, unrelated, _LEAST_SPREAD**2)
