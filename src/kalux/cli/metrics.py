"""``--methods``, ``--hdrvdp`` and ``--lpips``: what `kalux evaluate` and `kalux benchmark` compute."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kalux.cli.parser import UsageError

if TYPE_CHECKING:
    from kalux.evaluation.lpips import LpipsWeights


def add_metrics(group: Any) -> None:
    """Add the flags to a group of a parser."""
    group.add_argument("--methods", metavar="A,B", help="names, in this order, with commas")
    group.add_argument("--hdrvdp", action="store_true", help="HDR-VDP's Q as well, 0.2 s per VGA image")
    group.add_argument(
        "--lpips",
        metavar="WEIGHTS",
        help="LPIPS as well: file of AlexNet's weights, and after a comma that of LPIPS v0.1 (default: of the "
        "package lpips); needs kalux[learned]",
    )


def named_methods(options: argparse.Namespace) -> list[str] | None:
    """The names that were given; None without.

    Raises
    ------
    UsageError
        If there is none between the commas.
    """
    if options.methods is None:
        return None
    names = [name.strip() for name in options.methods.split(",") if name.strip()]
    if not names:
        raise UsageError(
            f"--methods {options.methods}: names no method; give names with commas, or no --methods"
        )
    return names


def lpips_files(options: argparse.Namespace) -> tuple[Path, ...]:
    """The files of weights that were given; empty without.

    Raises
    ------
    UsageError
        If there are more than two, or one is empty.
    """
    if options.lpips is None:
        return ()
    files = tuple(name.strip() for name in options.lpips.split(","))
    if not all(files) or len(files) > 2:
        raise UsageError(
            f"--lpips {options.lpips}: a file is needed, or two with a comma: AlexNet's, LPIPS's"
        )
    return tuple(Path(name) for name in files)


def lpips_weights(options: argparse.Namespace) -> LpipsWeights | None:
    """The weights that were given, loaded; None without.

    Raises
    ------
    KaluxError
        As of `kalux.evaluation.lpips.load_lpips`.
    """
    from kalux.evaluation.lpips import load_lpips

    files = lpips_files(options)
    return load_lpips(*files) if files else None
