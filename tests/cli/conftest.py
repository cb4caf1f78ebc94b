"""Recordings on disk, sound and damaged, and a way to run the command line."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import kalux
from kalux.cli import main
from kalux.datasets import SensorSettings, pan, photograph_scene, simulate
from kalux.evaluation.benchmark import runners
from kalux.writers import hdf5

SOURCE = Path(kalux.__file__).resolve().parent.parent


class Result(NamedTuple):
    """What a command did."""

    code: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The one line of an error."""
        assert "Traceback" not in self.err
        assert self.err.count("\n") == 1, self.err
        assert self.err.startswith("kalux: error: ")
        return self.err.removeprefix("kalux: error: ").rstrip("\n")


@pytest.fixture
def cli(capsys):
    """Runs a command line in this process."""

    def run(*arguments) -> Result:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        return Result(code, *capsys.readouterr())

    return run


@pytest.fixture
def ran(monkeypatch):
    """Jobs of a benchmark are run in this process, which starts no others; the names of those that are."""
    names = []

    def in_this(jobs, processes):
        for job, outcome in runners.here(jobs):
            names.append(job.name)
            yield job, outcome

    monkeypatch.setattr(runners, "in_processes", in_this)
    return names


@pytest.fixture(scope="session")
def start_cli():
    """Starts a command line in a process of its own."""

    def start(*arguments, **options) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "kalux", *map(str, arguments)],
            env={**os.environ, "PYTHONPATH": str(SOURCE)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            **options,
        )

    return start


@pytest.fixture(scope="session")
def simulation():
    """A small sensor that pans over bright and dark blocks, 0.5 s."""
    rng = np.random.default_rng(0)
    picture = np.full((200, 200), 0.1)
    for _ in range(200):
        y, x = rng.integers(0, 200, 2)
        height, width = rng.integers(6, 40, 2)
        picture[y : y + height, x : x + width] = np.exp(rng.uniform(np.log(0.02), np.log(2.0)))
    scene = photograph_scene(picture, pan(60.0), sensor_size=(32, 40), duration=500_000)
    return simulate(scene, SensorSettings())


@pytest.fixture(scope="session")
def write_recording(simulation):
    """Writes that recording, with changes, as a kalux HDF5 file."""

    def write(path: Path, **changes) -> Path:
        settings = simulation.settings
        whole = {
            "sensor_size": simulation.scene.sensor_size,
            "events": [simulation.events],
            "frames": simulation.frames,
            "contrast_threshold": (settings.threshold_on, settings.threshold_off),
        }
        hdf5.write(path, **{**whole, **changes})
        return path

    return write


@pytest.fixture(scope="session")
def recording(tmp_path_factory, write_recording) -> Path:
    """A sound recording."""
    return write_recording(tmp_path_factory.mktemp("recording") / "rec.h5")


@pytest.fixture
def damaged(tmp_path, simulation, write_recording):
    """Writes the recording with one thing wrong, found only by reading it to the end."""

    def write(damage: str) -> Path:
        events, frames = simulation.events.copy(), list(simulation.frames)
        last = frames[-1]
        changes = {}
        if damage == "event outside the sensor":
            events["x"][-1] = 40
        elif damage == "events not sorted":
            events["t"][-1] = 0
        elif damage == "no frames":
            frames = []
        elif damage == "zero exposure":
            frames[-1] = dataclasses.replace(last, exposure_end=last.exposure_start)
        elif damage == "frames overlap":
            frames[-1] = dataclasses.replace(last, exposure_start=frames[-2].exposure_end - 1)
        elif damage == "NaN":
            frames = [dataclasses.replace(f, image=f.normalised().astype(np.float32)) for f in frames]
            frames[-1].image[3, 5] = np.nan
        elif damage == "frames of another size":
            changes["sensor_size"] = (32, 41)
        elif damage == "no exposure times":
            frames = [dataclasses.replace(f, exposure_end=f.exposure_start) for f in frames]
            changes = {"exposure_known": False, "contrast_threshold": None}
        return write_recording(tmp_path / "damaged.h5", events=[events], frames=frames, **changes)

    return write
