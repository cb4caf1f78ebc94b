"""kalux's own HDF5: everything comes back, damage is told."""

from __future__ import annotations

import dataclasses

import h5py
import numpy as np
import pytest

from kalux import readers
from kalux.errors import FormatError
from kalux.frames import Frame, GroundTruth
from kalux.readers import hdf5
from kalux.writers import hdf5 as writer
from recordings import (
    REFERENCE,
    SIZE,
    all_events,
    assert_only_clear_errors,
    check_seeking,
    colour_frames,
    damaged,
    same_frames,
    small_events,
    small_frames,
    write_kalux,
)

MASK = np.random.default_rng(1).random(SIZE) < 0.5


@pytest.fixture
def path(tmp_path):
    return tmp_path / "recording.h5"


def test_round_trip(path):
    write_kalux(path)
    source = readers.read(path)
    assert (source.format, source.sensor_size, source.missing) == ("kalux", SIZE, ())
    assert (source.count_events(), source.count_frames()) == (500, 4)
    assert source.exposure_known
    assert source.contrast_threshold == (0.1, 0.2)
    assert np.array_equal(source.inverse_covariance, np.linspace(1, 2, 256))
    reference = source.ground_truth()
    assert np.array_equal(reference.times, REFERENCE.times)
    assert np.array_equal(reference.images, REFERENCE.images)
    for _ in range(2):
        assert np.array_equal(all_events(source), small_events())
        assert same_frames(source.frames(), small_frames())


