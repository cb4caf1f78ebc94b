"""No command replaces what it reads, whatever may be overwritten."""

from __future__ import annotations

import os

import pytest

from kalux.cli.output import check_apart
from kalux.cli.parser import UsageError


@pytest.mark.parametrize(
    ("arguments", "names", "out"),
    [
        ("calibrate contrast IN -o REC.toml", ["REC.npz"], "REC.npz"),
        ("calibrate noise IN -o REC.toml", ["REC.npz"], "REC.npz"),
        ("calibrate response IN a2.png --times 1,2 -o c.toml --plot IN", ["a1.png"], "a1.png"),
        ("calibrate offset rec.h5 --frames IN --plot IN/0.png", ["frames", "frames/0.png"], "frames/0.png"),
        ("calibrate offset IN -o IN", ["rec.aedat4"], "rec.aedat4"),
        ("calibrate rig IN f --board 9x6 --square 30 -o IN", ["rec.h5"], "rec.h5"),
        (
            "calibrate rig e.h5 IN --board 9x6 --square 30 -o r.toml --sheet IN/0.png",
            ["f", "f/0.png"],
            "f/0.png",
        ),
        ("register e.h5 --frames IN -o IN", ["frames.h5"], "frames.h5"),
        ("register e.h5 --frames IN -o o.h5 --overlay IN/0.png", ["f", "f/0.png"], "f/0.png"),
        ("register e.h5 --frames IN -o o.h5 --plot IN/0.png", ["f", "f/0.png"], "f/0.png"),
        ("convert rec.aedat4 IN --frames IN", ["frames.h5"], "frames.h5"),
        ("ahdr rec.aedat4 -o IN --frames IN", ["frames.h5"], "frames.h5"),
        ("reconstruct rec.h5 --frames IN -o IN", ["video.mp4"], "video.mp4"),
        ("reconstruct rec.h5 --frames IN -o IN", ["frames", "frames/0.png"], "frames"),
        ("reconstruct rec.h5 --frames IN -o IN/out", ["frames", "frames/0.png"], "frames/out"),
        ("evaluate IN -o IN", ["rec.csv"], "rec.csv"),
        ("evaluate rec.h5 --truth IN -o IN", ["truth.json"], "truth.json"),
        ("evaluate IN -o IN/times.csv", ["rec", "rec/times.csv"], "rec/times.csv"),
        ("hdr-reference IN --register rec.h5 -o IN", ["scene.npz"], "scene.npz"),
        ("hdr-reference scene.exr --register IN -o IN", ["rec.npz"], "rec.npz"),
        ("hdr-reference IN -o s.exr --plot IN/0.png", ["photos", "photos/0.png"], "photos/0.png"),
    ],
)
def test_what_a_command_reads_is_not_replaced(cli, tmp_path, monkeypatch, arguments, names, out):
    monkeypatch.chdir(tmp_path)
    (tmp_path / names[0]).parent.mkdir(exist_ok=True)
    if len(names) == 2:
        (tmp_path / names[0]).mkdir()
    file = tmp_path / names[-1]
    file.write_text("mine")
    words = arguments.replace("IN", names[0]).replace("REC", file.stem).split()
    found = cli(*words, "--overwrite", "--quiet")
    assert (found.code, found.error.startswith(f"{out}: ")) == (2, True)
    assert any(text in found.error for text in (" input", "the recording itself", "lies in the frames"))
    assert file.read_text() == "mine"


def test_other_names_of_an_input_are_known(tmp_path):
    given, link, hard = tmp_path / "rec.h5", tmp_path / "link.h5", tmp_path / "hard.h5"
    given.write_text("mine")
    link.symlink_to(given)
    os.link(given, hard)
    for out in (given, link, hard, tmp_path / "missing" / ".." / "rec.h5"):
        if out.exists():
            with pytest.raises(UsageError, match=r"this is an input itself; choose another name"):
                check_apart([None, out], [None, given])


def test_what_is_not_there_or_elsewhere_may_be_written(tmp_path):
    folder, beside = tmp_path / "rec", tmp_path / "rec2"
    for place in (folder, beside):
        place.mkdir()
        (place / "out.png").write_text("former")
    check_apart([folder / "new.png", beside / "out.png", tmp_path / "new.h5"], [folder, tmp_path / "no.h5"])


def test_a_link_that_leads_nowhere_is_replaced_only_if_asked_for(cli, recording, tmp_path):
    """It may be there for a disk that is not."""
    for out in (tmp_path / "s.csv", tmp_path / "v.mp4", tmp_path / "images"):
        out.symlink_to(tmp_path / "nowhere" / out.name)
        command = "evaluate" if out.suffix == ".csv" else "reconstruct"
        found = cli(command, recording, "-o", out, *(("--methods", "hold") if out.suffix == ".csv" else ()))
        assert (found.code, "there" in found.error) == (2, True)
        assert out.is_symlink()


def test_a_calibration_in_the_folder_of_its_recording_may_be_replaced(tmp_path):
    (tmp_path / "cal.toml").write_text("former")
    check_apart([tmp_path / "cal.toml"], [tmp_path])


@pytest.mark.parametrize(
    ("arguments", "suffix", "length"),
    [
        ("reconstruct none.h5 -o", ".mp4", 240),
        ("calibrate contrast none.h5 -o", ".toml", 250),
        ("evaluate none.h5 -o", ".csv", 250),
        ("simulate none.png -o", ".h5", 240),
    ],
)
def test_a_name_that_is_too_long_while_it_is_written_is_told_before_the_work(
    cli, tmp_path, arguments, suffix, length
):
    found = cli(*arguments.split(), tmp_path / ("a" * (length - len(suffix)) + suffix))
    assert (found.code, found.error.endswith("File name too long")) == (2, True)
    assert not any(tmp_path.iterdir())


def test_images_further_apart_than_a_video_can_say_are_refused_before_the_work(cli, tmp_path):
    found = cli("reconstruct", "none.h5", "-o", tmp_path / "v.mp4", "--rate", 0.5, "--slow-motion", 1e6)
    assert (found.code, "more than MP4 can say" in found.error) == (2, True)
