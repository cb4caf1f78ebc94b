"""The default filter's event loop and EDI as the equations are printed: what `speed.py` compares kalux with.

One float64 array per quantity, P rather than its inverse, a branch per polarity, loops over the neighbourhood, an
exponential per event: docs/equations.md, K1, K4 and K5, and equations (17), (20) and (21), as
`tests/naive.py` has them, only event by event. The functions can be compiled by numba, and run as plain Python too.
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
