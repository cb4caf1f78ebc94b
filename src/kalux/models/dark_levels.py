"""What dark levels of noisy frames say of log(I + I_0), so that a mean of many frames is right (docs/equations.md, K3).

The logarithm of a dark pixel's own value is wrong in the mean: noise below black reads 0, the logarithm bends, and R
(9) trusts a frame more the brighter its noise was. So a level b is taken for log(b + I_0) + d(b), with the d for which
the weighted mean of the levels that an intensity gives is log(I + I_0).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.models.camera import frame_log_covariance, log_intensity, noise_variance

Array = NDArray[np.float64]

_REACH: Final = 8.0
"""Standard deviations of the noise from black up to which d is sought: beyond, the mean is less than 2 % off."""

_TAPER: Final = 2.0
"""Standard deviations over which d then goes to 0."""

_BEYOND: Final = 4.0
"""Standard deviations beyond `_REACH` of levels that intensities up to there give."""

_FRAMES: Final = 10.0
"""Frames of which the mean is to be right: d trades what is left of its error against its noise, since what is wrong of
levels that are hidden below black takes ever larger d. With 5, 10 and 20, log-MSE of six dark scenes is 0.93, 0.94,
0.95 forward and 0.94, 0.93, 0.93 both ways of that without."""

_LEAST_NOISE: Final = 0.5
"""Of the distance of two levels: with less noise most frames show a pixel at the same level, and there is no mean."""

_PER_DEVIATION: Final = 4
"""Levels per standard deviation that are looked at, where frames have more."""

_INTENSITIES: Final = 200
"""At which the mean is to be right."""


_HIDDEN: Final = 4.0
"""Noise in units of I_0 from which that is told: up to here the mean of black is wrong by 0.7 at most, and rms z of 57
scenes, whose noise is less, is no nearer to 1 with it (docs/equations.md, K11)."""

_HIDES: Final = 4.0
"""Standard deviations of the noise from black up to which means are wrong."""

_SEEN: Final = 4.0
"""Frames of which the mean is compared: the filter soon forgets those before."""

_SHOWN: Final = 65
"""Intensities at which that is told."""


def dark_correction(
    intensity: Array, noise: tuple[float, float], white: float, log_offset: float, gap: float
) -> Array:
    """(N,) d of levels, which is added to their log(I + I_0); 0 where they are not dark.

    Parameters
    ----------
    intensity
        (N,) I of the levels.
    noise
        (read, shot) as of `noise_variance`, rounding included.
    white
        Intensity of a saturated pixel.
    log_offset
        I_0.
    gap
        Between the intensities of two successive levels; 0: of floating point.
    """
    levels, added = _correction(noise, log_offset / white, gap / white)
    return np.asarray(np.interp(np.maximum(intensity, 0.0) / white, levels, added), np.float64)


class DarkDoubt(NamedTuple):
    """By how much the mean of many frames may be wrong where it is dark.

    Attributes
    ----------
    spacing
        Of the intensities I at which it is told, from 0 on; white = 1.
    variances
        (M,) of log(I + I_0), to be added to what frames and events leave; 0 from the last one on.
    """

    spacing: float
    variances: NDArray[np.float32]


@lru_cache(maxsize=64)
def dark_doubt(noise: tuple[float, float], log_offset: float, gap: float) -> DarkDoubt | None:
    """What d leaves wrong of the mean of frames, by the intensity that it shows (K11); None: hardly anything.

    Intensities that noise hides below black have nearly the same mean. In log(I + I_0) all are taken to be as likely.

    Parameters
    ----------
    noise
        (read, shot), rounding included; white = 1.
    log_offset, gap
        As of `dark_correction`, white = 1.
    """
    read = _without_rounding(noise[0], gap)
    levels, added = _correction(noise, log_offset, gap)
    if len(levels) == 1 or read < _HIDDEN * log_offset:
        return None
    intensity = np.geomspace(log_offset, _HIDES * read + log_offset, _INTENSITIES) - log_offset
    weights = _weights(intensity, levels, noise, log_offset, gap)
    total = weights.sum(axis=1)
    mean = weights @ (log_intensity(levels, log_offset) + added) / total
    wrong = np.square(mean - log_intensity(intensity, log_offset))
    shown = np.linspace(0.0, _HIDES * read, _SHOWN)
    away = np.square(log_intensity(shown, log_offset)[:, None] - mean) * total * _SEEN
    likely = np.exp(-0.5 * (away - away.min(axis=1, keepdims=True))) * np.sqrt(total)
    variances = (likely @ wrong) / likely.sum(axis=1)
    variances[-1] = 0.0
    return DarkDoubt(_HIDES * read / (_SHOWN - 1), variances.astype(np.float32))


def _without_rounding(deviation: float, gap: float) -> float:
    """The noise that is not the rounding of levels a ``gap`` apart."""
    return float(np.sqrt(max(deviation**2 - gap**2 / 12.0, 0.0)))


@lru_cache(maxsize=64)
def _correction(noise: tuple[float, float], log_offset: float, gap: float) -> tuple[Array, Array]:
    """Levels, white = 1, and their d: 0 where there is no noise to correct for."""
    read = _without_rounding(noise[0], gap)
    if read == 0.0 or read < _LEAST_NOISE * gap:
        return np.zeros(1), np.zeros(1)
    step = gap * max(1, int(read / (_PER_DEVIATION * gap))) if gap > 0 else read / _PER_DEVIATION
    levels = np.asarray(np.arange(int((_REACH + _BEYOND) * read / step) + 1) * step, np.float64)
    intensity = np.linspace(0.0, _REACH * read, _INTENSITIES, dtype=np.float64)
    told, wanted = log_intensity(levels, log_offset), log_intensity(intensity, log_offset)
    share = _weights(intensity, levels, noise, log_offset, gap)
    share /= share.sum(axis=1, keepdims=True)
    # The sum over intensities of the squared error of the mean and of its variance is least.
    mean = share.T @ share
    normal = mean + (np.diag(share.sum(axis=0)) - mean) / _FRAMES
    added = np.linalg.solve(normal, share.T @ wanted - normal @ told)
    return levels, np.asarray(added * np.clip((_REACH * read - levels) / (_TAPER * read), 0.0, 1.0))


def _weights(
    intensity: Array, levels: Array, noise: tuple[float, float], log_offset: float, gap: float
) -> Array:
    """(M, N) probabilities that an intensity of M reads each level of N, times how much that counts; white = 1."""
    own = _without_rounding(noise[0], gap), noise[1]
    share = _shares(intensity, levels, np.sqrt(noise_variance(intensity, own, 1.0)))
    share /= frame_log_covariance(levels, np.ones(len(levels)), noise, 1.0, log_offset)
    return share


def _shares(intensity: Array, levels: Array, deviation: Array) -> Array:
    """(M, N) probability that an intensity of M, with noise of its standard deviation, reads each level of N.

    All that is less reads the first.
    """
    from scipy.special import ndtr  # a fifth of what it takes to import kalux, and only noisy frames need it

    edges = np.concatenate([[-np.inf], (levels[1:] + levels[:-1]) / 2.0, [np.inf]])
    return np.diff(ndtr((edges - intensity[:, None]) / deviation[:, None]), axis=1)
