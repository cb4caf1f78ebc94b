"""What dark levels of noisy frames say of log(I + I_0), so that a mean of many frames is right (docs/equations.md, K3).

The logarithm of a dark pixel's own value is wrong in the mean: noise below black reads 0, the logarithm bends, and R
(9) trusts a frame more the brighter its noise was. So a level b is taken for log(b + I_0) + d(b), with the d for which
the weighted mean of the levels that an intensity gives is log(I + I_0). No d does that for all intensities, since those
that noise hides below black read the same: those that frames show most count most.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.errors import SettingsError
from kalux.models.camera import frame_log_covariance, log_intensity, noise_variance
from kalux.models.stated import stated_numbers
from kalux.settings import AUTO, EVEN

Array = NDArray[np.float64]

_REACH: Final = 8.0
"""Standard deviations of the noise from black up to which d is sought: beyond, the mean is less than 2 % off."""

_TAPER: Final = 2.0
"""Standard deviations over which d then goes to 0."""

_BEYOND: Final = 4.0
"""Standard deviations beyond `_REACH` of levels that intensities up to there give."""

_FRAMES: Final = 10.0
"""Frames of which the mean is to be right: d trades what is left of its error against its noise, since what is wrong of
levels that are hidden below black takes ever larger d. With 5, 10 and 25, log-MSE of 19 noisy pans is 0.972, 0.975 and
0.985 forward, 0.970, 0.963 and 0.967 both ways, of that with even light and without `_EVENTS` (docs/equations.md, K3).
"""

_EVENTS: Final = 0.03
"""Variance of log(I + I_0) that all frames have in common, of what events add to them: without it, frames in which the
noise was dark seem to count less than they do. With 0, 0.03, 0.06 and 0.1, log-MSE of these pans is 0.986, 0.975, 0.974
and 0.977 forward, 0.986, 0.963, 0.962 and 0.969 both ways, and MSE 0.997, 1.003, 1.006 and 1.008 forward. Of still
pixels 0 is as good or better, by up to 3 %."""

_LEAST_NOISE: Final = 0.5
"""Of the distance of two levels: with less noise most frames show a pixel at the same level, and there is no mean."""

_PER_DEVIATION: Final = 4
"""Levels per standard deviation that are looked at, where frames have more."""

_INTENSITIES: Final = 200
"""At which the mean is to be right, where nothing says which of them frames show."""

LIGHT_EDGES: Final = (0.0, 0.125, 0.375, 0.75, 1.25, 1.75, 2.5, 4.0, 6.5, 10.0, 14.0)
"""Of the parts of the dark of which it is told how often frames show them, in standard deviations of its noise: as wide
as noise lets them be told apart."""

_WITHIN: Final = 8
"""Intensities of a part, which are as likely."""

_PARTS: Final = len(LIGHT_EDGES) - 1
EVEN_SHARES: Final = np.diff(LIGHT_EDGES) / LIGHT_EDGES[-1]
"""Shares of the parts where all intensities are as likely."""

_EVEN: Final = 0.2
"""Part of the shares that is even all the same, since scenes change and levels that nothing reads have no mean. With
0.1, 0.2 and 0.4, the cost of d on 18 noisy and 16 night scenes is 0.884, 0.888 and 0.896 of that with even light; with
the true light, as finely as it can be told, 0.762."""

_MOST: Final = 1e6  # a share, in any unit: their sum is a number

_HIDDEN: Final = 4.0
"""Noise in units of I_0 from which it is told what d leaves wrong: up to here the mean of black is wrong by 0.7 at
most, and rms z of 57 scenes, whose noise is less, is no nearer to 1 with it (docs/equations.md, K11)."""

_HIDES: Final = 4.0
"""Standard deviations of the noise from black up to which means are wrong."""

_SEEN: Final = 4.0
"""Frames of which the mean is compared: the filter soon forgets those before."""

_SHOWN: Final = 65
"""Intensities at which it is told."""

Shares = tuple[float, ...]
"""How often frames show each part of `LIGHT_EDGES`, in any unit."""


def dark_shares(text: str) -> Shares | None:
    """Shares of the parts of `LIGHT_EDGES` from a setting, numbers with spaces between; None: ``"auto"``, ``"even"``.

    Raises
    ------
    SettingsError
        If it is none of these.
    """
    if text in (AUTO, EVEN):
        return None
    shares = stated_numbers(text, _PARTS, _MOST)
    if shares is None or not sum(shares) > 0:
        raise SettingsError(
            f"dark_shares: {text!r} is neither {AUTO}, {EVEN} nor {_PARTS} numbers from 0 to {_MOST:g}, not all of "
            "them 0"
        )
    return shares


def dark_correction(
    intensity: Array,
    noise: tuple[float, float],
    white: float,
    log_offset: float,
    gap: float,
    shares: Shares | None = None,
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
    shares
        How often frames show each part of `LIGHT_EDGES`; None: all light up to 8 deviations alike.
    """
    levels, added = _correction(noise, log_offset / white, gap / white, shares)
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
def dark_doubt(
    noise: tuple[float, float], log_offset: float, gap: float, shares: Shares | None = None
) -> DarkDoubt | None:
    """What d leaves wrong of the mean of frames, by the intensity that it shows (K11); None: hardly anything.

    Intensities that noise hides below black have nearly the same mean. Where nothing says which of them frames show,
    all are as likely in log(I + I_0).

    Parameters
    ----------
    noise
        (read, shot), rounding included; white = 1.
    log_offset, gap, shares
        As of `dark_correction`, white = 1.
    """
    read = without_rounding(noise[0], gap)
    levels, added = _correction(noise, log_offset, gap, shares)
    if len(levels) == 1 or read < _HIDDEN * log_offset:
        return None
    even = np.geomspace(log_offset, _HIDES * read + log_offset, _INTENSITIES) - log_offset
    intensity, often = _light(read, shares, even)
    weights = _weights(intensity, levels, noise, log_offset, gap)
    total = weights.sum(axis=1)
    mean = weights @ (log_intensity(levels, log_offset) + added) / total
    wrong = np.square(mean - log_intensity(intensity, log_offset))
    shown = np.linspace(0.0, _HIDES * read, _SHOWN)
    away = np.square(log_intensity(shown, log_offset)[:, None] - mean) * total * _SEEN
    likely = np.exp(-0.5 * (away - away.min(axis=1, keepdims=True))) * np.sqrt(total) * often
    variances = (likely @ wrong) / likely.sum(axis=1)
    variances[-1] = 0.0
    return DarkDoubt(_HIDES * read / (_SHOWN - 1), variances.astype(np.float32))


