"""A folder with one file per image, `timestamps.csv` and `kalux.toml`."""

from __future__ import annotations

import contextlib
import os
import re
import time
from io import FileIO
from pathlib import Path
from typing import Final, NamedTuple

from kalux.display import ToneState
from kalux.errors import OutputError
from kalux.threads import InOrder
from kalux.wording import how_many
from kalux.writers.base import ImageLike, Writer
from kalux.writers.files import Claim, output_errors, remove_quietly, write_within
from kalux.writers.images import Encode
from kalux.writers.settings_file import SettingsFile, require_ours

LISTING = "timestamps.csv"
SETTINGS = "kalux.toml"
HEADER = "index,t_us,file"
SETTINGS_EVERY: Final = 1.0
"""Seconds between counts of images in the settings: replacing a file makes some file systems wait for the disk."""

# While old outputs are being removed their list has this name, so that an interrupted removal can be resumed
# and no list names a file that is gone.
REMOVING = ".timestamps.csv.removing"
_LINE = re.compile(r"\d+,-?\d+,(\d{6,}\.(?:png|exr|npy))")


class Encoded(NamedTuple):
    """An image's time, us, and its file."""

    t: int
    data: bytes


class FolderWriter(Writer):
    """Writes every image to its own file, then its line into the list; their count into the settings once a second.

    With several ``makers``, that many files are encoded at a time, in threads of their own. They are still written
    in order, each after up to as many calls of `write`: so late, too, is the error of one that cannot be.
    """

    def __init__(
        self,
        path: Path,
        encode: Encode,
        suffix: str,
        settings: SettingsFile,
        *,
        overwrite: bool,
        makers: int = 1,
    ) -> None:
        super().__init__(path)
        self._encode = encode
        self._suffix = suffix
        self._settings = settings
        self._state: ToneState | None = None
        self._pending: InOrder[Encoded] = InOrder(makers, "encode")
        with output_errors(path, "the output folder cannot be used"):
            make_folder(path)
            self._claim = Claim(path, is_folder=True)
            try:
                prepare_folder(path, overwrite=overwrite)
                settings.write(complete=False, images=0, times=None)
                self._settings_written = time.monotonic()
                write_within(path / LISTING, f"{HEADER}\n".encode())
                self._listing = FileIO(path / LISTING, "a")
            except BaseException:
                self._claim.release()
                raise

    def _write(self, image: ImageLike) -> None:
        data, self._state = self._encode(image, self._state)
        t = int(image.t)
        self._pending.give(lambda: Encoded(t, data()), self._store)

    def _store(self, image: Encoded) -> None:
        name = f"{self._images:06d}{self._suffix}"
        file = self.path / name
        with output_errors(file, self._consequence()):
            if os.path.lexists(file):
                raise OutputError(
                    f"{file}: there already, and not an output of kalux; move it or write to another folder"
                )
            write_within(file, image.data)
            try:
                append_line(self._listing, f"{self._images},{image.t},{name}\n")
            except BaseException:
                remove_quietly(file)
                raise
        self._count(image.t)
        if time.monotonic() - self._settings_written >= SETTINGS_EVERY:
            self._write_settings(complete=False)

    def _finish(self, complete: bool) -> None:
        try:
            self._pending.finish(self._store)
        except BaseException:
            # If this fails too, the settings on disk are those of an incomplete output already.
            with contextlib.suppress(OutputError):
                self._end_files(complete=False)
            raise
        else:
            self._end_files(complete=complete)
        finally:
            self._claim.release()

    def _end_files(self, *, complete: bool) -> None:
        self._pending.end()
        with output_errors(self.path / LISTING, self._consequence()):
            self._listing.close()
        self._write_settings(complete=complete)

    def _write_settings(self, *, complete: bool) -> None:
        with output_errors(self._settings.path, self._consequence()):
            self._settings.write(complete=complete, images=self._images, times=self._times)
        self._settings_written = time.monotonic()

    def _consequence(self) -> str:
        if not self._images:
            return "no image was finished"
        verb = "is" if self._images == 1 else "are"
        return f"the {how_many(self._images, 'image')} listed in {self.path / LISTING} {verb} whole"


def append_line(file: FileIO, line: str) -> None:
    """Append a line to an unbuffered file: all of it, or the file is as before.

    Raises
    ------
    OSError
        It cannot be written.
    """
    data = line.encode()
    size = file.seek(0, os.SEEK_END)
    try:
        written = 0
        while written < len(data):
            # A disk that fills up takes a part first, and reports the error at the next attempt.
            written += file.write(data[written:]) or 0
    except BaseException:
        file.truncate(size)
        raise


def make_folder(path: Path) -> None:
    """Create a folder, if it is not there.

    Raises
    ------
    OutputError
        A file has its name.
    OSError
        It cannot be created.
    """
    if os.path.lexists(path) and not path.is_dir():
        raise OutputError(f"{path}: a file of this name is there; choose another name for the folder")
    path.mkdir(parents=True, exist_ok=True)


def prepare_folder(path: Path, *, overwrite: bool) -> None:
    """Check that a folder may be used, and remove old outputs from it.

    With ``overwrite``, what an old `timestamps.csv` of kalux lists is removed, and nothing else.

    Raises
    ------
    OutputError
        The folder is not empty and ``overwrite`` is False, or it has a `timestamps.csv` or `kalux.toml` that
        is not of kalux.
    OSError
        The folder cannot be read.
    """
    if not any(path.iterdir()):
        return
    if not overwrite:
        raise OutputError(
            f"{path}: the folder is not empty; write to another one, or allow overwriting, which replaces "
            "former outputs of kalux and leaves other files alone"
        )
    require_ours(path / SETTINGS)
    for listing in (path / REMOVING, path / LISTING):
        if os.path.lexists(listing):
            _remove_listed(path, listed_files(listing), listing)


def listed_files(listing: Path) -> list[str]:
    """The names of the files in a `timestamps.csv` of kalux.

    Raises
    ------
    OutputError
        Some line is not as kalux writes it.
    """
    # What follows the last line break is a line that a crash cut short: its image was never listed.
    lines = listing.read_text(encoding="utf-8", errors="replace").split("\n")[:-1]
    matches = [_LINE.fullmatch(line) for line in lines[1:]]
    if lines[:1] != [HEADER] or not all(matches):
        raise OutputError(
            f"{listing}: not an output of kalux, so nothing is overwritten; write to another folder"
        )
    return [match.group(1) for match in matches if match]


def _remove_listed(path: Path, names: list[str], listing: Path) -> None:
    removing = path / REMOVING
    os.replace(listing, removing)
    (path / SETTINGS).unlink(missing_ok=True)
    for name in names:
        (path / name).unlink(missing_ok=True)
    removing.unlink()
