"""``kalux calibrate``: what cameras are like, measured."""

from __future__ import annotations

from typing import Any

from kalux.cli import calibrate_offset, calibrate_rig
from kalux.cli.parser import Parser

_DESCRIPTION = """\
Measure what cameras are like.

  rig      lenses and pose of an event camera and a frame camera, from a blinking board
  offset   the offset between the clocks of frames and events

kalux calibrate WHAT --help says more."""


def add_command(commands: Any) -> None:
    """Add ``calibrate`` to the parser."""
    parser: Parser = commands.add_parser(
        "calibrate", description=_DESCRIPTION, usage="kalux calibrate WHAT ..."
    )
    subparsers = parser.add_subparsers(
        dest="what", prog="kalux calibrate", parser_class=Parser, required=True
    )
    for command in (calibrate_rig, calibrate_offset):
        command.add_command(subparsers)
