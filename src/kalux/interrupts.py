"""Ctrl-C while a library is at work that cannot bear an exception in the middle of it. Standard library only."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from types import FrameType


@contextlib.contextmanager
def interrupts_held(*, done: str = "") -> Iterator[Callable[[], AbstractContextManager[None]]]:
    """Inside the block, an interrupt (SIGINT) waits for its end, or for a block of what this one gets, which allows it.

    Signals reach Python in the main thread only; in others, and where none is handled, there is nothing to hold back.
    ``done`` says what is there where the interrupt waited for the end; it becomes a note of the KeyboardInterrupt.
    """
    previous = signal.getsignal(signal.SIGINT)
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or not callable(previous):
        yield contextlib.nullcontext
        return
    handle = previous
    held, received = True, False

    def hold(number: int, frame: FrameType | None) -> None:
        nonlocal received
        if held:
            received = True
        else:
            handle(number, frame)

    @contextlib.contextmanager
    def allowed() -> Iterator[None]:
        nonlocal held, received
        try:
            held = False
            if received:
                received = False
                signal.raise_signal(signal.SIGINT)
            yield
        finally:
            held = True

    signal.signal(signal.SIGINT, hold)
    try:
        yield allowed
    finally:
        signal.signal(signal.SIGINT, previous)
    if received:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as interrupt:
            if done:
                interrupt.add_note(done)
            raise
