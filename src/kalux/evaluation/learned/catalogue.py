"""What is published of each network: input, output, and where its weights are. No PyTorch here."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, NamedTuple

from kalux.errors import InputError

Architecture = Literal["fire", "unet", "dynamic unet"]
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
    blob
        Git's name (SHA-1) of the weights that EVREAL distributes: others are used too, and the result says so.
    """

    label: str
    architecture: Architecture
    normalised: bool
    activation: Activation
    tone: Tone
    home: str
    blob: str


_ECNN: Final = "https://github.com/TimoStoff/event_cnn_minimal"

NETWORKS: Final = {
    "e2vid": Published(
        "E2VID",
        "unet",
        normalised=True,
        activation="sigmoid",
        tone="robust",
        home="https://github.com/uzh-rpg/rpg_e2vid (E2VID_lightweight.pth.tar)",
        blob="21b384198806a89c7b8426522e4b439f49def5c1",
    ),
    "e2vid+": Published(
        "E2VID+",
        "unet",
        normalised=False,
        activation="none",
        tone="none",
        home=f"{_ECNN} (reconstruction model)",
        blob="787f90c7eea3222e5287cd2e5eb7ef2d342b22ae",
    ),
    "firenet": Published(
        "FireNet",
        "fire",
        normalised=True,
        activation="none",
        tone="none",
        home="https://github.com/cedric-scheerlinck/rpg_e2vid/tree/cedric/firenet (firenet_1000.pth.tar)",
        blob="b7c5d3a31c6571c7d58c362c277fc2d044d6fa45",
    ),
    "firenet+": Published(
        "FireNet+",
        "fire",
        normalised=False,
        activation="none",
        tone="none",
        home=f"{_ECNN} (FireNet+ model)",
        blob="353522b00dd5dabc610971dedd3ecddcbb07bd4e",
    ),
    "hypere2vid": Published(
        "HyperE2VID",
        "dynamic unet",
        normalised=False,
        activation="none",
        tone="none",
        home="https://github.com/ercanburak/HyperE2VID",
        blob="b69afbf1eee9070cbb335f1ea50614ad0be9a0df",
    ),
}
"""By the name that a method is chosen with.

Input, normalisation and tone as in EVREAL (Ercan et al., CVPRW 2023, ``config/method``; MIT), which runs all five with
their authors' settings: the voxel grid of E2VID and FireNet is normalised, that of the later three, which were trained
on unscaled ones, is not; only E2VID's image is stretched.
"""


class Checksums(NamedTuple):
    """Of a file: SHA-256, and SHA-1 with git's header, which is how a repository names it."""

    sha256: str
    blob: str


def checksums(name: str, path: Path) -> Checksums:
    """Checksums of the weights.

    Raises
    ------
    InputError
        If there is no such file; says where the authors publish it.
    """
    published = NETWORKS[name]
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            sha256, blob = hashlib.sha256(), hashlib.sha1(b"blob %d\0" % size, usedforsecurity=False)
            while block := file.read(1 << 20):
                sha256.update(block)
                blob.update(block)
    except OSError as error:
        raise InputError(
            f"{path}: the weights of {published.label} cannot be read: {error.strerror}; the authors publish them at "
            f"{published.home}"
        ) from error
    return Checksums(sha256.hexdigest(), blob.hexdigest())
