"""``kalux evaluate``: how good reconstructions of a recording are, by several methods."""

from __future__ import annotations

import argparse
import csv
import dataclasses
import io
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from kalux.cli.calibrations import (
    add_black_level,
    add_calibration,
    camera_calibration,
    given_calibration,
)
from kalux.cli.checking import check_recording
from kalux.cli.loops import prepare_loops, tell_of_compiling
from kalux.cli.metrics import add_metrics, lpips_files, lpips_weights, named_methods
from kalux.cli.parser import Parser, UsageError, whole
from kalux.cli.recordings import add_recording, open_recording
from kalux.cli.terminal import say, warn
from kalux.settings import AUTO
from kalux.wording import how_many

if TYPE_CHECKING:
    from kalux.evaluation.consistency import BlurConsistency
    from kalux.evaluation.method import Method
    from kalux.evaluation.scores import Scores
    from kalux.recording import Recording

_DESCRIPTION = """\
Compare what methods reconstruct from a recording with its ground truth or, where it has none, with frames
that were held out from them. Needs the extra kalux[evaluation].

methods: hold (the last frame), mean (of the frames around; for images between frames only), edi (nearest frame,
deblurred and moved by events), cf, iccv2021, iccv2021-flir, default, smooth (default, both ways in time),
davis240c, davis346, prophesee-flir. Without --methods all but iccv2021-flir and the last three, which are for
one camera each. Networks, with their weights (need the extra kalux[learned]):
e2vid:FILE, e2vid+:FILE, firenet:FILE, firenet+:FILE, hypere2vid:FILE. Any other method: NAME=FOLDER of images
with a timestamps.csv."""

_EXAMPLES = """\
examples:
  kalux evaluate night_drive.aedat4
  kalux evaluate pan.mat --truth pan_gt.npz --hdrvdp -o scores.csv
  kalux evaluate slider_depth --exposure 10000 --hold-out-frames 4 --methods hold,cf,default
  kalux evaluate night_drive.aedat4 --methods default,firenet:firenet.pth,mine=results/night"""

_SUFFIXES: Final = (".csv", ".json")
_OWN: Final = Path()  # --truth without a file


def add_command(commands: Any) -> None:
    """Add ``evaluate`` to the parser."""
    parser: Parser = commands.add_parser(
        "evaluate", description=_DESCRIPTION, epilog=_EXAMPLES, usage="kalux evaluate REC [flags]"
    )
    add_recording(parser)
    group = parser.add_argument_group(
        "compared with (default: its truth if it has any, else every 2nd frame)"
    )
    one = group.add_mutually_exclusive_group()
    one.add_argument("--hold-out-frames", type=whole, metavar="N", help="every N-th frame, held out")
    one.add_argument(
        "--truth",
        type=Path,
        nargs="?",
        const=_OWN,
        metavar="FILE",
        help="the recording's ground truth, or that of an .npz with times (us) and images, maybe mask",
    )
    group.add_argument("--clip", action="store_true", help="held-out: clip images where the camera clips")
    group.add_argument(
        "--response",
        default=AUTO,
        help="of the camera: linear, srgb, gamma:EXPONENT (default: what the recording states, else linear)",
    )
    add_black_level(group)
    add_calibration(group)
    group = parser.add_argument_group("what is computed")
    add_metrics(group)
    group.add_argument(
        "--blur-consistency", action="store_true", help="do images, integrated, give the frames? PSNR"
    )
    group = parser.add_argument_group("output")
    group.add_argument(
        "-o", "--out", type=Path, metavar="OUT", help=".csv: the table; .json: that and every image's scores"
    )
    group.add_argument("--overwrite", action="store_true", help="replace the file if it is there")
    group.add_argument("--quiet", action="store_true", help="no progress")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.cli.output import check_apart, check_file
    from kalux.cli.progress import Progress
    from kalux.evaluation.scores import require_dependencies
    from kalux.evaluation.specs import spec_path

    if options.out is not None:
        if options.out.suffix.lower() not in _SUFFIXES:
            raise UsageError(f"{options.out}: the output is a table; give a name that ends in .csv or .json")
        truth = None if options.truth == _OWN else options.truth
        methods = [spec_path(name) for name in named_methods(options) or ()]
        check_apart(
            [options.out], [options.recording, options.frames, truth, *methods, *lpips_files(options)]
        )
        check_file(options.out, overwrite=options.overwrite)
    if options.clip and options.truth is not None:
        raise UsageError("--clip is for held-out frames, which clip; ground truth does not")
    require_dependencies()
    prepare_loops()
    tell_of_compiling(quiet=options.quiet)
    recording = open_recording(options)
    with Progress("checking", quiet=options.quiet) as progress:
        contents = check_recording(recording, lambda count: progress.add(events=count))
    for text in contents.warnings():
        warn(text)
    protocol = Protocol(recording, options, contents.colours)
    if contents.frames > 1 and contents.events_between and (doubt := protocol.doubt()) is not None:
        warn(doubt)
    say(f"{recording.source.path}: {protocol.described}")
    say(table_head(options))
    found, consistent = [], []
    for method in protocol.methods:
        scores = protocol.score(method)
        consistency = protocol.consistency(method) if options.blur_consistency else None
        say(table_row(scores, consistency))
        found.append(scores)
        consistent.append(consistency)
    for line in notes(found):
        say(line)
    if options.out is not None:
        write(options.out, recording, protocol.described, found, consistent)
        say(f"wrote {options.out}")


