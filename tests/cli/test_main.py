"""The command line as a whole: help, exit codes, one line per error, pipes."""

from __future__ import annotations

import contextlib
import errno
import gc
import io
import os
import resource
import signal
import subprocess
import sys
import threading
import time

import numba
import pytest

import kalux
from kalux.cli.app import COMMANDS, _imported
from kalux.cli.flags import setting_flags
from kalux.cli.progress import Progress
from kalux.cli.signals import termination_as_interrupt
from kalux.cli.terminal import say
from kalux.errors import OutputError
from kalux.settings import Settings, to_dict


@pytest.mark.parametrize("command", [[], ["info"], ["reconstruct"], ["convert"], ["evaluate"], ["demo"]])
def test_help_has_examples_and_fits_a_screen(cli, command):
    found = cli(*command, "--help")
    assert (found.code, found.err) == (0, "")
    assert "examples:\n  kalux " in found.out
    assert len(found.out.splitlines()) < 60
    assert max(map(len, found.out.splitlines())) <= 110


def test_garbage_is_collected_again_after_imports(monkeypatch):
    monkeypatch.delitem(sys.modules, "this", raising=False)
    with contextlib.redirect_stdout(io.StringIO()):
        assert _imported("this") is sys.modules["this"]
    assert gc.isenabled()
    with pytest.raises(ModuleNotFoundError):
        _imported("kalux.cli.nothing")
    assert gc.isenabled()


def test_help_names_every_command(cli):
    found = cli("--help").out
    for command in ("info", "reconstruct", "convert", "evaluate", "demo"):
        assert f"\n  {command} " in found


def test_every_setting_is_a_flag_with_its_default_and_text(cli):
    text = cli("reconstruct", "--help-settings").out
    flags = list(setting_flags())
    assert {flag.key for flag in flags} >= {f"{g}.{n}" for g, v in to_dict(Settings()).items() for n in v}
    for flag in flags:
        assert f"\n  {flag.name} " in text
        assert flag.text, f"{flag.key} is not explained in its docstring"


def test_what_can_be_estimated_may_be_left_to_that(cli, recording, tmp_path):
    """``auto``, as in TOML: over a settings file that says otherwise."""
    assert "--camera.log-offset NUMBER  (default auto)" in cli("reconstruct", "--help-settings").out
    (tmp_path / "fixed.toml").write_text("[camera]\nlog_offset = 0.25\n")
    arguments = [
        "reconstruct",
        recording,
        "-o",
        tmp_path / "out",
        "--settings",
        tmp_path / "fixed.toml",
        "--quiet",
    ]
    assert cli(*arguments, "--camera.log-offset", "auto", "--rate", "10").code == 0
    assert "log_offset = 0.25" not in (tmp_path / "out" / "kalux.toml").read_text()
    assert "'auto' is not a number" in cli(*arguments, "--events.trail", "auto").error
    assert "'x' is not a number or auto" in cli(*arguments, "--camera.log-offset", "x").error


def test_version(cli):
    assert cli("--version").out == f"kalux {kalux.__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "no command"),
        (["reconstrct"], "'reconstrct', did you mean reconstruct?"),
        (["--fast"], "--fast"),
        (["info"], "still needed: REC"),
        (["info", "x", "--exposre", "3"], "did you mean --exposure?"),
        (["reconstruct", "x"], "still needed: -o"),
        (["reconstruct", "x", "-o", "y", "--fps", "30"], "did you mean --rate?"),
    ],
)
def test_usage_errors_are_one_line(cli, arguments, told):
    found = cli(*arguments)
    assert found.code == 2
    assert told in found.error
    assert "--help" in found.error


def test_an_empty_argument_is_not_the_current_folder(cli):
    """What a shell makes of a variable that is not set."""
    found = cli("reconstruct", "x", "-o", "")
    assert found.code == 2
    assert "an argument is empty" in found.error


def test_an_error_of_ours_shows_the_traceback_and_asks_for_a_report(cli, recording, monkeypatch):
    def broken(options):
        raise ZeroDivisionError("ours")

    monkeypatch.setattr("kalux.cli.info.open_recording", broken)
    found = cli("info", recording)
    assert found.code == 1
    assert found.err.startswith("Traceback")
    assert "please report" in found.err.splitlines()[-1]


