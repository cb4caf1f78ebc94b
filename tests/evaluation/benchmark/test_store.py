"""Finished jobs on disk: whole and with the right key, or not there."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kalux.errors import FormatError, OutputError
from kalux.evaluation.benchmark.jobs import run_job
from kalux.evaluation.benchmark.store import Store, file_name, prepare


@pytest.fixture
def stored(small_set, tmp_path):
    job = small_set.job("hold")
    store, done = Store(tmp_path / "out"), run_job(job)
    store.save(job, done)
    return store, job, done


def test_what_is_saved_is_found(stored):
    store, job, done = stored
    assert store.record(job) == done.record
    pictures = store.pictures(job)
    assert pictures.keys() == done.pictures.keys()
    assert all(np.array_equal(pictures[name], done.pictures[name]) for name in pictures)
    assert sorted(p.name for p in store.path(job).parent.iterdir()) == ["hold.json", "hold.npz"]


def test_another_key_is_not_done_but_another_title_is(stored):
    store, job, _ = stored
    assert store.record(dataclasses.replace(job, key="other")) is None
    renamed = dataclasses.replace(job, sequence=dataclasses.replace(job.sequence, title="new"))
    assert store.record(renamed)["sequence"]["title"] == "new"


@pytest.mark.parametrize("damage", ["no pictures", "cut", "not a record", "gone"])
def test_what_is_not_whole_is_not_done(stored, damage):
    store, job, _ = stored
    path = store.path(job)
    if damage == "no pictures":
        path.with_suffix(".npz").unlink()
    elif damage == "cut":
        path.write_bytes(path.read_bytes()[:100])
    elif damage == "gone":
        path.unlink()
    else:
        path.write_text("[]")
    assert store.record(job) is None


def test_damaged_pictures_are_named(stored):
    store, job, _ = stored
    store.path(job).with_suffix(".npz").write_bytes(b"PK\x03\x04 no zip")
    with pytest.raises(FormatError, match=r"hold\.npz: damaged"):
        store.pictures(job)


def test_the_folder_is_of_a_benchmark_or_empty(tmp_path):
    out = tmp_path / "out"
    prepare(out)
    prepare(out)
    (tmp_path / "mine.txt").write_text("mine")
    (out / "jobs").rmdir()
    prepare(out)
    with pytest.raises(OutputError, match="not of a benchmark"):
        prepare(tmp_path)
    with pytest.raises(OutputError):
        prepare(tmp_path / "mine.txt" / "out")


def test_names_of_methods_become_names_of_files():
    assert file_name("default,smooth") != file_name("default-smooth") == "default-smooth"
    name = file_name("firenet:/a b/w.pth")
    assert name.startswith("firenet-a-b-w.pth-")
    assert len(name) == len("firenet-a-b-w.pth-") + 8
    assert file_name("ours=results/run3") != file_name("ours=results-run3")