@pytest.mark.parametrize("distinct", [1, 40, 1 << 20])
def test_later_events_are_read_without_those_before(path, distinct):
    """Also where chunks of the file begin and end with events of the same time."""
    events = np.tile(small_events(1), 5 * writer._EVENTS_PER_CHUNK + 7)
    events["t"] = np.linspace(0, distinct, len(events)).astype(np.int64)
    write_kalux(path, events=[events])
    check_seeking(
        readers.read(path), [-5, 0, distinct // 3, distinct // 2, distinct - 1, distinct, distinct + 1]
    )


def test_a_file_without_events_has_none_later_either(path):
    write_kalux(path, events=[])
    assert [*readers.read(path).events.since(5)] == []


def test_a_copy_of_a_copy_is_the_same(path, tmp_path):
    write_kalux(path)
    source = readers.read(path)
    copy = tmp_path / "copy.h5"
    write_kalux(copy, events=source.events(), frames=source.frames(), ground_truth=source.ground_truth())
    assert np.array_equal(all_events(readers.read(copy)), small_events())
    assert same_frames(readers.read(copy).frames(), small_frames())


@pytest.mark.parametrize(
    ("dtype", "white"), [(np.uint8, None), (np.uint16, 1023), (np.float32, None), (np.float64, 4.0)]
)
def test_frames_keep_type_and_white(path, dtype, white):
    frames = [
        Frame(frame.image.astype(dtype), 10 * i, 10 * i + 5, white) for i, frame in enumerate(small_frames())
    ]
    write_kalux(path, frames=frames)
    assert same_frames(readers.read(path).frames(), frames)


def test_frames_keep_where_black_is(path):
    frames = [dataclasses.replace(frame, black=16.5) for frame in small_frames()]
    write_kalux(path, frames=frames)
    assert [frame.black for frame in readers.read(path).frames()] == [16.5] * len(frames)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_frames_in_rgb(path, dtype):
    frames = colour_frames(dtype=dtype)
    write_kalux(path, frames=frames)
    source = readers.read(path)
    assert same_frames(source.frames(), frames)
    assert source.mosaic is None


def test_a_mosaic_is_that_of_the_frames_or_as_given(path):
    frames = [dataclasses.replace(frame, mosaic="GRBG") for frame in small_frames()]
    write_kalux(path, frames=frames)
    assert readers.read(path).mosaic == "GRBG"
    write_kalux(path, frames=colour_frames(), mosaic="BGGR")  # RGB that was made of it
    assert readers.read(path).mosaic == "BGGR"


def test_an_unknown_mosaic_is_refused(path):
    write_kalux(path, frames=small_frames(), mosaic="RGGB")
    with h5py.File(path, "r+") as file:
        file["frames"].attrs["mosaic"] = np.bytes_("RGBG")
    with pytest.raises(FormatError, match="states the mosaic 'RGBG'"):
        readers.read(path)


def test_nothing_but_a_sensor(path):
    writer.write(path, sensor_size=SIZE, events=[], frames=[])
    source = readers.read(path)
    assert (source.sensor_size, source.count_events(), source.count_frames()) == (SIZE, 0, 0)
    assert list(source.events()) == list(source.frames()) == []
    assert source.contrast_threshold is source.inverse_covariance is source.ground_truth is None
    assert len(source.missing) == 2


def test_unknown_exposures(path):
    frames = [Frame(frame.image, frame.middle, frame.middle) for frame in small_frames()]
    write_kalux(path, frames=frames, exposure_known=False)
    source = readers.read(path)
    assert not source.exposure_known
    assert "exposure times" in source.missing[0]
    assert same_frames(source.frames(), frames)


def test_a_newer_layout_is_refused(path):
    write_kalux(path)
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = np.bytes_("1.7")
    assert readers.read(path).count_events() == 500
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = np.bytes_("2.0")
    with pytest.raises(FormatError, match=r"version 2\.0 .* update kalux"):
        readers.read(path)


def test_columns_must_be_equally_long(path):
    write_kalux(path)
    with h5py.File(path, "r+") as file:
        file["events/x"].resize((499,))
    with pytest.raises(FormatError, match="x 499"):
        readers.read(path)


def test_other_hdf5_files_are_not_recognised(path):
    with h5py.File(path, "w") as file:
        file["events/t"] = np.arange(5)
    assert not hdf5.recognises(path)
    with pytest.raises(FormatError, match="not a recording that kalux knows"):
        readers.read(path)


def test_a_file_cut_short_is_refused(path):
    write_kalux(path)
    data = path.read_bytes()
    for share in (0.01, 0.3, 0.6, 0.9, 0.999):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(FormatError, match=str(path)):
            readers.read(path)


def test_damage_gives_clear_errors(path):
    write_kalux(path)
    assert_only_clear_errors(path, damaged(path.read_bytes(), 300))


def test_damage_of_colours_gives_clear_errors(path, tmp_path):
    write_kalux(path, frames=colour_frames(), mosaic="RGGB")
    assert_only_clear_errors(tmp_path / "damaged.h5", damaged(path.read_bytes(), 60))


def test_a_real_recording_comes_back(shared_data, path):
    source = readers.read(shared_data / "newton_davis346.aedat4")
    writer.write(path, sensor_size=source.sensor_size, events=source.events(), frames=source.frames())
    copy = readers.read(path)
    assert copy.count_events() == 319_512
    assert np.array_equal(all_events(copy), all_events(source))
    assert same_frames(copy.frames(), source.frames())


def test_masks_of_the_truth_and_the_response(tmp_path):
    rng = np.random.default_rng(0)
    images = rng.random((2, *SIZE)).astype(np.float32)
    truth = GroundTruth(np.array([5, 9]), images, images > 0.5, (0.01, 0.002))
    writer.write(
        tmp_path / "a.h5",
        sensor_size=SIZE,
        events=[small_events()],
        frames=small_frames(),
        ground_truth=truth,
        response="gamma:2.2",
    )
    found = hdf5.read(tmp_path / "a.h5")
    assert found.response == "gamma:2.2"
    assert np.array_equal(found.ground_truth().masks, truth.masks)
    assert found.ground_truth().noise == (0.01, 0.002)


@pytest.mark.parametrize("masked", [(0, 1, 2, 3), (0,), (2,), (3,), ()])
def test_masks_of_valid_pixels_come_back(path, masked):
    """Where one frame has a mask, all have one; those without are valid everywhere."""
    frames = [
        dataclasses.replace(frame, valid=MASK if i in masked else None)
        for i, frame in enumerate(small_frames())
    ]
    write_kalux(path, frames=frames)
    back = list(readers.read(path).frames())
    assert same_frames(frames, back)
    for i, frame in enumerate(back):
        if not masked:
            assert frame.valid is None
        else:
            assert frame.valid.dtype == bool
            np.testing.assert_array_equal(frame.valid, MASK if i in masked else np.ones(SIZE, bool))


def test_masks_of_another_number_are_refused(path):
    write_kalux(path, frames=[dataclasses.replace(frame, valid=MASK) for frame in small_frames()])
    with h5py.File(path, "r+") as file:
        file["frames/valid"].resize(3, axis=0)
    with pytest.raises(FormatError, match="3 masks of valid pixels for 4 frames"):
        readers.read(path)


@pytest.mark.parametrize("name", ["events/x", "frames/image", "ground_truth/images"])
def test_what_is_not_stored_in_full_is_not_read_as_zeros(path, name):
    """HDF5 gives zeros for what a file lacks: black frames, or events of the first column."""
    write_kalux(path)
    with h5py.File(path, "r+") as file:
        length = len(file[name])
        file[name].resize(0, axis=0)
        file[name].resize(length, axis=0)
    with pytest.raises(FormatError, match=f"/{name} is not stored in full"):
        readers.read(path).ground_truth()


def rewritten(path, name, change):
    """With one dataset of the file replaced, as by another program."""
    write_kalux(path)
    with h5py.File(path, "r+") as file:
        values = change(file[name][...])
        del file[name]
        file[name] = values
    return path


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("events/p", lambda p: np.where(p, 1, -1).astype(np.int8)),
        ("events/p", lambda p: p.astype(np.uint8)),
        ("events/x", lambda x: x.astype(np.int64)),
        ("events/t", lambda t: t.astype(">u8")),
    ],
    ids=["signs", "numbers", "wider", "other order of bytes"],
)
def test_integers_of_any_type_are_read(path, name, change):
    assert np.array_equal(all_events(readers.read(rewritten(path, name, change))), small_events())


