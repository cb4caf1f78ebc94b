"""One exception tree: every error that a user can cause or mend.

::

    KaluxError                what is wrong, where, and what to do about it
    ├── InputError            something that was given cannot be used
    │   ├── FormatError       a file is not what it claims to be, or is damaged
    │   ├── EventError        events outside the sensor, unsorted, of the wrong type
    │   ├── FrameError        a frame of the wrong size or type, not finite, out of order
    │   ├── ExposureError     exposure times are missing, empty or overlap
    │   └── SettingsError     a setting is unknown or out of its range
    ├── OutputError           an output cannot be written
    ├── MissingDependencyError  an optional library is not installed
    └── InternalError         kalux itself is wrong: please report it

Messages are one line. The command line prints them as they are and exits with code 2, or 1 for an InternalError.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class KaluxError(Exception):
    """Base of all errors that kalux raises on purpose."""


class InputError(KaluxError, ValueError):
    """Something that was given cannot be used."""


class FormatError(InputError):
    """A file is not of a known format, contradicts its format, or is damaged."""


class EventError(InputError):
    """Events lie outside the sensor, are not sorted in time, or have an unknown layout."""


class FrameError(InputError):
    """A frame has the wrong size or type, is not finite, or is out of order."""


class ExposureError(InputError):
    """Exposure times are missing, empty, or overlap each other."""


class SettingsError(InputError):
    """A setting is unknown or out of its range."""


class OutputError(KaluxError, OSError):
    """An output cannot be written."""


class MissingDependencyError(KaluxError, ImportError):
    """An optional library is not installed; the message names the extra that brings it."""


class InternalError(KaluxError, RuntimeError):
    """A result of kalux is not what it must be: an error in kalux, not in what it was given."""


def require_type(what: str, given: object, kind: type, needed: str) -> None:
    """Require an object of a class of kalux; ``needed`` says which, by its public name, and where one comes from.

    Raises
    ------
    InputError
        If it is something else.
    """
    if not isinstance(given, kind):
        raise InputError(f"{what} is a {type(given).__name__}; {needed}")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """End of a message about an unknown name: ``", did you mean ...?"`` with the nearest of those known, or nothing."""
    near = difflib.get_close_matches(name, known, 1)
    return f", did you mean {near[0]}?" if near else ""
