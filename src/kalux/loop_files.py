"""The files in which compiled loops are kept, each under a name that tells all that it was compiled from.

numba keeps a loop as long as its own module's file is not changed, and lists the files of a loop's types in another
file, which it writes first. So it may run machine code of another version of kalux, or of other types: where only a
module that the loop uses has changed, where a process is ended between both files, or two write them at a time. Here
there is no list, and no file is read under whose name another may have been written.
"""

from __future__ import annotations

import contextlib
import functools
import glob
import hashlib
import os
import pickle
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numba
import numpy as np
from numba.core.serialize import dumps

from kalux.interrupts import interrupts_held

_WRITERS: Final = ("compiled.py", "formulas.py")
"""Modules that write machine code down: any change of them counts."""


def kept(dispatcher: Any) -> Any:
    """The same loop of numba's, compiled with ``cache=True``, whose files have such names.

    An interrupt waits until it is loaded or compiled.
    """
    numbas = dispatcher._cache._cache_file
    dispatcher._cache._cache_file = _Files(Path(numbas._index_path).with_suffix(""), dispatcher)
    dispatcher.compile = _uninterrupted(dispatcher.compile)
    return dispatcher


def _uninterrupted(make: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The same, with an interrupt held until its end, 3 s at most of the largest loop, and mostly 0.01 s.

    LLVM's lock would never be released where one comes just after it was taken: other threads would wait for ever.
    """

    @functools.wraps(make)
    def uninterrupted(signature: Any) -> Any:
        with interrupts_held():
            return make(signature)

    return uninterrupted


class _Files:
    """The files of one loop, of which numba's cache asks for `load` and `save`.

    Parameters
    ----------
    base
        Folder, and what the names begin with.
    loop
        numba's, or the function in Python.
    """

    def __init__(self, base: Path, loop: Any) -> None:
        self._base, self._loop = base, loop

    def load(self, key: Any) -> Any:
        """What was saved for a key, types and processor; None if nothing was, or a power cut has left a part of it."""
        try:
            return pickle.loads(self._path(key).read_bytes())
        except (FileNotFoundError, EOFError, pickle.UnpicklingError):
            return None

    def save(self, key: Any, data: Any) -> None:
        """Keep what was compiled, whole or not at all, and remove what was compiled from something else.

        Raises
        ------
        OSError
            It cannot be written.
        """
        path = self._path(key)
        whole = dumps(data)  # type: ignore[no-untyped-call]
        part = path.with_suffix(f".{os.getpid()}.nbt")
        try:
            part.write_bytes(whole)
            part.replace(path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
        for other in self._base.parent.glob(f"{glob.escape(self._base.name)}.*"):
            if not other.name.startswith(f"{self._base.name}.{self._source}."):
                with contextlib.suppress(OSError):  # another process has removed it
                    other.unlink()

    def _path(self, key: Any) -> Path:
        kind = _short(repr(key).encode())
        return self._base.with_name(f"{self._base.name}.{self._source}.{kind}.nbc")

    @functools.cached_property
    def _source(self) -> str:
        """Of all that the loop is compiled from."""
        return _short(_writers() + b"".join(_parts(self._loop, set())))


def _short(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


@functools.cache
def _writers() -> bytes:
    """What compiles: numba, and kalux's own modules for it."""
    here = Path(__file__).parent
    return b"".join([str(numba.__version__).encode(), *((here / name).read_bytes() for name in _WRITERS)])


def _parts(value: Any, seen: set[int]) -> Iterator[bytes]:
    """What a loop is compiled from: options, instructions and constants of functions, and of those that they name."""
    options = getattr(value, "targetoptions", {})
    yield repr(
        [(name, sorted(o) if isinstance(o, set) else o) for name, o in sorted(options.items())]
    ).encode()
    value = getattr(value, "py_func", getattr(value, "_defn", value))  # of numba's loops and intrinsics
    if isinstance(value, types.FunctionType):
        if id(value) in seen:
            return
        seen.add(id(value))
        yield from _parts(value.__code__, seen)
        yield from _parts(value.__defaults__, seen)
        for name in _names(value.__code__):
            if name in value.__globals__:
                yield name.encode()
                yield from _parts(value.__globals__[name], seen)
        for cell in value.__closure__ or ():
            yield from _parts(cell.cell_contents, seen)
    elif isinstance(value, types.CodeType):
        yield value.co_code
        for constant in value.co_consts:
            yield from _parts(constant, seen)
        yield repr((value.co_names, value.co_varnames, value.co_freevars)).encode()
    elif isinstance(value, np.ndarray):
        yield repr((value.dtype, value.shape)).encode() + value.tobytes()
    elif isinstance(value, (tuple, list)):
        yield str(len(value)).encode()
        for part in value:
            yield from _parts(part, seen)
    elif isinstance(value, (types.ModuleType, type)):
        yield value.__name__.encode()
    else:
        yield repr(value).encode()


def _names(code: types.CodeType) -> Iterator[str]:
    """The globals that a function and those within it may name."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _names(constant)
