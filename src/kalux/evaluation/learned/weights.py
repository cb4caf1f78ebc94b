"""Published checkpoints into networks: nothing in a file is executed, and every tensor has to fit.

Checkpoints are pickles. PyTorch's weights-only reader refuses all that is neither a tensor nor a plain container, but
those of E2VID+, FireNet+ and HyperE2VID also hold an object with the training's configuration. Here every class that
is foreign to PyTorch is read as an `Inert` object, which keeps what it is given and does nothing.
"""

from __future__ import annotations

import pickle
import pickletools
import re
import zipfile
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor

from kalux.errors import FormatError
from kalux.evaluation.learned.catalogue import NETWORKS, Activation, Published
from kalux.evaluation.learned.networks import (
    DynamicDesign,
    FireNet,
    FireNetDesign,
    Network,
    RecurrentUNet,
    UNetDesign,
)

Tensors = Mapping[str, Tensor]

_LEGACY_PICKLES: Final = 4
"""Before its raw tensors, a file of PyTorch before 1.6 has a magic number, a version, the machine, the checkpoint."""

_FIRE_NAMES: Final = {
    "net.head.conv.": "head.",
    "net.head.recurrent_block.": "G1.",
    "net.resblocks.0.conv.": "R1.",
    "net.resblocks.0.recurrent_block.": "G2.",
    "net.resblocks.1.": "R2.",
    "net.pred.": "pred.",
}
_UNET_NAMES: Final = {"unetrecurrent.": "", "unetflow.": ""}
_NAMES: Final[Mapping[str, Mapping[str, str]]] = {
    "e2vid": _UNET_NAMES,
    "e2vid+": _UNET_NAMES,
    "firenet": _FIRE_NAMES,
    "firenet+": {"": ""},
    "hypere2vid": _UNET_NAMES,
}
"""How the published names of each network's tensors begin, and how ours do. FireNet's first release names the parts of
the same network otherwise than FireNet+; ``unetflow`` predicts optical flow beside the image."""

_NAMED: Final = 4
"""Tensors that an error names before it only counts."""


class Inert:
    """Stands for an object of a foreign class: keeps its arguments and its state."""

    def __init__(self, *arguments: Any) -> None:
        self.arguments, self.state = arguments, None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class Checkpoint(NamedTuple):
    """What a file holds: tensors by name, and the training's configuration, empty where there is none."""

    tensors: dict[str, Tensor]
    config: Mapping[str, Any]


def load_network(name: str, path: Path) -> Network:
    """The network, ready to run, with the weights of a file.

    Parameters
    ----------
    name
        Of `kalux.evaluation.learned.catalogue.NETWORKS`.
    path
        A checkpoint as published: a dictionary with ``state_dict``, or only that.

    Raises
    ------
    FormatError
        If it cannot be read safely, or a tensor is missing, too many, or of another shape than the network's.
    """
    published = NETWORKS[name]
    tensors, config = read_checkpoint(path)
    try:
        tensors = {_renamed(key, _NAMES[name]): value for key, value in tensors.items()}
        # Without memory for its own tensors, and without drawing random ones.
        with torch.device("meta"):
            network = _build(published, tensors, config)
        problems = differences(network.state_dict(), tensors)
    except (LookupError, ValueError, RuntimeError) as error:
        problems = f"no network has such tensors ({str(error).splitlines()[0]})"
    if problems:
        raise FormatError(
            f"{path}: not the weights of {published.label}: {problems}; the authors publish them at {published.home}"
        )
    network.load_state_dict(
        {key: value.float() if value.is_floating_point() else value for key, value in tensors.items()},
        strict=True,
        assign=True,
    )
    network.eval()
    return network


def read_checkpoint(path: Path) -> Checkpoint:
    """Tensors and configuration of a file, read without executing anything in it.

    Raises
    ------
    FormatError
        If it is no checkpoint of PyTorch, damaged, asks for what is not allowed, or has no tensors.
    """
    try:
        foreign = [(Inert, name) for name in sorted(foreign_classes(path))]
        with torch.serialization.safe_globals(foreign):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, ValueError, EOFError, OSError, zipfile.BadZipFile) as error:
        reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise FormatError(f"{path}: not a checkpoint of PyTorch that can be read safely: {reason}") from error
    except (AttributeError, TypeError, KeyError, IndexError, AssertionError) as error:
        raise FormatError(f"{path}: not a checkpoint of PyTorch, or damaged") from error
    tensors = content.get("state_dict", content) if isinstance(content, dict) else {}
    if not tensors or not all(isinstance(value, Tensor) for value in tensors.values()):
        raise FormatError(f"{path}: holds no tensors by name (state_dict)")
    return Checkpoint(dict(tensors), _configuration(content))


