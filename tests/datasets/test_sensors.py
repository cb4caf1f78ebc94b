"""Presets: each has a source for every value that is not ideal, and behaves as it says."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from kalux.datasets import PRESETS, SensorSettings, moving_edge, sensor_preset, sensors, simulate, static
from kalux.errors import ExposureError, SettingsError

IDEAL = SensorSettings()


@pytest.mark.parametrize("name", PRESETS)
def test_every_value_of_a_preset_has_a_source(name: str) -> None:
    preset = PRESETS[name]
    changed = {
        field.name
        for field in dataclasses.fields(SensorSettings)
        if getattr(preset.settings, field.name) != getattr(IDEAL, field.name)
    }
    assert changed <= preset.sources.keys()
    assert all(field in {f.name for f in dataclasses.fields(SensorSettings)} for field in preset.sources)


def test_an_unknown_preset_is_named() -> None:
    with pytest.raises(SettingsError, match="no preset 'dvs128'; known are ideal, davis240c"):
        sensor_preset("dvs128")


@pytest.mark.parametrize("name", [name for name in PRESETS if name != "ideal"])
@pytest.mark.parametrize("radiance", [0.0, 0.15, 1.0])
def test_still_pixels_have_the_noise_of_the_preset(name: str, radiance: float) -> None:
    """Noise and leak together; noise resets the reference, so that fewer leak events come than the leak's rate."""
    sensor, size, seconds = PRESETS[name].settings, (60, 80), 4.0
    scene = static(radiance, sensor_size=size, duration=round(seconds * 1e6))
    found = simulate(scene, sensor, seed=2).events
    # The mean of a log-normal is above its median.
    mean = np.exp((np.log(10) * sensor.noise_spread) ** 2 / 2)
    noise = mean * sensor.noise_rate * (1 + (sensor.noise_at_white - 1) * radiance)
    rate = len(found) / seconds / (size[0] * size[1])
    assert 0.97 * noise < rate < 1.03 * (noise + mean * sensor.leak_rate)


@pytest.mark.parametrize(
    "change",
    [
        {"cutoff": -1.0},
        {"latency": -1.0},
        {"leak_rate": float("inf")},
        {"noise_at_white": -0.1},
        {"hot_pixels": 1.0},
        {"auto_exposure": 1.5},
        {"row_time": -1.0},
        {"fixed_offset": float("nan")},
        {"response": "log"},
        {"threshold_on": 1e-300},
        {"log_offset": 1e300},
        {"latency": 1e300},
        {"noise_rate": 1e300},
        {"noise_spread": 1e300},
        {"frame_rate": 1e300},
        {"frame_rate": "25"},
        {"exposure": 10**23},
        {"exposure": None},
        {"timestamp_resolution": 10**23},
        {"reference_exposure": 10**23},
        {"full_well": float("inf")},
    ],
)
def test_settings_out_of_range_are_named(change: dict[str, object]) -> None:
    with pytest.raises(SettingsError, match=next(iter(change))):
        SensorSettings(**change)  # type: ignore[arg-type]


@pytest.mark.parametrize("end", [0, 1], ids=["least", "most"])
@pytest.mark.parametrize("name", sensors._RANGES)
def test_the_ends_of_every_range_can_be_simulated(name: str, end: int) -> None:
    """Events and frames are in order and whole, or the error names what does not fit."""
    value = sensors._RANGES[name][end]
    kind = int if name in {"exposure", "reference_exposure", "timestamp_resolution", "bits"} else float
    quick: dict[str, Any] = {"noise_rate": 1.0, "full_well": 1e4, "read_noise": 0.01, name: kind(value)}
    scene = moving_edge(sensor_size=(4, 6), duration=50_000)
    if (name, end) in {("exposure", 1), ("frame_rate", 1), ("row_time", 1)}:
        with pytest.raises(ExposureError, match="do not fit"):
            simulate(scene, SensorSettings(**quick))
        return
    found = simulate(scene, SensorSettings(**quick))
    assert (np.diff(found.events["t"]) >= 0).all()
    assert found.events["t"].min(initial=0) >= 0
    assert all(frame.image.shape == (4, 6) for frame in found.frames)


def test_light_far_beyond_white_is_white() -> None:
    """Also where the number of its photons is more than an integer holds."""
    scene = static(1e12, sensor_size=(4, 5), duration=100_000)
    frames = simulate(scene, SensorSettings(full_well=1e9, threshold_on=9.0)).frames
    assert frames
    assert all((frame.image == 255).all() for frame in frames)
