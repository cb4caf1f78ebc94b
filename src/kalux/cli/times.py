"""Times on the command line: of images, from a file, text or NumPy, in us; of exposures, in s."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.lib.format import read_array
from numpy.typing import NDArray

from kalux.cli.parser import UsageError
from kalux.schedule import checked_times

_COLUMN: Final = "t_us"
"""Of tables with times: their first line names the columns."""


def exposure_times(text: str) -> list[float]:
    """The seconds of ``--times``, with commas between.

    Raises
    ------
    UsageError
        If it has something else.
    """
    from kalux.calibration.photographs import parse_seconds

    try:
        return [parse_seconds(part) for part in text.split(",")]
    except ValueError:
        raise UsageError(f"--times {text}: seconds are needed, numbers with commas, as 2,0.5,1/8") from None


def load_times(path: Path) -> NDArray[np.int64]:
    """Read the times of images.

    Parameters
    ----------
    path
        A ``.npy`` file; or text with a time per line, us, in which ``#`` begins a comment; or a table with a column
        ``t_us``, such as the ``timestamps.csv`` of an output of kalux.

    Raises
    ------
    UsageError
        The file cannot be read, or a time is not a whole number; names the line.
    InputError
        As of `checked_times`.
    """
    try:
        times = _from_numpy(path) if path.suffix == ".npy" else _from_text(path)
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}") from error
    return checked_times(times, f"{path}: times")


def _from_numpy(path: Path) -> NDArray[Any]:
    try:
        with path.open("rb") as file:
            return np.asarray(read_array(file, allow_pickle=False))
    except (ValueError, EOFError) as error:
        raise UsageError(f"{path}: not a NumPy array of numbers") from error


def _from_text(path: Path) -> NDArray[np.int64]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: neither text nor .npy; one time per line is needed, in us") from error
    column = 0
    heads = [head.strip() for head in lines[0].lstrip("\ufeff").split(",")] if lines else []
    if _COLUMN in heads:
        lines[0], column = "", heads.index(_COLUMN)
    times = [
        _whole(_field(line, column), path, number)
        for number, line in enumerate((line.partition("#")[0] for line in lines), start=1)
        if line.strip()
    ]
    return np.array(times, np.int64)


def _field(line: str, column: int) -> str:
    """Empty where a line has too few."""
    return next(iter(line.split(",")[column:]), "")


def _whole(text: str, path: Path, line: int) -> int:
    try:
        value = int(text)
    except ValueError:
        raise UsageError(f"{path}: line {line}: {text.strip()!r} is not a whole number of us") from None
    if abs(value) >= 2**62:
        raise UsageError(f"{path}: line {line}: {value} us is out of range")
    return value
