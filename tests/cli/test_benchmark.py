"""``kalux benchmark``: resumes, tells what failed and what is missing, writes its files."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import time

import pytest

import kalux
from kalux.evaluation.benchmark import jobs, runners

FILES = ("results.csv", "results.json", "results.tex", "report.html")


@pytest.fixture
def folder(tmp_path, recording):
    """A folder with two recordings."""
    folder = tmp_path / "set"
    folder.mkdir()
    for name in ("a.h5", "b.h5"):
        shutil.copy(recording, folder / name)
    return folder


def test_it_writes_a_table_and_a_report_and_does_nothing_twice(cli, ran, folder, tmp_path):
    out = tmp_path / "out"
    arguments = ("benchmark", folder, "--methods", "hold,cf", "-o", out)
    first = cli(*arguments)
    assert first.code == 0, first.err
    assert ran == ["a/hold", "a/cf", "b/hold", "b/cf"]
    assert "4/4 b/cf" in first.err
    rows = [line.split() for line in first.out.splitlines()]
    assert [row[0] for row in rows[1:5]] == ["a", "a", "b", "b"]
    contents = [(out / name).read_bytes() for name in FILES]
    assert all(contents)
    again = cli(*arguments)
    assert len(ran) == 4
    assert "4 of 4 jobs are done already" in again.err
    assert again.out == first.out
    assert [(out / name).read_bytes() for name in FILES] == contents
    more = cli("benchmark", folder, "--methods", "hold,mean,cf", "-o", out, "--quiet")
    assert ran[4:] == ["a/mean", "b/mean"]
    assert more.err == ""
    cli(*arguments, "--overwrite")
    assert ran[6:] == ["a/hold", "a/cf", "b/hold", "b/cf"]


def test_what_has_changed_is_done_again(cli, ran, folder, tmp_path):
    arguments = ("benchmark", folder, "--methods", "hold", "-o", tmp_path / "out")
    cli(*arguments)
    os.utime(folder / "b.h5", ns=(5, 5))
    cli(*arguments)
    assert ran == ["a/hold", "b/hold", "b/hold"]


def test_what_another_kalux_has_done_is_done_again_with_a_line(cli, ran, folder, tmp_path, monkeypatch):
    """Versions in development have one number: the code tells them apart."""
    out = tmp_path / "out"
    arguments = ("benchmark", folder, "--methods", "hold,cf", "-o", out)
    cli(*arguments)
    monkeypatch.setattr(jobs, "code_digest", lambda: "other")
    again = cli(*arguments)
    assert ran == 2 * ["a/hold", "a/cf", "b/hold", "b/cf"]
    told = f"4 jobs in {out} were done by another version or other code of kalux ({kalux.__version__})"
    assert f"kalux: {told}, and are done again" in again.err
    assert "another version" not in cli(*arguments).err
    assert len(ran) == 8


def test_a_failed_job_is_told_and_tried_again_and_the_others_are_done(cli, ran, folder, tmp_path):
    good = (folder / "b.h5").read_bytes()
    (folder / "b.h5").write_bytes(good[: len(good) // 2])
    out = tmp_path / "out"
    arguments = ("benchmark", folder / "a.h5", folder / "b.h5", "--methods", "hold,cf", "-o", out)
    found = cli(*arguments, "--quiet")
    assert found.code == 2
    assert "2 of 4 jobs failed: b/hold, b/cf" in found.error
    assert "b.h5" in found.error
    assert {row["sequence"] for row in csv.DictReader((out / "results.csv").open())} == {"a"}
    assert len(json.loads((out / "results.json").read_text())["failures"]) == 2
    assert "failed" in (out / "report.html").read_text()
    (folder / "b.h5").write_bytes(good)
    assert cli(*arguments).code == 0
    assert ran[-2:] == ["b/hold", "b/cf"]
    assert json.loads((out / "results.json").read_text())["failures"] == []


def test_where_all_jobs_failed_there_are_no_others(cli, ran, tmp_path):
    """A mistyped name was said to have left results of other jobs in the folder, where there are none."""
    found = cli("benchmark", tmp_path / "none.h5", "--methods", "hold", "-o", tmp_path / "out", "--quiet")
    assert found.code == 2
    assert "1 of 1 jobs failed: none/hold; the same command tries again. none/hold: " in found.error


def test_an_error_of_kalux_itself_is_one(cli, ran, folder, tmp_path, monkeypatch):
    def broken(job):
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(jobs, "_run", broken)
    found = cli("benchmark", folder / "a.h5", "--methods", "hold", "-o", tmp_path / "out")
    assert found.code == 1
    assert "a/hold: ZeroDivisionError inside kalux: oh" in found.err


def test_an_interrupt_keeps_what_is_done_and_says_what_is_missing(cli, ran, folder, tmp_path, monkeypatch):
    def interrupted(given, processes):
        for number, done in enumerate(runners.here(given)):
            if number == 2:
                raise KeyboardInterrupt
            yield done

    out = tmp_path / "out"
    arguments = ("benchmark", folder, "--methods", "hold,cf", "-o", out)
    with monkeypatch.context() as patch:
        patch.setattr(runners, "in_processes", interrupted)
        found = cli(*arguments)
    assert found.code == 130
    assert "2 of 4 jobs are finished and kept" in found.err
    assert "missing: b/hold, b/cf; the same command goes on" in found.err
    assert not (out / "results.csv").exists()
    assert cli(*arguments).code == 0
    assert ran == ["b/hold", "b/cf"]


def test_ctrl_c_ends_the_processes_and_leaves_whole_files(start_cli, folder, tmp_path):
    out = tmp_path / "out"
    names = "hold,mean,edi,cf,iccv2021,default,smooth"
    running = start_cli(
        "benchmark", folder, "--methods", names, "-o", out, "--processes", "1", start_new_session=True
    )
    deadline = time.monotonic() + 90
    while not list(out.glob("jobs/*/*.json")) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(running.pid, signal.SIGINT)
    _, err = running.communicate(timeout=30)
    assert running.returncode == 130, err
    assert "jobs are finished and kept in" in err
    assert "Traceback" not in err
    for path in out.glob("jobs/*/*.json"):
        assert json.loads(path.read_text())["key"]


def test_a_toml_file_says_it_all(cli, ran, folder, tmp_path):
    path = folder / "bench.toml"
    path.write_text('title = "Mine"\nmethods = ["hold"]\n[[sequence]]\npath = "a.h5"\nname = "pan"\n')
    out = tmp_path / "out"
    assert cli("benchmark", path, "-o", out).code == 0
    assert ran == ["pan/hold"]
    assert "<h1>Mine</h1>" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--methods", "e3vid"], "no method 'e3vid'"),
        (["--methods", ","], "--methods ,: names no method"),
        (["--hold-out-frames", "0"], "every is 0; at least 2"),
        (["--processes", "0"], "at least 1"),
        (["--stamp", "end"], "give --exposure, too"),
        (["--processes", "2", "--dask", "tcp://x"], "not allowed with"),
        (["missing.h5"], "missing.h5"),
    ],
)
def test_errors_are_one_line_and_come_before_the_work(cli, ran, recording, tmp_path, arguments, told):
    found = cli("benchmark", recording, "-o", tmp_path / "out", *arguments)
    assert found.code == 2
    assert told in found.err
    assert ran == []


def test_a_folder_of_something_else_is_left_alone(cli, recording, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    assert "not of a benchmark" in cli("benchmark", recording, "-o", tmp_path).error
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_results_do_not_lie_in_what_is_read(cli, ran, recording, tmp_path):
    """Each run would change what all jobs depend on."""
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "events.txt").write_text("0.000001 3 4 1\n")
    (folder / "images.txt").write_text("")
    (folder / "timestamps.csv").write_text("t_us,file\n1,0.npy\n")
    (folder / "0.npy").write_text("")
    for arguments in ((folder, "--methods", "hold"), (recording, "--methods", f"hold,{{sequence}}={folder}")):
        found = cli("benchmark", *arguments, "-o", folder / "results")
        assert (found.code, f"lies in {folder}, an input" in found.error) == (2, True), found.err
    assert not (folder / "results").exists()
    assert ran == []


def test_without_dask_the_extra_is_named(cli, recording, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    found = cli("benchmark", recording, "-o", tmp_path / "out", "--dask", "tcp://x", "--methods", "hold")
    assert found.code == 2
    assert "kalux[dask]" in found.error
