"""``kalux simulate``: a recording with ground truth from an HDR photograph, images or a video."""

from __future__ import annotations

import argparse
import dataclasses
import math
import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from kalux.cli.parser import Parser, UsageError, number, true_or_false, whole
from kalux.cli.terminal import say, warn
from kalux.wording import how_many

if TYPE_CHECKING:
    from kalux.datasets import Motion, Scene, SensorSettings
    from kalux.datasets.record import Recorded
    from kalux.datasets.sources import ImageSequence, Photograph

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

_SATURATED: Final = 0.12
"""Of the pixels, beyond white, where HDR sources leave the choice: clear highlights, most of the image well exposed."""

_VIEW: Final = 0.75
"""Part of a photograph's height or width that the sensor sees, which leaves room to move."""

_MOTIONS: Final = ("still", "pan", "rotate", "dolly", "shake", "handheld")

_SHORT: Final = {
    "frame_rate": (number, "HZ", "frames per second; as --sensor.frame-rate"),
    "exposure": (whole, "US", "exposure time; as --sensor.exposure"),
    "auto_exposure": (number, "LEVEL", "vary the exposures for this mean of the frames, 0 to 1"),
}


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
    _add_sensor(parser)
    _add_view(parser)
    _add_motion(parser)
    _add_foreground(parser)
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


def _add_sensor(parser: Parser) -> None:
    group = parser.add_argument_group(
        "sensor (--help-sensor lists presets and all settings, with their sources)"
    )
    group.add_argument(
        "--preset",
        default="davis346",
        metavar="NAME",
        help="ideal, davis240c, davis346 (default) or prophesee-vga",
    )
    for name, (kind, metavar, text) in _SHORT.items():
        group.add_argument("--" + name.replace("_", "-"), type=kind, metavar=metavar, help=text)
    group.add_argument("--size", metavar="WxH", help="pixels (default: of the preset)")
    for field, kind in _sensor_fields().items():
        parser.add_argument(
            f"--sensor.{field.replace('_', '-')}",
            dest=f"sensor.{field}",
            type=kind,
            default=None,
            help=argparse.SUPPRESS,
        )
    parser.add_help_flag("--help-sensor", HelpSensor, "presets, and every setting of the sensor")


def _add_view(parser: Parser) -> None:
    group = parser.add_argument_group("view")
    group.add_argument(
        "--duration", metavar="S", type=number, help="seconds (default 2; of a sequence: all of it)"
    )
    group.add_argument(
        "--source-rate", metavar="HZ", type=number, help="images per second of a folder or video"
    )
    group.add_argument(
        "--scale",
        metavar="N",
        type=number,
        help="image pixels per sensor pixel (default: the sensor sees 0.75 of a photograph, all of a sequence)",
    )
    group.add_argument(
        "--saturate",
        metavar="PART",
        type=number,
        help="part of the pixels that is brighter than a frame can show (default 0.12 for HDR sources)",
    )
    group.add_argument(
        "--white", metavar="VALUE", type=number, help="radiance that saturates a frame, instead of --saturate"
    )


def _add_motion(parser: Parser) -> None:
    group = parser.add_argument_group("motion of the camera")
    group.add_argument(
        "--motion",
        metavar="NAME",
        help=f"{', '.join(_MOTIONS)}, or several, as pan+shake (default: pan+handheld; still for sequences)",
    )
    group.add_argument("--speed", metavar="PX/S", type=number, help="of pan, sensor pixels (default 60)")
    group.add_argument("--direction", metavar="DEG", type=number, help="of pan, 0 right, 90 down (default 0)")
    group.add_argument("--turn", metavar="DEG/S", type=number, help="of rotate, clockwise (default 20)")
    group.add_argument("--closer", metavar="1/S", type=number, help="of dolly, log of the zoom (default 0.2)")
    group.add_argument(
        "--amplitude",
        metavar="PX",
        type=number,
        help="of shake (default 1) and of handheld's sway (default 6), root mean square",
    )


