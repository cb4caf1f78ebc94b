"""``kalux calibrate rig``: lenses and pose of two cameras, from a blinking board."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kalux.cli.parser import Parser, UsageError, number, whole
from kalux.cli.terminal import say, warn

if TYPE_CHECKING:
    from kalux.calibration.boards import RigCalibration

_DESCRIPTION = """\
Calibrate an event camera and a frame camera side by side: focal length, principal point and distortion of
both, and the pose between them. Show a checkerboard on a screen that blinks (kalux's docs/rig.md says how),
hold the rig still before it, move, hold still again: 15 to 30 places, tilted, all over both images."""

_EXAMPLES = """\
examples:
  kalux calibrate rig board.raw board_frames/ --board 9x6 --square 30 -o rig.toml
  kalux calibrate rig board.raw board.mp4 --frames-start 0 --board 9x6 --square 30 -o rig.toml
  kalux calibrate rig board.raw frames/ --board 9x6 --charuco 5X5_100 --marker 22 -o rig.toml"""


def add_command(subparsers: Any) -> None:
    """Add ``rig`` to the parser of ``kalux calibrate``."""
    parser: Parser = subparsers.add_parser(
        "rig",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux calibrate rig EVENTS FRAMES --board 9x6 --square MM -o rig.toml [flags]",
    )
    group = parser.add_argument_group("recording")
    group.add_argument("events", metavar="EVENTS", type=Path, help="recording of the event camera")
    add_frames(group, positional=True)
    group = parser.add_argument_group("board")
    group.add_argument("--board", required=True, metavar="COLUMNSxROWS", help="inner corners, such as 9x6")
    group.add_argument("--square", required=True, type=number, metavar="MM", help="side of a square, mm")
    group.add_argument("--charuco", metavar="DICT", help="a ChArUco board of this dictionary, e.g. 5X5_100")
    group.add_argument("--marker", type=number, metavar="MM", help="of a ChArUco board: side of a marker, mm")
    group.add_argument(
        "--window",
        type=whole,
        default=400,
        metavar="MS",
        help="events that make one event image, ms; the board must blink and stand still in it (400)",
    )
    group = parser.add_argument_group("output")
    group.add_argument("-o", "--out", required=True, type=Path, metavar="RIG.toml", help="the rig file")
    group.add_argument("--sheet", type=Path, metavar="FILE.png", help="a picture of what was found")
    group.add_argument("--overwrite", action="store_true", help="replace files that are there")
    group.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    parser.set_defaults(run=run)


def add_frames(group: Any, *, positional: bool) -> None:
    """Add what says which frames, and when the first of a video was taken."""
    text = "frames of the other camera: image folder with times, video, or any recording"
    if positional:
        group.add_argument("frames", metavar="FRAMES", type=Path, help=text)
    else:
        group.add_argument("--frames", required=True, metavar="FRAMES", type=Path, help=text)
    group.add_argument(
        "--frames-start", type=whole, metavar="US", help="of a video: time of its first frame, us"
    )
    group.add_argument("--frames-rate", type=number, metavar="HZ", help="of a video: frames per second")


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    import kalux
    from kalux.calibration.boards import (
        Board,
        calibrate_rig,
        contact_sheet,
        event_images,
        find_views,
    )
    from kalux.calibration.rig import rig_toml
    from kalux.calibration.two_cameras import open_frames
    from kalux.cli.output import check_apart, check_file, check_picture, write_picture
    from kalux.cli.progress import Progress, counted
    from kalux.writers.files import save

    columns, rows = board_size(options.board)
    marker = None if options.marker is None else options.marker * 1e-3
    board = Board(columns, rows, options.square * 1e-3, options.charuco, marker)
    check_apart([options.out, options.sheet], [options.events, options.frames])
    check_file(options.out, overwrite=options.overwrite)
    check_picture(options.sheet, overwrite=options.overwrite)
    if options.window <= 0:
        raise UsageError(f"--window is {options.window} ms; it must be positive")
    events = kalux.open(options.events)
    frames = open_frames(options.frames, start=options.frames_start, rate_hz=options.frames_rate)
    views = []
    with Progress("looking for the board", quiet=options.quiet) as progress:
        chunks = counted(events.events(), lambda chunk: progress.add(events=len(chunk)))
        images = event_images(chunks, events.sensor_size, options.window * 1000)
        for view in find_views(board, images, frames.stamped_frames()):
            views.append(view)
            progress.add(images=1)
    found = calibrate_rig(board, views, events_size=events.sensor_size, frames_size=frames.sensor_size)
    save(options.out, rig_toml(found.rig))
    if options.sheet is not None:
        write_picture(options.sheet, contact_sheet(found.views))
    about = found.rig.about
    if min(about["coverage_events"], about["coverage_frames"]) < 0.5:
        warn(
            f"the board covered {100 * about['coverage_events']:.0f} % of the event image and "
            f"{100 * about['coverage_frames']:.0f} % of the frames; distortion is a guess where it never was"
        )
    if not options.quiet:
        for line in described(found):
            say(line)
        say(f"wrote {options.out}")


def described(found: RigCalibration) -> Iterator[str]:
    """What was found, a line each."""
    about = found.rig.about
    yield (
        f"views        {about['views']} used, {found.dropped} dropped because they did not agree, or showed too little "
        "of the board"
    )
    for name, lens in (("events", found.rig.events), ("frames", found.rig.frames)):
        f = lens.matrix
        yield (
            f"{name:<12} focal length {f[0, 0]:.1f} and {f[1, 1]:.1f} px, centre ({f[0, 2]:.1f}, {f[1, 2]:.1f}), "
            f"k1 {lens.distortion[0]:.3f}; error {about[f'rms_{name}_px']:.2f} px, "
            f"board seen in {100 * about[f'coverage_{name}']:.0f} % of the image"
        )
    yield (
        f"pose         {found.rig.angle:.2f} degrees, {1e3 * found.rig.baseline:.1f} mm apart; "
        f"error of both together {about['rms_rig_px']:.2f} px"
    )


def board_size(text: str) -> tuple[int, int]:
    """Columns and rows of ``9x6``."""
    match = re.fullmatch(r"(\d{1,3})x(\d{1,3})", text.strip().lower())
    if match is None:
        raise UsageError(f"--board {text}: COLUMNSxROWS of inner corners is needed, such as 9x6")
    return int(match[1]), int(match[2])
