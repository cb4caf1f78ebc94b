"""One pixel: its events, and the differential equations of the filter by a general solver."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from kalux.augmentation.refractory import EventClock
from kalux.events import make_events

US = 1e-6
ONE = np.ones((1, 1))
levels = st.floats(-3, 2)
variances = st.floats(1e-4, 0.5)


def events_at(times, polarity):
    zeros = np.zeros(len(times), np.int64)
    events = make_events(np.array(times, np.int64), zeros, zeros, np.array(polarity, bool))
    return EventClock((1, 1), 0).weighed(events)


def integrate(rates, start, end, value, variance):
    """L and P from (14) without events and (19); ``rates(t)`` is dL^A/dt shared by L, L^A and R at t (us)."""

    def derivative(t, y):
        drift, augmented, covariance = rates(t)
        gain = y[1] / covariance  # (18)
        return [(drift - gain * (y[0] - augmented)) * US, -(y[1] ** 2) / covariance * US]

    solution = solve_ivp(
        derivative,
        (start, end),
        [value, variance],
        rtol=1e-11,
        atol=1e-13,
        method="LSODA",
        max_step=(end - start) / 50,
    )
    return solution.y[:, -1]
