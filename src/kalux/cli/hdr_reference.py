"""``kalux hdr-reference``: radiance from bracketed exposures, and ground truth from it for a recording."""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from kalux.cli.calibrations import add_black_level
from kalux.cli.parser import Parser, UsageError, number, whole
from kalux.cli.recordings import check_stamp
from kalux.cli.terminal import say, warn
from kalux.settings import AUTO

if TYPE_CHECKING:
    from kalux.datasets.radiance import HdrReference
    from kalux.datasets.registration import RegisteredTruth

_DESCRIPTION = """\
Join photographs of one scene at several exposure times to one image of its radiance: aligned, with the
camera's response recovered, things that moved left out, and a mask of what was measured. With --register,
register it to every frame of a recording, as ground truth for kalux evaluate.

PHOTOS is a folder of photographs (exposure times from EXIF, which needs kalux[hdr], or from --times), or a
radiance image (.exr, .hdr, .npz) that is there already."""

_EXAMPLES = """\
examples:
  kalux hdr-reference brackets/ -o scene.exr
  kalux hdr-reference brackets/ -o scene.exr --times 2,1/2,1/8,1/32 --align none
  kalux hdr-reference scene.exr --register night_drive.aedat4 -o night_drive_gt.npz"""

_RADIANCE: Final = (".exr", ".npz")
_RADIANCE_INPUT: Final = (".exr", ".hdr", ".npz")


def add_command(commands: Any) -> None:
    """Add ``hdr-reference`` to the parser."""
    parser: Parser = commands.add_parser(
        "hdr-reference",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux hdr-reference PHOTOS -o OUT [--register REC] [flags]",
    )
    group = parser.add_argument_group("photographs")
    group.add_argument("photos", metavar="PHOTOS", type=Path, help="folder, or radiance image")
    group.add_argument(
        "--times",
        metavar="TIMES",
        help="seconds, with commas, for the images by name; or a CSV with columns file, exposure_s (default: EXIF)",
    )
    group.add_argument(
        "--response",
        metavar="NAME",
        default="debevec",
        help="debevec (default), robertson or auto recover it, as kalux calibrate response --method; linear, srgb, "
        "gamma:EXPONENT, curve:... state it",
    )
    group.add_argument(
        "--align", choices=("homography", "none"), default="homography", help="none: a tripod that held"
    )
    group.add_argument("--keep-moving", action="store_true", help="do not leave out what moved")
    group = parser.add_argument_group("registered to a recording")
    group.add_argument("--register", metavar="REC", help="file or folder, of any format that kalux reads")
    group.add_argument("--exposure", type=whole, metavar="US", help="exposure time of all its frames, us")
    group.add_argument("--stamp", choices=("start", "middle", "end"), help="what its frames' stamps mark")
    group.add_argument(
        "--frame-response",
        default=AUTO,
        metavar="NAME",
        help="of its frames: linear, srgb, gamma:EXPONENT (what it states, else linear)",
    )
    add_black_level(group)
    group.add_argument(
        "--blur",
        type=number,
        default=0.0,
        metavar="PIXELS",
        help="by which its lens is less sharp (std. deviation)",
    )
    group = parser.add_argument_group("output")
    group.add_argument(
        "-o",
        "--out",
        type=Path,
        required=True,
        metavar="OUT",
        help="radiance, .exr or .npz; with --register the truth, .npz",
    )
    group.add_argument(
        "--plot", type=Path, metavar="PNG", help="the response (default: OUT_response.png for photographs)"
    )
    group.add_argument("--overwrite", action="store_true", help="replace files that are there")
    group.add_argument("--quiet", action="store_true", help="no progress")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.cli.output import check_apart, check_file, check_picture, write_picture
    from kalux.datasets.hdr_plot import response_plot
    from kalux.datasets.radiance import encode_radiance
    from kalux.writers.files import save

    _check_flags(options)
    is_image = options.photos.suffix.lower() in _RADIANCE_INPUT
    plot = None if is_image else options.plot or options.out.with_name(f"{options.out.stem}_response.png")
    check_apart([options.out, plot], [options.photos, options.register, options.times])
    check_file(options.out, overwrite=options.overwrite)
    check_picture(plot, overwrite=options.overwrite)
    reference = _reference(options, is_image)
    for line in reference.said:
        say(line)
    say(f"{100 * reference.valid.mean():.2f} % of {_by(reference)} pixels measured; {_range(reference)}")
    if options.register is None:
        data = encode_radiance(reference, options.out.suffix.lower())
    else:
        data = _truth(options, reference)
    save(options.out, data)
    say(f"wrote {options.out}")
    if plot is not None and reference.response is not None:
        write_picture(plot, response_plot(reference.pictures, reference.response)[..., ::-1])
        say(f"wrote {plot}")


