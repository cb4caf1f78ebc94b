"""Frames from elsewhere: folders with times, videos, and what does not fit the events."""

from __future__ import annotations

import dataclasses

import av
import cv2
import numpy as np
import pytest

import kalux
from kalux import readers
from kalux.errors import ExposureError, FormatError, FrameError, InputError
from kalux.frames import Frame
from kalux.readers import joined
from kalux.writers import hdf5
from recordings import SIZE, damaged, same_frames, small_events, small_frames

EVENTS = small_events()


@pytest.fixture
def events_only(tmp_path):
    """A recording without frames that states its sensor."""
    path = tmp_path / "events.h5"
    hdf5.write(path, sensor_size=SIZE, events=[EVENTS], frames=[], contrast_threshold=(0.1, 0.2))
    return path


@pytest.fixture
def sizeless(tmp_path):
    """Events in a file that does not say how large the sensor is."""
    np.savez(tmp_path / "events.npz", t_us=EVENTS["t"], x=EVENTS["x"], y=EVENTS["y"], p=EVENTS["p"])
    return tmp_path / "events.npz"


def write_images(folder, frames=None, names=None):
    folder.mkdir()
    frames = small_frames() if frames is None else frames
    names = names or [f"{index:03d}.png" for index in range(len(frames))]
    for frame, name in zip(frames, names, strict=True):
        cv2.imwrite(str(folder / name), frame.image)
    return names


def write_list(folder, header, row, name="frames.csv", names=None):
    """A folder of the small frames with a list, ``row`` of a frame and its file name."""
    names = write_images(folder, names=names)
    lines = [header, *(row(frame, file) for frame, file in zip(small_frames(), names, strict=True))]
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder


LISTS = {
    "exposures in us": ("timestamp_us,exposure_us", lambda f, n: f"{f.exposure_start},{f.exposure}"),
    "other units": ("t_ns;exposure_ms", lambda f, n: f"{f.exposure_start * 1000}; {f.exposure / 1000}"),
    "files": ("file,t_s,gain,exposure", lambda f, n: f"{n},{f.exposure_start / 1e6:.6f},,{f.exposure}"),
    "comment": ("# timestamp, exposure_time", lambda f, n: f"{f.exposure_start}, {f.exposure}"),
}


@pytest.mark.parametrize("kind", LISTS)
def test_a_folder_with_exposures(events_only, tmp_path, kind):
    folder = write_list(tmp_path / "images", *LISTS[kind])
    rec = kalux.open(events_only, frames=folder)
    assert (rec.exposure_known, rec.sensor_size, rec.source.format) == (True, SIZE, "kalux + images")
    assert (rec.contrast_threshold, rec.source.missing) == ((0.1, 0.2), ())
    assert (len(rec.events()), len(rec.frames())) == (500, 4)
    for _ in range(2):
        assert same_frames(rec.frames(), small_frames())
        assert np.array_equal(np.concatenate(list(rec.events())), EVENTS)


def test_trigger_edges_of_the_events_are_kept(events_only, tmp_path):
    source = dataclasses.replace(readers.read(events_only), triggers=lambda: iter(()))
    folder = write_list(tmp_path / "images", *LISTS["exposures in us"])
    assert joined.join(source, folder, start=None, rate_hz=None, replace=False).triggers is source.triggers


def test_files_are_taken_in_the_order_of_the_list(events_only, tmp_path):
    names = ["d.png", "c.png", "b.png", "a.png"]
    row = LISTS["files"][1]
    folder = write_list(tmp_path / "images", LISTS["files"][0], row, names=names)
    assert same_frames(kalux.open(events_only, frames=folder).frames(), small_frames())


def test_images_that_no_list_names_are_in_the_order_of_their_numbers(events_only, tmp_path):
    """9.png before 10.png; what other systems leave beside them (._9.png) is no image."""
    header, row = LISTS["exposures in us"]
    folder = write_list(tmp_path / "images", header, row, names=["8.png", "9.png", "10.png", "11.png"])
    (folder / "._9.png").write_bytes(b"Mac OS X")
    assert same_frames(kalux.open(events_only, frames=folder).frames(), small_frames())


