"""The AEDAT 4 writer: everything comes back by our reader, and by others' where they are installed."""

from __future__ import annotations

import dataclasses
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kalux import readers
from kalux.errors import FrameError, OutputError
from kalux.events import EVENT_DTYPE, make_events
from kalux.frames import Frame
from kalux.readers import aedat4 as reader
from kalux.writers import aedat4
from recordings import (
    SIZE,
    all_events,
    colour_frames,
    read_by_dv_processing,
    same_frames,
    small_events,
    small_frames,
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "copy.aedat4"


def write(path, events=None, frames=None, **options):
    events = [small_events()] if events is None else events
    frames = small_frames() if frames is None else frames
    aedat4.write(path, **{"sensor_size": SIZE, "events": events, "frames": frames, **options})
    return readers.read(path)


@pytest.mark.parametrize("compression", ["lz4", "zstd", "none"])
def test_everything_comes_back(path, compression):
    source = write(path, compression=compression)
    assert (source.format, source.sensor_size, source.exposure_known) == ("aedat4", SIZE, True)
    assert source.missing == ()
    assert np.array_equal(all_events(source), small_events())
    assert same_frames(source.frames(), small_frames())


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("make", [small_frames, colour_frames])
def test_pixels_of_8_and_16_bits_grey_and_rgb(path, dtype, make):
    frames = [dataclasses.replace(f, image=f.image.astype(dtype) * 3) for f in make()]
    assert same_frames(write(path, frames=frames).frames(), frames)


def test_big_endian_pixels(path):
    frames = [dataclasses.replace(f, image=f.image.astype(">u2") * 200) for f in small_frames()]
    for ours, theirs in zip(write(path, frames=frames).frames(), frames, strict=True):
        assert np.array_equal(ours.image, theirs.image)


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    times=st.lists(st.integers(-(10**18), 10**18), max_size=8),
    shots=st.lists(st.integers(-(10**15), 10**15), max_size=5, unique=True),
    exposure=st.integers(1, 10**6),
    splits=st.integers(1, 4),
)
def test_any_times(path, times, shots, exposure, splits):
    """Negative times, zero, gaps of years: exactly what was written, in chunks of any length."""
    times = sorted(times)
    events = make_events(
        np.array(times, np.int64),
        np.full(len(times), 3),
        np.full(len(times), 4),
        np.arange(len(times)) % 2 == 0,
    )
    frames = [Frame(np.full(SIZE, i, np.uint8), t, t + exposure) for i, t in enumerate(sorted(shots))]
    source = write(path, np.array_split(events, splits), frames)
    assert np.array_equal(all_events(source), events)
    assert same_frames(source.frames(), frames)
    assert source.exposure_known


def test_exposures_that_are_unknown_stay_unknown(path):
    frames = [dataclasses.replace(f, exposure_end=f.exposure_start) for f in small_frames()]
    source = write(path, frames=frames, exposure_known=False)
    assert not source.exposure_known
    assert same_frames(source.frames(), frames)


def test_events_alone_and_frames_alone(path):
    source = write(path, frames=[])
    assert (source.count_events(), source.count_frames()) == (500, 0)
    source = write(path, events=[])
    assert (source.count_events(), source.count_frames()) == (0, 4)
    assert any("no event stream" in text for text in source.missing)
    source = write(path, events=[], frames=[])
    assert (source.count_events(), source.count_frames()) == (0, 0)


