"""The AEDAT 4 reader, on files built here byte by byte, and on real ones against dv-processing."""

from __future__ import annotations

import struct

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard

import kalux
from kalux import readers
from kalux.errors import FormatError, FrameError
from kalux.events import make_events
from kalux.frames import Frame
from kalux.models.colour import sample_mosaic
from kalux.readers import CHUNK_EVENTS, aedat4
from recordings import (
    SIZE,
    all_events,
    assert_only_clear_errors,
    check_seeking,
    colour_frames,
    damaged,
    read_by_dv_processing,
    same_frames,
    small_events,
    small_frames,
)

COMPRESS = {0: bytes, 1: lz4.frame.compress, 3: zstandard.ZstdCompressor().compress}


def flatbuffer(identifier, fields):
    """A size-prefixed FlatBuffers table. Fields: number -> (struct code, value) or bytes (a vector)."""
    last = max(fields, default=-1)
    table, vectors, offsets = bytearray(4), {}, [0] * (last + 1)
    for number, field in fields.items():
        code, value = ("<I", 0) if isinstance(field, tuple) and field[0] == "vector" else field
        table += bytes(-len(table) % 8)
        offsets[number] = len(table)
        if field[0] == "vector":
            vectors[number] = field[1:]
        table += struct.pack(code, value)
    vtable = struct.pack(f"<HH{len(offsets)}H", 4 + 2 * len(offsets), len(table), *offsets)
    vtable += bytes(-len(vtable) % 8)
    start = 8 + len(vtable)  # after root offset, identifier
    struct.pack_into("<i", table, 0, len(vtable))
    body = bytearray(struct.pack("<I", start) + identifier.encode() + vtable + table)
    for number, (length, content) in vectors.items():
        body += bytes(-len(body) % 8)
        struct.pack_into("<I", body, start + offsets[number], len(body) - start - offsets[number])
        body += struct.pack("<I", length) + content
    return struct.pack("<I", len(body)) + bytes(body)


def event_packet(events):
    return flatbuffer("EVTS", {0: ("vector", len(events), events.tobytes())})


def frame_packet(frame, *, kind=0, exposure="both", length=0):
    height, width = frame.image.shape[:2]
    fields = {0: ("<q", frame.exposure_start), 1: ("<q", 0), 2: ("<q", 0)}
    if exposure == "both":
        fields |= {3: ("<q", frame.exposure_start), 4: ("<q", frame.exposure_end)}
    content = frame.image.tobytes()
    fields |= {5: ("<b", kind), 6: ("<h", width), 7: ("<h", height), 10: ("vector", len(content), content)}
    if exposure == "duration":
        length = frame.exposure
    if length:
        fields[11] = ("<q", length)
    return flatbuffer("FRME", fields)


def colour_packet(frame, kind):
    bgr = frame.image[..., ::-1]
    stored = np.dstack([bgr, bgr[..., 0]]) if kind in (24, 26) else bgr
    flat = Frame(np.ascontiguousarray(stored), frame.exposure_start, frame.exposure_end)
    return frame_packet(flat, kind=kind)


def aedat4_file(
    packets,
    *,
    streams=(("EVTS", SIZE), ("FRME", SIZE)),
    compression=0,
    closed=True,
    camera="Unknown",
    module="capture",
    info="",
):
    """A file of (stream, packet) pairs. Streams are (kind, size), or with a camera of their own."""
    nodes = "".join(
        f'<node name="{i}"><attr key="originalModuleName" type="string">{module}</attr>'
        f'<attr key="typeIdentifier" type="string">{kind}</attr><node name="info">{info}'
        f'<attr key="sizeX" type="int">{width}</attr><attr key="sizeY" type="int">{height}</attr>'
        f'<attr key="source" type="string">{(*own, camera)[0]}</attr></node></node>'
        for i, (kind, (height, width), *own) in enumerate(streams)
    )
    tree = f'<dv version="2.0"><node name="outInfo">{nodes}</node></dv>'.encode()
    body = b"".join(
        struct.pack("<ii", stream, len(packed)) + packed
        for stream, packed in ((stream, COMPRESS[compression](packet)) for stream, packet in packets)
    )

    def header(table_position):
        return b"#!AER-DAT4.0\r\n" + flatbuffer(
            "IOHE", {0: ("<i", compression), 1: ("<q", table_position), 2: ("vector", len(tree), tree)}
        )

    end = len(header(0)) + len(body)
    return header(end if closed else -1) + body + (b"data table" if closed else b"")


