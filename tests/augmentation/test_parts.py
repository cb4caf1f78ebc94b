"""Sums over parts of an image, weighted by how near they are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kalux.augmentation.parts import ALL, PART, interpolated, interpolated_plane, part_sums, weighted_sums

SIZES = st.tuples(st.integers(1, 12), st.integers(1, 12))


def weights(count, farthest):
    """(N, N) weights of parts in a row for each other."""
    away = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return np.where(away < farthest, np.exp(-0.5 * (away * PART / 8.0) ** 2), 0.0)


@given(SIZES.flatmap(lambda size: arrays(np.float64, size, elements=st.floats(0, 100))), st.integers(1, ALL))
def test_weighted_sums_are_of_all_parts_up_to_the_farthest(parts, farthest):
    rows, columns = parts.shape
    expected = weights(rows, farthest) @ parts @ weights(columns, farthest)
    np.testing.assert_allclose(weighted_sums(parts, farthest), expected, rtol=1e-12, atol=1e-300)


def test_what_is_far_counts_where_nothing_is_near():
    """Its weight is next to nothing, but not nothing: a ratio of two sums is that of the far ones."""
    sums = np.zeros((2, 3, 30))
    sums[:, 1, 0] = 3.0, 4.0
    first, second = map(weighted_sums, sums)
    assert (first > 0).all()
    np.testing.assert_allclose(first / second, 0.75, rtol=1e-12)


@given(SIZES, st.integers(0, 2**32 - 1))
def test_parts_sum_all_pixels_also_at_the_right_and_below(size, seed):
    values = np.random.default_rng(seed).random(size).astype(np.float32)
    assert part_sums(values).sum() == pytest.approx(values.sum(dtype=np.float64), rel=1e-5)


def test_values_of_parts_are_read_between_their_middles():
    parts = np.arange(12, dtype=np.float32).reshape(3, 4)
    plane = interpolated_plane(parts, (20, 27))
    pixels = np.arange(20 * 27)
    np.testing.assert_allclose(interpolated(parts, pixels, 27).reshape(20, 27), plane, atol=1e-5)
    assert plane[11:13, 11:13].mean() == pytest.approx(parts[1, 1])
