"""By how much the contrast threshold differs between a recording's pixels, and the steps of one pixel from each other.

The mismatch of a pixel's events and frames has many causes. The deviation of its threshold is the same in all frame
intervals, while frame noise, the noise of single steps and changes below the threshold are independent. So the mean
product of the mismatches of two *different* intervals is due to the threshold alone, and no model of the rest is
needed. Neighbouring intervals have a frame, and its noise, in common and are left out.

What the mean *square* of an interval's mismatch has beyond that, and beyond the noise of its frames, is the variance of
its steps.
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

BELIEVED_STEPS: Final = (0.03, 0.4)
"""What is believed of a step's variance, in units of c^2. The steps of simulated sensors without noise have none; but
what is not modelled of events counts, too, where no frame checks them (docs/equations.md, K9)."""

_FEWEST_EVENTS: Final = 2.0
"""Of a pixel in an interval whose steps count: single ones are noise more often, which has a variance of its own (K5),
and changes below the threshold hide what they say."""

_OF_NOISE: Final = 0.5
"""Share of what events of noise make of the mean square that is not the steps'. With all of it variances and log-MSE
are a little better, but steps beyond white, where noise has come for signal and no frame has told, are then believed
more (docs/reasons.md, K9)."""

_MIN_STEPS: Final = 1_000
"""Pixels and intervals from which the variance of steps is known within a tenth of c^2."""


class Mismatch(NamedTuple):
    """What a recording says of its pixels' thresholds and of their steps.

    Attributes
    ----------
    spread
        Relative standard deviation between pixels, of on and off thresholds alike: within `SPREADS`.
    variance, error
        Its square as measured, which noise may make negative, and the standard error of that.
    samples
        Pixels and frame intervals used.
    per_event
        Mean square mismatch per event, in units of c^2, that frames and changes below the threshold do not explain;
        None: too few pixels had two events.
    by_spread
        What a relative variance of 1 between pixels' thresholds makes of it.
    """

    spread: float
    variance: float
    error: float
    samples: int
    per_event: float | None = None
    by_spread: float = 0.0

    def step_variance(self, spread: float) -> float | None:
        """Variance of a step, in units of c^2, given the ``spread``: within `BELIEVED_STEPS`. None: unknown."""
        if self.per_event is None:
            return None
        return float(np.clip(self.per_event - spread**2 * self.by_spread, *BELIEVED_STEPS))


def estimate_mismatch(
    recording: Recording, camera: CameraSettings, events: EventSettings, noise_rate: float = 0.0
) -> Mismatch | None:
    """Spread of the contrast thresholds between pixels, from the first 80 frames.

    With m the mismatch of a frame interval (docs/equations.md, K1), n its weighed events of one polarity, c their
    threshold and w = 1 / Var m, the sum over pairs of intervals j, k at least two apart of w_j m_j c n_j w_k m_k c n_k
    is on average the squared spread times that of w_j w_k c n_j c n_k (c n_j c n_k + c' n'_j c' n'_k), primes for the
    other polarity. What is measured is drawn towards the usual spread as far as it is uncertain, and exceeds that only
    as far as it is certain. The variance of a step is what m^2 has, per event, beyond the variance Var' by frames,
    changes below the threshold and the spread, and half of that by events of noise: over pixels above 0.01 of white
    with two events and more in an interval, the sum of v (m^2 - Var' m) over that of v c c' (n + n'), with v = (n + n')
    w^2. Steps of darker ones have a variance of their own (K20).

    Parameters
    ----------
    recording
        With frames and exposures.
    camera
        Response, saturation, I_0 and frame noise.
    events
        With both thresholds.
    noise_rate
        Events of a pixel without reason, Hz: each is a step of a threshold that the light does not take. It has a
        variance of its own in the filter (K5).

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
    of_steps = events.usual_threshold_spread**2, events.step_noise * threshold_on * threshold_off
    products: Array = np.zeros((*recording.sensor_size, *_PRODUCTS))
    sums: Array = np.zeros(len(_Sums._fields))
    samples = 0
    for interval, on, off, bend in counted_intervals(recording, camera, events, most_frames=_MAX_FRAMES):
        first, second = interval.ends
        whites = (np.broadcast_to(np.float64(end.shot.white), on.shape) for end in interval.ends)
        seen = Samples(first.intensity, second.intensity, on, off, bend, *whites)
        bright = seen.darkest > DARKEST
        measured = first.shot.measured & second.shot.measured
        usable = measured & bright & (on + off > 0)
        mismatch, variance = mismatch_of(seen, model, camera.offset, events.step_noise)
        _add(mismatch, variance, usable, threshold_on * on, threshold_off * off, products)
        of_noise = _OF_NOISE * noise_rate * interval.seconds * threshold_on * threshold_off
        _add_steps(
            mismatch, variance, measured & bright, (on, off), events.thresholds, (*of_steps, of_noise), sums
        )
        samples += int(np.count_nonzero(usable))
        if samples >= MAX_SAMPLES:
            break
    found = _solved(products, samples, events.usual_threshold_spread)
    return None if found is None else _with_steps(found, _Sums(*sums.tolist()), threshold_on * threshold_off)


class _Sums(NamedTuple):
    """Of pixels and intervals with `_FEWEST_EVENTS` and more, and the weights of `estimate_mismatch`.

    Attributes
    ----------
    unexplained
        Of the squared mismatch less its variance by frames and changes below the threshold.
    spread
        Of what a relative variance of 1 between pixels makes of it.
    events
        Of their number.
    used
        Pixels and intervals.
    """

    unexplained: float
    spread: float
    events: float
    used: float


def _with_steps(found: Mismatch, sums: _Sums, threshold2: float) -> Mismatch:
    if sums.used < _MIN_STEPS:
        return found
    one = threshold2 * sums.events
    return found._replace(per_event=sums.unexplained / one, by_spread=sums.spread / one)


@loop
def _add_steps(mismatches, variances, measured, events, thresholds, of_steps, sums):  # type: ignore[no-untyped-def]
    """Add one interval to the fields of `_Sums`, in place.

    ``of_steps``: the squared spread and the variance of a step that ``variances`` count, and the variance of events of
    noise, which they do not.
    """
    events_on, events_off = events
    spread2, per_event, of_noise = of_steps
    for row in range(measured.shape[0]):
        for column in range(measured.shape[1]):
            i = row, column
            count = events_on[i] + events_off[i]
            if not measured[i] or count < _FEWEST_EVENTS:
                continue
            variance, on, off = variances[i], thresholds[0] * events_on[i], thresholds[1] * events_off[i]
            by_spread = on * on + off * off
            of_frames = variance - spread2 * by_spread - per_event * count + of_noise
            square = smaller(mismatches[i] * mismatches[i], _CLIP * _CLIP * variance)
            weight = count / (variance * variance)
            sums[0] += weight * (square - of_frames)
            sums[1] += weight * by_spread
            sums[2] += weight * count
            sums[3] += 1.0


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
