"""Small networks with random weights, stored as the published checkpoints are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

torch = pytest.importorskip("torch", reason="needs PyTorch; pip install -e '.[learned]' brings it")

from kalux.evaluation.learned.networks import (  # noqa: E402
    DynamicDesign,
    FireNet,
    FireNetDesign,
    RecurrentUNet,
    UNetDesign,
)

SMALL = UNetDesign(5, 4, 5, 3, 2, 1, batch_norm=False, transposed=False, dynamic=None)
LEGACY = {
    "head.": "net.head.conv.",
    "G1.": "net.head.recurrent_block.",
    "R1.": "net.resblocks.0.conv.",
    "G2.": "net.resblocks.0.recurrent_block.",
    "R2.": "net.resblocks.1.",
    "pred.": "net.pred.",
}


class Case(NamedTuple):
    """A network by name, how it is built, and how its tensors are called in its checkpoint."""

    name: str
    build: Callable[[], torch.nn.Module]
    rename: Callable[[str], str]


def _legacy(key: str) -> str:
    first = key.split(".")[0] + "."
    return LEGACY[first] + key.removeprefix(first)


def _unet(**changed):
    activation = changed.pop("activation", "none")
    return lambda: RecurrentUNet(SMALL._replace(**changed), activation)


CASES = {
    "e2vid": Case(
        "e2vid", _unet(batch_norm=True, transposed=True, activation="sigmoid"), "unetrecurrent.{}".format
    ),
    "e2vid upsampled": Case("e2vid", _unet(batch_norm=True, activation="sigmoid"), "unetrecurrent.{}".format),
    "e2vid+": Case("e2vid+", _unet(), "unetrecurrent.{}".format),
    "e2vid+ with flow": Case("e2vid+", _unet(outputs=3), "unetflow.{}".format),
    "firenet": Case("firenet", lambda: FireNet(FireNetDesign(5, 4, 3)), _legacy),
    "firenet+": Case("firenet+", lambda: FireNet(FireNetDesign(5, 4, 3)), lambda key: key),
    "hypere2vid": Case("hypere2vid", _unet(dynamic=DynamicDesign(6, 8, 3, 12)), "unetrecurrent.{}".format),
}


def random_network(case: Case, seed: int = 0) -> torch.nn.Module:
    """With weights, and statistics of batch normalisation, from the seed."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = case.build().eval()
        for name, value in network.named_buffers():
            if name.endswith(("running_mean", "bases")):
                value.normal_()
            if name.endswith("running_var"):
                value.uniform_(0.5, 2)
        for name, value in network.named_parameters():
            if name.endswith(("compositional_coefficients", "dynamic_conv.bias")):
                torch.nn.init.normal_(value, std=0.1)
            if name == "pred.conv2d.bias":
                value.data.fill_(0.5)  # so that images are not clipped
    return network


def published(case: Case, network: torch.nn.Module) -> dict[str, torch.Tensor]:
    """Its tensors under their published names."""
    return {case.rename(key): value for key, value in network.state_dict().items()}


def save(case: Case, path: Path, **more) -> Path:
    """A checkpoint of a random network."""
    torch.save({"state_dict": published(case, random_network(case)), **more}, path)
    return path


ALEXNET = {
    0: (64, 3, 11, 11),
    3: (192, 64, 5, 5),
    6: (384, 192, 3, 3),
    8: (256, 384, 3, 3),
    10: (256, 256, 3, 3),
}


def write_lpips(folder: Path) -> tuple[Path, Path]:
    """Random weights of LPIPS, as torchvision and the authors store them."""
    drawn = torch.Generator().manual_seed(0)
    tensors = {"classifier.1.weight": torch.zeros(2)}
    for number, shape in ALEXNET.items():
        weight = torch.randn(shape, generator=drawn)
        tensors[f"features.{number}.weight"] = weight / (shape[1] * shape[2] * shape[3]) ** 0.5
        tensors[f"features.{number}.bias"] = 0.1 * torch.randn(shape[0], generator=drawn)
    torch.save(tensors, folder / "alexnet.pth")
    widths = [shape[0] for shape in ALEXNET.values()]
    linear = {f"lin{i}.model.1.weight": torch.rand(1, n, 1, 1, generator=drawn) for i, n in enumerate(widths)}
    torch.save(linear, folder / "alex.pth")
    return folder / "alexnet.pth", folder / "alex.pth"
