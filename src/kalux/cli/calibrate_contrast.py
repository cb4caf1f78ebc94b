"""``kalux calibrate contrast``: the events' thresholds from a recording."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from kalux.cli.calibrations import (
    add_black_level,
    add_result,
    camera_calibration,
    check_result,
    finish,
    mended_recording,
)
from kalux.cli.parser import Parser, whole
from kalux.cli.recordings import add_recording, open_recording

if TYPE_CHECKING:
    from kalux.cli.checking import Contents
    from kalux.planning.mending import Mends

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
    add_black_level(group)
    group.add_argument(
        "--delay", type=whole, metavar="US", help="how late the events are (default: from the recording)"
    )
    group.add_argument(
        "--refractory",
        type=whole,
        metavar="US",
        help="refractory period of the pixels (default: from the recording)",
    )
    add_result(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.calibration.pixel_thresholds import calibrate_contrast
    from kalux.cli.progress import Stages
    from kalux.errors import InputError
    from kalux.recording import no_frames
    from kalux.settings import altered, preset

    check_result(options, [options.recording, options.frames])
    settings = camera_calibration(options.black_level, options.response).apply(preset("default"))
    settings = altered(settings, "events", delay=options.delay, refractory_period=options.refractory)
    recording = open_recording(options)
    if not len(recording.frames()):
        raise no_frames(recording)
    stages = Stages(quiet=options.quiet)
    (recording, settings, mends), contents = mended_recording(recording, settings, stages)
    with stages.stage("measuring thresholds"):
        found = calibrate_contrast(
            recording, settings.camera, delay=options.delay, refractory=options.refractory
        )
    assert contents is not None
    if found is None:
        raise InputError(f"{recording.source.path}: {untold(contents, mends)}")
    finish(found.calibration(), recording, contents.white, options, command)


def untold(contents: Contents, mends: Mends) -> str:
    """Why a recording does not tell the thresholds, and what to do."""
    if contents.frames < 2:
        return "there is one frame; thresholds are measured from how frames differ, and two are needed"
    if contents.events_between == 0:
        what = "are no events" if contents.events == 0 else "is no event between the frames"
        return f"there {what} to measure thresholds of"
    if contents.one_sided:
        return "events of one polarity do not tell thresholds; record both, ON and OFF"
    if mends.layout is not None and not mends.layout.agrees:
        return (
            "frames and events change, but not together, so that they do not tell thresholds; kalux calibrate offset "
            "REC finds out whether both have the same clock, kalux register whether they see the same pixels"
        )
    return (
        "too little moves before well exposed pixels to measure thresholds; record texture that moves, without "
        "saturation"
    )
