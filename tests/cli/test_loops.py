"""How commands start numba."""

from __future__ import annotations

import dataclasses
import gc
import os
import subprocess
import sys
import time

import numba as nb
import numpy as np
import pytest
from numba.core import event

from kalux.cli import loops
from kalux.cli.loops import compiling_beside, prepare_loops, tell_of_compiling
from kalux.compiled import magnitude_bits

_RUN = """
import sys
import numpy as np
from kalux.cli.loops import prepare_loops
prepare_loops()
from kalux.compiled import magnitude_bits
assert magnitude_bits(np.zeros(3, np.float32)) == 0
assert "scipy.linalg" not in sys.modules
prepare_loops()
import scipy.linalg.cython_blas
import scipy.linalg
assert scipy.linalg.det(np.eye(2)) == 1
prepare_loops()
"""


def test_loops_run_without_scipy_and_scipy_can_still_be_imported() -> None:
    done = subprocess.run([sys.executable, "-c", _RUN], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


_KEPT = """
import sys
import numba as nb
import numpy as np
from kalux.cli.loops import prepare_loops
prepare_loops()
from kalux.compiled import magnitude_bits
assert magnitude_bits(np.ones(3, np.float32)) == 0x3F800000
assert "numba.typed.typeddict" not in sys.modules
assert nb.njit(lambda x: [x, x + 1.5])(1.0) == [1.0, 2.5]
assert "numba.typed.typeddict" in sys.modules
assert magnitude_bits(np.zeros(3, np.float32)) == 0
"""


def test_a_loop_that_is_kept_runs_without_the_compiler_and_another_is_compiled() -> None:
    magnitude_bits(np.ones(3, np.float32))
    done = subprocess.run([sys.executable, "-c", _KEPT], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_search_for_garbage_is_as_before_once_a_loop_is_compiled() -> None:
    """However often a process has prepared: tests call many commands in one."""
    before, within = gc.get_threshold(), []

    class Compiling(event.Listener):
        def on_start(self, event):
            within.append(gc.get_threshold())

        def on_end(self, event):
            pass

    for _ in range(2):
        prepare_loops()
    with event.install_listener("numba:compile", Compiling()):
        nb.njit(lambda x: x + 2)(1)
    assert within[0][:2] == before[:2]
    assert within[0][2] > before[2]
    assert gc.get_threshold() == before


@pytest.mark.parametrize(
    ("terminal", "quiet", "times"), [(True, False, 1), (True, True, 0), (False, False, 0)]
)
def test_compiling_is_told_once_and_on_a_terminal_only(monkeypatch, terminal, quiet, times) -> None:
    listeners, told = [], []
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    monkeypatch.setattr(event, "register", lambda kind, listener: listeners.append((kind, listener)))
    tell_of_compiling(quiet=quiet, tell=told.append)
    monkeypatch.undo()
    for kind, listener in listeners:
        with event.install_listener(kind, listener):
            for _ in range(2):
                nb.njit(lambda x: x + 1)(1)
    assert len(told) == times
    assert all("for the first time" in text for text in told)


@pytest.fixture
def started(monkeypatch) -> list[subprocess.Popen[bytes]]:
    """Processes that `compiling_beside` starts, which here do nothing for the seconds that stand for a part."""
    processes: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen

    def sleeping(command, **options):
        assert command[:4] == [sys.executable, "-P", "-m", "kalux.cli.rehearsal"]
        processes.append(start(["sleep", *command[4:]], **options))
        return processes[-1]

    monkeypatch.setattr(loops.subprocess, "Popen", sleeping)
    return processes


def test_others_compile_from_the_first_loop_on_that_is_not_kept(started) -> None:
    compiled = nb.njit(lambda x: x + 1)
    compiled(1)
    with compiling_beside(["60", "61", "62"], 3):
        compiled(1)
        assert not started
        compiled(1.0)
        compiled(np.float32(1.0))
        assert [process.args for process in started] == [["sleep", "60", "62"], ["sleep", "61"]]
    nb.njit(lambda x: x + 2)(1)
    assert len(started) == 2


@pytest.mark.parametrize(("threads", "count"), [(1, 0), (2, 1), (8, 2)])
def test_with_this_process_as_many_as_there_may_be_threads_but_no_more_than_three(
    started, threads, count
) -> None:
    with compiling_beside(["60", "60"], threads):
        nb.njit(lambda x: x + 1)(1)
    assert len(started) == count


def test_one_process_leaves_the_begin_of_the_filter_to_the_command(started) -> None:
    assert loops.OF_ALL[-1] == "filter"
    with compiling_beside(("60", "61", "62", "63"), 2):
        nb.njit(lambda x: x + 1)(1)
    assert started[0].args == ["sleep", "60", "61", "62"]


def test_others_are_ended_with_an_interrupt(started) -> None:
    def interrupted() -> None:
        with compiling_beside(["60"], 2):
            nb.njit(lambda x: x + 1)(1)
            raise KeyboardInterrupt

    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert started[0].returncode != 0
    assert time.monotonic() - begun < 30


def test_a_run_does_without_others_where_there_can_be_none(monkeypatch) -> None:
    def refuse(*arguments, **options):
        raise BlockingIOError

    monkeypatch.setattr(loops.subprocess, "Popen", refuse)
    with compiling_beside(["60"], 2):
        assert nb.njit(lambda x: x + 1)(1) == 2


_REHEARSED = """
import sys
from numba.core.dispatcher import Dispatcher
from kalux.cli import loops, main, rehearsal

rehearsal.prepare_loops()
for part in rehearsal.PARTS.values():
    part()
assert set(rehearsal.PARTS) == set(loops.OF_ALL) > set(loops.OF_IMAGES)
modules = [module for name, module in sys.modules.items() if name.startswith("kalux.")]
values = [value for module in modules for value in vars(module).values()]
print([loop for loop in values if isinstance(loop, Dispatcher) and len(loop.overloads) > 1])
add, new = Dispatcher.add_overload, []

def watched(self, compiled):
    new.append(f"{self.py_func.__module__}.{self.py_func.__name__}")
    return add(self, compiled)

Dispatcher.add_overload = watched
assert main(["reconstruct", sys.argv[1], "-o", sys.argv[2], "--rate", "100", "--threads", "1"]) == 0
assert any(name.startswith("kalux.calibration") for name in new), new
print([name for name in new if name.startswith(("kalux.filters", "kalux.display", "kalux.images"))])
"""


def test_a_reconstruction_comes_to_nothing_after_the_estimates_that_is_not_rehearsed_once(
    simulation, write_recording, tmp_path
) -> None:
    frames = [dataclasses.replace(frame, image=np.tile(frame.image, (8, 8))) for frame in simulation.frames]
    recording = write_recording(
        tmp_path / "rec.h5", sensor_size=frames[0].image.shape, frames=frames, contrast_threshold=None
    )
    command = [sys.executable, "-c", _REHEARSED, str(recording), str(tmp_path / "out.mp4")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert [done.stdout.splitlines()[line] for line in (0, -1)] == ["[]", "[]"]
