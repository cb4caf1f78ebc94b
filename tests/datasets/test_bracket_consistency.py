"""What moved between exposures: nothing where nothing did. (Where it did: `test_hdr`.)"""

from __future__ import annotations

import numpy as np
import pytest

from kalux.datasets.bracket_consistency import consistency
from kalux.models.camera import Response
from photographs import SHAPE, photographs, scene_radiance


@pytest.fixture
def scene():
    return scene_radiance()


def test_nothing_moved_nothing_left_out(scene):
    pictures = photographs(scene)
    everywhere = [np.ones(SHAPE, bool)] * len(pictures)
    found = consistency(pictures, Response.srgb(), everywhere, 0.03)
    assert found.moved.mean() < 0.002
    assert found.unsettled.mean() < 0.002
