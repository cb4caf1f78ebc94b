"""`kalux.toml`: what made an output, and whether it is complete."""

from __future__ import annotations

import dataclasses
import datetime
import enum
import importlib.metadata
import platform
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePath
from typing import Any, Final

import numpy as np
import tomli_w

from kalux.errors import OutputError, SettingsError
from kalux.writers.files import utf8, write_whole

FIRST_LINE = (
    "# Written by kalux: the settings of this output. complete = false: it was interrupted or failed."
)
_PACKAGES: Final = ("kalux", "numpy", "opencv-python-headless", "av", "isal")
"""With which outputs are written."""

RESERVED = ("complete", "images", "first_t_us", "last_t_us", "output")


@dataclasses.dataclass(frozen=True)
class SettingsFile:
    """A settings file that is rewritten as the output grows.

    Attributes
    ----------
    path
        Of the file.
    body
        The part that stays the same, as TOML.
    """

    path: Path
    body: str

    def write(self, *, complete: bool, images: int, times: tuple[int, int] | None) -> None:
        """Replace the file; ``times`` are those of the first and last image, us.

        Raises
        ------
        OSError
            It cannot be written; the old one stays.
        """
        lines = [FIRST_LINE, f"complete = {str(complete).lower()}", f"images = {images}"]
        if times is not None:
            lines += [f"first_t_us = {times[0]}", f"last_t_us = {times[1]}"]
        write_whole(self.path, utf8("\n".join([*lines, self.body])))


def settings_file(path: Path, metadata: Mapping[str, Any], output: Mapping[str, Any]) -> SettingsFile:
    """The settings file of an output.

    Parameters
    ----------
    path
        Of the file.
    metadata
        Nested settings of the caller. None is left out: in TOML, a setting that is not there has its default.
        Dataclasses become tables; tuples and arrays, lists; paths and enumerations, their values.
    output
        Settings of the writer, for the table ``output``.

    Raises
    ------
    SettingsError
        A value has no TOML form, or a name is one that the writer sets itself.
    """
    taken = [name for name in RESERVED if name in metadata]
    if taken:
        raise SettingsError(f"metadata: {taken[0]!r} is set by the writer itself; choose another name")
    given = {name: value for name, value in metadata.items() if name != "versions"}
    used = {**versions(_PACKAGES), **metadata.get("versions", {})}
    tables = {**given, "output": output, "versions": used}
    return SettingsFile(path, tomli_w.dumps(plain(tables, "metadata")))


def beside(path: Path) -> Path:
    """Where the settings of an output that is one file are."""
    return path.with_name(f"{path.name}.kalux.toml")


def require_ours(path: Path) -> None:
    """Check that a settings file, if there is one, was written by kalux and may be replaced.

    Raises
    ------
    OutputError
        Something else has the name.
    """
    if not path.exists() and not path.is_symlink():
        return
    if not path.is_file() or not path.read_bytes().startswith(FIRST_LINE.encode()):
        raise OutputError(
            f"{path}: not an output of kalux, so it is not replaced; move it or write elsewhere"
        )


def versions(packages: Iterable[str]) -> dict[str, str]:
    """The versions of Python and of packages, or that they are not installed."""
    return {"python": platform.python_version(), **{package: _version(package) for package in packages}}


def plain(value: Any, where: str) -> Any:
    """A value in the types of TOML, None left out of tables; ``where`` is its name, for errors.

    Raises
    ------
    SettingsError
        The value has no TOML form.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, enum.Enum):
        value = value.value
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        present = {str(name): item for name, item in value.items() if item is not None}
        return {name: plain(item, f"{where}.{name}") for name, item in present.items()}
    if isinstance(value, list | tuple):
        return [plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, bool | int | float | str | datetime.datetime | datetime.date | datetime.time):
        return value
    raise SettingsError(f"{where}: {value!r} cannot be written to a settings file")


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