def _check_flags(options: argparse.Namespace) -> None:
    suffix = options.out.suffix.lower()
    if options.register is not None and suffix != ".npz":
        raise UsageError(f"{options.out}: ground truth is an .npz file; give a name that ends in .npz")
    if options.register is None and suffix not in _RADIANCE:
        raise UsageError(f"{options.out}: a radiance image is written as .exr or .npz; give such a name")
    if options.register is None:
        given = {"exposure": None, "stamp": None, "frame_response": AUTO, "black_level": None, "blur": 0.0}
        for name, default in given.items():
            if getattr(options, name) != default:
                raise UsageError(f"--{name.replace('_', '-')} is for a recording; give --register REC, too")
    if options.photos.suffix.lower() in _RADIANCE_INPUT:
        if options.register is None:
            raise UsageError(
                f"{options.photos}: is a radiance image already; give --register REC, or a folder"
            )
        joins = options.times or options.plot or options.keep_moving
        if joins or options.align != "homography" or options.response != "debevec":
            raise UsageError(
                f"{options.photos}: --times, --plot, --response, --align and --keep-moving are for a folder of "
                "photographs"
            )
    if not options.blur >= 0:
        raise UsageError(f"--blur {options.blur}: 0 or more pixels are possible")


def _reference(options: argparse.Namespace, is_image: bool) -> HdrReference:
    from kalux.datasets.brackets import read_bracket
    from kalux.datasets.hdr import hdr_reference
    from kalux.datasets.radiance import read_radiance
    from kalux.models.camera import Response

    if is_image:
        return read_radiance(options.photos)
    recovered = options.response in ("auto", "debevec", "robertson")
    response = options.response if recovered else Response.named(options.response)
    pictures = read_bracket(options.photos, _times(options.times))
    return hdr_reference(
        pictures, response=response, aligned=options.align != "none", ghosts=not options.keep_moving
    )


def _times(text: str | None) -> Path | list[float] | None:
    from kalux.cli.times import exposure_times

    if text is None:
        return None
    if Path(text).suffix.lower() == ".csv":
        return Path(text)
    return exposure_times(text)


def _by(reference: HdrReference) -> str:
    height, width = reference.valid.shape
    return f"{width} x {height}"


def _range(reference: HdrReference) -> str:
    import numpy as np

    lit = reference.luminance[reference.valid & (reference.luminance > 0)]
    if len(lit) == 0:
        return "nothing is lit"
    low, high = np.percentile(lit, (0.1, 99.9))
    return f"radiance over {np.log10(high / low) * 20:.0f} dB (0.1 to 99.9 % of pixels)"


def _truth(options: argparse.Namespace, reference: HdrReference) -> bytes:
    import numpy as np

    import kalux
    from kalux.cli.progress import Progress
    from kalux.datasets.registration import register_frames
    from kalux.evaluation.exposures import compared_recording, of_black

    check_stamp(options)
    recording = kalux.open(options.register, exposure=options.exposure, stamp=options.stamp or "start")
    recording = compared_recording(recording, options.frame_response, options.black_level)
    with Progress("registering", images=len(recording.frames()), quiet=options.quiet) as progress:
        found = register_frames(
            reference.luminance,
            reference.valid,
            recording,
            response=options.frame_response,
            blur=options.blur,
            on_frame=lambda: progress.add(images=1),
        )
    for line in _left_out(found):
        warn(line)
    placed = [frame for frame in found.frames if not frame.failure]
    say(
        f"{len(placed)} of {len(found.frames)} frames registered, {100 * found.masks.mean():.1f} % of their pixels "
        f"valid; frame and reference differ by {100 * np.median([f.deviation for f in placed]):.1f} % (median of "
        f"robust standard deviations), in scale by {100 * np.std([f.scale for f in placed]) / found.scale:.1f} %"
        f"{of_black(recording)}"
    )
    file = io.BytesIO()
    np.savez_compressed(
        file,
        times_us=found.truth.times,
        gt=found.truth.images,
        mask=found.masks,
        homography=np.stack([f.matrix for f in placed if f.matrix is not None]),
    )
    return file.getvalue()


def _left_out(found: RegisteredTruth) -> list[str]:
    return [f"frame {f.number} ({f.time} us) is left out: {f.failure}" for f in found.frames if f.failure]
