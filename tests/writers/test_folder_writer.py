"""Folders of images: exact values, and what is left after interrupts, full disks and overwriting."""

from __future__ import annotations

import dataclasses
import enum
import errno
import os
import signal
import subprocess
import sys
import time
import tomllib
from io import FileIO
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from kalux.display import DisplaySettings, Linear, tone_map, tone_map_next
from kalux.errors import InputError, InternalError, OutputError, SettingsError
from kalux.writers import files, folder, open_writer
from kalux.writers.files import uninterrupted
from kalux.writers.folder import append_line

from builders import own_threads


@dataclasses.dataclass(frozen=True, eq=False)
class Image:
    t: int
    intensity: np.ndarray
    variance: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class ColourImage(Image):
    colour: np.ndarray


def make_image(index: int, shape: tuple[int, int] = (13, 17), top: float = 40.0) -> Image:
    rng = np.random.default_rng(index)
    intensity = rng.uniform(0, 1, shape).astype(np.float32)
    intensity[: shape[0] // 3] *= top
    return Image(1_000_000 + 3333 * index, intensity, rng.uniform(1e-5, 1, shape).astype(np.float32))


def settings_of(out: Path) -> dict:
    return tomllib.loads((out / "kalux.toml").read_text())


def listed(out: Path) -> list[str]:
    lines = (out / "timestamps.csv").read_text().splitlines()
    assert lines[0] == "index,t_us,file"
    return [line.split(",")[2] for line in lines[1:]]


def assert_valid(out: Path, images: int, *, complete: bool) -> None:
    names = listed(out)
    assert len(names) == images
    for name in names:
        assert cv2.imread(str(out / name), cv2.IMREAD_UNCHANGED) is not None
    others = {"timestamps.csv", "kalux.toml"}
    assert {p.name for p in out.iterdir()} == others | set(names)
    assert settings_of(out)["complete"] is complete
    assert settings_of(out)["images"] == images


def test_png_16_bits_are_within_rounding(tmp_path):
    display = DisplaySettings()
    state = None
    with open_writer(tmp_path / "a/b", format="png", display=display) as writer:
        for k in range(3):
            writer.write(make_image(k))
    for k in range(3):
        mapped, state = tone_map_next(make_image(k), display, state)
        picture = cv2.imread(str(tmp_path / f"a/b/{k:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert picture.dtype == np.uint16
        assert np.abs(picture / 65535 - mapped).max() <= 0.5 / 65535 + 1e-7
    assert_valid(tmp_path / "a/b", 3, complete=True)


def test_linear_png_is_the_intensity(tmp_path):
    with open_writer(tmp_path / "o", format="png", display=DisplaySettings(Linear(white=4))) as writer:
        writer.write(make_image(0, top=4))
    picture = cv2.imread(str(tmp_path / "o/000000.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(picture, np.rint(make_image(0, top=4).intensity / np.float32(4) * 65535))


def test_png_8_bits(tmp_path):
    with open_writer(tmp_path / "o", format="png", display=DisplaySettings(Linear()), png_bits=8) as writer:
        writer.write(make_image(0, top=1))
    picture = cv2.imread(str(tmp_path / "o/000000.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(picture, np.rint(make_image(0, top=1).intensity * 255).astype(np.uint8))


def test_exr_is_exact(tmp_path):
    image = make_image(0, top=1e6)
    image.variance[3, 4] = np.inf
    with open_writer(tmp_path / "o", format="exr") as writer:
        writer.write(image)
    file = OpenEXR.File(str(tmp_path / "o/000000.exr"))
    assert set(file.channels()) == {"Y", "variance"}
    np.testing.assert_array_equal(file.channels()["Y"].pixels, image.intensity)
    np.testing.assert_array_equal(file.channels()["variance"].pixels, image.variance)
    assert file.channels()["Y"].pixels.dtype == np.float32
    assert file.header()["compression"] == OpenEXR.ZIP_COMPRESSION
    assert file.header()["t_us"] == str(image.t)


def test_npy_is_exact(tmp_path):
    image = make_image(0, top=1e6)
    with open_writer(tmp_path / "o", format="npy") as writer:
        writer.write(Image(image.t, image.intensity[:, ::2], image.variance[:, ::2]))
    read = np.load(tmp_path / "o/000000.npy")
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, [image.intensity[:, ::2], image.variance[:, ::2]])


class TestColour:
    image = ColourImage(
        7,
        np.ones((5, 6), np.float32),
        np.full((5, 6), 0.5, np.float32),
        np.random.default_rng(0).uniform(0, 3, (5, 6, 3)).astype(np.float32),
    )

    def test_exr_has_red_green_blue_and_variance(self, tmp_path):
        with open_writer(tmp_path / "o", format="exr") as writer:
            writer.write(self.image)
        # Channels one by one; OpenEXR would join them to one array.
        channels = OpenEXR.File(str(tmp_path / "o/000000.exr"), separate_channels=True).channels()
        assert set(channels) == {"R", "G", "B", "variance"}
        for index, name in enumerate("RGB"):
            np.testing.assert_array_equal(channels[name].pixels, self.image.colour[..., index])
        np.testing.assert_array_equal(channels["variance"].pixels, self.image.variance)

    def test_npy_has_red_green_blue_and_variance(self, tmp_path):
        with open_writer(tmp_path / "o", format="npy") as writer:
            writer.write(self.image)
        read = np.load(tmp_path / "o/000000.npy")
        np.testing.assert_array_equal(read, [*np.moveaxis(self.image.colour, 2, 0), self.image.variance])

    @pytest.mark.parametrize(("bits", "top"), [(8, 255), (16, 65535)])
    def test_png_is_in_colour(self, tmp_path, bits, top):
        with open_writer(tmp_path / "o", format="png", png_bits=bits) as writer:
            writer.write(self.image)
        read = cv2.imread(str(tmp_path / "o/000000.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_allclose(read[..., ::-1] / top, tone_map(self.image.colour), atol=0.51 / top)

    def test_what_does_not_fit_is_refused(self, tmp_path):
        with open_writer(tmp_path / "a", format="npy") as writer:
            writer.write(self.image)
            with pytest.raises(InputError, match="image 1: is grey, those before it are not"):
                writer.write(Image(8, self.image.intensity, self.image.variance))
        flat = dataclasses.replace(self.image, colour=self.image.colour[..., :2])
        with (
            open_writer(tmp_path / "b", format="npy") as writer,
            pytest.raises(InputError, match="the colour is"),
        ):
            writer.write(flat)
        bad = dataclasses.replace(
            self.image, colour=np.where(self.image.colour > 2.9, np.nan, self.image.colour)
        )
        with (
            open_writer(tmp_path / "c", format="npy") as writer,
            pytest.raises(InternalError, match=r"the colour at x=.* is not finite"),
        ):
            writer.write(bad)


def test_the_list_and_the_settings_grow_with_the_images(tmp_path, monkeypatch):
    monkeypatch.setattr(folder, "SETTINGS_EVERY", 0.0)
    out = tmp_path / "o"
    writer = open_writer(out, format="png")
    assert_valid(out, 0, complete=False)
    for k in range(3):
        writer.write(make_image(k))
        assert_valid(out, k + 1, complete=False)
    assert (out / "timestamps.csv").read_text().splitlines()[2] == "1,1003333,000001.png"
    writer.close()
    writer.close()
    assert_valid(out, 3, complete=True)
    assert settings_of(out)["first_t_us"] == 1_000_000
    assert settings_of(out)["last_t_us"] == 1_006_666
    with pytest.raises(OutputError, match="closed"):
        writer.write(make_image(3))


def test_the_settings_are_not_replaced_for_every_image(tmp_path):
    """It makes some file systems wait for the disk; the list grows meanwhile."""
    with open_writer(tmp_path / "o", format="png") as writer:
        for k in range(3):
            writer.write(make_image(k))
            assert len(listed(tmp_path / "o")) == k + 1
        assert settings_of(tmp_path / "o")["images"] < 3
    assert_valid(tmp_path / "o", 3, complete=True)


def test_settings_hold_the_metadata(tmp_path):
    @dataclasses.dataclass
    class Filter:
        floor: float = 0.09
        window: tuple[int, int] = (3, 4)
        mask: Path | None = None

    class Mode(enum.Enum):
        FAST = "fast"

    metadata = {
        "source": Path("in.aedat4"),
        "filter": Filter(),
        "mode": Mode.FAST,
        "rate": np.float32(0.5),
        "curve": np.arange(3),
        "unset": None,
        "versions": {"kalux": "9.9"},
    }
    with open_writer(tmp_path / "o", format="png", rate_hz=300, metadata=metadata):
        pass
    written = settings_of(tmp_path / "o")
    assert written["source"] == "in.aedat4"
    assert written["filter"] == {"floor": 0.09, "window": [3, 4]}
    assert written["mode"] == "fast"
    assert written["rate"] == 0.5
    assert written["curve"] == [0, 1, 2]
    assert "unset" not in written
    assert written["versions"]["kalux"] == "9.9"
    assert written["versions"]["numpy"] == np.__version__
    assert written["output"]["format"] == "png"
    assert written["output"]["rate_hz"] == 300
    assert written["output"]["display"]["auto"]["knee"] == 0.5


@pytest.mark.parametrize("metadata", [{"f": print}, {"list": [1, None]}, {"images": 3}])
def test_metadata_without_a_toml_form_is_refused(tmp_path, metadata):
    with pytest.raises(SettingsError, match="metadata"):
        open_writer(tmp_path / "o", format="png", metadata=metadata)
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
@pytest.mark.parametrize("images", [0, 2])
def test_an_interrupt_leaves_what_was_finished(tmp_path, error, images):
    def interrupted():
        with open_writer(tmp_path / "o", format="png") as writer:
            for k in range(images):
                writer.write(make_image(k))
            raise error

    with pytest.raises(error):
        interrupted()
    assert_valid(tmp_path / "o", images, complete=False)


def test_ctrl_c_during_a_write_takes_effect_after_it(tmp_path, monkeypatch):
    replace = os.replace

    def interrupting(source, target):
        if str(target).endswith("000001.png"):
            signal.raise_signal(signal.SIGINT)
        replace(source, target)

    monkeypatch.setattr(files.os, "replace", interrupting)

    def write():
        with open_writer(tmp_path / "o", format="png") as writer:
            for k in range(5):
                writer.write(make_image(k))

    with pytest.raises(KeyboardInterrupt):
        write()
    assert_valid(tmp_path / "o", 2, complete=False)


def test_interrupts_are_held_back_and_the_handler_restored():
    before = signal.getsignal(signal.SIGINT)
    done = []

    def block():
        with uninterrupted():
            signal.raise_signal(signal.SIGINT)
            done.append(1)

    with pytest.raises(KeyboardInterrupt):
        block()
    assert done == [1]
    assert signal.getsignal(signal.SIGINT) is before


def full_disk(monkeypatch, ending: str) -> None:
    """Let writing files whose name has the ending fail half-way, as on a full disk."""

    class Half:
        def __init__(self, path):
            self.file = FileIO(path, "w")

        def __enter__(self):
            return self

        def __exit__(self, *error):
            self.file.close()

        def write(self, data):
            self.file.write(data[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def opening(path, mode):
        return Half(path) if str(path).endswith(ending) else open(path, mode)

    monkeypatch.setattr(files, "open", opening, raising=False)


@pytest.mark.parametrize("format", ["png", "exr", "npy"])
def test_a_full_disk_is_one_clear_error(tmp_path, monkeypatch, format):
    full_disk(monkeypatch, f"000002.{format}.part")
    writer = open_writer(tmp_path / "o", format=format)

    def write():
        with writer:
            for k in range(5):
                writer.write(make_image(k))

    with pytest.raises(OutputError, match=r"000002.*no space is left.*2 images listed") as caught:
        write()
    assert caught.value.errno == errno.ENOSPC
    assert "\n" not in str(caught.value)
    assert listed(tmp_path / "o") == [f"00000{k}.{format}" for k in range(2)]
    assert len(list((tmp_path / "o").iterdir())) == 4
    assert settings_of(tmp_path / "o")["complete"] is False
    assert settings_of(tmp_path / "o")["images"] == 2
    with pytest.raises(OutputError, match="closed"):
        writer.write(make_image(0))


def test_a_full_disk_that_stops_the_settings_keeps_the_old_ones(tmp_path, monkeypatch):
    monkeypatch.setattr(folder, "SETTINGS_EVERY", 0.0)
    writer = open_writer(tmp_path / "o", format="png")
    writer.write(make_image(0))
    full_disk(monkeypatch, "kalux.toml.part")
    with pytest.raises(OutputError, match=r"kalux.toml: no space"):
        writer.write(make_image(1))
    with pytest.raises(OutputError, match=r"kalux.toml: no space"):
        writer.close()
    assert len(listed(tmp_path / "o")) == 2
    assert settings_of(tmp_path / "o")["complete"] is False


def test_a_closed_writer_that_has_failed_is_incomplete(tmp_path):
    writer = open_writer(tmp_path / "o", format="png")
    writer.write(make_image(0))
    with pytest.raises(InputError):
        writer.write(make_image(1, shape=(4, 4)))
    with pytest.raises(OutputError, match="unusable"):
        writer.write(make_image(1))
    writer.close()
    assert_valid(tmp_path / "o", 1, complete=False)


def test_a_line_is_appended_whole_or_not_at_all(tmp_path):
    path = tmp_path / "list"
    path.write_text("first\n")

    class Full:
        def __init__(self):
            self.file = FileIO(path, "a")
            self.writes = 0

        def write(self, data):
            self.writes += 1
            if self.writes == 2:
                raise OSError(errno.ENOSPC, "full")
            return self.file.write(data[:3])

        def __getattr__(self, name):
            return getattr(self.file, name)

    full = Full()
    with pytest.raises(OSError, match="full"):
        append_line(full, "second\n")
    full.file.close()
    assert path.read_text() == "first\n"


@pytest.mark.parametrize("format", ["png", "mp4"])
def test_a_folder_that_cannot_be_created(tmp_path, format):
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / ("o.mp4" if format == "mp4" else "o")
    with pytest.raises(OutputError, match="file"):
        open_writer(out, format=format)


def test_a_file_in_place_of_the_folder(tmp_path):
    (tmp_path / "o").write_text("mine")
    with pytest.raises(OutputError, match="a file of this name"):
        open_writer(tmp_path / "o", format="png", overwrite=True)
    assert (tmp_path / "o").read_text() == "mine"


def test_an_existing_empty_folder_is_used(tmp_path):
    with open_writer(tmp_path, format="png") as writer:
        writer.write(make_image(0))
    assert_valid(tmp_path, 1, complete=True)


def write_some(out: Path, images: int, format: str = "png", **options: object) -> None:
    with open_writer(out, format=format, **options) as writer:
        for k in range(images):
            writer.write(make_image(k))


def test_a_folder_in_use_is_refused(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"not empty.*overwriting"):
        open_writer(tmp_path, format="png")
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_overwriting_removes_only_what_kalux_listed(tmp_path):
    out = tmp_path / "o"
    write_some(out, 4, "exr")
    (out / "mine.txt").write_text("mine")
    (out / "000099.png").write_bytes(b"mine")
    write_some(out, 2, overwrite=True)
    names = {p.name for p in out.iterdir()}
    assert names == {
        "000000.png",
        "000001.png",
        "000099.png",
        "mine.txt",
        "kalux.toml",
        "timestamps.csv",
    }
    assert (out / "000099.png").read_bytes() == b"mine"


def test_a_foreign_file_is_never_replaced(tmp_path):
    (tmp_path / "000001.png").write_bytes(b"mine")
    with pytest.raises(OutputError, match=r"000001.png: there already"):
        write_some(tmp_path, 3, overwrite=True)
    assert (tmp_path / "000001.png").read_bytes() == b"mine"
    assert listed(tmp_path) == ["000000.png"]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("timestamps.csv", "t,file\n1,000000.png\n"),
        ("timestamps.csv", "index,t_us,file\n0,1,../000000.png\n"),
        ("timestamps.csv", ""),
        ("kalux.toml", "preset = 'iccv2021'\n"),
    ],
)
def test_foreign_lists_and_settings_are_left(tmp_path, name, text):
    out = tmp_path / "o"
    out.mkdir()
    (tmp_path / "000000.png").write_bytes(b"mine")
    (out / "000000.png").write_bytes(b"mine")
    (out / name).write_text(text)
    with pytest.raises(OutputError, match="not an output of kalux"):
        open_writer(out, format="png", overwrite=True)
    assert {p.name for p in out.iterdir()} == {"000000.png", name}
    assert (tmp_path / "000000.png").exists()


def test_an_interrupted_overwrite_is_resumed(tmp_path):
    write_some(tmp_path, 3)
    (tmp_path / "timestamps.csv").rename(tmp_path / ".timestamps.csv.removing")
    (tmp_path / "000000.png").unlink()
    write_some(tmp_path, 1, overwrite=True)
    assert_valid(tmp_path, 1, complete=True)


def test_a_list_that_a_crash_cut_short_can_be_overwritten(tmp_path):
    write_some(tmp_path, 3)
    with open(tmp_path / "timestamps.csv", "a") as file:
        file.write("3,10099")
    write_some(tmp_path, 1, overwrite=True)
    assert_valid(tmp_path, 1, complete=True)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("format", ["png", "exr", "npy"])
def test_intensities_that_are_not_finite_are_never_written(tmp_path, bad, format):
    image = make_image(1)
    image.intensity[2, 5] = bad
    writer = open_writer(tmp_path / "o", format=format)
    writer.write(make_image(0))
    with pytest.raises(InternalError, match="image 1 at 1003333 us: the intensity at x=5, y=2 is not finite"):
        writer.write(image)
    assert len(listed(tmp_path / "o")) == 1


def test_a_variance_may_be_infinite_but_not_nan(tmp_path):
    image = make_image(0)
    image.variance[0, 0] = np.inf
    writer = open_writer(tmp_path / "o", format="npy")
    writer.write(image)
    image.variance[0, 0] = np.nan
    with pytest.raises(InternalError, match="variance at x=0, y=0 is NaN"):
        writer.write(image)


def test_images_of_another_type_or_size_are_refused(tmp_path):
    image = make_image(0)
    for bad in (
        Image(0, image.intensity.astype(np.float64), image.variance),
        Image(0, image.intensity, image.variance[1:]),
        Image(0, image.intensity[None], image.variance[None]),
        Image(0, image.intensity[:0], image.variance[:0]),
    ):
        writer = open_writer(tmp_path / "o", format="npy", overwrite=True)
        with pytest.raises(InputError, match="image 0"):
            writer.write(bad)
        writer.stop()


@pytest.mark.parametrize(
    ("name", "format", "match"),
    [
        ("out.avi", None, "cannot be told"),
        ("out", None, "folder and the format png, exr or npy"),
        ("out", "tiff", "png, exr, npy, mp4"),
        ("out", "mp4", "does not fit"),
        ("out.mp4", "png", "does not fit"),
    ],
)
def test_unknown_formats_say_what_is_possible(tmp_path, name, format, match):
    with pytest.raises(SettingsError, match=match):
        open_writer(tmp_path / name, format=format)
    assert not any(tmp_path.iterdir())


def test_a_killed_process_leaves_a_valid_folder(tmp_path):
    script = """
import sys
sys.path[:0] = sys.argv[2:]
from test_folder_writer import make_image
from kalux.writers import open_writer
writer = open_writer(sys.argv[1], format="png")
for k in range(10**6):
    writer.write(make_image(k, (64, 64)))
"""
    out = tmp_path / "o"
    here = Path(__file__).parent
    process = subprocess.Popen([sys.executable, "-c", script, str(out), str(here), str(here.parent)])
    try:
        deadline = time.monotonic() + 20
        while not (out / "000020.png").exists() and time.monotonic() < deadline:
            time.sleep(0.005)
    finally:
        process.kill()
        process.wait()
    names = listed(out)
    assert len(names) >= 20
    for name in names:
        assert cv2.imread(str(out / name), cv2.IMREAD_UNCHANGED).shape == (64, 64)
    assert settings_of(out)["complete"] is False
    assert settings_of(out)["images"] <= len(names)


class TestSeveralEncoders:
    @pytest.mark.parametrize("format", ["png", "exr", "npy"])
    def test_the_files_are_the_same(self, tmp_path, format):
        for threads in (1, 2, 4):
            with open_writer(tmp_path / str(threads), format=format, threads=threads) as writer:
                for k in range(9):
                    writer.write(make_image(k))
            assert writer.images == 9
            assert_same_folder(tmp_path / "1", tmp_path / str(threads))
        assert settings_of(tmp_path / "4")["complete"] is True

    def test_what_is_listed_is_there_meanwhile(self, tmp_path):
        with open_writer(tmp_path / "o", format="npy", threads=3) as writer:
            for k in range(9):
                writer.write(make_image(k))
                assert len(listed(tmp_path / "o")) == writer.images == max(0, k + 1 - 3)
                assert_valid_npy(tmp_path / "o")
        assert len(listed(tmp_path / "o")) == writer.images == 9

    @pytest.mark.parametrize("error", [KeyboardInterrupt, InputError])
    def test_an_interrupt_leaves_all_that_was_given(self, tmp_path, error):
        def write():
            with open_writer(tmp_path / "o", format="png", threads=4) as writer:
                for k in range(7):
                    writer.write(make_image(k))
                raise error

        with pytest.raises(error):
            write()
        assert_valid(tmp_path / "o", 7, complete=False)
        assert not own_threads()

    @pytest.mark.parametrize("last", [4, 12], ids=["when it closes", "while it writes"])
    def test_a_full_disk_ends_it_there(self, tmp_path, monkeypatch, last):
        def write():
            with open_writer(tmp_path / "o", format="png", threads=3) as writer:
                for k in range(last):
                    writer.write(make_image(k))

        full_disk(monkeypatch, "000002.png.part")
        with pytest.raises(OutputError, match=r"000002.png: no space .*; the 2 images listed in"):
            write()
        assert_valid(tmp_path / "o", 2, complete=False)
        assert not own_threads()

    def test_an_error_of_encoding_is_raised(self, tmp_path, monkeypatch):
        def broken(picture):
            raise MemoryError("no room")

        monkeypatch.setattr("kalux.writers.images.png_bytes", broken)
        writer = open_writer(tmp_path / "o", format="png", threads=3)
        writer.write(make_image(0))
        with pytest.raises(MemoryError, match="no room"):
            writer.close()
        assert_valid(tmp_path / "o", 0, complete=False)
        writer.close()

    def test_a_wrong_image_is_refused_at_once(self, tmp_path):
        with open_writer(tmp_path / "o", format="png", threads=4) as writer:
            writer.write(make_image(0))
            with pytest.raises(InputError, match="image 1: the intensity is"):
                writer.write(make_image(1, shape=(5, 5)))
        assert_valid(tmp_path / "o", 1, complete=False)

    def test_none_is_refused(self, tmp_path):
        with pytest.raises(SettingsError, match="threads is 0"):
            open_writer(tmp_path / "o", format="png", threads=0)


def assert_same_folder(expected, found):
    names = sorted(path.name for path in expected.iterdir())
    assert sorted(path.name for path in found.iterdir()) == names
    for name in names:
        assert (expected / name).read_bytes() == (found / name).read_bytes()


def assert_valid_npy(out):
    for name in listed(out):
        assert np.isfinite(np.load(out / name)).all()
