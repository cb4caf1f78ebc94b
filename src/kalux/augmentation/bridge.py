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

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.trail import Trail
from kalux.compiled import any_from, apart, empty, larger, loop, smaller

Array = NDArray[np.floating[Any]]

UNMEASURED: Final = 2.0**40
"""Variance of a clipped pixel, a number that float32 holds too. 1/R is then 1e-12, which cannot be told
from 0 beside any information in use (1e-2 and more), and the formulas need no special case."""

MASKED: Final = 2.0**41
"""Variance of a pixel that the frame masks out (`Frame.valid`): no weight, and, unlike a clipped one, no bound."""

REPEATED: Final = 2.0**39
"""Variance of a black pixel in K11: a measurement, but one that adds nothing to those of other frames."""

RANDOM: Final = 0.25
"""Of a random walk: variance of its middle about the mean of its ends, over the variance of its change."""

WRONG_STEPS: Final = 0.1
"""Variance of steps that are all wrong alike, in units of what the thresholds' spread makes of as many events (K10):
half-way between two frames that both measure the pixel, by the errors of 30 scenes and three recordings, and on the way
back from a frame where the one before does not (docs/equations.md, K11 and K4)."""

_LEAST_SQUARE: Final = 1e-12  # log intensity^2: where events tell of no change, a division

_BLOCK: Final = 64
"""Pixels in a block: blocks that frames measure completely are skipped where they may be."""

_SCALE_BOUNDS: Final = (0.3, 3.0)
_SCALE_DRIFT: Final = 1e-5  # variance per frame: a calibration never becomes certain, temperatures drift

_NOT_SHOWN: Final = 2.4
"""In units of the variance of the change that no event has told: a. Of changes that are C by the events, frames show
C^2 / (C^2 + a) on average (docs/equations.md, K2)."""


def bridge_variance(share: float) -> float:
    """Variance of a random walk that is tied at both ends, a Brownian bridge, over that half-way: 4 s (1 - s).

    ``share`` is s, of the way from the frame before to the one after: it is 0 at a frame, and 1 half-way.
    """
    return 4.0 * share * (1.0 - share)


class Latent(NamedTuple):
    """A deblurred frame at one moment: (H, W) log intensity and its variance.

    The variance is `UNMEASURED` where the frame is clipped, `MASKED` where it is masked. ``ceiling`` is the upper bound
    of black pixels, inf where the value is a measurement; None: black is a measurement as any other.
    """

    value: Array
    variance: Array
    ceiling: Array | None = None


class Revealed(NamedTuple):
    """Statistics of pixels that have left saturation, for the expectation of those that have not (K15).

    Attributes
    ----------
    excess, expected, pixels
        Of every part of the image: sum of the distances of these pixels from their bounds, sum of the distances that
        had been expected, and the number of these pixels. T, F and n of docs/equations.md.
    moved_excess, moved_expected
        Both sums over the whole image, of pixels that events have taken out of saturation. T_all and F_all.
    """

    excess: Array
    expected: Array
    pixels: Array
    moved_excess: float
    moved_expected: float


class Texture(NamedTuple):
    """What events tell of how fast the light changes beyond white: sums over all intervals until now (K15).

    Attributes
    ----------
    events, pixels
        Of every part of the image: sum of the events of pixels that no frame has measured, as far as they are signal,
        and the number of these pixels. E and U of docs/equations.md.
    rim_events, rim_slope
        The same of measured pixels beside clipped ones, and the sum of the slopes that frames show there, log intensity
        per pixel. E_r and S_r.
    """

    events: Array
    pixels: Array
    rim_events: Array
    rim_slope: Array


