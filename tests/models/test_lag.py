"""How far slow pixels are off the light, by how dark it is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.models.lag import DARKEST, LEVEL, lag_growth


@given(st.floats(DARKEST, 100.0))
def test_a_quarter_of_the_light_is_eight_times_the_variance(intensity):
    brighter, darker = lag_growth(np.array([4 * intensity, intensity]))
    assert darker == pytest.approx(8 * brighter)


def test_it_is_stated_at_a_level_and_bounded_in_black():
    assert lag_growth(np.array([LEVEL]))[0] == 1.0
    assert lag_growth(np.array([0.0]))[0] == lag_growth(np.array([DARKEST]))[0] == pytest.approx(8.0)
