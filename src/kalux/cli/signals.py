"""SIGTERM as Ctrl-C."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType


@contextlib.contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """Inside the block, SIGTERM does what Ctrl-C does: it raises KeyboardInterrupt, held back during a write.

    Where Ctrl-C is ignored, as in a shell's background jobs, it stays ignored, and SIGTERM still works.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ignores_interrupt = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    terminated = False

    def terminate(number: int, frame: FrameType | None) -> None:
        nonlocal terminated
        terminated = True
        signal.raise_signal(signal.SIGINT)

    def interrupt(number: int, frame: FrameType | None) -> None:
        if terminated or not ignores_interrupt:
            raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, terminate), signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        for number, handler in zip((signal.SIGTERM, signal.SIGINT), previous, strict=True):
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


@contextlib.contextmanager
def interrupts_held() -> Iterator[Callable[[], None]]:
    """Inside the block, an interrupt waits until the function that the block gets is called, or for its end.

    For libraries that cannot bear an exception in the middle of their work.
    """
    received = False

    def hold(number: int, frame: FrameType | None) -> None:
        nonlocal received
        received = True

    def let_through() -> None:
        if received:
            raise KeyboardInterrupt

    previous = signal.getsignal(signal.SIGINT)
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or previous is None or previous == signal.SIG_IGN:
        yield let_through
        return
    signal.signal(signal.SIGINT, hold)
    try:
        yield let_through
    finally:
        signal.signal(signal.SIGINT, previous)
    if received:
        signal.raise_signal(signal.SIGINT)
