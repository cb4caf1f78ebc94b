"""The output that the flags ask for."""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from kalux.cli.flags import given_display
from kalux.cli.parser import UsageError
from kalux.display import DisplaySettings
from kalux.errors import OutputError

if TYPE_CHECKING:
    from kalux.writers import VideoSettings, Writer

DEFAULT_RATE: Final = 100.0
"""Images per second where nothing is said: several per frame, and a video that plays in real time."""

FOLDER_FORMATS = ("png", "exr", "npy")
_VIDEOS = {".avi", ".mkv", ".mov", ".webm", ".gif", ".m4v"}
_IMAGES = {".png", ".exr", ".npy", ".npz", ".tif", ".jpg"}
_RECORDINGS = {".h5", ".hdf5", ".aedat4", ".mat"}
_NOT_FOLDERS = _VIDEOS | _IMAGES | _RECORDINGS
"""Endings of names of files: an output of such a name is meant to be one, not a folder."""


@dataclass(frozen=True)
class Output:
    """What is to be written where.

    Attributes
    ----------
    path
        A video or a folder.
    format
        One of `kalux.writers.FORMATS`.
    display, video, png_bits
        How it looks.
    rate_hz
        Images per second; None: they have no common rate.
    overwrite
        Whether a former output is replaced.
    """

    path: Path
    format: str
    display: DisplaySettings
    video: VideoSettings
    png_bits: int
    rate_hz: float | None
    overwrite: bool

    @property
    def settings_path(self) -> Path:
        """Where the settings are written."""
        from kalux.writers.folder import SETTINGS
        from kalux.writers.settings_file import beside

        return beside(self.path) if self.format == "mp4" else self.path / SETTINGS

    @property
    def has_variance(self) -> bool:
        """Whether images are written with their variance."""
        return self.format in ("exr", "npy")

    def open(self, described: dict[str, Any], threads: int = 1) -> Writer:
        """The writer, with ``described`` for the settings file; ``threads`` images are encoded at a time."""
        from kalux.writers import open_writer

        return open_writer(
            self.path,
            format=self.format,
            display=self.display,
            rate_hz=self.rate_hz,
            overwrite=self.overwrite,
            metadata=described,
            png_bits=8 if self.png_bits == 8 else 16,
            video=self.video,
            threads=threads,
        )


def image_rate(options: argparse.Namespace) -> float | None:
    """Images per second; None where other flags say which images."""
    if options.times is not None or options.at is not None:
        return None
    return DEFAULT_RATE if options.rate is None else float(options.rate)


def chosen_output(options: argparse.Namespace) -> Output:
    """What the flags say of the output.

    Raises
    ------
    UsageError
        Flags contradict each other or the name.
    SettingsError
        A value is out of its range.
    """
    from kalux.writers import VideoSettings
    from kalux.writers.video import make_ticks

    path: Path = options.out
    is_video = path.suffix.lower() == ".mp4"
    if is_video and options.format is not None:
        raise UsageError(
            f"--format {options.format}: {path} is a video; give a folder with -o, or no --format"
        )
    if not is_video and path.suffix.lower() in _NOT_FOLDERS and not path.is_dir():
        raise UsageError(
            f"{path}: give a name that ends in .mp4 for a video, or the name of a folder, {path.stem}, for a file per "
            f"image (--format {', '.join(FOLDER_FORMATS)})"
        )
    if path.name.lower() == ".mp4":
        raise UsageError(f"{path}: only the ending of a name; is a variable of the shell not set?")
    format = "mp4" if is_video else options.format or "png"
    _check_flags(options, format)
    rate = image_rate(options)
    video = VideoSettings(
        crf=18.0 if options.crf is None else options.crf,
        slow_motion=1.0 if options.slow_motion is None else options.slow_motion,
    )
    if is_video:
        make_ticks(rate, video)  # refuses what MP4 cannot say, before the work
    return Output(
        path, format, given_display(options), video, options.png_bits or 16, rate, options.overwrite
    )


