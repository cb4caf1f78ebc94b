"""Folders of event files and images, written as HS-ERGB, BS-ERGB and vid2e do."""

from __future__ import annotations

import re
import shutil

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import kalux
from kalux import readers
from kalux.datasets.published import contents, sequences
from kalux.errors import EventError, ExposureError, FormatError, FrameError
from kalux.frames import Frame
from kalux.readers import npz_folder
from recordings import (
    SIZE,
    all_events,
    colour_frames,
    complaint,
    damaged,
    same_frames,
    small_events,
    small_frames,
)

STAMPS = [frame.exposure_start for frame in small_frames()]
CUTS = STAMPS[1:]  # events of an interval between images


def as_stamped(frames):
    return [Frame(frame.image, frame.exposure_start, frame.exposure_start) for frame in frames]


def intervals(events, cuts):
    return np.split(events, np.searchsorted(events["t"], cuts))


def write_images(folder, frames, first=0):
    folder.mkdir(parents=True)
    for number, frame in enumerate(frames, first):
        cv2.imwrite(
            str(folder / f"{number:06d}.png"),
            frame.image[..., ::-1] if frame.image.ndim == 3 else frame.image,
        )


def write_hs_ergb(folder, events, frames, cuts=CUTS, save=np.savez):
    """Floats in pixels, as its programs read them; the first file is of the time before the first image."""
    (folder / "events_aligned").mkdir(parents=True)
    nudge = np.random.default_rng(0).uniform(-0.49, 0.49, (2, len(events)))
    moved = {"x": events["x"] + nudge[0], "y": events["y"] + nudge[1]}
    columns = moved | {"t": events["t"].astype(np.float64), "p": events["p"].astype(np.float32)}
    places = np.searchsorted(events["t"], [0, *cuts])
    for number in range(len(places) + 1):
        part = slice(places[number - 1] if number else 0, places[number] if number < len(places) else None)
        save(folder / f"events_aligned/{number:06d}.npz", **{k: v[part] for k, v in columns.items()})
    write_images(folder / "images_corrected", frames)
    lines = [f"{frame.exposure_start:.1f}\n" for frame in frames]
    (folder / "images_corrected/timestamp.txt").write_text("".join(lines))


def write_bs_ergb(folder, events, frames, cuts=CUTS, parts=32, save=np.savez_compressed, beyond=True):
    """Integers in 1/32 of a pixel, some of them beyond the images, where negative ones wrap around."""
    (folder / "events").mkdir(parents=True)
    for number, part in enumerate(intervals(events, cuts)):
        x, y = (part[name].astype(np.uint16) * parts for name in "xy")
        t, p = part["t"].astype(np.uint32), part["p"].astype(np.uint8)
        if beyond and len(part):
            x, y, t, p = (np.append(a, b) for a, b in ((x, 65_530), (y, 3), (t, t[-1]), (p, 1)))
        save(folder / f"events/{number:06d}.npz", x=x, y=y, timestamp=t, polarity=p)
    write_images(folder / "images", frames)
    (folder / "images/timestamp.txt").write_text("".join(f"{frame.exposure_start}\n" for frame in frames))


def write_vid2e(folder, events, frames, cuts=CUTS):
    """Times in ns, those of images in seconds as Python prints them; polarities of -1 and 1."""
    (folder / "events").mkdir(parents=True)
    for number, part in enumerate(intervals(events, cuts)):
        columns = {name: part[name].astype(np.int64) for name in "xy"}
        t = part["t"] * 1000 + 999  # cut off, as of all times in ns
        np.savez(folder / f"events/{number:010d}.npz", **columns, t=t, p=np.where(part["p"], 1, -1))
    write_images(folder / "imgs", frames)
    lines = [f"{frame.exposure_start / 1e6}\n" for frame in frames]
    (folder / "timestamps.txt").write_text("".join(lines))


WRITERS = {"hs-ergb": write_hs_ergb, "bs-ergb": write_bs_ergb, "vid2e": write_vid2e}


