"""Folders of images as methods: files, times, errors."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from kalux import Recording, reconstruct
from kalux.errors import FormatError, FrameError, InputError
from kalux.evaluation.folder_method import images, listed
from kalux.writers import open_writer
from kalux.writers.exr import exr_file

from builders import frame, moving_blocks, pixel_events

SIZE = (2, 3)


def recording(size=SIZE):
    shots = [frame(10, t, t + 10, size) for t in (0, 1000)]
    return Recording.from_arrays(pixel_events([], []), shots, sensor_size=size)


def write(folder, images, times, suffix=".npy"):
    """A folder as another program might write it."""
    folder.mkdir(exist_ok=True)
    lines = ["index,t_us,file"]
    for i, (t, image) in enumerate(zip(times, images, strict=True)):
        name = f"{i}{suffix}"
        if suffix == ".npy":
            np.save(folder / name, image)
        else:
            cv2.imwrite(str(folder / name), image)
        lines.append(f"{i},{t},{name}")
    (folder / "timestamps.csv").write_text("\n".join(lines) + "\n")
    return folder


def values(folder, times, **options):
    return [float(i[0, 0]) for i in images(recording(), np.array(times), folder=folder, **options)]


def test_the_nearest_image_within_the_tolerance(tmp_path):
    folder = write(tmp_path / "a", [np.full(SIZE, v) for v in (0.1, 0.2, 1.5)], [0, 1000, 5000])
    assert values(folder, [0, 499, 501, 1000, 1999, 4000]) == pytest.approx([0.1, 0.1, 0.2, 0.2, 0.2, 1.5])
    assert values(folder, [2999, 3001], tolerance=2000) == pytest.approx([0.2, 1.5])
    with pytest.raises(
        InputError, match=r"no image within 1000 us of 2 of 3 times, the first is 2001 us.*1000 us"
    ):
        values(folder, [1000, 2001, 9000])


def test_the_list_may_be_in_any_order(tmp_path):
    folder = write(tmp_path / "a", [np.full(SIZE, v) for v in (0.3, 0.1, 0.2)], [300, 100, 200])
    assert values(folder, [100, 200, 300], tolerance=1) == pytest.approx([0.1, 0.2, 0.3])


@pytest.mark.parametrize(("kind", "white"), [(np.uint8, 255), (np.uint16, 65535)])
def test_png_is_0_to_1(kind, white, tmp_path):
    folder = write(
        tmp_path / "a", [np.full(SIZE, v, kind) for v in (0, white // 5, white)], [0, 1, 2], ".png"
    )
    assert values(folder, [0, 1, 2]) == pytest.approx([0, 0.2, 1])


@pytest.mark.parametrize("suffix", ["exr", "npy"])
def test_what_kalux_writes_is_read_back_as_it_was(suffix, tmp_path):
    simulation = moving_blocks()
    times = simulation.truth_times()[:4]
    made = list(reconstruct(simulation.recording(), times=times))
    with open_writer(tmp_path / "out", format=suffix) as writer:
        for image in made:
            writer.write(image)
    found = list(images(simulation.recording(), times, folder=tmp_path / "out", tolerance=1))
    assert np.array_equal(found, [image.intensity for image in made])


@pytest.mark.parametrize("kind", [np.int16, np.int32, np.uint32, np.float32, np.float64])
def test_images_of_other_types_than_levels_of_8_and_16_bits_are_refused(kind, tmp_path):
    """Divided by the largest number of 32 bits, an image would be black; floats have no largest."""
    folder = write(tmp_path / "a", [np.full(SIZE, 1, kind)], [0], ".tif")
    with pytest.raises(
        FormatError, match=rf"0\.tif: holds {np.dtype(kind)}; images of 8 or 16-bit levels are"
    ):
        values(folder, [0])


def test_a_radiance_picture_is_refused_by_what_it_holds(tmp_path):
    folder = write(tmp_path / "a", [np.ones((*SIZE, 3), np.float32)], [0], ".hdr")
    with pytest.raises(
        FormatError, match=r"0\.hdr: holds float32; .* as \.npy, or as \.exr with the channel Y"
    ):
        values(folder, [0])


def test_levels_in_an_npy_are_no_intensity(tmp_path):
    """Whole numbers of intensity are small, as in a file of ground truth."""
    folder = write(tmp_path / "a", [np.full(SIZE, 128, np.uint8), np.full(SIZE, 2, np.int64)], [0, 5])
    assert values(folder, [5], tolerance=1) == [2.0]
    with pytest.raises(
        FormatError, match=r"0\.npy: the images are uint8, up to 128; linear intensity is needed"
    ):
        values(folder, [0], tolerance=1)


@pytest.mark.parametrize("suffix", [".png", ".npy", ".exr"])
def test_colour_is_refused_with_what_writes_grey(suffix, tmp_path):
    """The first image, too, before which there are no others."""
    folder = write(tmp_path / "a", [], [])
    name = f"0{suffix}"
    if suffix == ".png":
        cv2.imwrite(str(folder / name), np.full((*SIZE, 3), (1, 2, 3), np.uint8))
    elif suffix == ".npy":
        np.save(folder / name, np.zeros((4, *SIZE), np.float32))
    else:
        (folder / name).write_bytes(exr_file({c: np.zeros(SIZE, np.float32) for c in "RGB"}, {}))
    (folder / "timestamps.csv").write_text(f"t_us,file\n0,{name}\n")
    with pytest.raises(InputError, match=rf"0\{suffix}: .*--grey \(RGB frames\) or --bayer none") as caught:
        values(folder, [0])
    assert "before it" not in str(caught.value)


def test_grey_that_is_stored_in_colour_is_grey(tmp_path):
    folder = write(tmp_path / "a", [np.full((*SIZE, 3), 51, np.uint8)], [0], ".png")
    assert values(folder, [0]) == pytest.approx([0.2])


def test_times_may_be_negative_as_kalux_writes_them(tmp_path):
    folder = write(tmp_path / "a", [np.full(SIZE, v) for v in (0.1, 0.2)], [-2000, 0])
    assert values(folder, [-2000, 0], tolerance=1) == pytest.approx([0.1, 0.2])


def test_a_list_that_is_wrong_is_told_what_it_should_be(tmp_path):
    """Not the lists that only recordings have."""
    folder = write(tmp_path / "a", [], [])
    for text in ("", "a,b\n1,2\n"):
        (folder / "timestamps.csv").write_text(text)
        with pytest.raises(
            FormatError, match="a CSV with a line per image and the columns t_us and file is needed"
        ):
            listed(folder)


def test_errors(tmp_path):
    with pytest.raises(InputError, match="not a folder of images"):
        listed(tmp_path / "none")
    folder = write(tmp_path / "a", [np.zeros((4, 5))], [0])
    with pytest.raises(FrameError, match=r"0\.npy: has 5x4 pixels, but the sensor 3x2"):
        values(folder, [0])
    for content in (b"nothing", b"PK\x05\x06" + bytes(18)):  # an empty .npz
        (folder / "0.npy").write_bytes(content)
        with pytest.raises(FormatError, match=r"0\.npy: not an \.npy"):
            values(folder, [0])
    (folder / "0.npy").unlink()
    with pytest.raises(FormatError, match="1 of 1 images are missing"):
        listed(folder)
    (folder / "timestamps.csv").write_text("index,t_us,file\n")
    with pytest.raises(FormatError, match="lists no images"):
        listed(folder)
    exr = write(tmp_path / "b", [], [])
    (exr / "0.exr").write_bytes(b"nothing")
    (exr / "timestamps.csv").write_text("t_us,file\n0,0.exr\n")
    with pytest.raises(FormatError, match=r"0\.exr: not an OpenEXR"):
        values(exr, [0])