def _check_flags(options: argparse.Namespace, format: str) -> None:
    """Refuse flags that would have no effect."""
    uses = {"png_bits": ("png",), "crf": ("mp4",), "slow_motion": ("mp4",), "display": ("png", "mp4")}
    for name, formats in uses.items():
        if getattr(options, name) is not None and format not in formats:
            flag = "--" + name.replace("_", "-")
            raise UsageError(f"{flag} is for {' and '.join(formats)}, the output is {format}")


def check_output(output: Output) -> None:
    """Check that the output can be made, before the work; the writer checks again.

    Raises
    ------
    OutputError
        It is there already, its folder cannot be written, or its name is too long.
    """
    from kalux.writers.files import check_length

    path = output.path
    with _system_errors(path):
        if output.format == "mp4":
            check_length(output.settings_path)  # the longest name of those to be made
        is_folder = path.is_dir()
        if is_folder and output.format == "mp4":
            raise OutputError(f"{path}: a folder of this name is there; choose another name for the video")
        is_there = os.path.lexists(path)  # a link that leads nowhere, too, as the writers see it
        if not is_folder and is_there and output.format != "mp4":
            raise OutputError(f"{path}: a file of this name is there; choose another name for the folder")
        taken = any(path.iterdir()) if is_folder else is_there
        if taken and not output.overwrite:
            what = "the folder is not empty" if is_folder else "there already"
            raise OutputError(f"{path}: {what}; choose another name, or replace it with --overwrite")
        _check_writable(path if is_folder else path.absolute().parent)


def check_apart(outputs: Iterable[Path | None], inputs: Iterable[Path | str | None]) -> None:
    """Refuse to replace what the command reads: an input, or a file in a folder that is one.

    A TOML file is no part of a recording: a calibration may lie in its folder, and be replaced.

    Raises
    ------
    UsageError
        With what to do instead.
    """
    given = [Path(name) for name in inputs if name is not None and os.path.exists(name)]
    for out in outputs:
        if out is None or not os.path.exists(out):
            continue
        for name in given:
            if out.samefile(name):
                raise UsageError(f"{out}: this is an input itself; choose another name for the output")
            if out.suffix.lower() != ".toml" and name.is_dir() and lies_in(out, name):
                raise UsageError(f"{out}: lies in {name}, an input; choose another place for the output")


def lies_in(path: Path, folder: Path) -> bool:
    """Whether something is a folder, or would be in it, by whatever names."""
    return path.resolve().is_relative_to(folder.resolve())


def check_file(path: Path, *, overwrite: bool) -> None:
    """Check that a file of this name can be made, before the work.

    Raises
    ------
    OutputError
        It is there already, its folder is not there or cannot be written, or its name is too long.
    """
    from kalux.writers.files import check_length

    with _system_errors(path):
        check_length(path)
        if path.is_dir():
            raise OutputError(f"{path}: a folder of this name is there; choose another name for the file")
        if os.path.lexists(path) and not overwrite:
            raise OutputError(f"{path}: there already; choose another name, or replace it with --overwrite")
        folder = path.absolute().parent
        if not folder.exists():
            raise OutputError(f"{folder}: no such folder; make it, or choose another place for the output")
        _check_writable(folder)


def check_picture(path: Path | None, *, overwrite: bool) -> None:
    """As `check_file`, for a picture, if one is asked for.

    Raises
    ------
    UsageError
        Its name is not that of a PNG.
    OutputError
        As of `check_file`.
    """
    if path is None:
        return
    if path.suffix.lower() != ".png":
        raise UsageError(f"{path}: pictures are PNG; give a name that ends in .png")
    check_file(path, overwrite=overwrite)


def write_picture(path: Path, picture: Any) -> None:
    """Write a picture, uint8, (H, W, 3) in OpenCV's order of colours, as PNG, whole or not at all."""
    import cv2

    from kalux.writers.files import save

    save(path, cv2.imencode(".png", picture)[1].tobytes())


def _check_writable(folder: Path) -> None:
    existing = next(place for place in (folder, *folder.parents) if place.exists())
    if not existing.is_dir():
        raise OutputError(f"{existing}: not a folder; choose another place for the output")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OutputError(f"{existing}: no permission to write there; choose another place for the output")


@contextlib.contextmanager
def _system_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{path}: {error.strerror or error}") from error
