"""Homographies between images, and warping by them: known ones are found, unlikely ones refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from kalux.calibration.homography import find_features
from kalux.datasets.warping import (
    displacement,
    is_plausible,
    match_features,
    refined,
    resampled,
    tone_compressed,
    warped,
)

from builders import blocks, printed_on_threads

SIZE = (100, 130)


@pytest.fixture(scope="module")
def photograph():
    fine = blocks(0.02, 6.0, shape=(260, 340), count=900)
    return cv2.GaussianBlur(fine, (0, 0), 0.8).astype(np.float32)


def test_a_perspective_is_found(photograph):
    truth = np.array([[1.9, 0.06, 20.0], [-0.04, 1.95, 15.0], [2e-4, -1e-4, 1.0]])
    log = np.log(photograph + 0.02)
    fixed = np.log(warped(photograph, truth, SIZE) + 0.02)
    mask, everywhere = np.isfinite(fixed), np.ones(log.shape, bool)
    fixed = np.where(mask, fixed, 0)
    low, high = np.percentile(log, (1, 99))
    pictures = [tone_compressed(image, low, high) for image in (fixed, log)]
    match = match_features(find_features(pictures[0], mask), find_features(pictures[1], everywhere))
    assert displacement(match.matrix, truth, SIZE) < 3.0
    better, deviation = refined(fixed + 0.4, log, mask, everywhere, match.matrix)
    assert displacement(better, truth, SIZE) < 0.2
    assert deviation < 0.02


_REFINED = """
import numpy as np
from kalux.datasets.warping import refined
y, x = np.indices((240, 320))
image = np.sin(0.05 * x) + np.cos(0.04 * y + 0.01 * x)
mask = np.ones(image.shape, bool)
matrix = np.array([[1.0, 0.0, 0.3], [0.0, 1.0, -0.2], [0.0, 0.0, 1.0]])
print(refined(image, image, mask, mask, matrix)[0].tobytes())
"""


def test_the_last_bits_do_not_depend_on_the_number_of_threads():
    assert len(printed_on_threads(_REFINED)) == 1


def test_pictures_without_features_do_not_match():
    blank, mask = np.full(SIZE, 80, np.uint8), np.ones(SIZE, bool)
    match = match_features(find_features(blank, mask), find_features(blank, mask))
    assert (match.matrix, match.inliers) == (None, 0)


def test_a_larger_image_is_smoothed_before_it_is_made_smaller():
    fine = np.indices((300, 300)).sum(axis=0) % 2 * 1.0  # a chess board of pixels
    shrink = np.diag([3.0, 3.0, 1.0])
    seen = warped(fine, shrink, (90, 90))[5:-5, 5:-5]
    assert np.abs(seen - 0.5).max() < 0.05
    assert np.isnan(warped(fine, shrink, (120, 120))[-1, -1])
    assert np.ptp(resampled(fine.astype(np.float32), shrink, (90, 90), 0.0)) == 1.0


@pytest.mark.parametrize(
    ("matrix", "plausible"),
    [
        (np.eye(3), True),
        (np.diag([-1.0, 1.0, 1.0]), False),  # mirrored
        (np.diag([1e-3, 1e-3, 1.0]), False),
        (np.array([[1, 0, 0], [0, 1, 0], [-0.02, 0, 1.0]]), False),  # through infinity
    ],
)
def test_plausible_homographies(matrix, plausible):
    assert is_plausible(matrix, SIZE) == plausible
