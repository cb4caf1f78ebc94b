"""By how much slow pixels are off the light: told by mismatches of successive intervals that undo each other."""

from __future__ import annotations

import dataclasses

from kalux.calibration.lag import Lag, estimate_lag
from kalux.settings import CameraSettings, EventSettings

from builders import moving_blocks, slow_scene, with_frame_noise, without_any_events

THRESHOLD = 0.15
CAMERA = CameraSettings(log_offset=0.004, frame_noise=0.002)
EVENTS = EventSettings(threshold_on=THRESHOLD, threshold_off=THRESHOLD, delay=0, refractory_period=0)


def test_slow_pixels_are_told_from_fast_ones():
    """Those of 200 Hz at white are of 4 Hz at 0.02 of it."""
    fast, slow = (estimate_lag(slow_scene(cutoff), CAMERA, EVENTS) for cutoff in (0.0, 200.0))
    assert fast.believed < 0.1
    assert slow.believed == min(slow.variance, 4.0) > 1.0
    assert slow.error < 0.3 * slow.variance


def test_errors_of_thresholds_are_no_lag():
    """They are the same in all intervals, or add up from one to the next."""
    different = estimate_lag(slow_scene(0.0, mismatch=0.1), CAMERA, EVENTS)
    assert different.believed < 0.3


def test_what_may_be_none_is_not_believed():
    assert Lag(0.5, 0.3, 1000).believed == 0.0
    assert Lag(0.5, 0.2, 1000).believed == 0.5
    assert Lag(-0.5, 0.1, 1000).believed == 0.0


def test_more_than_pixels_lag_is_not_believed():
    assert Lag(17.0, 7.0, 1000).believed == 4.0


def test_noise_of_frames_is_no_lag():
    """It is taken off as far as it is known, whatever of it is in both mismatches."""
    noisy = with_frame_noise(slow_scene(0.0), 3.0)
    told = estimate_lag(noisy, dataclasses.replace(CAMERA, frame_noise=3 / 255), EVENTS)
    untold = estimate_lag(noisy, CAMERA, EVENTS)
    assert told.believed < 0.5 * untold.believed


def test_nothing_that_moves_tells_nothing():
    still = without_any_events(moving_blocks().recording())
    assert estimate_lag(still, CAMERA, EVENTS) is None
