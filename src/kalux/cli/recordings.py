"""Recordings on the command line: which is read, and copies that are written."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from kalux.cli.parser import Parser, UsageError, number, whole
from kalux.cli.progress import counted
from kalux.cli.terminal import warn
from kalux.frames import MOSAICS

if TYPE_CHECKING:
    from kalux.events import EventArray
    from kalux.frames import Frame
    from kalux.recording import Recording

HDF5: Final = (".h5", ".hdf5")
"""Suffixes of kalux HDF5."""


def add_recording(parser: Parser) -> None:
    """Add what says which recording it is, and what it does not say itself."""
    group = parser.add_argument_group("recording")
    group.add_argument("recording", metavar="REC", help="file or folder, of any format that kalux reads")
    add_exposure(group)
    group.add_argument(
        "--frames",
        type=Path,
        metavar="FRAMES",
        help="frames from elsewhere: image folder with times, or video",
    )
    group.add_argument(
        "--frames-start", type=whole, metavar="US", help="of a video: time of its first frame, us"
    )
    group.add_argument("--frames-rate", type=number, metavar="HZ", help="of a video: frames per second")
    group.add_argument(
        "--replace-frames", action="store_true", help="--frames instead of the recording's own"
    )
    group.add_argument(
        "--white",
        type=number,
        metavar="LEVEL",
        help="value of a saturated pixel, if not stored: 4095 of 12 bits in 16",
    )
    group.add_argument(
        "--bayer",
        type=_pattern,
        choices=(*MOSAICS, "none"),
        metavar="PATTERN",
        help=f"the sensor's Bayer pattern, where the recording does not state it: {', '.join(MOSAICS)}, none",
    )


def add_exposure(group: Any) -> None:
    """Add what says when frames are exposed whose times do not say it."""
    group.add_argument(
        "--exposure",
        type=whole,
        metavar="US",
        help="exposure time of all frames, us; needed where none are stored",
    )
    group.add_argument(
        "--stamp",
        choices=("start", "middle", "end"),
        help="with --exposure: what a frame's time stamp marks (default start)",
    )


def _pattern(text: str) -> str:
    return "none" if text.lower() == "none" else text.upper()


def check_stamp(options: argparse.Namespace) -> None:
    """Refuse ``--stamp`` where there is nothing that it could say.

    Raises
    ------
    UsageError
        Without ``--exposure``.
    """
    if options.stamp is not None and options.exposure is None:
        raise UsageError("--stamp says what a frame's time marks for --exposure; give --exposure, too")


def open_recording(options: argparse.Namespace) -> Recording:
    """Open the recording that the flags name.

    Raises
    ------
    UsageError
        Flags contradict each other.
    InputError
        As of `kalux.open`.
    """
    import kalux

    check_stamp(options)
    if options.frames is None:
        for name in ("frames_start", "frames_rate", "replace_frames"):
            if getattr(options, name) not in (None, False):
                raise UsageError(
                    f"--{name.replace('_', '-')} is for frames from elsewhere; give --frames, too"
                )
    recording = kalux.open(
        Path(options.recording),
        exposure=options.exposure,
        stamp=options.stamp or "start",
        frames=options.frames,
        frames_start=options.frames_start,
        frames_rate=options.frames_rate,
        replace_frames=options.replace_frames,
        mosaic=options.bayer,
        white=options.white,
    )
    if options.exposure is not None and recording.source.exposure_known and recording.source.count_frames():
        warn(f"the recording states its exposure times; --exposure {options.exposure} replaces them")
    return recording


# Copies.


def check_name(out: Path, recording: Path, suffixes: tuple[str, ...] = HDF5) -> None:
    """Refuse names that say another format than is written, and the recording's own.

    Raises
    ------
    UsageError
        With what to do instead.
    """
    if out.suffix.lower() not in suffixes:
        also = ", or in .aedat4 for AEDAT 4" if ".aedat4" in suffixes else ""
        raise UsageError(f"{out}: the output is a kalux HDF5 file; give a name that ends in .h5{also}")
    if os.path.exists(out) and os.path.exists(recording) and out.samefile(recording):
        raise UsageError(f"{out}: this is the recording itself; choose another name for the copy")


class Stated(NamedTuple):
    """What a copy says of the sensor in place of the recording; None: what the recording says."""

    contrast_threshold: tuple[float, float] | None = None
    response: str | None = None
    black_level: float | None = None


def write_copy(recording: Recording, out: Path, progress: Any, stated: Stated | None = None) -> str | None:
    """Write all that a recording holds as kalux HDF5; the file appears when it is complete. Returns as `write_streams`.

    Raises
    ------
    InputError
        Whatever is wrong with the recording; nothing is left of the copy.
    OutputError
        If the file cannot be written.
    """
    from kalux.recording import less_black
    from kalux.writers import hdf5

    stated = stated or Stated()
    recording = less_black(recording, stated.black_level)
    write = partial(
        hdf5.write,
        out,
        sensor_size=recording.sensor_size,
        exposure_known=recording.exposure_known,
        contrast_threshold=stated.contrast_threshold or recording.contrast_threshold,
        inverse_covariance=recording.source.inverse_covariance,
        ground_truth=recording.ground_truth(),
        mosaic=recording.mosaic,
        response=stated.response or recording.response,
    )
    return write_streams(write, recording.events(), recording.stored_frames(), progress)


def write_streams(
    write: Callable[..., None], events: Iterable[EventArray], frames: Iterable[Frame], progress: Any
) -> str | None:
    """Have a writer, which takes ``events`` and ``frames``, write them, with progress.

    Returns what makes the frames' white value doubtful; None if nothing does.
    """
    from kalux.white import WhiteCheck

    white = WhiteCheck()
    write(
        events=counted(events, lambda chunk: progress.add(events=len(chunk))),
        frames=counted(white.watched(frames), lambda _: progress.add(images=1)),
    )
    return white.doubt()
