"""Recordings in memory and from files: streams that can be iterated twice, checks, exposures given by the user."""

from __future__ import annotations

import copy
import dataclasses
import gzip
import os
import pickle

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux import readers, recording
from kalux.errors import EventError, ExposureError, FormatError, FrameError, InputError
from kalux.event_slices import in_order, whole_row_delays, with_delay_of_rows
from kalux.events import make_events
from kalux.frames import Frame, GroundTruth, with_black_level
from kalux.readers.source import SeekableEvents
from kalux.recording import (
    EventLayout,
    FrameCorrections,
    Recording,
    less_black,
    with_cached_start,
    with_counted_events,
    with_event_layout,
    with_frames,
    with_rows_at_once,
    with_white_from,
    without_events_of,
)
from kalux.writers import hdf5
from recordings import SIZE, same_frames, small_events, small_frames


def in_memory(**changes):
    return Recording.from_arrays(
        **({"events": small_events(), "frames": small_frames(), "sensor_size": SIZE} | changes)
    )


@pytest.fixture
def stamped(tmp_path):
    """A file whose frames have stamps only."""
    path = tmp_path / "stamped.h5"
    frames = [
        Frame(frame.image, frame.exposure_start + 5_000, frame.exposure_start + 5_000)
        for frame in small_frames()
    ]
    hdf5.write(path, sensor_size=SIZE, events=[small_events()], frames=frames, exposure_known=False)
    return path


def write_listed(folder):
    """A folder of one image with its exposure."""
    cv2.imwrite(str(folder / "000.png"), np.zeros(SIZE, np.uint8))
    (folder / "frames.csv").write_text("t_us,exposure_us\n0,5\n")
    return folder


def test_streams_can_be_iterated_again():
    rec = in_memory()
    for _ in range(2):
        assert np.array_equal(np.concatenate(list(rec.events())), small_events())
        assert same_frames(rec.frames(), small_frames())
    assert (len(rec.events()), len(rec.frames())) == (500, 4)


def test_an_opened_recording_is_opened_again_where_it_is_unpickled(stamped, tmp_path, monkeypatch):
    """With what was given and what is known of it, wherever the other process runs."""
    monkeypatch.chdir(stamped.parent)
    opened = recording.open(stamped.name, exposure=3_000, stamp="middle")
    frames, sent = list(opened.frames()), pickle.dumps(less_black(opened, 0.1))
    monkeypatch.chdir("/")
    rec = pickle.loads(sent)
    assert rec.black_level == 0.1
    assert same_frames(rec.frames(), [with_black_level(frame, 0.1) for frame in frames])
    assert np.array_equal(np.concatenate([*rec.events()]), small_events())
    assert pickle.loads(pickle.dumps(rec)).black_level == 0.1
    joined = recording.open(stamped, frames=write_listed(tmp_path), replace_frames=True)
    assert same_frames(pickle.loads(pickle.dumps(joined)).frames(), joined.frames())


def test_a_recording_that_is_not_as_a_file_says_is_not_pickled(stamped):
    """It would be another one on the other side; copied it can be."""
    opened = recording.open(stamped, exposure=3_000)
    for rec in (
        in_memory(),
        without_events_of(opened, np.zeros(SIZE, bool)),
        with_cached_start(opened, 9, 9),
    ):
        with pytest.raises(InputError, match="only a recording as kalux"):
            pickle.dumps(rec)
        for copied in (copy.copy(rec), copy.deepcopy(rec)):
            assert same_frames(copied.frames(), rec.frames())


def test_chunks_are_bounded(monkeypatch):
    monkeypatch.setattr(recording, "CHUNK_EVENTS", 64)
    assert [len(chunk) for chunk in in_memory().events()] == [64] * 7 + [52]


