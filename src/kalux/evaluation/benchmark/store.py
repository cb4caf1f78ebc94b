"""Finished jobs in a folder: ``jobs/SEQUENCE/METHOD.json`` with the scores, ``.npz`` beside it with the pictures.

The JSON is written last and in one piece: a job whose JSON is there with the right key is done.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import re
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError, OutputError
from kalux.evaluation.benchmark.jobs import Finished, Job, described
from kalux.writers.files import output_errors, uninterrupted, write_whole

FOLDER: Final = "jobs"


class Store:
    """The finished jobs of an output folder.

    Parameters
    ----------
    out
        The benchmark's output folder.
    """

    def __init__(self, out: Path) -> None:
        self._folder = out / FOLDER

    def path(self, job: Job) -> Path:
        """Where the record of a job is, or will be."""
        return self._folder / job.sequence.name / f"{file_name(job.method)}.json"

    def save(self, job: Job, finished: Finished) -> None:
        """Keep a finished job, in the place of a former one.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        path = self.path(job)
        pictures = io.BytesIO()
        np.savez_compressed(pictures, allow_pickle=False, **finished.pictures)
        record = json.dumps(finished.record, indent=1, allow_nan=False) + "\n"
        with output_errors(path, "the jobs done before are kept"), uninterrupted():
            path.parent.mkdir(parents=True, exist_ok=True)
            # Between the two writes a former record must not stand beside new pictures.
            path.unlink(missing_ok=True)
            write_whole(path.with_suffix(".npz"), pictures.getvalue())
            write_whole(path, record.encode())

    def record(self, job: Job) -> dict[str, Any] | None:
        """The record of a job, if it is done with this very key; its title and group may have changed since."""
        found = self._stored(job)
        if found is None or found.get("key") != job.key:
            return None
        return {**found, "sequence": described(job)}

    def other_kalux(self, job: Job) -> str | None:
        """The version of kalux that has left a record of a job, if that or its code is another; None: none has."""
        found = self._stored(job)
        if found is None or found.get("code") == job.code:
            return None
        made_by = found.get("versions")
        return str(made_by.get("kalux", "?")) if isinstance(made_by, dict) else "?"

    def _stored(self, job: Job) -> dict[str, Any] | None:
        """What is stored of a job, with whatever key; None if nothing is, or not whole."""
        path = self.path(job)
        if not path.with_suffix(".npz").is_file():
            return None
        with contextlib.suppress(OSError, ValueError):
            found = json.loads(path.read_text(encoding="utf-8"))
            if isinstance(found, dict):
                return found
        return None

    def pictures(self, job: Job) -> dict[str, NDArray[Any]]:
        """The pictures of a job that is done.

        Raises
        ------
        FormatError
            If the file is damaged.
        """
        path = self.path(job).with_suffix(".npz")
        try:
            with np.load(path, allow_pickle=False) as file:
                return {name: file[name] for name in file.files}
        except Exception as error:  # a damaged zip raises nearly anything
            raise FormatError(f"{path}: damaged; remove it and run the benchmark again") from error


def file_name(method: str) -> str:
    """A method's name as that of a file; where it cannot be the same, with what tells it from others like it."""
    plain = re.sub(r"[^\w.-]+", "-", method).strip(".-")
    return plain if plain == method else f"{plain}-{hashlib.sha256(method.encode()).hexdigest()[:8]}"


def prepare(out: Path) -> None:
    """Make the output folder, or check that it is one of a benchmark.

    Raises
    ------
    OutputError
        If it holds something else, or cannot be made.
    """
    with output_errors(out, "the benchmark writes to a folder"):
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()) and not (out / FOLDER).is_dir():
            raise OutputError(
                f"{out}: the folder is not empty, and not of a benchmark; choose another one with -o"
            )
        (out / FOLDER).mkdir(exist_ok=True)
