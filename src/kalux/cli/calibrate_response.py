"""``kalux calibrate response``: the camera's response from images at several exposure times."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kalux.cli.calibrations import add_result, check_result, finish
from kalux.cli.parser import Parser, UsageError
from kalux.cli.terminal import say

if TYPE_CHECKING:
    from kalux.calibration.response import ResponseCalibration
    from kalux.recording import Recording
    from kalux.white import CheckedWhite

_DESCRIPTION = """\
Measure the camera's response function: from images of one still scene at three or more exposure times (from their EXIF,
or --times), or from one recording under auto-exposure whose still pixels are seen at several exposures. By Debevec's
method, or by Robertson's where that predicts the images clearly better from one another."""

_EXAMPLES = """\
examples:
  kalux calibrate response room_*.jpg -o response.toml --plot response.png
  kalux calibrate response a.png b.png c.png --times 0.001,0.004,0.016 -o response.toml
  kalux calibrate response auto_exposure.aedat4 -o response.toml"""


def add_command(commands: Any) -> None:
    """Add ``response`` to the group."""
    parser: Parser = commands.add_parser(
        "response",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux calibrate response IMAGE IMAGE IMAGE ... | REC -o FILE.toml",
    )
    group = parser.add_argument_group("what to look at")
    group.add_argument("inputs", nargs="+", metavar="IMAGE|REC", help="images, or one recording")
    group.add_argument(
        "--times", metavar="S,S,..", help="exposure times of the images, s, in their order, as 2,0.5,1/8"
    )
    group.add_argument(
        "--per-channel", action="store_true", help="a curve for each colour (default: one for all)"
    )
    group.add_argument(
        "--method",
        choices=("auto", "debevec", "robertson"),
        default="auto",
        help="debevec is what kalux hdr-reference takes (default auto)",
    )
    add_result(parser)
    parser.add_argument_group("picture").add_argument(
        "--plot", type=Path, metavar="FILE.png", help="picture of the curves; needs kalux[plots]"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.calibration.response import calibrate_response

    check_result(options, options.inputs)
    if options.plot is not None:
        from kalux.calibration.figures import require_matplotlib
        from kalux.cli.output import check_apart, check_picture

        check_apart([options.plot], options.inputs)
        require_matplotlib()
        check_picture(options.plot, overwrite=options.overwrite)
    images, times, recording = _inputs(options)
    found = calibrate_response(images, times, per_channel=options.per_channel, method=options.method)
    finish(found.calibration(), recording, _white(recording), options, command)
    if not options.quiet:
        say("\n".join(report(found)))
    if options.plot is not None:
        from kalux.calibration.figures import response_figure
        from kalux.writers.files import save

        save(options.plot, response_figure(found.curves))


def report(found: ResponseCalibration) -> list[str]:
    """How well each image is predicted, and by which method."""
    lines = [f"{'exposure s':>12}  residual, % of full scale (left out of the merged radiance)"]
    for time, inside, out in zip(found.exposures, found.residuals, found.left_out, strict=True):
        pairs = ", ".join(f"{100 * a:.2f} ({100 * b:.2f})" for a, b in zip(inside, out, strict=True))
        lines.append(f"{time:12.6g}  {pairs}")
    return lines


def _inputs(options: argparse.Namespace) -> tuple[Any, list[float], Recording | None]:
    from kalux.calibration.photographs import read_exposure, read_photograph
    from kalux.calibration.still_pixels import still_pixels
    from kalux.cli.times import exposure_times
    from kalux.readers.images import IMAGES, images_in

    paths = [Path(name) for name in options.inputs]
    if len(paths) == 1 and paths[0].suffix.lower() not in IMAGES:
        images = images_in(paths[0]) if paths[0].is_dir() else []
        recording = _recording(paths[0], options, may_be_none=bool(images))
        if recording is not None:
            return *still_pixels(recording), recording
        paths = images
    if options.times is None:
        stated = [read_exposure(path) for path in paths]
        # Seconds at the sensitivity and aperture of the first, where these differ.
        times = [one.seconds * one.gain / stated[0].gain for one in stated]
    else:
        times = exposure_times(options.times)
    return [read_photograph(path) for path in paths], times, None


def _white(recording: Recording | None) -> CheckedWhite | None:
    """That of all frames, of which the measurement has seen the first only; None of photographs."""
    from kalux.white import WhiteCheck

    check = WhiteCheck()
    for frame in () if recording is None else recording.frames():
        check.see(frame)
    return check.found()


def _recording(path: Path, options: argparse.Namespace, *, may_be_none: bool) -> Recording | None:
    """The recording that is to be measured; None, where there ``may_be_none``: a folder of photographs."""
    import kalux
    from kalux.errors import FormatError

    try:
        recording = kalux.open(path)
    except FormatError:
        if may_be_none:
            return None
        raise
    if options.times is not None:
        raise UsageError("--times is for images; a recording has exposure times")
    return recording
