"""Elementary functions in float32, and events as machine words."""

from __future__ import annotations

import numba as nb
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.compiled import (
    INFINITE_BITS,
    apart,
    event_column,
    event_is_on,
    event_row,
    event_words,
    exponential,
    larger,
    largest_around,
    logarithm,
    magnitude_bits,
    pack,
    smaller,
    unpack,
    word_at,
)
from kalux.events import EVENT_DTYPE


def over(function, values):
    @nb.njit(error_model="numpy")
    def run(values):
        out = np.empty_like(values)
        for i in range(len(values)):
            out[i] = function(values[i])
        return out

    return run(values)


def test_the_exponential_is_good_to_float32():
    x = np.linspace(-86.9, 87.9, 1_000_001).astype(np.float32)
    np.testing.assert_allclose(over(exponential, x), np.exp(x.astype(np.float64)), rtol=2e-7)


def test_the_exponential_ends_in_finite_numbers():
    out = over(exponential, np.array([-1e30, -100.0, 0.0, 100.0, 1e30], np.float32))
    assert np.isfinite(out).all()
    assert 0 < out[0] == out[1] < 1e-37
    assert out[2] == 1.0
    assert 1e38 < out[3] == out[4]


def test_the_logarithm_is_good_to_float32():
    x = np.exp(np.linspace(-87.0, 88.0, 1_000_001)).astype(np.float32)
    np.testing.assert_allclose(over(logarithm, x), np.log(x.astype(np.float64)), rtol=2e-7, atol=1e-7)
    near_one = np.linspace(0.7, 1.5, 100_001).astype(np.float32)
    np.testing.assert_allclose(over(logarithm, near_one), np.log(near_one.astype(np.float64)), atol=6e-8)
    assert over(logarithm, np.ones(1, np.float32))[0] == 0.0


@nb.njit
def fields_of(word):
    return event_column(word), event_row(word), event_is_on(word)


@given(
    st.integers(-(2**62), 2**62),
    st.integers(0, 65535),
    st.integers(0, 65535),
    st.booleans(),
    st.binary(min_size=16, max_size=16),
)
def test_an_event_is_two_words_whatever_its_padding_holds(t, x, y, p, memory):
    events = np.frombuffer(bytearray(memory), EVENT_DTYPE)
    events["t"], events["x"], events["y"], events["p"] = t, x, y, p
    words = event_words(events)
    assert words[0, 0] == t
    assert fields_of(words[0, 1]) == (x, y, p)


def test_words_share_the_memory():
    events = np.zeros(3, EVENT_DTYPE)
    event_words(events[1:])[0, 0] = 7
    assert events["t"].tolist() == [0, 7, 0]


@nb.njit
def ends(one, other):
    return smaller(one, other), larger(one, other)


@pytest.mark.parametrize(
    ("one", "other"), [(1, 2), (2, 1), (1, -0.5), (np.nan, 1.0), (1.0, np.nan), (np.int32(3), 2**40)]
)
def test_the_smaller_and_the_larger_are_those_of_python(one, other):
    np.testing.assert_array_equal(ends(one, other), (min(one, other), max(one, other)))


@nb.njit
def word_from(octets, place):
    return word_at(octets, place)


def test_a_word_is_eight_bytes_from_any_place():
    octets = np.arange(20, dtype=np.uint8)
    assert word_from(octets, np.uint64(3)) == int.from_bytes(bytes(range(3, 11)), "little")


@nb.njit
def largest_of_all(plane, stride, out):
    for at in range(np.uint64(stride + 1), np.uint64(len(plane) - stride - 1)):
        out[at] = largest_around(plane, at, stride)


def test_the_largest_of_nine_up_to_the_last_pixel():
    plane = np.random.default_rng(0).integers(-(2**30), 2**30, (7, 9)).astype(np.int32)
    out = np.zeros_like(plane)
    largest_of_all(plane.reshape(-1), np.uint64(9), out.reshape(-1))
    for row, column in np.ndindex(5, 7):
        assert out[row + 1, column + 1] == plane[row : row + 3, column : column + 3].max()


@nb.njit
def unpacked(records, first, count, planes):
    unpack(records, first, count, planes)


@pytest.mark.parametrize("names", ["ab", "abcdefgh"])
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 40])
def test_unpacked_records_are_their_fields(names, count):
    """Whole vectors and what is left over; nothing beyond them is written."""
    records = np.zeros(50, [(name, "f4") for name in names])
    records.view(np.float32)[:] = np.arange(50 * len(names))
    planes = np.full((len(names), 40), -1.0, np.float32)
    unpacked(records, 3, count, planes)
    for plane, name in zip(planes, names, strict=True):
        np.testing.assert_array_equal(plane[:count], records[name][3 : 3 + count])
    assert (planes[:, count:] == -1).all()


@nb.njit
def repacked(planes, records, first, count):
    pack(planes, records, first, count)


@pytest.mark.parametrize("names", ["ab", "abcdefgh"])
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 40])
def test_packed_records_have_the_fields_of_planes(names, count):
    """Whole vectors and what is left over; nothing beyond them is written."""
    records = np.full(50, -1, [(name, "f4") for name in names])
    planes = np.arange(40.0 * len(names), dtype=np.float32).reshape(len(names), 40)
    repacked(planes, records, 3, count)
    for plane, name in zip(planes, names, strict=True):
        np.testing.assert_array_equal(records[name][3 : 3 + count], plane[:count])
    assert (records.view(np.float32).reshape(50, -1)[[0, 1, 2, *range(3 + count, 50)]] == -1).all()


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (480, 640)])
def test_planes_apart_begin_at_different_places_of_a_page(shape):
    planes = apart(5, shape)
    assert planes.shape == (5, *shape)
    assert all(plane.flags.c_contiguous for plane in planes)
    begins = {plane.ctypes.data // 64 % 64 for plane in planes}
    assert len(begins) == 5
    planes[:] = np.arange(5)[:, None, None]
    assert all((plane == k).all() for k, plane in enumerate(planes))


@given(st.lists(st.floats(width=32), max_size=70))
def test_the_largest_bits_tell_infinite_from_finite_and_from_nan(numbers):
    values = np.array(numbers, np.float32)
    found = magnitude_bits(values)
    assert (found < INFINITE_BITS) == np.isfinite(values).all()
    assert (found > INFINITE_BITS) == np.isnan(values).any()
    assert magnitude_bits(np.stack([values, -values])[:, ::2]) == magnitude_bits(values[::2])


@given(st.floats(width=32))
def test_a_number_that_is_repeated_is_looked_at_once(number):
    one = np.array([number], np.float32)
    assert magnitude_bits(np.broadcast_to(one, (3, 5))) == magnitude_bits(one)
