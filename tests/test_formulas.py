"""Formulas of loops: what numba makes of the same Python, bit for bit."""

from __future__ import annotations

import numba as nb
import numpy as np
import pytest
from numba.core import types

from kalux.formulas import LANES, Number, Pixels, choose, formula, row_formula


@formula(types.float32)
def of_floats(a, b):
    return choose(a < b, np.float32(2.0) / (a - b), (np.float32(1.0) - a) * b + a) + np.float32(0.5)


@formula(types.int64)
def of_integers(a, b):
    changed = (b & np.int64(0xFF)) << np.int64(3)
    return choose(a > b, (a >> np.int64(2)) | changed, np.int64(7) - a) + choose(a != b, b, a)


@formula(types.float32)
def converted(word, small):
    high = (word.to(types.uint64) >> np.uint64(60)).to(types.int32).to(types.float32)
    return high + small.to(types.float32) + small.to(types.int64).to(types.float32) + word.to(types.float32)


def called(function):
    return nb.njit(lambda a, b: function(a, b), error_model="numpy")


def test_a_formula_is_what_numpy_makes_of_its_operations() -> None:
    one, half = np.float32(1.0), np.float32(0.5)
    function = called(of_floats)
    for a, b in np.random.default_rng(0).normal(size=(50, 2)).astype(np.float32):
        assert function(a, b) == (np.float32(2.0) / (a - b) if a < b else (one - a) * b + a) + half


@pytest.mark.parametrize("a", [-9, 0, 5, 2**40])
@pytest.mark.parametrize("b", [-300, 5, 2**33 + 17])
def test_whole_numbers_keep_their_sign_when_shifted(a, b) -> None:
    expected = (a >> 2 | (b & 0xFF) << 3 if a > b else 7 - a) + (b if a != b else a)
    assert called(of_integers)(a, b) == expected


@pytest.mark.parametrize("word", [-1, -(2**62), 2**62 + 12345, 0])
def test_conversions_know_signs(word) -> None:
    expected = np.float32((word % 2**64) >> 60) + np.float32(-3) + np.float32(-3) + np.float32(word)
    assert called(converted)(word, np.int8(-3)) == expected


@formula()
def shifted(row, at, other):
    other[at] = row[at + np.uint64(1)] - row[at]


@nb.njit
def over(row, other):
    for at in range(np.uint64(len(other))):
        shifted(row, at, other)


def test_rows_are_looked_up_and_filled() -> None:
    row, other = np.array([1.0, 4.0, 9.0, 7.0], np.float32), np.empty(3, np.float32)
    over(row, other)
    assert other.tolist() == [3.0, 5.0, -2.0]


def test_rows_with_gaps_are_refused() -> None:
    with pytest.raises((TypeError, nb.core.errors.NumbaError), match="without gaps"):
        over(np.zeros(8, np.float32)[::2], np.empty(3, np.float32))


def test_numbers_of_different_types_are_refused() -> None:
    with pytest.raises((TypeError, nb.core.errors.NumbaError), match="float64 and float32 in one operation"):
        called(of_floats)(1.0, 2.0)


@row_formula
def smoothed(out: Pixels, whole: Pixels, row: Pixels, factor: Number) -> None:
    mean = (row[-1] + row[0] + row[1]) * factor
    mean = choose(mean < np.float32(0.0), np.float32(1.0) - mean, mean) + factor
    out[0] = mean
    whole[0] = mean.to(types.int32)


@nb.njit
def along(count, out, whole, at, row, factor):
    smoothed(count, out, at, whole, np.uint64(0), row, np.uint64(1), factor)


@pytest.mark.parametrize("count", [0, 1, LANES - 1, LANES, LANES + 1, 3 * LANES + 5])
def test_a_row_formula_is_its_operations_at_every_pixel_of_a_row_and_no_other(count) -> None:
    row = np.random.default_rng(count).normal(0.0, 100.0, count + 2).astype(np.float32)
    out, whole = np.full(count + 5, 7.0, np.float32), np.full(count + 3, 7, np.int32)
    factor = np.float32(0.25)
    along(np.uint64(count), out, whole, np.uint64(2), row, factor)
    mean = (row[:-2] + row[1:-1] + row[2:]) * factor
    mean = np.where(mean < 0.0, np.float32(1.0) - mean, mean) + factor
    np.testing.assert_array_equal(out, [7.0, 7.0, *mean, 7.0, 7.0, 7.0])
    np.testing.assert_array_equal(whole, [*mean.astype(np.int32), 7, 7, 7])


def test_rows_of_a_row_formula_are_flat_and_begin_at_whole_numbers() -> None:
    row, whole, factor = np.zeros(20, np.float32), np.zeros(20, np.int32), np.float32(1.0)
    with pytest.raises((TypeError, nb.core.errors.NumbaError), match="without gaps"):
        along(np.uint64(3), row[::2], whole, np.uint64(0), row, factor)
    with pytest.raises((TypeError, nb.core.errors.NumbaError), match="places uint64"):
        along(np.uint64(3), row, whole, 0.0, row, factor)
