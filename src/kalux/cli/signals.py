"""SIGTERM, and SIGHUP of a terminal that is closed, as Ctrl-C."""

from __future__ import annotations

import _thread
import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Final

_LATER: Final = 0.01
"""Seconds after which an interrupt that was lost comes again."""


@contextlib.contextmanager
def termination_as_interrupt() -> Iterator[Callable[[], bool]]:
    """Inside the block, SIGTERM and SIGHUP do what Ctrl-C does: KeyboardInterrupt is raised, held back during a write.

    Where Ctrl-C is ignored, as in a shell's background jobs, it stays ignored, and SIGTERM still works. Where SIGHUP is
    ignored, as by nohup, it stays so, too. Where it is raised while an object is collected Python drops it: it comes
    again. The block gets a function that tells whether KeyboardInterrupt was raised: libraries lose it, and fail with
    something else, as numba does where it comes while LLVM asks for a loop.
    """
    raised = terminated = ended = False
    if threading.current_thread() is not threading.main_thread():
        yield lambda: raised
        return
    ignores_interrupt = signal.getsignal(signal.SIGINT) == signal.SIG_IGN

    def terminate(number: int, frame: FrameType | None) -> None:
        nonlocal terminated
        terminated = True
        signal.raise_signal(signal.SIGINT)

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal raised
        if terminated or not ignores_interrupt:
            raised = True
            raise KeyboardInterrupt

    def come_again() -> None:
        time.sleep(_LATER)  # here it would be lost again
        if not ended:
            _thread.interrupt_main()

    def tell_unraisable(unraisable: sys.UnraisableHookArgs) -> None:
        if unraisable.exc_type is KeyboardInterrupt:
            _thread.start_new_thread(come_again, ())  # `threading` would wait until it runs
        else:
            previous_hook(unraisable)

    handlers = {signal.SIGTERM: terminate, signal.SIGINT: interrupt}
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        handlers[signal.SIGHUP] = terminate
    previous = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    previous_hook, sys.unraisablehook = sys.unraisablehook, tell_unraisable
    try:
        yield lambda: raised
    finally:
        ended = True
        sys.unraisablehook = previous_hook
        for number, handler in previous.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
