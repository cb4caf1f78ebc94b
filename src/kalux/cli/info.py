"""``kalux info``: what is in a recording."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kalux.cli.calibrations import add_calibration, calibration_lines, given_calibration
from kalux.cli.parser import Parser, UsageError, number, whole
from kalux.cli.terminal import say
from kalux.frames import MOSAICS
from kalux.settings import PRESETS, Settings, preset

if TYPE_CHECKING:
    from kalux.calibration.values import Calibration
    from kalux.info import Description
    from kalux.recording import Recording

_DESCRIPTION = """\
Say what is in a recording: the sensor, frames and events, exposures, what is missing; and what reconstruct
would find out from it: contrast thresholds, delay, and the noise of events, with units and origin."""

_EXAMPLES = """\
examples:
  kalux info night_drive.aedat4
  kalux info slider_depth --exposure 10000 --stamp start"""


def add_command(commands: Any) -> None:
    """Add ``info`` to the parser."""
    parser: Parser = commands.add_parser(
        "info",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux info REC [flags]",
    )
    add_recording(parser)
    group = parser.add_argument_group("what reconstruct would use")
    group.add_argument("--no-estimate", action="store_true", help="leave it out, which is faster")
    group.add_argument("--preset", default="default", metavar="NAME", help="|".join(PRESETS))
    add_calibration(group)
    parser.set_defaults(run=run)


def add_recording(parser: Parser) -> None:
    """Add what says which recording it is, and what it does not say itself."""
    group = parser.add_argument_group("recording")
    group.add_argument("recording", metavar="REC", help="file or folder, of any format that kalux reads")
    group.add_argument(
        "--exposure",
        type=whole,
        metavar="US",
        help="exposure time of all frames, us; needed where the recording has none",
    )
    group.add_argument(
        "--stamp",
        choices=("start", "middle", "end"),
        help="with --exposure: what a frame's time stamp marks (default start)",
    )
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


def _pattern(text: str) -> str:
    return "none" if text.lower() == "none" else text.upper()


def open_recording(options: argparse.Namespace) -> Recording:
    """Open the recording that the flags name."""
    import kalux

    if options.stamp is not None and options.exposure is None:
        raise UsageError("--stamp says what a frame's time marks for --exposure; give --exposure, too")
    if options.frames is None:
        for name in ("frames_start", "frames_rate", "replace_frames"):
            if getattr(options, name) not in (None, False):
                raise UsageError(
                    f"--{name.replace('_', '-')} is for frames from elsewhere; give --frames, too"
                )
    return kalux.open(
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


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.info import describe, format_description

    settings = preset(options.preset)
    recording = open_recording(options)
    calibration = given_calibration(options)
    description = describe(recording)
    say(format_description(description))
    if calibration is not None:
        say("\n".join(calibration_lines(calibration)))
    if not options.no_estimate:
        say("\n".join(settled_lines(recording, description, settings, calibration, options.preset)))


def settled_lines(
    recording: Recording,
    description: Description,
    settings: Settings,
    calibration: Calibration | None,
    name: str,
) -> list[str]:
    """What a reconstruction would settle, a line each; why it could not, if it could not."""
    from kalux.planning import plan
    from kalux.settled import saturation_text, settled

    title = f"reconstruct would use, with the preset {name}"
    if not description.frames.count:
        return [title, "  nothing: it needs frames"]
    if not recording.exposure_known:
        return [title, "  nothing can be estimated without exposure times; give --exposure"]
    asked = settings if calibration is None else calibration.apply(settings)
    made = plan(recording, at="frames", settings=asked, calibration=calibration)
    rows = [*settled(recording, made, asked), ("saturation", saturation_text(recording, made, asked))]
    width = max(len(label) for label, _ in rows)
    return [title, *(f"  {label:<{width}}  {text}" for label, text in rows)]