def test_packets_are_in_order_of_time(path):
    """Players read from the beginning to the end; a frame lies before the events that follow its start."""
    events = np.concatenate([small_events()] * 60)
    events["t"] = np.arange(len(events)) * 3
    write(path, [events])
    with path.open("rb") as file:
        container = reader._open(path, file)
    places = sorted(
        (offset, stream) for stream, places in container.packets.items() for offset in places[::2]
    )
    starts = {(s.number, i): t for s in container.streams for i, t in enumerate(first_times(container, s))}
    seen, times = {0: 0, 1: 0}, []
    for _, stream in places:
        times.append(starts[stream, seen[stream]])
        seen[stream] += 1
    assert seen == {0: -(-len(events) // aedat4.EVENTS_PER_PACKET), 1: 4}
    assert times[0] == 0
    frames_at = [i for i, (_, stream) in enumerate(places) if stream == 1]
    for i in frames_at:
        assert all(t >= times[i] for t in times[i + 1 :])


def first_times(container, stream):
    if stream.kind == "EVTS":
        parts = container.read(stream, reader._events)
        return [int(np.frombuffer(part, EVENT_DTYPE)["t"][0]) for part in parts]
    return [frame.exposure_start for frame in reader._stored_frames(container, stream)]


def test_the_data_table_names_every_packet(path):
    """Programs that seek need it: offset behind the packet's header, stream, size, elements, first and last time."""
    write(path, compression="none")
    data = path.read_bytes()
    with path.open("rb") as file:
        container = reader._open(path, file)
    position = reader._root(data[14:], b"IOHE").scalar(1, "<q", -1)
    table = reader._root(data[position:], b"FTAB")
    start, count = table.vector(0)
    entries = []
    for place in range(start, start + 4 * count, 4):
        entry = reader._Table(table.data, place + struct.unpack_from("<I", table.data, place)[0])
        packet = struct.unpack_from("<ii", table.data, entry._field(1))
        entries.append((*(entry.scalar(i, "<q", 0) for i in (0, 2, 3, 4)), *packet))
    found = {
        (offset, size): number
        for number, places in container.packets.items()
        for offset, size in zip(places[::2], places[1::2], strict=True)
    }
    assert {(offset, size): stream for offset, _, _, _, stream, size in entries} == found
    events = small_events()
    assert [e[1:4] for e in entries if e[4] == 0] == [(500, int(events["t"][0]), int(events["t"][-1]))]
    assert [e[1:4] for e in entries if e[4] == 1] == [
        (1, f.exposure_start, f.exposure_start) for f in small_frames()
    ]


def test_the_same_bytes_each_time(path, tmp_path):
    """Padding between the fields of an event is not copied from memory."""
    dirty = np.frombuffer(bytes([255]) * (16 * 500), EVENT_DTYPE).copy()
    for name in "txyp":
        dirty[name] = small_events()[name]
    write(path)
    write(tmp_path / "other.aedat4", [dirty])
    assert path.read_bytes() == (tmp_path / "other.aedat4").read_bytes()


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"image": np.zeros(SIZE, np.float32)}, "frame 2 has pixels of float32"),
        ({"valid": np.zeros(SIZE, bool)}, "frame 2 has pixels that are not valid"),
        ({"gain": 2.0}, "frame 2 has a gain of 2"),
    ],
)
def test_frames_that_cannot_be_held(path, changes, told):
    path.write_text("mine")
    frames = small_frames()
    frames[2] = dataclasses.replace(frames[2], **changes)
    with pytest.raises(FrameError, match=rf"{path}: {told}.*kalux HDF5"):
        write(path, frames=frames)
    assert path.read_text() == "mine"
    assert list(path.parent.iterdir()) == [path]


def test_a_sensor_too_large(path):
    with pytest.raises(OutputError, match="up to 32767 pixels a side, this one has 40000x30"):
        write(path, sensor_size=(30, 40_000))
    assert not path.exists()


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(OutputError, match="none"):
        write(tmp_path / "none" / "copy.aedat4")


def test_an_interrupt_leaves_nothing(path):
    def stopped():
        yield small_events()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(path, stopped())
    assert list(path.parent.iterdir()) == []


@pytest.mark.parametrize("name", ["street_davis346", "newton_davis346"])
@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_dv_processing_reads_it(shared_data, path, name, compression):
    source = readers.read(shared_data / f"{name}.aedat4")
    write(path, source.events(), source.frames(), sensor_size=source.sensor_size, compression=compression)
    theirs, images = read_by_dv_processing(path)
    assert np.array_equal(all_events(source), theirs)
    for frame, image in zip(source.frames(), images, strict=True):
        assert np.array_equal(frame.image, image.image)
        assert (frame.exposure_start, frame.exposure) == (
            image.timestamp,
            image.exposure.total_seconds() * 1e6,
        )


@pytest.mark.parametrize("make", [small_frames, colour_frames])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_aedat_reads_it(path, make, dtype):
    other = pytest.importorskip("aedat")
    frames = [dataclasses.replace(f, image=f.image.astype(dtype) * 3) for f in make()]
    write(path, frames=frames)
    packets = list(other.Decoder(str(path)))
    theirs = np.concatenate([packet["events"] for packet in packets if "events" in packet])
    for field, their_field in zip("txyp", ("t", "x", "y", "on"), strict=True):
        assert np.array_equal(small_events()[field], theirs[their_field])
    stored = [packet["frame"] for packet in packets if "frame" in packet]
    for frame, image in zip(frames, stored, strict=True):
        assert (frame.exposure_start, frame.exposure_end) == (
            image["exposure_begin_t"],
            image["exposure_end_t"],
        )
        assert np.array_equal(frame.image, image["pixels"])
