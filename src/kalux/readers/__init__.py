"""Readers, one module per format, chosen by content."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from kalux.errors import FormatError, InputError
from kalux.readers import aedat4, hdf5, ijrr, mat
from kalux.readers.source import CHUNK_EVENTS, GroundTruth, Source

__all__ = ["CHUNK_EVENTS", "READERS", "GroundTruth", "Reader", "Source", "read"]


class Reader(NamedTuple):
    """One format: its name, a one-line description, how to recognise it and how to open it."""

    name: str
    description: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path], Source]


READERS: tuple[Reader, ...] = (
    Reader("aedat4", "AEDAT 4 (iniVation DV)", aedat4.recognises, aedat4.read),
    Reader("kalux", "kalux HDF5", hdf5.recognises, hdf5.read),
    Reader("mat", "MATLAB file of the AKF authors' datasets (v5, v7.3)", mat.recognises, mat.read),
    Reader("ijrr", "IJRR text folder or zip (events.txt, images.txt)", ijrr.recognises, ijrr.read),
)


def read(path: str | Path) -> Source:
    """Open a recording with the reader that recognises its content.

    Raises
    ------
    InputError
        If there is no such file or folder.
    FormatError
        If no reader recognises it, or the one that does finds it damaged.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    try:
        reader = next((reader for reader in READERS if reader.recognises(path)), None)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if reader is None:
        known = "; ".join(reader.description for reader in READERS)
        raise FormatError(f"{path}: not a recording that kalux knows. It reads: {known}")
    return reader.open(path)
