"""Event pixels: what each does between two moments, exactly.

Within a segment of time the log intensity of a pixel is linear, and so is the fall of its reference by leakage. The
level that the comparator sees, relative to that reference, is then ``offset + slope u + lag exp(-u / tau)`` at u us
after the segment's start, where tau is the time constant of the pixel's low pass (lag is 0 without one). Its crossings
of the thresholds are solved for, one after the other; noise events come from a Poisson process per pixel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_TOLERANCE = 1e-4  # us, of a crossing


class Segment(NamedTuple):
    """A stretch of time over which each pixel's log intensity is linear.

    ``t0`` and ``t1`` in us; ``before`` and ``after`` the (N,) log intensities at both ends; ``light_before`` and
    ``light_after`` the (N,) radiances plus log offset there, read only where something depends on light.
    """

    t0: float
    t1: float
    before: FloatArray
    after: FloatArray
    light_before: FloatArray
    light_after: FloatArray


class Pixels(NamedTuple):
    """All pixels: what they are, and (N,) arrays of their state, which `advance` changes.

    ``on``, ``off`` (N,) thresholds; ``tau`` us, time constant of the low pass at radiance 1 (0: none); ``leak`` (N,)
    fall of the reference, 1/us; ``noise`` (N,) noise events per us in darkness; ``at_white`` the part of it at white;
    ``log_offset``; ``resets`` whether noise resets; ``refractory``, ``latency`` us.

    ``reference`` (N,) the level last reported; ``level`` (N,) output of the low pass; ``release`` (N,) us until when
    the pixel is held in reset; ``wait`` (N,) expected noise events until the next one; ``random`` (N,) state of the
    pixel's random numbers.
    """

    on: FloatArray
    off: FloatArray
    tau: float
    leak: FloatArray
    noise: FloatArray
    at_white: float
    log_offset: float
    resets: bool
    refractory: float
    latency: float
    reference: FloatArray
    level: FloatArray
    release: FloatArray
    wait: FloatArray
    random: NDArray[np.uint64]


class Buffer(NamedTuple):
    """Events as they are found: t in us, not rounded."""

    t: FloatArray
    pixel: NDArray[np.int64]
    p: NDArray[np.bool_]


class _Curve(NamedTuple):
    """A pixel's level in a segment: offset + slope u + lag exp(-u / tau)."""

    offset: float
    slope: float
    lag: float
    tau: float


def empty_buffer(capacity: int) -> Buffer:
    """A buffer with room for some events; it grows."""
    return Buffer(np.empty(capacity), np.empty(capacity, np.int64), np.empty(capacity, bool))


@numba.njit(cache=True)
def first_waits(random: NDArray[np.uint64]) -> FloatArray:
    """Expected noise events until each pixel's first one; advances the random states."""
    wait = np.empty(len(random))
    for i in range(len(random)):
        wait[i] = _exponential(random, i)
    return wait


@numba.njit(cache=True)
def largest_change(before: FloatArray, after: FloatArray) -> float:
    """Greatest absolute difference of two arrays."""
    largest = 0.0
    for i in range(len(before)):
        largest = max(largest, abs(after[i] - before[i]))
    return largest


@numba.njit(cache=True)
def advance(segment: Segment, pixels: Pixels, buffer: Buffer, count: int) -> tuple[Buffer, int]:
    """Take all pixels through a segment and append their events; returns the buffer and its new count."""
    # Arrays are taken out of their tuples, and quiet pixels passed over here: nearly all pixels are quiet in
    # a segment, and this loop is where the time goes.
    t0, span = segment.t0, segment.t1 - segment.t0
    before, after = segment.before, segment.after
    light_before, light_after = segment.light_before, segment.light_after
    on, off, leak, noise = pixels.on, pixels.off, pixels.leak, pixels.noise
    reference, level, release, wait = pixels.reference, pixels.level, pixels.release, pixels.wait
    for i in range(len(after)):
        slope, lag, tau, end, steady = (after[i] - before[i]) / span, 0.0, 1.0, after[i], True
        if pixels.tau > 0.0:
            tau = pixels.tau / (0.5 * (light_before[i] + light_after[i]))
            lag = level[i] - before[i] + slope * tau
            left = lag * math.exp(-span / tau)
            end = after[i] - slope * tau + left
            # The slope has the same sign at both ends: no turning point between them.
            drift = slope + leak[i]
            steady = (drift - lag / tau) * (drift - left / tau) >= 0.0
        rate = noise[i]
        if rate > 0.0:
            light = min(0.5 * (light_before[i] + light_after[i]) - pixels.log_offset, 1.0)
            rate *= 1.0 + (pixels.at_white - 1.0) * light
        change = end + leak[i] * span - reference[i]
        if (
            -off[i] < change < on[i]
            and steady
            and release[i] <= t0
            and not (rate > 0.0 and rate * span >= wait[i])
        ):
            reference[i] -= leak[i] * span
        else:
            offset = before[i] - slope * tau if pixels.tau > 0.0 else before[i]
            curve = _Curve(offset, slope + leak[i], lag, tau)
            buffer, count = _advance_pixel(t0, span, curve, rate, pixels, buffer, count, i)
        wait[i] -= rate * span
        level[i] = end
    return buffer, count


