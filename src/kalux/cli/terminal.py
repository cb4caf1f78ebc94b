"""What is printed: results on stdout; warnings, errors and progress on stderr."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import sys

from kalux.errors import OutputError


def say(text: str = "") -> None:
    """Print to stdout. A reader that has gone away (``| head``, a closed terminal) is no error: work goes on silently.

    Raises
    ------
    OutputError
        Stdout cannot be written for another reason, e.g. a full disk.
    """
    encoding = sys.stdout.encoding or "utf-8"  # which names of files may not fit
    try:
        print(text.encode(encoding, "backslashreplace").decode(encoding), flush=True)
    except OSError as error:
        nobody_reads = isinstance(error, BrokenPipeError) or (error.errno == errno.EIO and _is_device())
        _discard_output()
        if nobody_reads:
            return
        raise OutputError(f"standard output: {error.strerror or error}") from error


def _is_device() -> bool:
    """Whether stdout is a device: of a terminal that is closed nothing else can be told any more."""
    try:
        return stat.S_ISCHR(os.fstat(sys.stdout.fileno()).st_mode)
    except (OSError, ValueError):
        return False


def warn(text: str) -> None:
    """Print a warning, one line."""
    error_line(f"warning: {text}")


def error_line(*parts: str) -> None:
    """Print one line to stderr, whatever line breaks file names or libraries put into it."""
    line = " ".join("; ".join(parts).split())
    with contextlib.suppress(OSError):
        print(f"kalux: {line}", file=sys.stderr, flush=True)


def hold_closed_streams() -> None:
    """Open to nothing what is closed of stdin, stdout and stderr: libraries print to whatever has these numbers."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
    # What was closed when Python began is None.
    sys.stdout = sys.stdout or open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", closefd=False)  # noqa: SIM115


def close_output() -> None:
    """Flush stdout, so that a reader that has gone away is not reported when Python ends."""
    try:
        sys.stdout.flush()
    except OSError:
        _discard_output()


def _discard_output() -> None:
    with contextlib.suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)
