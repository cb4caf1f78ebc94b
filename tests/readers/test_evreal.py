"""Folders of EVREAL, written as its tools do."""

from __future__ import annotations

import json

import numpy as np
import pytest

import kalux
from kalux import readers
from kalux.errors import EventError, FormatError
from kalux.frames import Frame
from kalux.readers import evreal
from recordings import SIZE, all_events, complaint, damaged, same_frames, small_events, small_frames

NAMES = ("events_ts", "events_xy", "events_p", "images", "images_ts", "image_event_indices")


def write_evreal(folder, events, frames, **changes):
    """The arrays as ``bag_to_npy.py`` makes them; ``changes`` replace some, or leave them out (None)."""
    folder.mkdir(parents=True, exist_ok=True)
    seconds = events["t"] / 1e6
    stamps = np.array([[frame.exposure_start] for frame in frames]) / 1e6
    arrays = {
        "events_ts": seconds,
        "events_xy": np.array([events["x"].astype(np.int64), events["y"].astype(np.int64)]).transpose(),
        "events_p": events["p"].astype(np.int64),
        "images": np.expand_dims(np.stack([frame.image for frame in frames]), axis=-1),
        "images_ts": stamps,
        "image_event_indices": np.searchsorted(seconds, stamps, "right") - 1,
    }
    assert arrays["events_xy"].flags.f_contiguous, "one column after the other, in the file, too"
    for name, array in (arrays | changes).items():
        if name in NAMES and array is not None:
            np.save(folder / f"{name}.npy", array)
    metadata = changes.get("metadata", {"sensor_resolution": frames[0].image.shape})
    if metadata is not None:
        (folder / "metadata.json").write_text(json.dumps(metadata))
    return folder


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "sequence"


def test_a_folder_is_read_whole(folder):
    write_evreal(folder, small_events(), small_frames())
    source = readers.read(folder)
    assert (source.format, source.sensor_size, source.sensor_size_known) == ("evreal", SIZE, True)
    assert (source.count_events(), source.count_frames(), source.exposure_known) == (500, 4, False)
    for _ in range(2):
        assert np.array_equal(all_events(source), small_events())
        stamped = [Frame(f.image, f.exposure_start, f.exposure_start) for f in small_frames()]
        assert same_frames(source.frames(), stamped)
    recording = kalux.open(folder, exposure=3000, stamp="start")
    assert [frame.exposure_end for frame in recording.frames()] == [
        f.exposure_start + 3000 for f in small_frames()
    ]


def test_the_arrays_of_its_other_tools(folder):
    """Columns of bool and int16 in the order of C, (N, 1), images without a channel, no indices."""
    events, frames = small_events(), small_frames()
    write_evreal(
        folder,
        events,
        frames,
        events_ts=events["t"][:, None] / 1e6,
        events_xy=np.stack([events["x"], events["y"]], axis=-1).astype(np.int16),
        events_p=events["p"],
        images=np.stack([frame.image for frame in frames]),
        images_ts=np.array([frame.exposure_start for frame in frames]) / 1e6,
        image_event_indices=None,
    )
    source = readers.read(folder)
    assert np.array_equal(all_events(source), events)
    assert [frame.exposure_start for frame in source.frames()] == [f.exposure_start for f in frames]


@pytest.mark.parametrize("size", [1, 7, 499, 500])
def test_chunks_join_without_a_seam(folder, monkeypatch, size):
    write_evreal(folder, small_events(), small_frames())
    monkeypatch.setattr(evreal, "CHUNK_EVENTS", size)
    chunks = list(readers.read(folder).events())
    assert max(map(len, chunks)) == size
    assert np.array_equal(np.concatenate(chunks), small_events())


@pytest.mark.parametrize("left_out", ["images", "images_ts"])
def test_without_images_the_metadata_say_how_large_the_sensor_is(folder, left_out):
    write_evreal(folder, small_events(), small_frames(), **{left_out: None})
    source = readers.read(folder)
    assert (source.sensor_size, source.sensor_size_known, source.count_frames()) == (SIZE, True, 0)
    assert (list(source.frames()), source.exposure_known) == ([], True)
    for metadata in (None, {}, []):
        (folder / "metadata.json").unlink(missing_ok=True)
        write_evreal(folder, small_events(), small_frames(), metadata=metadata, **{left_out: None})
        source = readers.read(folder)
        assert (source.sensor_size, source.sensor_size_known) == (SIZE, False)
        assert any("sensor size" in text for text in source.missing)


def test_a_sequence_without_events(folder):
    write_evreal(folder, small_events(0), small_frames())
    source = readers.read(folder)
    assert (source.sensor_size, source.count_events(), len(all_events(source))) == (SIZE, 0, 0)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"events_ts": np.arange(500)}, r"events_ts\.npy: its times are int64, .* floating-point seconds"),
        ({"events_ts": np.zeros((500, 2))}, r"events_ts\.npy: has the shape \(500, 2\)"),
        ({"events_ts": np.full(500, np.nan)}, "not finite"),
        ({"events_ts": np.full(500, 1e305)}, "out of range"),
        ({"events_ts": np.zeros(499)}, "different lengths"),
        ({"events_xy": np.zeros((500, 3), int)}, r"events_xy\.npy: has the shape \(500, 3\)"),
        ({"events_xy": np.full((500, 2), -1)}, "x of event 0 is -1"),
        ({"events_p": np.array(["on"] * 500)}, r"events_p\.npy: holds .* an array of numbers is needed"),
        ({"events_p": np.full(500, 2)}, "polarit"),
        ({"images_ts": np.zeros((3, 1))}, "has 4 images for 3 times"),
        ({"images": np.zeros((4, *SIZE, 3), np.uint8)}, "in colour"),
        ({"images": np.zeros(4, np.uint8)}, r"\(height, width\) is needed"),
        ({"metadata": {"sensor_resolution": [40, 30]}}, "40x30 pixels, but metadata.json says 30x40"),
        ({"metadata": {"sensor_resolution": [30, -40]}}, "height and width are needed"),
        ({"metadata": {"sensor_resolution": 30}}, "height and width are needed"),
    ],
)
def test_what_does_not_belong_together_is_refused(folder, changes, told):
    write_evreal(folder, small_events(), small_frames(), **changes)
    with pytest.raises(FormatError, match=told) as caught:
        all_events(readers.read(folder))
    assert str(folder) in str(caught.value)


def test_events_beyond_the_sensor_are_an_error(folder):
    events = small_events()
    events["x"][7] = SIZE[1]
    write_evreal(folder, events, small_frames())
    with pytest.raises(EventError, match="outside the sensor"):
        list(kalux.open(folder).events())


@pytest.mark.parametrize("name", [*NAMES[:5], "metadata"])
def test_damage_gives_clear_errors(folder, name):
    write_evreal(folder, small_events(100), small_frames())
    file = folder / (name + (".json" if name == "metadata" else ".npy"))
    for changed in damaged(file.read_bytes(), 60, 200):
        file.write_bytes(changed)
        message = complaint(folder)
        assert "\n" not in message
        assert not message or str(folder) in message


def test_other_folders_are_not_recognised(folder):
    write_evreal(folder, small_events(), small_frames(), events_p=None)
    assert not evreal.recognises(folder)
    assert not evreal.recognises(folder / "images.npy")
