"""Frames: rolling shutter, automatic exposure, fixed pattern; the rest is in test_simulate."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.datasets import Scene, SensorSettings, linear_ramp, log_ramp, moving_edge, simulate, static
from kalux.datasets.exposure import mean_radiance, plan_exposures, rolling_radiance
from kalux.datasets.scenes import LOG_OFFSET
from kalux.errors import ExposureError
from kalux.event_slices import row_delays

SIZE = (8, 10)


# --- rolling shutter --------------------------------------------------------------------------------------


def test_rows_of_a_ramp_are_read_at_their_own_times() -> None:
    row_time = 700.0
    sensor = SensorSettings(bits=16, exposure=12_000, row_time=row_time)
    frames = simulate(linear_ramp(0.2, 0.5), sensor).frames
    for frame in frames:
        middle = (frame.exposure_start + frame.exposure_end) / 2
        times = middle + (np.arange(8) - 3.5) * row_time
        expected = 0.2 + 0.5 * times * 1e-6
        assert np.abs(frame.normalised() - expected[:, None]).max() < 0.5 / 65535 + 1e-9


def test_rows_of_an_exponential_have_its_integral() -> None:
    start, rate, row_time, exposure = 0.1, 8.0, 2000.0, 20_000
    found = rolling_radiance(log_ramp(start, rate), 100_000, 100_000 + exposure, row_time, 500.0)
    a = 0.1 + row_delays(8, row_time) * 1e-6
    b = a + exposure * 1e-6
    integral = (start + LOG_OFFSET) * (np.exp(rate * b) - np.exp(rate * a)) / (rate * (b - a)) - LOG_OFFSET
    assert np.allclose(found, integral[:, None], rtol=1e-5)


@given(
    row_time=st.floats(0.1, 3000.0),
    exposure=st.integers(50, 20_000),
    level=st.floats(0.0, 5.0),
    step=st.floats(30, 2e4),
)
def test_rows_of_a_still_scene_are_its_radiance(
    row_time: float, exposure: int, level: float, step: float
) -> None:
    found = rolling_radiance(static(level), 100_000, 100_000 + exposure, row_time, step)
    assert np.allclose(found, level, rtol=1e-9)


def test_a_moving_edge_leans() -> None:
    """Each row sees the edge where it was at its own time."""
    speed, row_time = 50.0, 4000.0
    scene = moving_edge(0.0, 1.0, speed=speed, sensor_size=(9, 40))
    found = rolling_radiance(scene, 400_000, 401_000, row_time, 100.0)
    place = found.sum(axis=1)
    times = 400_500 + (np.arange(9) - 4) * row_time
    assert place == pytest.approx(speed * times * 1e-6, abs=1e-6)


def test_without_row_time_all_rows_are_alike() -> None:
    scene = log_ramp(0.1, 4.0)
    tiny = rolling_radiance(scene, 100_000, 120_000, 1e-9, 500.0)
    assert np.allclose(tiny, mean_radiance(scene, 100_000, 120_000, 500.0), rtol=1e-5)


def test_rows_must_fit_into_the_scene() -> None:
    with pytest.raises(ExposureError, match="rows 9000 us apart do not fit"):
        plan_exposures(static(), SensorSettings(row_time=9000.0))


# --- automatic exposure -----------------------------------------------------------------------------------


def brightening(factor: float) -> Scene:
    """A scene whose light is multiplied by ``factor`` after a second."""
    return Scene(lambda t: np.full(SIZE, 0.3 if t < 1e6 else 0.3 * factor), SIZE, 0, 3_000_000, "brightening")


@pytest.mark.parametrize("factor", [2.5, 0.4])
def test_exposure_follows_the_light(factor: float) -> None:
    sensor = SensorSettings(bits=16, exposure=4000, auto_exposure=0.3)
    simulation = simulate(brightening(factor), sensor)
    lengths = simulation.exposures.lengths
    assert set(lengths[:24].tolist()) == {4000}
    assert lengths[-1] == pytest.approx(4000 / factor, rel=0.01)
    # The first frame of the new light still has the old exposure; then the error of the logarithm halves.
    errors = np.log(lengths[24:30] / (4000 / factor))
    assert errors[0] == pytest.approx(np.log(factor))
    assert errors[1:] / errors[:-1] == pytest.approx(np.full(5, 0.5), abs=0.01)
    shown = [frame.normalised().mean() for frame in simulation.frames]
    assert shown[-1] == pytest.approx(0.3, rel=0.01)
    assert shown[24] == pytest.approx(min(0.3 * factor, 1.0), rel=0.001)


def test_exposures_leave_time_to_read_out() -> None:
    sensor = SensorSettings(frame_rate=25, exposure=4000, auto_exposure=0.5, row_time=100.0)
    simulation = simulate(static(0.001), sensor)
    assert simulation.exposures.lengths.max() <= 0.95 * 40_000
    assert simulation.exposures.lengths[-1] > 0.9 * 40_000


def test_truth_is_in_units_of_the_median_exposure() -> None:
    """A reconstruction says 1 where a frame of median exposure saturates, and so must the truth."""
    sensor = SensorSettings(bits=16, exposure=4000, auto_exposure=0.15)
    simulation = simulate(static(0.3), sensor)
    median = round(float(np.median(simulation.exposures.lengths)))
    assert median == pytest.approx(2000, rel=0.01)
    frame = next(frame for frame in simulation.frames if frame.exposure == median)
    assert simulation.truth([100_000]).images.mean() == pytest.approx(frame.normalised().mean(), abs=1e-4)
    fixed = simulate(static(0.3), SensorSettings(bits=16, exposure=4000, reference_exposure=8000))
    assert fixed.truth([100_000]).images.mean() == pytest.approx(
        fixed.frames[0].normalised().mean(), abs=1e-4
    )


# --- fixed pattern ----------------------------------------------------------------------------------------


def frames_of(level: float, **changes: Any) -> np.ndarray:
    sensor = SensorSettings(bits=16, **changes)
    scene = static(level, sensor_size=(80, 100), duration=200_000)
    return np.array([frame.normalised() for frame in simulate(scene, sensor, seed=1).frames])


def test_fixed_pattern_is_the_same_in_all_frames() -> None:
    offset = frames_of(0.5, fixed_offset=0.01)
    assert np.ptp(offset, axis=0).max() == 0
    assert offset[0].std() == pytest.approx(0.01, rel=0.03)
    bright, dim = frames_of(0.8, fixed_gain=0.02)[0], frames_of(0.2, fixed_gain=0.02)[0]
    assert bright.std() == pytest.approx(0.016, rel=0.03)
    assert np.allclose(bright, 4 * dim, atol=1e-4)


def test_named_responses() -> None:
    assert frames_of(0.25, response="gamma:2.0").mean() == pytest.approx(0.5, abs=1e-3)
    assert frames_of(0.2140, response="srgb").mean() == pytest.approx(0.5, abs=1e-3)
