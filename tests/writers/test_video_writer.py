"""Videos: frames, times and pixels; interrupts, full disks, overwriting."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import time
import tomllib
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest

from kalux.display import DisplaySettings, Linear, tone_map
from kalux.errors import InputError, OutputError, SettingsError
from kalux.models.colour import luminance
from kalux.writers import VideoSettings, open_writer, video
from kalux.writers.video import chroma, video_frame

from builders import own_threads

LINEAR, NO_STATISTICS = DisplaySettings(Linear()), np.empty(0)


@dataclasses.dataclass(frozen=True, eq=False)
class Image:
    t: int
    intensity: np.ndarray
    variance: np.ndarray


def make_image(t: int, shape: tuple[int, int] = (48, 64), phase: float = 0.0) -> Image:
    x, y = np.meshgrid(np.linspace(0, 1, shape[1]), np.linspace(0, 1, shape[0]))
    intensity = (0.5 + 0.45 * np.sin(6 * x + 4 * y + phase)).astype(np.float32)
    return Image(t, intensity, np.ones(shape, np.float32))


def decoded(path: Path) -> tuple[list[float], list[np.ndarray], tuple[int, int]]:
    """Times in seconds, luma as 0 to 1, and (height, width)."""
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
        times = [float(frame.time) for frame in frames]
        size = frames[0].height, frames[0].width
        return times, [(luma(frame) - 16) / 219 for frame in frames], size


def luma(frame: av.VideoFrame) -> np.ndarray:
    plane = frame.planes[0]
    values = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
    return values[: frame.height, : frame.width].astype(float)


def settings_of(path: Path) -> dict:
    return tomllib.loads(path.with_name(f"{path.name}.kalux.toml").read_text())


def names(folder: Path) -> set[str]:
    return {p.name for p in folder.iterdir()}


def test_frames_times_and_pixels(tmp_path):
    out = tmp_path / "new" / "v.mp4"
    images = [make_image(5_000_000 + round(k * 1e6 / 300), phase=0.1 * k) for k in range(40)]
    with open_writer(out, display=LINEAR, rate_hz=300, metadata={"preset": "default"}) as writer:
        for image in images:
            writer.write(image)
        assert not out.exists()
    times, pictures, size = decoded(out)
    assert size == (48, 64)
    np.testing.assert_allclose(times, np.arange(40) / 300, atol=1e-6)
    for image, picture in zip(images, pictures, strict=True):
        assert np.abs(picture - image.intensity).mean() < 0.01
    with av.open(str(out)) as container:
        stream = container.streams.video[0]
        assert stream.frames == 40
        assert stream.codec_context.name == "h264"
        assert stream.pix_fmt == "yuv420p"
        assert stream.average_rate == 300
    written = settings_of(out)
    assert written["complete"] is True
    assert written["images"] == 40
    assert written["first_t_us"] == 5_000_000
    assert written["preset"] == "default"
    assert written["output"]["video"]["crf"] == 18
    assert names(out.parent) == {"v.mp4", "v.mp4.kalux.toml"}


def test_times_as_they_are(tmp_path):
    stamps = [100, 10_100, 12_345, 50_000, 50_001, 2_000_000]
    with open_writer(tmp_path / "v.mp4", display=LINEAR) as writer:
        for t in stamps:
            writer.write(make_image(t))
    times, _, _ = decoded(tmp_path / "v.mp4")
    np.testing.assert_allclose(times, (np.array(stamps) - 100) * 1e-6, atol=1e-7)


def test_slow_motion(tmp_path):
    slow = VideoSettings(slow_motion=10)
    with open_writer(tmp_path / "v.mp4", rate_hz=300, video=slow) as writer:
        for k in range(5):
            writer.write(make_image(round(k * 1e6 / 300)))
    times, _, _ = decoded(tmp_path / "v.mp4")
    np.testing.assert_allclose(times, np.arange(5) / 30, atol=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (47, 63), (180, 240), (261, 346)])
def test_odd_sizes_are_padded_by_the_edge(tmp_path, shape):
    with open_writer(tmp_path / "v.mp4", display=LINEAR, video=VideoSettings(crf=1)) as writer:
        writer.write(make_image(0, shape))
    _, pictures, size = decoded(tmp_path / "v.mp4")
    assert size == (shape[0] + shape[0] % 2, shape[1] + shape[1] % 2)
    expected = np.pad(make_image(0, shape).intensity, [(0, n % 2) for n in shape], mode="edge")
    assert np.abs(pictures[0] - expected).max() < 0.03


def test_a_frame_is_the_limited_range():
    frame = video_frame(np.array([[0.0, 1.0], [0.5, 0.25]], np.float32), LINEAR, NO_STATISTICS)
    np.testing.assert_array_equal(luma(frame), [[16, 235], [126, 71]])
    np.testing.assert_array_equal(np.frombuffer(frame.planes[1], np.uint8)[0], 128)


def test_colours_are_those_of_bt_709(tmp_path):
    """Decoded by FFmpeg with what the file says of itself: bars of the primaries, and a ramp, come back."""
    bars = np.zeros((48, 96, 3), np.float32)
    for index, colour in enumerate(
        [(0.8, 0, 0), (0, 0.8, 0), (0, 0, 0.8), (0.6, 0.6, 0.1), (0.3, 0.5, 0.7), (0.5, 0.5, 0.5)]
    ):
        bars[:, 16 * index : 16 * index + 16] = colour
    image = SimpleNamespace(t=0, intensity=bars[..., 0], variance=np.ones((48, 96), np.float32), colour=bars)
    with open_writer(tmp_path / "v.mp4", display=LINEAR, video=VideoSettings(crf=1)) as writer:
        writer.write(image)
    with av.open(str(tmp_path / "v.mp4")) as container:
        context = container.streams.video[0].codec_context
        assert (context.colorspace, context.color_primaries, context.color_trc, context.color_range) == (
            1,
            1,
            1,
            1,
        )
        frame = next(container.decode(video=0))
        assert frame.colorspace == 1
        rgb = frame.reformat(format="rgb24", src_colorspace=1, dst_colorspace=1).to_ndarray() / 255
    expected = tone_map(bars, LINEAR)
    inside = np.abs(np.arange(96) % 16 - 7.5) < 5  # chroma is at half the size
    np.testing.assert_allclose(rgb[:, inside], expected[:, inside], atol=0.02)


def red_difference(picture):
    """The first row of Cr, -0.5 to 0.5."""
    return chroma(picture, luminance(picture))[1][0]


def test_chroma_lies_on_even_columns_between_rows():
    picture = np.zeros((2, 6, 3), np.float32)
    picture[:, 2, 0] = 1.0  # one red column
    np.testing.assert_allclose(red_difference(picture), [0, 1 / 4, 0], atol=1e-3)
    picture = np.roll(picture, 1, axis=1)
    np.testing.assert_allclose(red_difference(picture), [0, 1 / 8, 1 / 8], atol=1e-3)


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_video_plays(tmp_path, error):
    def interrupted():
        with open_writer(tmp_path / "v.mp4", display=LINEAR) as writer:
            for k in range(7):
                writer.write(make_image(1000 * k))
            raise error

    with pytest.raises(error):
        interrupted()
    times, _, _ = decoded(tmp_path / "v.mp4")
    assert len(times) == 7
    assert settings_of(tmp_path / "v.mp4")["complete"] is False
    assert settings_of(tmp_path / "v.mp4")["images"] == 7
    assert names(tmp_path) == {"v.mp4", "v.mp4.kalux.toml"}


def test_an_interrupt_before_the_first_image_leaves_nothing(tmp_path):
    def interrupted():
        with open_writer(tmp_path / "v.mp4"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert names(tmp_path) == set()


def test_a_video_without_images_is_an_error(tmp_path):
    with pytest.raises(OutputError, match="there was no image"):
        open_writer(tmp_path / "v.mp4").close()
    assert names(tmp_path) == set()


CHILD = """
import resource, sys
sys.path[:0] = sys.argv[3:]
import numpy as np
from test_video_writer import Image
from kalux.errors import OutputError
from kalux.writers import open_writer
limit = int(sys.argv[2])
rng = np.random.default_rng(0)
noise = [rng.uniform(0, 1, (120, 160)).astype(np.float32) for _ in range(8)]
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
try:
    with open_writer(sys.argv[1]) as writer:
        for k in range(10**6 if not limit else 200):
            writer.write(Image(1000 * k, noise[k % 8], noise[0]))
            print(k, flush=True)
