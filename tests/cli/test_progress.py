"""Progress: a bar on a terminal, lines elsewhere, nothing when quiet."""

from __future__ import annotations

import io
import sys

import pytest

from kalux.cli import progress
from kalux.cli.progress import Progress, clock, progress_text, short_number


def test_lines_where_there_is_no_terminal(capsys, monkeypatch):
    monkeypatch.setattr(progress, "LINE_EVERY", 0.0)
    with Progress("reconstructing", images=4) as shown:
        shown.add(events=1000)
        shown.add(images=1)
        shown.add(images=1)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("kalux: reconstructing: 0/4 images")
    assert lines[1].startswith("kalux: reconstructing: 1/4 images")
    assert not lines[1].endswith("left")  # the first one compiles
    assert lines[2].startswith("kalux: reconstructing: 2/4 images")
    assert lines[2].endswith("left")


def test_few_lines(capsys):
    with Progress("checking") as shown:
        for _ in range(1000):
            shown.add(events=1)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("images", [0, 3])
def test_a_bar_on_a_terminal(monkeypatch, images):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(progress, "BAR_EVERY", 0.0)
    monkeypatch.setenv("TERM", "xterm")
    with Progress("working", images=images) as shown:
        shown.add(images=1, events=5)
    assert "working" in terminal.getvalue()
    assert "events/s" in terminal.getvalue()


def test_quiet(capsys, monkeypatch):
    monkeypatch.setattr(progress, "LINE_EVERY", 0.0)
    with Progress("working", images=3, quiet=True) as shown:
        shown.add(images=1)
    assert capsys.readouterr().err == ""


def test_texts():
    assert progress_text(30, 120, 6_000_000, 0, 2.0) == "30/120 images, 15 images/s, 3M events/s, 0:06 left"
    started_slowly = progress_text(30, 120, 0, 0, 22.0, warm=(20.0, 1))
    assert started_slowly == "30/120 images, 1.36 images/s, 0:06 left"
    assert progress_text(0, 0, 5_000_000, 0, 2.0) == "5M events, 2.5M events/s"
    assert [short_number(n) for n in (0.5, 12, 999.9, 12_345, 1e9)] == ["0.5", "12", "1k", "12.3k", "1G"]
    assert (clock(5), clock(65), clock(3700)) == ("0:05", "1:05", "1:01:40")


@pytest.mark.parametrize(
    ("arguments", "titles"),
    [
        ("info REC", ["reading", "estimating"]),
        ("calibrate contrast REC", ["checking", "measuring thresholds"]),
        ("calibrate noise REC", ["checking", "measuring noise"]),
        ("ahdr REC -o OUT --cut 0.25", ["counting", "writing"]),
        ("reconstruct REC -o OUTDIR --smooth --at frames", ["checking", "backward pass", "reconstructing"]),
    ],
)
def test_commands_show_their_progress_from_the_start(
    cli, write_recording, tmp_path, monkeypatch, arguments, titles
):
    recording = write_recording(tmp_path / "rec.h5", contrast_threshold=None)
    monkeypatch.setattr(progress, "LINE_EVERY", 0.0)
    words = {"REC": recording, "OUT": tmp_path / "out.h5", "OUTDIR": tmp_path / "out"}
    found = cli(*[words.get(word, word) for word in arguments.split()])
    assert found.code == 0, found.err
    lines = [line.split(": ")[1] for line in found.err.splitlines() if "warning" not in line]
    assert list(dict.fromkeys(lines)) == titles


def test_no_quiet_command_shows_progress(cli, recording, monkeypatch):
    monkeypatch.setattr(progress, "LINE_EVERY", 0.0)
    assert cli("calibrate", "noise", recording, "--quiet").err == ""
