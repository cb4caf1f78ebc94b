"""By how much more events of dark pixels vary: where these are slow, and not where other things are wrong."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kalux.calibration.dark_steps import estimate_dark_steps
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings

from builders import moving_blocks, slow_scene, with_frame_noise, with_noise_events, without_any_events

THRESHOLD = 0.15
CAMERA = CameraSettings(log_offset=0.004, frame_noise=0.002)
EVENTS = EventSettings(
    threshold_on=THRESHOLD,
    threshold_off=THRESHOLD,
    delay=0,
    refractory_period=0,
    threshold_spread=0.02,
    step_variance=0.05,
)


@pytest.fixture(scope="module")
def slow():
    """200 Hz at white is 4 Hz at 0.02 of it."""
    return slow_scene(200.0)


@pytest.fixture(scope="module")
def fast():
    return slow_scene(0.0)


def test_slow_pixels_are_told_from_fast_ones(slow, fast):
    """The darker, and the slower, the more; none where pixels follow the light."""
    found, faster = (np.array(estimate_dark_steps(one, CAMERA, EVENTS)) for one in (slow, slow_scene(400.0)))
    assert (np.diff(found) >= 0).all()
    assert found[3] > 1.0
    assert found[0] < 0.4 * found[3]
    assert (faster < 0.7 * found).all()
    assert estimate_dark_steps(fast, CAMERA, EVENTS) is None


def test_what_is_more_than_all_steps_have_counts(slow):
    """Where the variance of all is as large already, less is left, and nothing is negative."""
    few, most = (
        estimate_dark_steps(slow, CAMERA, dataclasses.replace(EVENTS, step_variance=step))
        for step in (0.05, 0.4)
    )
    left = np.array(few) - 0.35
    np.testing.assert_allclose(np.array(most), np.where(left < 0.05, 0.0, left), atol=0.06)


def test_no_more_is_believed_than_four_squared_thresholds(fast):
    """An octave has at most that, and what all steps have is taken off."""
    events = np.concatenate(list(fast.events()))
    events["p"] = np.random.default_rng(0).random(len(events)) < 0.5
    wrong = Recording.from_arrays(events, list(fast.frames()), sensor_size=fast.sensor_size)
    found = estimate_dark_steps(wrong, CAMERA, EVENTS)
    assert max(found) <= 4.0 - EVENTS.step_noise


def test_noise_of_frames_is_not_the_events(fast):
    """It is taken off as far as it is known."""
    noisy = with_frame_noise(fast, 3.0)
    untold = estimate_dark_steps(noisy, CAMERA, EVENTS)
    told = estimate_dark_steps(noisy, dataclasses.replace(CAMERA, frame_noise=3 / 255), EVENTS)
    assert max(untold) > 0.3
    assert told is None or max(told) < 0.3 * max(untold)


def test_events_of_noise_are_not_slow_pixels(fast):
    """They are taken off, too, as far as their rate is known."""
    noisy = with_noise_events(fast, 20.0)
    untold, told = (estimate_dark_steps(noisy, CAMERA, EVENTS, known) for known in (0.0, 20.0))
    assert max(untold) > 0.3
    assert told is None or max(told) < 0.5 * max(untold)


def test_nothing_that_moves_tells_nothing():
    still = without_any_events(moving_blocks().recording())
    assert estimate_dark_steps(still, CAMERA, EVENTS) is None
