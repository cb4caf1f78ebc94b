"""Errors of reading: damage, files that the system refuses, and too little memory are told apart."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from kalux.errors import FormatError, InputError
from kalux.readers.source import reading

FILE = Path("night.h5")


@pytest.mark.parametrize("error", [ValueError("truncated\nfile"), OSError("unable to open")])
def test_damage_is_told_on_one_line(error):
    told = r"night.h5: damaged or incomplete \((truncated f|unable to open)"
    with pytest.raises(FormatError, match=told), reading(FILE, ValueError):
        raise error


def test_what_the_system_refuses_is_no_damage():
    told = "night.h5: cannot be read: Permission denied"
    with pytest.raises(InputError, match=told) as caught, reading(FILE, ValueError):
        raise PermissionError(errno.EACCES, "")
    assert not isinstance(caught.value, FormatError)


def test_too_little_memory_is_told_as_it_is():
    """Where damage can ask for too much, too: an intact file may need more than `ulimit -v` leaves."""
    with (
        pytest.raises(
            FormatError, match=r"needs more memory than there is \(Unable to allocate .*allow more"
        ),
        reading(FILE, MemoryError),
    ):
        np.empty(1 << 60, np.uint8)


def test_other_errors_are_left_alone():
    with pytest.raises(KeyError), reading(FILE, ValueError):
        raise KeyError
