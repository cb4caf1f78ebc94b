"""`main`: runs a command and turns whatever happens into an exit code and, at most, one line."""

from __future__ import annotations

import gc
import importlib
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from types import ModuleType

from kalux.cli.parser import Parser, UsageError, normalised
from kalux.cli.signals import termination_as_interrupt
from kalux.cli.terminal import close_output, error_line, hold_closed_streams
from kalux.errors import InternalError, KaluxError
from kalux.interrupts import interrupts_held
from kalux.kernel_cache import VARIABLE, check_variables
from kalux.wording import one_line

DONE, BUG, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130

COMMANDS = (
    "info",
    "reconstruct",
    "convert",
    "register",
    "calibrate",
    "evaluate",
    "benchmark",
    "simulate",
    "demo",
    "ahdr",
    "hdr-reference",
    "datasets",
)
"""The commands, in the order of the help; each has a module of its name."""

_DESCRIPTION = """\
HDR video with per-pixel uncertainty from cameras that give events and frames.

commands:
  info           what is in a recording, and what kalux would use of it
  reconstruct    make images or a video from a recording
  convert        copy a recording of any format into one file, kalux HDF5 or AEDAT 4
  register       make one recording of an event camera's events and another camera's frames
  calibrate      measure cameras: thresholds, noise, response, two-camera rigs, clock offsets
  evaluate       compare methods with ground truth, or with frames held out
  benchmark      the same for many recordings, with a report
  simulate       make a recording with ground truth from an HDR photograph, images or a video
  demo           simulate a scene, reconstruct it, and compare with the truth
  ahdr           a recording with frames clipped on purpose, the originals as truth
  hdr-reference  radiance from bracketed exposures, and ground truth from it
  datasets       published sets: licence, page, layout; checks a folder

kalux COMMAND --help says more."""

_EXAMPLES = """\
examples:
  kalux demo
  kalux info night_drive.aedat4
  kalux reconstruct night_drive.aedat4 -o night.mp4
  kalux reconstruct night_drive.aedat4 -o night/ --format exr --rate 300"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    argv
        Arguments without the program's name. Default: those of the process.

    Returns
    -------
    int
        0 done, 1 an error in kalux, 2 bad input or usage, 130 interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # of a damaged image kalux says it, in its line
    # Its products are small: a second thread would only wait, busily.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    hold_closed_streams()
    try:
        with termination_as_interrupt() as was_interrupted:
            return _guarded(arguments, was_interrupted)
    finally:
        close_output()


def _guarded(arguments: list[str], was_interrupted: Callable[[], bool]) -> int:
    try:
        return _run(arguments)
    except KeyboardInterrupt as interrupt:
        error_line("interrupted", *(_notes(interrupt) or ["nothing was written"]))
        return INTERRUPTED
    except Exception as error:
        if was_interrupted() or _is_interrupt(error):
            error_line("interrupted", *(_notes(error) or ["what is finished is whole"]))
            return INTERRUPTED
        return _failed(error)


def _failed(error: Exception) -> int:
    if _keeps_a_loop(error) or _keeps_a_loop(error.__cause__):
        place = os.environ.get(VARIABLE) or importlib.import_module("kalux").__path__[0]
        reason = one_line(error.__cause__ or error)
        error_line(
            f"error: {place}: compiled loops cannot be kept ({reason}); make room there, or name another folder in "
            f"{VARIABLE}"
        )
        return BAD_INPUT
    if _finds_no_folder(error):
        error_line(
            f"error: {os.environ.get(VARIABLE)}: compiled loops cannot be kept: neither this folder nor that of kalux "
            f"can be written; name another one in {VARIABLE}"
        )
        return BAD_INPUT
    if isinstance(error, KaluxError):
        error_line(f"error: {error}", *_notes(error))
        return BUG if isinstance(error, InternalError) else BAD_INPUT
    if isinstance(error, OSError) and error.filename is not None:
        error_line(f"error: {error.filename}: {error.strerror or error}", *_notes(error))
        return BAD_INPUT
    return _bug(error)


def _keeps_a_loop(error: BaseException | None) -> bool:
    """Whether the system refused to keep what numba has compiled, e.g. on a full disk."""
    if not isinstance(error, OSError):
        return False
    frames = traceback.walk_tb(error.__traceback__)
    return any(frame.f_globals.get("__name__") == "numba.core.caching" for frame, _ in frames)


def _finds_no_folder(error: Exception) -> bool:
    """Whether numba can write to none of its folders, one of them named by the user: else `check_variables` says so."""
    return isinstance(error, RuntimeError) and "no locator available" in str(error) and VARIABLE in os.environ


def _bug(error: Exception) -> int:
    traceback.print_exception(error)
    error_line(
        f"error: {type(error).__name__} inside kalux; this is an error in kalux, please report it with the "
        "lines above and the command"
    )
    return BUG


def _is_interrupt(error: BaseException) -> bool:
    """Whether Ctrl-C came while numba loaded a compiled loop: it becomes the cause of a SystemError, or of two."""
    cause: BaseException | None = error
    while isinstance(cause, SystemError):
        cause = cause.__cause__
    return cause is not error and isinstance(cause, KeyboardInterrupt)


def _notes(error: BaseException) -> list[str]:
    return list(getattr(error, "__notes__", []))


def _run(arguments: list[str]) -> int:
    command = next((word for word in arguments if word in COMMANDS), None)
    if command is not None:
        check_variables()  # the command's flags are made with what imports numba
    parser = make_parser(command)
    try:
        options = parser.parse_args(normalised(arguments))
    except SystemExit as done:  # --help and --version have printed what was asked for
        return int(done.code or 0)
    if options.command is None:
        raise UsageError("no command is given; kalux --help lists them, kalux demo shows what kalux does")
    options.run(options, ["kalux", *arguments])
    return DONE


def make_parser(command: str | None = None) -> Parser:
    """The parser with the flags of one command; of the others it knows the names, which need no imports."""
    parser = Parser(prog="kalux", description=_DESCRIPTION, epilog=_EXAMPLES, usage="kalux COMMAND ...")
    parser.add_version()
    commands = parser.add_subparsers(dest="command", prog="kalux", parser_class=Parser)
    for name in COMMANDS:
        if name == command:
            _imported(f"kalux.cli.{name.replace('-', '_')}").add_command(commands)
        else:
            commands.add_parser(name)
    return parser


def _imported(name: str) -> ModuleType:
    """A module. What imports make stays: looking for garbage in it takes 0.1 s of 0.5, and later as long again."""
    if name in sys.modules:
        return sys.modules[name]
    collects = gc.isenabled()
    gc.disable()
    try:
        with interrupts_held():  # what is being imported may lose an interrupt, or turn it into another error
            return importlib.import_module(name)
    finally:
        gc.freeze()
        if collects:
            gc.enable()
