"""By how much the contrast threshold differs between a recording's pixels.

The mismatch of a pixel's events and frames has many causes. The deviation of its threshold is the same in all frame
intervals, while frame noise, the noise of single steps and changes below the threshold are independent. So the mean
product of the mismatches of two *different* intervals is due to the threshold alone, and no model of the rest is
needed. Neighbouring intervals have a frame, and its noise, in common and are left out.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.event_model import DARKEST, ErrorModel, Samples, mismatch_of
from kalux.calibration.intervals import counted_intervals
from kalux.calibration.regression import parts, ratio_error
from kalux.compiled import larger, loop, smaller
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings

Array = NDArray[np.float64]


SPREADS: Final = (0.02, 0.2)
"""What is believed: from 2 %, the best of data sheets, to somewhat more than the 17.5 % of a DAVIS240C (3.5 % contrast
at a threshold of 0.2). What looks like more has other reasons: frames beside the events, or events that are missing."""

_CERTAIN: Final = 4.0
"""Standard errors by which the variance must exceed the usual one to count: moving fine texture makes it too large by
up to as many, 0.033 +- 0.006 and 0.037 +- 0.007 in two noisy scenes of 0.01."""

MAX_SAMPLES: Final = 1_000_000
_MAX_FRAMES: Final = 80
_CLIP: Final = 3.0  # standard deviations of a mismatch: flicker and occlusions say nothing of thresholds


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
    other polarity. What is measured is drawn towards the usual spread as far as it is uncertain, and exceeds that only
    as far as it is certain.

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
    threshold_on, threshold_off = events.thresholds
    model = ErrorModel(
        events.thresholds,
        camera.noise,
        events.usual_threshold_spread,
        events.quantisation_variance,
    )
    products: Array = np.zeros((*recording.sensor_size, *_PRODUCTS))
    samples = 0
    for interval, on, off, bend in counted_intervals(recording, camera, events, most_frames=_MAX_FRAMES):
        first, second = interval.ends
        seen = Samples(first.intensity, second.intensity, on, off, bend)
        bright = np.minimum(seen.before, seen.after) > DARKEST
        usable = ~first.shot.clipped & ~second.shot.clipped & bright & (on + off > 0)
        mismatch, variance = mismatch_of(seen, model, camera.offset, events.step_noise)
        _add(mismatch, variance, usable, threshold_on * on, threshold_off * off, products)
        samples += int(np.count_nonzero(usable))
        if samples >= MAX_SAMPLES:
            break
    return _solved(products, samples, events.usual_threshold_spread)


_PRODUCTS: Final = (2, 3, 3)
"""Per pixel and polarity, of w m c n, w (c n)^2 and w c n c' n': sum, the last one, and the sum of the squares and of
twice the products of neighbouring intervals."""


@loop
def _add(mismatches, variances, usable, steps_on, steps_off, products):  # type: ignore[no-untyped-def]
    """Add one interval to the sums of `_PRODUCTS`, in place."""
    for row in range(usable.shape[0]):
        for column in range(usable.shape[1]):
            i = row, column
            on, off = steps_on[i], steps_off[i]
            most = _CLIP * np.sqrt(variances[i])
            mismatch = smaller(larger(mismatches[i], -most), most)
            weight = 1.0 / variances[i] if usable[i] else 0.0
            for polarity in range(2):
                own, other = (on, off) if polarity == 0 else (-off, -on)
                values = weight * mismatch * own, weight * own * own, weight * own * other
                for k in range(3):
                    pixel = products[row, column, polarity, k]
                    pixel[2] += values[k] * (values[k] + 2.0 * pixel[1])
                    pixel[0] += values[k]
                    pixel[1] = values[k]


def _solved(products: Array, samples: int, usual: float) -> Mismatch | None:
    apart = (products[..., 0] ** 2 - products[..., 2]).sum(axis=2)
    found, possible = apart[..., 0], apart[..., 1] + apart[..., 2]
    if not possible.sum() > 0:
        return None
    variance = float(found.sum() / possible.sum())
    part = parts(found.shape).ravel()
    error = ratio_error(np.array([np.bincount(part, values.ravel()) for values in (found, possible)]).T)
    prior = usual**2
    trust = prior**2 / (prior**2 + error**2)
    likely = min(prior + trust * (variance - prior), max(variance - _CERTAIN * error, prior))
    spread = np.sqrt(max(likely, 0.0))
    return Mismatch(float(np.clip(spread, *SPREADS)), variance, error, samples)
