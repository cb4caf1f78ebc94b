"""The scene of ``kalux simulate``: flags of the view, the camera's motion and the foreground, and what they choose."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Final

from kalux.cli.parser import Parser, UsageError, number
from kalux.cli.terminal import warn

if TYPE_CHECKING:
    from kalux.datasets import Motion, Scene
    from kalux.datasets.sources import ImageSequence, Photograph

_SATURATED: Final = 0.12
"""Of the pixels, beyond white, where HDR sources leave the choice: clear highlights, most of the image well exposed."""

_VIEW: Final = 0.75
"""Part of a photograph's height or width that the sensor sees, which leaves room to move."""

_MOTIONS: Final = ("still", "pan", "rotate", "dolly", "shake", "handheld")


def add_scene(parser: Parser) -> None:
    """Add what says how a source is looked at, and what moves."""
    _add_view(parser)
    _add_motion(parser)
    _add_foreground(parser)


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


def chosen_scene(options: argparse.Namespace, size: tuple[int, int]) -> tuple[Scene, float]:
    """The scene that the flags ask for, and the source's radiance that is white in it.

    Raises
    ------
    UsageError
        Flags contradict each other, or the source.
    InputError
        The source cannot be read or used.
    """
    from kalux.datasets.sources import exposed, open_sequence, white_for
    from kalux.readers.images import IMAGES, RADIANCE

    source: Path = options.source
    if source.is_file() and source.suffix.lower() in IMAGES | RADIANCE:
        photograph = _photograph(source)
        is_hdr, scene = photograph.is_hdr, _photograph_scene(options, photograph, size)
    else:
        sequence = open_sequence(source, warn)
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


def _photograph(path: Path) -> Photograph:
    from kalux.datasets.sources import read_photograph

    found = read_photograph(path)
    if found.doubt is not None:
        warn(found.doubt)
    return found


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
        image = _photograph(Path(options.foreground))
        alpha = np.ones_like(image.radiance) if image.alpha is None else image.alpha
        sprite = Sprite(image.radiance, alpha, image.premultiplied)
    size = _or(options.foreground_size, 0.25 * scene.sensor_size[0])
    reach = 0.6 * size * max(1.0, sprite.alpha.shape[1] / sprite.alpha.shape[0])
    path = crossing(
        scene.sensor_size,
        reach,
        _or(options.foreground_speed, 150.0),
        turn=float(np.deg2rad(_or(options.foreground_turn, 0.0))),
    )
    return with_foreground(scene, sprite, path, size=size, level=_or(options.foreground_level, 0.6))
