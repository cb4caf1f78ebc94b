"""How commands have numba start, and compile, in less time."""

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
from kalux.interrupts import interrupts_held

_BLAS: Final = "scipy.linalg.cython_blas"


def prepare_loops() -> None:
    """Have numba start and compile without steps that take time and that kalux's loops do not need.

    - numba imports SciPy's BLAS to find out whether products of matrices can be compiled: 0.1 s of the 0.3 s before the
      first loop runs. kalux's loops have no such products.
    - It registers its implementations of all types, 0.2 s, which only compiling needs, not loading from the cache.
    - While it compiles, full collections of garbage look through all that it keeps, which takes an eighth more.

    Must be called before threads are started, which might import SciPy at the same time. Where SciPy is imported
    already, or another version of numba has other internals, nothing is gained and nothing lost.
    """
    _import_without_blas()
    _load_without_compiler()
    _collect_young_garbage_only()


@functools.cache  # once
def _load_without_compiler() -> None:
    """Have cached loops loaded without the implementations of types, which numba registers itself when it compiles."""
    from numba.core import caching
    from numba.core.runtime.nrt import rtsys

    def load(cache: Any, signature: Any, context: Any) -> Any:
        with (
            interrupts_held(),
            cache._guard_against_spurious_io_errors(),
        ):  # as `kept` does, of readers' loops, too
            rtsys.initialize(context)  # memory of arrays
            return cache._load_overload(signature, context)

    if {"_guard_against_spurious_io_errors", "_load_overload"} <= {*dir(caching.Cache)}:
        caching.Cache.load_overload = load  # type: ignore[method-assign]


@functools.cache  # once
def _collect_young_garbage_only() -> None:
    """Have no full collection of garbage while numba compiles."""
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
    """A listener that calls ``begin`` and ``end`` when numba begins and ends to compile a loop."""
    from numba.core import event

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            begin()

        def on_end(self, event: Any) -> None:
            end()

    return Listener()


def _import_without_blas() -> None:
    """Import the part of numba that imports SciPy's BLAS while that cannot be imported."""
    if _BLAS in sys.modules:
        return
    sys.modules[_BLAS] = None  # type: ignore[assignment]  # an import of it then fails
    try:
        with contextlib.suppress(ImportError):
            importlib.import_module("numba.np.arraymath")
    finally:
        del sys.modules[_BLAS]


def tell_of_compiling(*, quiet: bool = False, tell: Callable[[str], None] = error_line) -> None:
    """On a terminal, have a line printed when the first loop is compiled, which the first run of a kind waits for."""
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
"""Parts of `kalux.cli.rehearsal` that every reconstruction needs after the estimates."""

OF_ALL: Final = ("images", "segment", "display", "filter")
"""Those that the default filter needs. The part that is needed last comes first."""

_MOST_ALONE: Final = 3
"""Parts that a single process compiles: it takes as long for these as the command for the rest."""

_MOST_BESIDE: Final = 2
"""Most processes beside the command: each takes as long as the command, which compiles the estimates."""


@contextlib.contextmanager
def compiling_beside(parts: Sequence[str], threads: int) -> Generator[None, None, None]:
    """Inside the block, if this process has to compile a loop, other processes compile loops that it needs later.

    numba compiles one loop at a time, whatever the number of threads. The processes start with the first loop that is
    not in the cache, if there is one. All that they leave is numba's cache: no result depends on them, and nobody waits
    for them. What they have not compiled in time this process compiles itself. Those that still run at the end of the
    block are terminated.

    Parameters
    ----------
    parts
        Of `kalux.cli.rehearsal`, dealt out to the processes; a single process takes only the first three.
    threads
        How many may be used, this process among them.
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
            with contextlib.suppress(OSError):  # no process can be started: this one compiles all
                running.append(subprocess.Popen(command, stdin=none, stdout=none, stderr=none))

    try:
        with event.install_listener("numba:compile", _listener(begin)):
            yield
    finally:
        waiting.clear()
        for process in running:
            process.terminate()
            process.wait()