class UnshownMemory(NamedTuple):
    """At a node: pixels that no frame has measured yet, and what is expected of them (K15).

    Attributes
    ----------
    pixels
        (N,) their indices in the flattened image, ascending.
    bound
        (N,) float32, lower bound of L.
    shape
        (H, W).
    excess, limited, expected
        (N,) float32: how far above it L is expected to be by what frames show around the pixels; the same, limited by
        what events tell; and that, corrected by pixels that have left saturation.
    doubt
        (N,) float32: variance of ``expected``.
    revealed
        Statistics of the pixels that have left saturation.
    texture
        Of those that have not.
    hardness
        Of every part of the image: that of the borders of clipped pixels around, in the latest frame, 0 to 1.
    near, clipped
        Numbers of pixels just below white and of clipped ones, in all frames until now.
    times
        How many times as far beyond white pixels lie as frames make expect, by what was known of it before (R_0).
    """

    pixels: NDArray[np.int64]
    bound: NDArray[np.float32]
    shape: tuple[int, ...]
    excess: NDArray[np.float32]
    limited: NDArray[np.float32]
    expected: NDArray[np.float32]
    doubt: NDArray[np.float32]
    revealed: Revealed
    texture: Texture
    hardness: Array
    near: int
    clipped: int
    times: float


class Thresholds(NamedTuple):
    """Every pixel's thresholds: (H, W) estimated factors of the nominal ones, and the variances of these."""

    on: Array
    off: Array
    on_variance: Array
    off_variance: Array


class BridgeNoise(NamedTuple):
    """The scalars of the noise model: nominal thresholds (log intensity), and variances in log intensity^2.

    ``saturated_variance`` is that of the change between two successive frames that both clip the pixel.
    """

    threshold_on: float
    threshold_off: float
    step_variance: float
    quantisation_variance: float
    saturated_variance: float = UNMEASURED


class UntiedSteps(NamedTuple):
    """What errors of the thresholds add to the variance of each event's step, where only the next frame ties it (K10).

    Attributes
    ----------
    pixels
        (N,) int64 places in the flattened image, ascending.
    on, off
        (N,) float32, log intensity^2: of an on and of an off event.
    """

    pixels: NDArray[np.int64]
    on: NDArray[np.float32]
    off: NDArray[np.float32]


class BridgedSegment(NamedTuple):
    """L^A and its uncertainty from one moment to the next; arrays are (H, W) in the type of the frames.

    The covariance of L^A as a measurement is R = 1 / (rate (1/forward + 1/backward)), where ``forward`` is
    ``forward_variance`` and ``step_variance`` for each event since the start, and ``backward`` is ``backward_variance``
    and ``step_variance`` for each of the ``events`` still to come.

    Attributes
    ----------
    start, end
        int us.
    augmented
        L^A at the start, log intensity.
    slope
        Rate at which it moves between events, 1/s.
    step_on, step_off
        Steps of an on event, up, and of an off event, down; both usually positive.
    forward_variance, backward_variance, step_variance, rate
        Of R: variances, log intensity^2, and 1/s.
    events
        Number between start and end; None: not known, and none are counted.
    bound
        The frame at the end, whose clipped pixels are bounds of the state there (`raise_to_bound`).
    drift
        Growth of P until the end by errors of the thresholds (`drift`), with the pixel's events; None: none.
    still_since
        us: pixels without an event after it are still.
    floor
        Lower bound of L at the start (K7), of pixels that no frame measures there and that the next one clips. None:
        there are none.
    trail
        By how much the light is ahead of its newest event, in addition to L^A and the state (K14); None: nothing.
    unshown
        Pixels that no frame has measured until the end, or until the start in causal mode (K15).
    silent_change
        Mean square change of silent pixels around each between the frames (`subthreshold.silent_change`); None: not
        known.
    net
        Change of L by all events, and by K14, from start to end; None: not known.
    turns
        How often the intensity of a pixel with events reverses, on average (`subthreshold.turns`).
    half_way
        Variance of silent pixels about the mean of both frames (`subthreshold.half_way`).
    latents
        The frames at both ends, where they are looked at along the paths of what moves (K16); else None.
    brightest
        I of a pixel that is saturated in the frame of them that is exposed for less.
    doubt
        By how much the variance of an on and of an off event's step is more than a sure event's
        (`kalux.augmentation.background`); the steps are then those that are expected. None: every event is weighed by
        the age of those around it.
    signal
        Probability that an on and that an off event is signal, as far as K14 asks for it; None: all are.
    wrong
        Variance of the way that events lead back from the second frame, by errors of the thresholds, per squared number
        of these events, of pixels that the first frame does not measure; 0 of others (`wrong_way_back`, K4). None: 0.
    untold
        Variance of what no event has told of the change from start to end (`subthreshold.follow_silent`, K18); None:
        q_0 of all pixels.
    lost
        The part of it that events would have told which have been lost (K18); None: none.
    untied
        What P grows by with each event of these pixels besides (`untied_steps`, K10). None: nothing.
    texture
        Variance by which neighbours one apart differ (`kalux.augmentation.texture`); None: by no more than usual.
    """

    start: int
    end: int
    augmented: Array
    slope: Array
    step_on: Array
    step_off: Array
    forward_variance: Array
    backward_variance: Array
    events: Array | None
    step_variance: float
    rate: float
    bound: Latent | None
    drift: Array | None = None
    still_since: int = 0
    floor: Array | None = None
    trail: Trail | None = None
    unshown: UnshownMemory | None = None
    silent_change: Array | None = None
    net: Array | None = None
    turns: float = 0.0
    half_way: float = RANDOM
    latents: tuple[Latent, Latent] | None = None
    brightest: float = 1.0
    doubt: tuple[Array, Array] | None = None
    signal: tuple[Array, Array] | None = None
    wrong: Array | None = None
    untold: Array | None = None
    lost: Array | None = None
    untied: UntiedSteps | None = None
    texture: Array | None = None