def test_what_is_given_is_kept():
    reference = GroundTruth(np.array([1]), np.ones((1, *SIZE), np.float32))
    rec = in_memory(contrast_threshold=0.2, ground_truth=reference, inverse_covariance=np.ones(256))
    assert rec.contrast_threshold == (0.2, 0.2)
    assert rec.ground_truth() is reference
    assert in_memory(contrast_threshold=(0.1, 0.2)).contrast_threshold == (0.1, 0.2)
    assert in_memory().contrast_threshold is None
    assert in_memory().ground_truth() is None


def test_a_bad_recording_is_refused_at_once():
    with pytest.raises(EventError, match="outside the sensor"):
        in_memory(sensor_size=(10, 10), frames=[])
    with pytest.raises(EventError, match="comes after"):
        in_memory(events=small_events()[::-1])
    with pytest.raises(FrameError, match="time order"):
        in_memory(frames=small_frames()[::-1])
    with pytest.raises(
        FrameError, match=r"frame 0 is a ndarray; a kalux\.Frame with a NumPy array is needed"
    ):
        in_memory(frames=[np.zeros(SIZE, np.uint8)])


@pytest.mark.parametrize("threshold", [-0.2, float("nan"), (0.2, 0.0), "0.2 log", (0.1, 0.2, 0.3)])
def test_thresholds_that_are_none_are_refused(threshold):
    with pytest.raises(InputError, match=r"contrast threshold is .*must be positive"):
        in_memory(contrast_threshold=threshold)


def test_thresholds_of_numpy():
    assert in_memory(contrast_threshold=np.float64(0.2)).contrast_threshold == (0.2, 0.2)
    assert in_memory(contrast_threshold=np.array([0.1, 0.2])).contrast_threshold == (0.1, 0.2)


@pytest.mark.parametrize("t", [-(2**63), 2**62])
def test_times_that_nothing_could_be_added_to_are_refused(t):
    events = small_events()
    events["t"][0 if t < 0 else -1] = t
    with pytest.raises(EventError, match=r"event (0|499) is at .* us; at most 10\^18 us is possible"):
        in_memory(events=events)


def test_frames_in_memory_with_one_stamp_each():
    stamps = [Frame(frame.image, frame.exposure_start, frame.exposure_start) for frame in small_frames()]
    with pytest.raises(ExposureError, match="exposure="):
        in_memory(frames=stamps)
    rec = in_memory(frames=stamps, exposure=1_000, stamp="middle")
    starts = [frame.exposure_start for frame in rec.frames()]
    assert starts == [frame.exposure_start - 500 for frame in small_frames()]
    assert {frame.exposure for frame in rec.frames()} == {1_000}


def test_a_white_value_that_can_hardly_be_right_is_warned_of():
    dark = [dataclasses.replace(f, image=f.image.astype(np.uint16) * 2) for f in small_frames()]
    with pytest.warns(UserWarning, match=r"arrays: no pixel .*white=1023"):
        in_memory(frames=dark)


def test_a_last_exposure_that_can_hardly_be_right_is_warned_of():
    *others, last = small_frames()
    damaged = dataclasses.replace(last, exposure_end=last.exposure_end + 10**6)
    with pytest.warns(UserWarning, match="arrays: the last frame is exposed for .* is the end .* right"):
        in_memory(frames=[*others, damaged])


@pytest.mark.parametrize(
    ("start", "told"), [(0, []), (1_850, ["only 3 of the 40"]), (9_999, ["none of the 40"])]
)
def test_clocks_that_can_hardly_be_the_same_are_warned_of(recwarn, start, told):
    """Times of events in a notebook often begin at 0, those of frames with the time of day."""
    frames = [Frame(np.zeros((4, 5), np.uint8), t, t + 50) for t in range(0, 2_000, 100)]
    events = {"t": start + 50 * np.arange(40), "x": [0] * 40, "y": [0] * 40, "p": [True] * 40}
    Recording.from_arrays(events, frames, sensor_size=(4, 5))
    assert [str(warning.message).split(" events")[0] for warning in recwarn] == [
        f"arrays: {text}" for text in told
    ]


