"""How a command that runs compiled loops starts numba."""

from __future__ import annotations

import contextlib
import importlib
import sys
from typing import Final

_BLAS: Final = "scipy.linalg.cython_blas"


def prepare_loops() -> None:
    """Import what numba needs for any loop, without what it needs for products of matrices, which kalux's have none of.

    numba imports SciPy's BLAS only to see whether it is there: 0.1 s of the 0.3 that its first loop waits for. Must be
    called before there are threads, which might import SciPy meanwhile. Where SciPy is imported already, or numba is
    laid out otherwise, nothing is gained and nothing lost.
    """
    if _BLAS in sys.modules:
        return
    sys.modules[_BLAS] = None  # type: ignore[assignment]  # who asks for it is told that it is not there
    try:
        with contextlib.suppress(ImportError):
            importlib.import_module("numba.np.arraymath")
    finally:
        del sys.modules[_BLAS]
