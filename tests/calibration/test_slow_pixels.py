"""One pass over a recording for several that look at it."""

from __future__ import annotations

from itertools import pairwise

from kalux.calibration.dark_steps import DarkSamples, estimate_dark_steps
from kalux.calibration.lag import LagSums, estimate_lag
from kalux.calibration.slow_pixels import observe
from kalux.settings import CameraSettings, EventSettings

from builders import slow_scene

CAMERA = CameraSettings(log_offset=0.004, frame_noise=0.002)
EVENTS = EventSettings(
    threshold_on=0.15,
    threshold_off=0.15,
    delay=0,
    refractory_period=0,
    threshold_spread=0.02,
    step_variance=0.05,
)


class Counting:
    """Looks at as many intervals as it is told."""

    def __init__(self, most):
        self.most, self.seen = most, []

    @property
    def enough(self):
        return len(self.seen) >= self.most

    def add(self, counted):
        self.seen.append((counted.interval.start, counted.interval.end))


def test_each_sees_as_many_intervals_as_it_needs_in_order():
    few, more = Counting(2), Counting(5)
    observe(slow_scene(200.0), CAMERA, EVENTS, few, more)
    assert (len(few.seen), len(more.seen)) == (2, 5)
    assert more.seen[:2] == few.seen
    assert all(before[1] == after[0] for before, after in pairwise(more.seen))


def test_together_they_find_what_each_finds_alone():
    source = slow_scene(200.0)
    dark, lag = DarkSamples(CAMERA, EVENTS), LagSums(source.sensor_size, CAMERA, EVENTS)
    observe(source, CAMERA, EVENTS, dark, lag)
    assert dark.found == estimate_dark_steps(source, CAMERA, EVENTS) is not None
    assert lag.found == estimate_lag(source, CAMERA, EVENTS) is not None


def test_what_has_seen_nothing_finds_nothing():
    assert DarkSamples(CAMERA, EVENTS).found is None
    assert LagSums((90, 120), CAMERA, EVENTS).found is None
