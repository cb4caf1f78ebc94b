"""``kalux ahdr``: a recording whose frames an artificial camera clipped, with the originals as truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kalux.cli.parser import Parser, UsageError, number, whole
from kalux.cli.recordings import add_recording, open_recording
from kalux.cli.terminal import say, warn
from kalux.errors import InputError
from kalux.wording import how_many

if TYPE_CHECKING:
    from kalux.recording import Recording

_DESCRIPTION = """\
Make an artificial HDR recording of a real one, as the paper's AHDR data: an artificial camera response makes
the dark and the bright ends of all frames black and white, and the original frames are the ground truth.
kalux evaluate compares with it; the response is written into the file, and used."""

_EXAMPLES = """\
examples:
  kalux ahdr slider_depth -o slider_ahdr.h5 --exposure 10000 --cut 80
  kalux evaluate slider_ahdr.h5"""


def add_command(commands: Any) -> None:
    """Add ``ahdr`` to the parser."""
    parser: Parser = commands.add_parser(
        "ahdr", description=_DESCRIPTION, epilog=_EXAMPLES, usage="kalux ahdr REC -o OUT.h5 [flags]"
    )
    add_recording(parser)
    group = parser.add_argument_group("artificial camera")
    group.add_argument(
        "--cut",
        type=number,
        metavar="LEVEL",
        help="of 255, that both ends lose; published: 30, 50, 80, 100, 115 (default 80)",
    )
    group.add_argument("--cut-low", type=number, metavar="LEVEL", help="of 255: up to it, black")
    group.add_argument("--cut-high", type=number, metavar="LEVEL", help="of 255: from it on, white")
    group = parser.add_argument_group("original frames")
    group.add_argument(
        "--response", default="auto", metavar="NAME", help="of the real camera: linear, srgb, gamma:EXPONENT"
    )
    group.add_argument(
        "--black", type=number, default=0.0, metavar="LEVEL", help="of 255: their black (default 0)"
    )
    group.add_argument(
        "--saturation",
        type=number,
        metavar="LEVEL",
        help="of 255: from it on they are saturated, and no truth (default 249.9); see docs/datasets.md",
    )
    group.add_argument(
        "--hold-out-frames",
        type=whole,
        metavar="N",
        help="leave out every N-th frame; these alone are the truth",
    )
    group = parser.add_argument_group("output")
    group.add_argument("-o", "--out", type=Path, required=True, metavar="OUT.h5", help="kalux HDF5")
    group.add_argument("--overwrite", action="store_true", help="replace the file if it is there")
    group.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    import numpy as np

    from kalux.cli.output import check_apart, check_file
    from kalux.cli.progress import Progress
    from kalux.cli.recordings import check_name, write_copy
    from kalux.datasets.ahdr import artificial_hdr
    from kalux.settings import CameraSettings

    check_name(options.out, Path(options.recording))
    check_apart([options.out], [options.recording, options.frames])
    check_file(options.out, overwrite=options.overwrite)
    camera = _camera(options)
    original = open_recording(options)
    recording = artificial_hdr(
        original,
        camera,
        response=options.response,
        black=options.black / 255,
        saturation=CameraSettings.usual_saturation
        if options.saturation is None
        else options.saturation / 255,
        every=options.hold_out_frames,
    )
    white, black, pixels = 0, 0, 0
    with Progress("counting", images=len(recording.frames()), quiet=options.quiet, unit="frames") as progress:
        for frame in recording.frames():
            white += int(np.count_nonzero(frame.image == 255))
            black += int(np.count_nonzero(frame.image == 0))
            pixels += frame.image.size
            progress.add(images=1)
    if black == pixels:
        raise InputError(
            f"{options.recording}: every pixel of every frame would be black; give a smaller --black or --cut"
        )
    with Progress("writing", quiet=options.quiet) as progress:
        write_copy(recording, options.out, progress)
    if white == 0:
        warn("no pixel of any frame is white: nothing is left to reconstruct beyond it; try a larger cut")
    if options.saturation is None:
        _warn_of_saturation(original, options.response)
    if not options.quiet:
        truth = recording.ground_truth()
        assert truth is not None
        known = truth.images if truth.masks is None else truth.images[truth.masks]
        share = 100 * known.size / truth.images.size
        say(
            f"black up to {255 * camera.low:g} and white from {255 * camera.high:g} of 255: "
            f"{100 * white / pixels:.1f} % of pixels white, {100 * black / pixels:.1f} % black; "
            f"truth up to {known.max(initial=0.0):.2f} x white, of {share:.1f} % of pixels"
        )
        say(f"wrote {how_many(progress.images, 'frame')}, {len(truth.times):,} of truth, to {options.out}")


def _warn_of_saturation(original: Recording, response: str) -> None:
    """Where the original frames end below white while events go on: what these tell would count as an error."""
    from kalux.calibration.levels import find_ceiling
    from kalux.plan_report import ceiling_text
    from kalux.planning import plan
    from kalux.settings import PRESETS, altered

    made = plan(original, at="frames", settings=altered(PRESETS["default"], "camera", response=response))
    settings = made.settings
    found = made.mends.ceiling or find_ceiling(original, settings.camera, settings.events)
    if found is not None and found.level < settings.camera.usual_saturation:
        warn(
            f"the original {ceiling_text(found)}: from there on they are no truth; "
            f"--saturation {int(255 * found.saturation)} leaves that out"
        )


def _camera(options: argparse.Namespace) -> Any:
    from kalux.datasets.ahdr import ArtificialCamera

    if options.cut_low is None and options.cut_high is None:
        return ArtificialCamera.with_cut(80 if options.cut is None else options.cut)
    if options.cut is not None:
        raise UsageError("--cut is for both ends; give it, or --cut-low and --cut-high")
    low = 0.0 if options.cut_low is None else options.cut_low
    high = 255.0 if options.cut_high is None else options.cut_high
    return ArtificialCamera(low / 255, high / 255)
