"""``kalux convert``: any recording as kalux HDF5, with nothing lost but triggers, or as AEDAT 4."""

from __future__ import annotations

import argparse
import dataclasses
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from kalux.cli.calibrations import add_black_level, add_calibration, camera_calibration, given_calibration
from kalux.cli.parser import Parser, UsageError
from kalux.cli.recordings import (
    HDF5,
    Stated,
    add_recording,
    check_name,
    open_recording,
    write_copy,
    write_streams,
)
from kalux.cli.terminal import say, warn
from kalux.wording import how_many

if TYPE_CHECKING:
    from kalux.recording import Recording

T = TypeVar("T")

_DESCRIPTION = """\
Copy a recording of any format that kalux reads into one file. kalux HDF5 (.h5) holds events, frames with
their exposures, white and black value, contrast thresholds, image noise and reference images, unchanged. AEDAT 4
(.aedat4), for other programs, holds events and frames of 8 or 16 bits with their exposures, unchanged; what
it has no place for is said. Every event and frame is checked."""

_EXAMPLES = """\
examples:
  kalux convert night_drive.aedat4 night_drive.h5
  kalux convert night_drive.bag night_drive.aedat4
  kalux convert slider_depth slider.h5 --exposure 10000 --stamp start"""

_AEDAT4 = (".aedat4",)
_THRESHOLDS = ("threshold_on", "threshold_off")


def add_command(commands: Any) -> None:
    """Add ``convert`` to the parser."""
    parser: Parser = commands.add_parser(
        "convert",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux convert REC OUT.h5|OUT.aedat4 [flags]",
    )
    add_recording(parser)
    group = parser.add_argument_group("output")
    group.add_argument("out", metavar="OUT", type=Path, help="kalux HDF5 (.h5) or AEDAT 4 (.aedat4)")
    group.add_argument("--overwrite", action="store_true", help="replace the file if it is there")
    group.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    group = parser.add_argument_group("what OUT.h5 states in place of REC: thresholds, response, black level")
    add_black_level(group, otherwise="as REC")
    add_calibration(group)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.calibration.values import load_calibration, require_white
    from kalux.cli.output import check_apart, check_file
    from kalux.cli.progress import Progress, short_number

    check_name(options.out, Path(options.recording), (*HDF5, *_AEDAT4))
    check_apart([options.out], [options.recording, options.frames])
    check_file(options.out, overwrite=options.overwrite)
    stated = _calibrated(options)
    recording = open_recording(options)
    if options.calibration:
        require_white(load_calibration(*options.calibration), recording)
    if not recording.exposure_known:
        warn(
            "the recording has no exposure times, and the copy will not have them either; "
            "--exposure and --stamp would put them in"
        )
    if not recording.source.sensor_size_known:
        height, width = recording.sensor_size
        warn(
            f"the recording does not say how large the sensor is; the copy says {width}x{height}, which holds all "
            "events"
        )
    to_aedat4 = options.out.suffix.lower() in _AEDAT4
    if to_aedat4 and (lost := _not_in_aedat4(recording)):
        warn(f"AEDAT 4 has no place for {', '.join(lost)}: not in the copy, kalux HDF5 (.h5) would keep all")
    with Progress("converting", quiet=options.quiet) as progress:
        if to_aedat4:
            doubt = _write_aedat4(recording, options.out, progress)
        else:
            doubt = write_copy(recording, options.out, progress, stated)
    if doubt is not None:
        warn(doubt)
    if not options.quiet:
        seconds = max(progress.seconds, 1e-3)
        say(
            f"wrote {how_many(progress.events, 'event')} and {how_many(progress.images, 'frame')} to {options.out} "
            f"in {seconds:.1f} s ({short_number(progress.events / seconds)} events/s)"
        )


def _calibrated(options: argparse.Namespace) -> Stated:
    """What of the calibrations that are given a kalux HDF5 file can say; a warning names the rest.

    Raises
    ------
    UsageError
        If there is nothing of it, or the output is AEDAT 4.
    """
    from kalux.settings import AUTO, preset

    said = camera_calibration(options.black_level)
    calibration = given_calibration(options)
    if calibration is None and not said.settings["camera"]:
        return Stated()
    if options.out.suffix.lower() in _AEDAT4:
        raise UsageError(
            "--calibration, --black-level: AEDAT 4 has no place for what was measured; write kalux HDF5 (.h5), or give "
            "it to reconstruct"
        )
    calibration = said if calibration is None else calibration.merged(said)
    settings = calibration.apply(preset("default"))
    on, off = settings.events.threshold_on, settings.events.threshold_off
    response = settings.camera.response
    found = Stated(
        None if on is None or off is None else (float(on), float(off)),
        None if response == AUTO else response,
        settings.camera.black_level,
    )
    if found == Stated():
        raise UsageError(
            "--calibration: has neither contrast thresholds nor a response nor a black level, and a recording can "
            "state nothing else; give it to reconstruct, evaluate or info"
        )
    others = [f"{group}.{name}" for group, values in calibration.settings.items() for name in values]
    kept = [*(f"events.{name}" for name in _THRESHOLDS), "camera.response", "camera.black_level"]
    left = [*(name for name in others if name not in kept), *(f"map {name}" for name in calibration.maps)]
    if left:
        warn(
            f"of the calibration, the copy cannot state {', '.join(left)}; go on giving it to --calibration for these"
        )
    return found


def _not_in_aedat4(recording: Recording) -> list[str]:
    """What the recording holds that the other format cannot."""
    source = recording.source
    first = next(iter(recording.stored_frames()), None)
    usual = None if first is None else dataclasses.replace(first, white=None).white_value
    white = None if first is None or first.white_value == usual else first.white_value
    black = None if first is None or first.black == 0 else first.black
    found = [
        ("contrast thresholds", recording.contrast_threshold),
        ("image noise", source.inverse_covariance),
        ("reference images", source.ground_truth),
        (f"the response {recording.response}", recording.response),
        (f"the white value {white:g}" if white is not None else "", white),
        (f"the black value {black:g}" if black is not None else "", black),
        (f"the Bayer pattern (--bayer {recording.mosaic} opens the copy with it)", recording.mosaic),
    ]
    return [name for name, value in found if value is not None]


def _write_aedat4(recording: Recording, out: Path, progress: Any) -> str | None:
    from kalux.writers import aedat4

    write = partial(
        aedat4.write, out, sensor_size=recording.sensor_size, exposure_known=recording.exposure_known
    )
    return write_streams(write, recording.events(), recording.stored_frames(), progress)
