"""The short form of ``benchmarks/fuzz.py``: every reader, on a few changed recordings, in processes of their own."""

from __future__ import annotations

import os
import random
import shutil
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kalux import readers

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
if not hasattr(os, "pidfd_open"):
    pytest.skip("the changed recordings are read in processes that Linux watches", allow_module_level=True)

sys.path.insert(0, str(Path(__file__).resolve().parent.parent.parent / "benchmarks"))
import fuzz


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    """Small recordings of every format; they are read here once, so that compiled loops are loaded."""
    found = list(fuzz.built_seeds(tmp_path_factory.mktemp("seeds")))
    for seed in found:
        fuzz.read_all(seed.path)
    return found


def test_every_reader_has_recordings_to_change(seeds):
    assert {seed.reader for seed in seeds} == {reader.name for reader in readers.READERS}
    for seed in seeds:
        reader = next(reader for reader in readers.READERS if reader.recognises(seed.path))
        assert reader.name == seed.reader


@pytest.mark.parametrize("name", [reader.name for reader in readers.READERS])
@settings(
    max_examples=15,
    deadline=None,
    derandomize=True,  # HDF5 may crash on structures without checksums: a find belongs into the benchmark's list
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(number=st.integers(0, 2**32))
def test_changed_recordings_are_read_or_refused(seeds, tmp_path, name, number):
    rng = random.Random(number)
    folder = tmp_path / "changed"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    path = fuzz.write_changed(rng.choice([seed for seed in seeds if seed.reader == name]), rng, folder)
    assert fuzz.attempt(path, 20, 1500, tmp_path / "log").failure == ""


@pytest.mark.parametrize(
    ("deed", "told"),
    [
        (lambda path: time.sleep(60), "not done after 1 s"),
        (lambda path: 1 / 0, "ZeroDivisionError: division by zero"),
        (lambda path: os.kill(os.getpid(), signal.SIGSEGV), "crash: SIGSEGV"),
        (lambda path: bool(np.ones(30_000_000).sum()), "memory: "),
    ],
)
def test_what_must_not_happen_is_noticed(tmp_path, monkeypatch, deed, told):
    monkeypatch.setattr(fuzz, "read_all", deed)
    limit = 1 if "not done" in told else 60
    assert fuzz.attempt(tmp_path, limit, 100, tmp_path / "log").failure.startswith(told)


def test_a_message_of_several_lines_is_an_error(tmp_path, monkeypatch):
    def refuse(path):
        raise readers.FormatError(f"{path}: one line\nand another")

    monkeypatch.setattr(fuzz.readers, "read", refuse)
    assert "not one line" in fuzz.attempt(tmp_path, 60, 1500, tmp_path / "log").failure


def test_changes_are_the_same_each_time():
    data = bytes(range(256)) * 8
    for number in range(50):
        first, second = (fuzz.changed(data, random.Random(number)) for _ in range(2))
        assert first == second
    assert sum(fuzz.changed(data, random.Random(number)) != data for number in range(50)) > 45
