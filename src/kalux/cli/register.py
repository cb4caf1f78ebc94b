"""``kalux register``: events of one camera and frames of another, as one recording."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kalux.cli.calibrate_offset import add_range, checked_range, read_offset
from kalux.cli.calibrate_rig import add_frames
from kalux.cli.calibrations import add_black_level, camera_calibration
from kalux.cli.parser import Parser, UsageError, number, whole
from kalux.cli.recordings import add_exposure, check_stamp, write_streams
from kalux.cli.terminal import say, warn
from kalux.settings import AUTO, chosen_response, preset
from kalux.wording import how_many

if TYPE_CHECKING:
    from kalux.calibration.two_cameras import Registered
    from kalux.frames import Frame
    from kalux.recording import Recording
    from kalux.settings import CameraSettings

_DESCRIPTION = """\
Make one recording of an event camera's events and another camera's frames: the frames are undistorted, warped
into the event camera's pixels, and put into its clock. Pixels that the frames do not see are marked, and
reconstruct gives them no frame information. For scenes that are far away against the distance between the
cameras; docs/rig.md goes through all of it."""

_EXAMPLES = """\
examples:
  kalux register drive.raw --frames drive_frames/ --rig rig.toml --timing triggers -o drive.h5
  kalux register drive.raw --frames drive_frames/ --rig rig.toml --distance 20 -o drive.h5
  kalux register drive.raw --frames drive.mp4 --exposure 8000 --frames-start 0 -o drive.h5"""


def add_command(commands: Any) -> None:
    """Add ``register`` to the parser."""
    parser: Parser = commands.add_parser(
        "register",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux register EVENTS --frames FRAMES -o OUT.h5 [flags]",
    )
    group = parser.add_argument_group("recording")
    group.add_argument("events", metavar="EVENTS", type=Path, help="recording of the event camera")
    add_frames(group, positional=False)
    add_exposure(group)
    group.add_argument(
        "--response",
        default=AUTO,
        metavar="NAME",
        help="of the frames: linear, srgb, bt709 or gamma:2.2 (default: what they state, else linear)",
    )
    add_black_level(group, otherwise="as the frames state, else 0")
    group = parser.add_argument_group("space")
    group.add_argument("--rig", type=Path, metavar="RIG.toml", help="calibration of both cameras")
    group.add_argument(
        "--distance", type=number, metavar="M", help="of the scene, m; with --rig (default: infinitely far)"
    )
    group.add_argument(
        "--homography",
        choices=("rig", "refine", "auto"),
        help="rig: as calibrated; refine: from there to where frames and events agree (default with --rig); "
        "auto: from features (default without)",
    )
    group = parser.add_argument_group("time")
    group.add_argument(
        "--timing",
        choices=("auto", "triggers", "same"),
        help="auto: the offset is estimated (default); triggers: exposures from the trigger input; same: one clock",
    )
    group.add_argument("--offset", metavar="US|FILE", help="to be added to the frames' times, if it is known")
    add_range(group)
    group.add_argument(
        "--trigger-edge",
        choices=("both", "rising", "falling"),
        help="both: from rising to falling (default); else where exposures start, with --exposure",
    )
    group.add_argument("--trigger-input", type=whole, metavar="ID", help="where several inputs have edges")
    group.add_argument(
        "--skip-triggers", type=whole, metavar="N", help="exposures to leave out at the beginning"
    )
    group.add_argument("--skip-frames", type=whole, metavar="N", help="frames to leave out at the beginning")
    group = parser.add_argument_group("output")
    group.add_argument("-o", "--out", required=True, type=Path, metavar="OUT.h5", help="a kalux HDF5 file")
    group.add_argument(
        "--overlay", type=Path, metavar="FILE.png", help="a frame with the events on it, to look at"
    )
    group.add_argument("--plot", type=Path, metavar="FILE.png", help="the correlation over the offset")
    group.add_argument("--overwrite", action="store_true", help="replace files that are there")
    group.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    import kalux
    from kalux.calibration.pictures import correlation_plot
    from kalux.calibration.rig import load_rig
    from kalux.calibration.two_cameras import events_size, open_frames, register
    from kalux.cli.output import check_apart, check_file, check_picture, write_picture
    from kalux.cli.recordings import check_name
    from kalux.readers.source import on_sensor
    from kalux.recording import Recording, less_black

    timing = _timing(options)
    centre, reach = checked_range(options)
    camera = camera_calibration(options.black_level).apply(preset("default")).camera
    check_name(options.out, options.events)
    check_apart([options.out, options.overlay, options.plot], [options.events, options.frames])
    check_file(options.out, overwrite=options.overwrite)
    for path in (options.overlay, options.plot):
        check_picture(path, overwrite=options.overwrite)
    rig = None if options.rig is None else load_rig(options.rig)
    events = kalux.open(options.events)
    size = events_size(events, rig)
    if not events.source.sensor_size_known:
        events = Recording(on_sensor(events.source, size))
    by_trigger = timing == "triggers"
    other = open_frames(
        options.frames,
        start=options.frames_start,
        rate_hz=options.frames_rate,
        exposure=None if by_trigger else options.exposure,
        stamp=options.stamp or "start",
    )
    other = _with_clipped_white(less_black(other, camera.black_level), camera)
    response = chosen_response(options.response, other.response)
    frames, exposure_known = _timed_frames(options, events, other, by_trigger)
    found = register(
        frames,
        events.events,
        events_size=size,
        frames_size=other.sensor_size,
        rig=rig,
        distance=options.distance,
        homography=options.homography,
        offset=_known_offset(options, timing),
        centre=centre,
        reach=reach,
        camera=dataclasses.replace(camera, response=response),
    )
    if not options.quiet:
        for line in described(found, by_trigger):
            say(line)
    if not exposure_known:
        warn("the frames have no exposure times; --exposure and --stamp would put them in")
    _write(options, events, size, found.frames(frames()), exposure_known, response)
    if options.plot is not None and found.coarse is not None:
        write_picture(
            options.plot,
            correlation_plot(found.coarse, offset=found.offset, standard_error=found.standard_error),
        )
    if options.overlay is not None:
        write_picture(options.overlay, _overlay(found, frames, events))


def _with_clipped_white(frames: Recording, camera: CameraSettings) -> Recording:
    """Frames whose clipped pixels are white again where a codec left them below: once warped, that does not show."""
    from kalux.calibration.compression import find_compression
    from kalux.plan_report import compression_text
    from kalux.planning.levels import usual_saturation
    from kalux.recording import with_white_from

    compression = find_compression(frames)
    if compression is None:
        return frames
    level = usual_saturation(camera, compression)
    warn(f"compression: {compression_text(compression)}: what is above {level:.2g} of white becomes white")
    return with_white_from(frames, level)


def _known_offset(options: argparse.Namespace, timing: str) -> float | None:
    """us, that of a file, or 0 where both have one clock; None: it is to be found."""
    if options.offset is not None:
        return read_offset(options.offset)
    return None if timing == "auto" else 0.0


def _timing(options: argparse.Namespace) -> str:
    timing = str(options.timing or "auto")
    if options.offset is not None and options.timing is not None:
        raise UsageError("--offset says what the frames' clock is; leave --timing out")
    if timing != "triggers":
        for name in ("trigger_edge", "trigger_input", "skip_triggers", "skip_frames"):
            if getattr(options, name) is not None:
                raise UsageError(f"--{name.replace('_', '-')} is for --timing triggers")
        check_stamp(options)
    elif options.stamp is not None:
        raise UsageError(
            "--stamp is for frames with times of their own; --trigger-edge says what triggers mark"
        )
    return timing


def _timed_frames(
    options: argparse.Namespace, events: Recording, other: Recording, by_trigger: bool
) -> tuple[Callable[[], Iterable[Frame]], bool]:
    if not by_trigger:
        return other.stamped_frames, other.exposure_known
    from kalux.calibration.two_cameras import triggered

    frames, notes = triggered(
        events,
        other,
        edge=options.trigger_edge or "both",
        exposure=options.exposure,
        input_id=options.trigger_input,
        skip_triggers=options.skip_triggers,
        skip_frames=options.skip_frames,
    )
    for note in notes:
        warn(f"triggers: {note}")
    return frames, True


def described(found: Registered, by_trigger: bool) -> Iterator[str]:
    """What was found, a line each."""
    registration = found.registration
    yield (
        f"overlap     {100 * registration.overlap:.0f} % of the event camera's pixels lie in the frames; "
        f"{registration.scale:.2f} frame pixels to one of its own"
    )
    if found.matched is not None:
        yield f"features    {found.matched.inliers} of {found.matched.matches} matches agree with the homography"
    if found.coarse is not None:
        yield (
            f"offset      {found.offset * 1e-3:.2f} ms, standard error {found.standard_error * 1e-3:.2f} ms, added to "
            f"the frames' times; correlation {found.coarse.peak:.2f}, {found.coarse.ratio:.2f} times the next peak"
        )
    else:
        yield f"offset      {found.offset * 1e-3:.2f} ms, " + ("by trigger" if by_trigger else "as given")
    if found.alignment is not None:
        fit = found.alignment
        yield (
            f"fit         events explain {100 * fit.explained:.0f} % of what changes between frames, thresholds "
            f"{fit.thresholds[0]:.2f} and {fit.thresholds[1]:.2f}; moved by {fit.moved:.2f} pixels"
        )


def _write(
    options: argparse.Namespace,
    events: Recording,
    size: tuple[int, int],
    frames: Iterable[Frame],
    exposure_known: bool,
    response: str,
) -> None:
    from kalux.cli.progress import Progress
    from kalux.writers import hdf5

    write = partial(
        hdf5.write,
        options.out,
        sensor_size=size,
        exposure_known=exposure_known,
        contrast_threshold=events.contrast_threshold,
        response=None if response == "linear" else response,
    )
    with Progress("registering", quiet=options.quiet) as progress:
        doubt = write_streams(write, events.events(), frames, progress)
    if doubt is not None:
        warn(doubt)
    if not options.quiet:
        say(
            f"wrote {how_many(progress.events, 'event')} and {how_many(progress.images, 'frame')} to {options.out}"
        )


def _overlay(found: Registered, frames: Callable[[], Iterable[Frame]], events: Recording) -> Any:
    """The frame in the middle of the recording, with the events of 5 ms before and after its middle."""
    from kalux.calibration.offset import some_events, some_frames
    from kalux.calibration.pictures import overlay

    count = sum(1 for _ in frames())
    middle = count // 2
    frame = next(found.frames(some_frames(frames(), slice(middle, middle + 1))))
    return overlay(frame, some_events(events.events(), frame.middle - 5_000, frame.middle + 5_000))
