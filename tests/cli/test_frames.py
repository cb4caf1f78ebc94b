"""``--frames``: frames from elsewhere, in every command that opens a recording."""

from __future__ import annotations

import tomllib

import cv2
import numpy as np
import pytest

import kalux


@pytest.fixture
def events_only(tmp_path, write_recording):
    return write_recording(tmp_path / "events.h5", frames=[])


@pytest.fixture
def folder(tmp_path, simulation):
    """The recording's frames as PNG, with their times and exposures."""
    folder = tmp_path / "images"
    folder.mkdir()
    lines = ["file,timestamp_us,exposure_us"]
    for index, frame in enumerate(simulation.frames):
        cv2.imwrite(str(folder / f"{index:04d}.png"), frame.image)
        lines.append(f"{index:04d}.png,{frame.exposure_start},{frame.exposure}")
    (folder / "frames.csv").write_text("\n".join(lines))
    return folder


def test_info(cli, events_only, folder, simulation):
    found = cli("info", events_only, "--frames", folder, "--no-estimate")
    assert found.code == 0
    assert f"  frames     {len(simulation.frames)} at" in found.out
    assert "kalux + images" in found.out


def test_convert_makes_one_file_of_both(cli, events_only, folder, recording, tmp_path):
    assert cli("convert", events_only, tmp_path / "both.h5", "--frames", folder).code == 0
    both, whole = kalux.open(tmp_path / "both.h5"), kalux.open(recording)
    for ours, theirs in zip(both.frames(), whole.frames(), strict=True):
        assert np.array_equal(ours.image, theirs.image)
        assert (ours.exposure_start, ours.exposure_end) == (theirs.exposure_start, theirs.exposure_end)
    assert len(both.events()) == len(whole.events())


def test_reconstruct_gives_the_same_images_and_notes_the_frames(
    cli, events_only, folder, recording, tmp_path
):
    flags = ("--at", "frames", "--format", "npy")
    assert cli("reconstruct", recording, "-o", tmp_path / "whole", *flags).code == 0
    joined = (*flags, "--frames", folder, "--white", 255)
    assert cli("reconstruct", events_only, "-o", tmp_path / "joined", *joined).code == 0
    names = sorted(file.name for file in (tmp_path / "whole").glob("*.npy"))
    assert names
    for name in names:
        np.testing.assert_array_equal(np.load(tmp_path / "joined" / name), np.load(tmp_path / "whole" / name))
    told = tomllib.loads((tmp_path / "joined" / "kalux.toml").read_text())
    assert (told["input"]["frames"], told["input"]["white"]) == (str(folder), 255)


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (["--frames", "none"], "none: no such file or folder"),
        (["--frames-start", "5"], "--frames-start is for frames from elsewhere; give --frames"),
        (["--frames-rate", "5"], "--frames-rate is for"),
        (["--replace-frames"], "--replace-frames is for"),
        (["--frames", "FOLDER", "--frames-rate", "30"], "are for a video"),
    ],
)
def test_usage(cli, events_only, folder, flags, told):
    found = cli("info", events_only, *(str(folder) if flag == "FOLDER" else flag for flag in flags))
    assert found.code == 2
    assert told in found.error


def test_frames_of_its_own_are_kept(cli, recording, folder):
    found = cli("info", recording, "--frames", folder)
    assert found.code == 2
    assert "--replace-frames" in found.error
    assert cli("info", recording, "--frames", folder, "--replace-frames").code == 0
