"""Pictures of the report: decoded again, they are what they must be."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from kalux.evaluation.benchmark.pictures import (
    MAP_LIMITS,
    coloured,
    error_map,
    gradient,
    indexed_png,
    shown,
    uncertainty_map,
)


def decoded(uri):
    kind, data = uri.split(",", 1)
    assert kind == "data:image/png;base64"
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)
    return picture if picture.ndim == 2 else picture[..., ::-1]


def test_an_indexed_png_is_its_palette_by_its_indices():
    rng = np.random.default_rng(0)
    palette = rng.integers(0, 256, (7, 3), dtype=np.uint8)
    indices = rng.integers(0, 7, (5, 9), dtype=np.uint8)
    picture = cv2.imdecode(np.frombuffer(indexed_png(indices, palette), np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(picture[..., ::-1], palette[indices])


def test_larger_is_lighter_and_what_is_beyond_the_limits_has_their_colour():
    low, high = MAP_LIMITS
    picture = (
        decoded(coloured(np.array([[0.0, low, 0.03, 0.1, 0.3, high, np.inf]]))).astype(int).sum(axis=-1)[0]
    )
    assert picture[0] == picture[1]
    assert picture[5] == picture[6]
    assert (np.diff(picture[1:6]) > 0).all()
    assert gradient().count("#") >= 16


def test_an_error_and_its_uncertainty_have_the_same_colour_whatever_the_offset_of_the_method():
    reference = np.full((4, 4), 0.3)
    test = np.exp(np.log(reference + 0.02) + 0.1) - 0.02
    error = decoded(error_map(test, reference))
    for offset in (0.02, 1.0):
        # A deviation of 0.1 in log(I + 0.02) is one of 0.1 (I + 0.02) / (I + offset) in log(I + offset).
        variance = (0.1 * (test + 0.02) / (test + offset)) ** 2
        assert np.array_equal(decoded(uncertainty_map(variance, test, offset)), error)


def test_what_is_not_compared_is_black_and_all_pictures_share_a_curve():
    reference = np.linspace(0, 4, 48).reshape(6, 8)
    holed = reference.copy()
    holed[0, 0] = np.nan
    pictures = shown({"a": reference, "b": reference / 2, "c": holed}, holed)
    a, b, c = (decoded(pictures[name]).astype(int) for name in "abc")
    assert c[0, 0] == 0
    assert (np.diff(a.ravel()) >= 0).all()
    assert (b <= a).all()
    assert b[-1, -1] < a[-1, -1]
    assert decoded(error_map(reference, holed))[0, 0].sum() == decoded(coloured(np.zeros((1, 1))))[0, 0].sum()
