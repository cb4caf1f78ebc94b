"""Where numba keeps compiled loops, and checks of its environment variables.

numba keeps them in ``__pycache__`` beside the source. Where neither that nor the home folder can be written, as of a
package that is installed read-only, its decorator already fails for a function that is to be cached. kalux then names
another folder. No large imports here, since this runs whenever kalux is imported.
"""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Final

from kalux.errors import OutputError, SettingsError

VARIABLE: Final = "NUMBA_CACHE_DIR"
"""numba's environment variable for that folder; kalux sets it only if it is not set and needed."""


def ensure_writable(package: Path) -> None:
    """Make sure that numba has a folder to write to: the package, ``~/.cache/kalux``, or one for this process.

    ``XDG_CACHE_HOME`` stands for ``~/.cache`` where it is set. Where none can be made, `check_variables` says so: much
    of kalux does without loops.
    """
    if os.environ.get(VARIABLE) or _is_writable(package):
        return
    place = _user_folder() or _temporary_folder()
    if place is None:
        return
    os.environ[VARIABLE] = str(place)
    if "numba" in sys.modules:  # it has read its environment already
        sys.modules["numba"].config.CACHE_DIR = str(place)


def check_variables() -> None:
    """Refuse variables with which numba does not start, or does not compile, or has no folder to write to.

    Raises
    ------
    SettingsError
        That names the variable.
    OutputError
        There is no folder.
    """
    if not os.environ.get(VARIABLE) and not _is_writable(Path(__file__).parent):
        raise OutputError(
            "compiled loops cannot be kept: neither the folder of kalux nor one for caches or temporary files can be "
            f"written; name a folder in {VARIABLE}"
        )
    threads = _number("NUMBA_NUM_THREADS")
    if threads is not None and threads < 1:
        raise SettingsError(f"NUMBA_NUM_THREADS={threads}: it must be 1 or more; change it, or unset it")
    interpreted = _number("NUMBA_DISABLE_JIT")
    if interpreted:
        raise SettingsError(
            f"NUMBA_DISABLE_JIT={interpreted}: kalux's loops use machine instructions and have to be compiled; unset it"
        )


def _number(variable: str) -> int | None:
    """A variable as numba reads it: None where it is not set or no whole number."""
    try:
        return int(os.environ.get(variable, ""))
    except ValueError:
        return None


def _is_writable(package: Path) -> bool:
    cache = package / "__pycache__"
    return os.access(cache if cache.exists() else package, os.W_OK | os.X_OK)


def _user_folder() -> Path | None:
    """The user's folder for caches, made so that others cannot write to it: numba runs what it finds there."""
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        place = (Path(base) if base else Path.home() / ".cache") / "kalux"
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return None
    return place if os.access(place, os.W_OK | os.X_OK) else None


def _temporary_folder() -> Path | None:
    try:
        place = Path(tempfile.mkdtemp(prefix="kalux-"))
    except OSError:
        return None
    owner = os.getpid()

    def remove() -> None:
        if os.getpid() == owner:  # not in a forked child
            shutil.rmtree(place, ignore_errors=True)

    atexit.register(remove)
    return place
