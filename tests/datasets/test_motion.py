"""Motions of the camera."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from kalux.datasets import Pose, combine, dolly, handheld, pan, shake, spin
from kalux.errors import InputError


def test_motions_combine() -> None:
    both = combine(pan(10, 20), pan(1, 2), spin(0.5), dolly(0.1), dolly(0.2))(2e6)
    assert both == pytest.approx(Pose(22, 44, 1.0, np.exp(0.6)))


@pytest.mark.parametrize("make", [shake, handheld])
def test_random_motion_follows_its_seed(make: Any) -> None:
    times = np.linspace(0, 1e6, 7)
    assert [make(3)(t) for t in times] == [make(3)(t) for t in times]
    assert make(3)(5e5) != make(4)(5e5)


def test_shake_has_its_amplitude() -> None:
    motion = shake(1, amplitude=2.0, roll=0.01)
    poses = np.array([motion(t) for t in np.linspace(0, 60e6, 6000)])
    assert poses[:, :2].std(axis=0) == pytest.approx(2.0, rel=0.05)
    assert poses[:, 2].std() == pytest.approx(0.01, rel=0.05)


def test_a_negative_displacement_is_refused() -> None:
    with pytest.raises(InputError, match=r"shake: amplitude -1.*0 or more"):
        shake(0, amplitude=-1.0)
    with pytest.raises(InputError, match="shake: amplitude -6"):
        handheld(0, sway=-6.0)