except OutputError as error:
    print(error, *getattr(error, "__notes__", ()), flush=True)
    sys.exit(2)
except KeyboardInterrupt:
    sys.exit(130)
"""


def child(out: Path, limit: int = 0) -> subprocess.Popen:
    here = Path(__file__).parent
    arguments = [str(out), str(limit), str(here), str(here.parent)]
    return subprocess.Popen([sys.executable, "-c", CHILD, *arguments], stdout=subprocess.PIPE, text=True)


def wait_for(process: subprocess.Popen, line: str) -> None:
    assert process.stdout is not None
    for read in process.stdout:
        if read.strip() == line:
            return


@pytest.mark.parametrize("limit", [1, 50_000, 500_000])
def test_a_disk_that_is_really_full(tmp_path, limit):
    process = child(tmp_path / "v.mp4", limit)
    output, _ = process.communicate(timeout=20)
    assert process.returncode == 2
    said = output.splitlines()[-1]
    assert "v.mp4: the file would be larger than allowed; the video" in said
    assert said.count("v.mp4") == 1
    assert names(tmp_path) == set()


def test_ctrl_c_while_encoding(tmp_path):
    process = child(tmp_path / "v.mp4")
    wait_for(process, "30")
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=20)
    assert process.returncode == 130
    written = settings_of(tmp_path / "v.mp4")
    assert written["complete"] is False
    times, _, _ = decoded(tmp_path / "v.mp4")
    assert len(times) == written["images"] >= 31
    assert names(tmp_path) == {"v.mp4", "v.mp4.kalux.toml"}


def test_a_killed_process_leaves_no_video(tmp_path):
    process = child(tmp_path / "v.mp4")
    wait_for(process, "10")
    process.kill()
    process.communicate(timeout=20)
    assert names(tmp_path) == {".v.mp4.part"}
    with open_writer(tmp_path / "v.mp4") as writer:
        writer.write(make_image(0))
    assert names(tmp_path) == {"v.mp4", "v.mp4.kalux.toml"}


def test_a_video_that_lacks_frames_is_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "frames_of", lambda path: 0)
    writer = open_writer(tmp_path / "v.mp4")
    writer.write(make_image(0))
    with pytest.raises(OutputError, match="0 of 1 images"):
        writer.close()
    assert names(tmp_path) == set()


def test_overwriting(tmp_path):
    out = tmp_path / "v.mp4"
    out.write_bytes(b"former")
    with pytest.raises(OutputError, match=r"there already.*overwriting"):
        open_writer(out)
    writer = open_writer(out, overwrite=True)
    writer.write(make_image(0))
    assert out.read_bytes() == b"former"
    writer.close()
    assert len(decoded(out)[0]) == 1


def test_a_failed_overwrite_keeps_the_former_video(tmp_path, monkeypatch):
    out = tmp_path / "v.mp4"
    with open_writer(out) as writer:
        writer.write(make_image(0))
    before = out.read_bytes(), settings_of(out)

    def failing(*arguments):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(video.os, "replace", failing)
    writer = open_writer(out, overwrite=True)
    monkeypatch.setattr(video, "frames_of", failing)
    writer.write(make_image(0))
    with pytest.raises(OutputError, match="no space is left"):
        writer.close()
    assert (out.read_bytes(), settings_of(out)) == before
    assert names(tmp_path) == {"v.mp4", "v.mp4.kalux.toml"}


def test_foreign_settings_and_folders_are_left(tmp_path):
    (tmp_path / "v.mp4.kalux.toml").write_text("mine = 1")
    with pytest.raises(OutputError, match="there already"):
        open_writer(tmp_path / "v.mp4")
    with pytest.raises(OutputError, match="not an output of kalux"):
        open_writer(tmp_path / "v.mp4", overwrite=True)
    (tmp_path / "f.mp4").mkdir()
    with pytest.raises(OutputError, match="not a file"):
        open_writer(tmp_path / "f.mp4", overwrite=True)


@pytest.mark.parametrize("times", [(0, 0), (0, 10_000, 5000)])
def test_times_that_do_not_increase_are_refused(tmp_path, times):
    writer = open_writer(tmp_path / "v.mp4")
    for t in times[:-1]:
        writer.write(make_image(t))
    with pytest.raises(InputError, match="time order"):
        writer.write(make_image(times[-1]))
    writer.close()
    assert settings_of(tmp_path / "v.mp4")["complete"] is False


def test_times_that_do_not_fit_the_rate_are_refused(tmp_path):
    writer = open_writer(tmp_path / "v.mp4", rate_hz=100)
    writer.write(make_image(0))
    writer.write(make_image(10_001))
    with pytest.raises(InputError, match="does not fit 100 images per second"):
        writer.write(make_image(25_000))
    writer.stop()


def test_a_long_recording_stays_on_the_grid():
    ticks = video.make_ticks(29.97, VideoSettings())
    assert ticks.rate == Fraction(2997, 100)
    for k in (1, 1000, 10**7):
        assert ticks.count(round(k * 1e6 / 29.97)) == k


@pytest.mark.parametrize(
    ("rate", "slow"),
    [
        (29.97, 1.001),
        (99.99999, 999.999),
        (1e6 / 7.1, 123.457),
        (0.00123457, 0.123),
        (999_983.25, 0.001),
        (3e-3, 300.0),
    ],
)
def test_any_rate_and_slow_motion_have_a_clock(tmp_path, rate, slow):
    """Also where their product is a fraction of more than 32 bits: true to 1e-9, and no time twice."""
    slow_motion = VideoSettings(slow_motion=slow)
    ticks = video.make_ticks(rate, slow_motion)
    assert max(ticks.time_base.as_integer_ratio()) < 2**31
    exact = ticks.slow_motion / ticks.rate
    assert abs(ticks.time_base / exact - 1) < Fraction(1, 10**9)
    with open_writer(tmp_path / "v.mp4", rate_hz=rate, video=slow_motion) as writer:
        stamps = [round(k * 1e6 / rate) for k in range(4)]
        for t in stamps:
            writer.write(make_image(t))
    times, _, _ = decoded(tmp_path / "v.mp4")
    np.testing.assert_allclose(times, [float(k * exact) for k in range(4)], rtol=1e-6, atol=1e-7)


def test_a_fraction_that_fits_is_exact():
    ticks = video.make_ticks(29.97, VideoSettings(slow_motion=3.5))
    assert ticks.time_base == Fraction(100, 2997) * Fraction(7, 2)


def test_images_further_apart_than_mp4_can_say_are_refused_before_the_work(tmp_path):
    with pytest.raises(
        SettingsError, match=r"are 2e\+06 s apart, more than MP4 can say; choose a higher rate"
    ):
        open_writer(tmp_path / "v.mp4", rate_hz=0.5, video=VideoSettings(slow_motion=1e6))
    assert names(tmp_path) == set()


def test_a_gap_that_mp4_cannot_say_is_told_at_its_image(tmp_path):
    writer = open_writer(tmp_path / "v.mp4", video=VideoSettings(slow_motion=1e6))
    writer.write(make_image(0))
    writer.write(make_image(100_000))
    with pytest.raises(
        InputError, match="the image at 300000 us would be shown 200000 s after the one before it"
    ):
        writer.write(make_image(300_000))
    writer.stop()
    times, _, _ = decoded(tmp_path / "v.mp4")
    np.testing.assert_allclose(times, [0, 100_000])


@pytest.mark.parametrize("length", [230, 240, 251, 260])
def test_a_name_that_is_too_long_is_told_before_the_first_image(tmp_path, length):
    """Its settings file has a longer one, and a still longer one until it is whole."""
    path = tmp_path / ("v" * (length - 4) + ".mp4")
    if length == 230:
        with open_writer(path) as writer:
            writer.write(make_image(0))
        return
    with pytest.raises(OutputError, match="File name too long; the video cannot be written"):
        open_writer(path)
    assert names(tmp_path) == set()


@pytest.mark.parametrize(
    "options",
    [
        {"rate_hz": 0},
        {"rate_hz": float("nan")},
        {"rate_hz": 2e6},
        {"png_bits": 12},
    ],
)
def test_options_out_of_range(tmp_path, options):
    with pytest.raises(SettingsError):
        open_writer(tmp_path / "v.mp4", **options)


@pytest.mark.parametrize("options", [{"crf": 60}, {"preset": "fastest"}, {"slow_motion": 0}])
def test_video_settings_out_of_range(options):
    with pytest.raises(SettingsError):
        VideoSettings(**options)


class TestSeveralThreads:
    def write(self, out: Path, threads: int, images: int = 20) -> None:
        with open_writer(out, rate_hz=300, threads=threads) as writer:
            for k in range(images):
                writer.write(make_image(round(k * 1e6 / 300), phase=0.1 * k))

    def test_the_video_is_the_same(self, tmp_path):
        for threads in (1, 2, 4):
            self.write(tmp_path / f"{threads}.mp4", threads)
        assert len(decoded(tmp_path / "1.mp4")[0]) == 20
        for threads in (2, 4):
            assert (tmp_path / f"{threads}.mp4").read_bytes() == (tmp_path / "1.mp4").read_bytes()
        assert not own_threads()

    @pytest.mark.parametrize("error", [KeyboardInterrupt, InputError])
    def test_an_interrupt_leaves_all_that_was_given(self, tmp_path, error):
        def write():
            with open_writer(tmp_path / "v.mp4", threads=4) as writer:
                for k in range(7):
                    writer.write(make_image(1000 * k))
                raise error

        with pytest.raises(error):
            write()
        assert len(decoded(tmp_path / "v.mp4")[0]) == settings_of(tmp_path / "v.mp4")["images"] == 7
        assert not own_threads()

    @pytest.mark.parametrize("images", [2, 20], ids=["when it closes", "while it writes"])
    def test_an_error_of_encoding_leaves_nothing(self, tmp_path, monkeypatch, images):
        def broken(*given):
            raise MemoryError("no room")

        monkeypatch.setattr(video, "video_frame", broken)
        with pytest.raises(MemoryError, match="no room"):
            self.write(tmp_path / "v.mp4", 3, images)
        assert names(tmp_path) == set()
        assert not own_threads()

    @pytest.mark.parametrize("threads", [1, 4])
    def test_what_was_encoded_before_an_error_is_kept(self, tmp_path, monkeypatch, threads):
        made = video.video_frame

        def broken(shown, *given):
            if shown[0, 0] > 0.9:
                raise MemoryError("no room")
            return made(shown, *given)

        def write():
            with open_writer(tmp_path / "v.mp4", display=LINEAR, threads=threads) as writer:
                for k in range(6):
                    writer.write(make_image(1000 * k, phase=np.pi / 2 if k == 4 else 0.0))

        monkeypatch.setattr(video, "video_frame", broken)
        with pytest.raises(MemoryError, match="no room"):
            write()
        assert len(decoded(tmp_path / "v.mp4")[0]) == settings_of(tmp_path / "v.mp4")["images"] == 4
        assert settings_of(tmp_path / "v.mp4")["complete"] is False
        assert names(tmp_path) == {"v.mp4", "v.mp4.kalux.toml"}
        assert not own_threads()


def test_in_another_thread(tmp_path):
    from concurrent.futures import ThreadPoolExecutor

    with open_writer(tmp_path / "v.mp4") as writer, ThreadPoolExecutor(1) as pool:
        for k in range(3):
            pool.submit(writer.write, make_image(1000 * k)).result()
    start = time.monotonic()
    assert len(decoded(tmp_path / "v.mp4")[0]) == 3
    assert time.monotonic() - start < 5
