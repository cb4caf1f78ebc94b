"""What the README shows runs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

import kalux
from kalux.writers import hdf5

from builders import moving_blocks

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_python_example_runs(tmp_path, monkeypatch):
    simulation = moving_blocks(0.05, 0.8, size=(24, 32))
    frames = simulation.frames
    hdf5.write(
        tmp_path / "night_drive.aedat4",  # recognised by its content
        sensor_size=(24, 32),
        events=iter([simulation.events]),
        frames=iter(frames),
    )
    monkeypatch.chdir(tmp_path)
    code = re.search(r"```python\n(.*?)```", README, re.DOTALL).group(1)
    names = {
        "pixels": np.zeros((260, 346), np.uint8),
        "t0": 0,
        "t1": 10_000,
        "events": {"t": np.array([12_000]), "x": np.array([3]), "y": np.array([4]), "p": np.array([1])},
        "t": 13_000,
    }
    exec(code, names)
    assert isinstance(names["image"], kalux.Image)
    assert names["image"].intensity.shape == (260, 346)


def test_the_example_with_arrays_runs(tmp_path, monkeypatch):
    simulation = moving_blocks(0.05, 0.4, size=(24, 32))
    events = simulation.events
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    names = {
        "images": [frame.image for frame in simulation.frames],
        "starts": [frame.exposure_start for frame in simulation.frames],
        "t": events["t"] * 1e-6,
        "x": events["x"].astype(np.float64),
        "y": events["y"],
        "p": np.where(events["p"], 1, -1),
        "truth_times": np.array([100_000]),
        "truth": np.full((1, 24, 32), 0.5, np.float32),
    }
    exec(re.search(r"```python\n(.*?)```", page, re.DOTALL).group(1), names)
    assert names["scores"]["default"] > 0
    assert len(list((tmp_path / "made").glob("*.exr"))) == len(names["made"])
    assert np.array_equal(np.concatenate(list(kalux.open(tmp_path / "mine.h5").events())), events)


def test_its_links_lead_somewhere():
    links = re.findall(r"\]\(((?!http)[^)#]+)\)", README)
    assert "docs/equations.md" in links
    for link in links:
        assert (ROOT / link).exists(), link


def test_all_pages_are_linked_and_their_links_lead_somewhere():
    """Of docs/, headings included."""
    pages = sorted((ROOT / "docs").glob("*.md"))
    for page in pages:
        assert f"docs/{page.name}" in README, page.name
        for link, heading in re.findall(
            r"\]\(((?!http)[^)#]*)(?:#([^)]+))?\)", page.read_text(encoding="utf-8")
        ):
            target = page.parent / link if link else page
            assert target.exists(), f"{page.name}: {link}"
            if heading:
                titles = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
                known = [re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles]
                assert heading in known, f"{page.name}: {link}#{heading}"


def test_the_api_page_has_every_public_name():
    rows = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(rows) == sorted(kalux.__all__)
