"""Calibrations to files."""

from __future__ import annotations

from pathlib import Path

from kalux.calibration.values import Calibration, to_files
from kalux.writers.files import output_errors, write_whole


def save_calibration(calibration: Calibration, path: str | Path) -> list[Path]:
    """Write a calibration: a TOML file, and its maps, if it has any, beside it as an ``.npz`` of the same name.

    Returns the files, which are whole or not there.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    files = to_files(calibration, path)
    for name, data in files.items():
        with output_errors(name):
            write_whole(name, data)
    return list(files)
