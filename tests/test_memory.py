"""Memory that is used again: never while an array over it is alive, and within bounds."""

from __future__ import annotations

import gc
import os
import pickle
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from kalux import memory

SHAPE = (480, 641)


@pytest.mark.parametrize("shape", [(), (3,), (0, 5), (64, 256), SHAPE, (2, 3, 100_000)])
@pytest.mark.parametrize("dtype", [np.float32, np.int8, np.int64])
def test_arrays_are_as_asked_for(shape, dtype):
    array = memory.empty(shape, dtype)
    assert array.shape == shape
    assert array.dtype == dtype
    assert array.flags.c_contiguous
    assert array.flags.writeable
    assert array.size == 0 or array.ctypes.data % memory.PAGE == 0
    array[...] = 7
    assert (array == 7).all()
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(array)), array)


def test_memory_comes_back_with_the_last_array_over_it():
    first = memory.empty(SHAPE)
    place, part = first.ctypes.data, first[100:, 3:].T
    del first
    gc.collect()
    other = memory.empty(SHAPE)
    assert other.ctypes.data != place  # a part of the first is still in use
    del part
    gc.collect()
    assert memory.empty(SHAPE).ctypes.data == place


def test_arrays_that_are_alive_share_nothing():
    arrays = [memory.empty((100_000 + k,)) for k in range(10)]
    for k, array in enumerate(arrays):
        array[:] = k
    assert all((array == k).all() for k, array in enumerate(arrays))


def test_what_is_kept_is_bounded():
    pieces = [memory.empty((memory.MOST_FREE // 5,), np.uint8) for _ in range(12)]
    assert memory._free.total <= memory.MOST_FREE
    del pieces
    gc.collect()
    assert memory._free.total <= memory.MOST_FREE
    memory.empty((2 * memory.MOST_FREE,), np.uint8)  # larger than all that is kept
    assert memory._free.total <= memory.MOST_FREE


def test_an_interrupt_while_memory_is_lent_is_no_error_of_its_own(monkeypatch):
    told, piece = [], np.zeros(1 << 17, np.uint8)
    monkeypatch.setattr(sys, "unraisablehook", told.append)
    lent = memory._lent_bytes(len(piece)).from_buffer(piece)  # the interrupt comes here
    del lent
    gc.collect()
    assert not told


def test_threads_get_memory_of_their_own():
    wrong = []

    def work(number: int) -> None:
        for k in range(200):
            array = memory.empty(SHAPE, np.int32)
            array[::97] = 1000 * number + k
            if not (array[::97] == 1000 * number + k).all():
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


of_glibc = pytest.mark.skipif(
    sys.platform != "linux" or "CS_GNU_LIBC_VERSION" not in os.confstr_names, reason="of glibc's allocator"
)


@of_glibc
def test_what_lies_below_something_in_use_is_given_back():
    pieces = [np.ones(1 << 16, np.uint8) for _ in range(1000)]
    last, held = pieces[-1], resident_bytes()
    del pieces
    memory.give_back()
    assert resident_bytes() < held - 40e6
    assert last.sum() == 1 << 16


IN_THREADS = """
import ctypes, sys, threading
from pathlib import Path
from kalux import memory

if "shared" in sys.argv:
    memory.share_arena()
malloc = ctypes.CDLL(None).malloc
malloc.restype = ctypes.c_void_p
places = []
threads = [threading.Thread(target=lambda: places.append(malloc(1000))) for _ in range(3)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
heap = next(line for line in Path("/proc/self/maps").read_text().splitlines() if line.endswith("[heap]"))
first, last = (int(end, 16) for end in heap.split()[0].split("-"))
print(sum(first <= place < last for place in places))
"""


@of_glibc
@pytest.mark.parametrize(
    ("arguments", "chosen", "inside"),
    [((), {}, "0"), (("shared",), {}, "3"), (("shared",), {"MALLOC_ARENA_MAX": "4"}, "0")],
)
def test_threads_share_an_arena_when_asked_to_and_the_user_has_not_chosen(arguments, chosen, inside):
    """What threads allocate lies in the process's heap, which is the first arena, or outside of it, in their own."""
    others = {name: value for name, value in os.environ.items() if name != "MALLOC_ARENA_MAX"}
    command = [sys.executable, "-c", IN_THREADS, *arguments]
    told = subprocess.run(command, env={**others, **chosen}, capture_output=True, text=True, check=True)
    assert told.stdout.strip() == inside
