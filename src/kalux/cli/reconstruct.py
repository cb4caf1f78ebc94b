"""``kalux reconstruct``: images or a video from a recording."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib.metadata
import itertools
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import cv2
import numpy as np

from kalux import memory
from kalux.cli.calibrations import add_calibration, given_calibration
from kalux.cli.checking import Contents, check_beside
from kalux.cli.flags import HelpSettings, add_display, add_settings, given_settings
from kalux.cli.loops import OF_ALL, OF_IMAGES, compiling_beside, prepare_loops, tell_of_compiling
from kalux.cli.output import (
    DEFAULT_RATE,
    FOLDER_FORMATS,
    Output,
    check_apart,
    check_output,
    chosen_output,
    image_rate,
    lies_in,
)
from kalux.cli.parser import Parser, UsageError, number, whole
from kalux.cli.plan_warnings import plan_warnings, saturation_warning
from kalux.cli.progress import Progress, short_number
from kalux.cli.recordings import add_recording, open_recording
from kalux.cli.terminal import say, warn
from kalux.cli.times import load_times
from kalux.display import CURVES
from kalux.errors import InputError
from kalux.pipeline import execute
from kalux.plan_report import ORIGINS, plan_report
from kalux.planning import Plan, plan
from kalux.reconstructor import Reconstructor
from kalux.recording import Recording
from kalux.settings import PRESETS, Settings, from_dict, load, preset, read_toml, to_dict, without_effect
from kalux.threads import default_threads
from kalux.wording import how_many

if TYPE_CHECKING:
    from kalux.writers import Writer

T = TypeVar("T", dict[str, Any], list[Any])

_DESCRIPTION = """\
Reconstruct HDR images, at any rate, from a recording of events and frames. All frames and the first 4 million events
are checked before anything is written, later events as they are used."""

_EXAMPLES = """\
examples:
  kalux reconstruct drive.aedat4 -o drive.mp4
  kalux reconstruct slider_depth -o slider.mp4 --exposure 10000 --stamp start --slow-motion 4
  kalux reconstruct drive.aedat4 -o again.mp4 --settings drive/kalux.toml --camera.log-offset 0.05"""


def add_command(commands: Any) -> None:
    """Add ``reconstruct`` to the parser."""
    parser: Parser = commands.add_parser(
        "reconstruct",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux reconstruct REC -o OUT [flags]",
    )
    add_recording(parser)
    _add_images(parser)
    _add_output(parser)
    _add_settings(parser)
    _add_display(parser)
    parser.set_defaults(run=run)


def _add_images(parser: Parser) -> None:
    group = parser.add_argument_group("which images (one of --rate, --times and --at)")
    one = group.add_mutually_exclusive_group()
    one.add_argument(
        "--rate", type=number, metavar="HZ", help=f"images per second (default {DEFAULT_RATE:g})"
    )
    one.add_argument(
        "--times", type=Path, metavar="FILE", help="at the times in a file, us: a line each, or .npy"
    )
    one.add_argument("--at", choices=("frames",), help="one in the middle of each frame's exposure")
    group.add_argument(
        "--start", type=number, metavar="S", help="none before this time, s after the first frame begins"
    )
    group.add_argument("--end", type=number, metavar="S", help="none after this time, counted likewise")
    group.add_argument(
        "--causal", action="store_true", help="use the past only, as a robot must (default: one frame ahead)"
    )
    group.add_argument(
        "--smooth", action="store_true", help="use all of the future too: best quality, three times the work"
    )


def _add_output(parser: Parser) -> None:
    group = parser.add_argument_group("output")
    group.add_argument(
        "-o", "--out", type=Path, required=True, metavar="OUT", help="name.mp4 for a video, else a folder"
    )
    group.add_argument(
        "--format",
        choices=FOLDER_FORMATS,
        help="of a folder: png (default) for display; exr, npy linear, with variance",
    )
    group.add_argument("--grey", action="store_true", help="of a recording in colour, the luminance alone")
    group.add_argument("--overwrite", action="store_true", help="replace a former output of kalux")
    group.add_argument(
        "--threads", type=whole, metavar="N", help="processor cores to use, at least 1 (default all, up to 8)"
    )
    group.add_argument("--quiet", action="store_true", help="print warnings and errors only")


def _add_settings(parser: Parser) -> None:
    group = parser.add_argument_group("settings")
    group.add_argument("--preset", default="default", metavar="NAME", help="|".join(PRESETS))
    group.add_argument(
        "--settings", type=Path, metavar="FILE", help="TOML that changes the preset; an output's kalux.toml"
    )
    add_calibration(group)
    # Not a flag: a line of help for all of them.
    group.add_argument(
        "--GROUP.NAME",
        dest="_",
        metavar="VALUE",
        help="any setting, e.g. --camera.log-offset 0.05, --events.threshold-on 0.2, --filter.kind cf",
    )
    parser.add_help_flag("--help-settings", HelpSettings, "all settings, with units, defaults and reasons")
    add_settings(parser)


def _add_display(parser: Parser) -> None:
    group = parser.add_argument_group("display (png and mp4)")
    group.add_argument("--display", choices=tuple(CURVES), help="tone curve (default auto)")
    group.add_argument(
        "--display.PARAMETER",
        dest="_",
        metavar="VALUE",
        help="e.g. --display linear --display.white 4, --display.encoding srgb; see --help-settings",
    )
    group.add_argument("--png-bits", type=int, choices=(8, 16), help="bits of a png (default 16)")
    group.add_argument(
        "--crf", type=number, metavar="Q", help="quality of an mp4, 0 (best) to 51 (default 18)"
    )
    group.add_argument(
        "--slow-motion", type=number, metavar="X", help="play an mp4 X times slower (default 1)"
    )
    add_display(parser)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    if options._ is not None:
        raise UsageError("GROUP.NAME stands for the name of a setting; --help-settings lists them")
    if options.threads is not None and options.threads < 1:
        raise UsageError(f"--threads is {options.threads}; it must be 1 or more")
    output = chosen_output(options)
    settings = chosen_settings(options)
    _check_apart(output, Path(options.recording), options.frames)
    check_output(output)
    times = None if options.times is None else load_times(options.times)
    if times is not None and output.format == "mp4" and not np.diff(times).all():
        raise UsageError(
            f"{options.times}: a time comes twice; a video has one image of each, a folder may have more"
        )
    memory.share_arena()  # before there are threads
    prepare_loops()
    tell_of_compiling(quiet=options.quiet)
    threads = options.threads or default_threads()
    cv2.setNumThreads(1)  # its own threads would come on top of those
    with compiling_beside(_compiled_later(settings), threads):
        recording = open_recording(options)
        with Progress("checking", quiet=options.quiet) as progress:
            contents, planned = check_beside(
                recording,
                lambda count: progress.add(events=count),
                lambda: make_plan(recording, settings, times, options),
                threads,
            )
        for text in contents.warnings():
            warn(text)
        planned = part_of(planned, contents, options)
        told = plan_warnings(planned, contents, options.preset)
        saturated = saturation_warning(recording, planned, settings)
        for text in (
            *told,
            *filter(None, [saturated]),
            *_other_mode(planned, options),
            *_left_out_calibration(options),
            *_without_effect(settings, options),
        ):
            warn(text)
        if not options.quiet:
            say("\n".join(decided(recording, contents, planned, settings, output, options)))
        described = metadata(recording, planned, options, command)
        seconds, images = write_images(recording, planned, output, described, options, threads)
        if not options.quiet:
            say(
                f"wrote       {how_many(images, 'image')} to {output.path} in {seconds:.1f} s "
                f"({short_number(images / seconds)} images/s), settings in {output.settings_path}"
            )


def _compiled_later(settings: Settings) -> tuple[str, ...]:
    """Parts of `kalux.cli.rehearsal` that a reconstruction needs after the estimates."""
    return OF_ALL if settings.filter.joins_frames else OF_IMAGES


def _check_apart(output: Output, recording: Path, frames: Path | None) -> None:
    """Refuse to replace what is read, and to write into a folder that is the recording, or its frames."""
    for what, folder in (("recording", recording), ("frames", frames)):
        if folder is not None and folder.is_dir() and lies_in(output.path, folder):
            raise UsageError(
                f"{output.path}: lies in the {what} {folder}; choose another place for the output"
            )
    check_apart([output.path], [recording, frames])


# Decide.


def chosen_settings(options: argparse.Namespace) -> Settings:
    """The preset, changed by calibrations, changed by the file, changed by the flags."""
    settings = preset(options.preset)
    calibration = given_calibration(options)
    if calibration is not None:
        settings = calibration.apply(settings)
    if options.settings is not None:
        settings = load(options.settings, settings)
    settings = from_dict(given_settings(options), settings)
    Reconstructor((1, 1), settings=settings)  # refuses what only the engine can judge, before the work
    return settings


def make_plan(recording: Recording, settings: Settings, times: Any, options: argparse.Namespace) -> Plan:
    """The plan of the whole recording.

    Raises
    ------
    InputError
        As of `kalux.planning.plan`.
    """
    planned = plan(
        recording,
        rate_hz=image_rate(options),
        times=times,
        at=options.at,
        settings=settings,
        calibration=given_calibration(options),
        lookahead=not options.causal,
        smooth=options.smooth,
    )
    return dataclasses.replace(planned, threshold_origin=_origin(planned, options))


def part_of(planned: Plan, contents: Contents, options: argparse.Namespace) -> Plan:
    """The plan of the part that --start and --end leave.

    Raises
    ------
    UsageError
        No image lies in it.
    """
    for flag, value in (("--start", options.start), ("--end", options.end)):
        if value is not None and not np.isfinite(value):
            raise UsageError(f"{flag} is {value}; seconds are needed")
    first = -np.inf if options.start is None else contents.start + 1e6 * options.start
    last = np.inf if options.end is None else contents.start + 1e6 * options.end
    kept = planned.times[(planned.times >= first) & (planned.times <= last)]
    if len(planned.times) == 0:
        raise UsageError(
            "--at frames --causal: no exposure has its middle after the end of the first, where images begin"
        )
    if len(kept) == 0:
        raise UsageError(
            "no image lies in the part that --start and --end leave of the recording's "
            f"{contents.seconds:.3f} s"
        )
    return dataclasses.replace(planned, times=kept)


def _origin(planned: Plan, options: argparse.Namespace) -> Any:
    """Where the thresholds come from; of those in a former run's `kalux.toml`, the origin that it states."""
    flags = given_settings(options).get("events", {})
    if (
        planned.threshold_origin != "settings"
        or options.settings is None
        or {"threshold_on", "threshold_off"} & {*flags}
    ):
        return planned.threshold_origin
    origin = _former(options, "thresholds", dict[str, Any]).get("origin")
    return origin if origin in ORIGINS else planned.threshold_origin


