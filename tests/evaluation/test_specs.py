"""Methods by a text: names, networks and folders."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from kalux import PRESETS
from kalux.errors import InputError, MissingDependencyError
from kalux.evaluation.learned.catalogue import NETWORKS
from kalux.evaluation.specs import chosen_methods, outside_method
from kalux.evaluation.truth import evaluate_truth, prepare_reference

from builders import moving_blocks

WITHOUT_TORCH = importlib.util.find_spec("torch") is None


@pytest.fixture
def folder(tmp_path):
    """The truth of a simulation, as another method's images."""
    simulation = moving_blocks()
    path = tmp_path / "run3"
    path.mkdir()
    lines = ["t_us,file"]
    for i, (t, image) in enumerate(zip(simulation.truth_times(), simulation.truth().images, strict=True)):
        np.save(path / f"{i:03d}.npy", image)
        lines.append(f"{t},{i:03d}.npy")
    (path / "timestamps.csv").write_text("\n".join(lines))
    return path


@pytest.mark.parametrize(
    ("form", "label"), [("theirs={}", "theirs"), ("folder:{}", "run3"), ("a-b c={}?tolerance=5", "a-b c")]
)
def test_a_folder_is_a_method_like_all(form, label, folder):
    simulation = moving_blocks()
    recording = simulation.recording()
    (method,) = chosen_methods([form.format(folder)])
    scores = evaluate_truth(recording, prepare_reference(recording, simulation.truth()), method)
    assert (scores.method, scores.mse) == (label, 0)
    assert str(folder) in scores.adjustments()[-1]
    assert "linear" in scores.adjustments()[-1]


@pytest.mark.parametrize("name", NETWORKS)
def test_where_weights_come_from_is_said(name):
    for spec in (name, f"{name}:no/such.pth"):
        with pytest.raises(InputError) as caught:
            outside_method(spec)
        assert NETWORKS[name].home in str(caught.value)


@pytest.mark.parametrize(
    "spec", ["firenet:{}?window=0", "firenet:{}?tolerance=5", "firenet:{}?scaled=1", "mine={}?scaled"]
)
def test_unknown_options_are_refused(spec, tmp_path):
    with pytest.raises(InputError, match="the options here are"):
        outside_method(spec.format(tmp_path))


@pytest.mark.parametrize(
    "spec", ["mine={}?tolerance=1e3", "folder:{}?tolerance=-5", "firenet:{}/w.pth?scaled=yes"]
)
def test_what_is_no_option_is_not_taken_for_a_name(spec, folder):
    with pytest.raises(InputError, match="what follows \\? is no option; those of a folder are"):
        outside_method(spec.format(folder))


def test_a_folder_may_have_a_question_mark_in_its_name(folder):
    other = folder.rename(folder.with_name("run?"))
    assert outside_method(f"mine={other}").label == "mine"


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (["hold", "cf", "hold"], "method 'hold': is given twice"),
        (["a={}", "a={}?tolerance=5"], "method 'a=.*5': 'a=.*run3' is there already; give each once"),
        (["hold", "hold={}"], "'hold' is there already"),
    ],
)
def test_methods_of_one_name_are_refused(names, told, folder):
    """In a table they could not be told apart."""
    with pytest.raises(InputError, match=told):
        chosen_methods([name.format(folder) for name in names])


def test_other_texts_are_no_outside_methods():
    assert [outside_method(text) for text in ("blah", "x:y", "=y", "mine=", "")] == [None] * 5


def test_without_pytorch_the_extra_is_named(tmp_path, monkeypatch):
    (tmp_path / "w.pth").write_bytes(b"x")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match=r"kalux\[learned\]"):
        outside_method(f"firenet:{tmp_path / 'w.pth'}")


@pytest.mark.skipif(WITHOUT_TORCH, reason="needs PyTorch; pip install -e '.[learned]' brings it")
def test_a_network_says_what_it_does_and_which_weights_it_has(tmp_path):
    from random_networks import CASES, save

    path = save(CASES["e2vid"], tmp_path / "mine.pth")
    simulation = moving_blocks()
    method, scaled = chosen_methods([f"e2vid:{path}", f"e2vid:{path}?window=20000&scaled"])
    assert (method.label, scaled.label) == ("E2VID", "E2VID, scaled")
    assert "from frame to frame" in method.notes[0]
    assert "percentile" in method.notes[0]
    assert "not those that EVREAL distributes" in method.notes[1]
    assert "windows of 20000 us" in scaled.notes[0]
    assert "fitted" in scaled.notes[0]
    times = simulation.truth_times()[:3]
    found = [list(m.images(simulation.recording(), times)) for m in (method, scaled)]
    assert np.shape(found) == (2, 3, 32, 40)
    assert not np.allclose(found[0], found[1])


@pytest.mark.skipif(WITHOUT_TORCH, reason="needs PyTorch; pip install -e '.[learned]' brings it")
def test_real_weights_are_recognised_and_not_mixed_up(shared_data):
    path = shared_data / "weights" / "firenet.pth"
    assert "as EVREAL distributes them" in outside_method(f"firenet:{path}").notes[1]
    with pytest.raises(InputError, match="these are the weights of FireNet; give firenet:"):
        outside_method(f"firenet+:{path}")


def test_choice_by_name():
    assert [m.label for m in chosen_methods(["cf", "hold"])] == ["CF", "hold the last frame"]
    assert "mean of the neighbours" not in [m.label for m in chosen_methods()]
    assert "mean of the neighbours" in [m.label for m in chosen_methods(held_out=True)]
    with pytest.raises(InputError, match=r"no method 'e3vid'; known are hold.*NETWORK:WEIGHTS"):
        chosen_methods(["e3vid"])
    with pytest.raises(InputError, match="held out"):
        chosen_methods(["mean"])
    with pytest.raises(InputError, match="no method is given"):
        chosen_methods([])


@pytest.mark.parametrize("name", ["davis240c", "davis346", "prophesee-flir"])
def test_presets_of_sensors_are_methods_if_they_are_named(name):
    (method,) = chosen_methods([name])
    assert method.settings == PRESETS[name]
    assert method.label not in [m.label for m in chosen_methods(held_out=True)]
