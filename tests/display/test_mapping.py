"""Tone mapping: range, order, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from curves import ALL
from kalux.display import (
    Clahe,
    DisplaySettings,
    Linear,
    Reinhard,
    apply,
    encode_srgb,
    measure,
    quantised,
    to_uint8,
    to_uint16,
    tone_map,
)
from kalux.errors import InputError

INTENSITIES = hnp.arrays(
    np.float32,
    hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=24),
    elements=st.floats(0, float(np.float32(1e30)), width=32)
    | st.floats(0, 2, width=32)
    | st.sampled_from([0.0, 1.0, float(np.float32(3e38)), float(np.float32(1e-40))]),
)


@pytest.mark.parametrize("curve", ALL, ids=str)
@pytest.mark.parametrize("encoding", ["curve", "none", "srgb", "gamma"])
@settings(max_examples=15, deadline=None)
@given(intensity=INTENSITIES)
def test_mapped_values_are_finite_and_in_range(curve, encoding, intensity):
    mapped = tone_map(intensity, DisplaySettings(curve, encoding=encoding))
    assert mapped.dtype == np.float32
    assert mapped.shape == intensity.shape
    assert np.isfinite(mapped).all()
    assert mapped.min() >= 0
    assert mapped.max() <= 1


@pytest.mark.parametrize("curve", [c for c in ALL if not isinstance(c, Clahe)], ids=str)
@settings(max_examples=60, deadline=None)
@given(intensity=INTENSITIES)
def test_a_brighter_pixel_is_never_darker(curve, intensity):
    mapped = tone_map(intensity, DisplaySettings(curve)).ravel()
    order = np.argsort(intensity.ravel(), kind="stable")
    assert (np.diff(mapped[order]) >= -1e-6).all()


@pytest.mark.parametrize("curve", ALL, ids=str)
def test_a_black_image_is_shown(curve):
    assert np.isfinite(tone_map(np.zeros((5, 7), np.float32), DisplaySettings(curve))).all()


def test_gamma_and_default_encodings():
    half = np.full((2, 2), 0.5, np.float32)
    linear = DisplaySettings(Linear(), encoding="gamma", gamma=2)
    np.testing.assert_allclose(tone_map(half, linear), np.sqrt(0.5), rtol=1e-6)
    bare = tone_map(half, DisplaySettings(Reinhard(), encoding="none"))
    np.testing.assert_allclose(tone_map(half, DisplaySettings(Reinhard())), encode_srgb(bare), rtol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(bad):
    intensity = np.zeros((4, 5), np.float32)
    intensity[2, 3] = bad
    with pytest.raises(InputError, match="x=3, y=2"):
        tone_map(intensity)


@pytest.mark.parametrize("shape", [(3,), (2, 2, 4), (0, 4)])
def test_other_shapes_are_refused(shape):
    with pytest.raises(InputError, match="shape"):
        tone_map(np.zeros(shape, np.float32))


@pytest.mark.parametrize("curve", ALL, ids=str)
@pytest.mark.parametrize("shape", [(7, 9), (7, 9, 3)])
def test_whole_numbers_are_those_of_the_mapped_values(curve, shape):
    """Also where the curve goes straight to them."""
    intensity = np.random.default_rng(0).gamma(1.0, 0.7, shape).astype(np.float32)
    for display in (DisplaySettings(curve), DisplaySettings(curve, encoding="srgb")):
        statistics = measure(intensity, curve)
        mapped = apply(intensity, display, statistics)
        np.testing.assert_array_equal(quantised(intensity, display, statistics, np.uint8), to_uint8(mapped))
        found = quantised(intensity, display, statistics, np.uint16)
        np.testing.assert_array_equal(found, to_uint16(mapped))
        assert found.dtype == np.uint16
