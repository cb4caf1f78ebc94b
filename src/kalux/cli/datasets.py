"""``kalux datasets``: published sets, and whether a folder holds one as it was published."""

from __future__ import annotations

import argparse
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from kalux.cli.parser import Parser, UsageError
from kalux.cli.terminal import say
from kalux.errors import InputError
from kalux.wording import how_many

if TYPE_CHECKING:
    from kalux.datasets.published import PublishedSet, SequenceCheck

_DESCRIPTION = """\
List the published sets of recordings that kalux knows: licence, page, layout, and what kalux reads of them.
Nothing is downloaded. `kalux datasets check NAME FOLDER` opens every sequence in a folder as downloaded, and
tells what is missing, damaged, or does not belong to it."""

_EXAMPLES = """\
examples:
  kalux datasets
  kalux datasets hqf
  kalux datasets check ijrr ~/data/davis240c"""

_SHOWN: Final = 20  # names of files in a list, at most


def add_command(commands: Any) -> None:
    """Add ``datasets`` to the parser."""
    parser: Parser = commands.add_parser(
        "datasets",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        usage="kalux datasets [NAME | check NAME FOLDER [--whole]]",
    )
    group = parser.add_argument_group("set")
    group.add_argument(
        "words", nargs="*", metavar="NAME | check NAME FOLDER", help="a set; or check a folder"
    )
    group.add_argument(
        "--whole", action="store_true", help="check: read all events and frames, not only the first"
    )
    group.add_argument("--quiet", action="store_true", help="check: no progress")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace, command: list[str]) -> None:
    """Run the command."""
    from kalux.datasets.published import SETS, published_set

    words = options.words
    if words[:1] == ["check"]:
        if len(words) != 3:
            raise UsageError("check needs the name of a set and a folder: kalux datasets check ijrr FOLDER")
        check(published_set(words[1]), Path(words[2]), whole=options.whole, quiet=options.quiet)
        return
    if len(words) > 1 or options.whole:
        raise UsageError("give one set, or: kalux datasets check NAME FOLDER")
    for one in SETS if not words else (published_set(words[0]),):
        say(described(one))


def described(one: PublishedSet) -> str:
    """A set in some lines."""
    lines = [f"{one.name}: {one.title}"]
    facts = (
        ("paper", one.source),
        ("page", one.page),
        ("licence", one.licence),
        ("layout", one.layout),
        ("kalux", f"reads {one.reads}"),
    )
    for label, text in facts:
        lines += textwrap.wrap(text, 100, initial_indent=f"  {label:<8} ", subsequent_indent=" " * 11)
    if one.sequences:
        text = f"{len(one.sequences)} sequences: {', '.join(one.sequences)}"
        lines += textwrap.wrap(text, 100, initial_indent=" " * 11, subsequent_indent=" " * 11)
    return "\n".join(lines)


def check(one: PublishedSet, folder: Path, *, whole: bool, quiet: bool) -> None:
    """Check a folder and say what is in it.

    Raises
    ------
    InputError
        There is no sequence, or one cannot be read.
    """
    from kalux.cli.progress import Progress
    from kalux.datasets.published import check_sequence, contents

    held = contents(one.name, folder)
    if not held.found:
        raise InputError(f"{folder}: no sequence of {one.name} is in it; expected is {one.layout}")
    bad = 0
    with Progress("checking", images=len(held.found), quiet=quiet) as progress:
        for name, path in held.found:
            found = check_sequence(name, path, held.incomplete.get(name, ()), whole=whole)
            say(row(found))
            bad += bool(found.error)
            progress.add(images=1)
    total = "" if not one.sequences else f" of {len(one.sequences)}"
    say(f"{len(held.found)}{total} sequences found, {bad} of them cannot be read")
    for title, names in (("not there", held.missing), ("not part of the set", held.unknown)):
        if names:
            more = f", and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
            say(f"{title}: {', '.join(names[:_SHOWN])}{more}")
    if bad:
        raise InputError(f"{folder}: {bad} of {len(held.found)} sequences cannot be read; see above")


def row(found: SequenceCheck) -> str:
    """A sequence in a line, and a line for everything that it lacks."""
    if found.error:
        lines = [f"{found.name}: {found.error}"]
    else:
        height, width = found.sensor_size or (0, 0)
        truth = f", {found.truth:,} of truth" if found.truth else ""
        held = f"{how_many(found.events, 'event')}, {how_many(found.frames, 'frame')}"
        lines = [f"{found.name}: {width}x{height}, {held}{truth}"]
    return "\n".join([*lines, *(f"  {text}" for text in found.lacks)])
