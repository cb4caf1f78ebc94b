"""Small sequences on disk: one with ground truth, one without."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from kalux.evaluation.benchmark.jobs import Job, make_job
from kalux.evaluation.benchmark.sequences import Options, Sequence
from kalux.writers import hdf5

from builders import moving_blocks


class Set(NamedTuple):
    """A folder of two sequences."""

    folder: object
    with_truth: Sequence
    without: Sequence

    def job(self, method: str, *, held_out: bool = True, hdr_vdp: bool = False) -> Job:
        sequence = self.without if held_out else self.with_truth
        return make_job(sequence, method, held_out=held_out, hdr_vdp=hdr_vdp)


@pytest.fixture(scope="session")
def simulation():
    return moving_blocks(high=2.0)


@pytest.fixture
def small_set(tmp_path, simulation) -> Set:
    return write_set(tmp_path / "set", simulation)


@pytest.fixture(scope="module")
def lasting_set(tmp_path_factory, simulation) -> Set:
    """The same for all tests of a module, which do not change it."""
    return write_set(tmp_path_factory.mktemp("lasting") / "set", simulation)


def write_set(folder, simulation) -> Set:
    """Write the sequences to a new folder."""
    folder.mkdir()
    for name in ("a.h5", "b.h5"):
        hdf5.write(
            folder / name,
            sensor_size=simulation.scene.sensor_size,
            events=[simulation.events],
            frames=simulation.frames,
            contrast_threshold=(simulation.settings.threshold_on, simulation.settings.threshold_off),
        )
    truth = simulation.truth()
    np.savez(folder / "a_gt.npz", times_us=truth.times, gt=truth.images)
    a, b = (
        Sequence(name=name, path=folder / f"{name}.h5", options=Options(), title=name.upper())
        for name in "ab"
    )
    return Set(folder, a, b)
