"""The neighbourhood of a pixel."""

from __future__ import annotations

import numpy as np

from kalux.filters.common import newest_around


def test_the_neighbourhood_is_clipped_at_the_border():
    newest = np.arange(12, dtype=np.int64).reshape(3, 4)
    assert newest_around(newest, 0, 0) == 5
    assert newest_around(newest, 2, 3) == 11
    assert newest_around(newest, 1, 1) == 10
