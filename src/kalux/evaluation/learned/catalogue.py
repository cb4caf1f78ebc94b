"""What is published of each network: input, output, and where its weights are. No PyTorch here."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from kalux.errors import InputError

Architecture = Literal["fire", "unet"]
Activation = Literal["none", "sigmoid"]
Tone = Literal["none", "robust"]


@dataclass(frozen=True)
class Published:
    """A network as it was published.

    Attributes
    ----------
    label
        For tables.
    architecture
        Which class of `kalux.evaluation.learned.networks` it is.
    normalised
        Whether the voxel grid is normalised, as `kalux.evaluation.learned.voxels.normalise` does.
    activation
        Of the last layer, where the checkpoint does not state it.
    tone
        What is done to the image: nothing, or its 1st and 99th percentiles become 0 and 1.
    home
        Where the authors publish the weights.
    checksums
        SHA-256 of published weights that are known; others are used too, and the result says so.
    """

    label: str
    architecture: Architecture
    normalised: bool
    activation: Activation
    tone: Tone
    home: str
    checksums: frozenset[str] = frozenset()


_ECNN: Final = "https://github.com/TimoStoff/event_cnn_minimal"

NETWORKS: Final = {
    "e2vid": Published(
        "E2VID",
        "unet",
        normalised=True,
        activation="sigmoid",
        tone="robust",
        home="https://github.com/uzh-rpg/rpg_e2vid (E2VID_lightweight.pth.tar)",
    ),
    "e2vid+": Published(
        "E2VID+",
        "unet",
        normalised=False,
        activation="none",
        tone="none",
        home=f"{_ECNN} (reconstruction model)",
    ),
    "firenet": Published(
        "FireNet",
        "fire",
        normalised=True,
        activation="none",
        tone="none",
        home="https://github.com/cedric-scheerlinck/rpg_e2vid/tree/cedric/firenet (firenet_1000.pth.tar)",
        checksums=frozenset({"a64af3191a00e9f01cd47d086d9a88c35ff1e63756566ca44b4ff02301ca696e"}),
    ),
    "firenet+": Published(
        "FireNet+",
        "fire",
        normalised=False,
        activation="none",
        tone="none",
        home=f"{_ECNN} (FireNet+ model)",
        checksums=frozenset({"76122a81cf6313d84036509f388f150127482bcd977d46e8de650b7f841239f8"}),
    ),
    "hypere2vid": Published(
        "HyperE2VID",
        "unet",
        normalised=False,
        activation="none",
        tone="none",
        home="https://github.com/ercanburak/HyperE2VID",
    ),
}
"""By the name that a method is chosen with.

Input, normalisation and tone as in EVREAL (Ercan et al., CVPRW 2023, ``config/method``; MIT), which runs all five with
their authors' settings: the voxel grid of E2VID and FireNet is normalised, those of the later three, which were trained
on unscaled ones, is not; only E2VID's image is stretched. The checksums are those of the files that EVREAL distributes.
"""


def checksum(name: str, path: Path) -> str:
    """SHA-256 of the weights.

    Raises
    ------
    InputError
        If there is no such file; says where the authors publish it.
    """
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise InputError(
            f"{path}: the weights of {NETWORKS[name].label} cannot be read: {error.strerror}; the authors publish "
            f"them at {NETWORKS[name].home}"
        ) from error
    return digest.hexdigest()