@pytest.mark.parametrize("layout", WRITERS)
@pytest.mark.parametrize("frames", [small_frames(), colour_frames()], ids=["grey", "colour"])
def test_a_folder_is_read_whole(tmp_path, layout, frames):
    WRITERS[layout](tmp_path / "sequence", small_events(), frames)
    source = readers.read(tmp_path / "sequence")
    assert (source.format, source.sensor_size, source.sensor_size_known) == ("npz-folder", SIZE, True)
    for _ in range(2):
        assert np.array_equal(all_events(source), small_events())
        assert same_frames(source.frames(), as_stamped(frames))
    assert (source.count_events(), source.count_frames()) == (500, 4)
    mapped = any("mapped onto the images" in text for text in source.missing)
    assert mapped == (layout != "vid2e")


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    cuts=st.lists(st.integers(0, 100_000), max_size=12).map(sorted),
    layout=st.sampled_from(sorted(WRITERS)),
    size=st.integers(1, 600),
)
def test_how_events_are_cut_into_files_and_chunks_changes_nothing(tmp_path, monkeypatch, cuts, layout, size):
    shutil.rmtree(tmp_path / "sequence", ignore_errors=True)
    WRITERS[layout](tmp_path / "sequence", small_events(), small_frames(), cuts=cuts)
    with monkeypatch.context() as patch:
        patch.setattr("kalux.readers.numpy_files.CHUNK_EVENTS", size)
        patch.setattr("kalux.readers.streams.CHUNK_EVENTS", size)
        chunks = list(readers.read(tmp_path / "sequence").events())
    assert max(map(len, chunks)) <= size
    assert np.array_equal(np.concatenate(chunks), small_events())


def test_exposures_have_to_be_given(tmp_path):
    write_bs_ergb(tmp_path / "sequence", small_events(), small_frames())
    with pytest.raises(ExposureError, match="--exposure"):
        next(iter(kalux.open(tmp_path / "sequence").frames()))
    recording = kalux.open(tmp_path / "sequence", exposure=3000, stamp="middle")
    assert [frame.exposure_start for frame in recording.frames()] == [stamp - 1500 for stamp in STAMPS]
    images = list(kalux.reconstruct(recording, rate_hz=200))
    assert np.isfinite(images[-1].intensity).all()


@pytest.mark.parametrize(
    ("stored", "pixel"),
    [(0, 0), (15, 0), (16, 1), (47, 1), (48, 2), (39 * 32 + 15, 39), (39 * 32 + 16, None), (65_535, None)],
)
def test_parts_of_a_pixel_are_rounded_and_what_is_beyond_the_images_is_left_out(tmp_path, stored, pixel):
    write_bs_ergb(tmp_path / "sequence", small_events(), small_frames(), beyond=False)
    extra = {"x": np.uint16([stored]), "y": np.uint16([32]), "timestamp": np.uint32([99_999_999])}
    np.savez(tmp_path / "sequence/events/000099.npz", **extra, polarity=np.uint8([1]))
    events = all_events(readers.read(tmp_path / "sequence"))
    added = events[events["t"] == 99_999_999]
    assert list(added["x"]) == ([] if pixel is None else [pixel])
    assert len(events) == 500 + len(added)


def test_such_folders_with_whole_pixels_are_read_too_but_nothing_is_left_out(tmp_path):
    write_bs_ergb(tmp_path / "sequence", small_events(), small_frames(), parts=1, beyond=False)
    source = readers.read(tmp_path / "sequence")
    assert np.array_equal(all_events(source), small_events())
    assert not any("mapped" in text for text in source.missing)
    shutil.rmtree(tmp_path / "sequence")
    write_bs_ergb(tmp_path / "sequence", small_events(), small_frames(), parts=1, beyond=True)
    with pytest.raises(EventError, match=r"000000\.npz: event \d+ at x=65530.*outside the sensor"):
        all_events(readers.read(tmp_path / "sequence"))


def test_columns_of_one_column_are_columns(tmp_path):
    """As `save_events` of Time Lens writes them."""

    def save(path, **columns):
        np.savez(path, **{name: values[:, None] for name, values in columns.items()})

    write_bs_ergb(tmp_path / "sequence", small_events(), small_frames(), save=save)
    assert np.array_equal(all_events(readers.read(tmp_path / "sequence")), small_events())


def test_files_are_in_the_order_of_their_numbers(tmp_path):
    write_bs_ergb(tmp_path / "sequence", small_events(), small_frames(), cuts=range(9000, 100_000, 9000))
    for file in (tmp_path / "sequence/events").iterdir():
        file.rename(file.with_name(f"{int(file.stem)}.npz"))
    (tmp_path / "sequence/events/._1.npz").write_bytes(b"of another file system")
    assert np.array_equal(all_events(readers.read(tmp_path / "sequence")), small_events())


def test_images_without_a_time_are_left_out_and_said(tmp_path):
    write_hs_ergb(tmp_path / "sequence", small_events(), small_frames())
    (tmp_path / "sequence/images_corrected/timestamp.txt").write_text("0\n20000.0\n4e4\n")
    source = readers.read(tmp_path / "sequence")
    assert same_frames(source.frames(), as_stamped(small_frames())[:3])
    assert "The last 1 of 4 images have no time, and are not read." in source.missing


def edited(name, **changes):
    """Write a file of events anew, with other columns."""

    def edit(folder):
        with np.load(folder / name) as file:
            columns = dict(file)
        np.savez(folder / name, **(columns | {key: change(columns[key]) for key, change in changes.items()}))

    return edit


