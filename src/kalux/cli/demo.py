"""``kalux demo``: simulate, reconstruct, compare with the truth."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kalux.cli.loops import OF_ALL, compiling_beside, prepare_loops, tell_of_compiling
from kalux.cli.parser import Parser
from kalux.cli.terminal import say
from kalux.threads import default_threads

if TYPE_CHECKING:
    from kalux.demo import Score

_DESCRIPTION = """\
See what kalux does, without data of your own: simulates a recording with known truth, reconstructs it, and
writes a picture, a video and the recording. Takes a quarter of a minute, the first run, which compiles, up to one."""

_EXAMPLES = """\
examples:
  kalux demo
  kalux demo -o /tmp/demo --overwrite"""


def add_command(commands: Any) -> None:
    """Add ``demo`` to the parser."""
    parser: Parser = commands.add_parser(
        "demo", description=_DESCRIPTION, epilog=_EXAMPLES, usage="kalux demo [-o OUT]"
    )
    group = parser.add_argument_group("output")
    group.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("kalux-demo"),
        metavar="OUT",
        help="folder (default kalux-demo)",
    )
    group.add_argument("--overwrite", action="store_true", help="replace a former demo")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.demo import run_demo

    prepare_loops()
    tell_of_compiling()
    started = time.monotonic()
    try:
        # These are done before the demo comes to them.
        with compiling_beside(OF_ALL, default_threads()):
            found = run_demo(options.out, overwrite=options.overwrite, say=say)
    except KeyboardInterrupt as interrupt:
        if options.out.is_dir() and any(options.out.iterdir()):
            interrupt.add_note(f"what is in {options.out} is whole; kalux demo --overwrite makes the rest")
        raise
    say(f"done in {time.monotonic() - started:.0f} s\n")
    say(score_table(found))
    say(_guide(options.out))


def score_table(found: Sequence[Score]) -> str:
    """The scores as a table, smaller errors and greater similarity being better."""
    lines = [f"{'error against the truth':<28}{'MSE':>8}{'log-MSE':>10}{'SSIM':>8}".rstrip()]
    for score in found:
        similarity = "" if score.ssim is None else f"{score.ssim:8.3f}"
        lines.append(f"{score.method:<28}{score.mse:8.3f}{score.log_mse:10.4f}{similarity}")
    if found[0].ssim is None:
        lines[0] = lines[0].removesuffix("SSIM").rstrip()
    return "\n".join(lines)


def _guide(out: Path) -> str:
    margin = " " * (len(str(out)) + 12)
    return f"""
{out}/demo.png   the window is clipped to white in the camera frame; in the AKF's image there are trees, a
{margin}hill and clouds, told by events alone. Bright in 'uncertainty' is where the AKF itself
{margin}expects errors: compare with its true errors. All images have the same tone curve.
{out}/demo.mp4   the camera's frames (left) and the AKF's 100 images/s (right), five times slower: watch the ball
{out}/demo.h5    the recording with its truth; try: kalux reconstruct {out}/demo.h5 -o video.mp4"""
