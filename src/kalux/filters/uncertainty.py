"""The variance that is given out with an image (docs/equations.md, K11).

The filter's P counts what it has seen. Missing are what the next frame tells of the image before it, which its level
has through the bridge; the noise of frames that all images share; and subthreshold changes, which no event has
signalled.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.bridge import RANDOM, UNMEASURED, bridge_variance
from kalux.augmentation.subthreshold import UNKNOWN_CHANGE, told_by_none
from kalux.compiled import FUSED, ZERO, empty, larger, loop, smaller, zeros
from kalux.filters.readout import CORRELATED, Subthreshold
from kalux.models.dark_levels import DarkDoubt
from kalux.models.lag import lag_growth_at

Array = NDArray[np.floating[Any]]

SUBTHRESHOLD_MOVING: Final = 0.09
"""Variance, in c^2, of the subthreshold change of a pixel with recent events, half-way between two frames: by the
errors of images, forward and both ways in time, of thirty simulated scenes and of the held-out frames of three real
recordings."""

SUBTHRESHOLD_EXPOSED: Final = 0.2
"""Share of these variances, of moving and of silent pixels, that is left at a frame that is exposed all the time, the
mean of which is not the middle: fifty simulated scenes, exposed for a twentieth to three quarters of the time."""

BLURRED: Final = 0.06
"""Variance at a frame by what its exposure hides, in units of the mean square change of silent pixels from frame to
frame, if frames are exposed all the time: by the errors at frames of silent and of moving pixels of 152 scenes."""

SUBTHRESHOLD_INTERMITTENT: Final = (0.5, 0.25)
"""Variance of an intermittent pixel's subthreshold change (`_mark_intermittent`) half-way, in units of that of a silent
pixel and of that of one with an event in this frame interval, which are added: the same scenes, and held-out frames."""

LAG_HALF_WAY: Final = 1.5
"""Variance of errors of the moment half-way between two frames, in units of what they have at a moment, if those of
three moments have nothing to do with one another. 0.9 to 2.9 in the dark of four simulated scenes of a slow sensor."""

_FEW_TURNS: Final = 1e-2  # in an exposure: what they change is less than the digits of their exponentials

BEFORE_AVERAGING: Final = 1.6
"""Variance of the subthreshold change before spatial averaging (K12), in units of that after it: the mean over
neighbours takes a fifth to a third of the squared errors."""

CORRELATED_UNMEASURED: Final = 0.1
"""Part of P that spatial averaging does not reduce, of a pixel that neither frame around measures, by the errors of 91
scenes (docs/equations.md, K11). `kalux.filters.readout.CORRELATED`, by which highlights are doubted, is more."""

UNMEASURED_SHARE: Final = 0.52
"""Part of P that is given out of such a pixel: P allows for more than thresholds turn out to be wrong by, as the errors
of 294 scenes say, whatever their noise and motion (docs/equations.md, K11)."""

UNSHOWN_SHARE: Final = 0.25
"""The same of the variance of what an unshown pixel is expected to exceed its bound by (K15): 1.5 in place of 3 for how
little is known of it, by the errors of 294 scenes. Both ways in time the 3 weighs."""

_BLOCK: Final = 4096
"""Pixels that all steps to the variance are taken of at a time."""

_REDUCTION: Final = np.float32((1.0 - CORRELATED_UNMEASURED) / (1.0 - CORRELATED))
"""By how much more averaging reduces P under the former correlation than under the latter."""

REPEATED_ROUNDING: Final = 0.5
"""Part of the variance of rounding that all frames of a still pixel have in common, where their noise is less than half
a level: such pixels err by 0.4 to 1.0 times its standard deviation on five photographs, three recordings of each."""


class Around(NamedTuple):
    """What the frames around an image say of its pixels.

    Attributes
    ----------
    first, second
        (H, W) variances of the frame before and of the one after.
    events
        (H, W) events between them.
    coming
        Variance of one of these, times the share of the time between the frames that is to come.
    counted
        `UNMEASURED` where P counts the second frame already, as it does both ways in time; else 0.
    quantisation_variance
        q_0 of K1.
    repeated
        What share of the variance of the frames' noise is in the image: 1 at a frame, 1/2 half-way between two.
    wrong
        Variance of steps that are all wrong alike, per squared number of events.
    wrong_back
        The same of the way back from the second frame, where the first does not measure the pixel (K4).
    share
        Of the way from the frame before to the one after.
    half_way
        How far silent pixels are off the mean of both frames there (`kalux.augmentation.subthreshold.half_way`).
    untold
        (H, W) variance of what no event has told of the change between them; None: q_0.
    lost
        (H, W) the part of it that is of events that have been lost (K18); None: none.
    """

    first: Array
    second: Array
    events: Array
    coming: float
    counted: float
    quantisation_variance: float
    repeated: float
    wrong: float
    wrong_back: float
    share: float
    half_way: float = RANDOM
    untold: Array | None = None
    lost: Array | None = None

    def scalars(self) -> tuple[float, ...]:
        """Those that `known_variance` takes."""
        of_lost = RANDOM * bridge_variance(self.share), 1.0 - self.share
        return self.coming, self.counted, self.repeated, self.wrong, self.wrong_back, *of_lost

    def misses_some(self, unmeasured: NDArray[np.int64]) -> bool:
        """Whether of pixels without a measurement some are not known to be black either (K7)."""
        return bool((self.second.reshape(-1)[unmeasured] >= UNMEASURED).any())


def subthreshold_variance(
    between: float,
    threshold2: float,
    exposed: float = 0.0,
    since: float | None = None,
    half_way: float = RANDOM,
) -> Subthreshold:
    """Variance of the changes that no event has signalled, at a time between two frames.

    Parameters
    ----------
    between
        `kalux.augmentation.bridge.bridge_variance` of the time: 0 at a frame, 1 half-way.
    threshold2
        c^2.
    exposed
        Share of the time for which frames are exposed.
    since
        Where no next frame is used, time since the latest one, in frame intervals: nothing then holds the other end of
        a silent pixel's change. Else None.
    half_way
        That of `Around`.
    """
    unsignalled = between + (1.0 - between) * SUBTHRESHOLD_EXPOSED * exposed**2
    silent = unsignalled * half_way if since is None else min(since, 1.0)
    moving = threshold2 * SUBTHRESHOLD_MOVING
    return Subthreshold(silent, moving * unsignalled, moving)


def changed_within(exposed: float, turns: float) -> float:
    """What share of the time frames would be exposed if a pixel went at random and changed as much within exposures.

    ``exposed`` is the share of the time for which they are, ``turns`` how often the light turns from frame to frame.
    What turns n times has correlations exp(-n a) over a share a of the time: with x = n ``exposed``, its mean over an
    exposure is off the middle by 1 + 2 (x - 1 + exp(-x)) / x^2 - 4 (1 - exp(-x/2)) / x of its variance, and it changes
    by 2 (1 - exp(-n)) of it from frame to frame. Of a random walk, n = 0, the one over the other is ``exposed`` / 12.
    """
    within = turns * exposed
    if within < _FEW_TURNS:
        return exposed
    mean = 2.0 * (within + math.expm1(-within)) / within**2
    off = 1.0 + mean + 4.0 * math.expm1(-within / 2.0) / within
    return -12.0 * off / (2.0 * math.expm1(-turns))


def before_averaging(subthreshold: Subthreshold) -> Subthreshold:
    """The same before spatial averaging (K12)."""
    return Subthreshold(*(BEFORE_AVERAGING * value for value in subthreshold))


@nb.njit(cache=True, inline="always", error_model="numpy")
def known_variance(variance, first, second, events, untold, lost, around):  # type: ignore[no-untyped-def]
    """Variance of L given all frames and events around, from P and the variances of the frames around.

    The next frame, seen through the events that are to come, is information about L besides P. As far as the slope
    follows the frames, the share ``untold`` / V of their mismatch (K1), their noise is in every image, however many
    have been seen. What is ``lost`` came at any time between the frames.
    """
    coming, counted, repeated, wrong, wrong_back, lost_between, lost_after = around
    following = counted + second + coming * events + lost_after * lost
    following += wrong_back * events * events if first >= UNMEASURED else ZERO  # K4
    slope = untold / (first + second + untold)
    known = larger(
        variance * following / (variance + following), repeated * slope * slope * smaller(first, second)
    )
    return known + wrong * events * events + lost_between * lost


def given_variance(
    variance: Array,
    moving: NDArray[np.bool_],
    silent_change: Array,
    subthreshold: Subthreshold,
    around: Around | None,
    left: Array | None = None,
) -> NDArray[np.float32]:
    """(H, W) the variance of log(I + I_0) that an image is given.

    Parameters
    ----------
    variance
        (H, W) P.
    moving
        (H, W): pixels with an event of late.
    silent_change
        (H, W): mean square change of silent pixels around each.
    subthreshold
        From `subthreshold_variance`.
    around
        None: not known, P stands alone.
    left
        (H, W): P and the variance of subthreshold changes after averaging (`kalux.filters.readout.read_out`); None: it
        is not averaged.
    """
    before, above_moving = before_averaging(subthreshold), subthreshold.above_moving
    given = np.empty(variance.shape, np.float32)
    nothing = np.empty(0, np.float32)
    frames: tuple[Array, ...] = (nothing,) * 5
    if around is not None:
        untold = told_by_none(around.untold, around.quantisation_variance, variance.shape)
        lost = nothing if around.lost is None else around.lost
        frames = around.first, around.second, around.events, untold, lost
    planes = variance, silent_change, *frames
    _give(
        *(np.ascontiguousarray(plane, np.float32).reshape(-1) for plane in planes),
        tuple(np.float32(value) for value in ((0.0,) * 7 if around is None else around.scalars())),
        nothing if left is None else left.reshape(-1),
        moving.reshape(-1),
        (np.float32(subthreshold.silent), np.float32(subthreshold.moving)),
        tuple(np.float32(value) for value in _of_intermittent(subthreshold, around)),
        (np.float32(before.moving + before.above_moving), np.float32(above_moving)),
        given.reshape(-1),
    )
    return given


def _of_intermittent(subthreshold: Subthreshold, around: Around | None) -> tuple[float, ...]:
    """Variance of an intermittent pixel half-way, per unit of its surroundings' change and besides, and how much of
    both there is of one that both frames measure, that the first alone does, and that the second alone does.

    Nothing ties a pixel at the frame that does not measure it. At the second frame itself P has grown by that.
    """
    if around is None:
        return (0.0,) * 5
    of_silent, of_moving = SUBTHRESHOLD_INTERMITTENT
    between = subthreshold.moving / subthreshold.untied if subthreshold.untied else 0.0
    away = around.share if around.share < 1.0 else 0.0
    shares = between, between / 2.0 + away, between / 2.0 + 1.0 - around.share
    return of_silent * around.half_way, of_moving * subthreshold.untied, *shares


@loop
def _give(  # type: ignore[no-untyped-def]
    variance,
    change,
    first,
    second,
    events,
    untold,
    lost,
    around,
    left,
    moving,
    subthreshold,
    intermittent,
    untied,
    given,
):
    """`given_variance`, a few pixels at a time: what one step leaves is in the nearer caches for the next.

    No step writes over what it reads, or it would be no vector code.
    """
    averaged, informed = empty(_BLOCK, np.float32), empty(_BLOCK, np.float32)
    waits = zeros(_BLOCK, np.float32)
    for start in range(0, len(given), _BLOCK):
        here = slice(start, min(start + _BLOCK, len(given)))
        known, count = variance[here], len(given[here])
        if len(events):
            if len(left):
                _average_unmeasured(known, left[here], first[here], second[here], untied, averaged[:count])
                known = averaged[:count]
            some = lost[here] if len(lost) else lost
            _inform(
                known, first[here], second[here], events[here], untold[here], some, around, informed[:count]
            )
            _mark_intermittent(
                moving[here], first[here], second[here], events[here], intermittent, waits[:count]
            )
            known = informed[:count]
        _add_subthreshold(known, moving[here], waits, change[here], subthreshold, intermittent, given[here])


@loop(fastmath=FUSED)
def _inform(variance, first, second, events, untold, lost, around, known):  # type: ignore[no-untyped-def]
    """`known_variance` of every pixel."""
    for i in range(np.uint64(len(known))):
        gone = lost[i] if len(lost) else ZERO
        known[i] = known_variance(variance[i], first[i], second[i], events[i], untold[i], gone, around)


@loop(fastmath=FUSED)
def _average_unmeasured(variance, left, first, second, untied, averaged):  # type: ignore[no-untyped-def]
    """P where a frame measures the pixel; else `UNMEASURED_SHARE` of what spatial averaging (K12) leaves of it.

    ``untied`` are the variance of its subthreshold change before averaging, and by how much that is above other moving
    pixels' after it. ``left`` is what averaging makes of P and the former under the correlation `CORRELATED`. That
    relative reduction times `_REDUCTION` is the one under `CORRELATED_UNMEASURED`.
    """
    one, unmeasured, (before, above_moving) = np.float32(1.0), np.float32(UNMEASURED), untied
    share = np.float32(UNMEASURED_SHARE)
    for i in range(np.uint64(len(averaged))):
        reduction = one - np.float32(left[i]) / (variance[i] + before)
        neither = smaller(first[i], second[i]) >= unmeasured
        reduced = share * variance[i] * (one - _REDUCTION * larger(reduction, np.float32(0.0))) + above_moving
        averaged[i] = reduced if neither else variance[i]


@loop
def _mark_intermittent(moving, first, second, events, intermittent, waits):  # type: ignore[no-untyped-def]
    """How much of `_of_intermittent` a pixel has: without an event between the frames, but with one just before, or
    measured by one of the frames alone. 0: it is another."""
    unmeasured = np.float32(UNMEASURED)
    _, _, of_both, of_first, of_second = intermittent
    for i in range(np.uint64(len(waits))):
        by_first, by_second = first[i] < unmeasured, second[i] < unmeasured
        share = of_both if moving[i] else ZERO
        share = share if by_first & by_second else (of_first if by_first else of_second)
        waits[i] = share if (events[i] == ZERO) & (by_first | by_second) else ZERO


@loop(fastmath=FUSED)
def _add_subthreshold(known, moving, waits, change, subthreshold, intermittent, given):  # type: ignore[no-untyped-def]
    """The known variance and that of the subthreshold change: of a silent, an intermittent or a moving pixel."""
    share, of_moving = subthreshold
    per_change, always = intermittent[:2]
    for i in range(np.uint64(len(given))):
        silent = share * change[i]
        active = waits[i] * (per_change * change[i] + always) if waits[i] > ZERO else of_moving
        given[i] = known[i] + (active if moving[i] | (waits[i] > ZERO) else silent)


def add_lag(variance: NDArray[np.float32], intensity: Array, around: Around, lag_variance: float) -> None:
    """Add how far pixels with events are off the light because they are slow, between two frames. In place.

    At a frame they are not, since that says where the light is. Half-way the way to it is off by what the pixel lags
    there, and by half of what it lags at either frame: 1.5 times the variance of that.

    Parameters
    ----------
    variance
        (H, W), contiguous.
    intensity
        (H, W) I.
    around
        Of pixels without an event between the frames, or that neither measures, nothing is added.
    lag_variance
        At `kalux.models.lag.LEVEL`; elsewhere as `kalux.models.lag.lag_growth` has it.
    """
    planes = np.ascontiguousarray(intensity, np.float32), *around[:3]
    most = np.float32(LAG_HALF_WAY * bridge_variance(around.share) * lag_variance)
    _add_lag(variance.reshape(-1), *(plane.reshape(-1) for plane in planes), most)


@loop(fastmath=FUSED)
def _add_lag(variance, intensity, first, second, events, most):  # type: ignore[no-untyped-def]
    unmeasured = np.float32(UNMEASURED)
    for i in range(np.uint64(len(variance))):
        tells = (events[i] > ZERO) & (smaller(np.float32(first[i]), np.float32(second[i])) < unmeasured)
        more = most * lag_growth_at(intensity[i])
        variance[i] += more if tells else ZERO


def add_pattern(
    variance: NDArray[np.float32], intensity: Array, log_offset: float, deviation: float | NDArray[np.float32]
) -> None:
    """Add the variance of log(I + I_0) by offsets of the pixels that all frames share. In place.

    Images have them as the frames do: events tell changes of the light only, and no number of frames averages them.

    Parameters
    ----------
    variance
        (H, W), contiguous.
    intensity
        (H, W) I.
    log_offset
        I_0.
    deviation
        Standard deviation of the offsets, in units of I: a number, or (H, W).
    """
    planes = np.ascontiguousarray(intensity).reshape(-1), np.asarray(deviation, np.float32).reshape(-1)
    _add_pattern(variance.reshape(-1), *planes, np.float32(log_offset))


@nb.njit(cache=True, inline="always", error_model="numpy")
def _of_logarithm(deviation, intensity, log_offset):  # type: ignore[no-untyped-def]
    """Variance of log(I + I_0) by an error of I with this standard deviation."""
    relative = deviation / (intensity + log_offset)
    return relative * relative


@loop(fastmath=FUSED)
def _add_pattern(variance, intensity, deviation, log_offset):  # type: ignore[no-untyped-def]
    every = len(deviation) > 1
    for i in range(np.uint64(len(variance))):
        variance[i] += _of_logarithm(deviation[i] if every else deviation[0], intensity[i], log_offset)


def add_blurred(
    variance: NDArray[np.float32], silent_change: Array, around: Around, exposed: float, threshold2: float
) -> None:
    """Add to the variance of log(I + I_0) how far the middle of an exposure is off its mean. In place.

    Neither neighbours nor the other frame along the paths (K16) know it: they lack the same detail. It counts in full
    at a frame and not at all half-way between two: what silent pixels are off there includes it.

    Parameters
    ----------
    variance
        (H, W), contiguous.
    silent_change
        (H, W): mean square change of silent pixels around each. Of pixels with events it is taken to be the usual one,
        since events deblur what they tell.
    around
        Of pixels that neither frame measures nothing is added.
    exposed
        From `changed_within`.
    threshold2
        c^2.
    """
    planes = np.ascontiguousarray(silent_change, np.float32), *around[:3]
    share = BLURRED * exposed**2 * (1.0 - bridge_variance(around.share))
    scalars = np.float32(share), np.float32(share * UNKNOWN_CHANGE * threshold2)
    _add_blurred(variance.reshape(-1), *(plane.reshape(-1) for plane in planes), *scalars)


@loop(fastmath=FUSED)
def _add_blurred(variance, change, first, second, events, share, of_moving):  # type: ignore[no-untyped-def]
    zero, unmeasured = np.float32(0.0), np.float32(UNMEASURED)
    for i in range(np.uint64(len(variance))):
        hidden = share * change[i] if events[i] == zero else of_moving
        measured = smaller(np.float32(first[i]), np.float32(second[i])) < unmeasured
        variance[i] += hidden if measured else zero


def keep_rounding(
    variance: NDArray[np.float32],
    intensity: Array,
    moving: NDArray[np.bool_],
    log_offset: float,
    deviation: float,
) -> None:
    """Let the variance of still pixels be no less than that of the rounding that their frames share. In place.

    What does not move by a level is rounded the same way in every frame, and no number of frames averages that.

    Parameters
    ----------
    variance
        (H, W), contiguous.
    intensity
        (H, W) I.
    moving
        (H, W): pixels with an event of late, which are rounded in another way by every frame.
    log_offset
        I_0.
    deviation
        Standard deviation of the rounding, in units of I.
    """
    scalars = np.float32(log_offset), np.float32(REPEATED_ROUNDING**0.5 * deviation)
    planes = np.ascontiguousarray(intensity), np.ascontiguousarray(moving)
    _keep_rounding(variance.reshape(-1), *(plane.reshape(-1) for plane in planes), *scalars)


@loop(fastmath=FUSED)
def _keep_rounding(variance, intensity, moving, log_offset, deviation):  # type: ignore[no-untyped-def]
    for i in range(np.uint64(len(variance))):
        least = larger(variance[i], _of_logarithm(deviation, intensity[i], log_offset))
        variance[i] = variance[i] if moving[i] else least


def add_dark_doubt(variance: NDArray[np.float32], intensity: Array, doubt: DarkDoubt) -> None:
    """Add what the mean of frames may be wrong by where noise hides the light below black (K11). In place.

    Parameters
    ----------
    variance
        (H, W), contiguous.
    intensity
        (H, W) I.
    doubt
        By I.
    """
    planes = variance, np.ascontiguousarray(intensity)
    _add_dark_doubt(
        *(plane.reshape(-1) for plane in planes), np.float32(1.0 / doubt.spacing), doubt.variances
    )


@loop(fastmath=FUSED)
def _add_dark_doubt(variance, intensity, per_step, table):  # type: ignore[no-untyped-def]
    last = np.float32(len(table) - 1)
    for i in range(np.uint64(len(variance))):
        place = smaller(larger(np.float32(intensity[i]) * per_step, ZERO), last)
        step = smaller(np.int64(place), len(table) - 2)
        share = place - np.float32(step)
        variance[i] += table[step] + share * (table[step + 1] - table[step])
