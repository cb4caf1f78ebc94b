"""Interrupts wait for libraries that cannot bear them, no longer than that."""

from __future__ import annotations

import signal
import threading

import pytest

from kalux.interrupts import interrupts_held


def interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


def test_until_they_are_allowed() -> None:
    done = []

    def work() -> None:
        with interrupts_held() as allowed:
            with allowed():
                pass
            interrupt()
            done.append("held")
            with allowed():
                done.append("never")

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["held"]
    assert signal.getsignal(signal.SIGINT) == before


def test_they_come_at_once_where_they_are_allowed_and_wait_again_afterwards() -> None:
    done = []

    def work() -> None:
        with interrupts_held() as allowed:
            with pytest.raises(KeyboardInterrupt), allowed():
                interrupt()
            interrupt()
            done.append("held again")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["held again"]


def test_at_the_latest_until_the_end() -> None:
    with pytest.raises(KeyboardInterrupt), interrupts_held():
        interrupt()


def test_what_was_finished_meanwhile_is_told() -> None:
    with pytest.raises(KeyboardInterrupt) as caught, interrupts_held(done="it was finished"):
        interrupt()
    assert caught.value.__notes__ == ["it was finished"]


def test_one_within_another() -> None:
    done = []

    def work() -> None:
        with interrupts_held():
            with interrupts_held() as allowed:
                interrupt()
                with allowed():
                    done.append("inner")
            done.append("outer")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["inner", "outer"]


def test_a_handler_of_the_program_is_called_once() -> None:
    """It need not raise anything: the work then goes on."""
    told: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: told.append(number))
    try:
        with interrupts_held() as allowed:
            interrupt()
            assert not told
            with allowed():
                assert told == [signal.SIGINT]
        assert told == [signal.SIGINT]
    finally:
        signal.signal(signal.SIGINT, before)


def test_what_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interrupts_held() as allowed, allowed():
            interrupt()
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_other_threads_have_no_signals() -> None:
    done = []

    def work() -> None:
        with interrupts_held() as allowed, allowed():
            done.append(True)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done
