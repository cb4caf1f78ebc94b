"""`argparse`, with errors as one line and help that keeps its paragraphs."""

from __future__ import annotations

import argparse
import re
import textwrap
from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any, Final, Never

from kalux.cli.terminal import say
from kalux.errors import InputError, did_you_mean


class UsageError(InputError):
    """The command line cannot be understood."""


class Parser(argparse.ArgumentParser):
    """A parser that raises `UsageError` instead of printing its usage and ending the process."""

    def __init__(self, **options: Any) -> None:
        options = {"formatter_class": HelpFormatter, "allow_abbrev": False, "add_help": False, **options}
        super().__init__(**options)
        self._help_group = self.add_argument_group("help")
        self._help_group.add_argument("-h", "--help", action="help", help="this text")

    def add_version(self) -> None:
        """Add ``--version``, read only when it is asked for."""
        self._help_group.add_argument("--version", action=_Version, nargs=0, help="the version of kalux")

    def add_help_flag(self, flag: str, action: type[argparse.Action], text: str) -> None:
        """Add a flag that prints something else than `--help` does."""
        self._help_group.add_argument(flag, action=action, nargs=0, help=text)

    def format_help(self) -> str:
        """The help, with the flags that print help last."""
        self._action_groups.sort(key=lambda group: group is self._help_group)
        return super().format_help()

    def error(self, message: str) -> Never:
        """Raise `UsageError`."""
        hint = f"{self.prog} --help lists what is possible"
        raise UsageError(f"{plainer(message)}; {hint}")

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        """Parse; an unknown flag is an error that names the nearest known one."""
        options, unknown = self.parse_known_args(args, namespace)
        if unknown:
            parser = self._command_parser(getattr(options, "command", None))
            parser = parser._command_parser(getattr(options, "subcommand", None))
            parser.error(_unknown(unknown[0], list(parser._option_string_actions)))
        return options

    def _command_parser(self, command: str | None) -> Parser:
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction) and command in action.choices:
                return action.choices[command]  # type: ignore[no-any-return]
        return self

    def add_commands(self, commands: Any, dest: str) -> None:
        """Add commands below this one: modules with ``add_command``; which was chosen goes to ``dest``."""
        parsers = self.add_subparsers(dest=dest, prog=self.prog, parser_class=Parser)
        for command in commands:
            command.add_command(parsers)


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Help with room for the flags."""

    def __init__(self, prog: str, **options: Any) -> None:
        super().__init__(prog, max_help_position=28, width=100, **options)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        """Paragraphs wrapped, indented lines (examples, tables) as they are."""
        lines: list[str] = []
        for indented, group in groupby(text.splitlines(), key=lambda line: line[:1] in ("", " ")):
            part = [*group]
            lines += part if indented else textwrap.wrap(" ".join(part), width)
        return "".join(f"{indent}{line}".rstrip() + "\n" for line in lines)

    def _metavar_formatter(
        self, action: argparse.Action, default_metavar: str
    ) -> Callable[[int], tuple[str, ...]]:
        if action.metavar is None and action.choices is not None:
            return lambda size: ("|".join(str(choice) for choice in action.choices or ()),) * size
        return super()._metavar_formatter(action, default_metavar)

    def add_argument(self, action: argparse.Action) -> None:
        """Add an argument's help; the commands are in the description already."""
        if not isinstance(action, argparse._SubParsersAction):
            super().add_argument(action)


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *unused: Any) -> None:
        from kalux import __version__

        say(f"kalux {__version__}")
        parser.exit()


def normalised(arguments: Sequence[str]) -> list[str]:
    """Arguments with dashes in flags, so that ``--camera.log_offset`` is understood, too.

    Raises
    ------
    UsageError
        If one is empty, which as a path would mean the current folder.
    """
    if "" in arguments:
        raise UsageError("an argument is empty; is a variable of the shell not set?")
    return [_normalised(argument) for argument in arguments]


def _normalised(argument: str) -> str:
    if not argument.startswith("--"):
        return argument
    flag, equals, value = argument.partition("=")
    return flag.replace("_", "-") + equals + value


def plainer(message: str) -> str:
    """The messages of `argparse` in plainer words."""
    message = re.sub(r"^argument ([^:]+): ", lambda match: f"{match[1]}: ", message)
    message = message.replace("the following arguments are required:", "still needed:")
    message = re.sub(r"invalid choice: '([^']*)' \(choose from (.*)\)", _no_such_choice, message)
    return re.sub(r"invalid ([\w ]+) value: (.*)", r"\2 is not \1", message)


def _no_such_choice(found: re.Match[str]) -> str:
    known = [choice.strip(" '") for choice in found[2].split(",")]
    return f"there is no {found[1]!r}{did_you_mean(found[1], known)} (choose from {', '.join(known)})"


_ELSEWHERE: Final = {"--fps": "--rate", "--output": "--out", "-q": "--quiet", "-j": "--threads"}
"""What other programs call some flags."""


def _unknown(argument: str, known: list[str]) -> str:
    flag = argument.partition("=")[0]
    if not flag.startswith("-"):
        return f"{argument}: one argument too many"
    meant = _ELSEWHERE.get(flag)
    hint = f", did you mean {meant}?" if meant in known else did_you_mean(flag, known)
    return f"unknown flag {flag}{hint}"


# Types of arguments: their names stand in messages ("'x' is not a number").


def number(text: str) -> float:
    """A float."""
    return float(text)


def whole(text: str) -> int:
    """An int."""
    return int(text)


def true_or_false(text: str) -> bool:
    """A bool, as in TOML, or yes and no."""
    try:
        return {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}[
            text.lower()
        ]
    except KeyError:
        raise ValueError(text) from None


number.__name__, whole.__name__, true_or_false.__name__ = "a number", "a whole number", "true or false"
