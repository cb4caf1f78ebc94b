"""Voxel grids: against a loop, and what they keep."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.evaluation.learned.voxels import normalise, voxel_grid

from builders import events, random_stream


def naive_grid(rows, size, bins):
    """Linear in time, event by event and bin by bin."""
    grid = np.zeros((bins, *size))
    first, last = rows["t"][0], rows["t"][-1]
    for t, x, y, p in rows.tolist():
        at = (bins - 1) * (t - first) / (last - first) if last > first else 0
        for b in range(bins):
            grid[b, y, x] += (1 if p else -1) * max(0.0, 1 - abs(b - at))
    return grid


@pytest.mark.parametrize("bins", [1, 2, 5])
@pytest.mark.parametrize("seed", range(3))
def test_equals_a_loop(seed, bins):
    stream = random_stream(seed)
    found = voxel_grid(stream.events, stream.sensor_size, bins)
    assert found.dtype == np.float32
    assert found == pytest.approx(naive_grid(stream.events, stream.sensor_size, bins), abs=1e-6)


@given(
    st.lists(
        st.tuples(st.integers(0, 10**12), st.integers(0, 3), st.integers(0, 2), st.booleans()), max_size=30
    )
)
def test_polarities_are_kept_pixel_by_pixel(rows):
    """However they are shared between bins, their sum is that of the events."""
    found = voxel_grid(events(*sorted(rows)), (3, 4)).sum(0, dtype=np.float64)
    expected = np.zeros((3, 4))
    for _, x, y, p in rows:
        expected[y, x] += 1 if p else -1
    assert found == pytest.approx(expected, abs=1e-5)


def test_no_events_and_events_of_one_time():
    assert not voxel_grid(events(), (2, 3)).any()
    grid = voxel_grid(events((7, 1, 0, True), (7, 1, 0, True), (7, 2, 1, False)), (2, 3))
    assert grid[0].tolist() == [[0, 2, 0], [0, 0, -1]]
    assert not grid[1:].any()


def test_normalised_values_have_mean_0_and_deviation_1_and_zeros_stay():
    stream = random_stream(4)
    grid = voxel_grid(stream.events, stream.sensor_size)
    grid[2, 1, 1] = 0
    found = normalise(grid)
    assert np.array_equal(found == 0, grid == 0)
    touched = found[grid != 0].astype(float)
    assert touched.mean() == pytest.approx(0, abs=1e-6)
    assert touched.std() == pytest.approx(1, abs=1e-6)


def test_normalising_one_value_everywhere_or_nothing_is_harmless():
    assert not normalise(np.zeros((5, 2, 3), np.float32)).any()
    assert not normalise(np.full((5, 2, 3), 2, np.float32)).any()
