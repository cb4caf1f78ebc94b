"""By how much slow pixels are off the light: told by mismatches of successive intervals that undo each other."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kalux.calibration.lag import Lag, estimate_lag
from kalux.datasets import SensorSettings, demo_scene, simulate
from kalux.events import EVENT_DTYPE
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings

from builders import moving_blocks

THRESHOLD = 0.15
CAMERA = CameraSettings(log_offset=0.004, frame_noise=0.002)
EVENTS = EventSettings(threshold_on=THRESHOLD, threshold_off=THRESHOLD, delay=0, refractory_period=0)


def made(cutoff=0.0, **sensor):
    """A scene of a second whose pixels are as fast as light, or slower the darker they are."""
    settings = SensorSettings(
        threshold_on=THRESHOLD,
        threshold_off=THRESHOLD,
        log_offset=0.004,
        cutoff=cutoff,
        frame_rate=25.0,
        **sensor,
    )
    return simulate(demo_scene(sensor_size=(90, 120), duration=1_000_000), settings, seed=1).recording()


def test_slow_pixels_are_told_from_fast_ones():
    """Those of 200 Hz at white are of 4 Hz at 0.02 of it."""
    fast, slow = (estimate_lag(made(cutoff), CAMERA, EVENTS) for cutoff in (0.0, 200.0))
    assert fast.believed < 0.1
    assert slow.believed == min(slow.variance, 4.0) > 1.0
    assert slow.error < 0.3 * slow.variance


def test_errors_of_thresholds_are_no_lag():
    """They are the same in all intervals, or add up from one to the next."""
    different = estimate_lag(made(threshold_mismatch=0.1), CAMERA, EVENTS)
    assert different.believed < 0.3


def test_what_may_be_none_is_not_believed():
    assert Lag(0.5, 0.3, 1000).believed == 0.0
    assert Lag(0.5, 0.2, 1000).believed == 0.5
    assert Lag(-0.5, 0.1, 1000).believed == 0.0


def test_more_than_pixels_lag_is_not_believed():
    assert Lag(17.0, 7.0, 1000).believed == 4.0


def test_noise_of_frames_is_no_lag():
    """It is taken off as far as it is known, whatever of it is in both mismatches."""
    rng = np.random.default_rng(0)
    still = made()
    frames = [
        dataclasses.replace(
            frame, image=np.clip(frame.image + rng.normal(0, 3, frame.image.shape), 0, 255).astype(np.uint8)
        )
        for frame in still.frames()
    ]
    events = np.concatenate(list(still.events()))
    noisy = Recording.from_arrays(events, frames, sensor_size=still.sensor_size)
    told = estimate_lag(noisy, dataclasses.replace(CAMERA, frame_noise=3 / 255), EVENTS)
    untold = estimate_lag(noisy, CAMERA, EVENTS)
    assert told.believed < 0.5 * untold.believed


def test_nothing_that_moves_tells_nothing():
    moving = moving_blocks().recording()
    still = Recording.from_arrays(
        np.empty(0, EVENT_DTYPE), list(moving.frames()), sensor_size=moving.sensor_size
    )
    assert estimate_lag(still, CAMERA, EVENTS) is None


@pytest.mark.parametrize("count", [1, 2])
def test_two_intervals_are_needed(count):
    whole = made()
    frames, events = list(whole.frames())[:count], np.concatenate(list(whole.events()))
    until = events["t"] <= frames[-1].exposure_end
    few = Recording.from_arrays(events[until], frames, sensor_size=whole.sensor_size)
    assert estimate_lag(few, CAMERA, EVENTS) is None
