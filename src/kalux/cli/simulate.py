"""``kalux simulate``: a recording with ground truth from an HDR photograph, images or a video."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kalux.cli.parser import Parser, number, whole
from kalux.cli.simulated_scenes import add_scene, chosen_scene
from kalux.cli.simulated_sensors import add_sensor, chosen_sensor
from kalux.cli.terminal import say
from kalux.wording import how_many

if TYPE_CHECKING:
    from kalux.datasets import Scene, SensorSettings
    from kalux.datasets.record import Recorded

_DESCRIPTION = """\
Simulate an event camera that also takes frames, and looks at a photograph, a folder of images or a video.
Writes one kalux HDF5 file with events, frames, and the true radiance as ground truth; 1 is a saturated frame
pixel. The same source, flags and seed give the same file."""

_EXAMPLES = """\
examples:
  kalux simulate church.hdr -o church.h5
  kalux simulate church.hdr -o shaky.h5 --motion pan+shake --speed 60 --preset davis240c --seed 3
  kalux simulate church.hdr -o ball.h5 --foreground ball --sensor.cutoff 300 --sensor.noise-rate 5
  kalux simulate frames/ -o rendered.h5 --source-rate 1000 --preset ideal --saturate 0.1
  kalux evaluate church.h5"""


def add_command(commands: Any) -> None:
    """Add ``simulate`` to the parser."""
    parser: Parser = commands.add_parser(
        "simulate",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux simulate SOURCE -o OUT.h5 [flags]",
    )
    parser.add_argument_group("what is seen").add_argument(
        "source",
        metavar="SOURCE",
        type=Path,
        help="an HDR photograph (.hdr, .exr), another image, a folder of images, or a video",
    )
    add_sensor(parser)
    add_scene(parser)
    group = parser.add_argument_group("output")
    group.add_argument("-o", "--out", metavar="OUT.h5", type=Path, required=True, help="the kalux HDF5 file")
    group.add_argument(
        "--truth-rate",
        metavar="HZ",
        type=number,
        help="images of ground truth per second (default: in the middle of the frames and halfway between)",
    )
    group.add_argument("--seed", type=whole, default=0, metavar="N", help="of all that is random (default 0)")
    group.add_argument("--overwrite", action="store_true", help="replace the file if it is there")
    group.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.cli.output import check_file
    from kalux.cli.progress import Progress
    from kalux.cli.recordings import check_name
    from kalux.datasets.record import record
    from kalux.writers.files import check_length, output_errors
    from kalux.writers.settings_file import beside, require_ours

    check_name(options.out, options.source)
    check_file(options.out, overwrite=options.overwrite)
    require_ours(beside(options.out))
    with output_errors(options.out):
        check_length(beside(options.out))
    settings, size = chosen_sensor(options)
    scene, white = chosen_scene(options, size)
    total = scene.duration // 1000
    with Progress("simulating", images=total, quiet=options.quiet, unit="ms") as progress:

        def on_time(t: float) -> None:
            progress.add(images=int((t - scene.start) / 1000) - progress.images)

        recorded = record(
            options.out,
            scene,
            settings,
            seed=options.seed,
            truth_rate=options.truth_rate,
            on_time=on_time,
        )
    write_settings(options, command, settings, scene, white, recorded)
    if not options.quiet:
        say(summary(options.out, scene, recorded, white, progress.seconds))


def write_settings(
    options: argparse.Namespace,
    command: list[str],
    settings: SensorSettings,
    scene: Scene,
    white: float,
    recorded: Recorded,
) -> None:
    """Write what made the recording: the command, the sensor, what is white, and the versions.

    Raises
    ------
    OutputError
        If the file cannot be written; the recording is whole.
    """
    from kalux.writers.files import output_errors
    from kalux.writers.settings_file import beside, settings_file

    path = beside(options.out)
    metadata = {
        "command": shlex.join(command),
        "simulation": {
            "source": options.source,
            "seed": options.seed,
            "sensor_size": scene.sensor_size,
            "duration_us": scene.duration,
            "white_radiance": white,
            "events": recorded.events,
            "frames": recorded.frames,
        },
        "sensor": settings,
    }
    with output_errors(path, f"the recording {options.out} is whole, its settings are missing"):
        settings_file(path, metadata, {"format": "kalux"}).write(
            complete=True, images=recorded.truth, times=None
        )


def summary(out: Path, scene: Scene, recorded: Recorded, white: float, seconds: float) -> str:
    """What was written, in two lines."""
    height, width = scene.sensor_size
    rate = recorded.events / (scene.duration * 1e-6) / (height * width)
    shortest, longest = recorded.exposures
    exposures = f"{shortest}" if shortest == longest else f"{shortest} to {longest}"
    on = 100 * recorded.on_events / max(recorded.events, 1)
    return (
        f"wrote {out}: {width}x{height}, {scene.duration * 1e-6:g} s, {how_many(recorded.events, 'event')}, "
        f"{how_many(recorded.frames, 'frame')}, {how_many(recorded.truth, 'image')} of truth, in {seconds:.1f} s\n"
        f"events: {rate:.2f} Hz per pixel, {on:.0f} % ON; exposures {exposures} us; white is a radiance of {white:.4g}"
    )