class Protocol:
    """What the flags say to compare with what.

    Parameters
    ----------
    recording
        Checked.
    options
        The flags.
    colours
        As of `kalux.Frame`.

    Raises
    ------
    InputError
        There is no truth, too few frames, no such method.
    """

    def __init__(self, recording: Recording, options: argparse.Namespace, colours: str) -> None:
        from kalux.evaluation import baselines, held_out, specs, truth
        from kalux.evaluation.exposures import compared_recording, of_black

        self._options = options
        self._score: Callable[[Method, Callable[[], None]], Scores]
        said = camera_calibration(options.black_level, options.response)
        calibration = given_calibration(options)
        if calibration is not None:
            calibration = calibration.merged(said)
        camera = (said if calibration is None else calibration).settings.get("camera", {})
        self._response: str = camera.get("response", AUTO)
        recording = compared_recording(recording, self._response, camera.get("black_level"))
        self._recording = recording
        weights = lpips_weights(options)
        reference, between = None, True
        if options.hold_out_frames is None:
            reference, origin = _reference(recording, options)
        if reference is None:
            every = 2 if options.hold_out_frames is None else options.hold_out_frames
            held = held_out.hold_out_frames(recording, every, response=self._response)
            self._given, self._times = held.kept, held.times.ravel()
            self.described, self._images = held.described(), len(held.compared)
            self._score = lambda method, count: held_out.evaluate_held_out(
                held, method, clip=options.clip, hdr_vdp=options.hdrvdp, lpips=weights, on_image=count
            )
        else:
            self._given, self._times = recording, reference.times
            self.described = reference.described(origin) + of_black(recording)
            self._images = len(reference.times)
            between = truth.lies_between_frames(recording, reference.times)
            self._score = lambda method, count: truth.evaluate_truth(
                recording, reference, method, hdr_vdp=options.hdrvdp, lpips=weights, on_image=count
            )
        self.described += _of_colours(colours)
        self._planner = baselines.Planner(calibration)
        choose = partial(
            specs.chosen_methods,
            response=self._response,
            held_out=between,
            calibration=calibration,
            planner=self._planner,
        )
        self.methods, (self._default,) = choose(named_methods(options)), choose(["default"])

    def doubt(self) -> str | None:
        """That events do not explain the frames, as a reconstruction would warn; None where they do.

        The plan that tells it is that of the method ``default``, which makes no other.
        """
        from kalux.cli.plan_warnings import unrelated_warning
        from kalux.cli.progress import Stages

        stages = Stages(quiet=self._options.quiet)
        assert self._default.settings is not None
        with stages.stage("estimating"):
            planned = self._planner.plan(
                self._given, self._times, self._default.settings, watched=stages.watched(self._given)
            )
        return unrelated_warning(planned)

    def score(self, method: Method) -> Scores:
        """Score one method, with progress."""
        from kalux.cli.progress import Progress

        with Progress(method.label, images=self._images, quiet=self._options.quiet) as progress:
            return self._score(method, lambda: progress.add(images=1))

    def consistency(self, method: Method) -> BlurConsistency | None:
        """Blur consistency of one method, with progress; None for those that look at the very frame."""
        from kalux.cli.progress import Progress
        from kalux.evaluation.consistency import blur_consistency

        if method.needs_held_out:
            return None
        title = f"{method.label}, blur consistency"
        count = len(self._recording.frames()) - 2
        with Progress(title, images=max(count, 0), quiet=self._options.quiet) as progress:
            return blur_consistency(
                self._recording,
                method,
                response=self._response,
                on_image=lambda: progress.add(images=1),
            )


