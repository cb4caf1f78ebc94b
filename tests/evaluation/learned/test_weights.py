"""Checkpoints: what is loaded, what is refused, and that nothing in them runs."""

from __future__ import annotations

import pickle

import pytest

torch = pytest.importorskip("torch", reason="needs PyTorch; pip install -e '.[learned]' brings it")

from kalux.errors import FormatError  # noqa: E402
from kalux.evaluation.learned.catalogue import NETWORKS, checksums  # noqa: E402
from kalux.evaluation.learned.weights import Inert, foreign_classes, load_network, read_checkpoint  # noqa: E402
from random_networks import CASES, published, random_network, save  # noqa: E402

REAL = {"firenet": "firenet.pth", "firenet+": "firenet_plus.pth"}


class ConfigParser:
    """As in the checkpoints of E2VID+ and FireNet+: an object around nested dictionaries."""

    def __init__(self, config):
        self._config = config


class Harmful:
    """Unpickled, it would leave a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.parametrize("legacy", [False, True], ids=["zip", "legacy"])
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_every_network_from_its_published_names(case, legacy, tmp_path):
    """The sizes are found in the file, every tensor is taken, and the network does the same."""
    path, network = tmp_path / "weights.pth", random_network(case)
    content = {"state_dict": published(case, network), "config": ConfigParser({"name": case.name})}
    torch.save(content, path, _use_new_zipfile_serialization=not legacy)
    loaded = load_network(case.name, path)
    expected = network.state_dict()
    assert loaded.state_dict().keys() == expected.keys()
    assert all(torch.equal(value, expected[key]) for key, value in loaded.state_dict().items())
    grid = torch.linspace(-1, 1, 5 * 16 * 24).reshape(1, 5, 16, 24)
    assert torch.equal(loaded(grid, None)[0], network(grid, None)[0])


def test_a_plain_dictionary_of_tensors_is_enough(tmp_path):
    torch.save(published(CASES["firenet+"], random_network(CASES["firenet+"])), tmp_path / "weights.pth")
    assert load_network("firenet+", tmp_path / "weights.pth").bins == 5


@pytest.mark.parametrize(
    "more",
    [
        {"model": {"final_activation": "sigmoid"}},
        {"config": {"model": {"final_activation": "sigmoid"}}},
        {"config": ConfigParser({"arch": {"args": {"unet_kwargs": {"final_activation": "sigmoid"}}}})},
    ],
    ids=["model", "config", "object"],
)
def test_the_last_activation_is_as_the_checkpoint_says(more, tmp_path):
    case = CASES["e2vid+"]
    grid = torch.ones(1, 5, 16, 16)
    stated = load_network("e2vid+", save(case, tmp_path / "stated.pth", **more))(grid, None)[0]
    silent = load_network("e2vid+", save(case, tmp_path / "silent.pth"))(grid, None)[0]
    assert torch.equal(stated, torch.sigmoid(silent))


def test_loading_draws_no_random_numbers(tmp_path):
    path = save(CASES["e2vid"], tmp_path / "weights.pth")
    before = torch.random.get_rng_state()
    load_network("e2vid", path)
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize("legacy", [False, True], ids=["zip", "legacy"])
def test_what_a_file_asks_for_is_not_done(legacy, tmp_path):
    path, mark = tmp_path / "weights.pth", tmp_path / "mark"
    content = {"state_dict": published(CASES["firenet+"], random_network(CASES["firenet+"]))}
    content["extra"] = Harmful(mark)
    torch.save(content, path, _use_new_zipfile_serialization=not legacy)
    assert foreign_classes(path) == {"io.open"}
    load_network("firenet+", path)
    assert not mark.exists()


def test_an_inert_object_keeps_what_it_is_given(tmp_path):
    path = tmp_path / "weights.pth"
    content = {"state_dict": {"a": torch.zeros(1)}, "config": ConfigParser({"arch": {"args": {"x": 1}}})}
    torch.save(content, path)
    assert read_checkpoint(path).config == {"x": 1}
    assert Inert(1, 2).arguments == (1, 2)


def test_missing_unexpected_and_misshapen_tensors_are_named(tmp_path):
    case = CASES["e2vid"]
    tensors = published(case, random_network(case))
    del tensors["unetrecurrent.encoders.1.conv.conv2d.weight"]
    tensors["unetrecurrent.extra"] = torch.zeros(1)
    tensors["unetrecurrent.resblocks.0.conv1.weight"] = torch.zeros(3, 3)
    path = tmp_path / "weights.pth"
    torch.save({"state_dict": tensors}, path)
    with pytest.raises(FormatError) as caught:
        load_network("e2vid", path)
    message = str(caught.value)
    assert "missing: encoders.1.conv.conv2d.weight; unexpected: extra" in message
    assert "of another shape: resblocks.0.conv1.weight (3, 3), not (32, 32, 3, 3)" in message
    assert NETWORKS["e2vid"].home in message
    assert "\n" not in message


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_no_network_takes_the_weights_of_another_architecture(case, tmp_path):
    """E2VID and E2VID+ are the same one."""
    same = {"e2vid", "e2vid+"} if case.name in ("e2vid", "e2vid+") else {case.name}
    path = save(case, tmp_path / "weights.pth")
    for name in NETWORKS.keys() - same:
        with pytest.raises(FormatError, match="not the weights of"):
            load_network(name, path)


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"", id="empty"),
        pytest.param(b"not a pickle at all", id="text"),
        pytest.param(pickle.dumps({"state_dict": 1}), id="pickle"),
        pytest.param(b"PK\x03\x04 and nothing else", id="half a zip"),
    ],
)
def test_what_is_no_checkpoint_is_refused_in_one_line(content, tmp_path):
    path = tmp_path / "weights.pth"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=r"weights\.pth: ") as caught:
        load_network("firenet", path)
    assert "\n" not in str(caught.value)


def test_damage_anywhere_is_refused_or_harmless(tmp_path):
    """Cut short at many places."""
    path = save(CASES["firenet+"], tmp_path / "whole.pth")
    data, cut = path.read_bytes(), tmp_path / "cut.pth"
    for length in range(0, len(data) - 1, len(data) // 40):
        cut.write_bytes(data[:length])
        with pytest.raises(FormatError):
            load_network("firenet+", cut)


@pytest.mark.parametrize("name", REAL)
def test_real_weights_load_strictly_and_are_recognised(name, shared_data):
    path = shared_data / "weights" / REAL[name]
    network = load_network(name, path)
    assert sum(p.numel() for p in network.parameters()) == 37777
    assert checksums(name, path).blob == NETWORKS[name].blob
