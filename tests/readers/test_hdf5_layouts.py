"""Other people's HDF5 layouts, each transcoded by a writer made from its public description."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import NamedTuple

import cv2
import h5py
import hdf5plugin
import numpy as np
import pytest

import kalux
from kalux import readers
from kalux.errors import FormatError, FrameError, InputError
from kalux.frames import Frame
from kalux.readers import hdf5_layout
from recordings import SIZE, all_events, colour_frames, complaint, damaged, small_events, small_frames


class Layout(NamedTuple):
    """A writer, the file it makes, and what of a recording the layout keeps."""

    write: object
    name: str
    has_frames: bool = True


def packing():
    return {"chunks": (64,), **hdf5plugin.Blosc(cname="zstd")}


def write_dsec_events(path, events, offset=7_000_000):
    path.parent.mkdir(parents=True, exist_ok=True)
    t = events["t"] - events["t"][0] if len(events) else events["t"]
    offset = int(events["t"][0]) if len(events) else offset
    with h5py.File(path, "w") as file:
        file.create_dataset("events/t", data=t.astype(np.uint32), **packing())
        file.create_dataset("events/x", data=events["x"], **packing())
        file.create_dataset("events/y", data=events["y"], **packing())
        file.create_dataset("events/p", data=events["p"].astype(np.uint8), **packing())
        duration_ms = (int(t[-1]) if len(t) else 0) // 1000 + 1
        file["ms_to_idx"] = np.searchsorted(t, np.arange(duration_ms) * 1000).astype(np.uint64)
        file["t_offset"] = np.int64(offset)


def write_rectify_map(path, size):
    with h5py.File(path, "w") as file:
        file["rectify_map"] = np.zeros((*size, 2), np.float32)


def write_dsec_folder(folder, events, frames, size):
    write_dsec_events(folder / "events/left/events.h5", events)
    write_rectify_map(folder / "events/left/rectify_map.h5", size)
    images = folder / "images/left/rectified"
    images.mkdir(parents=True)
    for index, frame in enumerate(frames):
        cv2.imwrite(str(images / f"{index:06d}.png"), frame.image)
    lines = "".join(f"{frame.exposure_start}, {frame.exposure_end}\n" for frame in frames)
    (folder / "images/left/exposure_timestamps.txt").write_text(
        "# exposure_start_timestamp_us, exposure_end_timestamp_us\n" + lines
    )
    (folder / "images/timestamps.txt").write_text("".join(f"{frame.middle}\n" for frame in frames))
    return folder


def write_dsec(path, events, frames, size):
    write_dsec_events(path, events)
    write_rectify_map(path.with_name("rectify_map.h5"), size)


def write_hqf(path, events, frames, size):
    with h5py.File(path, "w") as file:
        for name, column, dtype in (("xs", "x", np.int16), ("ys", "y", np.int16), ("ps", "p", np.float64)):
            file.create_dataset(
                f"events/{name}", data=events[column].astype(dtype), maxshape=(None,), chunks=True
            )
        file.create_dataset("events/ts", data=events["t"] / 1e6, maxshape=(None,), chunks=True)
        for index, frame in enumerate(frames):
            image = file.create_dataset(f"images/image{index:09d}", data=frame.image)
            image.attrs["size"] = frame.image.shape
            image.attrs["timestamp"] = frame.exposure_start / 1e6
            image.attrs["type"] = "greyscale"
        file.attrs["sensor_resolution"] = size
        file.attrs["num_events"], file.attrs["num_imgs"] = len(events), len(frames)


def write_mvsec(path, events, frames, size):
    rows = np.empty((len(events), 4))
    rows[:, 0], rows[:, 1], rows[:, 2] = events["x"], events["y"], events["t"] / 1e6
    rows[:, 3] = np.where(events["p"], 1, -1)
    with h5py.File(path, "w") as file:
        file.create_dataset("davis/left/events", data=rows, chunks=(100, 4))
        file["davis/left/image_raw"] = np.array([frame.image for frame in frames]).reshape(-1, *size)
        file["davis/left/image_raw_ts"] = np.array([frame.exposure_start / 1e6 for frame in frames])
        file["davis/right/events"] = rows[:5]


def write_v2e(path, events, frames, size):
    rows = np.stack([events[name].astype(np.uint32) for name in "txyp"], axis=-1)
    with h5py.File(path, "w") as file:
        file.create_dataset("events", data=rows, maxshape=(None, 4), chunks=(100, 4), compression="gzip")
        images = np.array([frame.image for frame in frames]).reshape(-1, *size)
        stamps = np.array([frame.exposure_start for frame in frames], np.uint32)
        file.create_dataset("frame", data=images, compression="gzip")
        file.create_dataset("frame_ts", data=stamps, compression="gzip")
        file.create_dataset("frame_idx", data=np.searchsorted(events["t"], stamps), compression="gzip")


def write_metavision(path, events, frames, size):
    dtype = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")], align=True)
    rows = np.empty(len(events), dtype)
    for field in "xypt":
        rows[field] = events[field]
    with h5py.File(path, "w") as file:
        file.create_dataset("CD/events", data=rows, chunks=(100,))  # without ECF, which no package brings
        file["EXT_TRIGGER/events"] = np.zeros(3, [("p", "<i2"), ("t", "<i8"), ("id", "<i2")])
        file.attrs["geometry"] = f"{size[1]}x{size[0]}"


def write_plain(path, events, frames, size, group="prophesee/left"):
    with h5py.File(path, "w") as file:
        there = file.require_group(group)
        for name, dtype in (("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.int8)):
            there.create_dataset(name, data=events[name].astype(dtype), chunks=(100,), compression="lzf")
        there["ms_map_idx"] = np.arange(20, dtype=np.uint64)
        there.attrs["height"], there.attrs["width"] = size


def write_plain_table(path, events, frames, size, name="events"):
    with h5py.File(path, "w") as file:
        kind = [("ts_us", "<i8"), ("x", "<u2"), ("y", "<i4"), ("pol", "?"), ("other", "<f4")]
        rows = np.zeros(len(events), kind)
        rows["ts_us"], rows["x"], rows["y"], rows["pol"] = (events[field] for field in "txyp")
        file.create_dataset(name, data=rows, chunks=(100,))
        file.attrs["resolution"] = size[::-1]


LAYOUTS = {
    "hdf5": Layout(write_plain, "m3ed_data.h5", has_frames=False),
    "dsec": Layout(write_dsec, "events.h5", has_frames=False),
    "hqf": Layout(write_hqf, "slow_hand.h5"),
    "mvsec": Layout(write_mvsec, "indoor_flying1_data.hdf5"),
    "v2e": Layout(write_v2e, "events.h5"),
    "metavision hdf5": Layout(write_metavision, "spinner.hdf5", has_frames=False),
}


@pytest.fixture(params=LAYOUTS)
def layout(request):
    return request.param


def write(tmp_path, layout, events=None, frames=None, size=SIZE):
    path = tmp_path / LAYOUTS[layout].name
    events = small_events() if events is None else events
    LAYOUTS[layout].write(path, events, small_frames() if frames is None else frames, size)
    return path


def assert_stamped(frames, expected):
    """The images, each with its stamp for start and end."""
    for ours, theirs in zip(frames, expected, strict=True):
        assert np.array_equal(ours.image, theirs.image)
        assert ours.image.dtype == theirs.image.dtype
        assert ours.exposure_start == ours.exposure_end == theirs.exposure_start


def test_everything_that_a_layout_holds(tmp_path, layout):
    source = readers.read(write(tmp_path, layout))
    assert (source.format, source.sensor_size, source.sensor_size_known) == (layout, SIZE, True)
    assert source.count_events() == 500
    for _ in range(2):
        assert np.array_equal(all_events(source), small_events())
        expected = small_frames() if LAYOUTS[layout].has_frames else []
        assert_stamped(source.frames(), expected)
    assert source.count_frames() == len(expected)
    assert source.exposure_known == (not expected)
    assert any(("exposure times" if expected else "no ") in sentence for sentence in source.missing)


def test_chunks_join_without_a_seam(tmp_path, layout, monkeypatch):
    path = write(tmp_path, layout)
    monkeypatch.setattr(hdf5_layout, "CHUNK_EVENTS", 150)
    chunks = list(readers.read(path).events())
    assert max(map(len, chunks)) <= (512 if layout == "hqf" else 150)
    assert np.array_equal(np.concatenate(chunks), small_events())


def test_whole_chunks_of_the_file_are_read(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        column = file.create_dataset("x", (5 << 20,), "u2", chunks=(300_000,))
        parts = list(hdf5_layout.slices(column, len(column)))
    assert all(part.start % 300_000 == 0 for part in parts)
    assert [parts[0].start, parts[-1].stop] == [0, 5 << 20]
    assert all(a.stop == b.start for a, b in pairwise(parts))
    assert max(part.stop - part.start for part in parts) <= 1 << 20


def test_columns_that_are_not_stored_in_full_are_refused(tmp_path):
    """HDF5 would read what is not there as zeros, without end."""
    path = write(tmp_path, "dsec")
    with h5py.File(path, "r+") as file:
        for name in "txyp":
            column = file[f"events/{name}"]
            data, kind = column[...], column.dtype
            del file[f"events/{name}"]
            file.create_dataset(f"events/{name}", (10**12,), kind, maxshape=(None,), chunks=(64,))
            file[f"events/{name}"][: len(data)] = data
    with pytest.raises(FormatError, match="not stored in full"):
        readers.read(path)


def test_huge_chunks_are_refused(tmp_path):
    """HDF5 would need as much memory to unpack one."""
    path = write(tmp_path, "dsec")
    with h5py.File(path, "r+") as file:
        del file["events/t"]
        file.create_dataset("events/t", (500,), "u4", maxshape=(None,), chunks=(1 << 28,), compression="gzip")
    with pytest.raises(FormatError, match="repack it in smaller ones"):
        readers.read(path)


@pytest.mark.parametrize("layout", ["dsec", "hqf"])
def test_columns_of_different_lengths_are_refused(tmp_path, layout):
    path = write(tmp_path, layout)
    with h5py.File(path, "r+") as file:
        name = "events/x" if layout == "dsec" else "events/xs"
        data = file[name][:-1]
        del file[name]
        file[name] = data
    with pytest.raises(FormatError, match=f"different lengths .*{name} 499"):
        readers.read(path)


def test_a_truncated_file_is_refused(tmp_path, layout):
    path = write(tmp_path, layout)
    data = path.read_bytes()
    for share in (0.1, 0.5, 0.9):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(FormatError, match="damaged"):
            readers.read(path)


def test_damage_gives_clear_errors(tmp_path, layout):
    """Only values and lengths: HDF5's own structures have no checksums in these files, and it may crash on them."""
    path = write(tmp_path, layout)
    with h5py.File(path) as file:
        names = []
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        whole = {name: (file[name][()], file[name].dtype) for name in names}
    for name, (values, kind) in whole.items():
        for seed, changed in enumerate(damaged(np.asarray(values).tobytes(), 6)):
            if len(changed) % kind.itemsize:
                changed = changed[: -(len(changed) % kind.itemsize)]
            replaced = np.frombuffer(changed, kind)
            with h5py.File(path, "r+") as file:
                del file[name]
                file[name] = (
                    replaced
                    if seed % 2 or replaced.size != np.size(values)
                    else replaced.reshape(np.shape(values))
                )
            message = complaint(path)
            assert "\n" not in message
            assert not message or str(path.parent) in message
        with h5py.File(path, "r+") as file:
            del file[name]
            file[name] = values


