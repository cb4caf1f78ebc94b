"""kalux's own augmentation: two frames joined by events, each trusted by its variance.

The paper scales the threshold so that the events reach exactly from one frame to the next (12), and falls back
to the nominal threshold where that makes no sense. Here the same mismatch

    r = L(tau^{k+1}) - L(tau^k) - (c_on n_on - c_off n_off)

is shared out among everything that may have caused it, in proportion to the variances (the posterior mean of a
linear Gaussian model): the two frames, the pixel's own thresholds, the single events, and what changed
without an event. Where the thresholds dominate, this is (12); where a frame is clipped, its variance is
infinite and the events keep their steps; where a pixel is silent, the frames are joined by a straight line. See
docs/equations.md, K1 to K3.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

UNMEASURED: Final = 1e12
"""Variance of a clipped pixel. 1/R is then 1e-12, which a double cannot tell from 0 beside any
information in use (1e-2 and more), and the formulas need no special case."""

UNSEEN: Final = 1e13
"""Variance of a pixel of which the frame says nothing (`Frame.valid`): as little weight, and no bound."""

_SCALE_BOUNDS: Final = (0.3, 3.0)
_SCALE_DRIFT: Final = 1e-5  # variance per frame: a calibration never becomes certain, temperatures drift


class Latent(NamedTuple):
    """A deblurred frame at one moment: (H, W) log intensity and its variance.

    The variance is `UNMEASURED` where the frame is clipped, `UNSEEN` where it is masked.
    """

    value: Array
    variance: Array


class Thresholds(NamedTuple):
    """What is known of every pixel's thresholds: (H, W) factors of the nominal ones, and their variances."""

    on: Array
    off: Array
    on_variance: Array
    off_variance: Array


class BridgeNoise(NamedTuple):
    """The scalars of the noise model: nominal thresholds (log intensity), and variances in log intensity^2."""

    threshold_on: float
    threshold_off: float
    step_variance: float
    quantisation_variance: float


class BridgedSegment(NamedTuple):
    """L^A and its uncertainty from one moment to the next.

    Times are int us, arrays (H, W) float64, log intensity. Between events L^A moves by ``slope`` (1/s); an
    event moves it by ``step_on`` or -``step_off`` (both usually positive) and moves ``step_variance`` from
    ``backward_variance`` to ``forward_variance``. The covariance of L^A as a measurement is
    R = 1 / (rate (1/forward + 1/backward)), ``rate`` in 1/s. At ``end`` the pixel is no darker than
    ``end_bound``.
    """

    start: int
    end: int
    augmented: Array
    slope: Array
    step_on: Array
    step_off: Array
    forward_variance: Array
    backward_variance: Array
    step_variance: float
    rate: float
    end_bound: Array


def lower_bound(frame: Latent) -> Array:
    """What a clipped pixel does say: it was no darker than this (docs/equations.md, K7); -inf elsewhere.

    A frame integrates: where its value is clipped, the mean over the exposure was at least the value, and the
    latent value computed from it is a bound for every moment.
    """
    clipped = (frame.variance >= UNMEASURED) & (frame.variance < UNSEEN)
    return np.where(clipped, frame.value, -np.inf)


def nominal_thresholds(shape: tuple[int, int], spread: float) -> Thresholds:
    """Before any calibration: factor 1 with the variance that pixels have among each other."""
    return Thresholds(np.ones(shape), np.ones(shape), np.full(shape, spread**2), np.full(shape, spread**2))


def bridge(
    first: Latent,
    second: Latent,
    on: Array,
    off: Array,
    thresholds: Thresholds,
    noise: BridgeNoise,
    start: int,
    end: int,
) -> tuple[BridgedSegment, Thresholds]:
    """Join two latent frames (docs/equations.md, K1), and learn the pixels' thresholds from them (K2).

    Parameters
    ----------
    first, second
        The frames at ``start`` and ``end`` (us).
    on, off
        (H, W) number of events of each polarity between them.
    thresholds
        What is known of the pixels' thresholds so far.

    Returns
    -------
    The segment, and the thresholds with what this interval says of them.
    """
    step_on = noise.threshold_on * thresholds.on
    step_off = noise.threshold_off * thresholds.off
    mismatch = second.value - first.value - (step_on * on - step_off * off)
    on_covariance = thresholds.on_variance * noise.threshold_on * on
    off_covariance = -thresholds.off_variance * noise.threshold_off * off
    of_events = noise.step_variance * (on + off)
    total = (
        first.variance
        + second.variance
        + on_covariance * noise.threshold_on * on
        - off_covariance * noise.threshold_off * off
        + of_events
        + noise.quantisation_variance
    )
    gain = mismatch / total
    seconds = (end - start) * 1e-6
    segment = BridgedSegment(
        start=start,
        end=end,
        augmented=first.value + gain * first.variance,
        slope=gain * noise.quantisation_variance / seconds,
        step_on=step_on + gain * (noise.threshold_on * on_covariance + noise.step_variance),
        step_off=step_off + gain * (noise.threshold_off * off_covariance - noise.step_variance),
        forward_variance=first.variance,
        backward_variance=second.variance + of_events,
        step_variance=noise.step_variance,
        rate=0.5 / seconds,
        end_bound=lower_bound(second),
    )
    low, high = _SCALE_BOUNDS
    learned = Thresholds(
        np.clip(thresholds.on + gain * on_covariance, low, high),
        np.clip(thresholds.off + gain * off_covariance, low, high),
        thresholds.on_variance - on_covariance**2 / total + _SCALE_DRIFT,
        thresholds.off_variance - off_covariance**2 / total + _SCALE_DRIFT,
    )
    return segment, learned


def extend(
    frame: Latent,
    thresholds: Thresholds,
    noise: BridgeNoise,
    start: int,
    end: int,
    seconds: float,
    end_bound: Array,
) -> BridgedSegment:
    """L^A from one frame alone, forward in time (10): causal mode, and after the last frame.

    ``seconds`` is the time over which the frame's information is spread, that to the next frame; ``end_bound``
    what the next frame says if it is clipped, -inf elsewhere.
    """
    return BridgedSegment(
        start=start,
        end=end,
        augmented=frame.value,
        slope=np.zeros_like(frame.value),
        step_on=noise.threshold_on * thresholds.on,
        step_off=noise.threshold_off * thresholds.off,
        forward_variance=frame.variance,
        backward_variance=np.full_like(frame.value, UNMEASURED),
        step_variance=noise.step_variance,
        rate=1.0 / seconds,
        end_bound=end_bound,
    )


def extend_backward(
    frame: Latent, on: Array, off: Array, thresholds: Thresholds, noise: BridgeNoise, start: int, end: int
) -> BridgedSegment:
    """L^A from one frame alone, backward in time (11): before the middle of the first exposure."""
    step_on, step_off = noise.threshold_on * thresholds.on, noise.threshold_off * thresholds.off
    return BridgedSegment(
        start=start,
        end=end,
        augmented=frame.value - (step_on * on - step_off * off),
        slope=np.zeros_like(frame.value),
        step_on=step_on,
        step_off=step_off,
        forward_variance=np.full_like(frame.value, UNMEASURED),
        backward_variance=frame.variance + noise.step_variance * (on + off),
        step_variance=noise.step_variance,
        rate=0.5 / ((end - start) * 1e-6),
        end_bound=lower_bound(frame),
    )