@pytest.mark.parametrize("mosaics", [("RGGB", "BGGR"), (None, "RGGB"), ("RGGB", None)])
def test_arrays_of_frames_are_of_one_mosaic(mosaics):
    """The first one's would make other colours of the others."""
    frames = [
        Frame(np.zeros((4, 6), np.uint8), 100 * k, 100 * k + 50, mosaic=mosaic)
        for k, mosaic in enumerate(mosaics)
    ]
    with pytest.raises(FrameError, match=r"frame 1 is .* all must be alike"):
        Recording.from_arrays(small_events()[:0], frames, sensor_size=(4, 6))


def test_what_is_not_valid_is_no_bound_in_an_empty_frame_before_it():
    """An empty first frame shows what the next one clips, if that measures it."""
    image, valid = np.full((2, 2), 255, np.uint8), np.array([[True, False], [True, True]])
    image[1, 1] = 100
    empty = Frame(np.zeros((2, 2), np.uint8), 0, 50)
    frames = [empty, Frame(image, 100, 150, valid=valid)]
    corrected = recording._corrected(iter(frames), FrameCorrections(empty=1), 1)
    np.testing.assert_array_equal(next(corrected).valid, [[True, False], [True, False]])


def test_white_is_found_where_frames_of_16_bits_end(recwarn):
    """All frames get it, also those before the one that shows it, and copies; no warning is needed."""
    frames = [
        Frame(np.full((3, 4), level, np.uint16), 100 * k, 100 * k + 50) for k, level in enumerate((9, 4095))
    ]
    recording = Recording.from_arrays(small_events()[:0], frames, sensor_size=(3, 4))
    assert recording.found_white == 4095
    assert [frame.white for frame in recording.frames()] == [4095, 4095]
    assert [frame.white for frame in recording.stored_frames()] == [4095, 4095]
    assert not recwarn
    given = Recording(recording.source, white=60000)
    assert (given.found_white, {frame.white for frame in given.frames()}) == (None, {60000})


def test_a_recording_says_what_it_is():
    assert repr(in_memory()) == f"<kalux.Recording 'arrays': arrays, {SIZE[1]} x {SIZE[0]} pixels>"


def test_order_is_checked_across_chunks(tmp_path):
    path = tmp_path / "unsorted.h5"
    events = small_events()
    hdf5.write(path, sensor_size=SIZE, events=[events[250:], events[:250]], frames=[])
    with pytest.raises(EventError, match="event 250 at"):
        list(recording.open(path).events())


def test_unknown_exposures_must_be_given(stamped):
    rec = recording.open(stamped)
    assert not rec.exposure_known
    with pytest.raises(ExposureError, match="--exposure 10000"):
        rec.frames()
    assert [frame.exposure for frame in rec.stamped_frames()] == [0] * 4


@pytest.mark.parametrize(("stamp", "start"), [("start", 5_000), ("middle", 4_500), ("end", 4_000)])
def test_exposures_given(stamped, stamp, start):
    rec = recording.open(stamped, exposure=1_000, stamp=stamp)
    assert rec.exposure_known
    assert [frame.exposure_start for frame in rec.frames()] == [start + 20_000 * i for i in range(4)]
    assert {frame.exposure for frame in rec.frames()} == {1_000}


@pytest.mark.parametrize("kind", [np.int32, np.uint16, np.uint64, np.float32])
def test_an_exposure_of_any_type_is_given(stamped, kind):
    """Times since 1970 are beyond `numpy.int32`; the other types have no negative numbers, or are not exact."""
    epoch = 1_600_000_000_000_000
    frames = [Frame(f.image, epoch + f.exposure_start, epoch + f.exposure_start) for f in small_frames()]
    source = dataclasses.replace(readers.read(stamped), frames=lambda: iter(frames))
    placed = list(Recording(source, exposure=kind(1_001), stamp="middle").frames())
    assert [f.exposure_start for f in placed] == [f.exposure_start - 500 for f in frames]
    assert [type(f.exposure) for f in placed] == [int] * 4
    assert {f.exposure for f in placed} == {1_001}


