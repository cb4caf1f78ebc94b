"""``kalux calibrate shutter``: how much later than the one above each row of frames is exposed."""

from __future__ import annotations

import argparse
from typing import Any

from kalux.cli.calibrations import (
    add_black_level,
    add_result,
    camera_calibration,
    check_result,
    finish,
    mended_recording,
)
from kalux.cli.parser import Parser
from kalux.cli.recordings import add_recording, open_recording
from kalux.errors import InputError

_DESCRIPTION = """\
Estimate the time from row to row of a rolling shutter: by the delay of the events against the frames in four parts of
the image, one above the other. A tenth off is usual. Record something that moves everywhere, as bright above as below:
pixels are later the darker they are, so that a sky above dark ground looks like some milliseconds of rolling, too. The
data sheet of the camera, or its exposure register, is the better source."""

_EXAMPLES = """\
examples:
  kalux calibrate shutter drive.h5 -o shutter.toml
  kalux reconstruct drive.h5 -o drive.mp4 --calibration shutter.toml"""


def add_command(commands: Any) -> None:
    """Add ``shutter`` to the group."""
    parser: Parser = commands.add_parser(
        "shutter",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux calibrate shutter REC -o FILE.toml",
    )
    add_recording(parser)
    add_black_level(parser.add_argument_group("what is known"))
    add_result(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.calibration.rolling import estimate_row_time
    from kalux.calibration.values import Calibration
    from kalux.cli.progress import Stages
    from kalux.recording import no_frames
    from kalux.settings import preset

    check_result(options, [options.recording, options.frames])
    known = camera_calibration(options.black_level)
    opened = open_recording(options)
    if not len(opened.frames()):
        raise no_frames(opened)
    stages = Stages(quiet=options.quiet)
    (recording, settings, _), contents = mended_recording(opened, known.apply(preset("default")), stages)
    with stages.stage("comparing rows"):
        found = estimate_row_time(recording, settings.camera)
    if found is None:
        raise InputError(
            f"{recording.source.path}: no rolling shutter is seen: the delay of the events does not grow from row to "
            "row by 4 ms or more in all, or too little moves to tell"
        )
    row_time = float(f"{found:.3g}")
    white = None if contents is None else contents.white
    finish(Calibration({"camera": {"row_time": row_time}}), recording, white, options, command)
