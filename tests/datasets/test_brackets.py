"""Brackets from folders: exposures, and what is refused."""

from __future__ import annotations

import csv

import cv2
import numpy as np
import pytest

from kalux.datasets.brackets import read_bracket
from kalux.errors import FormatError, InputError
from photographs import TIMES, photographs, scene_radiance


@pytest.fixture
def scene():
    return scene_radiance()


def write(folder, pictures):
    folder.mkdir()
    for picture in pictures:
        cv2.imwrite(str(folder / picture.name), picture.levels[..., ::-1])
    return folder


def test_brackets_from_a_folder(scene, tmp_path):
    pictures = photographs(scene)
    folder = write(tmp_path / "b", pictures)
    with (tmp_path / "times.csv").open("w", newline="", encoding="utf-8-sig") as file:  # as Excel writes it
        rows = csv.writer(file)
        rows.writerow(["file", "exposure_s"])
        rows.writerows([["3.png", "1/16"], ["0.png", 4], ["1.png", 1]])
    found = read_bracket(folder, tmp_path / "times.csv")
    assert [(p.name, p.exposure) for p in found] == [("0.png", 4.0), ("1.png", 1.0), ("3.png", 1 / 16)]
    assert np.array_equal(found[1].levels, pictures[1].levels)
    assert [p.exposure for p in read_bracket(folder, TIMES)] == list(TIMES)


@pytest.mark.parametrize(
    ("times", "told"),
    [
        (None, "no exposure time in its EXIF"),
        ([1.0], "1 exposure times for 4 images"),
        ([1.0] * 4, "all exposures are equal"),
        ([1.0, 2.0, -1.0, 3.0], "must be positive"),
    ],
)
def test_exposures_are_needed(scene, tmp_path, times, told):
    folder = write(tmp_path / "b", photographs(scene))
    with pytest.raises(InputError, match=told):
        read_bracket(folder, times)


def test_a_photograph_has_one_exposure(scene, tmp_path):
    """The last of two would have been taken without a word."""
    folder = write(tmp_path / "b", photographs(scene))
    times = tmp_path / "times.csv"
    times.write_text("file,exposure_s\n0.png,4\n1.png,1\n0.png,2\n")
    with pytest.raises(FormatError, match=r"times\.csv: lists 0\.png twice; give each photograph one line"):
        read_bracket(folder, times)


def test_damaged_and_unequal_photographs(scene, tmp_path):
    folder = write(tmp_path / "b", photographs(scene))
    cv2.imwrite(str(folder / "1.png"), np.zeros((50, 60, 3), np.uint8))
    with pytest.raises(InputError, match="all must be alike"):
        read_bracket(folder, TIMES)
    (folder / "1.png").write_bytes(b"text")
    with pytest.raises(FormatError, match=r"1\.png: not an image"):
        read_bracket(folder, TIMES)
    with pytest.raises(InputError, match="no such folder"):
        read_bracket(tmp_path / "none")


@pytest.mark.parametrize("listed", ["1/0", "two", "", '"'])
def test_a_list_of_exposures_that_is_none(scene, tmp_path, listed):
    folder = write(tmp_path / "b", photographs(scene))
    times = tmp_path / "times.csv"
    times.write_text(f"file,exposure_s\n0.png,{listed}\n")
    with pytest.raises(FormatError, match=r"times\.csv: not a CSV"):
        read_bracket(folder, times)


def test_the_exposures_of_a_real_bracket(shared_data):
    """Canon EOS Rebel T2i: shutters are powers of two, which EXIF's exposure times round (1/30, 1/125)."""
    pytest.importorskip("PIL")
    pictures = read_bracket(shared_data / "exposures")
    stops = [np.log2(p.exposure / pictures[0].exposure) for p in pictures]
    assert np.allclose(stops, [0, -2, -4, -6, -8, -11, -13], atol=1e-9)
