"""Pictures to check a registration by."""

from __future__ import annotations

import numpy as np

from kalux import Frame
from kalux.calibration.offset import Correlation
from kalux.calibration.pictures import correlation_plot, overlay

from builders import events


def test_events_lie_on_their_pixels_and_masked_ones_are_dim():
    frame = Frame(np.full((4, 6), 255, np.uint8), 0, 1, valid=np.arange(24).reshape(4, 6) < 12)
    picture = overlay(frame, events((0, 1, 2, 1), (1, 4, 0, 0)), scale=2)
    assert picture.shape == (8, 12, 3)
    assert picture[4, 2].tolist() == [60, 60, 255]
    assert picture[0, 8].tolist() == [255, 140, 40]
    assert picture[0, 0].tolist() == [255, 255, 255]
    assert 0 < picture[7, 0, 0] < 100


def test_the_plot_marks_the_offset():
    grid = np.arange(-100_000, 100_001, 1_000)
    curve = np.exp(-(((grid - 20_000) / 10_000) ** 2))
    found = Correlation(20_000.0, 100.0, 1.0, float("inf"), grid, curve, True)
    picture = correlation_plot(found, offset=20_000.0, standard_error=100.0)
    red = (picture[:, :, 2] > 180) & (picture[:, :, 0] < 100)
    columns = np.flatnonzero(red.sum(axis=0) > 200)
    assert columns.min() < 450 < columns.max()
    left = (columns[columns < 450].mean() - 60) / (450 - 90)
    assert abs(left - 0.6) < 0.02  # 20 ms of -100 to 100