@pytest.mark.parametrize("name", ["frames.csv", "timestamps.csv", "mine.csv"])
@pytest.mark.parametrize("given", ["folder", "file"])
def test_lists_have_other_names_and_can_be_given(events_only, tmp_path, name, given):
    folder = write_list(tmp_path / "images", *LISTS["exposures in us"], name=name)
    rec = kalux.open(events_only, frames=folder if given == "folder" else folder / name)
    assert same_frames(rec.frames(), small_frames())


def test_stamps_alone_need_an_exposure(events_only, tmp_path):
    folder = write_list(tmp_path / "images", "timestamp_us", lambda f, n: str(f.exposure_start))
    rec = kalux.open(events_only, frames=folder)
    assert any("exposure times" in text for text in rec.source.missing)
    with pytest.raises(ExposureError, match="--exposure"):
        rec.frames()
    rec = kalux.open(events_only, frames=folder, exposure=3_000, stamp="middle")
    assert [frame.exposure_start for frame in rec.frames()] == [
        f.exposure_start - 1_500 for f in small_frames()
    ]


def test_the_list_of_ijrr(events_only, tmp_path):
    row = lambda f, n: f"{f.exposure_start / 1e6:.9f} {n}"  # noqa: E731
    folder = write_list(tmp_path / "images", "# t file", row, name="images.txt")
    rec = kalux.open(events_only, frames=folder)
    assert [frame.exposure_start for frame in rec.stamped_frames()] == [
        f.exposure_start for f in small_frames()
    ]


TIMES_ALONE = {
    "us": ("{t}", "whole numbers are taken as microseconds"),
    "us, as floats": ("{t}.0", "whole numbers are taken as microseconds"),
    "s": ("{s:.6f}", "decimals are taken as seconds"),
    "s, as Python prints them": ("{s}", "decimals are taken as seconds"),
}


@pytest.mark.parametrize("kind", TIMES_ALONE)
@pytest.mark.parametrize("name", ["timestamps.txt", "timestamp.txt", "timestamps.csv"])
def test_times_alone_are_those_of_the_images_beside_them(events_only, tmp_path, kind, name):
    """As jAER saves frames: images named by their times, which are in order of their numbers, and a comment."""
    template, told = TIMES_ALONE[kind]
    stamps = [f.exposure_start + 5 for f in small_frames()]
    folder = tmp_path / "images"
    write_images(folder, names=[f"{stamp}.png" for stamp in stamps])
    lines = ["# jAER APS frame timestamps (microseconds), one per PNG"]
    lines += [template.format(t=stamp, s=stamp / 1e6) for stamp in stamps]
    (folder / name).write_text("\n".join(lines))
    for place in (folder, folder / name):
        rec = kalux.open(events_only, frames=place)
        assert [frame.exposure_start for frame in rec.stamped_frames()] == stamps
        assert all(
            np.array_equal(ours.image, theirs.image)
            for ours, theirs in zip(rec.stamped_frames(), small_frames(), strict=True)
        )
        assert any(told in sentence for sentence in rec.source.missing)
        assert any("exposure times" in sentence for sentence in rec.source.missing)


@pytest.mark.parametrize(
    ("text", "told"), [("1\n2\n", "lists 2 times, but there are 4 images"), ("1\n1e99\n", "line 2")]
)
def test_times_alone_must_be_possible_and_as_many_as_images(events_only, tmp_path, text, told):
    folder = tmp_path / "images"
    write_images(folder)
    (folder / "timestamps.txt").write_text(text)
    with pytest.raises(FormatError, match=told):
        kalux.open(events_only, frames=folder)