def test_impossible_exposures_are_refused(stamped):
    for exposure in (0, 0.5, np.nan, np.inf, "10 ms"):
        with pytest.raises(ExposureError, match="must be positive and whole"):
            recording.open(stamped, exposure=exposure)
    with pytest.raises(InputError, match="stamp is 'centre'"):
        recording.open(stamped, exposure=10, stamp="centre")
    with pytest.raises(ExposureError, match="is the exposure time too long"):
        list(recording.open(stamped, exposure=30_000).frames())


def test_open_refuses_what_it_does_not_know(tmp_path):
    with pytest.raises(InputError, match="no such file or folder"):
        recording.open(tmp_path / "absent.aedat4")
    (tmp_path / "notes.txt").write_text("events")
    for path in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises(FormatError, match="not a recording that kalux knows"):
            recording.open(path)


def test_a_white_value_that_is_given_is_that_of_all_frames(tmp_path):
    deep = [Frame(np.full(SIZE, 2048, np.uint16), t, t + 10) for t in (0, 20)]
    path = tmp_path / "deep.h5"
    hdf5.write(path, sensor_size=SIZE, events=[], frames=deep)
    assert [f.white_value for f in recording.open(path).frames()] == [65535, 65535]
    assert [f.normalised().max() for f in recording.open(path, white=4096).frames()] == [0.5, 0.5]
    for white in (0, -1, np.nan):
        with pytest.raises(InputError, match="the value of a saturated pixel is needed"):
            recording.open(path, white=white)


@pytest.mark.parametrize("size", [(0, 5), (-3, 5), (4.5, 5), 5, (1, 2, 3), "ab"])
def test_impossible_sensor_sizes_are_refused(size):
    with pytest.raises(InputError, match=r"sensor_size is .*; \(height, width\) in pixels is needed"):
        recording.Recording.from_arrays([], [], sensor_size=size)


def small_file(path):
    hdf5.write(path, sensor_size=SIZE, events=[small_events()], frames=[])


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda path: path.touch(), "an empty file, not a recording"),
        (lambda path: path.mkdir(), "an empty folder, not a recording"),
        (
            lambda path: (path.mkdir(), (path / "images.txt").touch()),
            r"frames \(images.txt\) without their events",
        ),
        (os.mkfifo, "a pipe or a device, of which nothing can be read twice"),
        (lambda path: (path.mkdir(), (path / "0.png").touch()), "a folder of images, which --frames takes"),
        (lambda path: (path.mkdir(), small_file(path / "a.h5")), r"a folder of recordings \(a\.h5\)"),
        (
            lambda path: path.write_text("version https://git-lfs.github.com/spec/v1\n"),
            "a pointer of Git LFS",
        ),
        (
            lambda path: path.write_text("\n<!DOCTYPE html>\n<html></html>"),
            "a web page, perhaps what a download",
        ),
        (
            lambda path: path.write_bytes(gzip.compress(b"0 1 2 1")),
            "compressed by gzip, which has to be unpacked",
        ),
    ],
)
def test_what_is_no_recording_is_named(tmp_path, make, told):
    make(tmp_path / "it")
    with pytest.raises(FormatError, match=told):
        recording.open(tmp_path / "it")


def test_a_name_that_is_too_long_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="File name too long"):
        recording.open(tmp_path / ("a" * 300))


