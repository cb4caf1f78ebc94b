"""EXR files: what OpenEXR's own library reads is what was written, bit for bit."""

from __future__ import annotations

import io
import struct

import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.writers.exr import exr_file


def read(data: bytes) -> tuple[dict[str, np.ndarray], dict]:
    file = OpenEXR.File(io.BytesIO(data), separate_channels=True)
    return {name: channel.pixels for name, channel in file.channels().items()}, file.header()


def bits(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values).view(np.uint32)


@given(
    height=st.integers(1, 50),
    width=st.integers(1, 40),
    names=st.sets(st.sampled_from(["Y", "R", "G", "B", "variance", "a" * 31]), min_size=1),
    kind=st.sampled_from(["constant", "smooth", "any bits"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_openexr_reads_it_back(height, width, names, kind, seed):
    """Any size, also of incomplete blocks of lines, and any values, also infinite ones and NaN."""
    rng = np.random.default_rng(seed)
    channels = {
        name: {
            "constant": np.full((height, width), rng.normal(), np.float32),
            "smooth": np.linspace(0, 1, height * width, dtype=np.float32).reshape(height, width),
            "any bits": rng.integers(0, 2**32, (height, width), np.uint32).view(np.float32),
        }[kind]
        for name in sorted(names)
    }
    found, header = read(exr_file(channels, {"t_us": "-17"}))
    assert set(found) == names
    for name, values in channels.items():
        assert found[name].dtype == np.float32
        np.testing.assert_array_equal(bits(found[name]), bits(values))
    assert header["t_us"] == "-17"
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION


@pytest.mark.parametrize("shape", [(180, 240), (480, 640)])
def test_large_images(shape):
    values = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    steps = np.round(values * 4) / 4
    found, _ = read(exr_file({"Y": values, "variance": steps}, {}))
    np.testing.assert_array_equal(found["Y"], values)
    np.testing.assert_array_equal(found["variance"], steps)


def test_any_layout_in_memory():
    values = np.random.default_rng(0).normal(size=(40, 60)).astype(np.float32)
    for view in (values.T, values[::-1], values[:, ::2], values.astype(">f4")):
        found, _ = read(exr_file({"Y": view}, {}))
        np.testing.assert_array_equal(found["Y"], view)


def test_it_is_as_small_as_openexrs_own():
    """Within 3 %: on a smooth image, as one without compression or without its preparation would not be."""
    y, x = np.mgrid[:240, :320].astype(np.float32)
    channels = {
        "Y": np.sin(x / 31) * np.cos(y / 23) + 1,
        "variance": np.round(np.sin(x / 31) * 16).astype(np.float32),
    }
    other = io.BytesIO()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, dict(channels)).write(other)
    ours = len(exr_file(channels, {}))
    assert ours < 0.8 * 240 * 320 * 8
    assert ours < 1.03 * len(other.getvalue())


def test_noise_is_stored_as_it_is():
    """Blocks that compression would enlarge are not compressed: a header, a table, and the values."""
    values = np.random.default_rng(0).integers(0, 2**32, (32, 64), np.uint32).view(np.float32)
    data = exr_file({"Y": values}, {})
    assert data[-16 * 64 * 4 :] == values[16:].tobytes()
    assert struct.unpack("<2i", data[-16 * 64 * 4 - 8 : -16 * 64 * 4]) == (16, 16 * 64 * 4)


def test_the_same_image_is_the_same_file():
    values = np.random.default_rng(0).normal(size=(33, 20)).astype(np.float32)
    assert exr_file({"Y": values}, {"t_us": "1"}) == exr_file({"Y": values.copy()}, {"t_us": "1"})


def header_length(data: bytes) -> int:
    """Magic and version, then attributes: name, type, size, value; an empty name ends them."""
    at = 8
    while data[at] != 0:
        at = data.index(b"\0", data.index(b"\0", at) + 1) + 1
        at += 4 + struct.unpack_from("<i", data, at)[0]
    return at + 1


@pytest.mark.parametrize("height", [1, 16, 17, 50])
def test_the_table_says_where_each_block_begins(height):
    """OpenEXR's own library finds blocks without it, other readers do not."""
    values = np.random.default_rng(0).normal(size=(height, 30)).round().astype(np.float32)
    data = exr_file({"Y": values, "variance": values}, {"t_us": "5"})
    count = -(-height // 16)
    offsets = struct.unpack_from(f"<{count}Q", data, header_length(data))
    ends = [*offsets[1:], len(data)]
    assert offsets[0] == header_length(data) + 8 * count
    for index, (start, end) in enumerate(zip(offsets, ends, strict=True)):
        line, size = struct.unpack_from("<2i", data, start)
        assert (line, start + 8 + size) == (16 * index, end)
