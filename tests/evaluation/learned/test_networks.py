"""The architectures: published sizes, and the parts that have a simple truth."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs PyTorch; pip install -e '.[learned]' brings it")

from kalux.evaluation.learned.networks import (  # noqa: E402
    DynamicDesign,
    FireNet,
    FireNetDesign,
    GatedUnit,
    LongMemory,
    RecurrentUNet,
    UNetDesign,
    _DynamicConvolution,
)
from random_networks import CASES, random_network  # noqa: E402

PUBLISHED = UNetDesign(5, 32, 5, 3, 2, 1, batch_norm=False, transposed=False, dynamic=None)


@pytest.mark.parametrize(
    ("network", "parameters"),
    [
        (lambda: FireNet(FireNetDesign(5, 16, 3)), 37_777),
        (lambda: RecurrentUNet(PUBLISHED._replace(batch_norm=True, transposed=True), "sigmoid"), 10_712_098),
        (lambda: RecurrentUNet(PUBLISHED, "none"), 10_710_401),
        (lambda: RecurrentUNet(PUBLISHED._replace(dynamic=DynamicDesign(32, 64, 6, 12)), "none"), 10_149_881),
    ],
    ids=["FireNet", "E2VID", "E2VID+", "HyperE2VID"],
)
def test_as_many_parameters_as_published(network, parameters):
    """FireNet: counted in its weights. The others: counted in the networks of EVREAL that run the published weights."""
    with torch.device("meta"):
        assert sum(p.numel() for p in network().parameters()) == parameters


def test_the_tensors_of_e2vid_are_as_many_as_in_its_checkpoint():
    """74 in E2VID_lightweight.pth.tar, as the tests of evlib (github.com/tallamjr/evlib) state."""
    with torch.device("meta"):
        network = RecurrentUNet(PUBLISHED._replace(batch_norm=True, transposed=True), "sigmoid")
    assert len(network.state_dict()) == 74


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_state_is_a_value(case):
    """The same grid and state give the same image again, and another state another image."""
    network = random_network(case)
    grid = torch.from_numpy(np.random.default_rng(0).normal(size=(1, 5, 16, 24)).astype(np.float32))
    first, state = network(grid, None)
    second, _ = network(grid, state)
    again, _ = network(grid, state)
    assert first.shape == (1, 1, 16, 24)
    assert torch.equal(second, again)
    assert not torch.allclose(first, second)


def test_a_gated_unit_between_old_and_proposed():
    """With the update gate shut the state stays; open, it is the proposal."""
    unit, x, state = GatedUnit(2), torch.randn(1, 2, 4, 5), torch.randn(1, 2, 4, 5)
    for weight in unit.parameters():
        torch.nn.init.zeros_(weight)
    unit.update_gate.bias.data.fill_(-100)
    assert torch.equal(unit(x, state), state)
    unit.update_gate.bias.data.fill_(100)
    unit.out_gate.bias.data.fill_(0.5)
    assert torch.allclose(unit(x, state), torch.tanh(torch.tensor(0.5)))


def test_a_long_memory_keeps_its_cell_while_the_gates_say_so():
    unit, x, cell = LongMemory(2), torch.randn(1, 2, 4, 5), torch.randn(1, 2, 4, 5)
    torch.nn.init.zeros_(unit.Gates.weight)
    enter, keep, leave, proposed = -100.0, 100.0, 100.0, 0.3
    unit.Gates.bias.data = torch.tensor([enter, keep, leave, proposed]).repeat_interleave(2)
    output, kept = unit(x, (torch.randn(1, 2, 4, 5), cell))
    assert torch.equal(kept, cell)
    assert torch.allclose(output, torch.tanh(cell))


def test_a_dynamic_convolution_equals_a_loop():
    rng = np.random.default_rng(1)
    x, atoms = rng.normal(size=(2, 4, 5)), rng.normal(size=(3, 9, 4, 5))
    layer = _DynamicConvolution(inputs=2, outputs=2, kernel=3, atoms=3)
    layer.compositional_coefficients.data = torch.from_numpy(rng.normal(size=(2, 6, 1, 1)))
    layer.bias.data = torch.from_numpy(rng.normal(size=2))
    found = layer(torch.from_numpy(x)[None], torch.from_numpy(atoms)[None])[0].detach().numpy()
    around = np.pad(x, ((0, 0), (1, 1), (1, 1)))
    coefficients = layer.compositional_coefficients.detach().numpy().reshape(2, 2, 3)
    for i in range(4):
        for j in range(5):
            patch = around[:, i : i + 3, j : j + 3].reshape(2, 9)
            expected = np.einsum("oca,ak,ck->o", coefficients, atoms[:, :, i, j], patch)
            assert found[:, i, j] == pytest.approx(expected + layer.bias.detach().numpy())
