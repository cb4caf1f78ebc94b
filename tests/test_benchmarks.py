"""The benchmarks go on working where what they measure has changed; how fast anything is, no test says."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import kalux

ROOT = Path(__file__).resolve().parent.parent
SOURCE = Path(kalux.__file__).resolve().parent.parent


@pytest.mark.parametrize(
    ("command", "told"),
    [
        (
            ["speed.py", "--events", "300000", "--rounds", "1"],
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
