"""The benchmarks go on working where what they measure has changed; how fast anything is, no test says."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import kalux

ROOT = Path(__file__).resolve().parent.parent
SOURCE = Path(kalux.__file__).resolve().parent.parent


def benchmark(name):
    """A benchmark as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where dataclasses and named tuples look for their annotations
    spec.loader.exec_module(module)
    return module


scenes = benchmark("scenes")


@pytest.mark.parametrize(
    ("command", "told"),
    [
        (
            ["speed.py", "--events", "60000", "--rounds", "1"],
            ["filter, literal in numba", "EDI / literal in numba", "all else"],
        ),
        (["fuzz.py", "--seconds", "0.2", "--readers", "kalux"], ["| kalux | 1 |"]),
        (["memory.py", "--megabytes", "2", "--formats", "kalux"], ["| kalux | 1 |"]),
        (["hdrvdp.py", "--pairs", "1"], ["slowest"]),
    ],
    ids=lambda value: value[0],
)
def test_a_small_run(command, told, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
    done = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / command[0], *command[1:]],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    for part in told:
        assert part in done.stdout


def test_scenes_at_random(tmp_path):
    """They are simulated, scored and summed up; a second run has nothing to do."""
    rng = np.random.default_rng(0)
    coarse = np.exp(rng.normal(0.0, 1.0, (30, 40, 3))).astype(np.float32)
    cv2.imwrite(str(tmp_path / "small.hdr"), cv2.resize(coarse, (240, 180)))
    small = ["--count", "1", "--size", "64x48", "--duration", "0.5", "--processes", "1"]
    command = [sys.executable, ROOT / "benchmarks" / "scenes.py", "small.hdr", "-o", "out", *small]
    environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
    first, again = (
        subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    )
    assert first.stdout.startswith("1 scene: ")
    assert "forward    mean 0." in first.stdout
    assert again.stdout == first.stdout
    assert (tmp_path / "out" / "recordings" / "000_small.h5").exists()


def test_scenes_at_random_are_those_of_the_seed():
    """Of few and of many the first are the same; what is drawn are flags of kalux simulate."""
    drawn = scenes.draw([Path("a.hdr"), Path("b.exr")], 40, 3)
    assert drawn[:7] == scenes.draw([Path("a.hdr"), Path("b.exr")], 7, 3)
    assert drawn != scenes.draw([Path("a.hdr"), Path("b.exr")], 40, 4)
    assert len({scene.flags for scene in drawn}) == 40
    assert [scene.name for scene in drawn[:2]] == ["000_a", "001_b"]
    often = scenes.draw([Path("a.hdr"), Path("b.exr")], 2, 3, truth_rate=197.0)
    assert [scene.flags for scene in often] == [
        (*scene.flags, "--truth-rate", "197.0") for scene in drawn[:2]
    ]


def test_a_folder_with_other_scenes_is_refused(tmp_path):
    """Their recordings would be scored as those of this run; more and fewer of the same are no others."""
    for count in (3, 5, 2):
        scenes.claim(tmp_path, scenes.draw([Path("a.hdr")], count, 1))
    assert len((tmp_path / "scenes.txt").read_text().splitlines()) == 5
    with pytest.raises(SystemExit, match="has other scenes"):
        scenes.claim(tmp_path, scenes.draw([Path("a.hdr")], 3, 2))


def test_what_stands_out_among_scenes_is_told():
    fine = {"mse": 0.1, "ssim": 0.9, "log_mse": 0.1, "rms_z": 1.0}
    simple = {"mse": 1.0, "ssim": 0.5, "log_mse": 1.0}
    scores = {"hold": simple, "edi": simple, "iccv2021": simple, "default": fine, "smooth": fine}
    assert scenes.oddities(scores) == []
    assert scenes.oddities({**scores, "smooth": {**fine, "mse": 0.11}}) == ["both ways worse than forward"]
    assert scenes.oddities({**scores, "default": {**fine, "rms_z": 1.3}}) == ["rms z"]
    worse = {"mse": 2.0, "ssim": 0.4, "log_mse": 0.6, "rms_z": 1.0}
    assert scenes.oddities({**scores, "default": worse}) == [
        "MSE above that of the last frame",
        "SSIM below that of the last frame",
        "MSE above EDI's",
        "log-MSE above half of iccv2021's",
    ]
    told = scenes.summary({"one": scores, "two": scores})
    assert told.startswith("2 scenes")
    assert "mean 0.100, median 0.100; at most 0.10; median 1.00, within 0.8 to 1.2 in 100%" in told
