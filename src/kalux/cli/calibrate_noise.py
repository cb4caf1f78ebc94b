"""``kalux calibrate noise``: noise of events and frames from a recording."""

from __future__ import annotations

import argparse
from typing import Any

from kalux.cli.calibrations import (
    add_black_level,
    add_calibration,
    add_result,
    camera_calibration,
    check_result,
    finish,
    given_calibration,
    mended_recording,
)
from kalux.cli.parser import Parser, whole
from kalux.cli.recordings import add_recording, open_recording
from kalux.cli.terminal import say

_DESCRIPTION = """\
Measure the background noise of the events (rate, hot and dead pixels), the noise of the frames (read and shot), where
they clip if events say so, and the events' delay. A still camera, or still parts of the scene, tell most.

With --fit, what is left (scale and spread of the thresholds, I_0, variances) is fitted to the recording's own frames:
every second is held out, and the settings are chosen under which they are most likely."""

_EXAMPLES = """\
examples:
  kalux calibrate noise still.aedat4 -o noise.toml
  kalux calibrate noise drive.aedat4 --fit --calibration contrast.toml -o drive.toml"""


def add_command(commands: Any) -> None:
    """Add ``noise`` to the group."""
    parser: Parser = commands.add_parser(
        "noise", description=_DESCRIPTION, epilog=_EXAMPLES, usage="kalux calibrate noise REC -o FILE.toml"
    )
    add_recording(parser)
    group = parser.add_argument_group("what is known")
    group.add_argument(
        "--response",
        help="of the camera, as in --camera.response (default: what the recording states, else linear)",
    )
    add_black_level(group)
    add_calibration(group)
    group = parser.add_argument_group("fit")
    group.add_argument("--fit", action="store_true", help="fit the rest to held-out frames")
    group.add_argument(
        "--evaluations", type=whole, default=60, metavar="N", help="reconstructions at most (default 60)"
    )
    group.add_argument(
        "--fit-frames",
        type=whole,
        default=40,
        metavar="N",
        help="of the recording's first N frames (default 40)",
    )
    add_result(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    import dataclasses

    from kalux.calibration.noise import calibrate_noise
    from kalux.calibration.values import Calibration, require_white
    from kalux.cli.progress import Progress, Stages
    from kalux.settings import preset

    check_result(options, [options.recording, options.frames])
    known = (given_calibration(options) or Calibration()).merged(
        camera_calibration(options.black_level, options.response)
    )
    opened = open_recording(options)
    require_white(known, opened)
    stages = Stages(quiet=options.quiet)
    (recording, settings, mends), contents = mended_recording(opened, known.apply(preset("default")), stages)
    with stages.stage("measuring noise"):
        is_compressed = mends.compression is not None
        measured = calibrate_noise(recording, settings.camera, mends.hot, is_compressed=is_compressed)
        found = measured.calibration()
    if mends.ceiling is not None or mends.is_clean_end:
        found = found.merged(Calibration({"camera": {"saturation": settings.camera.saturation}}))
    if options.fit:
        from kalux.evaluation.fit import fit_settings

        start = known.merged(found)
        with Progress("fitting", images=options.evaluations, quiet=options.quiet) as progress:
            fitted = fit_settings(
                recording,
                start,
                evaluations=options.evaluations,
                most_frames=options.fit_frames,
                on_evaluation=lambda: progress.add(images=1),
            )
        if not options.quiet:
            say(fitted.described())
        found = start.merged(fitted.calibration())
    white = None if contents is None else contents.white
    finish(dataclasses.replace(found, provenance={}), recording, white, options, command)
