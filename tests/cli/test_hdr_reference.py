"""``kalux hdr-reference``: from photographs to a truth that ``kalux evaluate`` takes; errors."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from kalux.datasets import SensorSettings, pan, photograph_scene, simulate
from kalux.datasets.radiance import read_radiance
from kalux.models.camera import Response
from kalux.writers import hdf5

from builders import blocks

TIMES = "2,1/2,1/8"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder of photographs, and a recording of the same scene."""
    folder = tmp_path_factory.mktemp("hdr")
    picture = cv2.GaussianBlur(blocks(0.02, 6.0, shape=(220, 300), count=800), (0, 0), 0.8).astype(np.float32)
    (folder / "photos").mkdir()
    for k, seconds in enumerate((2.0, 0.5, 0.125)):
        level = Response.srgb()(np.clip(picture.astype(np.float64) * seconds, 0, 1))
        cv2.imwrite(str(folder / "photos" / f"{k}.png"), np.rint(255 * level).astype(np.uint8))
    scene = photograph_scene(picture, pan(50.0), sensor_size=(96, 128), duration=500_000, scale=1.1)
    simulation = simulate(scene, SensorSettings(frame_rate=12.0))
    hdf5.write(
        folder / "rec.h5",
        sensor_size=(96, 128),
        events=[simulation.events],
        frames=simulation.frames,
        contrast_threshold=(0.2, 0.2),
    )
    return folder, simulation


def test_from_photographs_to_scores(cli, data, tmp_path):
    folder, simulation = data
    out, truth = tmp_path / "scene.exr", tmp_path / "rec_gt.npz"
    made = cli("hdr-reference", folder / "photos", "-o", out, "--times", TIMES)
    assert made.code == 0, made.err
    assert ": the reference of the alignment" in made.out
    assert "220 pixels measured" in made.out
    assert read_radiance(out).valid.mean() > 0.95
    assert cv2.imread(str(tmp_path / "scene_response.png")).shape == (480, 640, 3)
    placed = cli("hdr-reference", out, "--register", folder / "rec.h5", "-o", truth, "--blur", "0.5")
    assert placed.code == 0, placed.err
    assert "6 of 6 frames registered" in placed.out
    with np.load(truth) as arrays:
        true = simulation.truth(arrays["times_us"]).images
        off = (arrays["gt"] - true)[arrays["mask"]]
        assert arrays["homography"].shape == (6, 3, 3)
    assert np.sqrt(np.mean(off**2)) < 0.1 * true.std()
    scored = cli("evaluate", folder / "rec.h5", "--truth", truth, "--methods", "hold,default")
    assert "masked pixels" in scored.out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["none", "-o", "x.exr"], "no such folder"),
        (["photos", "-o", "x.png"], "written as .exr or .npz"),
        (["photos", "-o", "x.exr"], "no exposure time in its EXIF"),
        (["photos", "-o", "x.exr", "--times", "1,2"], "2 exposure times for 3 images"),
        (["photos", "-o", "x.exr", "--times", "1,x,3"], "seconds are needed, numbers with commas"),
        (["photos", "-o", "x.exr", "--times", "t.csv"], "t.csv: cannot be read"),
        (["photos", "-o", "x.exr", "--times", TIMES, "--response", "log"], "unknown response"),
        (["photos", "-o", "x.exr", "--times", TIMES, "--exposure", "5"], "give --register REC"),
        (["photos", "-o", "x.exr", "--register", "rec.h5"], "ground truth is an .npz"),
        (["x.exr", "-o", "x.npz"], "is a radiance image already"),
        (["none.exr", "-o", "x.npz", "--register", "rec.h5"], "no such file"),
        (["rec.h5", "-o", "x.exr"], "no such folder"),
        (["a.exr", "-o", "x.npz", "--register", "rec.h5", "--response", "srgb"], "--response, --align"),
    ],
)
def test_errors_are_one_line(cli, data, tmp_path, monkeypatch, arguments, told):
    monkeypatch.chdir(data[0])
    arguments = [str(tmp_path / a) if a.startswith("x.") else a for a in arguments]
    found = cli("hdr-reference", *arguments)
    assert found.code == 2
    assert told in found.error
    assert list(tmp_path.iterdir()) == []


def test_files_are_replaced_only_if_asked_for(cli, data, tmp_path):
    (tmp_path / "a_response.png").write_text("mine")
    arguments = ("hdr-reference", data[0] / "photos", "-o", tmp_path / "a.npz", "--times", TIMES)
    assert "--overwrite" in cli(*arguments).error
    assert cli(*arguments, "--overwrite").code == 0


def test_without_pillow_the_extra_is_named(cli, data, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "PIL", None)
    found = cli("hdr-reference", data[0] / "photos", "-o", tmp_path / "x.exr")
    assert found.code == 2
    assert "kalux[hdr]" in found.error