def _reference(recording: Recording, options: argparse.Namespace) -> tuple[Any, str]:
    """The ground truth that is asked for, or there, and where it was found; None: none."""
    from kalux.evaluation.truth import find_truth, prepare_reference, truth_file

    path = recording.source.path
    file = truth_file(path, None if options.truth in (None, _OWN) else options.truth)
    images, mask = find_truth(recording, file)
    if images is None:
        if options.truth == _OWN:
            raise UsageError(f"{path}: has no ground truth; give --truth FILE.npz, or --hold-out-frames 2")
        return None, ""
    if options.clip:
        raise UsageError("--clip is for held-out frames, the recording has ground truth; --hold-out-frames 2")
    return prepare_reference(recording, images, mask), "" if file is None else f" of {file}"


def _of_colours(colours: str) -> str:
    """What of a recording in colour is compared, as the end of a sentence."""
    if colours == "grey":
        return ""
    return "; of RGB the luminance" if colours == "RGB" else "; of every pixel of the mosaic its own colour"


# Say.

_COLUMNS: Final[tuple[tuple[str, Callable[[Scores], str]], ...]] = (
    ("MSE x100", lambda s: f"{100 * s.mse:.3f}"),
    ("PSNR dB", lambda s: f"{s.psnr:.2f}"),
    ("SSIM", lambda s: "" if s.ssim is None else f"{s.ssim:.3f}"),
    ("log-MSE x100", lambda s: f"{100 * s.log_mse:.2f}"),
    ("rms z", lambda s: "" if (z := s.uncertainty()["rms_z"]) is None else f"{z:.2f}"),
)


def table_head(options: argparse.Namespace) -> str:
    """The names of the columns."""
    head = f"{'method':<26}" + "".join(f"{name:>14}" for name, _ in _COLUMNS)
    head += f"{'HDR-VDP Q':>14}" if options.hdrvdp else ""
    head += f"{'LPIPS':>14}" if options.lpips else ""
    return head + (f"{'blur dB':>14}" if options.blur_consistency else "")


def table_row(scores: Scores, consistency: BlurConsistency | None) -> str:
    """The means of a method."""
    row = f"{scores.method:<26}" + "".join(f"{shown(scores):>14}" for _, shown in _COLUMNS)
    row += "" if scores.q is None else f"{scores.q:>14.3f}"
    row += "" if scores.lpips is None else f"{scores.lpips:>14.3f}"
    return row + ("" if consistency is None else f"{consistency.psnr:>14.2f}")


_BETTER: Final = (
    "better: less MSE and log-MSE, more PSNR and SSIM, rms z (error over stated uncertainty) near 1"
)


def notes(found: list[Scores]) -> list[str]:
    """How many pixels, and what was done to images before they were compared."""
    first = found[0]
    everywhere = [text for text in first.adjustments() if all(text in s.adjustments() for s in found)]
    return [
        f"{how_many(len(first.images), 'image')}, {how_many(first.pixels, 'pixel')} compared; "
        f"data range {first.data_range:.4g}",
        _BETTER,
        *(f"all: {text}" for text in everywhere),
        *(f"{s.method}: {text}" for s in found for text in s.adjustments() if text not in everywhere),
    ]


# Write.


def write(
    out: Path,
    recording: Recording,
    protocol: str,
    found: list[Scores],
    consistent: list[BlurConsistency | None],
) -> None:
    """Write the scores; the file is whole or not there.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from kalux.writers.files import save

    as_text = as_csv if out.suffix.lower() == ".csv" else as_json
    save(out, as_text(str(recording.source.path), protocol, found, consistent))


def as_csv(path: str, protocol: str, found: list[Scores], consistent: list[BlurConsistency | None]) -> str:
    """A row of means per method."""
    text = io.StringIO()
    rows = [_row(path, protocol, *pair) for pair in zip(found, consistent, strict=True)]
    table = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return text.getvalue()


def as_json(path: str, protocol: str, found: list[Scores], consistent: list[BlurConsistency | None]) -> str:
    """The same, and the scores of every image; infinite values (PSNR of equal images) as null."""
    import kalux
    from kalux.evaluation.scores import finite_or_none

    rows = []
    for scores, consistency in zip(found, consistent, strict=True):
        row = _row(path, protocol, scores, consistency)
        row["adjustments"] = scores.adjustments()
        row["per_image"] = [dataclasses.asdict(image) for image in scores.images]
        rows.append(row)
    return json.dumps(finite_or_none({"kalux": kalux.__version__, "methods": rows}), indent=1) + "\n"


def _row(path: str, protocol: str, scores: Scores, consistency: BlurConsistency | None) -> dict[str, Any]:
    return {
        "recording": path,
        "protocol": protocol,
        "method": scores.method,
        "images": len(scores.images),
        "pixels": scores.pixels,
        **scores.means(),
        **scores.uncertainty(),
        "blur_psnr": None if consistency is None else consistency.psnr,
        "data_range": scores.data_range,
        "scale": scores.scale,
        "clipped": scores.clipped,
        "negative": scores.negative,
    }