class TestDsec:
    def test_times_have_the_offset(self, tmp_path):
        events = small_events()
        events["t"] += 49_599_300_523
        assert np.array_equal(all_events(readers.read(write(tmp_path, "dsec", events))), events)

    def test_the_published_size_where_nothing_says_so(self, tmp_path):
        path = write(tmp_path, "dsec")
        path.with_name("rectify_map.h5").unlink()
        assert readers.read(path).sensor_size == (480, 640)
        events = small_events()
        events["x"][3] = 1279
        path = write(tmp_path, "dsec", events)
        path.with_name("rectify_map.h5").unlink()
        assert readers.read(path).sensor_size == (480, 1280)

    def test_joined_frames_know_the_size_better(self, tmp_path):
        """As other devices record in this layout; a size that is stated stays."""
        path = write(tmp_path, "dsec")
        rectify_map = path.with_name("rectify_map.h5")
        frames = tmp_path / "frames"
        frames.mkdir()
        cv2.imwrite(str(frames / "0.png"), np.zeros((SIZE[0] + 1, SIZE[1]), np.uint8))
        (frames / "frames.csv").write_text("t_us\n0\n")
        with pytest.raises(FrameError, match="but the sensor"):
            kalux.open(path, frames=frames)
        rectify_map.unlink()
        source = kalux.open(path, frames=frames).source
        assert source.sensor_size == (SIZE[0] + 1, SIZE[1])
        assert not any("sensor size" in sentence for sentence in source.missing)

    def test_a_folder_has_exposures(self, tmp_path):
        folder = write_dsec_folder(tmp_path / "interlaken_00_c", small_events(), small_frames(), SIZE)
        source = readers.read(folder)
        assert (source.sensor_size, source.exposure_known, source.missing) == (SIZE, True, ())
        assert np.array_equal(all_events(source), small_events())
        for ours, theirs in zip(source.frames(), small_frames(), strict=True):
            assert np.array_equal(ours.image, theirs.image)
            assert (ours.exposure_start, ours.exposure_end) == (theirs.exposure_start, theirs.exposure_end)

    def test_without_exposures_the_stamps_mark_the_middle(self, tmp_path):
        folder = write_dsec_folder(tmp_path / "s", small_events(), small_frames(), SIZE)
        (folder / "images/left/exposure_timestamps.txt").unlink()
        source = readers.read(folder)
        assert not source.exposure_known
        assert "mark the middle" in source.missing[0]
        assert [frame.exposure_start for frame in source.frames()] == [f.middle for f in small_frames()]
        (folder / "images/timestamps.txt").unlink()
        with pytest.raises(FormatError, match="neither"):
            readers.read(folder)

    def test_events_alone(self, tmp_path):
        write_dsec_events(tmp_path / "events/left/events.h5", small_events())
        source = readers.read(tmp_path)
        assert source.count_frames() == 0
        assert source.missing[0] == "There are no images."

    @pytest.mark.parametrize("place", ["/", "events"])
    def test_a_size_in_attributes(self, tmp_path, place):
        """As jAER writes it; the map that is published beside the events comes before."""
        path = write(tmp_path, "dsec")
        with h5py.File(path, "r+") as file:
            file[place].attrs["height"], file[place].attrs["width"] = np.int32(50), np.int32(60)
        assert readers.read(path).sensor_size == SIZE
        path.with_name("rectify_map.h5").unlink()
        source = readers.read(path)
        assert (source.sensor_size, source.sensor_size_known) == ((50, 60), True)
        assert source.missing == ("There are no images.",)
        with h5py.File(path, "r+") as file:
            file[place].attrs["width"] = 0
        with pytest.raises(FormatError, match="says that the sensor has 0 x 50 pixels"):
            readers.read(path)

    def test_images_in_colour(self, tmp_path):
        folder = write_dsec_folder(tmp_path / "s", small_events(), small_frames(), SIZE)
        colour = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8)
        cv2.imwrite(str(folder / "images/left/rectified/000000.png"), colour)
        frames = list(readers.read(folder).frames())
        assert np.array_equal(frames[0].image, colour[..., ::-1])
        assert {frame.image.shape for frame in frames} == {(*SIZE, 3)}

    def test_images_of_another_size_are_refused(self, tmp_path):
        folder = write_dsec_folder(tmp_path / "s", small_events(), small_frames(), (31, 40))
        with pytest.raises(FormatError, match="its images have 40x30 pixels, its events 40x31"):
            readers.read(folder)

    @pytest.mark.parametrize(
        ("text", "told"),
        [
            ("1, 2\n", "has 4 images, but 1 lines"),
            ("1, 2\n3\n", "line 2: '3' is not 'start, end'"),
            ("1, 2.5\n", "line 1"),
            (b"\xff\xff", "damaged"),
        ],
    )
    def test_exposures_that_cannot_be_read(self, tmp_path, text, told):
        folder = write_dsec_folder(tmp_path / "s", small_events(), small_frames(), SIZE)
        text = text if isinstance(text, bytes) else text.encode()
        (folder / "images/left/exposure_timestamps.txt").write_bytes(text)
        with pytest.raises(FormatError, match=told):
            readers.read(folder)


