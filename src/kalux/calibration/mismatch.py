"""By how much the contrast threshold differs between a recording's pixels.

A pixel's own threshold is wrong in every interval between two frames, while frame noise, single steps and what events
have not told yet are new in each. So the products of what a pixel's events and frames disagree about in *different*
intervals are on average that of the threshold alone, without a model of the rest. Neighbouring intervals have a frame
in common and are left out.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.deblur import between
from kalux.calibration.intervals import intervals
from kalux.calibration.refractory import Counts
from kalux.models.camera import noise_variance
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings

Array = NDArray[np.float64]


SPREADS: Final = (0.02, 0.1)
"""What is believed: the 2 to 10 % of data sheets and the literature. What looks like more has other reasons (noise
events, an edge that outruns the pixel), and calibrating pixels more freely for these costs (docs/tuning.md)."""

MAX_SAMPLES: Final = 1_000_000
_MAX_FRAMES: Final = 80
_DARKEST: Final = 0.01  # as for I_0: below, a frame's log is rounding
_CLIP: Final = 3.0  # standard deviations of a mismatch: flicker and occlusions say nothing of thresholds
_BLOCKS: Final = 8  # of the sensor, either way, for the standard error


class Mismatch(NamedTuple):
    """What a recording says of its pixels' thresholds.

    Attributes
    ----------
    spread
        Relative standard deviation between pixels, of on and off thresholds alike: within `SPREADS`.
    variance, error
        Its square as measured, which noise may make negative, and the standard error of that.
    samples
        Pixels and frame intervals used.
    """

    spread: float
    variance: float
    error: float
    samples: int


def estimate_mismatch(recording: Recording, camera: CameraSettings, events: EventSettings) -> Mismatch | None:
    """Spread of the contrast thresholds between pixels, from the first 80 frames.

    With m the mismatch of a frame interval (docs/equations.md, K1), n its weighed events of one polarity, c their
    threshold and w = 1 / Var m, the sum over pairs of intervals j, k at least two apart of w_j m_j c n_j w_k m_k c n_k
    is on average the squared spread times that of w_j w_k c n_j c n_k (c n_j c n_k + c' n'_j c' n'_k), primes for the
    other polarity. What is measured is drawn towards the usual spread as far as it is uncertain.

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response, saturation, I_0 and frame noise.
    events
        With both thresholds.

    Returns None where no pixel has events in two intervals that tell.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    assert events.threshold_on is not None
    assert events.threshold_off is not None
    thresholds = np.array([events.threshold_on, events.threshold_off])
    noise = (max(camera.noise[0], camera.usual_frame_noise), camera.noise[1])
    counts = Counts(recording.sensor_size, (events.refractory,), np.inf)
    delay = events.lateness
    products: Array = np.zeros((*recording.sensor_size, *_PRODUCTS))
    samples = 0
    for interval in intervals(recording, camera, margin=abs(delay), most_frames=_MAX_FRAMES):
        weighed, _ = counts.add(between(interval.events, interval.start + delay, interval.end + delay))
        first, second = interval.first, interval.second
        told = ~first.clipped & ~second.clipped & (np.minimum(first.intensity, second.intensity) > _DARKEST)
        variance = sum(
            noise_variance(shot.intensity, noise, 1.0) / (shot.intensity + camera.offset) ** 2
            for shot in (first, second)
        )
        change = np.log(second.intensity + camera.offset) - np.log(first.intensity + camera.offset)
        steps = thresholds[:, None, None] * weighed[0]
        of_steps = events.step_noise, events.quantisation_variance, events.usual_threshold_spread
        samples += _add(change, variance, told, steps, thresholds, of_steps, products)
        if samples >= MAX_SAMPLES:
            break
    return _solved(products, samples, events.usual_threshold_spread)


_PRODUCTS: Final = (2, 3, 3)
"""Per pixel and polarity, of w m c n, w (c n)^2 and w c n c' n': sum, the last one, and the sum of the squares and of
twice the products of neighbouring intervals."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _add(change, variance, told, steps, thresholds, of_steps, products):  # type: ignore[no-untyped-def]
    """One interval; how many pixels it tells of."""
    step_variance, quantisation, spread = of_steps
    threshold2 = thresholds[0] * thresholds[1]
    samples = 0
    for row in range(change.shape[0]):
        for column in range(change.shape[1]):
            on, off = steps[0, row, column], steps[1, row, column]
            known = told[row, column] and on + off > 0.0
            samples += known
            count = on / thresholds[0] + off / thresholds[1]
            total = variance[row, column] + threshold2 * (step_variance * count + quantisation)
            total += spread * spread * (on * on + off * off)
            most = _CLIP * np.sqrt(total)
            mismatch = min(max(change[row, column] - (on - off), -most), most)
            weight = 1.0 / total if known else 0.0
            for polarity in range(2):
                own, other = (on, off) if polarity == 0 else (-off, -on)
                values = weight * mismatch * own, weight * own * own, weight * own * other
                for k in range(3):
                    pixel = products[row, column, polarity, k]
                    pixel[2] += values[k] * (values[k] + 2.0 * pixel[1])
                    pixel[0] += values[k]
                    pixel[1] = values[k]
    return samples


def _solved(products: Array, samples: int, usual: float) -> Mismatch | None:
    apart = (products[..., 0] ** 2 - products[..., 2]).sum(axis=2)
    found, possible = apart[..., 0], apart[..., 1] + apart[..., 2]
    if not possible.sum() > 0:
        return None
    variance = float(found.sum() / possible.sum())
    error = _jackknifed(found, possible)
    prior = usual**2
    trust = prior**2 / (prior**2 + error**2)
    spread = np.sqrt(max(prior + trust * (variance - prior), 0.0))
    return Mismatch(float(np.clip(spread, *SPREADS)), variance, error, samples)


def _jackknifed(found: Array, possible: Array) -> float:
    """Standard error of the ratio of the sums, over blocks of the sensor."""
    height, width = found.shape
    block = (np.arange(height)[:, None] * _BLOCKS // height) * _BLOCKS + np.arange(width) * _BLOCKS // width
    sums = [np.bincount(block.ravel(), values.ravel()) for values in (found, possible)]
    rest = [values.sum() - values for values in sums]
    kept = rest[1] > 0
    n = int(kept.sum())
    return float(np.sqrt((n - 1) * np.var(rest[0][kept] / rest[1][kept]))) if n > 1 else float("inf")
