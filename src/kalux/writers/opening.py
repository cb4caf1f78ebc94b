"""The right writer for an output."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from kalux.display import DisplaySettings, settings_table
from kalux.errors import SettingsError
from kalux.writers.base import Writer
from kalux.writers.folder import SETTINGS, FolderWriter
from kalux.writers.images import encode_exr, encode_npy, encode_png
from kalux.writers.settings_file import beside, plain, settings_file
from kalux.writers.video import VideoSettings, VideoWriter, make_ticks

FORMATS = ("png", "exr", "npy", "mp4")
"""Formats of `open_writer`: three for a folder with a file per image, one for a video."""


def open_writer(
    out: Path | str,
    *,
    format: str | None = None,
    display: DisplaySettings | None = None,
    rate_hz: float | None = None,
    overwrite: bool = False,
    metadata: Mapping[str, Any] | None = None,
    png_bits: Literal[8, 16] = 16,
    video: VideoSettings | None = None,
    threads: int = 1,
) -> Writer:
    """Open an output for images.

    Parameters
    ----------
    out
        A file name that ends in ``.mp4``, or a folder. Folders on the way are created.
    format
        One of `FORMATS`; may be left out for ``.mp4``.
    display
        How ``png`` and ``mp4`` show intensities; ``exr`` and ``npy`` hold them as they are.
    rate_hz
        Images per second of a video at a constant rate; all images must fit it. None: every image of a video
        has the time stamp that it has. For a folder, a note in the settings.
    overwrite
        Replace a former output of kalux. In a folder, other files are left alone.
    metadata
        Nested settings and versions for `kalux.toml`; see `settings_file`.
    png_bits
        Bits per pixel of a PNG.
    video
        Compression of a video.
    threads
        How many EXR or NPY files are encoded at a time; of PNG, and of a video's pictures, which one encoder takes in
        turn, one less, but one at least. With more than one, images are written, and errors of writing are raised, up
        to as many calls later, at the latest in ``close()``; images given must not be changed.

    Returns
    -------
    Writer
        A context manager with ``write(image)``, ``close()`` and ``stop()``.

    Raises
    ------
    SettingsError
        The format is unknown or does not fit the name, a setting or ``threads`` is out of its range, or the
        metadata has no TOML form.
    OutputError
        The output exists and ``overwrite`` is False, is being written by another writer, or cannot be created.
    """
    path = Path(out)
    chosen = choose_format(path, format)
    display = display or DisplaySettings()
    video = video or VideoSettings()
    ticks = make_ticks(rate_hz, video)
    if png_bits not in (8, 16):
        raise SettingsError(f"png_bits is {png_bits}; it must be 8 or 16")
    if threads < 1:
        raise SettingsError(f"threads is {threads}; it must be 1 or more")
    described: dict[str, Any] = {"format": chosen, "rate_hz": rate_hz}
    if chosen in ("png", "mp4"):
        described["display"] = settings_table(display)
    if chosen == "png":
        described["bits"] = png_bits
    # Of what is soon made, one thread is left for the encoder and the disk: with two, handing an image over would take
    # half as long as to make it.
    makers = max(threads - 1, 1) if chosen in ("png", "mp4") else threads
    if chosen == "mp4":
        described["video"] = plain(video, "video")
        settings = settings_file(beside(path), metadata or {}, described)
        return VideoWriter(path, display, video, ticks, settings, overwrite=overwrite, makers=makers)
    inside = settings_file(path / SETTINGS, metadata or {}, described)
    encode = {"png": encode_png(display, png_bits), "exr": encode_exr, "npy": encode_npy}[chosen]
    return FolderWriter(path, encode, f".{chosen}", inside, overwrite=overwrite, makers=makers)


def choose_format(path: Path, format: str | None) -> str:
    """The format of an output, from its name where it is not given.

    Raises
    ------
    SettingsError
        It is unknown, cannot be told from the name, or contradicts it.
    """
    if format is not None and format not in FORMATS:
        raise SettingsError(f"{path}: unknown format {format!r}; possible are {', '.join(FORMATS)}")
    is_video = path.suffix.lower() == ".mp4"
    if format is None and not is_video:
        raise SettingsError(
            f"{path}: the format cannot be told from the name; give a name that ends in .mp4 for a video, or "
            "a folder and the format png, exr or npy"
        )
    if format is not None and is_video != (format == "mp4"):
        raise SettingsError(
            f"{path}: the format {format} does not fit the name; mp4 is for names that end in .mp4, "
            "png, exr and npy are for folders"
        )
    return format or "mp4"
