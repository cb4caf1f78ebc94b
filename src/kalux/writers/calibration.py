"""Calibrations to files: a TOML text, and the maps of pixels beside it."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomli_w
from numpy.typing import NDArray

from kalux.calibration.values import UNITS, VERSION, Calibration
from kalux.writers.files import save

_FIRST_LINE: Final = (
    "# A calibration by kalux: docs/calibration.md. Can be given to --calibration and to --settings."
)


def save_calibration(calibration: Calibration, path: str | Path) -> list[Path]:
    """Write a calibration: a TOML file, and its maps, if it has any, beside it as an ``.npz`` of the same name.

    Returns the files, which are whole or not there; the text comes last, so that it never names maps that are not.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    path = Path(path)
    body: dict[str, Any] = {
        "kalux_calibration": VERSION,
        "provenance": dict(calibration.provenance),
        "settings": {group: dict(values) for group, values in calibration.settings.items()},
        "standard_errors": dict(calibration.errors),
        "measured": dict(calibration.measured),
    }
    written = [path]
    if calibration.maps:
        maps, data = path.with_suffix(".npz"), _npz(calibration.maps)
        save(maps, data)
        written = [maps, path]
        body["maps"] = {
            "file": maps.name,
            "sha256": hashlib.sha256(data).hexdigest(),
            "names": sorted(calibration.maps),
        }
    lines = [_with_unit(line) for line in tomli_w.dumps(body).splitlines()]
    save(path, "\n".join([_FIRST_LINE, *lines, ""]))
    return written


def _with_unit(line: str) -> str:
    name, equals, _ = line.partition(" = ")
    return f"{line}  # {UNITS[name]}" if equals and name in UNITS else line


def _npz(maps: Mapping[str, NDArray[Any]]) -> bytes:
    """As `numpy.savez_compressed`, but the same bytes every time: no time stamps."""
    out = BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(maps):
            values = np.asarray(maps[name])
            data = BytesIO()
            np.save(data, values.astype(np.float32) if values.dtype.kind == "f" else values)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), data.getvalue(), zipfile.ZIP_DEFLATED)
    return out.getvalue()