def test_empty_files_are_refused(tmp_path):
    for suffix in (".aedat4", ".mat", ".h5", ".zip"):
        path = tmp_path / f"empty{suffix}"
        path.touch()
        with pytest.raises(FormatError, match="not a recording that kalux knows"):
            recording.open(path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_an_unreadable_file_is_an_input_error(stamped):
    stamped.chmod(0)
    with pytest.raises(InputError, match="Permission denied"):
        recording.open(stamped)


@pytest.mark.parametrize(
    "name",
    ["slider_depth", "street_davis346.aedat4", "newton_davis346.aedat4", "hdr_pan/Oxford_Church_clean.mat"],
)
def test_real_recordings_pass_every_check(shared_data, name):
    rec = recording.open(shared_data / name)
    assert sum(len(chunk) for chunk in rec.events()) == len(rec.events())
    assert sum(1 for _ in rec.stamped_frames()) == len(rec.stamped_frames())


@pytest.mark.parametrize(
    "name", ["hdr/Oxford_Church.hdr", "weights/firenet.pth", "exposures/stack_room_exp_0.jpg"]
)
def test_real_files_that_are_no_recordings_are_refused(shared_data, name):
    with pytest.raises(FormatError, match="not a recording that kalux knows"):
        recording.open(shared_data / name)


@pytest.mark.parametrize("size", [(0, 4), (4, 70_000), (10**20, 4)])
def test_a_sensor_that_no_event_could_address_is_refused(tmp_path, size):
    path = tmp_path / "events.npz"
    columns = {name: np.zeros(1, int) for name in "txyp"}
    np.savez(path, **columns, height=np.array(4), width=np.array(5))
    source = dataclasses.replace(readers.read(path), sensor_size=size)
    with pytest.raises(FormatError, match="states a sensor of"):
        recording.Recording(source)


def counted(made):
    """A recording in ten chunks that adds to ``made`` whatever is read of it."""
    events, frames = np.array_split(small_events(), 10), small_frames()

    def parts(name, items):
        for item in items:
            made.append(name)
            yield item

    source = dataclasses.replace(
        in_memory().source, events=lambda: parts("chunk", events), frames=lambda: parts("frame", frames)
    )
    return Recording(source)


@pytest.mark.parametrize("events", [0, len(small_events()) // 3, len(small_events())])
def test_a_recording_with_a_cached_start_is_the_same(events):
    cached = with_cached_start(counted([]), events, small_frames()[0].image.nbytes)
    next(iter(cached.events()))
    for _ in range(2):
        assert np.array_equal(np.concatenate(list(cached.events())), small_events())
        assert same_frames(list(cached.frames()), small_frames())


def test_what_is_cached_is_read_once():
    made = []
    cached = with_cached_start(counted(made), len(small_events()), 1 << 20)
    for _ in range(3):
        list(cached.events())
        list(cached.frames())
    assert (made.count("chunk"), made.count("frame")) == (10, len(small_frames()))


def test_the_longest_exposure_is_known_once_all_frames_are_read():
    made = []
    rec = counted(made)
    for _ in range(2):
        assert rec.longest_exposure == max(frame.exposure for frame in small_frames())
    assert len(made) == len(small_frames())


def test_a_ground_truth_that_is_none():
    truth = (np.zeros(1, np.int64), np.zeros((1, 4, 5), np.float32))
    with pytest.raises(
        InputError, match=r"ground_truth is a tuple; a kalux\.frames\.GroundTruth is needed, from"
    ):
        recording.Recording.from_arrays([], [], sensor_size=(4, 5), ground_truth=truth)


def test_events_of_single_pixels_can_be_left_out():
    whole = Recording.from_arrays(small_events(), [], sensor_size=SIZE)
    first = np.concatenate(list(whole.events()))
    left_out = np.zeros(whole.sensor_size, np.bool_)
    left_out[first["y"][0], first["x"][0]] = True
    rest = np.concatenate(list(without_events_of(whole, left_out).events()))
    assert 0 < len(rest) < len(first)
    assert not left_out[rest["y"], rest["x"]].any()
    assert len(np.concatenate(list(whole.events()))) == len(first)


def test_a_recording_whose_events_are_seekable_stays_so():
    """Whatever is left out, cached, counted or put right: only events in the time of rows are read from the first."""
    rec = in_memory()
    none = np.zeros(SIZE, np.bool_)
    told: list[int] = []
    made = [
        rec,
        with_cached_start(rec, 10, 10),
        without_events_of(rec, none),
        with_counted_events(rec, told.append),
        with_event_layout(rec, EventLayout(mirrored_x=True)),
        with_frames(rec, rec.frames),
        less_black(rec, 0.1),
    ]
    whole = small_events()
    for each in made:
        assert each.is_seekable
        since = np.concatenate([*each.events_since(70_000)])
        assert np.array_equal(since["t"], whole["t"][whole["t"] >= 70_000])
    assert sum(told) == len(since)
    late = with_rows_at_once(rec, 10.0)
    assert not late.is_seekable
    assert [*late.events_since(70_000)][-1]["t"][-1] == [*late.events()][-1]["t"][-1]


def test_a_wrong_event_that_is_read_later_is_told_by_its_index():
    events = small_events()
    events["x"][400] = SIZE[1]
    source = in_memory().source
    chunks = np.array_split(events, 10)
    later = SeekableEvents(lambda: iter(chunks), lambda t: (chunk for chunk in chunks if chunk["t"][-1] >= t))
    rec = Recording(dataclasses.replace(source, events=later))
    assert len(next(rec.events_since(0))) == 50
    with pytest.raises(EventError, match="event 400 "):
        list(rec.events_since(int(events["t"][300])))


def test_events_are_counted_as_often_as_they_are_read():
    told: list[int] = []
    rec = Recording.from_arrays(small_events(), small_frames(), sensor_size=SIZE)
    watched = with_counted_events(rec, told.append)
    assert not told
    for times in (1, 2):
        for chunk, expected in zip(watched.events(), rec.events(), strict=True):
            assert np.array_equal(chunk, expected)
        assert sum(told) == times * len(small_events())


@given(st.lists(st.integers(0, 400), max_size=5))
def test_events_in_the_time_of_rows_are_in_order_however_they_are_cut(cuts):
    rng = np.random.default_rng(2)
    t = np.sort(rng.integers(0, 5_000, 400))
    events = make_events(t, rng.integers(0, 4, 400), rng.integers(0, 8, 400), rng.integers(0, 2, 400) > 0)
    whole = Recording.from_arrays(events, [], sensor_size=(8, 4))
    parts = Recording.from_arrays(events, [], sensor_size=(8, 4))
    parts.source = dataclasses.replace(
        parts.source, events=lambda: (part for part in np.split(events, sorted(cuts)) if len(part))
    )
    found, same = (np.concatenate([*with_rows_at_once(r, 300.0).events()]) for r in (whole, parts))
    np.testing.assert_array_equal(found, same)
    np.testing.assert_array_equal(found, in_order(with_delay_of_rows(events, whole_row_delays(8, 300.0))))


@pytest.mark.parametrize(
    ("black", "dtype", "white"), [(None, np.uint8, 255), (0.2, np.uint8, 255), (None, np.uint16, 65535)]
)
def test_pixels_are_white_from_a_level_on(black, dtype, white):
    levels = np.array([[0.5, 0.85, 0.89], [0.91, 0.95, 1.0]])
    stored = np.rint(((black or 0.0) + levels * (1.0 - (black or 0.0))) * white).astype(dtype)
    source = less_black(
        Recording.from_arrays(small_events()[:0], [Frame(stored, 0, 10)], sensor_size=(2, 3)), black
    )
    (frame,) = with_white_from(source, 0.9).frames()
    assert frame.image.dtype == dtype
    assert frame.image[0].tolist() == stored[0].tolist()
    assert frame.image[1].tolist() == [white] * 3
