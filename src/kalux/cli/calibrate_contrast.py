"""``kalux calibrate contrast``: the events' thresholds from a recording."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kalux.cli.calibrations import calibration_lines
from kalux.cli.info import add_recording, open_recording
from kalux.cli.parser import Parser, whole
from kalux.cli.terminal import say

if TYPE_CHECKING:
    from kalux.calibration.values import Calibration
    from kalux.recording import Recording

_DESCRIPTION = """\
Measure the contrast thresholds, ON and OFF, on average and of every pixel, with their spread and standard errors,
from a recording with motion before well exposed pixels. Five frames are enough for the average; pixels of their
own need some seconds of texture everywhere."""

_EXAMPLES = """\
examples:
  kalux calibrate contrast textured.aedat4 -o contrast.toml
  kalux calibrate contrast slider_depth --exposure 10000 -o contrast.toml"""


def add_command(commands: Any) -> None:
    """Add ``contrast`` to the group."""
    parser: Parser = commands.add_parser(
        "contrast",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux calibrate contrast REC -o FILE.toml",
    )
    add_recording(parser)
    group = parser.add_argument_group("what is known")
    group.add_argument(
        "--response",
        default="auto",
        help="of the camera, as in --camera.response (default: what the recording states, else linear)",
    )
    group.add_argument(
        "--delay", type=whole, metavar="US", help="how late the events are (default: from the recording)"
    )
    group.add_argument(
        "--refractory",
        type=whole,
        default=0,
        metavar="US",
        help="refractory period of the pixels (default 0)",
    )
    add_result(parser)
    parser.set_defaults(run=run)


def add_result(parser: Parser) -> None:
    """Add where the result goes."""
    group = parser.add_argument_group("output")
    group.add_argument("-o", "--out", type=Path, metavar="FILE", help="TOML; maps of pixels beside it, .npz")
    group.add_argument("--overwrite", action="store_true", help="replace the files if they are there")
    group.add_argument("--quiet", action="store_true", help="print warnings and errors only")


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.calibration.thresholds import calibrate_contrast
    from kalux.errors import InputError
    from kalux.recording import no_frames
    from kalux.settings import CameraSettings

    check_result(options)
    recording = open_recording(options)
    if not len(recording.frames()):
        raise no_frames(recording)
    found = calibrate_contrast(
        recording,
        CameraSettings(response=options.response),
        delay=options.delay,
        refractory=options.refractory,
    )
    if found is None:
        raise InputError(
            f"{recording.source.path}: too little moves before well exposed pixels to measure thresholds; record "
            "texture that moves, without saturation"
        )
    finish(found.calibration(), recording, options, command)


def check_result(options: argparse.Namespace) -> None:
    """Check that the result can be written, before the work.

    Raises
    ------
    UsageError, OutputError
        It is no TOML file, is there already, or its folder cannot be written.
    """
    from kalux.cli.output import check_file
    from kalux.cli.parser import UsageError

    if options.out is None:
        return
    if options.out.suffix.lower() != ".toml":
        raise UsageError(f"{options.out}: a calibration is a TOML file; give a name that ends in .toml")
    for path in (options.out, options.out.with_suffix(".npz")):
        check_file(path, overwrite=options.overwrite)


def finish(
    calibration: Calibration, recording: Recording | None, options: argparse.Namespace, command: list[str]
) -> None:
    """Print the result and write it."""
    import kalux
    from kalux.writers.calibration import save_calibration

    provenance: dict[str, Any] = {"command": shlex.join(command), "kalux": kalux.__version__}
    if recording is not None:
        height, width = recording.sensor_size
        provenance |= {
            "recording": str(recording.source.path),
            "format": recording.source.format,
            "width": width,
            "height": height,
        }
    made = dataclasses.replace(calibration, provenance=provenance)
    if not options.quiet:
        say("\n".join(calibration_lines(dataclasses.replace(made, provenance={}))))
    if options.out is not None:
        written = save_calibration(made, options.out)
        if not options.quiet:
            say("wrote " + " and ".join(str(path) for path in written[::-1]))
