"""The picture of a bracket's response: photographs that follow it lie on its curve."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.datasets.hdr_plot import response_plot
from kalux.models.camera import Response
from photographs import photographs, scene_radiance


@pytest.fixture
def scene():
    return scene_radiance()


def test_photographs_lie_on_the_response_that_made_them(scene):
    """Dots hide the curve where the response is theirs; of another they lie beside it."""
    pictures = photographs(scene, response=Response.gamma(1.5))
    shown = []
    for curve in (Response.gamma(1.5), Response.linear()):
        plot = response_plot(pictures, curve)
        assert plot.shape == (480, 640, 3)
        blank = response_plot([], curve)
        dots = (plot == (40, 90, 160)).all(axis=2)
        on_curve = (blank == (190, 60, 30)).all(axis=2)
        shown.append(np.count_nonzero(dots & on_curve) / np.count_nonzero(dots))
    assert shown[0] > 3 * shown[1]
