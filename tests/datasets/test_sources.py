"""Photographs, folders and videos as radiance."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from kalux.datasets import Pose, SensorSettings, pan, photograph_scene, simulate, sources, static, still
from kalux.datasets.foreground import Sprite, with_foreground
from kalux.datasets.sources import (
    exposed,
    fitting_scale,
    interpolated,
    open_sequence,
    read_photograph,
    sequence_scene,
    white_for,
)
from kalux.errors import FormatError, InputError

RNG = np.random.default_rng(0)


def srgb(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def write_exr(path: Path, **channels: np.ndarray) -> Path:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {name: np.ascontiguousarray(c, np.float32) for name, c in channels.items()}).write(
        str(path)
    )
    return path


@pytest.fixture
def hdr_folder(tmp_path: Path) -> Path:
    """Five images, 1.png ... 12.png in name, each e^0.3 brighter than the one before."""
    folder = tmp_path / "frames"
    folder.mkdir()
    base = RNG.uniform(0.1, 3.0, (20, 30))
    for i, number in enumerate((1, 2, 3, 10, 12)):
        write_exr(folder / f"f{number}.exr", Y=base * np.exp(0.3 * i))
    return folder


# --- photographs ------------------------------------------------------------------------------------------


def test_radiance_hdr_is_luminance(tmp_path: Path, monkeypatch) -> None:
    """Also where OpenCV has no room for a copy of its own."""
    monkeypatch.setenv("OPENCV_TEMP_PATH", str(tmp_path / "none"))
    colour = RNG.uniform(0.01, 50.0, (8, 9, 3)).astype(np.float32)  # R, G, B
    cv2.imwrite(str(tmp_path / "a.hdr"), colour[..., ::-1])
    found = read_photograph(tmp_path / "a.hdr")
    assert found.is_hdr
    # RGBE has 8 bits of mantissa, of the largest channel.
    expected = colour @ [0.2126, 0.7152, 0.0722]
    assert np.abs(found.radiance - expected).max() < colour.max(axis=2).max() / 128
    assert found.radiance.mean() == pytest.approx(expected.mean(), rel=0.01)


def test_exr_in_colour_and_grey(tmp_path: Path) -> None:
    r, g, b = RNG.uniform(0.0, 20.0, (3, 6, 7)).astype(np.float32)
    colour = read_photograph(write_exr(tmp_path / "c.exr", R=r, G=g, B=b, A=np.full((6, 7), 0.25)))
    assert np.allclose(colour.radiance, 0.2126 * r + 0.7152 * g + 0.0722 * b, rtol=1e-5)
    assert np.allclose(colour.alpha, 0.25)
    grey = read_photograph(write_exr(tmp_path / "g.exr", Y=r))
    assert np.array_equal(grey.radiance, r)
    assert grey.alpha is None


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.uint8, 5e-3), (np.uint16, 4e-5)])
def test_ordinary_images_are_decoded_from_srgb(tmp_path: Path, dtype: type, tolerance: float) -> None:
    linear = np.linspace(0, 1, 60).reshape(6, 10)
    top = np.iinfo(dtype).max
    cv2.imwrite(str(tmp_path / "a.png"), np.rint(srgb(linear) * top).astype(dtype))
    found = read_photograph(tmp_path / "a.png")
    assert not found.is_hdr
    assert np.abs(found.radiance - linear).max() < tolerance


def test_alpha_of_a_png(tmp_path: Path) -> None:
    pixels = np.full((4, 5, 4), 255, np.uint8)
    pixels[..., 3] = 51
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    found = read_photograph(tmp_path / "a.png")
    assert np.allclose(found.alpha, 0.2)
    assert np.allclose(found.radiance, 1.0)


def test_alpha_of_an_exr_is_in_its_colours_already(tmp_path: Path) -> None:
    """A pane of radiance 0.8 that covers half of what is behind it (0.2)."""
    flat = np.full((32, 32), 0.4)
    pane = read_photograph(write_exr(tmp_path / "a.exr", R=flat, G=flat, B=flat, A=np.full((32, 32), 0.5)))
    pixels = np.full((32, 32, 4), round(255 * float(srgb(np.array(0.8)))), np.uint8)
    pixels[..., 3] = 128
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    straight = read_photograph(tmp_path / "a.png")
    for image in (pane, straight):
        assert image.alpha is not None
        sprite = Sprite(image.radiance, image.alpha, image.premultiplied)
        scene = with_foreground(static(0.2, sensor_size=(40, 40)), sprite, lambda t: Pose(20, 20), size=20)
        assert scene.at(0.0)[20, 20] == pytest.approx(0.5, abs=0.005)


@pytest.mark.parametrize("dtype", [np.int8, np.int16, np.int32])
def test_numbers_with_a_sign_are_refused(tmp_path: Path, dtype: type) -> None:
    cv2.imwrite(str(tmp_path / "a.tif"), np.full((4, 5), -1, dtype))
    with pytest.raises(FormatError, match=rf"a\.tif: its values are {dtype.__name__}; .* are needed"):
        read_photograph(tmp_path / "a.tif")


@pytest.mark.parametrize("name", ["a.hdr", "a.exr", "a.png"])
@pytest.mark.parametrize(
    "data", [b"", b"#?RADIANCE\n", b"\x89PNG\r\n\x1a\n" + bytes(30), b"v/1\x01" + bytes(60)]
)
def test_what_is_no_image_is_refused(tmp_path: Path, name: str, data: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(FormatError, match=name) as error:
        read_photograph(path)
    assert "\n" not in str(error.value)


def test_a_few_negative_pixels_are_black_and_told(tmp_path: Path) -> None:
    """Colours outside of the gamut have them; a picture that is negative for the most part is something else."""
    image = np.full((4, 5), 2.0)
    image[0, :2] = (-0.25, -0.5)
    found = read_photograph(write_exr(tmp_path / "n.exr", Y=image))
    assert np.array_equal(found.radiance, np.maximum(image, 0))
    assert (
        found.doubt
        == f"{tmp_path / 'n.exr'}: 2 of 20 pixels (10 %) are negative, down to -0.5, and taken as black"
    )
    image[:2] = -1.0
    with pytest.raises(FormatError, match=r"10 of 20 pixels \(50 %\) are negative; linear"):
        read_photograph(write_exr(tmp_path / "n.exr", Y=image))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(tmp_path: Path, value: float) -> None:
    image = np.ones((4, 5))
    image[3, 4] = value
    with pytest.raises(FormatError, match=r"1 of 20 pixels \(5 %\) is not finite"):
        read_photograph(write_exr(tmp_path / "n.exr", Y=image))


def test_the_content_says_what_an_image_is(tmp_path: Path) -> None:
    write_exr(tmp_path / "n.exr", Y=np.ones((4, 5))).rename(tmp_path / "n.hdr")
    assert np.array_equal(read_photograph(tmp_path / "n.hdr").radiance, np.ones((4, 5)))


def test_of_a_folder_the_first_doubt_is_told_once(tmp_path: Path) -> None:
    for i in range(3):
        write_exr(tmp_path / f"{i}.exr", Y=np.where(np.eye(4) > 0, 1.0 - 2 * min(i, 1), 1.0))
    told: list[str] = []
    sequence = open_sequence(tmp_path, told.append)
    assert told == []
    for index in (0, 1, 2, 1):
        assert sequence.image(index).min() >= 0
    assert [line.split(";")[0] for line in told] == [
        f"{tmp_path / '1.exr'}: 4 of 16 pixels (25 %) are negative, down to -1, and taken as black"
    ]


def test_the_real_photograph(shared_data: Path) -> None:
    found = read_photograph(shared_data / "hdr" / "Oxford_Church.hdr")
    assert found.is_hdr
    assert found.radiance.shape == (1200, 1012)
    scene = photograph_scene(found.radiance, still(), sensor_size=(60, 80), duration=100_000, scale=10.0)
    white = white_for(scene, 0.12)
    assert (exposed(scene, white).at(0.0) > 1).mean() == pytest.approx(0.12, abs=0.001)


# --- sequences --------------------------------------------------------------------------------------------


def test_a_folder_is_in_the_order_of_its_numbers(hdr_folder: Path) -> None:
    sequence = open_sequence(hdr_folder)
    assert (sequence.length, sequence.size, sequence.is_hdr, sequence.rate_hz) == (5, (20, 30), True, None)
    means = [sequence.image(i).mean() for i in range(5)]
    assert np.diff(np.log(means)) == pytest.approx(np.full(4, 0.3), abs=1e-4)


def test_interpolation_is_linear_in_the_logarithm(hdr_folder: Path) -> None:
    """So a scene that brightens by the same factor from image to image is an exact ramp."""
    sequence = open_sequence(hdr_folder)
    radiance = interpolated(sequence, 100.0)
    first = sequence.image(0) + 1e-4
    for t in (0.0, 2_500.0, 10_000.0, 17_000.0, 40_000.0):
        assert np.allclose(np.log(radiance(t) + 1e-4), np.log(first) + 0.3 * t / 10_000, atol=2.5e-3)
    assert np.array_equal(radiance(1e9), radiance(40_000.0))


def test_events_of_a_folder_are_counted(hdr_folder: Path) -> None:
    sequence = open_sequence(hdr_folder)
    scene = sequence_scene(sequence, still(), sensor_size=(20, 30), rate_hz=100.0)
    assert scene.duration == 40_000
    found = simulate(scene, SensorSettings(threshold_on=0.11, log_offset=1e-4, frame_rate=100, exposure=5000))
    assert found.events["p"].all()
    assert len(found.events) == 600 * int(1.2 / 0.11)
    assert len(found.frames) == 4


def test_a_moving_camera_over_a_folder(hdr_folder: Path) -> None:
    sequence = open_sequence(hdr_folder)
    scene = sequence_scene(
        sequence, pan(100.0), sensor_size=(10, 10), rate_hz=100.0, scale=1.0, duration=30_000
    )
    moved = sequence.image(2)[5:15, 12:22]
    assert np.allclose(scene.at(20_000.0), moved, rtol=1e-4)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Ten pictures of a grey that brightens, 25 per second."""
    import av

    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 32, 24, "yuv420p"
        stream.options = {"crf": "0"}
        for i in range(10):
            picture = np.full((24, 32, 3), 40 + 20 * i, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def test_a_video_forwards_and_backwards(video: Path) -> None:
    sequence = open_sequence(video)
    assert (sequence.length, sequence.size, sequence.is_hdr) == (10, (24, 32), False)
    assert sequence.rate_hz == 25
    expected = [((v / 255 + 0.055) / 1.055) ** 2.4 for v in 40 + 20 * np.arange(10)]
    for index in (0, 3, 4, 9, 2, 0, 8):
        assert sequence.image(index).mean() == pytest.approx(expected[index], rel=0.05)


def test_a_fast_video_is_read_once_in_a_pass(video: Path, monkeypatch) -> None:
    """Steps that are halved go back in time, by 4 ms and less: 4 pictures here."""
    decoded, decode = [], sources._decoded_video

    def counted(path: Path) -> Iterator[np.ndarray]:
        decoded.append(0)
        for image in decode(path):
            decoded[-1] += 1
            yield image

    monkeypatch.setattr(sources, "_decoded_video", counted)
    monkeypatch.setattr(sources, "_VIDEO_BYTES", 0)  # as of pictures that are so large
    sequence = open_sequence(video)
    scene = sequence_scene(sequence, still(), sensor_size=(24, 32), rate_hz=1000.0)
    made = simulate(scene, SensorSettings(threshold_on=0.05, frame_rate=200, exposure=2000))
    assert len(made.events) > 20_000
    assert len(decoded) == 2  # events and frames
    assert max(decoded) <= 10


def test_a_video_makes_a_recording(video: Path) -> None:
    scene = sequence_scene(open_sequence(video), still(), sensor_size=(24, 32), rate_hz=25.0)
    simulation = simulate(scene, SensorSettings(threshold_on=0.3))
    assert simulation.events["p"].all()
    height = np.log(simulation.scene.at(360_000.0) + 0.004) - np.log(simulation.scene.at(0.0) + 0.004)
    assert len(simulation.events) / 768 == pytest.approx(height.mean() / 0.3, abs=1.0)


def test_sequences_that_cannot_be_used(tmp_path: Path, hdr_folder: Path) -> None:
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no such file"):
        open_sequence(tmp_path / "none")
    with pytest.raises(FormatError, match=r"text\.mp4"):
        open_sequence(tmp_path / "text.mp4")
    with pytest.raises(FormatError, match="has 0 images"):
        open_sequence(tmp_path / "empty")
    with pytest.raises(InputError, match=r"last 0\.04 s, 1 s are wanted"):
        sequence_scene(
            open_sequence(hdr_folder), still(), sensor_size=(20, 30), rate_hz=100.0, duration=1_000_000
        )
    with pytest.raises(InputError, match="scale is 0"):
        sequence_scene(open_sequence(hdr_folder), still(), sensor_size=(20, 30), rate_hz=100.0, scale=0.0)
    with pytest.raises(InputError, match="the rate is 0"):
        sequence_scene(open_sequence(hdr_folder), still(), sensor_size=(20, 30), rate_hz=0.0)
    write_exr(hdr_folder / "f11.exr", Y=np.ones((5, 5)))
    with pytest.raises(FormatError, match=r"f11\.exr: 5x5 pixels, the first image of the folder has 30x20"):
        open_sequence(hdr_folder).image(4)
    cv2.imwrite(str(hdr_folder / "a.png"), np.zeros((20, 30), np.uint8))
    with pytest.raises(FormatError, match="HDR and ordinary"):
        open_sequence(hdr_folder)


# --- exposure level ---------------------------------------------------------------------------------------


def test_scale_fits_the_image() -> None:
    assert fitting_scale((101, 201), (51, 51)) == 2.0
    assert fitting_scale((101, 201), (51, 51), 0.5) == 1.0


@pytest.mark.parametrize("part", [0.02, 0.12, 0.5])
def test_a_part_of_the_frames_saturates(part: float) -> None:
    image = RNG.lognormal(0.0, 1.5, (64, 80))
    scene = photograph_scene(image, pan(17.3), sensor_size=(40, 50), duration=500_000, blur=0.0)
    scene = exposed(scene, white_for(scene, part))
    frames = simulate(scene, SensorSettings(exposure=200, frame_rate=40, bits=16)).frames
    saturated = np.mean([(frame.image == 65535).mean() for frame in frames])
    assert saturated == pytest.approx(part, abs=0.02)


def test_levels_that_cannot_be() -> None:
    scene = photograph_scene(np.zeros((40, 40)), still(), sensor_size=(10, 10), duration=1000)
    with pytest.raises(InputError, match="so much of it is black"):
        white_for(scene, 0.1)
    with pytest.raises(InputError, match="between 0 and 1"):
        white_for(scene, 1.5)
    for white in (0.0, 1e-300, 1e300, float("nan")):
        with pytest.raises(InputError, match="must be positive"):
            exposed(scene, white)
