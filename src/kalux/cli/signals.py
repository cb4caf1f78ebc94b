"""SIGTERM, and SIGHUP of a terminal that is closed, as Ctrl-C."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType


@contextlib.contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """Inside the block, SIGTERM and SIGHUP do what Ctrl-C does: KeyboardInterrupt is raised, held back during a write.

    Where Ctrl-C is ignored, as in a shell's background jobs, it stays ignored, and SIGTERM still works. Where SIGHUP is
    ignored, as by nohup, it stays so, too.
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

    handlers = {signal.SIGTERM: terminate, signal.SIGINT: interrupt}
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        handlers[signal.SIGHUP] = terminate
    previous = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in previous.items():
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
