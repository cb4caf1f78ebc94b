"""OpenEXR files of other programs: what is read of each kind, and what is refused."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from kalux.datasets.exr import exr_channels, exr_image, is_exr
from kalux.errors import FormatError

RNG = np.random.default_rng(0)
PATH = Path("a.exr")
PLANES = {n: RNG.uniform(0, 20, (40, 70)).astype(np.float16) for n in ("R", "G", "B", "A")}


def encoded(channels: dict[str, object], **header: object) -> bytes:
    file = io.BytesIO()
    described = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | header
    OpenEXR.File(described, channels).write(file)
    return file.getvalue()


@pytest.mark.parametrize(
    "header",
    [
        {},
        {"compression": OpenEXR.PIZ_COMPRESSION},
        {"compression": OpenEXR.NO_COMPRESSION},
        {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()},
    ],
)
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_every_kind_gives_the_same_colours(header: dict[str, object], dtype: type) -> None:
    data = encoded({n: np.ascontiguousarray(p, dtype) for n, p in PLANES.items()}, **header)
    channels = exr_channels(PATH, data)
    assert channels.keys() == PLANES.keys()
    image = exr_image(PATH, channels)
    assert image.dtype == np.float32
    assert np.array_equal(image, np.stack([PLANES[n] for n in "RGB"], axis=-1).astype(np.float32))


def luminance_and_chroma(y: np.ndarray, chroma: np.ndarray) -> bytes:
    """Y, and RY and BY of half its height and width, not compressed: the bindings cannot write such a file."""
    height, width = y.shape

    def attribute(name: bytes, kind: bytes, value: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value

    channels = b"".join(
        name + b"\0" + struct.pack("<iB3xii", 1, 0, step, step)
        for name, step in ((b"BY", 2), (b"RY", 2), (b"Y", 1))
    )
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = b"".join(
        (
            struct.pack("<ii", 20000630, 2),
            attribute(b"channels", b"chlist", channels + b"\0"),
            attribute(b"compression", b"compression", b"\0"),
            attribute(b"dataWindow", b"box2i", window),
            attribute(b"displayWindow", b"box2i", window),
            attribute(b"lineOrder", b"lineOrder", b"\0"),
            attribute(b"pixelAspectRatio", b"float", struct.pack("<f", 1)),
            attribute(b"screenWindowCenter", b"v2f", bytes(8)),
            attribute(b"screenWindowWidth", b"float", struct.pack("<f", 1)),
            b"\0",
        )
    )
    blocks, offsets, place = [], [], len(header) + 8 * height
    for row in range(height):
        line = b"" if row % 2 else 2 * chroma[row // 2].tobytes()
        blocks.append(struct.pack("<ii", row, len(line) + 2 * width) + line + y[row].tobytes())
        offsets.append(place)
        place += len(blocks[-1])
    return header + struct.pack(f"<{height}Q", *offsets) + b"".join(blocks)


def test_of_luminance_and_chroma_the_luminance_is_taken() -> None:
    data = luminance_and_chroma(PLANES["G"], RNG.normal(size=(20, 35)).astype(np.float16))
    channels = exr_channels(PATH, data)
    assert channels.keys() == {"Y"}
    assert np.array_equal(exr_image(PATH, channels), PLANES["G"].astype(np.float32))


def test_a_deep_image_says_what_to_do() -> None:
    values = np.empty((4, 5), object)
    for place in np.ndindex(values.shape):
        values[place] = np.arange(1 + place[1] % 2, dtype=np.float32)
    data = encoded({"Y": values}, type=OpenEXR.deepscanline, compression=OpenEXR.ZIPS_COMPRESSION)
    with pytest.raises(FormatError, match=r"a\.exr: a deep image.*flattened"):
        exr_channels(PATH, data)


def test_other_channels_are_named() -> None:
    with pytest.raises(FormatError, match=r"a\.exr: has the channels depth, normal\.X; R, G and B, or Y"):
        exr_image(PATH, {"normal.X": np.ones((2, 2)), "depth": np.ones((2, 2))})


def test_damage_and_other_files_are_told_apart() -> None:
    whole = encoded({"Y": PLANES["R"].copy()})
    assert is_exr(whole)
    for length in (8, 200, len(whole) // 2):
        with pytest.raises(FormatError, match=r"a\.exr: damaged or cut off .*; copy or download it again"):
            exr_channels(PATH, whole[:length])
    with pytest.raises(FormatError, match=r"a\.exr: not an OpenEXR image"):
        exr_channels(PATH, b"#?RADIANCE\n")
