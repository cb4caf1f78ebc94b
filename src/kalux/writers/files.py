"""Files that are whole or not there; errors of the operating system in one clear line."""

from __future__ import annotations

import contextlib
import errno
import fcntl
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


def check_length(path: Path) -> None:
    """Check that a file of this name, and its temporary one, may have such long names.

    Raises
    ------
    OSError
        A name is too long.
    """
    try:
        os.lstat(temporary_path(path))
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise


class Claim:
    """The right to write an output, which one writer has at a time; the system ends it with the process.

    Of a file it is a lock on its temporary file, which is created or, if a process was killed, left from it; of a
    folder a lock on the folder. Where the system has no such locks, nothing is locked.

    Parameters
    ----------
    path
        The output.
    is_folder
        Whether it is a folder, which is there.

    Raises
    ------
    OutputError
        If another writer has it.
    OSError
        As of the operating system.
    """

    def __init__(self, path: Path, *, is_folder: bool = False) -> None:
        self._descriptor = -1
        self._is_folder = is_folder
        self.temporary = path if is_folder else temporary_path(path)
        self._descriptor = self._locked(path)

    def _locked(self, path: Path) -> int:
        flags = os.O_RDONLY if self._is_folder else os.O_RDWR | os.O_CREAT
        while True:
            descriptor = os.open(self.temporary, flags, 0o666)
            try:
                if not _lock(descriptor):
                    raise OutputError(
                        f"{path}: it is being written already; wait until that has ended, or choose another name"
                    )
                # The writer before may have renamed or removed the file since it was opened.
                if self._is_folder or _is_open_as(descriptor, self.temporary):
                    return descriptor
            except BaseException:
                os.close(descriptor)
                raise
            os.close(descriptor)

    def release(self) -> None:
        """Give it up, and remove the temporary file if it has not got the output's name. Twice is once."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor < 0:
            return
        if not self._is_folder and _is_open_as(descriptor, self.temporary):
            remove_quietly(self.temporary)
        os.close(descriptor)

    def __enter__(self) -> Path:
        return self.temporary

    def __exit__(self, *error: object) -> None:
        self.release()

    def __del__(self) -> None:
        self.release()  # of a writer that nobody has closed


def _lock(descriptor: int) -> bool:
    """Whether a file or folder is now locked, or cannot be: some file systems have no such locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def _is_open_as(descriptor: int, path: Path) -> bool:
    """Whether the open file has this name."""
    with contextlib.suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    return False


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name to write a file under, which gets its own name at the end, unless something fails.

    Raises
    ------
    OSError
        As of the operating system, or of `Claim`; the temporary file is removed.
    """
    with Claim(path) as temporary:
        yield temporary
        os.replace(temporary, path)


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that it is whole under its name, or not there (or as it was before).

    Raises
    ------
    OSError
        As of `replacing`.
    """
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(data)


def write_within(path: Path, data: bytes) -> None:
    """As `write_whole`, in a folder that the writer has claimed: the file needs no lock of its own, which takes as long
    as all else but the data.

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
