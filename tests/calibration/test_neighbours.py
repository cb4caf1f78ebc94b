"""What calibrations ask of the pixels around each."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.calibration.neighbours import sum_of_neighbours


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int16])
def test_all_eight_count_and_nothing_lies_beyond_the_border(dtype):
    values = np.random.default_rng(0).integers(0, 9, (4, 6)).astype(dtype)
    wide = np.pad(values, 1)
    expected = [
        [wide[row : row + 3, column : column + 3].sum() - values[row, column] for column in range(6)]
        for row in range(4)
    ]
    found = sum_of_neighbours(values)
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == dtype
