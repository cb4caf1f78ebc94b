"""The AEDAT 3.1 reader. No real file could be had: all here are written by `packet`, from the layout's description."""

from __future__ import annotations

import dataclasses
import struct

import numpy as np
import pytest

from kalux import readers
from kalux.errors import FormatError
from kalux.events import make_events
from kalux.frames import Frame
from kalux.readers import CHUNK_EVENTS
from kalux.recording import Recording
from recordings import (
    SIZE,
    all_events,
    assert_only_clear_errors,
    colour_frames,
    damaged,
    same_frames,
    small_events,
    small_frames,
)

# A writer, after the description of the layout


def header(*lines, version="3.1", packets="RAW", sensor="Unknown"):
    text = [
        f"#!AER-DAT{version}",
        f"#Format: {packets}",
        f"#Source 1: {sensor}",
        "#-Source 1: DAVIS128",
        "#Start-Time: 2016-05-03 12:00:00 (TZ+0200)",
        *lines,
        "#!END-HEADER",
    ]
    return "".join(line + "\r\n" for line in text).encode()


def packet(kind, body, count, size, source=1, overflow=0, spare=0):
    head = struct.pack("<hhiiiiii", kind, source, size, 4, overflow, count + spare, count, count)
    return head + body + bytes(size * spare)


def polarity(events, valid=True, **more):
    e = {name: events[name].astype(np.uint32) for name in "xyp"}
    pairs = np.empty((len(events), 2), "<u4")
    pairs[:, 0] = e["x"] << 17 | e["y"] << 2 | e["p"] << 1 | np.uint32(valid)
    pairs[:, 1] = events["t"] & 0x7FFFFFFF
    return packet(1, pairs.tobytes(), len(events), 8, **more)


def frame(stored, info=0b11, **more):
    height, width = stored.image.shape[:2]
    begin, end = stored.exposure_start, stored.exposure_end
    head = struct.pack("<I8i", info, begin - 5, end + 900, begin, end, width, height, 0, 0)
    body = head + stored.image.astype("<u2").tobytes()
    return packet(2, body, 1, len(body), **more)


def wide(frames):
    return [Frame(f.image.astype(np.uint16) << 8, f.exposure_start, f.exposure_end) for f in frames]


OTHERS = packet(0, bytes(8), 1, 8) + packet(3, bytes(72), 2, 36)  # special and inertial events


@pytest.fixture
def path(tmp_path):
    return tmp_path / "recording.aedat"


def write(path, *parts, head=None):
    path.write_bytes((header() if head is None else head) + b"".join(parts))
    return readers.read(path)


def test_reads_what_was_written(path):
    events, frames = small_events(), wide(small_frames())
    parts = [polarity(events[:200]), OTHERS, *map(frame, frames), polarity(events[200:], spare=7)]
    source = write(path, *parts)
    assert (source.format, source.sensor_size, source.exposure_known, source.missing) == (
        "aedat3",
        SIZE,
        True,
        (),
    )
    for _ in range(2):
        assert np.array_equal(all_events(source), events)
        assert same_frames(source.frames(), frames)
    assert (source.count_events(), source.count_frames()) == (len(events), len(frames))


@pytest.mark.parametrize(
    ("number", "mosaic"), [(1, "RGGB"), (2, "GRBG"), (3, "GBRG"), (4, "BGGR"), (0, None)]
)
def test_colour_filters_are_those_of_libcaer(path, number, mosaic):
    """libcaer's RGBG, GRGB, GBGR, BGRG name the upper left pixels by columns of its frame_utils.c."""
    frames = wide(small_frames())
    source = write(path, *(frame(f, 0b11 | number << 4) for f in frames))
    assert source.mosaic == mosaic
    assert same_frames(source.frames(), frames)
    assert {f.mosaic for f in Recording(source).frames()} == {mosaic}


@pytest.mark.parametrize("channels", [3, 4])
def test_frames_in_rgb(path, channels):
    frames = colour_frames(dtype=np.uint16)
    stored = [
        dataclasses.replace(f, image=np.dstack([f.image, f.image[..., :1]])[..., :channels]) for f in frames
    ]
    source = write(path, *(frame(f, 1 | channels << 1) for f in stored))
    assert source.sensor_size == SIZE
    assert same_frames(source.frames(), frames)


def test_how_packets_are_cut_makes_no_difference(path):
    events = small_events(5_000)
    for size in (1, 777, 5_000):
        source = write(path, *(polarity(events[i : i + size]) for i in range(0, 5_000, size)))
        assert np.array_equal(all_events(source), events)


def test_chunks_are_full_but_the_last(path):
    source = write(path, polarity(np.repeat(small_events(1), CHUNK_EVENTS + 10)))
    assert all(len(chunk) <= CHUNK_EVENTS for chunk in source.events())
    assert source.count_events() == CHUNK_EVENTS + 10


