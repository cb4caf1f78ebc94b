"""Photographs of a bracket are aligned, or it is told that they are not."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.datasets.bracket_alignment import align
from kalux.datasets.brackets import Picture, best_exposed
from kalux.datasets.hdr import hdr_reference
from kalux.datasets.warping import warped
from kalux.models.camera import Response
from kalux.models.colour import LUMINANCE
from photographs import SHAPE, photographs, scene_radiance


@pytest.fixture
def scene():
    return scene_radiance()


def test_photographs_are_aligned(scene):
    """Shifted and turned by a few pixels: as sharp as if they had not been."""
    turn = np.array([[0.9995, -0.012, 4.0], [0.012, 0.9995, -2.5], [0.0, 0.0, 1.0]])

    def moved(k, radiance):
        return np.nan_to_num(warped(radiance, np.linalg.matrix_power(turn, k), SHAPE)) if k else radiance

    pictures = photographs(scene, change=moved)
    found = align(pictures)
    best = best_exposed(pictures)
    assert found[best].said == "the reference of the alignment"
    assert all("aligned" in a.said for k, a in enumerate(found) if k != best)
    inside = np.s_[30:-30, 30:-30]
    still = np.linalg.matrix_power(turn, best)
    truth = np.nan_to_num(warped(scene, still, SHAPE))
    reference = hdr_reference(pictures, response=Response.srgb())
    light = np.maximum(reference.luminance, 1e-6) / (truth @ LUMINANCE + 1e-6)
    ratio = np.log(light)[inside][reference.valid[inside]]
    assert 1.4826 * np.median(np.abs(ratio - np.median(ratio))) < 0.04


def test_an_exposure_that_cannot_be_aligned_is_told(scene):
    dark = Picture("dark.png", np.zeros((*SHAPE, 3), np.uint8), 1 / 4000)
    found = align([*photographs(scene), dark])
    assert "too few to align it" in found[-1].said
    assert found[-1].moved is None
