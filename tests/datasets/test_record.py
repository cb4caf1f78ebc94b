"""Simulations written while they are made: the same as in memory, in bounded memory, whole or not there."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import kalux
from kalux.datasets import Scene, SensorSettings, moving_edge, sensor_preset, simulate
from kalux.datasets.record import record
from kalux.datasets.sensors import CameraResponse
from kalux.datasets.simulate import truth_times
from kalux.errors import InputError, SettingsError

SENSOR = dataclasses.replace(
    sensor_preset("davis240c").settings, noise_rate=20.0, auto_exposure=0.3, exposure=4000
)


@pytest.mark.parametrize("exposures", [None, [3000, 5000, 9000] * 8 + [1000]])
def test_the_file_is_the_simulation(tmp_path: Path, exposures: list[int] | None) -> None:
    scene = moving_edge(0.05, 3.0, sensor_size=(12, 16))
    simulation = simulate(scene, SENSOR, seed=7, exposures=exposures)
    told = record(tmp_path / "a.h5", scene, SENSOR, seed=7, exposures=exposures)
    found, expected = kalux.open(tmp_path / "a.h5"), simulation.recording()
    events = np.concatenate(list(found.events()))
    assert np.array_equal(events, simulation.events)
    for a, b in zip(found.frames(), expected.frames(), strict=True):
        assert np.array_equal(a.image, b.image)
        assert (a.exposure_start, a.exposure_end) == (b.exposure_start, b.exposure_end)
    truth = found.ground_truth()
    assert truth is not None
    assert np.array_equal(truth.times, simulation.truth_times())
    assert np.array_equal(truth.images, simulation.truth().images)
    assert found.contrast_threshold == (SENSOR.threshold_on, SENSOR.threshold_off)
    assert told[:4] == (len(events), int(events["p"].sum()), 25, len(truth.times))
    lengths = simulation.exposures.lengths
    assert told.exposures == (lengths.min(), lengths.max())


@pytest.mark.parametrize(
    ("response", "stated"), [("srgb", "srgb"), ("linear", None), (np.sqrt, None)], ids=str
)
def test_the_response_is_stated(tmp_path: Path, response: CameraResponse, stated: str | None) -> None:
    """Unless it is the usual one, or has no name: a reconstruction would take its frames for linear."""
    scene = moving_edge(0.05, 3.0, sensor_size=(12, 16))
    sensor = SensorSettings(response=response)
    record(tmp_path / "a.h5", scene, sensor)
    assert kalux.open(tmp_path / "a.h5").response == stated
    assert simulate(scene, sensor).recording().response == stated


def test_the_same_bytes_again(tmp_path: Path) -> None:
    scene = moving_edge(0.05, 3.0, duration=300_000)
    for name in ("a.h5", "b.h5"):
        record(tmp_path / name, scene, SENSOR, seed=7)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_truth_at_a_rate(tmp_path: Path) -> None:
    scene = moving_edge(duration=500_000)
    record(tmp_path / "a.h5", scene, SensorSettings(frame_rate=20), truth_rate=100.0)
    truth = kalux.open(tmp_path / "a.h5").ground_truth()
    assert truth is not None
    assert truth.times.tolist() == list(range(25_000, 480_001, 10_000))
    assert np.allclose(truth.images[3], scene.at(55_000.0))


def test_short_recordings_have_truth_too() -> None:
    simulation = simulate(moving_edge(duration=100_000), SensorSettings(frame_rate=20))
    assert truth_times(simulation.exposures).tolist() == [25_000, 50_000, 75_000]


def test_progress_reaches_the_end(tmp_path: Path) -> None:
    told: list[float] = []
    record(tmp_path / "a.h5", moving_edge(duration=200_000), on_time=told.append)
    assert told[-1] == 200_000


def test_an_error_leaves_nothing(tmp_path: Path) -> None:
    edge = moving_edge(duration=400_000)

    def broken(t: float) -> np.ndarray:
        return edge.radiance(t) * (np.nan if 250_000 < t < 251_000 else 1.0)

    with pytest.raises(InputError, match="negative or not finite"):
        record(tmp_path / "a.h5", Scene(broken, edge.sensor_size, 0, 400_000, "broken"))
    with pytest.raises(InputError, match="too short for one frame"):
        record(tmp_path / "a.h5", moving_edge(duration=20_000))
    with pytest.raises(SettingsError, match="seed"):
        record(tmp_path / "a.h5", edge, seed=-1)
    with pytest.raises(InputError, match="images of truth per second"):
        record(tmp_path / "a.h5", edge, truth_rate=0.0)
    assert list(tmp_path.iterdir()) == []


def test_memory_does_not_grow_with_length(tmp_path: Path) -> None:
    """Chunks are given out as they come: none holds more than a moment of a long, noisy recording."""
    from kalux.datasets import Sampling, static
    from kalux.datasets.event_stream import event_chunks

    scene = static(0.5, sensor_size=(40, 50), duration=3_000_000)
    sensor = SensorSettings(noise_rate=100.0)
    sizes = [len(c) for c in event_chunks(scene, sensor, seed=0, sampling=Sampling(), chunk=5000)]
    assert sum(sizes) == pytest.approx(600_000, rel=0.01)
    assert max(sizes) < 7000