def small_file(**options):
    events, frames = small_events(), small_frames()
    packets = [(0, event_packet(part)) for part in np.array_split(events, 7)]
    packets += [(1, frame_packet(frame)) for frame in frames]
    return aedat4_file(packets, **options)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "recording.aedat4"


@pytest.mark.parametrize("compression", [0, 1, 3])
@pytest.mark.parametrize("closed", [True, False])
def test_reads_what_was_written(path, compression, closed):
    path.write_bytes(small_file(compression=compression, closed=closed))
    source = readers.read(path)
    assert (source.format, source.sensor_size, source.exposure_known) == ("aedat4", SIZE, True)
    assert source.missing == ()
    for _ in range(2):
        assert np.array_equal(all_events(source), small_events())
        assert same_frames(source.frames(), small_frames())
    assert (source.count_events(), source.count_frames()) == (500, 4)


def test_large_packets_are_split_and_small_ones_joined(path):
    count = CHUNK_EVENTS + 10
    many = np.tile(small_events(1), count)
    path.write_bytes(aedat4_file([(0, event_packet(many)), (0, event_packet(many[:3]))]))
    assert [len(chunk) for chunk in readers.read(path).events()] == [CHUNK_EVENTS, 13]
    path.write_bytes(aedat4_file([(0, event_packet(many[:5]))] * 10))
    assert [len(chunk) for chunk in readers.read(path).events()] == [50]


@pytest.mark.parametrize("module", ["capture", "jAER"])
def test_later_events_are_read_without_those_before(path, module):
    """Packets may be empty, or begin and end at the same time."""
    times = [[], [1, 1, 5], [5, 5], [5, 8], [], [9, 20], [20, 31], [40], []]
    packets = [
        event_packet(make_events(t, t, np.zeros_like(t), np.ones_like(t)))
        for t in (np.array(packet, np.int64) for packet in times)
    ]
    path.write_bytes(aedat4_file([(0, packet) for packet in packets], module=module))
    check_seeking(readers.read(path), [*range(-1, 42), 1 << 40])


def test_late_frames_are_put_in_order(path):
    frames = small_frames(20)
    shuffled = [*frames[5:8], *frames[:5], *frames[8:]]
    path.write_bytes(aedat4_file([(1, frame_packet(frame)) for frame in shuffled]))
    assert same_frames(readers.read(path).frames(), frames)


def test_exposure_from_its_duration(path):
    frames = small_frames()
    path.write_bytes(aedat4_file([(1, frame_packet(frame, exposure="duration")) for frame in frames]))
    source = readers.read(path)
    assert source.exposure_known
    assert same_frames(source.frames(), frames)


def test_unknown_exposure_is_said(path):
    frames = small_frames()
    path.write_bytes(aedat4_file([(1, frame_packet(frame, exposure="none")) for frame in frames]))
    source = readers.read(path)
    assert not source.exposure_known
    assert "exposure times" in source.missing[-1]
    assert [(f.exposure_start, f.exposure_end) for f in source.frames()] == [
        (f.exposure_start, f.exposure_start) for f in frames
    ]


def test_an_exposure_that_contradicts_its_length_is_noted(path):
    """Start and end are taken, and a file that states both is read without a word where they agree."""
    frame = Frame(small_frames()[0].image, 1_000, 1_500)
    for stated, noted in ((300, True), (500, False), (0, False), (900, False)):
        packet = frame_packet(frame, length=stated)
        path.write_bytes(aedat4_file([(0, event_packet(small_events())), (1, packet)]))
        source = readers.read(path)
        assert same_frames(source.frames(), [frame])
        assert (
            any("exposure of 300 us, but one that takes 500 us" in text for text in source.missing) == noted
        )


def test_events_only_and_frames_only(path):
    path.write_bytes(aedat4_file([(0, event_packet(small_events()))], streams=[("EVTS", SIZE)]))
    source = readers.read(path)
    assert source.count_frames() == 0
    assert list(source.frames()) == []
    assert any("no frames" in sentence for sentence in source.missing)
    path.write_bytes(aedat4_file([(0, frame_packet(small_frames()[0]))], streams=[("FRME", SIZE)]))
    source = readers.read(path)
    assert source.count_events() == 0
    assert list(source.events()) == []
    assert any("no event" in sentence for sentence in source.missing)