class TestSize:
    def test_another_size_is_refused(self, events_only, tmp_path):
        folder = tmp_path / "images"
        write_images(folder, [Frame(np.zeros((31, 40), np.uint8), 0, 1)])
        (folder / "frames.csv").write_text("t_us\n0\n")
        with pytest.raises(FrameError, match=r"40x31 pixels, but the sensor of .* is 40x30"):
            kalux.open(events_only, frames=folder)

    def test_a_size_that_the_recording_does_not_know_is_that_of_the_frames(self, sizeless, tmp_path):
        assert kalux.open(sizeless).sensor_size != (60, 80)
        folder = tmp_path / "images"
        write_images(folder, [Frame(np.zeros((60, 80), np.uint8), 0, 1)])
        (folder / "frames.csv").write_text("t_us,exposure_us\n0,5\n")
        rec = kalux.open(sizeless, frames=folder)
        assert (rec.sensor_size, rec.source.missing) == ((60, 80), ())
        assert next(iter(rec.frames())).image.shape == (60, 80)

    def test_rows_that_are_counted_from_below_are_those_of_the_frames(self, tmp_path):
        """jAER's text does not say how many there are."""
        path, folder = tmp_path / "events.txt", tmp_path / "images"
        path.write_text(
            "# jAER DAVIS/DVS camera text file output\n# t_us x y p\n1 0 0 1\n2 3 19 0\n3 3 10 1\n"
        )
        write_images(folder, [Frame(np.zeros((60, 80), np.uint8), 0, 1)])
        (folder / "frames.csv").write_text("t_us,exposure_us\n0,5\n")
        alone, joined = kalux.open(path), kalux.open(path, frames=folder)
        assert np.concatenate([*alone.events()])["y"].tolist() == [19, 0, 9]
        assert np.concatenate([*joined.events()])["y"].tolist() == [59, 40, 49]
        (tmp_path / "low").mkdir()
        cv2.imwrite(str(tmp_path / "low" / "000.png"), np.zeros((19, 80), np.uint8))
        (tmp_path / "low" / "frames.csv").write_text("t_us\n0\n")
        path.write_text("# jAER DAVIS/DVS camera text file output\n# t_us x y p\n1 0 15 1\n2 3 19 0\n")
        with pytest.raises(FrameError, match="is at least 4x20"):
            kalux.open(path, frames=tmp_path / "low")

    def test_but_all_events_must_lie_in_it(self, sizeless, tmp_path):
        folder = tmp_path / "images"
        write_images(folder, [Frame(np.zeros((60, 20), np.uint8), 0, 1)])
        (folder / "frames.csv").write_text("t_us\n0\n")
        with pytest.raises(FrameError, match="is at least"):
            kalux.open(sizeless, frames=folder)


class TestOwnFrames:
    @pytest.fixture
    def hybrid(self, tmp_path):
        path = tmp_path / "hybrid.h5"
        frames = small_frames(3, seed=9)
        hdf5.write(path, sensor_size=SIZE, events=[EVENTS], frames=frames, inverse_covariance=np.ones(256))
        return path

    def test_are_kept_unless_told_otherwise(self, hybrid, tmp_path):
        folder = write_list(tmp_path / "images", *LISTS["exposures in us"])
        with pytest.raises(InputError, match=r"3 frames of its own.*--replace-frames"):
            kalux.open(hybrid, frames=folder)
        rec = kalux.open(hybrid, frames=folder, replace_frames=True)
        assert same_frames(rec.frames(), small_frames())
        assert rec.source.inverse_covariance is None, "it describes the frames that were replaced"

    def test_flags_without_frames_are_refused(self, hybrid):
        for flag in ({"frames_start": 5}, {"frames_rate": 5.0}, {"replace_frames": True}):
            with pytest.raises(InputError, match="give frames"):
                kalux.open(hybrid, **flag)