@pytest.mark.parametrize(
    "arguments",
    [
        ("info", "REC", "--frames", "LONG"),
        ("reconstruct", "LONG", "-o", "out"),
        ("benchmark", "LONG", "-o", "out"),
        ("simulate", "LONG", "-o", "out.h5"),
    ],
)
def test_what_the_system_refuses_is_told_with_the_name(cli, recording, arguments):
    """A name that is longer than it allows."""
    found = cli(*({"REC": recording, "LONG": "x" * 300}.get(word, word) for word in arguments))
    assert found.code == 2
    assert "xxx: " in found.error
    assert "File name too long" in found.error


HEAVY = {"numpy", "numba", "cv2", "h5py", "scipy", "av", "skimage", "OpenEXR", "kalux.writers"}


def modules_after(code):
    env = {**os.environ, "PYTHONPATH": os.path.dirname(os.path.dirname(kalux.__file__))}
    code = f"import sys; {code}; print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    return set(done.stderr.split())


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["calibrate", "--help"], ["nothing"]])
def test_help_starts_without_heavy_libraries(arguments):
    modules = modules_after(f"from kalux.cli import main; main({arguments})")
    assert "kalux.cli.app" in modules
    assert not (HEAVY - ({"numpy"} if "calibrate" in arguments else set())) & modules


def test_every_command_has_a_module_and_its_own_help(cli):
    for command in COMMANDS:
        found = cli(command, "--help")
        assert (found.code, found.err) == (0, "")
        assert f"kalux {command}" in found.out


def test_a_reader_that_goes_away_is_no_error(start_cli):
    process = start_cli("reconstruct", "--help-settings")
    process.stdout.close()
    assert process.wait(timeout=30) == 0
    assert process.stderr.read() == ""
    process.stderr.close()


def test_work_goes_on_when_nobody_reads_what_is_said(start_cli, recording, tmp_path):
    process = start_cli("reconstruct", recording, "-o", tmp_path / "out", "--at", "frames")
    process.stdout.close()
    assert process.wait(timeout=60) == 0
    assert process.stderr.read() == ""
    process.stderr.close()
    assert "complete = true" in (tmp_path / "out" / "kalux.toml").read_text()


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&- <&-"])
def test_closed_streams_are_no_error(recording, tmp_path, closed):
    env = {**os.environ, "PYTHONPATH": os.path.dirname(os.path.dirname(kalux.__file__))}
    command = f'exec "$0" -m kalux reconstruct "$1" -o "$2" --at frames --format npy {closed}'
    done = subprocess.run(
        ["sh", "-c", command, sys.executable, recording, tmp_path / "out"],
        env=env,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "complete = true" in (tmp_path / "out" / "kalux.toml").read_text()


def info_apart(recording, variables, **options):
    """`kalux info` in a process of its own, with some variables of the environment set."""
    command = [sys.executable, "-m", "kalux", "info", str(recording)]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    return subprocess.run(command, env={**os.environ, **variables}, text=True, check=False, **streams)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no /dev/full")
def test_standard_output_that_is_full_is_told(recording):
    package = os.path.dirname(os.path.dirname(kalux.__file__))
    with open("/dev/full", "w") as full:
        done = info_apart(recording, {"PYTHONPATH": package}, stdout=full)
    assert done.returncode == 2
    assert done.stderr == "kalux: error: standard output: No space left on device\n"


@pytest.mark.skipif(
    not hasattr(numba.config, "CACHE_LOCATOR_CLASSES"), reason="this numba always tries all its folders"
)
def test_a_folder_for_compiled_loops_that_cannot_be_written_is_one_line(recording, tmp_path):
    """It was a traceback, as of a mistake in kalux, where neither that folder nor the one of kalux can be written."""
    (tmp_path / "file").write_text("not a folder")
    place = str(tmp_path / "file" / "loops")
    # Without numba's other folders, which root can write to whatever their permissions.
    only = {"NUMBA_CACHE_DIR": place, "NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"}
    done = info_apart(recording, only)
    assert done.returncode == 2
    assert done.stderr == (
        f"kalux: error: {place}: compiled loops cannot be kept: neither this folder nor that of kalux can be written; "
        "name another one in NUMBA_CACHE_DIR\n"
    )


def test_no_room_for_compiled_loops_is_one_line(recording, tmp_path):
    done = info_apart(
        recording,
        {"NUMBA_CACHE_DIR": str(tmp_path / "loops")},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000)),
    )
    assert done.returncode == 2
    assert done.stderr == (
        f"kalux: error: {tmp_path / 'loops'}: compiled loops cannot be kept ([Errno 27] File too large); make room "
        "there, or name another folder in NUMBA_CACHE_DIR\n"
    )


