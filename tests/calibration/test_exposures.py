"""What events within an exposure say of the mean that a frame shows."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.calibration import exposures as module
from kalux.calibration.exposures import Exposures, bends
from kalux.filters.shots import take_shot
from kalux.models.camera import Camera

from builders import pixel_events, random_stream


def test_one_step_within_an_exposure():
    """At a third of it the light falls by 0.5; the event at the start is no part of it."""
    found = bends(pixel_events([0, 4_000], [1, 0]), (1, 1), 0, 12_000, (0.4, 0.5))
    log_mean = np.log((1 + 2 * np.exp(-0.5)) / 3)
    assert found.over_mean[0, 0] == pytest.approx(log_mean + 2 * 0.5 / 3)
    assert found.over_middle[0, 0] == pytest.approx(log_mean + 0.5)


def test_a_path_looked_at_every_microsecond():
    """Of a pixel with several events: mean of the light, mean of its logarithm, and its middle, one by one."""
    times, signs = [130, 400, 401, 720, 999], [1, 1, 0, 0, 1]
    found = bends(pixel_events(times, signs), (1, 1), 100, 1_100, (0.2, 0.3))
    level = np.zeros(1_000)
    for t, sign in zip(times, signs, strict=True):
        level[t - 100 :] += 0.2 if sign else -0.3
    log_mean = np.log(np.mean(np.exp(level)))
    assert found.over_mean[0, 0] == pytest.approx(log_mean - level.mean(), abs=1e-6)
    assert found.over_middle[0, 0] == pytest.approx(log_mean - level[500], abs=1e-6)


@given(st.lists(st.tuples(st.integers(1, 999), st.integers(0, 1)), max_size=12))
def test_a_mean_is_no_less_than_the_mean_of_its_logarithm(events):
    """Jensen's inequality; and as much where nothing happens, or the exposure has no length."""
    times, signs = zip(*sorted(events), strict=True) if events else ((), ())
    stream = pixel_events(list(times), list(signs))
    found = bends(stream, (1, 2), 0, 1_000, (0.3, 0.2))
    assert found.over_mean[0, 0] >= -1e-6
    assert found.over_mean[0, 1] == found.over_middle[0, 1] == 0
    assert bends(stream, (1, 1), 500, 500, (0.3, 0.2)).over_mean[0, 0] == 0


def test_each_exposure_is_integrated_once(monkeypatch):
    """And what is kept of it is what its own events say."""
    stream, delay, integrated = random_stream(4), 1_500, []
    size, thresholds = stream.sensor_size, (0.2, 0.3)

    def watched(events, sensor_size, start, end, thresholds):
        integrated.append(start - delay)
        return bends(events, sensor_size, start, end, thresholds)

    monkeypatch.setattr(module, "bends", watched)
    exposures = Exposures(size, delay, thresholds)
    shots = [take_shot(one, Camera.named("linear", 0.98), 10_000.0) for one in stream.frames]
    found = [exposures.of(*pair, stream.events) for pair in itertools.pairwise(shots)]
    assert integrated == [shot.start for shot in shots]
    for both, pair in zip(found, itertools.pairwise(shots), strict=True):
        for one, shot in zip(both, pair, strict=True):
            alone = bends(stream.events, size, shot.start + delay, shot.end + delay, thresholds)
            np.testing.assert_array_equal(one.over_mean, alone.over_mean)
            np.testing.assert_array_equal(one.over_middle, alone.over_middle)
