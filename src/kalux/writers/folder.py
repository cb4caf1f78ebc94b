"""A folder with one file per image, `timestamps.csv` and `kalux.toml`."""

from __future__ import annotations

import os
import re
from io import FileIO
from pathlib import Path

from kalux.display import ToneState
from kalux.errors import OutputError
from kalux.writers.base import ImageLike, Writer
from kalux.writers.files import output_errors, remove_quietly, write_whole
from kalux.writers.images import Encode
from kalux.writers.settings_file import SettingsFile, require_ours

LISTING = "timestamps.csv"
SETTINGS = "kalux.toml"
HEADER = "index,t_us,file"

# While old outputs are being removed their list has this name, so that an interrupted removal can be resumed
# and no list names a file that is gone.
REMOVING = ".timestamps.csv.removing"
_LINE = re.compile(r"\d+,-?\d+,(\d{6,}\.(?:png|exr|npy))")


class FolderWriter(Writer):
    """Writes every image to its own file, then its line into the list, then the count into the settings."""

    def __init__(
        self, path: Path, encode: Encode, suffix: str, settings: SettingsFile, *, overwrite: bool
    ) -> None:
        super().__init__(path)
        self._encode = encode
        self._suffix = suffix
        self._settings = settings
        self._state: ToneState | None = None
        with output_errors(path, "the output folder cannot be used"):
            prepare_folder(path, overwrite=overwrite)
            settings.write(complete=False, images=0, times=None)
            write_whole(path / LISTING, f"{HEADER}\n".encode())
            self._listing = FileIO(path / LISTING, "a")

    def _write(self, image: ImageLike) -> None:
        name = f"{self._images:06d}{self._suffix}"
        file = self.path / name
        data, following = self._encode(image, self._state)
        with output_errors(file, self._consequence()):
            if os.path.lexists(file):
                raise OutputError(
                    f"{file}: there already, and not an output of kalux; move it or write to another folder"
                )
            write_whole(file, data)
            try:
                append_line(self._listing, f"{self._images},{int(image.t)},{name}\n")
            except BaseException:
                remove_quietly(file)
                raise
        self._state = following

    def _written(self) -> None:
        with output_errors(self._settings.path, self._consequence()):
            self._settings.write(complete=False, images=self._images, times=self._times)

    def _finish(self, complete: bool) -> None:
        with output_errors(self._settings.path, self._consequence()):
            self._listing.close()
            self._settings.write(complete=complete, images=self._images, times=self._times)

    def _consequence(self) -> str:
        return f"the {self._images} images listed in {self.path / LISTING} are whole"


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


def prepare_folder(path: Path, *, overwrite: bool) -> None:
    """Create a folder, or check that an existing one may be used, and remove old outputs from it.

    With ``overwrite``, what an old `timestamps.csv` of kalux lists is removed, and nothing else.

    Raises
    ------
    OutputError
        The folder is not empty and ``overwrite`` is False, or it has a `timestamps.csv` or `kalux.toml` that
        is not of kalux.
    OSError
        The folder cannot be created or read.
    """
    if os.path.lexists(path) and not path.is_dir():
        raise OutputError(f"{path}: a file of this name is there; choose another name for the folder")
    path.mkdir(parents=True, exist_ok=True)
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
