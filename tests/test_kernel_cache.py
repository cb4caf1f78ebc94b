"""Compiled loops find a place, however kalux is installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from kalux import kernel_cache
from kalux.cli.app import main
from kalux.errors import OutputError, SettingsError
from kalux.kernel_cache import VARIABLE, check_variables, ensure_writable


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A package that cannot be written, and no cache of the user yet."""
    package = tmp_path / "kalux"
    package.mkdir()
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("kalux.kernel_cache._is_writable", lambda package: False)
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    yield package
    os.environ.pop(VARIABLE, None)


def test_a_package_that_can_be_written_keeps_its_own(tmp_path, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    ensure_writable(tmp_path)
    assert VARIABLE not in os.environ


def test_what_the_user_says_stays(installed, monkeypatch):
    monkeypatch.setenv(VARIABLE, "/somewhere")
    ensure_writable(installed)
    assert os.environ[VARIABLE] == "/somewhere"


def test_else_it_is_the_cache_of_the_user(installed, tmp_path):
    import numba

    ensure_writable(installed)
    assert os.environ[VARIABLE] == str(tmp_path / "cache/kalux") == numba.config.CACHE_DIR
    assert (tmp_path / "cache/kalux").stat().st_mode & 0o777 == 0o700


def test_else_a_folder_for_this_process(installed, tmp_path, monkeypatch):
    ends = []
    monkeypatch.setattr(kernel_cache.atexit, "register", ends.append)
    (tmp_path / "cache").write_text("not a folder")
    ensure_writable(installed)
    place = Path(os.environ[VARIABLE])
    assert place.is_dir()
    ends[0]()
    assert not place.exists()


def test_where_there_is_no_folder_at_all_one_line_says_so(installed, tmp_path, monkeypatch, capsys):
    """`import kalux` itself needs none."""

    def none(**options):
        raise FileNotFoundError(2, "No usable temporary directory found")

    monkeypatch.setattr(kernel_cache.tempfile, "mkdtemp", none)
    (tmp_path / "cache").write_text("not a folder")
    ensure_writable(installed)
    assert VARIABLE not in os.environ
    with pytest.raises(OutputError, match=f"name a folder in {VARIABLE}"):
        check_variables()
    assert main(["info", "none.h5"]) == 2
    assert "compiled loops cannot be kept: " in capsys.readouterr().err


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="setpriv is not installed")
@pytest.mark.parametrize("home", ["writable", "read-only"])
def test_a_read_only_install_works(tmp_path, home):
    """A copy of the package without write permission (root would have it all the same, and gives it up)."""
    source = Path(kernel_cache.__file__).parent
    shutil.copytree(source, tmp_path / "src/kalux", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "home").mkdir()
    locked = [
        *(tmp_path / "src").rglob("*/"),
        tmp_path / "src",
        *([tmp_path / "home"] * (home == "read-only")),
    ]
    for folder in locked:
        folder.chmod(0o555) if folder.is_dir() else None
    limits = (
        [] if os.getuid() else ["setpriv", "--bounding-set", "-dac_override", "--inh-caps", "-dac_override"]
    )
    code = "from kalux.readers import table; import kalux.compiled, os; print(os.environ['NUMBA_CACHE_DIR'])"
    env = {k: v for k, v in os.environ.items() if k not in (VARIABLE, "XDG_CACHE_HOME")}
    env.update(PYTHONPATH=str(tmp_path / "src"), HOME=str(tmp_path / "home"), PYTHONDONTWRITEBYTECODE="1")
    try:
        done = subprocess.run(
            [*limits, sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False
        )
    finally:
        for folder in locked:
            folder.chmod(0o755) if folder.is_dir() else None
    if "Operation not permitted" in done.stderr:
        pytest.skip("root cannot give up its permissions here")
    assert done.returncode == 0, done.stderr
    place = Path(done.stdout.strip())
    assert (place == tmp_path / "home/.cache/kalux") == (home == "writable")
    assert place.exists() == (home == "writable")


@pytest.mark.parametrize(
    "said", ["NUMBA_NUM_THREADS=0", "NUMBA_NUM_THREADS=-3", "NUMBA_DISABLE_JIT=1", "NUMBA_DISABLE_JIT=2"]
)
def test_variables_with_which_nothing_runs_are_named(said, monkeypatch, capsys):
    monkeypatch.setenv(*said.split("="))
    with pytest.raises(SettingsError, match=f"{said}: .*unset it"):
        check_variables()
    assert main(["info", "none.h5"]) == 2
    assert said in capsys.readouterr().err
    assert main(["--version"]) == 0


@pytest.mark.parametrize("said", ["NUMBA_NUM_THREADS=1", "NUMBA_NUM_THREADS=", "NUMBA_DISABLE_JIT=0"])
def test_other_values_are_left_to_numba(said, monkeypatch):
    monkeypatch.setenv(*said.split("="))
    check_variables()


def test_without_compilation_the_library_says_so():
    process = subprocess.run(
        [sys.executable, "-c", "import kalux; kalux.reconstruct"],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.stderr.splitlines()[-1].startswith("kalux.errors.SettingsError: NUMBA_DISABLE_JIT=1")
