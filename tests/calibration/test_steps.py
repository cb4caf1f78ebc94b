"""Steps of events, spread over the time in which the light made them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kalux import Recording
from kalux.calibration.steps import steps
from kalux.datasets import SensorSettings, simulate
from kalux.datasets.scenes import Scene
from kalux.settings import CameraSettings

from builders import unlabelled

CAMERA = CameraSettings(log_offset=0.004, response="linear")
SIZE = (12, 16)


def swinging(hertz, refractory=0.0, exposure=5_000):
    """Pixels whose light swings by a factor of 5 either way, each at its own time; thresholds 0.2 / 0.25."""
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, SIZE)

    def radiance(t):
        return 0.3 * np.exp(0.8 * np.sin(2 * np.pi * hertz * t * 1e-6 + phase))

    sensor = SensorSettings(threshold_on=0.2, threshold_off=0.25, exposure=exposure, refractory=refractory)
    return unlabelled(simulate(Scene(radiance, SIZE, 0, 1_000_000), sensor, seed=1))


def told(recording, period=0):
    """By pixels: the change that frames show, and what events say of it."""
    (found,) = steps(recording, CAMERA, delays=(0,), periods=(period,), late=np.inf, thresholds=(0.2, 0.25))
    on, off = found.events.sum(axis=(1, 2)).T
    return found.change, (0.2 * on - 0.25 * off) * found.share


def test_the_origin_of_time_does_not_matter():
    """Microseconds since 1970 have no room for halves in float64."""
    recording, origin = swinging(6.0), 1_700_000_000_000_000
    moved = np.concatenate([*recording.events()])
    moved["t"] += origin
    frames = [
        dataclasses.replace(
            frame, exposure_start=frame.exposure_start + origin, exposure_end=frame.exposure_end + origin
        )
        for frame in recording.frames()
    ]
    later = Recording.from_arrays(moved, frames, sensor_size=SIZE)
    for one, other in zip(told(recording), told(later), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("hertz", [2.0, 6.0])
def test_events_say_what_frames_show(hertz):
    """Within four tenths of a threshold, also where the direction turns several times; on average within 3 %."""
    change, said = told(swinging(hertz))
    assert len(change) > 500
    assert np.std(change - said) < 0.09
    assert (said @ change) / (change @ change) == pytest.approx(1.0, abs=0.03)


def test_long_exposures_bend():
    """A frame shows more than the mean of the logarithm where the light swings by a factor of 5 within its exposure."""
    recording = swinging(8.0, exposure=30_000)
    change, said = told(recording)
    (bent,) = steps(recording, CAMERA, delays=(0,), periods=(0,), late=np.inf)
    assert np.std(change - said) < 0.08
    assert np.std(bent.change - said) > 1.3 * np.std(change - said)


def test_what_is_lost_is_made_up_for():
    """2 ms after every event, of some 10 ms between them."""
    lossy = swinging(6.0, refractory=2_000.0)
    change, plain = told(lossy)
    again, said = told(lossy, 2_000)
    assert (plain @ change) / (change @ change) < 0.87
    assert (said @ again) / (again @ again) == pytest.approx(1.0, abs=0.04)


def test_several_delays_are_looked_at_in_one_pass():
    """The same as one after the other, if as much is known of the time before the first frame."""
    recording = swinging(2.0)
    both = steps(recording, CAMERA, delays=(-3_000, 3_000), periods=(0,), late=np.inf)
    for delay, one in zip((-3_000, 3_000), both, strict=True):
        (alone,) = steps(recording, CAMERA, delays=(delay,), periods=(0,), late=np.inf)
        for some, same in zip(one, alone, strict=True):
            np.testing.assert_array_equal(some, same)


def test_fewer_pixels_are_spread_over_intervals():
    """Some pixels of every interval, rather than all of one."""
    recording = swinging(2.0)
    (all_of_them,) = steps(recording, CAMERA, delays=(0,), periods=(0,), late=np.inf)
    (few,) = steps(recording, CAMERA, delays=(0,), periods=(0,), late=np.inf, most=60)
    assert len(all_of_them.change) > 500
    assert 30 <= len(few.change) <= 80
