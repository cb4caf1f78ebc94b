"""Kept loops: never run for another source or other types; kept where nothing has changed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from kalux import compiled
from kalux.compiled import loop
from kalux.loop_files import _Files

PARTS = """
import numba as nb
from kalux.formulas import formula
from numba.core import types
import numpy as np

SCALE = np.float32({scale})

@nb.njit(cache=True, inline="always")
def inlined(x):
    return x * np.float32({inlined})

@formula(types.float32)
def added(x):
    return x + np.float32({added})
"""

USER = """
import sys
import numpy as np
from kalux.compiled import loop
from parts import SCALE, added, inlined

@loop
def work(values):
    for k in range(len(values)):
        values[k] = added(inlined(values[k]) * SCALE)

if __name__ == "__main__":
    values = np.ones(3, np.float32)
    work(values)
    print(values[0], len(work.stats.cache_hits), len(work.stats.cache_misses))
"""


class Project:
    """Two modules in a folder, one of which has loops that use what is in the other."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "user.py").write_text(USER)
        self.parts = {"scale": 2, "inlined": 3, "added": 5}
        self.change()

    def change(self, **parts: int) -> None:
        self.parts |= parts
        (self.folder / "parts.py").write_text(PARTS.format(**self.parts))

    def run(self) -> tuple[float, int, int]:
        """What the loop makes of 1, and how many loops were found, and compiled."""
        source = str(Path(compiled.__file__).parents[1])
        done = subprocess.run(
            [sys.executable, "user.py"],
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": source, "PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True,
            text=True,
            check=True,
        )
        value, hits, misses = done.stdout.split()
        return float(value), int(hits), int(misses)

    @property
    def files(self) -> list[Path]:
        return sorted((self.folder / "__pycache__").glob("user.work-*"))


@pytest.fixture
def project(tmp_path):
    return Project(tmp_path)


def test_a_loop_is_compiled_once(project):
    assert project.run() == (11, 0, 1)
    assert project.run() == (11, 1, 0)


@pytest.mark.parametrize("part", ["scale", "inlined", "added"])
def test_a_change_of_what_a_loop_uses_compiles_it_again(project, part):
    """numba alone looks at the file of the loop itself."""
    project.run()
    project.change(**{part: 7})
    expected = project.parts["inlined"] * project.parts["scale"] + project.parts["added"]
    assert project.run() == (expected, 0, 1)
    assert len(project.files) == 1


def test_other_options_are_another_loop(tmp_path):
    plain, fused = loop(abs_of), loop(abs_of, fastmath={"contract"})
    _Files(tmp_path / "loop", plain).save("float32", "plain")
    assert _Files(tmp_path / "loop", fused).load("float32") is None
    assert _Files(tmp_path / "loop", loop(abs_of)).load("float32") == "plain"


def test_what_changes_no_instruction_compiles_nothing(project):
    """As a new time stamp, which an installation gives to all files."""
    project.run()
    with (project.folder / "user.py").open("a") as file:
        file.write("# A comment.\n")
    assert project.run() == (11, 1, 0)


@pytest.fixture
def files(tmp_path):
    return _Files(tmp_path / "loop", lambda x: x + 1)


def test_what_was_saved_is_loaded(files):
    assert files.load("float32") is None
    files.save("float32", ("code", 1))
    files.save("float64", ("code", 2))
    assert (files.load("float32"), files.load("float64")) == (("code", 1), ("code", 2))


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_what_is_not_whole_is_compiled_again(tmp_path, files, share):
    files.save("float32", ["code"] * 100 + [np.arange(100)])
    (kept,) = tmp_path.iterdir()
    kept.write_bytes(kept.read_bytes()[: int(share * kept.stat().st_size)])
    assert files.load("float32") is None
    files.save("float32", "code")
    assert files.load("float32") == "code"


def test_two_processes_that_save_at_a_time_do_not_mix_their_types(tmp_path):
    """Neither of them knows of the other's: numba's list would give one the name of the other."""
    one, other = (_Files(tmp_path / "loop", lambda x: x + 1) for _ in range(2))
    assert one.load("float32") is None
    assert other.load("int32") is None
    one.save("float32", "of float32")
    other.save("int32", "of int32")
    third = _Files(tmp_path / "loop", lambda x: x + 1)
    assert (third.load("float32"), third.load("int32")) == ("of float32", "of int32")


def test_files_of_another_source_are_removed(tmp_path, files):
    (tmp_path / "loop.1.nbc").touch()  # numba's own
    (tmp_path / "loop.nbi").touch()
    (tmp_path / "loop-2.1.nbc").touch()  # another loop's
    _Files(tmp_path / "loop", lambda x: x + 2).save("float32", "of another source")
    files.save("float32", "of this")
    names = sorted(path.name for path in tmp_path.iterdir())
    assert len(names) == 2
    assert names[0] == "loop-2.1.nbc"
    assert files.load("float32") == "of this"


def test_what_cannot_be_written_leaves_no_part(tmp_path, files, monkeypatch):
    def full(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space"):
        files.save("float32", "code")
    assert not list(tmp_path.iterdir())


def test_all_loops_of_kalux_are_kept_so():
    """What numba compiles with its own files may be stale: only functions that are always put in place do without."""
    for path in Path(compiled.__file__).parent.rglob("*.py"):
        for line in path.read_text().splitlines():
            if line.startswith("@nb.njit"):
                assert 'inline="always"' in line, (path, line)
    assert isinstance(loop(abs_of)._cache._cache_file, _Files)


def abs_of(x):
    return np.abs(x)


LOCKED = """
import signal, sys, threading
import numpy as np
from llvmlite.binding import ffi

from kalux.compiled import magnitude_bits

enter, waits = ffi._LLVMLock.__enter__, [True]

def interrupted(lock):
    enter(lock)
    if waits.pop():
        signal.raise_signal(signal.SIGINT)
        waits[:] = [False] * 100_000

ffi._LLVMLock.__enter__ = interrupted
try:
    magnitude_bits(np.ones(3, np.float32))
except KeyboardInterrupt:
    print("interrupted")
other = threading.Thread(target=lambda: ffi.lib._lock._lock.acquire(timeout=10) and print("unlocked"))
other.start()
other.join()
"""


def test_an_interrupt_while_a_loop_is_loaded_leaves_no_lock_behind() -> None:
    """Just after LLVM's lock was taken, before it is known that it has to be given back."""
    compiled.magnitude_bits(np.ones(3, np.float32))
    done = subprocess.run([sys.executable, "-c", LOCKED], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "interrupted\nunlocked\n"), done.stderr
