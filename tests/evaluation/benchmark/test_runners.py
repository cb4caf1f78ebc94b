"""Runners: the same numbers everywhere; a process that dies costs at most its own job."""

from __future__ import annotations

import multiprocessing
import time

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
    deadline = time.monotonic() + 60
    while not list(small_set.folder.glob("pid-*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    begun = time.monotonic()
    running.close()
    assert time.monotonic() - begun < 10
    alive = {process.pid for process in multiprocessing.active_children()}
    assert not alive & {int(path.name[4:]) for path in small_set.folder.glob("pid-*")}


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
