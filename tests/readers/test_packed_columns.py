"""Columns unpacked without HDF5 are what HDF5 unpacks; anything odd is left to it."""

from __future__ import annotations

import struct

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalux.compiled import event_words
from kalux.errors import FormatError
from kalux.events import EVENT_DTYPE, make_events
from kalux.readers import hdf5
from kalux.readers.packed_columns import _BITS, _ODD, PackedColumns, _checksum, _planes

LENGTH = 1 << 17


def some_events(count, start, span, seed=0):
    rng = np.random.default_rng(seed)
    t = start + np.sort(rng.integers(0, span, count))
    x, y = rng.integers(0, [[640], [480]], (2, count))
    return make_events(t, x, y, rng.random(count) < 0.5)


def written(path, events):
    hdf5.write(path, sensor_size=(480, 640), events=[events], frames=[])
    return path


def columns_of(file):
    return [file["events"][name] for name in "txyp"]


def naive_checksum(data):
    """Fletcher's sums as HDF5 takes them (H5checksum.c): big-endian pairs, folded to 16 bits."""
    first = second = 0
    for at in range(0, len(data), 2):
        first += int.from_bytes(data[at : at + 2].ljust(2, b"\0"), "big")
        second += first
        first, second = ((total & 0xFFFF) + (total >> 16) for total in (first, second))
    first, second = ((total & 0xFFFF) + (total >> 16) for total in (first, second))
    return second << 16 | first


@pytest.mark.parametrize(
    ("count", "start", "span"),
    [
        (1, 0, 1),
        (1000, 5, 10),
        (LENGTH, 1 << 40, 8_000),
        (LENGTH + 9, -(1 << 33), 1 << 34),
        (9, 1 << 23, 1 << 25),
    ],
)
def test_events_are_those_that_hdf5_unpacks(tmp_path, monkeypatch, count, start, span):
    events = some_events(count, start, span)
    path = written(tmp_path / "a.h5", events)
    with h5py.File(path) as file:
        packed = PackedColumns.of(columns_of(file))
        for first in range(0, count, LENGTH):
            found = np.empty(min(LENGTH, count - first), EVENT_DTYPE)
            assert packed.unpack(first, event_words(found))
            assert (found == events[first : first + LENGTH]).all()
    monkeypatch.setattr(PackedColumns, "unpack", lambda *_: False)
    assert (np.concatenate(list(hdf5.read(path).events())) == events).all()


@given(st.binary(max_size=1500) | st.integers(0, 1500).map(lambda n: b"\xff" * n))
@settings(max_examples=60, deadline=None)
def test_the_checksum_is_that_of_hdf5(data):
    assert _checksum(memoryview(data)) == naive_checksum(data)


def test_columns_of_another_layout_are_left_to_hdf5(tmp_path):
    events = some_events(300, 0, 5000)
    path = written(tmp_path / "a.h5", events)
    with h5py.File(path, "a") as file:
        del file["events"]["x"]
        file["events"].create_dataset("x", data=events["x"], chunks=(64,), compression="gzip")
        assert PackedColumns.of(columns_of(file)) is None
    assert (np.concatenate(list(hdf5.read(path).events())) == events).all()


def test_a_chunk_that_is_not_packed_is_left_to_hdf5(tmp_path):
    rng = np.random.default_rng(0)
    noise = make_events(
        np.sort(rng.integers(0, 1 << 60, LENGTH)),
        *rng.integers(0, 1 << 16, (2, LENGTH)),
        rng.random(LENGTH) < 0.5,
    )
    path = written(tmp_path / "a.h5", noise)
    assert (np.concatenate(list(hdf5.read(path).events())) == noise).all()


@pytest.mark.parametrize("place", [0, 2, 20, 400, -1])
def test_a_damaged_chunk_is_told_by_hdf5(tmp_path, place):
    path = written(tmp_path / "a.h5", some_events(5000, 0, 90_000))
    with h5py.File(path) as file:
        stored = columns_of(file)[1].id.get_chunk_info(0)
    data = bytearray(path.read_bytes())
    data[stored.byte_offset + (place if place >= 0 else stored.size - 1)] ^= 0x10
    path.write_bytes(data)
    with h5py.File(path) as file:
        assert not PackedColumns.of(columns_of(file)).unpack(0, np.empty((5000, 2), np.int64))
    with pytest.raises(FormatError, match="damaged or incomplete"):
        list(hdf5.read(path).events())


@given(st.integers(0, 29), st.integers(0, 255))
@settings(max_examples=80, deadline=None)
def test_odd_numbers_under_a_right_checksum_are_no_crash(chunk, place, value):
    changed = bytearray(chunk[:-4])
    changed[place] = value
    changed += struct.pack("<I", naive_checksum(bytes(changed)))
    try:
        found = _planes(bytes(changed), 2, _BITS, LENGTH)
    except _ODD:
        return
    assert found is None or [len(plane) for plane in found] == [LENGTH, LENGTH]


@pytest.fixture(scope="module")
def chunk(tmp_path_factory):
    path = written(tmp_path_factory.mktemp("packed") / "a.h5", some_events(2000, 0, 90_000))
    with h5py.File(path) as file:
        return columns_of(file)[1].id.read_direct_chunk((0,))[1]