@pytest.mark.parametrize("twice", [False, True])
def test_an_interrupt_within_numba_is_an_interrupt(cli, recording, monkeypatch, twice):
    def interrupted(*arguments, **options):
        inner = SystemError("returned a result with an exception set")
        inner.__cause__ = KeyboardInterrupt()
        raise SystemError("returned a result with an exception set") from (
            inner if twice else inner.__cause__
        )

    monkeypatch.setattr(kalux, "open", interrupted)
    found = cli("info", recording)
    assert (found.code, found.err) == (130, "kalux: interrupted; what is finished is whole\n")


def test_an_interrupt_that_a_library_loses_is_told_as_one_when_it_fails(cli, recording, monkeypatch):
    """As numba does, where LLVM asks for a loop: it is printed, and `no compiled object` follows."""

    class Lost:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    def interrupted(*arguments, **options):
        Lost()
        raise RuntimeError("no compiled object yet")

    monkeypatch.setattr(kalux, "open", interrupted)
    found = cli("info", recording)
    assert (found.code, found.err) == (130, "kalux: interrupted; what is finished is whole\n")


def test_an_interrupt_waits_for_an_import_that_would_lose_it(monkeypatch, tmp_path):
    (tmp_path / "swallowing.py").write_text(
        "import signal\ntry:\n    signal.raise_signal(signal.SIGINT)\nexcept:\n    lost = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        _imported("swallowing")
    assert not hasattr(sys.modules.pop("swallowing"), "lost")


class DeadTerminal(io.StringIO):
    """As a terminal that was closed."""

    def isatty(self):
        return True

    def fileno(self):
        return self.number

    def write(self, text=""):
        raise OSError(errno.EIO, "Input/output error")

    flush = write


def test_the_work_goes_on_where_the_terminal_was_closed(monkeypatch, tmp_path):
    """Ignored SIGHUP, as of a shell's ``disown``, is followed by errors of writing."""
    monkeypatch.setenv("TERM", "xterm")
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, DeadTerminal())
    with open(os.devnull) as device, open(tmp_path / "full", "w") as file:
        sys.stdout.number = device.fileno()
        say("one")
        with Progress("working", images=2) as shown:
            shown.add(images=1)
        sys.stdout.number = file.fileno()
        with pytest.raises(OutputError, match="Input/output error"):
            say("two")


class TestSignals:
    def test_termination_is_an_interrupt_even_where_interrupts_are_ignored(self):
        previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            with termination_as_interrupt():
                os.kill(os.getpid(), signal.SIGINT)  # ignored
                with pytest.raises(KeyboardInterrupt):
                    os.kill(os.getpid(), signal.SIGTERM)
            assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
        finally:
            signal.signal(signal.SIGINT, previous)

    def test_a_closed_terminal_is_an_interrupt_unless_it_is_ignored(self):
        before = signal.getsignal(signal.SIGHUP)
        try:
            signal.signal(signal.SIGHUP, signal.SIG_DFL)
            with termination_as_interrupt(), pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL
            signal.signal(signal.SIGHUP, signal.SIG_IGN)  # nohup
            with termination_as_interrupt():
                os.kill(os.getpid(), signal.SIGHUP)
        finally:
            signal.signal(signal.SIGHUP, before)

    def test_handlers_are_put_back(self):
        before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
        with termination_as_interrupt():
            assert signal.getsignal(signal.SIGTERM) != before[0]
        assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before

    def test_an_interrupt_while_an_object_is_collected_comes_again(self):
        class Collected:
            def __del__(self):
                signal.raise_signal(signal.SIGINT)

        def work():
            Collected()
            for _ in range(500):
                time.sleep(0.01)

        with termination_as_interrupt(), pytest.raises(KeyboardInterrupt):
            work()

    def test_other_threads_have_no_signals(self):
        done = []

        def work():
            with termination_as_interrupt():
                done.append(True)

        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
        assert done
