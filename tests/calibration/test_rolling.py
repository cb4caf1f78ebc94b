"""The time from row to row of a rolling shutter."""

from __future__ import annotations

import numpy as np
import pytest

from kalux import Recording
from kalux.calibration.rolling import estimate_row_time
from kalux.datasets import SensorSettings, photograph_scene, simulate
from kalux.datasets.motion import pan
from kalux.settings import CameraSettings

from builders import blocks


def recorded(row_time, size=(64, 48), duration=600_000):
    sensor = SensorSettings(threshold_on=0.15, threshold_off=0.15, row_time=row_time, exposure=2_000)
    scene = photograph_scene(blocks(0.05, 0.6), pan(60.0, 25.0), sensor_size=size, duration=duration)
    return simulate(scene, sensor).recording()


@pytest.mark.parametrize("row_time", [150.0, 250.0])
def test_it_is_found_to_a_tenth(row_time):
    assert estimate_row_time(recorded(row_time), CameraSettings()) == pytest.approx(row_time, rel=0.1)


def test_a_global_shutter_has_none():
    assert estimate_row_time(recorded(0.0), CameraSettings()) is None


def test_where_nothing_moves_nothing_tells():
    recording = recorded(200.0)
    frames = [*recording.frames()]
    still = Recording.from_arrays(
        np.concatenate([*recording.events()])[::500], frames, sensor_size=recording.sensor_size
    )
    assert estimate_row_time(still, CameraSettings()) is None