def _former(options: argparse.Namespace, name: str, kind: type[T]) -> T:
    """A table or list of ``--settings``, if it is a former run's `kalux.toml`; else an empty one."""
    former, empty = read_toml(options.settings).get(name), kind()
    return former if isinstance(former, type(empty)) else empty


def _other_mode(planned: Plan, options: argparse.Namespace) -> list[str]:
    """A warning where ``--settings`` is the `kalux.toml` of a run in another mode, which flags alone choose."""
    if options.settings is None:
        return []
    former = _former(options, "images_wanted", dict[str, Any])
    if not {"lookahead", "smooth"} <= {*former}:
        return []
    mode = "--smooth" if former["smooth"] else "one frame ahead" if former["lookahead"] else "--causal"
    if (former["lookahead"], former["smooth"]) == (planned.lookahead, planned.smooth):
        return []
    return [f"{options.settings} is of a run {mode}; settings do not say so, and these images are others"]


def _left_out_calibration(options: argparse.Namespace) -> list[str]:
    """A warning where ``--settings`` is of a run with ``--calibration``: it lacks the maps of pixels."""
    if options.settings is None or options.calibration:
        return []
    former = _former(options, "calibration", list[Any])
    if not former:
        return []
    flags = " ".join(f"--calibration {shlex.quote(str(name))}" for name in former)
    return [
        f"{options.settings} is of a run with {flags}; settings have no maps of pixels, and without it these images "
        "may be others"
    ]


