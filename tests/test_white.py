"""White where nobody states it: found where a converter ends, doubted where it can hardly be right."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.frames import Frame
from kalux.white import WhiteCheck, white_of_bits


@pytest.mark.parametrize(
    ("values", "dtype", "white", "told"),
    [
        ((100, 1000), np.uint16, None, "--white 1023"),
        ((100, 4080), np.uint16, None, "--white 4095"),
        ((16383, 100), np.uint16, None, "--white 16383"),
        ((100, 16384), np.uint16, None, None),
        ((100, 4080), np.uint16, 4095, None),
        ((0, 0), np.uint16, None, None),
        ((10, 20), np.uint8, None, None),
        ((0.5, 255.0), np.float32, None, "--white 255"),
        ((0.5, 3.0), np.float32, None, None),
    ],
)
def test_a_white_value_that_can_hardly_be_right_is_doubted(values, dtype, white, told):
    frames = [Frame(np.full((2, 2), value, dtype), 0, 1, white) for value in values]
    check = WhiteCheck()
    assert list(check.watched(frames)) == frames
    doubt = check.doubt()
    assert check.found() == (frames[-1].white_value, told is not None)
    assert doubt is None if told is None else told in doubt


@pytest.mark.parametrize(
    ("values", "dtype", "white", "found"),
    [
        ((100, 1023), np.uint16, None, 1023),
        ((4095, 100), np.uint16, None, 4095),
        ((255, 16383, 0), np.uint16, None, 16383),
        ((100, 255), np.uint16, None, 255),
        ((100, 4094), np.uint16, None, None),
        ((100, 4096), np.uint16, None, None),
        ((4095, 65535), np.uint16, None, None),
        ((100, 4095), np.uint16, 65535, None),
        ((100, 255), np.uint8, None, None),
        ((100, 4095.0), np.float32, None, None),
        ((0, 0), np.uint16, None, None),
        ((), np.uint16, None, None),
    ],
)
def test_white_is_where_a_converter_ends(values, dtype, white, found):
    assert white_of_bits(Frame(np.full((2, 2), v, dtype), 0, 1, white) for v in values) == found


@pytest.mark.parametrize(("count", "found"), [(4, None), (5, 4095)])
def test_a_few_broken_pixels_are_no_white(count, found):
    image = np.full((50, 100), 7, np.uint16)
    image.flat[:count] = 4095
    assert white_of_bits([Frame(image, 0, 1)]) == found
    assert white_of_bits([Frame(image, t, t + 1) for t in range(3)]) == found


@pytest.mark.parametrize(
    ("largest", "white", "doubted"), [(1.0, 255.0, True), (40.0, 255.0, False), (1.0, 1.0, False)]
)
def test_floats_of_another_unit_than_the_stated_white_are_doubted(largest, white, doubted):
    """As `.mat` files of the authors' layout, where 255 is white, with images from 0 to 1."""
    check = WhiteCheck()
    image = np.linspace(0, largest, 64).reshape(8, 8)
    assert len([*check.watched([Frame(image, 0, 10, white=white)])]) == 1
    told = check.doubt()
    assert (told is not None) == doubted
    assert (
        not doubted
        or "255 is taken for white; if they are in units of white, give --white 1 (white=1)" in told
    )