def _add_foreground(parser: Parser) -> None:
    group = parser.add_argument_group("moving foreground")
    group.add_argument("--foreground", metavar="ball|FILE", help="what crosses the view: an image with alpha")
    group.add_argument(
        "--foreground-size", metavar="PX", type=number, help="height (default 0.25 of the sensor's)"
    )
    group.add_argument("--foreground-speed", metavar="PX/S", type=number, help="to the right (default 150)")
    group.add_argument("--foreground-turn", metavar="DEG/S", type=number, help="clockwise (default 0)")
    group.add_argument(
        "--foreground-level",
        metavar="N",
        type=number,
        help="radiance of its white, frame white = 1 (default 0.6)",
    )


# Flags of the sensor.


def _sensor_fields() -> dict[str, Any]:
    """Fields of the sensor and the types of their flags, without the imports that describe them."""
    return {
        name: {"f": number, "i": whole, "b": true_or_false, "s": str}[kind]
        for kind, names in _FIELDS.items()
        for name in names.split()
    }


# Written out, because reading them off `SensorSettings` would make every command load the simulator; a test compares.
_FIELDS: Final = {
    "f": "threshold_on threshold_off threshold_mismatch log_offset cutoff latency refractory leak_rate noise_rate "
    "noise_at_white noise_spread hot_pixels hot_rate frame_rate auto_exposure row_time read_noise full_well "
    "fixed_offset fixed_gain",
    "i": "timestamp_resolution exposure reference_exposure bits",
    "b": "noise_resets settled",
    "s": "response",
}


class HelpSensor(argparse.Action):
    """``--help-sensor``: presets with their sources, and all settings."""

    def __call__(self, parser: argparse.ArgumentParser, *unused: Any) -> None:
        """Print and end."""
        say(sensor_help())
        parser.exit()


def sensor_help() -> str:
    """The text of ``--help-sensor``."""
    import inspect
    import textwrap

    from kalux.cli.flags import described, flags_of
    from kalux.datasets import PRESETS, SensorSettings, sensors

    lines = ["Presets, and where their values come from; what is not named is as in the preset ideal.", ""]
    for name, preset in PRESETS.items():
        height, width = preset.sensor_size
        lines.append(f"--preset {name}: {preset.description}; {width}x{height}")
        for field, source in preset.sources.items():
            text = f"{field} = {getattr(preset.settings, field)}: {source}"
            lines += textwrap.wrap(text, 110, initial_indent="      ", subsequent_indent="          ")
        lines.append("")
    references = (inspect.getdoc(sensors) or "").partition("References\n----------\n")[2]
    lines += [re.sub(r"^\.\. ", "  ", line) for line in references.splitlines()]
    lines += ["", "Every setting as a flag, with its default in the preset ideal:"]
    for flag in flags_of(SensorSettings(), "sensor"):
        lines += described(flag)
    return "\n".join(lines).replace("]_", "]").replace("``", "")


def chosen_sensor(options: argparse.Namespace) -> tuple[SensorSettings, tuple[int, int]]:
    """The sensor and its (height, width) that the flags ask for.

    Raises
    ------
    UsageError
        Two flags say the same thing, or the size cannot be read.
    SettingsError
        There is no such preset, or a value is out of its range.
    """
    from kalux.datasets import sensor_preset

    preset = sensor_preset(options.preset)
    values = vars(options)
    given = {
        name: values[f"sensor.{name}"] for name in _sensor_fields() if values[f"sensor.{name}"] is not None
    }
    for name in _SHORT:
        if values[name] is not None:
            flag = name.replace("_", "-")
            if name in given:
                raise UsageError(f"--{flag} and --sensor.{flag} say the same; give one of them")
            given[name] = values[name]
    settings = dataclasses.replace(preset.settings, **given)
    return settings, preset.sensor_size if options.size is None else _size(options.size)


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if match is None or min(int(match[1]), int(match[2])) < 8:
        raise UsageError(f"--size {text}: give width and height in pixels, 8 or more, as 346x260")
    return int(match[2]), int(match[1])