def _without_effect(settings: Settings, options: argparse.Namespace) -> list[str]:
    """Warnings of flags that the chosen filter has no use for."""
    given = given_settings(options)
    keys = (f"{group}.{name}" for group, values in given.items() for name in values)
    unused = without_effect(settings, keys)
    return [
        f"--{key.replace('_', '-')} has no effect: it is a setting of --preset {' and '.join(presets)}"
        for key, presets in unused.items()
    ]


# Say.


def decided(
    recording: Recording,
    contents: Contents,
    planned: Plan,
    asked: Settings,
    output: Output,
    options: argparse.Namespace,
) -> list[str]:
    """What is about to be done, in a few lines."""
    height, width = recording.sensor_size
    source = recording.source
    begin, end = ((int(t) - contents.start) * 1e-6 for t in (planned.times[0], planned.times[-1]))
    spacing = "at given times" if output.rate_hz is None else f"at {output.rate_hz:g} Hz"
    if options.at is not None:
        spacing = "at the frames"
    ahead = "both ways in time" if planned.smooth else "one frame ahead" if planned.lookahead else "causal"
    colours = (
        [] if contents.colours == "grey" else [f"colour      {_colour_line(contents, planned, options)}"]
    )
    return [
        f"recording   {source.path}: {source.format}, {width}x{height} pixels, {contents.seconds:.3f} s, "
        f"{how_many(contents.frames, 'frame')}, "
        f"{'' if contents.complete else 'more than '}{how_many(contents.events, 'event')}",
        *(
            f"{label:<11} {text}"
            for label, text in plan_report(recording, planned, asked)
            if label != "white balance"
        ),
        *colours,
        f"filter      {planned.settings.filter.kind}, preset {options.preset}"
        f"{'' if options.settings is None else f' changed by {options.settings}'}, {ahead}",
        f"images      {len(planned.times):,} {spacing}, {begin:.3f} to {end:.3f} s -> {output.path} ({output.format})",
    ]


