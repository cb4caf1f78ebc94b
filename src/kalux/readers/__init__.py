"""Readers, one module per format, chosen by content."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from kalux.errors import FormatError, InputError
from kalux.readers import (
    aedat2,
    aedat3,
    aedat4,
    dsec,
    es,
    evreal,
    hdf5,
    hqf,
    ijrr,
    mat,
    metavision_hdf5,
    mvsec,
    npz_folder,
    numpy_files,
    plain_hdf5,
    prophesee,
    rosbag,
    table,
    v2e,
)
from kalux.readers.images import IMAGES, RADIANCE
from kalux.readers.source import CHUNK_EVENTS, Source

__all__ = ["CHUNK_EVENTS", "READERS", "Reader", "Source", "read"]

_VIDEOS: Final = frozenset({".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v"})

_NAMED: Final = 3  # recordings in a folder, of more

# What may lie where a recording should, by the first bytes, and what to do about it.
_NOT_RECORDINGS: Final = (
    (
        b"version https://git-lfs",
        "a pointer of Git LFS to the file, not the file (fetch it by 'git lfs pull'); ",
    ),
    (b"<!doctype html", "a web page, perhaps what a download gave instead of the file; "),
    (b"<html", "a web page, perhaps what a download gave instead of the file; "),
    (b"\x1f\x8b", "compressed by gzip, which has to be unpacked first; "),
    (b"BZh", "compressed by bzip2, which has to be unpacked first; "),
    (b"\xfd7zXZ", "compressed by xz, which has to be unpacked first; "),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive, which has to be unpacked first; "),
    (b"Rar!", "a RAR archive, which has to be unpacked first; "),
)


class Reader(NamedTuple):
    """One format: its name, a one-line description, how to recognise it and how to open it.

    ``choose`` opens what is named after a ``?`` in the path, where a format may hold several recordings.
    """

    name: str
    description: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path], Source]
    choose: Callable[[Path, str], Source] | None = None


READERS: tuple[Reader, ...] = (
    Reader("aedat4", "AEDAT 4 (iniVation DV)", aedat4.recognises, aedat4.read),
    Reader("aedat2", "AEDAT 2.0 (jAER, DAVIS)", aedat2.recognises, aedat2.read),
    Reader("aedat3", "AEDAT 3.1 (cAER, libcaer)", aedat3.recognises, aedat3.read),
    Reader("kalux", "kalux HDF5", hdf5.recognises, hdf5.read),
    Reader("mat", "MATLAB file of the AKF authors (v5, v7.3)", mat.recognises, mat.read),
    Reader("raw", "Prophesee RAW (EVT 2.0, 2.1, 3.0)", prophesee.recognises_raw, prophesee.read_raw),
    Reader("dat", "Prophesee DAT", prophesee.recognises_dat, prophesee.read_dat),
    Reader("ros", "ROS 1 bag, ROS 2 db3 or MCAP", rosbag.recognises, rosbag.read, rosbag.read),
    Reader("dsec", "DSEC folder or events.h5", dsec.recognises, dsec.read),
    Reader("hqf", "HDF5 of HQF and E2VID+ (ECNN)", hqf.recognises, hqf.read),
    Reader("mvsec", "HDF5 of MVSEC", mvsec.recognises, mvsec.read),
    Reader("v2e", "HDF5 of v2e", v2e.recognises, v2e.read),
    Reader("metavision", "Metavision HDF5", metavision_hdf5.recognises, metavision_hdf5.read),
    # After all layouts of HDF5 that say more.
    Reader("hdf5", "other HDF5 (t, x, y, p)", plain_hdf5.recognises, plain_hdf5.read, plain_hdf5.read),
    Reader("es", "Event Stream (.es, DVS)", es.recognises, es.read),
    Reader(
        "npz-folder",
        "folder of .npz events and images (HS-ERGB, BS-ERGB, vid2e)",
        npz_folder.recognises,
        npz_folder.read,
    ),
    Reader("evreal", "EVREAL folder", evreal.recognises, evreal.read),
    # Before IJRR, whose zips could also be .npz; a broken zip is left to IJRR to report.
    Reader("numpy", "NumPy .npz or .npy", numpy_files.recognises, numpy_files.read),
    Reader("ijrr", "IJRR text folder or zip (events.txt)", ijrr.recognises, ijrr.read),
    Reader("table", "CSV or text with named columns", table.recognises, table.read),
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
    path, choice = _split(Path(path))
    try:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
        reader = next((reader for reader in READERS if reader.recognises(path)), None)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if reader is None:
        if held := plain_hdf5.held(path):
            raise FormatError(
                f"{path}: an HDF5 file, but not a recording that kalux knows: it holds {held}; columns t, x, y and p, "
                "or a table of them, are needed"
            )
        known = "; ".join(reader.description for reader in READERS)
        raise FormatError(f"{path}: {_what_it_is(path)}not a recording that kalux knows. It reads: {known}")
    if not choice:
        return reader.open(path)
    if reader.choose is None:
        raise InputError(
            f"{path}: nothing can be chosen after '?' in a recording of this format ({reader.name})"
        )
    return reader.choose(path, choice)


def _what_it_is(path: Path) -> str:
    """What somebody may have taken for a recording, as the beginning of a sentence; or nothing."""
    if path.is_dir():
        names = [file.suffix.lower() for file in path.iterdir()]
        if not names:
            return "an empty folder, "
        if any(name in IMAGES for name in names):
            return (
                "a folder of images, which --frames takes beside the recording of the events, and kalux "
                "hdr-reference if they are photographs at several exposures; "
            )
        if "images.txt" in {file.name for file in path.iterdir()}:
            return "a folder of frames (images.txt) without their events (events.txt); "
        recordings = _recordings_in(path)
        return (
            f"a folder of recordings ({', '.join(recordings)}), of which one is opened at a time, and kalux benchmark "
            "takes all; "
            if recordings
            else ""
        )
    if not path.is_file():
        return (
            "a pipe or a device, of which nothing can be read twice, so that it has to be copied to a file; "
        )
    if not path.stat().st_size:
        return "an empty file, "
    with path.open("rb") as file:
        beginning = file.read(64).lstrip().lower()
    for signature, meaning in _NOT_RECORDINGS:
        if beginning.startswith(signature.lower()):
            return meaning
    if path.suffix.lower() in RADIANCE:
        return "a radiance image, which kalux simulate makes a recording from; "
    if path.suffix.lower() in IMAGES | _VIDEOS:
        return "an image or a video, which --frames takes beside the recording of the events; "
    return ""


def _recordings_in(folder: Path) -> list[str]:
    """The names of the first recordings in a folder."""
    found = (path.name for path in sorted(folder.iterdir()) if any(r.recognises(path) for r in READERS))
    return list(itertools.islice(found, _NAMED))


def _split(path: Path) -> tuple[Path, str]:
    """A path and the choice after its ``?``, unless that belongs to the name of the file."""
    name, mark, choice = str(path).partition("?")
    return (Path(name), choice) if mark and not path.exists() else (path, "")