@pytest.mark.parametrize(
    ("name", "change", "told"),
    [
        ("events/t", lambda t: t * 1e-6, "events/t is float64; int64 is needed, in whole microseconds"),
        ("events/p", lambda p: p.astype(np.float32), "events/p is float32; bool is needed"),
        ("events/p", lambda p: p.astype(np.uint8) * 255, "events/p has values from 0 to 255; 0 and 1, or -1"),
        ("events/p", lambda p: p.astype(np.int8) + 1, "events/p has values from 1 to 2; 0 and 1, or -1"),
        ("events/p", lambda p: p.astype(np.int16) - 2, "events/p has values from -2 to -1; 0 and 1, or -1"),
        ("events/x", lambda x: x.astype(np.int32) + 65536, "values from 65536 .*; uint16 is needed"),
        ("events/y", lambda y: y.astype(np.int16) - 1, "values from -1 .*; uint16 is needed"),
        (
            "frames/exposure_end",
            lambda t: t * 1e-6,
            "exposure_end is float64; int64 is needed, in whole micro",
        ),
        ("inverse_covariance", lambda f: f[:7], r"inverse_covariance is float64 \(7,\); 256 finite numbers"),
        ("inverse_covariance", lambda f: -f, "inverse_covariance has a value of -2; none may be negative"),
        ("inverse_covariance", lambda f: f.astype("S8"), "inverse_covariance is .*; 256 finite numbers"),
    ],
)
def test_columns_that_would_be_something_else_are_refused(path, name, change, told):
    with pytest.raises(FormatError, match=told):
        all_events(readers.read(rewritten(path, name, change)))


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("contrast_threshold", [0.0, 0.2], "contrast threshold is .*must be positive"),
        ("contrast_threshold", [0.1, 0.2, 0.3], "contrast threshold is"),
        ("sensor_size", [24.5, 32.0], "sensor size .*24.5.*whole numbers, height and width"),
        ("sensor_size", [1, 24, 32], "whole numbers, height and width"),
    ],
)
def test_attributes_that_cannot_be_are_refused(path, name, value, told):
    write_kalux(path)
    with h5py.File(path, "r+") as file:
        file.attrs[name] = value
    with pytest.raises(FormatError, match=told):
        readers.read(path)