def become_measured(first: Latent, second: Latent, events: Array) -> NDArray[np.int64]:
    """Pixels with ``events`` that the second frame measures and the first does not.

    Parameters
    ----------
    first, second
        The frames before and after.
    events
        (H, W) number of events between them.

    Returns
    -------
    (N,) places in the flattened image.
    """
    return np.flatnonzero((first.variance >= UNMEASURED) & (second.variance < UNMEASURED) & (events > 0))


def wrong_way_back(
    pixels: NDArray[np.int64],
    thresholds: Thresholds,
    noise: BridgeNoise,
    counts: tuple[Array, Array],
    events: Array,
) -> Array | None:
    """Variance of the way back from the second frame, per squared event, by errors of the thresholds (K4).

    A wrong threshold is wrong for all events alike. Where the first frame does not measure a pixel, it does not tie the
    other end of the way that they lead back from the second.

    Parameters
    ----------
    pixels
        Those that `become_measured`.
    thresholds, noise
        As in `bridge`.
    counts
        (H, W) on and off events between the frames, as far as they are signal.
    events
        (H, W) the sum of both, with what is noise.

    Returns
    -------
    (H, W), 0 of other pixels; None: 0 of all.
    """
    if len(pixels) == 0:
        return None
    on, off, all_events, on_variance, off_variance = (
        plane.reshape(-1)[pixels] for plane in (*counts, events, *thresholds[2:])
    )
    of_on, of_off = noise.threshold_on * on, noise.threshold_off * off
    of_both = on_variance * of_on**2 + off_variance * of_off**2
    found = np.zeros(events.shape, of_both.dtype)
    found.reshape(-1)[pixels] = WRONG_STEPS * of_both / all_events**2
    return found