# The scene.


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.cli.output import check_file
    from kalux.cli.progress import Progress
    from kalux.cli.recordings import check_name
    from kalux.cli.signals import interrupts_held
    from kalux.datasets.record import Watch, record
    from kalux.writers.settings_file import beside, require_ours

    check_name(options.out, options.source)
    check_file(options.out, overwrite=options.overwrite)
    require_ours(beside(options.out))
    settings, size = chosen_sensor(options)
    scene, white = chosen_scene(options, size)
    total = scene.duration // 1000
    # An interrupt inside HDF5 would crash it: it waits for the next chunk or frame.
    with (
        Progress("simulating", images=total, quiet=options.quiet, unit="ms") as progress,
        interrupts_held() as let_through,
    ):

        def on_time(t: float) -> None:
            let_through()
            progress.add(images=int((t - scene.start) / 1000) - progress.images)

        recorded = record(
            options.out,
            scene,
            settings,
            seed=options.seed,
            truth_rate=options.truth_rate,
            watch=Watch(on_time, let_through),
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


def chosen_scene(options: argparse.Namespace, size: tuple[int, int]) -> tuple[Scene, float]:
    """The scene that the flags ask for, and the source's radiance that is white in it.

    Raises
    ------
    UsageError
        Flags contradict each other, or the source.
    InputError
        The source cannot be read or used.
    """
    from kalux.datasets.sources import exposed, open_sequence, read_photograph, white_for
    from kalux.readers.images import IMAGES, RADIANCE

    source: Path = options.source
    if source.is_file() and source.suffix.lower() in IMAGES | RADIANCE:
        photograph = read_photograph(source)
        is_hdr, scene = photograph.is_hdr, _photograph_scene(options, photograph, size)
    else:
        sequence = open_sequence(source)
        is_hdr, scene = sequence.is_hdr, _sequence_scene(options, sequence, size)
    if options.saturate is not None and options.white is not None:
        raise UsageError("--saturate and --white say the same; give one of them")
    if not is_hdr:
        warn(
            f"{source} is no HDR source: it is decoded as sRGB and has no highlights beyond its white, so "
            "events and truth have none either"
        )
    if options.saturate is not None or (is_hdr and options.white is None):
        white = white_for(scene, _or(options.saturate, _SATURATED))
    else:
        white = _or(options.white, 1.0)
    return _with_foreground(options, exposed(scene, white)), white


def _photograph_scene(options: argparse.Namespace, photograph: Photograph, size: tuple[int, int]) -> Scene:
    from kalux.datasets import photograph_scene
    from kalux.datasets.sources import fitting_scale

    if options.source_rate is not None:
        raise UsageError("--source-rate is for a folder or a video; the source is one image")
    scale = options.scale
    if scale is None:
        scale = fitting_scale((photograph.radiance.shape[0], photograph.radiance.shape[1]), size, _VIEW)
    return photograph_scene(
        photograph.radiance,
        chosen_motion(options, "pan+handheld"),
        sensor_size=size,
        duration=_duration(options, 2.0),
        scale=scale,
        name=str(options.source),
    )


def _sequence_scene(options: argparse.Namespace, sequence: ImageSequence, size: tuple[int, int]) -> Scene:
    from kalux.datasets.sources import sequence_scene

    rate = options.source_rate if options.source_rate is not None else sequence.rate_hz
    if rate is None:
        raise UsageError(
            f"{options.source}: a folder does not say how fast its images follow; give --source-rate HZ"
        )
    return sequence_scene(
        sequence,
        chosen_motion(options, "still"),
        sensor_size=size,
        rate_hz=rate,
        duration=None if options.duration is None else _duration(options, 0.0),
        scale=options.scale,
    )


def _duration(options: argparse.Namespace, default: float) -> int:
    """us."""
    seconds = _or(options.duration, default)
    if not 1e-6 <= seconds < 1e6:
        raise UsageError(
            f"--duration {seconds:g}: it must be positive, 1e-6 or more, and less than 1e6, in seconds"
        )
    return round(seconds * 1e6)


def _or(value: float | None, default: float) -> float:
    return default if value is None else value


def chosen_motion(options: argparse.Namespace, default: str) -> Motion:
    """The camera's motion that the flags ask for.

    Raises
    ------
    UsageError
        There is no such motion, or a flag belongs to none of them.
    """
    import numpy as np

    from kalux.datasets import combine, dolly, handheld, pan, shake, spin

    names = (options.motion or default).split("+")
    unknown = [name for name in names if name not in _MOTIONS]
    if unknown:
        raise UsageError(f"--motion: there is no {unknown[0]!r}; known are {', '.join(_MOTIONS)}")
    uses = {
        "speed": ("pan",),
        "direction": ("pan",),
        "turn": ("rotate",),
        "closer": ("dolly",),
        "amplitude": ("shake", "handheld"),
    }
    for flag, users in uses.items():
        check_finite(options, flag)
        if getattr(options, flag) is not None and not set(users) & set(names):
            raise UsageError(
                f"--{flag} is for the motion {' or '.join(users)}; the motion is {'+'.join(names)}"
            )
    if _or(options.amplitude, 0.0) < 0:
        raise UsageError(f"--amplitude {options.amplitude:g}: 0 or more is needed")
    speed, angle = _or(options.speed, 60.0), np.deg2rad(_or(options.direction, 0.0))
    seed = max(options.seed, 0)
    motions: dict[str, Motion] = {
        "still": combine(),
        "pan": pan(speed * float(np.cos(angle)), speed * float(np.sin(angle))),
        "rotate": spin(float(np.deg2rad(_or(options.turn, 20.0)))),
        "dolly": dolly(_or(options.closer, 0.2)),
        "shake": shake(seed, amplitude=_or(options.amplitude, 1.0)),
        "handheld": handheld(seed, sway=_or(options.amplitude, 6.0)),
    }
    return combine(*(motions[name] for name in names))


def check_finite(options: argparse.Namespace, name: str) -> None:
    """Refuse infinite numbers and NaN.

    Raises
    ------
    UsageError
        That names the flag.
    """
    value = getattr(options, name)
    if value is not None and not math.isfinite(value):
        raise UsageError(f"--{name.replace('_', '-')} {value}: a finite number is needed")


def _with_foreground(options: argparse.Namespace, scene: Scene) -> Scene:
    """The scene with what ``--foreground`` puts before it."""
    import numpy as np

    from kalux.datasets.foreground import Sprite, ball, crossing, with_foreground
    from kalux.datasets.sources import read_photograph

    if options.foreground is None:
        given = [
            name
            for name in vars(options)
            if name.startswith("foreground_") and vars(options)[name] is not None
        ]
        if given:
            raise UsageError(
                f"--{given[0].replace('_', '-')} is for a foreground; give --foreground ball or an image"
            )
        return scene
    for name in ("foreground_size", "foreground_speed", "foreground_turn", "foreground_level"):
        check_finite(options, name)
    if options.foreground == "ball":
        sprite = ball()
    else:
        image = read_photograph(Path(options.foreground))
        sprite = Sprite(image.radiance, np.ones_like(image.radiance) if image.alpha is None else image.alpha)
    size = _or(options.foreground_size, 0.25 * scene.sensor_size[0])
    reach = 0.6 * size * max(1.0, sprite.alpha.shape[1] / sprite.alpha.shape[0])
    path = crossing(
        scene.sensor_size,
        reach,
        _or(options.foreground_speed, 150.0),
        turn=float(np.deg2rad(_or(options.foreground_turn, 0.0))),
    )
    return with_foreground(scene, sprite, path, size=size, level=_or(options.foreground_level, 0.6))