in_seconds = pytest.mark.parametrize(
    ("layout", "column"),
    [("hqf", "events/ts"), ("mvsec", "davis/left/events"), ("mvsec", "davis/left/image_raw_ts")],
)


def with_column(path, column, change):
    """The file, in which a column is replaced by what ``change`` makes of it."""
    with h5py.File(path, "r+") as file:
        values = change(file[column][...])
        del file[column]
        file[column] = values
    return path


@in_seconds
def test_seconds_since_1970_in_single_precision_are_refused(tmp_path, layout, column):
    """They are 128 s apart."""

    def later(values):
        times = values[:, 2] if column == "davis/left/events" else values
        times += 1.6e9
        return values.astype(np.float32)

    path = with_column(write(tmp_path, layout), column, later)
    with pytest.raises(
        FormatError, match=f"{path.name}: times are float32, of which two that differ are 128 s"
    ):
        all_events(readers.read(path))


@in_seconds
def test_whole_numbers_are_no_seconds(tmp_path, layout, column):
    """Microseconds, as other programs write them, would be a million times as long."""
    path = with_column(write(tmp_path, layout), column, lambda values: (values * 1e6).astype(np.int64))
    with pytest.raises(FormatError, match=f"{path.name}: its times are int64.* floating-point seconds"):
        readers.read(path)