def test_of_several_streams_those_of_equal_size_are_read(path):
    streams = [("EVTS", SIZE), ("FRME", (60, 80)), ("FRME", SIZE), ("IMUS", (0, 0))]
    big = Frame(np.zeros((60, 80), np.uint8), 0, 10)
    packets = [(0, event_packet(small_events())), (1, frame_packet(big))]
    packets += [(2, frame_packet(frame)) for frame in small_frames()]
    path.write_bytes(aedat4_file(packets, streams=streams))
    source = readers.read(path)
    assert same_frames(source.frames(), small_frames())
    assert any("2 frame streams" in sentence and "stream 2" in sentence for sentence in source.missing)


def test_of_several_streams_those_with_packets_are_read(path):
    """A recorder may have declared an output that then had no events."""
    streams = [("EVTS", (60, 80)), ("EVTS", SIZE), ("FRME", SIZE)]
    path.write_bytes(aedat4_file([(1, event_packet(small_events()))], streams=streams))
    source = readers.read(path)
    assert source.sensor_size == SIZE
    assert np.array_equal(all_events(source), small_events())
    assert source.missing == ("The file has no frames.",)
    path.write_bytes(aedat4_file([], streams=streams))
    assert readers.read(path).count_events() == 0


def test_frames_of_another_size_than_the_events_are_left_out(path):
    """The events of such a file can be read all the same; a stream that contradicts its frames is an error, though."""
    big = Frame(np.zeros((60, 80), np.uint8), 0, 10)
    packets = [(0, event_packet(small_events())), (1, frame_packet(big))]
    path.write_bytes(aedat4_file(packets, streams=[("EVTS", SIZE), ("FRME", (60, 80))]))
    recording = kalux.open(path)
    assert np.array_equal(np.concatenate(list(recording.events())), small_events())
    assert list(recording.frames()) == []
    assert recording.source.count_frames() == 0
    assert any("have 80x60 pixels, the events 40x30" in text for text in recording.source.missing)
    path.write_bytes(aedat4_file(packets))
    with pytest.raises(FrameError, match="80x60 pixels, the sensor is 40x30"):
        list(kalux.open(path).frames())
    wrong = [("EVTS", SIZE), ("FRME", (60, 80))]
    path.write_bytes(aedat4_file([packets[0], (1, frame_packet(small_frames()[0]))], streams=wrong))
    assert len(list(kalux.open(path).frames())) == 1


LEFT, RIGHT = "DAVIS346_00000001", "DAVIS346_00000002"


def file_of(streams):
    """A file of (kind, camera) streams of one size; contents are those of the stream's number, see `contents`."""
    packets = []
    for number, (kind, _) in enumerate(streams):
        if kind == "EVTS":
            packets.append((number, event_packet(small_events(seed=number))))
        elif kind == "FRME":
            packets += [(number, frame_packet(frame)) for frame in small_frames(seed=number)]
        else:
            packets.append((number, trigger_packet(1000 * number)))
    return aedat4_file(packets, streams=[(kind, SIZE, camera) for kind, camera in streams])


def trigger_packet(t):
    """One rising edge: a vector of one offset, behind which lie the table of fields and the trigger itself."""
    fields, trigger = struct.pack("<4H", 8, 16, 8, 4), struct.pack("<ib3xq", 8, 1, t)
    return flatbuffer("TRIG", {0: ("vector", 1, struct.pack("<I", 12) + fields + trigger)})


