"""Rounding to 8 and 16 bits."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kalux.display import to_uint8, to_uint16


@given(st.integers(0, 65535))
def test_integers_are_rounded_to_nearest(level):
    assert to_uint16(np.array([[level / 65535]]))[0, 0] == level
    assert to_uint8(np.array([[level / 65535]]))[0, 0] == round(level / 65535 * 255)


def test_integers_are_clipped():
    np.testing.assert_array_equal(to_uint8(np.array([[-1.0, 2.0]])), [[0, 255]])


@given(st.lists(st.floats(-1.0, 2.0, width=32), min_size=1, max_size=70))
def test_integers_are_rounded_to_the_nearest(values):
    for to_integer, top in ((to_uint8, 255), (to_uint16, 65535)):
        exact = np.clip(np.float64(np.float32(values)), 0, 1) * top
        assert np.abs(to_integer(np.float32(values)) - exact).max() <= 0.505  # where the product is a float32