def test_whole_numbers_are_no_seconds_of_an_image(tmp_path):
    path = write(tmp_path, "hqf")
    with h5py.File(path, "r+") as file:
        file["images/image000000001"].attrs["timestamp"] = 20_000
    with pytest.raises(FormatError, match=f"{path.name}: its times are int64.* floating-point seconds"):
        readers.read(path)


class TestHqf:
    @pytest.mark.parametrize("stated", [(30, 40), (40, 30)])
    def test_the_resolution_in_either_order(self, tmp_path, stated):
        path = write(tmp_path, "hqf", frames=[], size=stated)
        source = readers.read(path)
        assert (source.sensor_size, source.sensor_size_known, source.count_frames()) == (SIZE, True, 0)

    def test_without_any_size(self, tmp_path):
        path = write(tmp_path, "hqf", frames=[])
        with h5py.File(path, "r+") as file:
            del file.attrs["sensor_resolution"]
        assert not readers.read(path).sensor_size_known

    def test_boolean_polarity(self, tmp_path):
        path = write(tmp_path, "hqf")
        with h5py.File(path, "r+") as file:
            del file["events/ps"]
            file["events/ps"] = small_events()["p"]
        assert np.array_equal(all_events(readers.read(path)), small_events())

    @pytest.mark.parametrize(("value", "told"), [(0.5, "polarity"), (np.nan, "polarity")])
    def test_polarity_that_is_none(self, tmp_path, value, told):
        path = write(tmp_path, "hqf")
        with h5py.File(path, "r+") as file:
            file["events/ps"][7] = value
        with pytest.raises(FormatError, match=f"{told} of event 7"):
            all_events(readers.read(path))

    def test_times_that_are_none(self, tmp_path):
        path = write(tmp_path, "hqf")
        with h5py.File(path, "r+") as file:
            file["events/ts"][7] = np.nan
        with pytest.raises(FormatError, match="not finite"):
            all_events(readers.read(path))

    def test_images_in_colour_are_stored_as_bgr(self, tmp_path):
        """The packager of event_utils writes what cv_bridge gives as "bgr8"."""
        path = write(tmp_path, "hqf", frames=[])
        frames = colour_frames()
        with h5py.File(path, "r+") as file:
            for index, frame in enumerate(frames):
                image = file.create_dataset(f"images/image{index:09d}", data=frame.image[..., ::-1])
                image.attrs["timestamp"] = frame.exposure_start * 1e-6
                image.attrs["type"] = "color_bgr"
        source = readers.read(path)
        assert source.sensor_size == SIZE
        for found, frame in zip(source.frames(), frames, strict=True):
            assert np.array_equal(found.image, frame.image)


