"""``kalux ahdr``: a file that ``kalux evaluate`` finds the truth in; errors."""

from __future__ import annotations

import dataclasses

import pytest

import kalux

from builders import passing_by, textured


def test_from_a_recording_to_scores(cli, recording, tmp_path):
    out = tmp_path / "a.h5"
    made = cli("ahdr", recording, "-o", out, "--cut-low", 10, "--cut-high", 120)
    assert made.code == 0, made.err
    assert "black up to 10 and white from 120 of 255" in made.out
    assert made.err == ""
    found = cli("evaluate", out, "--methods", "hold,default")
    assert found.out.splitlines()[0].startswith(f"{out}: ground truth: ")
    held, default = (float(line[26:].split()[0]) for line in found.out.splitlines()[2:4])
    assert default < held
    assert "s-curve" in kalux.open(out).response


def test_what_saturates_in_the_original_is_no_truth(cli, recording, tmp_path):
    out, found = tmp_path / "a.h5", {}
    for level in (250, 70):
        run = cli("ahdr", recording, "-o", out, "--cut-high", 60, "--saturation", level, "--overwrite")
        assert run.code == 0, run.err
        found[level] = kalux.open(out).ground_truth()
        assert ("of 100.0 % of pixels" in run.out) == (found[level].masks is None)
    assert (found[70].masks == (found[250].images * 60 < 69.99)).mean() > 0.999


@pytest.mark.parametrize(("white", "warned"), [(102, True), (255, False)])
def test_an_original_that_saturates_below_white_is_told(cli, tmp_path, write_recording, white, warned):
    original = passing_by(textured(1.2 if warned else 0.9), white)
    path = write_recording(
        tmp_path / "original.h5",
        sensor_size=original.sensor_size,
        events=list(original.events()),
        frames=list(original.frames()),
        contrast_threshold=None,
    )
    cut = "--cut-low", 5, "--cut-high", 0.7 * white, "--overwrite"
    found = cli("ahdr", path, "-o", tmp_path / "a.h5", *cut)
    assert ("where events go on" in found.err) == warned
    if warned:
        assert "the original frames end at 0.4, where" in found.err
        assert "--saturation 100 leaves that out" in found.err
        assert cli("ahdr", path, "-o", tmp_path / "a.h5", *cut, "--saturation", 100).err == ""


def test_held_out_frames(cli, recording, tmp_path):
    out = tmp_path / "a.h5"
    assert "4 of truth" in cli("ahdr", recording, "-o", out, "--cut", 60, "--hold-out-frames", "3").out
    assert len(kalux.open(out).frames()) == 8


def test_a_cut_that_leaves_no_highlights_is_told(cli, recording, tmp_path):
    found = cli("ahdr", recording, "-o", tmp_path / "a.h5", "--cut", 0, "--response", "gamma:0.2")
    assert found.code == 0
    assert ("no pixel of any frame is white" in found.err) == ("0.0 % of pixels white" in found.out)


def test_a_recording_that_is_all_black_is_not_written(cli, write_recording, simulation, tmp_path):
    """Nothing could be reconstructed of it, and the black of a camera is rarely above all that it has seen."""
    dim = [dataclasses.replace(f, image=f.image // 2) for f in simulation.frames]
    path = write_recording(tmp_path / "dim.h5", frames=dim)
    found = cli("ahdr", path, "-o", tmp_path / "a.h5", "--black", 250, "--quiet")
    assert found.code == 2
    assert "dim.h5: every pixel of every frame would be black; give a smaller --black" in found.error
    assert not (tmp_path / "a.h5").exists()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["-o", "x.mat"], "ends in .h5"),
        (["-o", "x.h5", "--cut", "128"], "leaves nothing"),
        (["-o", "x.h5", "--cut", "30", "--cut-low", "3"], "--cut-low and --cut-high"),
        (["-o", "x.h5", "--cut-low", "90", "--cut-high", "80"], "black < white"),
        (["-o", "x.h5", "--hold-out-frames", "1"], "at least 2"),
        (["-o", "x.h5", "--saturation", "80"], "the original saturates at 0.313725; more than"),
        (["-o", "x.h5", "--response", "film"], "unknown response"),
    ],
)
def test_errors_are_one_line(cli, recording, tmp_path, monkeypatch, arguments, told):
    monkeypatch.chdir(tmp_path)
    found = cli("ahdr", recording, *arguments)
    assert found.code == 2
    assert told in found.error
    assert list(tmp_path.iterdir()) == []
