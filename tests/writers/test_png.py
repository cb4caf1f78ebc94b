"""PNG files that other programs read back bit for bit."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalux.writers.png import png_bytes


def decoded(data):
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return picture[..., ::-1] if picture.ndim == 3 else picture


def random_picture(rng, shape, dtype):
    return rng.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


@settings(max_examples=80, deadline=None)
@given(
    st.integers(1, 40),
    st.integers(1, 40),
    st.booleans(),
    st.sampled_from([np.uint8, np.uint16]),
    st.integers(0, 99),
)
def test_opencv_reads_it_back(height, width, in_colour, dtype, seed):
    shape = (height, width, 3) if in_colour else (height, width)
    picture = random_picture(np.random.default_rng(seed), shape, dtype)
    read = decoded(png_bytes(picture))
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, picture)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(260, 346), (480, 640, 3), (1, 70_000)])
def test_large_pictures(shape, dtype):
    """More than one block of deflate; noise, which does not compress, and slopes, which do."""
    rng = np.random.default_rng(0)
    noise = random_picture(rng, shape, dtype)
    slope = np.add.outer(np.arange(shape[0]), np.arange(np.prod(shape[1:]))).reshape(shape).astype(dtype)
    for picture in (noise, slope):
        np.testing.assert_array_equal(decoded(png_bytes(picture)), picture)
    assert len(png_bytes(slope)) < slope.nbytes / 4 or shape[0] == 1


def test_any_layout_in_memory():
    picture = random_picture(np.random.default_rng(1), (24, 30, 3), np.uint16)
    for view in (
        picture[::-1],
        picture[:, ::2],
        picture[..., ::-1],
        picture[..., 1],
        picture.transpose(1, 0, 2),
    ):
        np.testing.assert_array_equal(decoded(png_bytes(view)), view)
    np.testing.assert_array_equal(decoded(png_bytes(picture.astype(">u2"))), picture)


def test_the_chunks_are_those_of_the_specification():
    data = png_bytes(np.array([[1, 2, 3], [1, 2, 770]], np.uint16))
    assert data[:8] == bytes([137, 80, 78, 71, 13, 10, 26, 10])
    chunks, rest = [], data[8:]
    while rest:
        (length,) = struct.unpack(">I", rest[:4])
        kind, body, (checksum,) = (
            rest[4:8],
            rest[8 : 8 + length],
            struct.unpack(">I", rest[8 + length : 12 + length]),
        )
        assert checksum == zlib.crc32(kind + body)
        chunks.append((kind, body))
        rest = rest[12 + length :]
    assert [kind for kind, _ in chunks] == [b"IHDR", b"IDAT", b"IEND"]
    assert chunks[0][1] == struct.pack(">IIBBBBB", 3, 2, 16, 0, 0, 0, 0)
    rows = zlib.decompress(chunks[1][1])
    assert rows == bytes([2, 0, 1, 0, 2, 0, 3, 2, 0, 0, 0, 0, 3, 255])


def test_the_same_picture_is_the_same_file():
    picture = random_picture(np.random.default_rng(2), (50, 60), np.uint16)
    assert png_bytes(picture) == png_bytes(picture.copy())


def test_what_deflate_does_not_shorten_is_stored_as_it_is():
    """16 bits of noise: the file is the picture's bytes and little else, and zlib reads it; a smooth one is shorter."""
    rng = np.random.default_rng(3)
    noise = random_picture(rng, (260, 346), np.uint16)
    assert noise.nbytes < len(png_bytes(noise)) < 1.005 * noise.nbytes
    smooth = (noise & 0x3FF) + np.uint16(20_000)
    assert len(png_bytes(smooth)) < 0.9 * smooth.nbytes
    np.testing.assert_array_equal(decoded(png_bytes(smooth)), smooth)
