"""What the README shows runs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import kalux
from kalux.evaluation.baselines import methods
from kalux.evaluation.held_out import evaluate_held_out, hold_out_frames
from kalux.evaluation.specs import outside_method
from kalux.frames import GroundTruth
from kalux.writers import hdf5, open_writer

from builders import moving_blocks

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.fixture
def demonstration(tmp_path, monkeypatch):
    """A small recording with truth, where `kalux demo` puts its own."""
    simulation = moving_blocks(0.05, 0.8, size=(24, 32))
    times = np.array([frame.middle for frame in simulation.frames])
    (tmp_path / "kalux-demo").mkdir()
    hdf5.write(
        tmp_path / "kalux-demo" / "demo.h5",
        sensor_size=(24, 32),
        events=iter([simulation.events]),
        frames=iter(simulation.frames),
        ground_truth=GroundTruth(times, np.full((len(times), 24, 32), 0.5, np.float32)),
    )
    monkeypatch.chdir(tmp_path)
    return simulation


def blocks(page):
    """The Python on a page, block by block."""
    return re.findall(r"```python\n(.*?)```", page, re.DOTALL)


def test_the_python_example_runs(demonstration):
    (code,) = blocks(README)
    names = {}
    exec(code, names)
    assert isinstance(names["image"], kalux.Image)
    assert names["image"].intensity.shape == (260, 346)


def test_the_example_with_arrays_runs(demonstration, tmp_path):
    (code,) = blocks((ROOT / "docs" / "api.md").read_text(encoding="utf-8"))
    names = {}
    exec(code, names)
    assert names["scores"]["default"] > 0
    assert len(list((tmp_path / "made").glob("*.exr"))) == len(names["made"])
    assert np.array_equal(
        np.concatenate(list(kalux.open(tmp_path / "mine.h5").events())), demonstration.events
    )


def test_the_examples_of_outputs_run(demonstration, tmp_path):
    """One after the other, as they are read."""
    names = {}
    for code in blocks((ROOT / "docs" / "outputs.md").read_text(encoding="utf-8")):
        exec(code, names)
    assert len(list(tmp_path.glob("uncertainty_*.png"))) == len(demonstration.frames)
    assert names["sheet"].ndim == 3


def test_the_input_of_another_method_is_what_the_default_is_given(demonstration, tmp_path):
    """Images that are made of it score as those that an evaluation makes."""
    exec(blocks((ROOT / "docs" / "baselines.md").read_text(encoding="utf-8"))[0], {})
    kept, times = kalux.open(tmp_path / "kept.h5"), np.loadtxt(tmp_path / "times.txt", np.int64)
    with open_writer(tmp_path / "mine", format="npy") as writer:
        for image in kalux.reconstruct(kept, times=times):
            writer.write(image)
    held = hold_out_frames(kalux.open(tmp_path / "kalux-demo" / "demo.h5"))
    default, mine = (
        evaluate_held_out(held, method).mse
        for method in (methods()["default"], outside_method(f"folder:{tmp_path / 'mine'}"))
    )
    assert mine == default


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