def untied_steps(
    pixels: NDArray[np.int64],
    thresholds: Thresholds,
    noise: BridgeNoise,
    far: tuple[Array, Array, Array | None],
    counts: tuple[Array, Array],
    signal: tuple[Array, Array] | None,
    by_period: Array | None,
) -> UntiedSteps | None:
    """What P grows by with each event of pixels that the second frame measures and the first does not (K10).

    Their events move L as they do where no frame measures (`drift`), until the second frame has told the level.

    Parameters
    ----------
    pixels
        Those that `become_measured`.
    thresholds, noise
        As in `bridge`.
    far
        (H, W) on and off events since a frame last measured the pixel, up to the first of both, and what the standard
        error of the refractory period adds to its level by these, log intensity; None: the period is known.
    counts
        (H, W) on and off events between the frames.
    signal
        (H, W) shares of these that are signal (K5); None: all.
    by_period
        (H, W) what the period's error adds by the events between the frames, as far as they are signal.

    Returns
    -------
    None where there is no such pixel.
    """
    if len(pixels) == 0:
        return None

    def of(*planes: Array) -> list[Array]:
        return [plane.reshape(-1)[pixels] for plane in planes]

    numbers, before = of(*counts), of(*far[:2])
    shares = (np.ones(1, np.float32),) * 2 if signal is None else of(*signal)
    variances = of(thresholds.on_variance, thresholds.off_variance)
    on, off = (
        share * variance * np.float32(step**2) * (2 * since + share * now)
        for step, share, variance, since, now in zip(
            (noise.threshold_on, noise.threshold_off), shares, variances, before, numbers, strict=True
        )
    )
    if far[2] is not None and by_period is not None:
        grown = _growth(*of(far[2], by_period)) / (numbers[0] + numbers[1])
        on, off = (np.maximum(each + grown, np.float32(0.0)) for each in (on, off))
    return UntiedSteps(pixels, on.astype(np.float32), off.astype(np.float32))


def drift(
    first: Latent,
    second: Latent,
    thresholds: Thresholds,
    noise: BridgeNoise,
    far: tuple[Array, Array],
    counts: tuple[Array, Array],
) -> tuple[Array, Array, Array]:
    """Growth of P by errors of the thresholds, of pixels that no frame measures (docs/equations.md, K10).

    A wrong threshold is wrong for all events alike: after N of them the level is off by N times the error, and the
    variance is N^2 times the threshold's. The change below the threshold since the last measurement is added once.

    Parameters
    ----------
    first, second
        The frames before and after.
    far, counts
        (H, W) on and off events since a frame last measured the pixel, up to ``first``, and those that come then.

    Returns
    -------
    (H, W) growth of the variance, and the on and off events since the last measurement, up to ``second``.
    """
    grown, far_on, far_off = apart(3, second.variance.shape)
    of_on, of_off = np.float32(noise.threshold_on**2), np.float32(noise.threshold_off**2)
    unsignalled = np.float32(noise.quantisation_variance / 2)
    planes = first.variance, second.variance, thresholds.on_variance, thresholds.off_variance, *far, *counts
    _drift(of_on, of_off, unsignalled, *(p.reshape(-1) for p in (*planes, grown, far_on, far_off)))
    return grown, far_on, far_off


@loop
def _drift(  # type: ignore[no-untyped-def]
    of_on,
    of_off,
    unsignalled,
    before,
    after,
    on_variance,
    off_variance,
    far_on,
    far_off,
    on,
    off,
    grown,
    new_on,
    new_off,
):
    unmeasured, two, zero = np.float32(UNMEASURED), np.float32(2.0), np.float32(0.0)
    drifted = empty(_BLOCK, np.float32)
    for first in range(np.uint64(0), np.uint64(len(grown)), np.uint64(_BLOCK)):
        pixels = range(first, smaller(np.uint64(len(grown)), first + np.uint64(_BLOCK)))
        if not any_from(after, pixels, unmeasured):
            for i in pixels:  # few arrays a loop: vector code
                grown[i] = zero
            for i in pixels:
                new_on[i] = zero
            for i in pixels:
                new_off[i] = zero
            continue
        for i in pixels:
            drifted[i - first] = on_variance[i] * of_on * on[i] * (two * far_on[i] + on[i])
        for i in pixels:
            drifted[i - first] += off_variance[i] * of_off * off[i] * (two * far_off[i] + off[i])
        for i in pixels:
            more = unsignalled if before[i] < unmeasured else zero
            grown[i] = drifted[i - first] + more if after[i] >= unmeasured else zero
        for i in pixels:
            new_on[i] = far_on[i] + on[i] if after[i] >= unmeasured else zero
        for i in pixels:
            new_off[i] = far_off[i] + off[i] if after[i] >= unmeasured else zero


