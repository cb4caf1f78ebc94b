"""``kalux info``: what is in a recording."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from kalux.cli.calibrations import add_calibration, calibration_lines, given_calibration
from kalux.cli.loops import prepare_loops, tell_of_compiling
from kalux.cli.parser import Parser
from kalux.cli.progress import Stages
from kalux.cli.recordings import add_recording, open_recording
from kalux.cli.terminal import say, warn
from kalux.settings import PRESETS, Settings, preset

if TYPE_CHECKING:
    from kalux.calibration.values import Calibration
    from kalux.info import Description
    from kalux.recording import Recording

_DESCRIPTION = """\
Say what is in a recording: the sensor, frames and events, exposures, what is missing; and what reconstruct
would find out from it: contrast thresholds, delay, and the noise of events, with units and origin. What each line
means: docs/cli.md, kalux info."""

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


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.cli.checking import CHECKED_FIRST, check_recording
    from kalux.info import describe, format_description

    settings = preset(options.preset)
    prepare_loops()
    tell_of_compiling()
    stages = Stages()
    recording = stages.watched(open_recording(options))
    calibration = given_calibration(options)
    contents = None
    with stages.stage("reading"):
        description = describe(recording)
        if description.frames.count and description.exposure_known:
            contents = check_recording(recording, lambda _: None, CHECKED_FIRST)
    say(format_description(description))
    if calibration is not None:
        say("\n".join(calibration_lines(calibration)))
    for text in () if contents is None else contents.stream_warnings(of_images=False):
        warn(text)
    if not options.no_estimate:
        with stages.stage("estimating"):
            settled, doubt = settled_lines(recording, description, settings, calibration, options.preset)
        say("\n".join(settled))
        if doubt is not None:
            warn(doubt)


def settled_lines(
    recording: Recording,
    description: Description,
    settings: Settings,
    calibration: Calibration | None,
    name: str,
) -> tuple[list[str], str | None]:
    """What a reconstruction would settle, a line each, or why it could not; and a warning, or None."""
    from kalux.cli.plan_warnings import unrelated_warning
    from kalux.plan_report import plan_report, saturation_text
    from kalux.planning import plan

    title = f"reconstruct would use, with the preset {name}"
    if not description.frames.count:
        return [title, "  nothing: it needs frames; --frames joins images or a video"], None
    if not recording.exposure_known:
        return [
            title,
            "  nothing can be estimated without exposure times; give --exposure 10000 --stamp start, or what they are "
            "(us); a guess will do",
        ], None
    asked = settings if calibration is None else calibration.apply(settings)
    made = plan(recording, at="frames", settings=asked, calibration=calibration)
    rows = plan_report(recording, made, asked)
    if made.mends.ceiling is None:
        rows.append(("saturation", saturation_text(recording, made, asked)))
    width = max(len(label) for label, _ in rows)
    lines = [title, *(f"  {label:<{width}}  {text}" for label, text in rows)]
    return lines, unrelated_warning(made)
