"""``kalux datasets``: the list, and checks of folders in the published layout (real payload, our writer)."""

from __future__ import annotations

import shutil

import cv2
import pytest

import kalux
from kalux.datasets.published import SETS


@pytest.fixture(scope="module")
def sequence(shared_data, tmp_path_factory):
    """The beginning of slider_depth, as the set publishes a sequence."""
    folder = tmp_path_factory.mktemp("set") / "slider_depth"
    recording = kalux.open(shared_data / "slider_depth", exposure=10_000)
    (folder / "images").mkdir(parents=True)
    events = next(iter(recording.events()))[:2000]
    rows = (f"{e['t'] * 1e-6:.6f} {e['x']} {e['y']} {int(e['p'])}\n" for e in events)
    (folder / "events.txt").write_text("".join(rows))
    lines = []
    for i, frame in zip(range(4), recording.frames(), strict=False):
        cv2.imwrite(str(folder / "images" / f"{i:08}.png"), frame.image)
        lines.append(f"{frame.exposure_start * 1e-6:.6f} images/{i:08}.png\n")
    (folder / "images.txt").write_text("".join(lines))
    return folder


def test_the_list_and_a_check(cli, sequence, tmp_path):
    listed = cli("datasets")
    assert listed.code == 0
    for one in SETS:
        assert f"\n{one.name}: " in f"\n{listed.out}"
        assert one.page in listed.out
    assert "still_life" in cli("datasets", "hqf").out
    for name in ("slider_depth", "urban"):
        shutil.copytree(sequence, tmp_path / name)
    found = cli("datasets", "check", "ijrr", tmp_path)
    assert found.code == 0, found.err
    assert "slider_depth: 240x180, 2,000 events, 4 frames\n  no calib.txt\n" in found.out
    assert "2 of 27 sequences found, 0 of them cannot be read" in found.out
    assert "not there: boxes_6dof" in found.out
    (tmp_path / "urban" / "images" / "00000002.png").write_bytes(b"")
    damaged = cli("datasets", "check", "ijrr", tmp_path, "--whole")
    assert damaged.code == 2
    assert "1 of 2 sequences cannot be read" in damaged.error
    assert "00000002.png" in damaged.out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["check"], "check needs"),
        (["check", "hqf", "none"], "no such folder"),
        (["hqf", "hdr"], "give one set"),
        (["mnist"], "no set 'mnist'"),
        (["--whole"], "give one set"),
    ],
)
def test_errors_are_one_line(cli, arguments, told):
    found = cli("datasets", *arguments)
    assert found.code == 2
    assert told in found.error
