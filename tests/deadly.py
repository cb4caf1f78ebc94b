"""Jobs that kill the process they run in, for tests of what becomes of the others. Workers import it by name."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from kalux.evaluation.benchmark.jobs import Job, Outcome, run_job


def deadly_once(job: Job) -> Outcome:
    """Kill the process at the first job with this method; a file beside the recording tells that it has happened."""
    struck = job.sequence.path.with_name("struck")
    if job.method == "cf" and not struck.exists():
        struck.touch()
        _kill()
    return run_job(job)


def deadly(job: Job) -> Outcome:
    """Kill the process at every job with this method."""
    if job.method == "cf":
        _kill()
    return run_job(job)


def endless(job: Job) -> Outcome:
    """The first job ends, others never do; each leaves a file that tells its process."""
    if job.method != "hold":
        Path(job.sequence.path.with_name(f"pid-{os.getpid()}")).touch()
        time.sleep(600)
    return run_job(job)


def _kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)
