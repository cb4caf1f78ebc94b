"""What is known of single event pixels."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.errors import InputError
from kalux.models.pixels import PixelCalibration, with_hot

NONE = np.zeros((2, 3), np.bool_)
ONE = np.array([[False, True, False], [False, False, False]])


def calibration(hot):
    factor = np.full(hot.shape, 1.1)
    return PixelCalibration(factor, factor, factor - 1, factor - 1, hot)


def test_without_hot_pixels_a_calibration_stays_what_it_is():
    assert with_hot(None, NONE, 0.1) is None
    known = calibration(ONE)
    assert with_hot(known, NONE, 0.1) is known


def test_hot_pixels_of_no_calibration_leave_the_thresholds_nominal():
    made = with_hot(None, ONE, 0.1)
    assert made is not None
    assert (made.hot == ONE).all()
    assert (made.on == 1).all()
    assert (made.off == 1).all()
    assert (made.on_variance == 0.1**2).all()
    assert (made.off_variance == 0.1**2).all()


def test_hot_pixels_join_those_of_a_calibration():
    other = np.roll(ONE, 1)
    made = with_hot(calibration(other), ONE, 0.1)
    assert made is not None
    assert (made.hot == (ONE | other)).all()
    assert (made.on == 1.1).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.int64, float])
def test_hot_pixels_are_true_and_false(dtype):
    """Numbers would choose events by their place."""
    with pytest.raises(InputError, match=rf"hot is {np.dtype(dtype)}; True and False"):
        calibration(ONE.astype(dtype))
