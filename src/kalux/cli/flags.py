"""Flags made from dataclasses: every setting and every parameter of the display."""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import re
import textwrap
import typing
from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

from kalux.cli.parser import number, true_or_false, whole
from kalux.cli.terminal import say
from kalux.display import CURVES, DisplaySettings, curve_from_name
from kalux.errors import SettingsError
from kalux.settings import AUTO, Settings

_WIDTH = 100
_DISPLAY = "display_parameter."


class Flag(NamedTuple):
    """A flag for one field of a dataclass.

    Attributes
    ----------
    name
        As typed, with dashes.
    key
        As in TOML: ``group.field``.
    kind
        Turns the text into a value.
    choices
        The possible values, or None.
    default
        Of the field.
    text
        What the docstring says.
    """

    name: str
    key: str
    kind: Callable[[str], Any]
    choices: tuple[str, ...] | None
    default: Any
    text: str


# Settings.


def setting_flags() -> Iterator[Flag]:
    """A flag for every setting: ``--camera.log-offset``."""
    defaults = Settings()
    for group in dataclasses.fields(Settings):
        for flag in flags_of(getattr(defaults, group.name), group.name):
            yield flag._replace(kind=_OrAuto(flag.kind)) if flag.default is None else flag


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add every setting as a flag; ``--help-settings`` explains them."""
    for flag in setting_flags():
        parser.add_argument(
            flag.name,
            dest=flag.key,
            type=flag.kind,
            choices=flag.choices,
            default=None,
            help=argparse.SUPPRESS,
        )


def given_settings(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """The settings that were given as flags, nested as in TOML."""
    values = vars(options)
    given: dict[str, dict[str, Any]] = {}
    for flag in setting_flags():
        if values[flag.key] is not None:
            group, name = flag.key.split(".")
            given.setdefault(group, {})[name] = values[flag.key]
    return given


# Display.


def display_flags() -> dict[str, list[Flag]]:
    """Flags for the parameters of every curve, and under ``""`` for what all curves have."""
    flags = {name: list(flags_of(curve(), "display")) for name, curve in CURVES.items()}
    common = [flag for flag in flags_of(DisplaySettings(), "display") if flag.key != "display.curve"]
    return {**flags, "": common}


def add_display(parser: argparse.ArgumentParser) -> None:
    """Add the parameters of all curves as flags."""
    added: set[str] = set()
    for flag in (flag for flags in display_flags().values() for flag in flags):
        if flag.name not in added:
            parser.add_argument(
                flag.name,
                dest=_DISPLAY + flag.key.split(".")[1],
                type=flag.kind,
                choices=flag.choices,
                default=None,
                help=argparse.SUPPRESS,
            )
            added.add(flag.name)


def given_display(options: argparse.Namespace) -> DisplaySettings:
    """The display that ``--display`` and its parameters ask for.

    Raises
    ------
    SettingsError
        A parameter is not one of the curve's, out of its range, or has no effect.
    """
    given = {
        key.removeprefix(_DISPLAY): value
        for key, value in vars(options).items()
        if key.startswith(_DISPLAY) and value is not None
    }
    if "gamma" in given and given.get("encoding") != "gamma":
        raise SettingsError(
            "--display.gamma has no effect: it is for --display.encoding gamma; give that, too"
        )
    common = {field.name for field in dataclasses.fields(DisplaySettings)}
    shared = {name: value for name, value in given.items() if name in common}
    try:
        curve = curve_from_name(
            options.display or "auto", **{n: v for n, v in given.items() if n not in common}
        )
        return DisplaySettings(curve, **shared)
    except SettingsError as error:
        raise SettingsError(f"--{error}") from None


# Their help.


class HelpSettings(argparse.Action):
    """``--help-settings``: all settings and display parameters with units, defaults and reasons."""

    def __call__(self, parser: argparse.ArgumentParser, *unused: Any) -> None:
        """Print and end."""
        say(settings_help())
        parser.exit()


def settings_help() -> str:
    """The text of ``--help-settings``."""
    lines = [
        "Every setting as a flag, with its default in the preset default. In TOML files, --camera.log-offset is",
        "log_offset in the table [camera]. docs/tuning.md tells how the defaults were found.",
    ]
    group = ""
    for flag in setting_flags():
        if flag.key.split(".")[0] != group:
            group = flag.key.split(".")[0]
            lines += ["", f"{group}: {_summary(type(getattr(Settings(), group)))}"]
        lines += described(flag)
    for name, flags in display_flags().items():
        title = f"--display {name}: {_summary(CURVES[name])}" if name else "every display:"
        lines += ["", title, *(line for flag in flags for line in described(flag))]
    return "\n".join(lines)


def described(flag: Flag) -> list[str]:
    """Lines of help for a flag."""
    default = AUTO if isinstance(flag.kind, _OrAuto) else _shown(flag.default)
    kind = flag.kind.convert if isinstance(flag.kind, _OrAuto) else flag.kind
    value = "|".join(flag.choices) if flag.choices else _KINDS[kind]
    head = f"  {flag.name} {value}  (default {default})"
    # What Python calls None is auto here.
    text = flag.text.replace("None:", f"{AUTO}:") if isinstance(flag.kind, _OrAuto) else flag.text
    return [head, *textwrap.wrap(text, _WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6)]


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value).lower()


_KINDS = {number: "NUMBER", whole: "INTEGER", true_or_false: "true|false", str: "TEXT"}


def _summary(kind: type) -> str:
    return _plain((inspect.getdoc(kind) or "").split("\n\n")[0])


# Dataclasses to flags.


def flags_of(instance: Any, group: str) -> Iterator[Flag]:
    """A flag for every field of a dataclass, ``--group.field-name``, with the instance's values as defaults."""
    kind = type(instance)
    hints = typing.get_type_hints(kind)
    texts = attribute_texts(kind)
    for field in dataclasses.fields(kind):
        convert, choices = _conversion(hints[field.name])
        name = f"--{group}.{field.name.replace('_', '-')}"
        default = getattr(instance, field.name)
        yield Flag(name, f"{group}.{field.name}", convert, choices, default, texts.get(field.name, ""))


class _OrAuto:
    """Turns a text into a value, but leaves ``auto`` as it is: what the setting is where nothing is said."""

    def __init__(self, convert: Callable[[str], Any]) -> None:
        self.convert = convert
        self.__name__ = f"{convert.__name__} or {AUTO}"  # for messages

    def __call__(self, text: str) -> Any:
        return AUTO if text == AUTO else self.convert(text)


def _conversion(hint: Any) -> tuple[Callable[[str], Any], tuple[str, ...] | None]:
    if typing.get_origin(hint) is Literal:
        return str, typing.get_args(hint)
    kinds = [kind for kind in typing.get_args(hint) or (hint,) if kind is not type(None)]
    return {float: number, int: whole, bool: true_or_false}.get(kinds[0], str), None


def attribute_texts(kind: type) -> dict[str, str]:
    """What the section Attributes of a numpydoc docstring says of each attribute, as plain text."""
    _, _, section = (inspect.getdoc(kind) or "").partition("Attributes\n----------\n")
    texts: dict[str, str] = {}
    for block in re.split(r"\n(?=\S)", section):
        names, _, text = block.partition("\n")
        for name in names.split(","):
            texts[name.strip()] = _plain(text)
    return texts


def _plain(text: str) -> str:
    return " ".join(text.replace("``", "").replace("`", "").split())