@numba.njit(cache=True)
def _advance_pixel(
    t0: float, span: float, curve: _Curve, rate: float, pixels: Pixels, buffer: Buffer, count: int, i: int
) -> tuple[Buffer, int]:
    """Take pixel i through a segment, one event after the other."""
    if not pixels.resets:
        while _chance(pixels, rate, i) <= span:
            u = _chance(pixels, rate, i)
            buffer, count = _append(buffer, count, t0 + u + pixels.latency, i, _coin(pixels.random, i))
            pixels.wait[i] += _exponential(pixels.random, i)
        rate = 0.0
    u, reference = 0.0, pixels.reference[i]
    while True:
        held = pixels.release[i] - t0
        if held > u:
            # What noise would have done while the pixel was held is lost.
            while _chance(pixels, rate, i) <= min(held, span):
                pixels.wait[i] += _exponential(pixels.random, i)
            if held > span:
                break
            u = held
            reference = _value(curve, u)
        crossing, p = _next_crossing(curve, reference, pixels.on[i], pixels.off[i], u, span)
        chance = _chance(pixels, rate, i)
        if min(crossing, chance) > span:
            break
        if crossing <= chance:
            u = crossing
            reference += pixels.on[i] if p else -pixels.off[i]
        else:
            u, p = max(chance, u), _coin(pixels.random, i)
            reference = _value(curve, u)
            pixels.wait[i] += _exponential(pixels.random, i)
        if pixels.refractory > 0.0:
            pixels.release[i] = t0 + u + pixels.refractory
        buffer, count = _append(buffer, count, t0 + u + pixels.latency, i, p)
    pixels.reference[i] = reference - pixels.leak[i] * span
    return buffer, count


@numba.njit(cache=True)
def _chance(pixels: Pixels, rate: float, i: int) -> float:
    """Time of pixel i's next noise event, us after the segment's start; infinite without noise."""
    return pixels.wait[i] / rate if rate > 0.0 else np.inf


@numba.njit(cache=True)
def _value(curve: _Curve, u: float) -> float:
    if curve.lag == 0.0:
        return curve.offset + curve.slope * u
    return curve.offset + curve.slope * u + curve.lag * math.exp(-u / curve.tau)


@numba.njit(cache=True)
def _next_crossing(
    curve: _Curve, reference: float, on: float, off: float, u: float, span: float
) -> tuple[float, bool]:
    """Time (us after the segment's start) and polarity of the next threshold crossing; infinite if there is none."""
    if curve.lag == 0.0:
        brighter = curve.slope > 0.0
        target = reference + on if brighter else reference - off
        end = curve.offset + curve.slope * span
        if curve.slope == 0.0 or (end < target if brighter else end > target):
            return np.inf, brighter
        return min(max((target - curve.offset) / curve.slope, u), span), brighter
    turn = span
    ratio = curve.lag / (curve.slope * curve.tau) if curve.slope != 0.0 else 0.0
    if ratio > 0.0:
        turn = min(max(curve.tau * math.log(ratio), u), span)
    begin = u
    for stop in (turn, span):
        if stop > begin:
            first, last = _value(curve, begin), _value(curve, stop)
            if last > first and last >= reference + on:
                return _root(curve, reference + on, begin, stop, True), True
            if last < first and last <= reference - off:
                return _root(curve, reference - off, begin, stop, False), False
            begin = stop
    return np.inf, False


@numba.njit(cache=True)
def _root(curve: _Curve, target: float, begin: float, stop: float, rising: bool) -> float:
    """Where the level, monotonic from begin to stop, reaches the target: Newton's steps, kept between bounds."""
    if (_value(curve, begin) >= target) == rising:
        return begin
    low, high = begin, stop
    u = 0.5 * (low + high)
    for _ in range(100):
        error = _value(curve, u) - target
        if (error > 0.0) == rising:
            high = u
        else:
            low = u
        slope = curve.slope - curve.lag / curve.tau * math.exp(-u / curve.tau)
        following = u - error / slope if slope != 0.0 else low - 1.0
        if not low < following < high:
            following = 0.5 * (low + high)
        if abs(following - u) < _TOLERANCE:
            return following
        u = following
    return u


@numba.njit(cache=True)
def _append(buffer: Buffer, count: int, t: float, pixel: int, p: bool) -> tuple[Buffer, int]:
    if count == len(buffer.t):
        buffer = _grown(buffer)
    buffer.t[count], buffer.pixel[count], buffer.p[count] = t, pixel, p
    return buffer, count + 1


@numba.njit(cache=True)
def _grown(buffer: Buffer) -> Buffer:
    """The buffer with twice its room."""
    n = len(buffer.t)
    t, pixel, p = np.empty(2 * n), np.empty(2 * n, np.int64), np.empty(2 * n, np.bool_)
    for i in range(n):  # of whole arrays, how numba complains of their sizes would take 2 s to compile
        t[i], pixel[i], p[i] = buffer.t[i], buffer.pixel[i], buffer.p[i]
    return Buffer(t, pixel, p)


# Random numbers: SplitMix64 (Steele, Lea, Flood, OOPSLA 2014), one state per pixel, so that a pixel's noise depends
# neither on the other pixels nor on how time is cut into segments.


@numba.njit(cache=True)
def _uniform(random: NDArray[np.uint64], i: int) -> float:
    """Uniform from 0 to 1, 1 excluded."""
    random[i] += np.uint64(0x9E3779B97F4A7C15)
    z = random[i]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) * 2.0**-53


@numba.njit(cache=True)
def _exponential(random: NDArray[np.uint64], i: int) -> float:
    """Exponential of mean 1."""
    return -math.log1p(-_uniform(random, i))


@numba.njit(cache=True)
def _coin(random: NDArray[np.uint64], i: int) -> bool:
    return _uniform(random, i) < 0.5