def period_drift(second: Latent, far: Array, now: Array) -> tuple[Array, Array]:
    """Growth of P by the error of the refractory period, of pixels that no frame measures (docs/equations.md, K10).

    The period is wrong for on and for off events alike, so that what it adds on the way up it takes off on the way
    down.

    Parameters
    ----------
    second
        The frame after.
    far, now
        (H, W) log intensity: what the standard error of the period adds to a pixel's level by the events since a frame
        last measured it, up to the frame before, and by those that come then.

    Returns
    -------
    (H, W) growth of the variance, negative on the way back, and ``far`` up to ``second``.
    """
    unmeasured = second.variance >= UNMEASURED
    then = np.where(unmeasured, far + now, np.float32(0.0))
    return np.where(unmeasured, _growth(far, now), np.float32(0.0)), then


def _growth(far: Array, now: Array) -> Array:
    """By how much the square of an error grows that was ``far`` and becomes more by ``now``."""
    return np.asarray((far + now) ** 2 - far**2)


def raise_to_bound(log_intensity: Array, frame: Latent) -> None:
    """Raise L to the lower bounds that clipped pixels of a frame give (docs/equations.md, K7). In place.

    A frame integrates: where its value is clipped, the mean over the exposure was at least the value, and the
    latent value computed from it is a bound for every moment.
    """
    _raise_to_bound(log_intensity.reshape(-1), frame.value.reshape(-1), frame.variance.reshape(-1))


def lower_to_ceiling(log_intensity: Array, frame: Latent) -> None:
    """Lower L to the upper bounds that black pixels of a frame give (K7). In place."""
    if frame.ceiling is not None:
        np.minimum(log_intensity, frame.ceiling, out=log_intensity)


@loop
def _raise_to_bound(log_intensity, value, variance):  # type: ignore[no-untyped-def]
    for i in range(len(value)):
        if UNMEASURED <= variance[i] < MASKED and value[i] > log_intensity[i]:
            log_intensity[i] = value[i]


def nominal_thresholds(shape: tuple[int, int], spread: float, dtype: Any = np.float64) -> Thresholds:
    """Thresholds before any calibration: all factors are 1, with the variance between pixels."""
    return Thresholds(*(np.full(shape, value, dtype) for value in (1.0, 1.0, spread**2, spread**2)))


def bridge(
    first: Latent,
    second: Latent,
    counts: tuple[Array, Array],
    thresholds: Thresholds,
    noise: BridgeNoise,
    start: int,
    end: int,
    *,
    grown: Array | None = None,
    signal: tuple[Array, Array] | None = None,
    untold: Array | None = None,
    dark: NDArray[np.float32] | None = None,
) -> tuple[BridgedSegment, Thresholds]:
    """Join two latent frames (docs/equations.md, K1), and learn the pixels' thresholds from them (K2).

    Parameters
    ----------
    first, second
        The frames at ``start`` and ``end`` (us).
    counts
        (H, W) number of on and of off events between them.
    thresholds
        What is known of the pixels' thresholds so far.
    noise
        Nominal thresholds, and variances of steps.
    grown
        (H, W) change of L between the frames in addition to the events' steps (K14); None: none.
    signal
        (H, W) shares of the on and of the off events that are signal (K5); None: all.
    untold
        (H, W) float32 variance of the change that no event has told, log intensity^2 (K18); None: q_0 of all pixels.
    dark
        (H, W) what the variance of a step of dark pixels is more (K20); None: nothing.

    Returns
    -------
    The segment, and the thresholds updated by this interval.
    """
    seconds = (end - start) * 1e-6
    shape = first.value.shape
    planes = tuple(apart(7, shape, first.value.dtype))
    augmented, slope, step_on, step_off, events, net, floor = planes
    factors = tuple(apart(4, shape, first.value.dtype))  # needed for longer
    segment = BridgedSegment(
        start=start,
        end=end,
        augmented=augmented,
        slope=slope,
        step_on=step_on,
        step_off=step_off,
        forward_variance=first.variance,
        backward_variance=second.variance,
        events=events,
        step_variance=noise.step_variance,
        rate=0.5 / seconds,
        bound=second,
        floor=floor,
        net=net,
        untold=untold,
    )
    more = np.zeros(shape, first.value.dtype) if grown is None else grown
    shares = (np.ones(shape, first.value.dtype),) * 2 if signal is None else signal
    by_none = np.full(shape, noise.quantisation_variance)
    if untold is not None:
        by_none[...] = untold
    given, known, filled, learned = (
        tuple(plane.reshape(-1) for plane in several)
        for several in (
            (*first[:2], *second[:2], *counts, more, *shares, by_none),
            thresholds,
            planes,
            factors,
        )
    )
    more_of_steps = np.empty(0, np.float32) if dark is None else dark.reshape(-1)
    _bridge(given, known, noise, more_of_steps, seconds, filled, learned)
    return segment, Thresholds(*factors)