def contents(source):
    """Numbers of the streams that events, frames and triggers are of."""
    events, frames = all_events(source), list(source.frames())
    of_events = [n for n in range(6) if np.array_equal(events, small_events(seed=n))]
    of_frames = [n for n in range(6) if frames and same_frames(frames, small_frames(seed=n))]
    of_triggers = (
        [int(t) // 1000 for chunk in source.triggers() for t in chunk["t"]] if source.triggers else []
    )
    return of_events + of_frames + of_triggers


@pytest.mark.parametrize(
    ("streams", "read"),
    [
        ([("EVTS", LEFT), ("EVTS", RIGHT), ("FRME", RIGHT)], [1, 2]),
        ([("EVTS", LEFT), ("FRME", RIGHT), ("FRME", LEFT)], [0, 2]),
        ([("EVTS", LEFT), ("EVTS", RIGHT), ("FRME", LEFT), ("FRME", RIGHT)], [0, 2]),
        ([("TRIG", RIGHT), ("TRIG", LEFT), ("EVTS", LEFT), ("FRME", LEFT)], [2, 3, 1]),
        ([("TRIG", RIGHT), ("EVTS", LEFT), ("FRME", LEFT)], [1, 2]),
        ([("EVTS", "filtered"), ("EVTS", LEFT), ("FRME", LEFT)], [1, 2]),
    ],
)
def test_events_frames_and_triggers_are_of_one_camera(path, streams, read):
    path.write_bytes(file_of(streams))
    source = readers.read(path)
    assert contents(source) == read
    assert not any("taken for one" in sentence for sentence in source.missing)


def test_frames_of_another_camera_are_not_read(path):
    path.write_bytes(file_of([("EVTS", LEFT), ("FRME", RIGHT)]))
    source = readers.read(path)
    assert contents(source) == [0]
    assert source.count_frames() == 0
    assert source.missing == (
        "The frames are not read: they are of DAVIS346_00000002, another camera than DAVIS346_00000001 of the events.",
    )


def test_streams_that_were_renamed_are_paired_by_their_size(path):
    """Modules of DV that filter events or undistort frames may give their output a name of its own."""
    path.write_bytes(file_of([("TRIG", LEFT), ("EVTS", "dvsnoisefilter_1"), ("FRME", LEFT)]))
    source = readers.read(path)
    assert contents(source) == [1, 2, 0]
    assert source.missing == (
        "The events are of the source 'dvsnoisefilter_1', the frames of 'DAVIS346_00000001'; they are taken for one "
        "camera's.",
    )


# jAER


def jaer_events(events, height=SIZE[0]):
    """Events with rows from the bottom."""
    out = events.copy()
    out["y"] = height - 1 - out["y"]
    return out


def jaer_packet(frame, read=4_000):
    """A frame with rows from the bottom, whose fields for the exposure hold when reading its pixels begins and ends."""
    turned = np.ascontiguousarray(frame.image[::-1])
    stored = Frame(turned, frame.exposure_start - read, frame.exposure_end + read)
    return frame_packet(stored, kind=2, length=frame.exposure)


def jaer_frames(count=3, exposure=3_000):
    rng = np.random.default_rng(5)
    return [
        Frame(
            rng.integers(0, 900, SIZE, dtype=np.uint16), 50_000 + 20_000 * i, 50_000 + 20_000 * i + exposure
        )
        for i in range(count)
    ]


def jaer_file(frames, events=None, **options):
    packets = [(0, event_packet(jaer_events(small_events() if events is None else events)))]
    packets += [(1, jaer_packet(frame)) for frame in frames]
    return aedat4_file(packets, **{"module": "jAER", "camera": "Davis346B", **options})


def test_rows_of_jaer_are_counted_from_the_bottom(path):
    frames = jaer_frames()
    path.write_bytes(jaer_file(frames))
    source = readers.read(path)
    assert np.array_equal(all_events(source), small_events())
    for found, frame in zip(source.frames(), frames, strict=True):
        assert np.array_equal(found.image, frame.image)
        assert found.white == 1023
    assert source.mosaic is None


def test_an_event_of_jaer_that_lies_outside_stays_there(path):
    path.write_bytes(jaer_file([], make_events([5, 6], [3, 4], [SIZE[0] - 1, 0], [0, 1])))
    assert all_events(readers.read(path))["y"].tolist() == [SIZE[0] - 1, 0]
    outside = make_events([5], [3], [SIZE[0] + 2], [0])
    path.write_bytes(aedat4_file([(0, event_packet(outside))], module="jAER"))
    assert all_events(readers.read(path))["y"].tolist() == [SIZE[0] + 2]


def test_exposures_of_jaer_are_in_the_middle_of_the_readout(path):
    """Only their length is recorded: start and end are those of reading the pixels."""
    frames = jaer_frames()
    path.write_bytes(jaer_file(frames))
    source = readers.read(path)
    assert source.exposure_known
    assert [(f.exposure_start, f.exposure_end) for f in source.frames()] == [
        (f.exposure_start, f.exposure_end) for f in frames
    ]
    assert any("jAER" in text and "in the middle" in text for text in source.missing)
    path.write_bytes(jaer_file(jaer_frames(exposure=0)))
    source = readers.read(path)
    assert not source.exposure_known
    assert [(f.exposure_start, f.exposure_end) for f in source.frames()] == [
        (f.exposure_start, f.exposure_start) for f in frames
    ]


@pytest.mark.parametrize(
    ("camera", "mosaic", "said"),
    [("Davis346redColor", "RGGB", False), ("Davis128Color", "GRBG", False), ("CDAVIS", None, True)],
)
def test_frames_of_jaer_of_a_sensor_in_colour_are_its_mosaic(path, camera, mosaic, said):
    info = '<attr key="colorFilter" type="int">0</attr>'
    path.write_bytes(jaer_file(jaer_frames(), camera=camera, info=info))
    source = readers.read(path)
    assert source.mosaic == mosaic
    assert any("in no pattern that is known" in text for text in source.missing) == said


def test_frames_that_jaer_made_brighter_are_not_of_ten_bits(path):
    """It stretches frames of 8 bits, of other files, to 16."""
    path.write_bytes(jaer_file([Frame(np.full(SIZE, 200 << 8, np.uint16), 50_000, 51_000)]))
    assert [frame.white for frame in readers.read(path).frames()] == [None]


def test_damage_of_a_file_of_jaer_gives_clear_errors(path):
    assert_only_clear_errors(path, damaged(jaer_file(jaer_frames()), 300, header=900))


def test_16_bit_frames(path):
    image = np.arange(1200, dtype=np.uint16).reshape(SIZE) * 50
    path.write_bytes(aedat4_file([(1, frame_packet(Frame(image, 5, 9), kind=2))]))
    frame = next(readers.read(path).frames())
    assert frame.image.dtype == np.uint16
    assert np.array_equal(frame.image, image)


@pytest.mark.parametrize(
    ("kind", "dtype"), [(16, np.uint8), (24, np.uint8), (18, np.uint16), (26, np.uint16)]
)
def test_frames_in_colour_are_stored_as_bgr(path, kind, dtype):
    frames = colour_frames(dtype=dtype)
    packets = [(1, colour_packet(frame, kind)) for frame in frames]
    path.write_bytes(aedat4_file(packets))
    source = readers.read(path)
    assert same_frames(source.frames(), frames)
    assert source.mosaic is None


def test_colours_of_a_davis_are_those_of_its_mosaic(path):
    """Events of a colour DAVIS see the colour of their pixel, so frames get each pixel's own channel back."""
    frames = colour_frames()
    path.write_bytes(
        aedat4_file([(1, colour_packet(frame, 16)) for frame in frames], camera="DAVIS346_00000002")
    )
    recording = kalux.open(path)
    assert recording.mosaic == "RGGB"
    assert any("Bayer mosaic" in text and "--bayer none" in text for text in recording.source.missing)
    for frame, rgb in zip(recording.frames(), frames, strict=True):
        assert frame.mosaic == "RGGB"
        assert np.array_equal(frame.image[::2, ::2], rgb.image[::2, ::2, 0])
        assert np.array_equal(frame.image[::2, 1::2], rgb.image[::2, 1::2, 1])
        assert np.array_equal(frame.image[1::2, ::2], rgb.image[1::2, ::2, 1])
        assert np.array_equal(frame.image[1::2, 1::2], rgb.image[1::2, 1::2, 2])
    assert same_frames(recording.stored_frames(), frames)
    assert same_frames(kalux.open(path, mosaic="none").frames(), frames)


def test_unknown_pixel_types_are_refused(path):
    path.write_bytes(aedat4_file([(1, frame_packet(small_frames()[0], kind=5))]))
    with pytest.raises(FormatError, match="unknown pixel type 5"):
        list(readers.read(path).frames())


@pytest.mark.parametrize("place", [0, 250, 499])
def test_a_polarity_that_is_none_is_refused(path, place):
    content = bytearray(small_events().tobytes())
    content[16 * place + 12] = 2
    path.write_bytes(aedat4_file([(0, flatbuffer("EVTS", {0: ("vector", 500, bytes(content))}))]))
    with pytest.raises(FormatError, match="polarity is neither 0 nor 1"):
        list(readers.read(path).events())


def test_a_file_without_events_and_frames_is_refused(path):
    path.write_bytes(aedat4_file([], streams=[("IMUS", (0, 0))]))
    with pytest.raises(FormatError, match="neither events nor frames"):
        readers.read(path)


@pytest.mark.parametrize("closed", [True, False])
def test_a_file_cut_short_is_refused(path, closed):
    data = small_file(closed=closed)
    end = data.rindex(b"data table") if closed else len(data)
    first_packet = data.index(b"EVTS", data.index(b"</dv>"))
    for cut in (20, 200, first_packet, first_packet + 100, end // 2, end - 1):
        path.write_bytes(data[:cut])
        with pytest.raises(FormatError, match=str(path)):
            readers.read(path)


def test_a_file_cut_between_packets_is_refused(path):
    data = small_file()
    packet = len(frame_packet(small_frames()[-1])) + 8
    path.write_bytes(data[: data.rindex(b"data table") - packet])
    with pytest.raises(FormatError, match="cut short"):
        readers.read(path)


@pytest.mark.parametrize("compression", [0, 1, 3])
def test_damage_gives_clear_errors(path, compression):
    assert_only_clear_errors(path, damaged(small_file(compression=compression), 300, header=700))


def test_damage_of_colours_gives_clear_errors(path):
    packets = [(1, colour_packet(frame, 24)) for frame in colour_frames()]
    assert_only_clear_errors(path, damaged(aedat4_file(packets, camera="DAVIS346_1"), 300, header=700))


# Real files


@pytest.mark.parametrize(
    ("name", "size", "events", "frames", "exposure"),
    [
        ("street_davis346", (260, 346), 78_830, 59, 500),
        ("newton_davis346", (260, 346), 319_512, 13, 20_000),
        ("bench_davis346", (260, 346), 117_667, 3, 4_773),
        ("formats/dvxplorer", (240, 320), 111_954, 0, None),
    ],
)
def test_real_recordings(shared_data, name, size, events, frames, exposure):
    source = readers.read(shared_data / f"{name}.aedat4")
    assert (source.sensor_size, source.count_events(), source.count_frames()) == (size, events, frames)
    assert len(all_events(source)) == events
    assert {frame.exposure for frame in source.frames()} == ({exposure} if frames else set())
    assert bool(frames) != any("no frames" in sentence for sentence in source.missing)


def test_real_16_bit_frame(shared_data):
    frame = next(readers.read(shared_data / "formats" / "test_data_gray16.aedat4").frames())
    assert frame.image.tolist() == [[1, 2], [3, 1023]]
    assert (frame.exposure_start, frame.exposure_end) == (950, 1050)


@pytest.mark.parametrize("name", ["street_davis346", "newton_davis346"])
def test_agrees_with_dv_processing(shared_data, name):
    path = shared_data / f"{name}.aedat4"
    source = aedat4.read(path)
    theirs, images = read_by_dv_processing(path)
    assert np.array_equal(all_events(source), theirs)
    for frame, image in zip(source.frames(), images, strict=True):
        assert np.array_equal(frame.image, image.image)
        assert frame.exposure == image.exposure.total_seconds() * 1e6


def test_a_real_photograph_as_a_colour_davis_stores_it(shared_data, path):
    """A real payload, our writer: no recording of a colour DAVIS could be had."""
    picture = cv2.imread(str(shared_data / "hdr" / "Oxford_Church.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    raw = sample_mosaic(np.rint(255 * np.clip(4 * picture[300:560, 300:646], 0, 1)).astype(np.uint8), "RGGB")
    stored = Frame(cv2.cvtColor(raw, cv2.COLOR_BayerBG2RGB), 1_000, 9_000)
    events = make_events([0, 5_000], [3, 345], [259, 2], [1, 0])
    streams = (("EVTS", (260, 346)), ("FRME", (260, 346)))
    packets = [(0, event_packet(events)), (1, colour_packet(stored, 16))]
    path.write_bytes(aedat4_file(packets, streams=streams, compression=1, camera="DAVIS346_00000499"))
    frame = next(iter(kalux.open(path).frames()))
    # OpenCV leaves measured values as they are, but for the outermost rows and columns, which it repeats.
    assert np.array_equal(frame.image[1:-1, 1:-1], raw[1:-1, 1:-1])


def test_the_exposure_of_a_real_global_shutter_is_in_the_middle_of_the_readout(shared_data):
    """What the exposures of jAER are taken for, as a DAVIS346 states it in frames that have all four times."""
    path = shared_data / "street_davis346.aedat4"
    with path.open("rb") as file:
        container = aedat4._open(path, file)
    frames = next(stream for stream in container.streams if stream.kind == "FRME")
    for begin, end, start, stop in container.read(
        frames, lambda t: [t.scalar(n, "<q", 0) for n in (1, 2, 3, 4)]
    ):
        assert abs((begin + end) - (start + stop)) < 2 * 50
        assert end - stop > 9_000


@pytest.mark.parametrize("share", [0.001, 0.1, 0.5, 0.9, 0.99])
def test_a_real_file_cut_short_is_refused(shared_data, tmp_path, share):
    data = (shared_data / "street_davis346.aedat4").read_bytes()
    path = tmp_path / "cut.aedat4"
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(FormatError, match=r"cut\.aedat4"):
        readers.read(path)
