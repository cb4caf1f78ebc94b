"""What events within an exposure say of the mean that a frame shows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.augmentation.deblur import integrate_exposure
from kalux.calibration.exposures import bends

from builders import pixel_events, random_stream


def test_one_step_within_an_exposure():
    """At a third of it the light falls by 0.5; the event at the start is no part of it."""
    found = bends(pixel_events([0, 4_000], [1, 0]), (1, 1), 0, 12_000, (0.4, 0.5))
    log_mean = np.log((1 + 2 * np.exp(-0.5)) / 3)
    assert found.over_mean[0, 0] == pytest.approx(log_mean + 2 * 0.5 / 3)
    assert found.over_middle[0, 0] == pytest.approx(log_mean + 0.5)


def test_it_is_the_integral_that_the_filters_deblur_with():
    stream = random_stream(4)
    for shot in stream.frames:
        start, end = shot.exposure_start, shot.exposure_end
        found = bends(stream.events, stream.sensor_size, start, end, (0.2, 0.3))
        steps = (np.full(stream.sensor_size, threshold) for threshold in (0.2, 0.3))
        integrals = integrate_exposure(stream.events, start, end, *steps)
        np.testing.assert_allclose(found.over_middle, integrals.log_mean - integrals.to_middle, atol=1e-5)


@given(st.lists(st.tuples(st.integers(1, 999), st.integers(0, 1)), max_size=12))
def test_a_mean_is_no_less_than_the_mean_of_its_logarithm(events):
    """Jensen's inequality; and as much where nothing happens, or the exposure has no length."""
    times, signs = zip(*sorted(events), strict=True) if events else ((), ())
    stream = pixel_events(list(times), list(signs))
    found = bends(stream, (1, 2), 0, 1_000, (0.3, 0.2))
    assert found.over_mean[0, 0] >= -1e-12
    assert found.over_mean[0, 1] == found.over_middle[0, 1] == 0
    assert bends(stream, (1, 1), 500, 500, (0.3, 0.2)).over_mean[0, 0] == 0
