"""Ways to run jobs: here, in processes of this machine, on a Dask cluster. The outcomes are the same.

Each takes jobs and yields every one with its outcome, in the order in which they end. When the iterator is closed, e.g.
by an interrupt, what has not ended is given up.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from typing import Any, Final

from kalux.errors import InputError, MissingDependencyError
from kalux.evaluation.benchmark.jobs import Failed, Job, Outcome, run_job

Outcomes = Generator[tuple[Job, Outcome], None, None]

_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
_ONE_THREAD: Final = dict.fromkeys(_THREADS, "1")
_KILLED: Final = "its process was killed, perhaps for want of memory"


def here(jobs: Sequence[Job]) -> Outcomes:
    """One after the other in this process."""
    for job in jobs:
        yield job, run_job(job)


def in_processes(jobs: Sequence[Job], processes: int) -> Outcomes:
    """In processes of this machine, each with one thread.

    A process that is killed takes those beside it along: what they were at is run again, each alone.

    Parameters
    ----------
    jobs
        Any number.
    processes
        How many at a time.
    """
    left = list(jobs)
    with contextlib.closing(_pool(left, processes)) as outcomes:
        for job, outcome in outcomes:
            if outcome is not None:
                left.remove(job)
                yield job, outcome
    for job in left:
        with contextlib.closing(_pool([job], 1)) as outcomes:
            for _, outcome in outcomes:
                yield job, outcome or Failed(_KILLED, is_bug=False)


def _pool(jobs: list[Job], processes: int) -> Generator[tuple[Job, Outcome | None], None, None]:
    """Run jobs in a pool; None for those that a killed process has cost."""
    if not jobs:
        return
    before = {*multiprocessing.active_children()}
    pool = ProcessPoolExecutor(
        min(processes, len(jobs)),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin_worker,
    )
    try:
        with _environment(_ONE_THREAD):  # the processes start with the first job
            futures: dict[Future[Outcome], Job] = {pool.submit(run_job, job): job for job in jobs}
        for future in as_completed(futures):
            try:
                yield futures[future], future.result()
            except BrokenProcessPool:
                yield futures[future], None
    finally:
        ours = {*multiprocessing.active_children()} - before
        pool.shutdown(wait=False, cancel_futures=True)
        for process in ours:
            process.terminate()
        for process in ours:
            # The pool's own thread waits for it, too: if that is told first, join returns before the end is noted.
            while process.is_alive():
                process.join(0.05)


def _begin_worker() -> None:
    """Prepare a process of the pool: it leaves Ctrl-C to its parent, and does not outlive it."""
    # A terminal sends Ctrl-C to all processes; only the first answers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, name="kalux-parent", daemon=True).start()


def _exit_with_parent() -> None:
    """Exit as soon as the parent has ended: one that was killed cannot stop its processes, nor take their outcomes."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


@contextlib.contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    former = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in former.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def on_dask(jobs: Sequence[Job], address: str) -> Outcomes:
    """On the workers of a Dask cluster, which must find the recordings under the same paths, and have the same kalux.

    Dask runs the job of a worker that dies on another one, up to three times.

    Parameters
    ----------
    jobs
        Any number.
    address
        Of the scheduler, e.g. ``tcp://192.168.1.5:8786``.

    Raises
    ------
    MissingDependencyError
        If Dask is not installed.
    InputError
        If there is no scheduler at the address.
    """
    distributed = _distributed()
    try:
        client = distributed.Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--dask {address}: no scheduler answers; start one with 'dask scheduler', workers with 'dask worker'"
        ) from error
    futures: dict[Any, Job] = {}
    try:
        futures = {client.submit(run_job, job, pure=False): job for job in jobs}
        for future in distributed.as_completed(futures, loop=client.loop):
            yield futures[future], _outcome(future)
            future.release()
    finally:
        with contextlib.suppress(Exception):  # the scheduler may have gone
            client.cancel(list(futures), force=True)
        client.close(timeout=5)


def _outcome(future: Any) -> Outcome:
    if future.status in ("cancelled", "lost"):
        return Failed("the Dask scheduler has given it up, or has gone", is_bug=False)
    error = future.exception()
    if error is None:
        outcome: Outcome = future.result()
        return outcome
    if type(error).__name__ == "KilledWorker":
        return Failed("every worker that Dask gave it to died, perhaps for want of memory", is_bug=False)
    text = " ".join(f"the Dask worker reports {type(error).__name__}: {error}".split())
    return Failed(f"{text}; do the workers have the same kalux?", is_bug=False)


def _distributed() -> Any:
    try:
        return importlib.import_module("distributed")
    except ImportError as error:
        raise MissingDependencyError("--dask needs Dask; pip install 'kalux[dask]'") from error