class TestBadLists:
    @pytest.mark.parametrize(
        ("text", "told"),
        [
            ("", "is empty"),
            ("exposure_us\n5\n", "has the columns exposure_us"),
            ("t_us,file\n", "lists no images"),
            ("t_us\n1\n2\n", "lists 2 times, but there are 4 images"),
            ("t_us\n1\n-2\n3\n4\n", "line 3: '-2' is not a plain number"),
            ("t_us\n1\nnan\n3\n4\n", "line 3: 'nan'"),
            ("t_us\n1\n2,5\n3\n4\n", "line 3: '2,5' has 2 columns, not 1"),
            ("t\n1\n2.5\n3\n4\n", "line 3: '2.5' has decimals, but no unit"),
            ("t_us,file\n1,none.png\n", "1 of 1 images are missing"),
            ("t_us,file\n1,frames.csv\n", "not an image"),
            (b"\xff\xfe", "damaged"),
            ("\0\0", "is empty, or no text"),
            ("t_us,file\n1," + "a" * 200_000, "field larger than field limit"),
        ],
    )
    def test_are_one_line(self, events_only, tmp_path, text, told):
        folder = tmp_path / "images"
        write_images(folder)
        (folder / "frames.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
        with pytest.raises(FormatError, match=told) as caught:
            kalux.open(events_only, frames=folder)
        assert "\n" not in str(caught.value)

    def test_no_list_or_several(self, events_only, tmp_path):
        folder = tmp_path / "images"
        write_images(folder)
        with pytest.raises(FormatError, match=r"has no list of times; a CSV named frames\.csv"):
            kalux.open(events_only, frames=folder)
        for name in ("a.csv", "b.csv"):
            (folder / name).write_text("t_us\n0\n")
        with pytest.raises(FormatError, match="has 2 CSV files"):
            kalux.open(events_only, frames=folder)

    def test_images_in_colour_are_not_among_them(self, events_only, tmp_path):
        folder = tmp_path / "images"
        colour = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8)
        write_images(folder, [Frame(colour, 0, 1)])
        (folder / "frames.csv").write_text("t_us\n0\n")
        frame = next(iter(kalux.open(events_only, frames=folder, exposure=100).frames()))
        assert np.array_equal(frame.image, colour[..., ::-1])  # `write_images` leaves OpenCV's order

    def test_nothing_there(self, events_only, tmp_path):
        with pytest.raises(InputError, match="no such file"):
            kalux.open(events_only, frames=tmp_path / "none")

    def test_a_start_for_images(self, events_only, tmp_path):
        folder = write_list(tmp_path / "images", *LISTS["exposures in us"])
        with pytest.raises(InputError, match="are for a video"):
            kalux.open(events_only, frames=folder, frames_start=0)

    def test_damage_gives_clear_errors(self, events_only, tmp_path):
        folder = write_list(tmp_path / "images", *LISTS["files"])
        whole = (folder / "frames.csv").read_bytes()
        for changed in damaged(whole, 150):
            (folder / "frames.csv").write_bytes(changed)
            message = complaint(events_only, frames=folder)
            assert "\n" not in message
            assert not message or str(tmp_path) in message


def complaint(path, **options):
    try:
        rec = kalux.open(path, **options)
        for _ in rec.stamped_frames():
            pass
    except kalux.KaluxError as error:
        return str(error)
    return ""


def write_video(path, images, *, codec="ffv1", pixels="gray", rate=25, transfer=None):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate)
        stream.height, stream.width = images[0].shape
        stream.pix_fmt = pixels
        if transfer is not None:
            stream.codec_context.color_trc = transfer
        kind = "gray16le" if images[0].dtype == np.uint16 else "gray"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format=kind)))
        container.mux(stream.encode())
    return path


def write_h264(path, images, reordered, **options):
    """One key frame, and up to so many pictures in a row that are stored after later ones."""
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream("libx264", 30)
        stream.height, stream.width, stream.pix_fmt = *SIZE, "yuv420p"
        stream.options = {"g": "100", "bf": str(reordered)}
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray")))
        container.mux(stream.encode())
    return path