def written(name, text):
    return lambda folder: (folder / name).write_text(text)


@pytest.mark.parametrize(
    ("layout", "spoil", "told"),
    [
        ("bs-ergb", lambda f: shutil.rmtree(f / "images"), "no folder 'images' or 'imgs' with their images"),
        ("hs-ergb", lambda f: shutil.rmtree(f / "images_corrected"), "no folder 'images_corrected'"),
        ("bs-ergb", lambda f: (f / "images/timestamp.txt").unlink(), "no images/timestamp.txt with their times"),
        ("vid2e", lambda f: (f / "timestamps.txt").unlink(), "no timestamps.txt"),
        ("bs-ergb", lambda f: (f / "images/000002.png").unlink(), "lists 4 times, but there are 3 images"),
        ("bs-ergb", written("images/timestamp.txt", "# us\n"), "lists 0 times"),
        ("bs-ergb", written("images/timestamp.txt", "0\n0.02\n0.04\n"), "line 2: '0.02' is not a whole number"),
        ("vid2e", written("timestamps.txt", "0\nnan\n"), "line 2: 'nan' is not a time in seconds"),
        ("bs-ergb", written("events/000001.npz", "no zip"), "000001.npz: damaged or incomplete"),
        ("hs-ergb", edited("events_aligned/000002.npz", t=lambda t: t + 0.5), "000002.npz: t of event 0 is .* whole"),
        ("hs-ergb", edited("events_aligned/000002.npz", x=lambda x: x * np.nan), "000002.npz: x of event 0 is nan"),
        ("hs-ergb", edited("events_aligned/000002.npz", y=lambda y: y.astype("U")), "000002.npz: y is <U"),
        ("hs-ergb", edited("events_aligned/000002.npz", p=lambda p: p + 5), "000002.npz: polarity of event 0 is"),
        ("bs-ergb", edited("events/000002.npz", timestamp=lambda t: t * 0), r"000002.npz: event 0 at 0 us comes after"),
        ("vid2e", edited("events/0000000001.npz", t=lambda t: t[::-1]), "0000000001.npz: event 1 at"),
        ("vid2e", edited("events/0000000001.npz", x=lambda x: x[1:]), "0001.npz: its arrays have different lengths"),
        ("bs-ergb", written("images/000001.png", "none"), "'000001.png' is not an image"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_with_its_file(tmp_path, layout, spoil, told):
    WRITERS[layout](tmp_path / "sequence", small_events(), small_frames())
    spoil(tmp_path / "sequence")
    message = complaint(tmp_path / "sequence")
    assert re.search(told, message)
    assert "\n" not in message


def test_images_of_another_size_are_refused(tmp_path):
    frames = small_frames()
    frames[2] = Frame(frames[2].image[:, 1:], *STAMPS[2:4])
    write_bs_ergb(tmp_path / "sequence", small_events(), frames)
    with pytest.raises(FrameError, match="frame 2 is 39x30 pixels, the sensor is 40x30"):
        list(kalux.open(tmp_path / "sequence", exposure=1000).frames())


def test_a_folder_of_event_files_alone_is_refused_with_what_to_give(tmp_path):
    write_bs_ergb(tmp_path / "sequence", small_events(), small_frames())
    with pytest.raises(FormatError, match="event files alone; give the folder that has them"):
        readers.read(tmp_path / "sequence/events")


@pytest.mark.parametrize("layout", ["hs-ergb", "bs-ergb"])
def test_sequences_of_the_published_sets_are_found(tmp_path, layout):
    WRITERS[layout](tmp_path / "test/candle", small_events(), small_frames())
    assert contents(layout, tmp_path).incomplete == {}
    [(name, recording)] = sequences(layout, tmp_path, exposure=1000)
    assert (name, len(recording.events()), len(recording.frames())) == ("test/candle", 500, 4)


def test_other_folders_are_not_recognised(tmp_path):
    (tmp_path / "events").mkdir()
    np.savez(tmp_path / "events/morning.npz", t=[1], x=[1], y=[1], p=[1])
    assert not npz_folder.recognises(tmp_path)
    assert not npz_folder.recognises(tmp_path / "events/morning.npz")
    assert not npz_folder.recognises(tmp_path / "none")


def test_damage_is_told_in_one_line(tmp_path):
    write_bs_ergb(tmp_path / "sequence", small_events(), small_frames())
    file = tmp_path / "sequence/events/000001.npz"
    data = file.read_bytes()
    for changed in damaged(data, 60):
        file.write_bytes(changed)
        message = complaint(tmp_path / "sequence")
        assert not message or str(tmp_path / "sequence") in message
        assert "\n" not in message
