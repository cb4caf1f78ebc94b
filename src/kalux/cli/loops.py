"""How a command that runs compiled loops starts numba."""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib
import subprocess
import sys
from collections.abc import Callable, Generator, Sequence
from typing import Any, Final

from kalux.cli.terminal import error_line

_BLAS: Final = "scipy.linalg.cython_blas"


def prepare_loops() -> None:
    """Have numba begin, and compile, without what takes it long and is for nothing here.

    It imports SciPy's BLAS only to see whether it is there, for products of matrices, which kalux's loops have none of:
    0.1 s of the 0.3 that its first loop waits for. The other 0.2 s are what it knows of all types, which a loop that is
    kept needs none of. And while it compiles only young garbage is looked for: looking through all that it keeps takes
    an eighth more. Must be called before there are threads, which might import SciPy meanwhile. Where SciPy is imported
    already, or numba is laid out otherwise, nothing is gained and nothing lost.
    """
    _import_without_blas()
    _load_without_compiler()
    _look_for_young_garbage_only()


@functools.cache  # once
def _load_without_compiler() -> None:
    """Have loops that are kept loaded without what numba needs to compile, which it sees to itself when it does."""
    from numba.core import caching
    from numba.core.runtime.nrt import rtsys

    def load(cache: Any, signature: Any, context: Any) -> Any:
        rtsys.initialize(context)  # memory of arrays
        with cache._guard_against_spurious_io_errors():
            return cache._load_overload(signature, context)

    if {"_guard_against_spurious_io_errors", "_load_overload"} <= {*dir(caching.Cache)}:
        caching.Cache.load_overload = load  # type: ignore[method-assign]


@functools.cache  # once
def _look_for_young_garbage_only() -> None:
    from numba.core import event

    depth, usual = 0, gc.get_threshold()

    def begin() -> None:  # under numba's lock, as all compiling
        nonlocal depth, usual
        if depth == 0:
            usual = gc.get_threshold()
            gc.set_threshold(*usual[:2], 1000)
        depth += 1

    def end() -> None:
        nonlocal depth
        depth -= 1
        if depth == 0:
            gc.set_threshold(*usual)

    event.register("numba:compile", _listener(begin, end))  # type: ignore[no-untyped-call]


def _listener(begin: Callable[[], None], end: Callable[[], None] = lambda: None) -> Any:
    """What numba tells when it begins and ends to compile a loop."""
    from numba.core import event

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            begin()

        def on_end(self, event: Any) -> None:
            end()

    return Listener()


def _import_without_blas() -> None:
    if _BLAS in sys.modules:
        return
    sys.modules[_BLAS] = None  # type: ignore[assignment]  # who asks for it is told that it is not there
    try:
        with contextlib.suppress(ImportError):
            importlib.import_module("numba.np.arraymath")
    finally:
        del sys.modules[_BLAS]


def tell_of_compiling(*, quiet: bool = False, tell: Callable[[str], None] = error_line) -> None:
    """On a terminal, have it told, once, when loops are compiled: the first run of a kind waits for that."""
    if quiet or not sys.stderr.isatty():
        return
    from numba.core import event

    told = False

    def begin() -> None:
        nonlocal told
        if not told:
            told = True
            tell("compiling what is used for the first time: up to a minute; later runs need not")

    event.register("numba:compile", _listener(begin))  # type: ignore[no-untyped-call]


OF_IMAGES: Final = ("images", "display")
"""Parts of `kalux.cli.rehearsal` that every reconstruction comes to after the estimates."""

OF_ALL: Final = ("images", "segment", "display", "filter")
"""Those of the default filter. What is come to last is first."""

_MOST_ALONE: Final = 3
"""Parts that one process alone does: they take it as long as the others take the command."""

_MOST_BESIDE: Final = 2
"""Processes: the estimates, which the command itself compiles, take as long as each of these does then."""


@contextlib.contextmanager
def compiling_beside(parts: Sequence[str], threads: int) -> Generator[None, None, None]:
    """Within it, where this process has to compile a loop, others compile what it will come to later.

    numba compiles one loop at a time, whatever the number of threads. Processes start with the first loop that is not
    kept: where all are, nothing is done. They leave nothing but numba's cache, so that no result depends on them, nor
    on whether they come to an end, and nobody waits for them: what they have not compiled in time this process
    compiles itself. Those that are still running when the block is left are ended.

    Parameters
    ----------
    parts
        Of `kalux.cli.rehearsal`, which the processes take in turns; one alone leaves those after three to the command.
    threads
        That there may be, of which this process is one.
    """
    from numba.core import event

    running: list[subprocess.Popen[bytes]] = []
    count = min(threads - 1, _MOST_BESIDE) if sys.executable else 0
    parts = parts[:_MOST_ALONE] if count == 1 else parts
    waiting = [list(parts[number::count]) for number in range(count)]

    def begin() -> None:
        while waiting:
            # -P: what lies in the working folder is not imported in place of modules.
            command = [sys.executable, "-P", "-m", "kalux.cli.rehearsal", *waiting.pop(0)]
            none = subprocess.DEVNULL
            with contextlib.suppress(OSError):  # no room for another process: all is compiled in this one
                running.append(subprocess.Popen(command, stdin=none, stdout=none, stderr=none))

    try:
        with event.install_listener("numba:compile", _listener(begin)):
            yield
    finally:
        waiting.clear()
        for process in running:
            process.terminate()
            process.wait()
