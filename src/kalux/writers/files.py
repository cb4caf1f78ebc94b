"""Files that are whole or not there; errors of the operating system in one clear line."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

from kalux.errors import OutputError
from kalux.wording import one_line

_REASONS = {
    errno.ENOSPC: "no space is left on the disk",
    errno.EDQUOT: "the disk quota is used up",
    errno.EACCES: "no permission to write there",
    errno.EPERM: "no permission to write there",
    errno.EROFS: "the file system is read-only",
    errno.EFBIG: "the file would be larger than allowed",
}


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold back SIGINT (Ctrl-C) until the end of the block, then let it happen.

    Signals reach Python in the main thread only; in others there is nothing to hold back.
    """
    previous = signal.getsignal(signal.SIGINT)
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or previous is None or previous == signal.SIG_IGN:
        yield
        return
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
        if received:
            signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def output_errors(path: Path, consequence: str = "") -> Iterator[None]:
    """Turn an OSError in the block into an OutputError that names the path and the consequence."""
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        reason = _REASONS.get(error.errno or 0) or error.strerror or one_line(error)
        translated = OutputError(f"{path}: {reason}" + (f"; {consequence}" if consequence else ""))
        translated.errno = error.errno
        raise translated from error


def temporary_path(path: Path) -> Path:
    """Where a file is kept until it is whole: beside it, hidden."""
    return path.with_name(f".{path.name}.part")


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that it is whole under its name, or not there (or as it was before).

    Raises
    ------
    OSError
        As of the operating system; the temporary file is removed.
    """
    temporary = temporary_path(path)
    try:
        with open(temporary, "wb") as file:
            file.write(data)
        os.replace(temporary, path)
    except BaseException:
        remove_quietly(temporary)
        raise


def save(path: Path, content: bytes | str) -> None:
    """As `write_whole`, of bytes or of text.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    with output_errors(path):
        write_whole(path, content if isinstance(content, bytes) else utf8(content))


def utf8(text: str) -> bytes:
    """Text in UTF-8. Names of files that are not UTF-8 have "?" in these places: there is no other form of them."""
    return text.encode(errors="replace")


def remove_quietly(path: Path) -> None:
    """Remove a file if that is possible; for cleaning up while another error is on its way."""
    with contextlib.suppress(OSError):
        path.unlink()
