"""``kalux calibrate``: a group of commands, each of which measures a part of the camera."""

from __future__ import annotations

import argparse
from typing import Any, Final

from kalux.cli import (
    calibrate_contrast,
    calibrate_noise,
    calibrate_offset,
    calibrate_response,
    calibrate_rig,
    calibrate_shutter,
)
from kalux.cli.parser import Parser, UsageError

SUBCOMMANDS: Final = (
    calibrate_contrast,
    calibrate_noise,
    calibrate_response,
    calibrate_rig,
    calibrate_offset,
    calibrate_shutter,
)

_DESCRIPTION = """\
Measure cameras, from their own recordings. The results are small TOML files; those of contrast, noise, response
and shutter are for --calibration of other commands, those of rig and offset for kalux register.

commands:
  contrast     the events' thresholds, global and of every pixel
  noise        noise events, hot and dead pixels, noise and clipping of frames; --fit: to held-out frames
  response     the frame camera's response, from images at several exposures
  rig          lenses and pose of an event camera and a frame camera, from a blinking board
  offset       the offset between the clocks of frames and events
  shutter      how much later than the one above each row of frames is exposed

kalux calibrate COMMAND --help says more."""

_EXAMPLES = """\
examples:
  kalux calibrate contrast textured.aedat4 -o contrast.toml
  kalux calibrate noise still.aedat4 -o noise.toml
  kalux reconstruct drive.aedat4 -o drive.mp4 --calibration contrast.toml --calibration noise.toml"""


def add_command(commands: Any) -> None:
    """Add ``calibrate`` to the parser."""
    parser: Parser = commands.add_parser(
        "calibrate",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux calibrate COMMAND ...",
    )
    parser.set_defaults(run=run)
    parser.add_commands(SUBCOMMANDS, "subcommand")


def run(options: argparse.Namespace, command: list[str]) -> None:
    """No command of the group was given."""
    raise UsageError(
        "calibrate what? contrast, noise, response, rig, offset or shutter; kalux calibrate --help says more"
    )