_SCRATCH: Final = 16
_COUNT_ON, _COUNT_OFF, _CHANGE, _BOTH, _MOVES, _BOUND, _MEASURED, _LEVEL, _SLOPE, _OF_STEP, *_LEARNED = (
    np.uint64(k * _BLOCK) for k in range(_SCRATCH)
)
_STEP_ON, _STEP_OFF, _NEW_ON, _NEW_OFF, _LEFT_ON, _LEFT_OFF = _LEARNED
"""Where the values of a block of pixels lie in the scratch memory of `_bridge`."""


@loop
def _bridge(given, thresholds, noise, dark, seconds, planes, factors):  # type: ignore[no-untyped-def]
    """Fill ``planes`` and ``factors``; in float64, whatever the arrays' type.

    Vector code: a block of pixels at a time, and in no loop more arrays than the compiler compares the places of. One
    piece of scratch memory is one array.
    """
    low, high = _SCALE_BOUNDS
    value, variance, next_value, next_variance, on, off, grown, signal_on, signal_off, untold = given
    augmented, slope, step_on, step_off, events, net, floor = planes
    new_on, new_off, new_on_variance, new_off_variance = factors
    scale_on, scale_off, variance_on, variance_off = thresholds
    c_on, c_off, of_steps = noise.threshold_on, noise.threshold_off, noise.step_variance
    of_saturated, not_shown = noise.saturated_variance, _NOT_SHOWN * noise.quantisation_variance
    s = empty(_SCRATCH * _BLOCK, np.float64)
    size = np.uint64(len(value))
    for first in range(np.uint64(0), size, np.uint64(_BLOCK)):
        pixels = range(smaller(size - first, np.uint64(_BLOCK)))
        for k in pixels:
            i = first + k
            before, after = np.float64(variance[i]), np.float64(next_variance[i])
            here, more = np.float64(value[i]), np.float64(grown[i])
            saturated = (smaller(before, after) >= UNMEASURED) & (larger(before, after) < MASKED)
            s[_COUNT_ON + k], s[_COUNT_OFF + k] = on[i], off[i]
            # Two lower bounds have no information of the change, but that it does not grow without limit.
            s[_CHANGE + k] = -more if saturated else np.float64(next_value[i]) - more - here
            s[_BOTH + k] = of_saturated if saturated else before + after
            s[_LEVEL + k], s[_MOVES + k] = here, 0.0 if saturated else before
            one = (smaller(before, after) < UNMEASURED) & (larger(before, after) >= UNMEASURED)
            bounded = one & (larger(before, after) < MASKED)
            s[_BOUND + k] = (1.0 if after > before else -1.0) if bounded else 0.0
            s[_MEASURED + k] = smaller(before, after)
        for k in pixels:
            s[_OF_STEP + k] = of_steps
        if len(dark):
            for k in pixels:
                s[_OF_STEP + k] += np.float64(dark[first + k])
        for k in pixels:
            i = first + k
            f_on, f_off, of_step = np.float64(signal_on[i]), np.float64(signal_off[i]), s[_OF_STEP + k]
            n_on, n_off = f_on * s[_COUNT_ON + k], f_off * s[_COUNT_OFF + k]
            in_doubt_on, in_doubt_off = (1.0 - f_on) * c_on * c_off, (1.0 - f_off) * c_on * c_off
            of_on, of_off = np.float64(scale_on[i]), np.float64(scale_off[i])
            nominal_on, nominal_off = c_on * of_on, c_off * of_off
            told = nominal_on * n_on - nominal_off * n_off
            mismatch = s[_CHANGE + k] - told
            on_variance, off_variance = np.float64(variance_on[i]), np.float64(variance_off[i])
            on_covariance = on_variance * c_on * n_on
            off_covariance = -off_variance * c_off * n_off
            # A bound that events lead below is as good as a measurement (K7): light comes from there, or gets there.
            bound = s[_BOUND + k]
            below = bound * mismatch > 0.0
            both = s[_MEASURED + k] if below else s[_BOTH + k]
            moves = 0.0 if below & (bound < 0.0) else s[_MOVES + k]
            total = (
                both
                + on_covariance * c_on * n_on
                - off_covariance * c_off * n_off
                + of_step * (n_on + n_off)
                + (in_doubt_on * n_on + in_doubt_off * n_off)
                + untold[i]
            )
            inverse = 1.0 / total
            gain = mismatch * inverse
            s[_LEVEL + k] += gain * moves
            s[_SLOPE + k] = gain * untold[i] / seconds
            s[_STEP_ON + k] = f_on * (nominal_on + gain * (c_on * on_covariance + (of_step + in_doubt_on)))
            s[_STEP_OFF + k] = f_off * (
                nominal_off + gain * (c_off * off_covariance - (of_step + in_doubt_off))
            )
            learned = gain + inverse * told * not_shown / larger(told * told + not_shown, _LEAST_SQUARE)
            tells = 0.0 if below else 1.0  # a bound says of thresholds no more than that they are too small
            learned, inverse = tells * learned, tells * inverse
            s[_NEW_ON + k] = smaller(larger(of_on + learned * on_covariance, low), high)
            s[_NEW_OFF + k] = smaller(larger(of_off + learned * off_covariance, low), high)
            s[_LEFT_ON + k] = on_variance - on_covariance * on_covariance * inverse + _SCALE_DRIFT
            s[_LEFT_OFF + k] = off_variance - off_covariance * off_covariance * inverse + _SCALE_DRIFT
        for k in pixels:
            i = first + k
            augmented[i], slope[i], events[i] = (
                s[_LEVEL + k],
                s[_SLOPE + k],
                s[_COUNT_ON + k] + s[_COUNT_OFF + k],
            )
        for k in pixels:
            step_on[first + k], step_off[first + k] = s[_STEP_ON + k], s[_STEP_OFF + k]
        for k in pixels:
            new_on[first + k], new_off[first + k] = s[_NEW_ON + k], s[_NEW_OFF + k]
        for k in pixels:
            new_on_variance[first + k], new_off_variance[first + k] = s[_LEFT_ON + k], s[_LEFT_OFF + k]
        for k in pixels:
            i = first + k
            net[i] = step_on[i] * on[i] - step_off[i] * off[i] + grown[i]
        for k in pixels:
            i = first + k
            # The unknown excess of a pixel that no frame measures does not change: if events lead to a level below the
            # next frame's bound, the level was too low all the time.
            bounded = (
                (variance[i] >= UNMEASURED) & (next_variance[i] >= UNMEASURED) & (next_variance[i] < MASKED)
            )
            floor[i] = next_value[i] - net[i] if bounded else -np.inf


def extend(
    frame: Latent,
    thresholds: Thresholds,
    noise: BridgeNoise,
    start: int,
    end: int,
    seconds: float,
    bound: Latent | None,
) -> BridgedSegment:
    """L^A from one frame alone, forward in time (10): causal mode, and after the last frame.

    ``seconds`` is the time over which the frame's information is spread, that to the next frame; ``bound`` is the
    next frame, which is a bound where it is clipped.
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
        events=None,
        step_variance=noise.step_variance,
        rate=1.0 / seconds,
        bound=bound,
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
        backward_variance=frame.variance,
        events=on + off,
        step_variance=noise.step_variance,
        rate=0.5 / ((end - start) * 1e-6),
        bound=frame,
    )
