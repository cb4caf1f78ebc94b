"""Runners: the same numbers everywhere; a process that dies costs at most its own job."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from kalux.errors import InputError
from kalux.evaluation.benchmark import runners
from kalux.evaluation.benchmark.jobs import Failed, Finished
from kalux.evaluation.benchmark.runners import here, in_processes, on_dask

import deadly


def outcomes(done) -> dict:
    """The outcomes by method, without what cannot be the same twice."""
    return {
        job.method: {k: v for k, v in outcome.record.items() if k != "seconds"}
        if isinstance(outcome, Finished)
        else outcome
        for job, outcome in done
    }


@pytest.fixture
def two(small_set):
    return [small_set.job(name, hdr_vdp=True) for name in ("cf", "default")]


@pytest.fixture(scope="module")
def cluster():
    """Two worker processes of one thread on this machine."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as local:
        yield local


def test_processes_find_what_this_one_finds_and_one_that_dies_costs_its_own_job_only(two, monkeypatch):
    expected = outcomes(here(two[1:]))
    monkeypatch.setattr(runners, "run_job", deadly.deadly)
    killed = Failed("its process was killed, perhaps for want of memory", is_bug=False)
    assert outcomes(in_processes(two, 2)) == {"cf": killed, **expected}


def test_giving_up_stops_the_processes(small_set, monkeypatch):
    """What has ended is there, what has not is stopped at once, as at Ctrl-C."""
    monkeypatch.setattr(runners, "run_job", deadly.endless)
    running = in_processes([small_set.job("hold"), small_set.job("cf")], 2)
    job, outcome = next(running)
    assert (job.method, type(outcome)) == ("hold", Finished)
    assert wait_until(lambda: list(small_set.folder.glob("pid-*")), 60)
    begun = time.monotonic()
    running.close()
    assert time.monotonic() - begun < 10
    alive = {process.pid for process in multiprocessing.active_children()}
    assert not alive & {int(path.name[4:]) for path in small_set.folder.glob("pid-*")}


BENCHMARK = """
import pickle, sys
import deadly
from kalux.evaluation.benchmark import runners

runners.run_job = deadly.endless
jobs = pickle.loads(sys.stdin.buffer.read())
list(runners.in_processes(jobs, len(jobs)))
"""


def runs(pid):
    """Whether a process runs; one that has ended and is not waited for by its parent does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until(condition, seconds):
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.05)
    return condition()


def test_processes_end_when_their_parent_is_killed(small_set):
    """It has no chance to stop them, and nobody would take what they find."""
    jobs = [small_set.job("cf"), small_set.job("mean")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    parent = subprocess.Popen([sys.executable, "-c", BENCHMARK], stdin=subprocess.PIPE, env=environment)
    workers = []
    try:
        parent.stdin.write(pickle.dumps(jobs))
        parent.stdin.close()
        assert wait_until(lambda: len(list(small_set.folder.glob("pid-*"))) == 2, 120)
        workers = [int(path.name[4:]) for path in small_set.folder.glob("pid-*")]
        assert all(map(runs, workers))
        parent.kill()
        assert wait_until(lambda: not any(map(runs, workers)), 10)
    finally:
        parent.kill()
        parent.wait()
        for worker in filter(runs, workers):
            with suppress(ProcessLookupError):
                os.kill(worker, signal.SIGKILL)


def test_dask_finds_what_this_process_finds_and_runs_the_job_of_a_killed_worker_again(
    two, cluster, small_set, monkeypatch
):
    expected = outcomes(here(two))
    monkeypatch.setattr(runners, "run_job", deadly.deadly_once)
    assert outcomes(on_dask(two, cluster.scheduler_address)) == expected
    assert (small_set.folder / "struck").exists()
    monkeypatch.undo()
    assert outcomes(on_dask(two, cluster.scheduler_address)) == expected


def test_without_a_scheduler_the_address_is_named(two):
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="nowhere: no scheduler answers"):
        next(on_dask(two, "nowhere"))


def test_a_cluster_that_gives_up_a_job_is_told():
    class Future:
        status = "cancelled"

    assert "has given it up" in runners._outcome(Future()).message
