"""``kalux convert``: any recording as kalux HDF5, with nothing lost."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from kalux.cli.info import add_recording, open_recording
from kalux.cli.parser import Parser, UsageError
from kalux.cli.terminal import say, warn

if TYPE_CHECKING:
    from kalux.recording import Recording

T = TypeVar("T")

_DESCRIPTION = """\
Copy a recording of any format that kalux reads into one kalux HDF5 file: events, frames with their
exposures and white value, contrast thresholds, image noise and reference images, unchanged. Every event
and frame is checked."""

_EXAMPLES = """\
examples:
  kalux convert night_drive.aedat4 night_drive.h5
  kalux convert slider_depth slider.h5 --exposure 10000 --stamp start"""

_SUFFIXES = (".h5", ".hdf5")


def add_command(commands: Any) -> None:
    """Add ``convert`` to the parser."""
    parser: Parser = commands.add_parser(
        "convert",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux convert REC OUT.h5 [flags]",
    )
    add_recording(parser)
    group = parser.add_argument_group("output")
    group.add_argument("out", metavar="OUT.h5", type=Path, help="the kalux HDF5 file")
    group.add_argument("--overwrite", action="store_true", help="replace the file if it is there")
    group.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.cli.output import check_file
    from kalux.cli.progress import Progress, short_number

    check_name(options.out, Path(options.recording))
    check_file(options.out, overwrite=options.overwrite)
    recording = open_recording(options)
    if not recording.exposure_known:
        warn(
            "the recording has no exposure times, and the copy will not have them either; "
            "--exposure and --stamp would put them in"
        )
    if not recording.source.sensor_size_known:
        height, width = recording.sensor_size
        warn(
            f"the recording does not say how large the sensor is; the copy says {width}x{height}, which holds all "
            "events"
        )
    with Progress("converting", quiet=options.quiet) as progress:
        write_copy(recording, options.out, progress)
    if not options.quiet:
        seconds = max(progress.seconds, 1e-3)
        say(
            f"wrote {progress.events:,} events and {progress.images:,} frames to {options.out} in {seconds:.1f} s "
            f"({short_number(progress.events / seconds)} events/s)"
        )


def check_name(out: Path, recording: Path) -> None:
    """Refuse names that say something else than kalux HDF5, and the recording's own.

    Raises
    ------
    UsageError
        With what to do instead.
    """
    if out.suffix.lower() not in _SUFFIXES:
        raise UsageError(f"{out}: the output is a kalux HDF5 file; give a name that ends in .h5")
    if out.exists() and recording.exists() and out.samefile(recording):
        raise UsageError(f"{out}: this is the recording itself; choose another name for the copy")


def write_copy(recording: Recording, out: Path, progress: Any) -> None:
    """Write all that a recording holds; the file appears when it is complete.

    Raises
    ------
    InputError
        Whatever is wrong with the recording; nothing is left of the copy.
    OutputError
        If the file cannot be written.
    """
    from kalux.cli.signals import interrupts_held
    from kalux.readers import hdf5

    # An interrupt inside HDF5 would crash it: it waits for the next chunk or frame.
    with interrupts_held() as let_through:
        hdf5.write(
            out,
            sensor_size=recording.sensor_size,
            events=_counted(recording.events(), lambda chunk: progress.add(events=len(chunk)), let_through),
            frames=_counted(recording.stored_frames(), lambda _: progress.add(images=1), let_through),
            exposure_known=recording.exposure_known,
            contrast_threshold=recording.contrast_threshold,
            inverse_covariance=recording.source.inverse_covariance,
            ground_truth=recording.ground_truth(),
            mosaic=recording.mosaic,
            response=recording.response,
        )


def _counted(items: Iterable[T], count: Callable[[T], None], let_through: Callable[[], None]) -> Iterator[T]:
    for item in items:
        let_through()
        yield item
        count(item)
