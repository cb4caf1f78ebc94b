"""How commands start numba."""

from __future__ import annotations

import subprocess
import sys

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