def test_coordinates_have_15_bits_and_the_origin_is_above_on_the_left(path):
    events = make_events([5, 6], [32767, 0], [0, 32767], [1, 0])
    assert np.array_equal(all_events(write(path, polarity(events))), events)


def test_times_go_on_above_31_bits(path):
    events = small_events()
    stored = wide(small_frames())[1]
    source = write(path, polarity(events, overflow=3), frame(stored, overflow=3))
    assert np.array_equal(all_events(source)["t"], events["t"] + (3 << 31))
    assert next(source.frames()).exposure_start == stored.exposure_start + (3 << 31)


def test_invalid_events_and_frames_are_skipped(path):
    events, frames = small_events(), wide(small_frames())
    parts = [polarity(events[:9], valid=False), polarity(events), frame(frames[0], 0b10), frame(frames[1])]
    source = write(path, *parts)
    assert np.array_equal(all_events(source), events)
    assert same_frames(source.frames(), frames[1:2])
    assert source.count_frames() == 1


@pytest.mark.parametrize(
    ("sensor", "size", "known"), [("DAVIS240C", (180, 240), True), ("Other", (30, 40), False)]
)
def test_the_size_is_that_of_the_sensor_or_holds_all_events(path, sensor, size, known):
    source = write(path, polarity(small_events()), head=header(sensor=sensor))
    assert (source.sensor_size, source.sensor_size_known) == (size, known)
    assert any("no frames" in sentence for sentence in source.missing)


def test_one_source_is_read_that_with_frames(path):
    events, frames = small_events(), wide(small_frames())
    parts = [polarity(events[:3]), polarity(events, source=2), *(frame(f, source=2) for f in frames)]
    source = write(path, *parts)
    assert np.array_equal(all_events(source), events)
    assert any("only source 2" in sentence for sentence in source.missing)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (header(version="3.0"), "AEDAT 3.0 cannot be read"),
        (header(packets="Serial-TS"), "packets as 'Serial-TS'"),
        (header()[:-5], "header does not end"),
        (header() + OTHERS, "neither events nor frames"),
        (header() + polarity(small_events())[:-1], "beyond the end"),
        (header() + polarity(small_events()) + b"\1\0", "within the header of a packet"),
        (header() + packet(1, bytes(9), 1, 9), "9 bytes instead of 8"),
        (header() + packet(-3, b"", 0, 8), "makes no sense"),
        (header() + frame(wide(small_frames())[0], 0b1010011), "colour filter that is no Bayer mosaic"),
        (header() + frame(wide(small_frames())[0], 0b101), "makes no sense"),  # of two channels
    ],
)
def test_what_cannot_be_read_is_said(path, data, message):
    path.write_bytes(data)
    with pytest.raises(FormatError, match=message):
        readers.read(path)


def test_damage_gives_clear_errors(path):
    events, frames = small_events(), wide(small_frames())
    parts = [polarity(events[:200]), OTHERS, *map(frame, frames), polarity(events[200:])]
    assert_only_clear_errors(path, damaged(header() + b"".join(parts), 200, header=400))


def test_damage_of_colours_gives_clear_errors(path):
    frames = [frame(f, 0b0010111) for f in colour_frames(dtype=np.uint16)]
    assert_only_clear_errors(path, damaged(header() + b"".join(frames), 200, header=400))


def test_tonic_reads_the_same_events(path):
    events = small_events()
    write(path, polarity(events[:200]), polarity(events[200:]))
    tonic_io = pytest.importorskip("tonic.io")
    theirs = tonic_io.get_aer_events_from_file(str(path), 3.1, len(header()))
    ours = all_events(readers.read(path))
    assert np.array_equal(theirs["timeStamp"], ours["t"])
    assert np.array_equal(theirs["address"] >> 17, ours["x"])


def test_real_frames_and_events_come_back(shared_data, path):
    """Real payload, our writer: a street, whose 8-bit frames are written with 16 bits."""
    real = readers.read(shared_data / "street_davis346.aedat4")
    events = all_events(real)
    start = int(events["t"][0]) - 1_000_000
    events["t"] -= start
    frames = [
        Frame(f.image.astype(np.uint16) << 8, f.exposure_start - start, f.exposure_end - start)
        for f in real.frames()
    ]
    parts = [polarity(events[i : i + 4096]) for i in range(0, len(events), 4096)]
    source = write(path, *parts, *map(frame, frames), head=header(sensor="DAVIS346B"))
    assert source.sensor_size == (260, 346)
    assert np.array_equal(all_events(source), events)
    assert same_frames(source.frames(), frames)