def _colour_line(contents: Contents, planned: Plan, options: argparse.Namespace) -> str:
    what = (
        "RGB frames: luminance filtered, chromaticity of the frames"
        if contents.colours == "RGB"
        else f"Bayer mosaic {contents.colours}, demosaiced after the filter"
    )
    return f"{what}; white balance {planned.settings.camera.white_balance}{', written in grey' if options.grey else ''}"


def metadata(
    recording: Recording, planned: Plan, options: argparse.Namespace, command: list[str]
) -> dict[str, Any]:
    """What `kalux.toml` tells of the run; `kalux reconstruct --settings` reads the settings from it."""
    height, width = recording.sensor_size
    estimate = None if planned.steps.thresholds is None else planned.steps.thresholds._asdict()
    return {
        "command": shlex.join(command),
        "preset": options.preset,
        "calibration": [str(path) for path in options.calibration or []],
        "settings": to_dict(planned.settings),
        "thresholds": {"origin": planned.threshold_origin, "estimate": estimate},
        "input": {
            "path": options.recording,
            "format": recording.source.format,
            "height": height,
            "width": width,
            "exposure": options.exposure,
            "stamp": options.stamp,
            "frames": options.frames,
            "frames_start": options.frames_start,
            "frames_rate": options.frames_rate,
            "replace_frames": options.replace_frames or None,
            "white": options.white,
            "bayer": options.bayer,
        },
        "images_wanted": {
            "count": len(planned.times),
            "times_file": options.times,
            "at": options.at,
            "start": options.start,
            "end": options.end,
            "lookahead": planned.lookahead,
            "smooth": planned.smooth,
        },
        "versions": {"numba": importlib.metadata.version("numba")},
    }


# Do.


def write_images(
    recording: Recording,
    planned: Plan,
    output: Output,
    described: dict[str, Any],
    options: argparse.Namespace,
    threads: int,
) -> tuple[float, int]:
    """Carry out the plan; returns the seconds it took and the number of images."""
    writer = output.open(described, threads)
    progress = Progress("reconstructing", images=len(planned.times), quiet=options.quiet)
    backward = Progress("backward pass", quiet=options.quiet)
    images = execute(
        recording,
        planned,
        lambda count: progress.add(events=count),
        lambda count: backward.add(events=count),
        threads=threads,
        with_variance=output.has_variance,
    )
    try:
        with writer, contextlib.closing(images):
            # The first image comes when the backward pass, if there is one, is done.
            with backward if planned.smooth else contextlib.nullcontext():
                first = next(images, None)
            with progress:
                for image in itertools.chain([] if first is None else [first], images):
                    writer.write(image.grey() if options.grey else image)
                    progress.add(images=1)
    except (KeyboardInterrupt, InputError) as error:
        error.add_note(_what_is_left(writer, output))
        raise
    return max(progress.seconds, 1e-3), writer.images


def _what_is_left(writer: Writer, output: Output) -> str:
    if writer.images == 0 or (output.format == "mp4" and not output.path.exists()):
        return f"no image was finished in {output.path}"
    return f"{how_many(writer.images, 'image')} finished and valid in {output.path}"