class TestMvsec:
    @pytest.mark.parametrize(
        "row", [(0.5, 1, 1, 1), (-1, 1, 1, 1), (1, 1, np.nan, 1), (1, 1, 1, 2), (1, 7e4, 1, 1)]
    )
    def test_rows_that_are_no_events_are_named(self, tmp_path, row):
        path = write(tmp_path, "mvsec")
        with h5py.File(path, "r+") as file:
            file["davis/left/events"][321] = row
        with pytest.raises(FormatError, match="event 321 is"):
            all_events(readers.read(path))

    def test_images_and_times_must_match(self, tmp_path):
        path = write(tmp_path, "mvsec")
        with h5py.File(path, "r+") as file:
            del file["davis/left/image_raw_ts"]
            file["davis/left/image_raw_ts"] = np.zeros(3)
        with pytest.raises(FormatError, match="4 images for 3 times"):
            readers.read(path)

    def test_without_images(self, tmp_path):
        path = write(tmp_path, "mvsec")
        with h5py.File(path, "r+") as file:
            del file["davis/left/image_raw"]
        source = readers.read(path)
        assert not source.sensor_size_known
        assert list(source.frames()) == []


class TestV2e:
    def test_events_alone(self, tmp_path):
        path = write(tmp_path, "v2e")
        with h5py.File(path, "r+") as file:
            for name in ("frame", "frame_ts", "frame_idx"):
                del file[name]
        source = readers.read(path)
        assert (source.count_frames(), source.sensor_size_known, list(source.frames())) == (0, False, [])
        assert np.array_equal(all_events(source), small_events())

    def test_polarity_that_is_none(self, tmp_path):
        path = write(tmp_path, "v2e")
        with h5py.File(path, "r+") as file:
            file["events"][321, 3] = 2
        with pytest.raises(FormatError, match="polarity of event 321"):
            all_events(readers.read(path))

    @pytest.mark.parametrize("times", [np.zeros(3, np.uint32), np.zeros(4)])
    def test_times_that_are_none(self, tmp_path, times):
        path = write(tmp_path, "v2e")
        with h5py.File(path, "r+") as file:
            del file["frame_ts"]
            file["frame_ts"] = times
        with pytest.raises(FormatError, match=r"4 images for 3 times|times of type float64; whole us"):
            readers.read(path)

    def test_another_table_is_not_taken_for_one(self, tmp_path):
        with h5py.File(tmp_path / "other.h5", "w") as file:
            file["events"] = np.zeros((5, 4))
        with pytest.raises(FormatError, match="not a recording that kalux knows"):
            readers.read(tmp_path / "other.h5")


