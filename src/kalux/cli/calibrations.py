"""Calibrations on the command line: ``--calibration`` of every command that uses one, and the result of `calibrate`."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from kalux.cli.parser import Parser, UsageError, number
from kalux.cli.terminal import say, warn

if TYPE_CHECKING:
    from kalux.calibration.values import Calibration
    from kalux.cli.checking import Contents
    from kalux.cli.progress import Stages
    from kalux.planning.mending import Mended
    from kalux.recording import Recording
    from kalux.settings import Settings
    from kalux.white import CheckedWhite


def add_calibration(group: Any) -> None:
    """Add the flag to a parser or a group of one."""
    group.add_argument(
        "--calibration",
        type=Path,
        action="append",
        metavar="FILE",
        help="of kalux calibrate; may be given more than once, the last wins",
    )


def add_black_level(group: Any, otherwise: str = "as events say") -> None:
    """Add the flag of commands that have no others for settings; ``otherwise`` says what holds without it."""
    group.add_argument(
        "--black-level",
        type=number,
        metavar="SHARE",
        help=f"of white, what frames read in the dark, as --camera.black-level (default: {otherwise})",
    )


def camera_calibration(black_level: float | None, response: str | None = None) -> Calibration:
    """What ``--black-level`` and ``--response`` (None or auto: nothing) say of the camera.

    Raises
    ------
    SettingsError
        One is out of its range.
    """
    from kalux.calibration.values import Calibration
    from kalux.settings import AUTO

    said = {"response": None if response == AUTO else response, "black_level": black_level}
    return Calibration({"camera": {name: value for name, value in said.items() if value is not None}})


class Checked(NamedTuple):
    """A recording that is mended, and what was found in it before; None of one without frames."""

    mended: Mended
    contents: Contents | None


def mended_recording(recording: Recording, settings: Settings, stages: Stages) -> Checked:
    """The recording as a reconstruction would mend it before it measures anything, with its warnings and progress."""
    from kalux.cli.checking import CHECKED_FIRST, check_recording
    from kalux.cli.plan_warnings import calibration_warnings
    from kalux.planning.mending import mend

    contents = None
    with stages.stage("checking"):
        watched = stages.watched(recording)
        if recording.source.count_frames():
            contents = check_recording(watched, lambda _: None, CHECKED_FIRST)
        mended = mend(watched, settings)
    told = () if contents is None else contents.warnings(of_images=False)
    for text in (*told, *calibration_warnings(mended.mends)):
        warn(text)
    return Checked(mended, contents)


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


# The result of a calibration.


def add_result(parser: Parser) -> None:
    """Add where the result goes."""
    group = parser.add_argument_group("output")
    group.add_argument("-o", "--out", type=Path, metavar="FILE", help="TOML; maps of pixels beside it, .npz")
    group.add_argument("--overwrite", action="store_true", help="replace the files if they are there")
    group.add_argument("--quiet", action="store_true", help="print warnings and errors only")


def check_result(options: argparse.Namespace, inputs: Iterable[Path | str | None]) -> None:
    """Check that the result can be written, and replaces none of the command's ``inputs``, before the work.

    Raises
    ------
    UsageError, OutputError
        It is no TOML file, is there already, or its folder cannot be written.
    """
    from kalux.cli.output import check_apart, check_file

    if options.out is None:
        return
    if options.out.suffix.lower() != ".toml":
        raise UsageError(f"{options.out}: a calibration is a TOML file; give a name that ends in .toml")
    paths = options.out, options.out.with_suffix(".npz")
    check_apart(paths, inputs)
    for path in paths:
        check_file(path, overwrite=options.overwrite)


def finish(
    calibration: Calibration,
    recording: Recording | None,
    white: CheckedWhite | None,
    options: argparse.Namespace,
    command: list[str],
) -> None:
    """Print the result and write it; ``white`` is that of the recording's frames, if there are any."""
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
            **({} if white is None else {"white": white.value, "white_is_doubtful": white.is_doubtful}),
        }
    made = dataclasses.replace(calibration, provenance=provenance)
    if not options.quiet:
        say("\n".join(calibration_lines(dataclasses.replace(made, provenance={}))))
    if options.out is not None:
        written = save_calibration(made, options.out)
        if not options.quiet:
            files = " and ".join(str(path) for path in written[::-1])
            say(f"wrote {files}, for kalux reconstruct REC --calibration {shlex.quote(str(written[-1]))}")
