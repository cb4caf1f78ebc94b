"""The filters' event loops and EDI as the equations are printed: what `speed.py` compares kalux with.

One float64 array per quantity, P rather than its inverse, a branch per polarity, loops over the neighbourhood, an
exponential per event: docs/equations.md, K1, K4 and K5, and equations (17), (20) and (21) for the default filter, (2),
(7), (9), (10), (11), (13), (15), (17), (20) and (21) for the paper's, as `tests/naive.py` has them, only event by
event. The functions can be compiled by numba, and run as plain Python too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

US = 1e-6


class LiteralState(NamedTuple):
    """(H, W) arrays: the state, L^A, what is known of it, and times in us."""

    value: np.ndarray
    variance: np.ndarray
    augmented: np.ndarray
    slope: np.ndarray
    step_on: np.ndarray
    step_off: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    since: np.ndarray
    newest: np.ndarray


def advance(events, state, rate, step_variance, noise_rate, event_variance, threshold2):
    """Take every event in turn."""
    height, width = state.value.shape
    for i in range(len(events)):
        event = events[i]
        t, x, y = event["t"], np.int64(event["x"]), np.int64(event["y"])
        seconds = (t - state.since[y, x]) * US
        covariance = 1.0 / (rate * (1.0 / state.forward[y, x] + 1.0 / state.backward[y, x]))  # K4
        variance = 1.0 / (1.0 / state.variance[y, x] + seconds / covariance)  # (20)
        deviation = state.value[y, x] - state.augmented[y, x]
        deviation = deviation / state.variance[y, x] * variance  # (17)
        augmented = state.augmented[y, x] + state.slope[y, x] * seconds
        newest = state.newest[y, x]
        for row in range(max(y - 1, 0), min(y + 2, height)):
            for column in range(max(x - 1, 0), min(x + 2, width)):
                newest = max(newest, state.newest[row, column])
        signal = 1.0 / (1.0 + (9.0 * noise_rate * (t - newest) * US) ** 2)  # K5
        if event["p"]:
            step = state.step_on[y, x]
        else:
            step = -state.step_off[y, x]
        state.value[y, x] = augmented + deviation + signal * step
        state.variance[y, x] = variance + threshold2 * (event_variance + signal * (1.0 - signal))  # (21)
        state.augmented[y, x] = augmented + step
        state.forward[y, x] += step_variance
        state.backward[y, x] -= step_variance
        state.since[y, x] = t
        state.newest[y, x] = t


class PaperState(NamedTuple):
    """(H, W) arrays of the paper's filter: the state, L^A of (10) and (11) with their c_p, R, and times in us.

    R (9) at the middles of the frames before and at the exposure, with the intensity of the frame before it, and at
    those of this frame and the next, with that of this one.
    """

    value: np.ndarray
    variance: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    scale_before: np.ndarray
    scale_after: np.ndarray
    r_before: np.ndarray
    r_at: np.ndarray
    r_from: np.ndarray
    r_after: np.ndarray
    since: np.ndarray
    newest: np.ndarray


class PaperScalars(NamedTuple):
    """Times in us (an exposure, and the middles around it), thresholds, and the noise of (2)."""

    start: int
    exposure_end: int
    previous_middle: int
    middle: int
    next_middle: int
    step_on: float
    step_off: float
    sigma_proc2: float
    sigma_iso2: float
    sigma_ref2: float
    refractory_bound: float


def advance_paper(events, state, scalars):
    """Take every event in turn through the paper's filter, from the start of one exposure to that of the next."""
    height, width = state.value.shape
    exposure = scalars.exposure_end - scalars.start
    for i in range(len(events)):
        event = events[i]
        t, x, y = event["t"], np.int64(event["x"]), np.int64(event["y"])
        since = state.since[y, x]
        seconds = (t - since) * US
        if t >= scalars.middle:  # (7), (9)
            u = (t - scalars.middle) / (scalars.next_middle - scalars.middle)
            covariance = (1.0 - u) * state.r_from[y, x] + u * state.r_after[y, x]
        else:
            u = (t - scalars.previous_middle) / (scalars.middle - scalars.previous_middle)
            covariance = (1.0 - u) * state.r_before[y, x] + u * state.r_at[y, x]
        variance = 1.0 / (1.0 / state.variance[y, x] + seconds / covariance)  # (20)
        u = min((since - scalars.start) / exposure, 1.0)
        deviation = state.value[y, x] - ((1.0 - u) * state.forward[y, x] + u * state.backward[y, x])  # (13)
        deviation = deviation / state.variance[y, x] * variance  # (17)
        u = min((t - scalars.start) / exposure, 1.0)
        augmented = (1.0 - u) * state.forward[y, x] + u * state.backward[y, x]
        newest = state.newest[y, x]
        noise = scalars.sigma_proc2 * (t - newest) * US  # (2)
        if (t - newest) * US <= scalars.refractory_bound:
            noise += scalars.sigma_ref2
        for row in range(max(y - 1, 0), min(y + 2, height)):
            for column in range(max(x - 1, 0), min(x + 2, width)):
                newest = max(newest, state.newest[row, column])
        noise += scalars.sigma_iso2 * (t - newest) * US
        if event["p"]:
            step = scalars.step_on
        else:
            step = -scalars.step_off
        state.value[y, x] = augmented + deviation + step  # (15)
        state.variance[y, x] = variance + noise  # (21)
        state.forward[y, x] += state.scale_before[y, x] * step  # (10)
        state.backward[y, x] += state.scale_after[y, x] * step  # (11)
        state.since[y, x] = t
        state.newest[y, x] = t


def integrate(events, start, end, step_on, step_off):
    """What EDI says of an exposure: log of the mean of exp E, E at the middle and the end, its peak, events."""
    shape = step_on.shape
    mean, level, since = np.zeros(shape), np.zeros(shape), np.full(shape, start, np.int64)
    to_middle, peak, number = np.zeros(shape), np.zeros(shape), np.zeros(shape, np.int64)
    for i in range(len(events)):
        event = events[i]
        t, x, y = event["t"], np.int64(event["x"]), np.int64(event["y"])
        mean[y, x] += np.exp(level[y, x]) * (t - since[y, x])
        since[y, x] = t
        if event["p"]:
            level[y, x] += step_on[y, x]
        else:
            level[y, x] -= step_off[y, x]
        peak[y, x] = max(peak[y, x], level[y, x])
        number[y, x] += 1
        if t <= (start + end) // 2:
            to_middle[y, x] = level[y, x]
    mean += np.exp(level) * (end - since)
    return np.log(mean / (end - start)), to_middle, level, peak, number


def store(events, newest):
    """The least that any event loop does: one random access per event."""
    for i in range(len(events)):
        newest[events[i]["y"], events[i]["x"]] = events[i]["t"]