def without_rounding(deviation: float, gap: float) -> float:
    """The noise that is not the rounding of levels a ``gap`` apart."""
    return float(np.sqrt(max(deviation**2 - gap**2 / 12.0, 0.0)))


def noisy_levels(read: float, gap: float, reach: float) -> Array:
    """(N,) levels from 0 to ``reach`` deviations; none where noise leaves most frames at the same level.

    Of levels a ``gap`` apart, 0 of floating point, no more than four a deviation.
    """
    if read == 0.0 or read < _LEAST_NOISE * gap:
        return np.zeros(0)
    step = gap * max(1, int(read / (_PER_DEVIATION * gap))) if gap > 0 else read / _PER_DEVIATION
    return np.asarray(np.arange(int(reach * read / step) + 1) * step, np.float64)


def light_of_parts(read: float) -> Array:
    """(parts, 8) intensities within the parts of `LIGHT_EDGES`, the first of which begin with black."""
    light = np.linspace(LIGHT_EDGES[:-1], LIGHT_EDGES[1:], 2 * _WITHIN + 1, axis=1)[:, 1::2]
    light[0] = np.linspace(LIGHT_EDGES[0], LIGHT_EDGES[1], _WITHIN)
    return np.asarray(read * light, np.float64)


def _light(read: float, shares: Shares | None, even: Array) -> tuple[Array, Array]:
    """(M,) intensities, white = 1, and how often frames show each; where that is not known the ``even`` ones."""
    if shares is None:
        return even, np.full(len(even), 1.0 / len(even))
    often = (1.0 - _EVEN) * np.array(shares) / np.sum(shares) + _EVEN * EVEN_SHARES
    return light_of_parts(read).ravel(), np.repeat(often / _WITHIN, _WITHIN)


@lru_cache(maxsize=64)
def _correction(
    noise: tuple[float, float], log_offset: float, gap: float, shares: Shares | None
) -> tuple[Array, Array]:
    """Levels, white = 1, and their d: 0 where there is no noise to correct for."""
    read = without_rounding(noise[0], gap)
    levels = noisy_levels(read, gap, _REACH + _BEYOND)
    if len(levels) == 0:
        return np.zeros(1), np.zeros(1)
    intensity, often = _light(read, shares, np.linspace(0.0, _REACH * read, _INTENSITIES, dtype=np.float64))
    told, wanted = log_intensity(levels, log_offset), log_intensity(intensity, log_offset)
    share = _weights(intensity, levels, noise, log_offset, gap)
    share /= share.sum(axis=1, keepdims=True)
    # The sum over intensities of the squared error of the mean and of its variance is least.
    mean = share.T @ (often[:, None] * share)
    normal = mean + (np.diag(often @ share) - mean) / _FRAMES
    added = np.linalg.solve(normal, share.T @ (often * wanted) - normal @ told)
    return levels, np.asarray(added * np.clip((_REACH * read - levels) / (_TAPER * read), 0.0, 1.0))


def _weights(
    intensity: Array, levels: Array, noise: tuple[float, float], log_offset: float, gap: float
) -> Array:
    """(M, N) probabilities that an intensity of M reads each level of N, times how much that counts; white = 1."""
    own = without_rounding(noise[0], gap), noise[1]
    share = level_shares(intensity, levels, np.sqrt(noise_variance(intensity, own, 1.0)))
    share /= _EVENTS + frame_log_covariance(levels, np.ones(len(levels)), noise, 1.0, log_offset)
    return share


def level_shares(intensity: Array, levels: Array, deviation: Array) -> Array:
    """(M, N) probability that an intensity of M, with noise of its standard deviation, reads each level of N.

    All that is less reads the first.
    """
    from scipy.special import ndtr  # a fifth of what it takes to import kalux, and only noisy frames need it

    edges = np.concatenate([[-np.inf], (levels[1:] + levels[:-1]) / 2.0, [np.inf]])
    return np.diff(ndtr((edges - intensity[:, None]) / deviation[:, None]), axis=1)
