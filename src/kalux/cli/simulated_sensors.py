"""The sensor of ``kalux simulate``: its flags, their help, and what they choose."""

from __future__ import annotations

import argparse
import dataclasses
import re
from typing import TYPE_CHECKING, Any, Final

from kalux.cli.parser import Parser, UsageError, number, true_or_false, whole
from kalux.cli.terminal import say

if TYPE_CHECKING:
    from kalux.datasets import SensorSettings

_SHORT: Final = {
    "frame_rate": (number, "HZ", "frames per second; as --sensor.frame-rate"),
    "exposure": (whole, "US", "exposure time; as --sensor.exposure"),
    "auto_exposure": (number, "LEVEL", "vary the exposures for this mean of the frames, 0 to 1"),
}


def add_sensor(parser: Parser) -> None:
    """Add what says which sensor looks."""
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
    for field, kind in sensor_fields().items():
        parser.add_argument(
            f"--sensor.{field.replace('_', '-')}",
            dest=f"sensor.{field}",
            type=kind,
            default=None,
            help=argparse.SUPPRESS,
        )
    parser.add_help_flag("--help-sensor", HelpSensor, "presets, and every setting of the sensor")


def sensor_fields() -> dict[str, Any]:
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
        name: values[f"sensor.{name}"] for name in sensor_fields() if values[f"sensor.{name}"] is not None
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