class TestMetavision:
    def test_the_missing_codec_is_named(self, tmp_path):
        path = write(tmp_path, "metavision hdf5")
        with h5py.File(path, "r+") as file:
            rows = file["CD/events"][...]
            del file["CD/events"]
            plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            plist.set_chunk((100,))
            plist.set_filter(0x8ECF, h5py.h5z.FLAG_OPTIONAL)
            kind = h5py.h5t.py_create(rows.dtype)
            h5py.h5d.create(file["CD"].id, b"events", kind, h5py.h5s.create_simple((500,)), plist)
        with pytest.raises(FormatError, match=r"Prophesee's ECF.*install hdf5_ecf"):
            readers.read(path)

    def test_without_geometry(self, tmp_path):
        path = write(tmp_path, "metavision hdf5")
        with h5py.File(path, "r+") as file:
            del file.attrs["geometry"]
        assert not readers.read(path).sensor_size_known
        with h5py.File(path, "r+") as file:
            file.attrs["geometry"] = "large"
        with pytest.raises(FormatError, match="geometry is 'large'"):
            readers.read(path)

    def test_triggers_are_told(self, tmp_path):
        assert any(
            "3 external trigger" in text for text in readers.read(write(tmp_path, "metavision hdf5")).missing
        )


class TestPlain:
    """Columns, or a table, of events anywhere in a file."""

    def test_a_table(self, tmp_path):
        path = tmp_path / "a.h5"
        write_plain_table(path, small_events(), [], SIZE)
        source = readers.read(path)
        assert (source.format, source.sensor_size, source.sensor_size_known) == ("hdf5", SIZE, True)
        assert np.array_equal(all_events(source), small_events())
        assert source.missing == ("The file has no frames.",)
        assert kalux.open(path).source.count_events() == 500

    @pytest.mark.parametrize("group", ["/", "events", "a/b/c"])
    def test_columns_in_any_group(self, tmp_path, group):
        path = tmp_path / "a.h5"
        write_plain(path, small_events(), [], SIZE, group)
        with h5py.File(path, "r+") as file:
            for name, new in (("t", "timestamps"), ("p", "Polarity")):  # not as in DSEC's layout
                file[group].move(name, new)
        assert np.array_equal(all_events(readers.read(path)), small_events())

    def test_columns_too_deep_are_not_found(self, tmp_path):
        path = tmp_path / "a.h5"
        write_plain(path, small_events(), [], SIZE, "a/b/c/d")
        with pytest.raises(FormatError, match="not a recording that kalux knows"):
            readers.read(path)

    def test_the_unit_is_in_the_name_or_microseconds(self, tmp_path):
        for name, scale in (("t", 1), ("t_ns", 1000), ("t_s", 1e-6)):
            path = tmp_path / f"{name}.h5"
            write_plain(path, small_events(), [], SIZE)
            with h5py.File(path, "r+") as file:
                del file["prophesee/left/t"]
                file[f"prophesee/left/{name}"] = small_events()["t"] * scale
            source = readers.read(path)
            assert np.array_equal(all_events(source), small_events())
            assert any("taken as microseconds" in text for text in source.missing) == (name == "t")

    def test_seconds_without_a_unit_are_refused(self, tmp_path):
        path = write(tmp_path, "hdf5")
        with h5py.File(path, "r+") as file:
            del file["prophesee/left/t"]
            file["prophesee/left/t"] = small_events()["t"] * 1e-6
        with pytest.raises(FormatError, match=r"unit cannot be known; name the unit in the column"):
            all_events(readers.read(path))

    def test_the_size_is_stated_or_the_smallest(self, tmp_path):
        """Beside the columns, as in M3ED, or in attributes, whichever of the sides comes first."""
        path = write(tmp_path, "hdf5")
        with h5py.File(path, "r+") as file:
            del file["prophesee/left"].attrs["height"]
        events = small_events()
        source = readers.read(path)
        assert source.sensor_size == (events["y"].max() + 1, events["x"].max() + 1)
        assert not source.sensor_size_known
        assert any("size is not recorded" in text for text in source.missing)
        with h5py.File(path, "r+") as file:
            file["prophesee/left/calib/resolution"] = [60, 50]
        assert readers.read(path).sensor_size == (50, 60)
        with h5py.File(path, "r+") as file:
            file.attrs["sensor_resolution"] = [70, 80]
        assert readers.read(path).sensor_size == (70, 80)
        with h5py.File(path, "r+") as file:
            file.attrs["sensor_resolution"] = [0, 80]
        with pytest.raises(FormatError, match="80 x 0 pixels"):
            readers.read(path)

    def test_an_offset_of_the_times_is_added(self, tmp_path):
        path = write(tmp_path, "hdf5")
        with h5py.File(path, "r+") as file:
            file["t_offset"] = np.int64(7_000)
        assert np.array_equal(all_events(readers.read(path))["t"], small_events()["t"] + 7_000)
        with h5py.File(path, "r+") as file:
            file["t_offset"][...] = 1 << 61
        with pytest.raises(FormatError, match="t_offset is 2305843009213693952"):
            readers.read(path)

    def test_of_two_cameras_the_left_one_is_read(self, tmp_path):
        path = write(tmp_path, "hdf5")
        with h5py.File(path, "r+") as file:
            file.copy("prophesee/left", "prophesee/right")
            file["prophesee/right/x"][...] = 0
        source = readers.read(path)
        assert np.array_equal(all_events(source), small_events())
        assert any(
            "others are prophesee/right ('m3ed_data.h5?events=NAME')" in text for text in source.missing
        )
        assert not all_events(readers.read(f"{path}?events=prophesee/right"))["x"].any()
        with pytest.raises(
            InputError, match="no events in 'middle'; they are in prophesee/left, prophesee/right"
        ):
            readers.read(f"{path}?events=middle")
        with pytest.raises(InputError, match="after '\\?' goes events=NAME"):
            readers.read(f"{path}?frames=")
        with h5py.File(path, "r+") as file:
            file.move("prophesee", "evk")
            file.move("evk/left", "evk/first")
        with pytest.raises(InputError, match="has events in evk/first, evk/right; choose with"):
            readers.read(path)

    def test_frames_that_are_not_read_are_named(self, tmp_path):
        path = write(tmp_path, "hdf5")
        with h5py.File(path, "r+") as file:
            file["ovc/left/data"] = np.zeros((2, 3, 4, 1), np.uint8)
        assert "ovc/left/data (2, 3, 4, 1)" in readers.read(path).missing[0]

    def test_columns_of_different_lengths_or_of_objects_are_refused(self, tmp_path):
        path = write(tmp_path, "hdf5")
        with h5py.File(path, "r+") as file:
            del file["prophesee/left/x"]
            file["prophesee/left/x"] = np.zeros(499, np.uint16)
        with pytest.raises(FormatError, match="different lengths"):
            readers.read(path)
        with h5py.File(path, "r+") as file:
            del file["prophesee/left/x"]
            file["prophesee/left/x"] = ["a"] * 500
        with pytest.raises(FormatError, match="prophesee/left/x holds objects"):
            readers.read(path)

    def test_what_a_file_without_events_holds_is_said(self, tmp_path):
        path = tmp_path / "rec.hdf5"
        with h5py.File(path, "w") as file:
            file["dvs/data"] = np.zeros((3, 1))
            file["dvs/timestamp"] = np.zeros(3)
            file["nowhere"] = h5py.SoftLink("/none")
        with pytest.raises(
            FormatError,
            match=r"an HDF5 file, but .* holds dvs/data \(3, 1\), dvs/timestamp \(3,\); columns t",
        ):
            readers.read(path)

    def test_only_so_many_groups_are_looked_at(self, tmp_path):
        """A file may lead round in circles."""
        path = tmp_path / "a.h5"
        with h5py.File(path, "w") as file:
            for name in range(60):
                file[f"g{name}"] = h5py.SoftLink("/")
            file["x"] = np.zeros(3)
        begin = time.monotonic()
        with pytest.raises(FormatError, match="not a recording that kalux knows"):
            readers.read(path)
        assert time.monotonic() - begin < 10


def test_a_real_payload(shared_data, tmp_path, layout):
    """Real payload, our writer; from time 0, since v2e has 32 bits for it."""
    source = readers.read(shared_data / "street_davis346.aedat4")
    events, frames = all_events(source), list(source.frames())
    begin = min(int(events["t"][0]), frames[0].exposure_start)
    events["t"] -= begin
    frames = [Frame(f.image, f.exposure_start - begin, f.exposure_end - begin) for f in frames]
    read = readers.read(write(tmp_path, layout, events, frames, source.sensor_size))
    assert read.sensor_size == source.sensor_size
    assert np.array_equal(all_events(read), events)
    assert_stamped(read.frames(), frames if LAYOUTS[layout].has_frames else [])