def foreign_classes(path: Path) -> set[str]:
    """Full names of all that a checkpoint names outside of PyTorch and `collections`, found without executing it."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            member = next(n for n in [*archive.namelist(), "data.pkl"] if n.endswith("data.pkl"))
            with archive.open(member) as file:
                return _foreign(file, 1)
    with path.open("rb") as file:
        return _foreign(file, _LEGACY_PICKLES)


def _foreign(file: Any, pickles: int) -> set[str]:
    found: set[str] = set()
    for _ in range(pickles):
        for opcode, argument, _ in pickletools.genops(file):
            if opcode.name == "GLOBAL":
                found.add(str(argument).replace(" ", "."))
    return {name for name in found if not name.startswith(("torch.", "collections."))}


def differences(expected: Tensors, found: Tensors) -> str:
    """How tensors differ in name and shape from what is expected, in words; empty: not at all."""
    missing = [name for name in expected if name not in found]
    unexpected = [name for name in found if name not in expected]
    other = [
        f"{name} {tuple(found[name].shape)}, not {tuple(expected[name].shape)}"
        for name in expected
        if name in found and found[name].shape != expected[name].shape
    ]
    lists = (("missing", missing), ("unexpected", unexpected), ("of another shape", other))
    return "; ".join(f"{what}: {_some(names)}" for what, names in lists if names)


def _some(names: list[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(islice(names, _NAMED)) + (f" and {more} more" if more > 0 else "")


def _renamed(name: str, prefixes: Mapping[str, str]) -> str:
    for prefix, ours in prefixes.items():
        if name.startswith(prefix):
            return ours + name.removeprefix(prefix)
    raise LookupError(f"unexpected: {name}")


def _build(published: Published, tensors: Tensors, config: Mapping[str, Any]) -> Network:
    """The network with the sizes that the tensors have."""
    if published.architecture == "fire":
        return FireNet(fire_design(tensors))
    design = unet_design(tensors)
    if (design.dynamic is None) != (published.architecture == "unet"):
        raise LookupError(f"the first decoder is {'not ' if design.dynamic is None else ''}dynamic")
    return RecurrentUNet(design, _activation(config, published.activation))


def fire_design(tensors: Tensors) -> FireNetDesign:
    """Sizes of a `FireNet`, from its tensors."""
    channels, bins, kernel, _ = tensors["head.conv2d.weight"].shape
    return FireNetDesign(bins, channels, kernel)


def unet_design(tensors: Tensors) -> UNetDesign:
    """Sizes of a `RecurrentUNet`, from its tensors."""
    channels, bins, kernel, _ = tensors["head.conv2d.weight"].shape
    return UNetDesign(
        bins=bins,
        channels=channels,
        kernel=kernel,
        encoders=_count(tensors, "encoders"),
        residuals=_count(tensors, "resblocks"),
        outputs=tensors["pred.conv2d.weight"].shape[0],
        batch_norm="pred.norm_layer.weight" in tensors,
        transposed=any("transposed_conv2d" in name for name in tensors),
        dynamic=_dynamic_design(tensors),
    )


def _dynamic_design(tensors: Tensors) -> DynamicDesign | None:
    prefix = "decoders.0.dynamic_atom_generation."
    if f"{prefix}bases" not in tensors:
        return None
    bases = tensors[f"{prefix}bases"].shape[0]
    hidden, context = tensors[f"{prefix}bases_net.0.weight"].shape[:2]
    coefficients = tensors[f"{prefix}bases_net.3.weight"].shape[0]
    return DynamicDesign(context, hidden, coefficients // bases, bases)


def _count(tensors: Tensors, part: str) -> int:
    found = {match[1] for name in tensors if (match := re.match(rf"{part}\.(\d+)\.", name))}
    return len(found)


def _activation(config: Mapping[str, Any], default: Activation) -> Activation:
    stated = config.get("final_activation")
    if stated == "sigmoid":
        return "sigmoid"
    return "none" if stated in ("none", "") else default


def _configuration(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """What the checkpoint says of its network, wherever it does."""
    config = content.get("config", {})
    if isinstance(config, Inert):
        config = _mapping(config.state).get("_config")
    arguments = _mapping(_mapping(_mapping(config).get("arch")).get("args"))
    for stated in (
        content.get("model"),
        _mapping(config).get("model"),
        arguments.get("unet_kwargs"),
        arguments,
    ):
        if _mapping(stated):
            return _mapping(stated)
    return {}


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
