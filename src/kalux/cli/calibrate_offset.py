"""``kalux calibrate offset``: the offset between the clocks of frames and events."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kalux.cli.calibrations import add_black_level, camera_calibration
from kalux.cli.parser import Parser, UsageError, number
from kalux.cli.recordings import add_recording, open_recording
from kalux.cli.terminal import say, warn
from kalux.errors import InputError

if TYPE_CHECKING:
    from kalux.calibration.offset import OffsetEstimate

_DESCRIPTION = """\
Estimate what has to be added to the frames' times to have those of the events, where no trigger tells it: by
correlation over seconds, then by a fit pixel by pixel. Frames and events must have the same pixels; for two
cameras, kalux register finds the offset on the way."""

_EXAMPLES = """\
examples:
  kalux calibrate offset night_drive.aedat4 --plot offset.png
  kalux calibrate offset events.raw --frames registered/ -o offset.toml"""


def add_command(subparsers: Any) -> None:
    """Add ``offset`` to the parser of ``kalux calibrate``."""
    parser: Parser = subparsers.add_parser(
        "offset", description=_DESCRIPTION, epilog=_EXAMPLES, usage="kalux calibrate offset REC [flags]"
    )
    add_recording(parser)
    add_range(parser.add_argument_group("search"))
    add_black_level(parser.add_argument_group("what is known"))
    group = parser.add_argument_group("output")
    group.add_argument(
        "-o", "--out", type=Path, metavar="OFFSET.toml", help="a file for kalux register --offset"
    )
    group.add_argument("--plot", type=Path, metavar="FILE.png", help="the correlation over the offset")
    group.add_argument("--overwrite", action="store_true", help="replace files that are there")
    group.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    parser.set_defaults(run=run)


def add_range(group: Any) -> None:
    """Add how far the search for an offset goes."""
    group.add_argument(
        "--range", type=number, default=2.0, metavar="S", help="how far the clocks may be apart, s (2)"
    )
    group.add_argument(
        "--around", type=number, default=0.0, metavar="MS", help="middle of that range, ms (0)"
    )


def checked_range(options: argparse.Namespace) -> tuple[float, int]:
    """Middle and reach, us."""
    from kalux.events import LATEST

    if not 0.01 <= options.range <= 600:
        raise UsageError(f"--range is {options.range:g} s; 0.01 to 600 is possible")
    centre = options.around * 1e3
    if not abs(centre) <= LATEST:
        raise UsageError(f"--around is {options.around:g} ms; at most 1e15 is possible")
    return centre, round(options.range * 1e6)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.calibration.pictures import correlation_plot
    from kalux.cli.output import check_apart, check_file, check_picture, write_picture
    from kalux.cli.plan_warnings import mend_warnings
    from kalux.cli.progress import Progress
    from kalux.planning.clock import offset_of_recording
    from kalux.recording import no_frames
    from kalux.settings import preset
    from kalux.white import WhiteCheck
    from kalux.writers.files import save

    centre, reach = checked_range(options)
    settings = camera_calibration(options.black_level).apply(preset("default"))
    check_apart([options.out, options.plot], [options.recording, options.frames])
    if options.out is not None:
        check_file(options.out, overwrite=options.overwrite)
    check_picture(options.plot, overwrite=options.overwrite)
    recording = open_recording(options)
    if not recording.source.count_frames():
        raise no_frames(recording)
    white = WhiteCheck()
    for _ in white.watched(recording.stamped_frames()):
        pass
    if (doubt := white.doubt()) is not None:
        warn(doubt)
    with Progress("correlating", quiet=options.quiet) as progress:
        found, mends = offset_of_recording(
            recording,
            settings,
            centre=centre,
            reach=reach,
            on_events=lambda count: progress.add(events=count),
        )
    for text in mend_warnings(mends, with_flags=False):
        warn(text)
    if not found.coarse.sure:
        warn(
            f"the correlation is {found.coarse.peak:.2f}, {found.coarse.ratio:.2f} times the next peak: the offset "
            "may be another; look at --plot, or narrow --range"
        )
    if not recording.exposure_known:
        warn("exposures are unknown: the offset is from the frames' stamps to the middle of their exposures")
    if not options.quiet:
        for line in described(found):
            say(line)
        black_level = options.black_level if mends.black is None else mends.black.level
        if black_level:
            say(f"of frames without their black level, {black_level:.3g} of white")
    if options.plot is not None:
        write_picture(
            options.plot,
            correlation_plot(found.coarse, offset=found.offset, standard_error=found.standard_error),
        )
    if options.out is not None:
        save(options.out, offset_toml(found))


def described(found: OffsetEstimate) -> Iterator[str]:
    """What was found, a line each."""
    yield (
        f"offset {found.offset * 1e-3:.2f} ms, standard error {found.standard_error * 1e-3:.2f} ms: "
        "to be added to the frames' times"
    )
    yield f"with the half threshold in it by which events trail the light: {found.apparent * 1e-3:.2f} ms"
    yield f"correlation {found.coarse.peak:.2f}, {found.coarse.ratio:.2f} times the next peak"


def offset_toml(found: OffsetEstimate) -> str:
    """An offset as the text of its file."""
    import tomli_w

    described = {
        "kalux_offset": 1,
        "offset_us": round(found.offset),
        "standard_error_us": round(found.standard_error, 1),
        "correlation": round(found.coarse.peak, 4),
    }
    if found.coarse.ratio < float("inf"):
        described["over_next_peak"] = round(found.coarse.ratio, 3)
    return tomli_w.dumps(described)


def read_offset(text: str) -> float:
    """us, from a number or the name of an offset file.

    Raises
    ------
    UsageError
        If it is neither, or no time that is possible.
    """
    from kalux.events import LATEST
    from kalux.settings import read_toml

    try:
        offset = float(text)
    except ValueError:
        try:
            offset = float(read_toml(Path(text))["offset_us"])
        except InputError as error:
            raise UsageError(f"--offset: neither a number of us nor a file: {error}") from error
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise UsageError(f"--offset {text}: not an offset file of kalux calibrate offset") from error
    if not abs(offset) <= LATEST:
        raise UsageError(f"--offset {text}: {offset:g} us; at most 1e18 is possible")
    return offset
