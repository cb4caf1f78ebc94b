"""How commands start numba."""

from __future__ import annotations

import subprocess
import sys

import numba as nb
import pytest
from numba.core import event

from kalux.cli.loops import tell_of_compiling

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
