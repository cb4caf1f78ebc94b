"""``--calibration``: what was measured of a sensor, for every command that uses it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from kalux.calibration.values import Calibration


def add_calibration(group: Any) -> None:
    """Add the flag to a parser or a group of one."""
    group.add_argument(
        "--calibration",
        type=Path,
        action="append",
        metavar="FILE",
        help="of kalux calibrate; may be given more than once, the last wins",
    )


def given_calibration(options: argparse.Namespace) -> Calibration | None:
    """All calibrations that were given, merged; None without."""
    if not options.calibration:
        return None
    from kalux.calibration.values import load_calibration

    return load_calibration(*options.calibration)


def calibration_lines(calibration: Calibration) -> list[str]:
    """For people: a line for every value, with its unit."""
    from kalux.calibration.values import describe_calibration

    rows = describe_calibration(calibration)
    made = calibration.provenance.get("command")
    if made:
        rows.append(("made by", str(made)))
    width = max((len(name) for name, _ in rows), default=0)
    return ["calibration", *(f"  {name:<{width}}  {text}" for name, text in rows)]