class TestVideo:
    images = tuple(frame.image for frame in small_frames(6))

    @pytest.mark.parametrize(
        ("codec", "pixels", "lossy"),
        [("ffv1", "gray", False), ("h264", "yuv420p", True), ("mjpeg", "yuvj420p", True)],
    )
    def test_says_whether_its_codec_changes_pictures(self, events_only, tmp_path, codec, pixels, lossy):
        video = write_video(tmp_path / "v.mkv", self.images, codec=codec, pixels=pixels)
        joined = kalux.open(events_only, frames=video, frames_start=0, frames_rate=30, exposure=2_000)
        assert joined.source.of_lossy_video == lossy
        assert not kalux.open(events_only).source.of_lossy_video

    def test_lossless(self, events_only, tmp_path):
        video = write_video(tmp_path / "v.mkv", self.images)
        rec = kalux.open(events_only, frames=video, frames_start=1_000, frames_rate=30, exposure=2_000)
        assert (len(rec.frames()), rec.source.format, rec.source.exposure_known) == (
            6,
            "kalux + video",
            False,
        )
        stamps = [1_000, 34_333, 67_667, 101_000, 134_333, 167_667]
        expected = [Frame(image, t, t + 2_000) for image, t in zip(self.images, stamps, strict=True)]
        for _ in range(2):
            assert same_frames(rec.frames(), expected)

    def test_start_and_rate_of_any_type(self, events_only, tmp_path):
        """Times beyond `numpy.int32`, and to the microsecond where `numpy.float32` has some thousands of them."""
        video = write_video(tmp_path / "v.mkv", self.images)
        for start, rate in ((np.int32(2**31 - 1), 0.001), (np.uint32(2**32 - 1), np.float32(0.25))):
            rec = kalux.open(events_only, frames=video, frames_start=start, frames_rate=rate)
            stamps = [frame.exposure_start for frame in rec.stamped_frames()]
            assert stamps == [int(start) + round(k * 1e6 / float(rate)) for k in range(6)]

    def test_a_start_between_microseconds(self, events_only, tmp_path):
        video = write_video(tmp_path / "v.mkv", self.images)
        for start in (0.5, float("nan")):
            with pytest.raises(InputError, match=r"the first frame is at .* us; whole microseconds"):
                kalux.open(events_only, frames=video, frames_start=start, frames_rate=30)

    @pytest.mark.parametrize("reordered", [0, 3])
    def test_trimmed_without_encoding_anew(self, events_only, tmp_path, reordered):
        """As ffmpeg -c copy does: pictures before the cut stay in the file, and its edit list hides them."""
        levels = [np.full(SIZE, 8 * k, np.uint8) for k in range(30)]
        whole = write_h264(tmp_path / "whole.mp4", levels, reordered)
        with av.open(str(whole)) as source, av.open(str(tmp_path / "v.mp4"), "w") as target:
            stream = target.add_stream_from_template(source.streams.video[0])
            for packet in source.demux(source.streams.video[0]):
                if packet.dts is not None:
                    packet.pts -= round(10 / 30 / packet.time_base)
                    packet.dts -= round(10 / 30 / packet.time_base)
                    packet.stream = stream
                    target.mux(packet)
        rec = kalux.open(events_only, frames=tmp_path / "v.mp4", frames_start=0, frames_rate=30)
        means = [frame.image.mean() for frame in rec.stamped_frames()]
        assert means == pytest.approx([8 * k for k in range(10, 30)], abs=3)

    @pytest.mark.parametrize("share", [0.5, 0.9, 0.999])
    def test_an_mp4_cut_short_is_refused(self, events_only, tmp_path, share):
        video = write_h264(tmp_path / "v.mp4", [f.image for f in small_frames(30)], 0, movflags="faststart")
        data = video.read_bytes()
        video.write_bytes(data[: int(share * len(data))])
        with pytest.raises(FormatError, match=r"v\.mp4"):
            list(kalux.open(events_only, frames=video, frames_start=0, frames_rate=30).stamped_frames())

    @pytest.mark.parametrize("share", [0.5, 0.9])
    def test_an_avi_cut_short_is_refused(self, events_only, tmp_path, share):
        video = write_h264(tmp_path / "v.avi", [f.image for f in small_frames(30)], 0)
        data = video.read_bytes()
        video.write_bytes(data[: int(share * len(data))])
        with pytest.raises(FormatError, match=r"v\.avi"):
            list(kalux.open(events_only, frames=video, frames_start=0, frames_rate=30).stamped_frames())

    def test_more_than_8_bits(self, events_only, tmp_path):
        images = [image.astype(np.uint16) * 257 for image in self.images]
        video = write_video(tmp_path / "v.mkv", images, pixels="gray16le")
        rec = kalux.open(events_only, frames=video, frames_start=0, frames_rate=30)
        for frame, image in zip(rec.stamped_frames(), images, strict=True):
            assert np.array_equal(frame.image, image)

    def test_the_luma_of_an_ordinary_video(self, events_only, tmp_path):
        levels = [np.full(SIZE, level, np.uint8) for level in (0, 100, 255)]
        video = write_video(tmp_path / "v.mp4", levels, codec="h264", pixels="yuv420p")
        rec = kalux.open(events_only, frames=video, frames_start=0, frames_rate=30)
        means = [frame.image.mean() for frame in rec.stamped_frames()]
        assert means == pytest.approx([0, 100, 255], abs=3)

    @pytest.mark.parametrize(
        ("transfer", "response", "note"),
        [
            (1, "bt709", None),
            (6, "bt709", None),
            (13, "srgb", None),
            (8, "linear", None),
            (None, None, "The video does not state how its pictures follow the light"),
            (16, None, "The video states transfer characteristics 16 of ITU-T H.273"),
        ],
    )
    def test_the_tone_curve_that_a_video_states(self, events_only, tmp_path, transfer, response, note):
        video = write_video(
            tmp_path / "v.mp4", self.images, codec="h264", pixels="yuv420p", transfer=transfer
        )
        rec = kalux.open(events_only, frames=video, frames_start=0, frames_rate=30)
        assert rec.response == response
        notes = [text for text in rec.source.missing if "count as linear" in text]
        assert len(notes) == (note is not None)
        assert all(text.startswith(str(note)) for text in notes)

    def test_a_video_in_colour(self, events_only, tmp_path):
        """Its first picture may be black; red is red."""
        pictures = [np.zeros((*SIZE, 3), np.uint8) for _ in range(3)]
        pictures[1][:] = (200, 40, 20)
        with av.open(str(tmp_path / "v.mp4"), "w") as container:
            stream = container.add_stream("h264", 25)
            stream.height, stream.width, stream.pix_fmt = *SIZE, "yuv420p"
            for picture in pictures:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode())
        rec = kalux.open(events_only, frames=tmp_path / "v.mp4", frames_start=0, frames_rate=30)
        means = [frame.image.mean(axis=(0, 1)) for frame in rec.stamped_frames()]
        assert means[0] == pytest.approx([0, 0, 0], abs=3)
        assert means[1] == pytest.approx([200, 40, 20], abs=4)
        assert any("colours of a video" in text for text in rec.source.missing)

    @pytest.mark.parametrize("given", [{}, {"frames_start": 0}, {"frames_rate": 30.0}])
    def test_start_and_rate_are_needed(self, events_only, tmp_path, given):
        video = write_video(tmp_path / "v.mkv", self.images)
        with pytest.raises(InputError, match="--frames-start US and --frames-rate HZ"):
            kalux.open(events_only, frames=video, **given)

    @pytest.mark.parametrize("rate", [0, -5, float("nan"), float("inf")])
    def test_impossible_rates(self, events_only, tmp_path, rate):
        video = write_video(tmp_path / "v.mkv", self.images)
        with pytest.raises(InputError, match="the rate of the frames is"):
            kalux.open(events_only, frames=video, frames_start=0, frames_rate=rate)

    def test_no_video(self, events_only, tmp_path):
        (tmp_path / "v.mp4").write_bytes(b"nothing" * 100)
        with pytest.raises(FormatError, match=r"v\.mp4: neither an image nor a video, or a damaged"):
            kalux.open(events_only, frames=tmp_path / "v.mp4", frames_start=0, frames_rate=30)

    @pytest.mark.parametrize(
        ("name", "codec", "pixels"), [("v.mkv", "ffv1", "gray"), ("v.mp4", "h264", "yuv420p")]
    )
    def test_damage_gives_clear_errors(self, events_only, tmp_path, name, codec, pixels):
        video = write_video(tmp_path / name, self.images, codec=codec, pixels=pixels)
        for changed in damaged(video.read_bytes(), 60):
            video.write_bytes(changed)
            message = complaint(events_only, frames=video, frames_start=0, frames_rate=30)
            assert "\n" not in message
            assert not message or str(tmp_path) in message


def test_a_real_recording_taken_apart(shared_data, tmp_path):
    """Real payload, our writer: events alone, and the frames as PNG with their exposures."""
    whole = kalux.open(shared_data / "street_davis346.aedat4")
    frames = list(whole.frames())
    hdf5.write(tmp_path / "events.h5", sensor_size=whole.sensor_size, events=whole.events(), frames=[])
    names = write_images(tmp_path / "images", frames)
    rows = (f"{n},{f.exposure_start},{f.exposure}" for f, n in zip(frames, names, strict=True))
    (tmp_path / "images" / "frames.csv").write_text("\n".join(["file,timestamp_us,exposure_us", *rows]))
    joined = kalux.open(tmp_path / "events.h5", frames=tmp_path / "images")
    assert same_frames(joined.frames(), frames)
    assert len(joined.events()) == len(whole.events())
