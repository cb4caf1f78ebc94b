"""The reader of ROS recordings.

No public recording with ``dvs_msgs`` and images was to be had, so such bags are written here, by the writers of
``rosbags`` and ``mcap`` after the public message definitions: "real payload, our writer" where the content is
that of a real recording. Bags with event packets are real ones.
"""

from __future__ import annotations

import builtins
import dataclasses
import struct
import tracemalloc

import cv2
import numpy as np
import pytest

import kalux
from kalux import readers
from kalux.errors import EventError, FormatError, InputError, MissingDependencyError
from kalux.events import make_events
from kalux.frames import Frame
from kalux.models.colour import sample_mosaic
from kalux.readers import CHUNK_EVENTS, evt3_packets, ros_bags
from kalux.readers.streams import rechunk
from kalux.recording import Recording
from recordings import (
    SIZE,
    all_events,
    assert_only_clear_errors,
    colour_frames,
    complaint,
    damaged,
    same_frames,
    small_events,
    small_frames,
)

rosbag1 = pytest.importorskip("rosbags.rosbag1")
mcap_writer = pytest.importorskip("mcap.writer")
rosbag2 = pytest.importorskip("rosbags.rosbag2")

HEIGHT, WIDTH = SIZE
EPOCH = 1_600_000_000_000_000_000  # ns


class Body:
    """A message, serialised as in ROS 1 or by CDR (ROS 2)."""

    def __init__(self, cdr):
        self.cdr, self.data = cdr, bytearray(b"\0\1\0\0" if cdr else b"")

    def number(self, code, value):
        if self.cdr:
            self.data += bytes((4 - len(self.data)) % struct.calcsize("<" + code))
        self.data += struct.pack("<" + code, value)
        return self

    def text(self, value):
        content = value.encode() + (b"\0" if self.cdr else b"")
        self.number("I", len(content)).data += content
        return self

    def blob(self, value):
        self.number("I", len(value)).data += value
        return self

    def header(self, ns):
        if not self.cdr:
            self.number("I", 7)
        return self.number("I", ns // 10**9).number("I", ns % 10**9).text("camera")


def event_array(events, cdr, size=SIZE):
    body = Body(cdr).header(EPOCH).number("I", size[0]).number("I", size[1]).number("I", len(events))
    for t, x, y, p in events.tolist():
        t_ns = EPOCH + 1000 * t + 999  # nanoseconds are cut off
        body.number("H", x).number("H", y).number("I", t_ns // 10**9).number("I", t_ns % 10**9).number("B", p)
    return bytes(body.data)


def packed_event_array(events, size=SIZE, epoch=EPOCH):
    """The same for ROS 1, for many events."""
    record = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
    records = np.empty(len(events), record)
    t = epoch + 1000 * events["t"]
    for name, column in zip(
        record.names, (events["x"], events["y"], t // 10**9, t % 10**9, events["p"]), strict=True
    ):
        records[name] = column
    body = Body(False).header(int(t[0])).number("I", size[0]).number("I", size[1]).number("I", len(events))
    return bytes(body.data) + records.tobytes()


def image(picture, ns, cdr, encoding="mono8", pad=0, big=False):
    rows = picture.astype(picture.dtype.newbyteorder(">" if big else "<"))
    rows = rows.view(np.uint8).reshape(len(picture), -1)
    rows = np.pad(rows, ((0, 0), (0, pad)))
    body = Body(cdr).header(ns).number("I", picture.shape[0]).number("I", picture.shape[1]).text(encoding)
    return bytes(body.number("B", big).number("I", rows.shape[1]).blob(rows.tobytes()).data)


def exposure(us, cdr):
    return bytes(Body(cdr).number("i", us).data)


def event_packet(encoding, content, stamp, time_base, cdr, size=SIZE, big=False, seq=3):
    body = Body(cdr).header(stamp).number("I", size[0]).number("I", size[1])
    body.number("Q", seq).number("Q", time_base).text(encoding).number("B", big)
    return bytes(body.blob(content).data)


DEFINITIONS = {
    "dvs_msgs/msg/EventArray": "Header header\nuint32 height\nuint32 width\nuint8[] events",
    "prophesee_event_msgs/msg/EventArray": "Header header\nuint32 height\nuint32 width\nuint8[] events",
    "dv_ros_msgs/msg/EventArray": "Header header\nuint32 height\nuint32 width\nuint8[] events",
    "dv_ros2_msgs/msg/EventArray": "Header header\nuint32 height\nuint32 width\nuint8[] events",
    "event_camera_msgs/msg/EventPacket": "uint8[] events",
    "other_msgs/msg/EventArray": "uint8[] events",
    "other_msgs/msg/CompressedEventsMsg": "uint8[] events",
    "rcl_interfaces/msg/ParameterEvent": "uint8[] events",
    "event_array_msgs/msg/EventArray": "uint8[] events",
    "sensor_msgs/msg/Image": "uint8[] data",
    "sensor_msgs/msg/CompressedImage": "uint8[] data",
    "std_msgs/msg/Int32": "int32 data",
}


def write_bag1(path, messages, compression=None):
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(compression)
    with writer:
        connections = {}
        for time, topic, kind, data in messages:
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(
                    topic, kind, msgdef=DEFINITIONS[kind], md5sum="0" * 32
                )
            writer.write(connections[topic, kind], time, data)


def write_db3(path, messages, compression=None):
    writer = rosbag2.Writer(path, version=8)
    if compression:
        writer.set_compression(rosbag2.CompressionMode.MESSAGE, rosbag2.CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for time, topic, kind, data in messages:
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(
                    topic, kind, msgdef="uint8 data", rihs01="RIHS01_" + "0" * 64
                )
            writer.write(connections[topic, kind], time, data)


def write_mcap(path, messages, compression=None, chunks=True, encoding="cdr"):
    with path.open("wb") as file:
        writer = mcap_writer.Writer(file, chunk_size=20_000, use_chunking=chunks)
        writer.start(profile="ros1" if encoding == "ros1" else "ros2")
        channels = {}
        for time, topic, kind, data in messages:
            if (topic, kind) not in channels:
                kind_there = kind.replace("/msg/", "/") if encoding == "ros1" else kind
                schema = writer.register_schema(kind_there, f"{encoding}msg", b"")
                channels[topic, kind] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic, kind], log_time=time, publish_time=time, data=data)
        writer.finish()


CONTAINERS = {"bag": (write_bag1, False), "db3": (write_db3, True), "mcap": (write_mcap, True)}


def davis_messages(
    cdr, events=None, frames=None, kind="dvs_msgs/msg/EventArray", exposures=True, prefix="/dvs"
):
    """What the DAVIS driver publishes: images are stamped with their middle, exposures follow at once."""
    events = small_events() if events is None else events
    messages = []
    for part in np.array_split(events, 7):
        if len(part):
            data = event_array(part, cdr)
            messages.append((EPOCH + 1000 * int(part["t"][-1]) + 5_000_000, f"{prefix}/events", kind, data))
    for frame in small_frames() if frames is None else frames:
        # recorded some time after it was taken
        recorded = EPOCH + 1000 * frame.exposure_end + 4_000_000
        picture = image(frame.image, EPOCH + 1000 * frame.middle, cdr)
        messages.append((recorded, f"{prefix}/image_raw", "sensor_msgs/msg/Image", picture))
        if exposures:
            data = exposure(frame.exposure, cdr)
            messages.append((recorded + 90_000, f"{prefix}/exposure", "std_msgs/msg/Int32", data))
    return sorted(messages, key=lambda message: message[0])


def shifted(events, us=EPOCH // 1000):
    out = events.copy()
    out["t"] += us
    return out


def shifted_frames(frames, us=EPOCH // 1000):
    return [Frame(f.image, f.exposure_start + us, f.exposure_end + us, f.white) for f in frames]


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize(
    "kind",
    [
        "dvs_msgs/msg/EventArray",
        "dv_ros_msgs/msg/EventArray",
        "dv_ros2_msgs/msg/EventArray",
        "prophesee_event_msgs/msg/EventArray",
    ],
)
def test_reads_what_was_written(tmp_path, container, kind):
    write, cdr = CONTAINERS[container]
    path = tmp_path / f"recording.{container}"
    write(path, davis_messages(cdr, kind=kind))
    source = readers.read(path)
    assert (source.format, source.sensor_size, source.exposure_known) == ("ros", SIZE, True)
    assert source.missing == ()
    for _ in range(2):
        assert np.array_equal(all_events(source), shifted(small_events()))
        assert same_frames(source.frames(), shifted_frames(small_frames()))
    assert (source.count_events(), source.count_frames()) == (500, 4)


@pytest.mark.parametrize("kind", ["other_msgs/msg/EventArray", "other_msgs/msg/CompressedEventsMsg"])
def test_topics_that_seem_to_hold_events_are_named(tmp_path, kind):
    """A recording is not said to have no events where it only has some of an unknown type."""
    path = tmp_path / "recording.bag"
    others = [(EPOCH, "/odd/events", kind, b"odd"), (EPOCH, "/p", "rcl_interfaces/msg/ParameterEvent", b"")]
    images = [message for message in davis_messages(False) if message[2] == "sensor_msgs/msg/Image"]
    write_bag1(path, [*others, *images])
    missing = readers.read(path).missing
    assert missing[0] == f"Other topics are not read: /odd/events ({kind.replace('/msg/', '/')})."
    assert "The recording has no events." not in missing
    assert any(
        "no events that kalux reads; known are dvs_msgs/EventArray" in sentence for sentence in missing
    )
    write_bag1(tmp_path / "both.bag", [*others, *davis_messages(False)])
    assert "/odd/events" in readers.read(tmp_path / "both.bag").missing[0]


@pytest.mark.parametrize("compression", ["BZ2", "LZ4"])
def test_compressed_bags(tmp_path, compression):
    path = tmp_path / "recording.bag"
    write_bag1(path, davis_messages(False), rosbag1.Writer.CompressionFormat[compression])
    assert np.array_equal(all_events(readers.read(path)), shifted(small_events()))


def test_messages_compressed_one_by_one(tmp_path):
    path = tmp_path / "recording"
    write_db3(path, davis_messages(True), "zstd")
    assert np.array_equal(all_events(readers.read(path)), shifted(small_events()))


@pytest.mark.parametrize("chunks", [True, False])
def test_mcap_is_not_loaded_as_a_whole(tmp_path, chunks):
    path = tmp_path / "recording.mcap"
    content = np.random.default_rng(0).integers(0, 256, (1000, 1000), dtype=np.uint8)
    messages = [(i, "/image", "sensor_msgs/msg/Image", image(content, i, True)) for i in range(1, 31)]
    write_mcap(path, messages, chunks=chunks)
    source = readers.read(path)
    tracemalloc.start()
    assert sum(1 for _ in source.frames()) == 30
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6  # frames held back to order them included


def test_an_mcap_that_was_made_of_a_ros_1_bag_is_read(tmp_path):
    """As 'mcap convert' makes it: with the messages of the bag."""
    path = tmp_path / "recording.mcap"
    write_mcap(path, davis_messages(False), encoding="ros1")
    source = readers.read(path)
    assert np.array_equal(all_events(source), shifted(small_events()))
    assert same_frames(source.frames(), shifted_frames(small_frames()))


def test_an_mcap_with_messages_of_others_than_ros_is_refused(tmp_path):
    path = tmp_path / "recording.mcap"
    write_mcap(path, davis_messages(False), encoding="protobuf")
    with pytest.raises(FormatError, match="neither events nor images, but no topics of ROS messages"):
        readers.read(path)


def test_files_compressed_as_a_whole_are_refused(tmp_path):
    (tmp_path / "recording_0.db3.zstd").write_bytes(b"\x28\xb5\x2f\xfd")
    with pytest.raises(FormatError, match="zstd -d"):
        readers.read(tmp_path)


def test_a_folder_of_several_files_is_one_recording(tmp_path):
    folder = tmp_path / "recording"
    folder.mkdir()
    messages = davis_messages(True)
    cut = len(messages) // 11
    for part in range(12):
        last = len(messages) if part == 11 else (part + 1) * cut
        write_mcap(folder / f"recording_{part}.mcap", messages[part * cut : last])
    source = readers.read(folder)
    assert np.array_equal(all_events(source), shifted(small_events()))
    assert same_frames(source.frames(), shifted_frames(small_frames()))
    assert source.count_frames() == 4


def test_small_messages_are_joined_and_large_ones_split(tmp_path):
    path = tmp_path / "recording.bag"
    many = np.repeat(small_events(1), 2 * CHUNK_EVENTS + 10)
    message = (1, "/events", "dvs_msgs/msg/EventArray", packed_event_array(many))
    write_bag1(path, [message, (2, *message[1:3], packed_event_array(many[:3]))])
    assert [len(chunk) for chunk in readers.read(path).events()] == [CHUNK_EVENTS, CHUNK_EVENTS, 13]
    assert sum(map(len, rechunk([many]))) == len(many)


# Images and exposures


@pytest.mark.parametrize("cdr", [False, True])
def test_images_of_16_bits_padded_and_big_endian(tmp_path, cdr):
    path = tmp_path / "recording.mcap" if cdr else tmp_path / "recording.bag"
    pictures = [np.arange(1200, dtype=np.uint16).reshape(SIZE) * 50 + k for k in range(3)]
    contents = [
        image(pictures[0], EPOCH, cdr, "mono16"),
        image(pictures[1], EPOCH + 10**6, cdr, "16UC1", pad=6),
        image(pictures[2], EPOCH + 2 * 10**6, cdr, "mono16", big=True),
    ]
    messages = [(EPOCH + i, "/image", "sensor_msgs/msg/Image", data) for i, data in enumerate(contents)]
    (write_mcap if cdr else write_bag1)(path, messages)
    source = readers.read(path)
    assert not source.exposure_known
    assert any("no events" in sentence for sentence in source.missing)
    for frame, picture in zip(source.frames(), pictures, strict=True):
        assert frame.image.dtype == np.uint16
        assert np.array_equal(frame.image, picture)


def test_compressed_images(tmp_path):
    path = tmp_path / "recording.bag"
    messages = []
    for frame in small_frames():
        png = cv2.imencode(".png", frame.image)[1].tobytes()
        data = bytes(Body(False).header(EPOCH + 1000 * frame.middle).text("png").blob(png).data)
        recorded = EPOCH + 1000 * frame.exposure_end
        messages.append((recorded, "/dvs/image_raw/compressed", "sensor_msgs/msg/CompressedImage", data))
        messages.append(
            (recorded + 1, "/dvs/exposure", "std_msgs/msg/Int32", exposure(frame.exposure, False))
        )
    write_bag1(path, messages)
    source = readers.read(path)
    assert source.exposure_known
    assert same_frames(source.frames(), shifted_frames(small_frames()))


@pytest.mark.parametrize("topic", ["/dvs/events", "/dvs/image_raw", "/dvs/exposure"])
def test_a_message_of_another_serialisation_is_damage(tmp_path, topic):
    """Also the first of a topic, which tells what it holds."""
    messages = [
        (time, name, kind, b"\0\0" + data[2:] if name == topic else data)
        for time, name, kind, data in davis_messages(True)
    ]
    write_mcap(tmp_path / "a.mcap", messages)
    with pytest.raises(FormatError, match=rf"topic '{topic}': damaged .*not serialised as little-endian CDR"):
        readers.read(tmp_path / "a.mcap")


def test_an_exposure_that_was_recorded_beyond_the_end_of_time_is_damage(tmp_path):
    messages = davis_messages(True)
    place = next(i for i, message in enumerate(messages) if message[1] == "/dvs/exposure")
    messages[place] = (1 << 63, *messages[place][1:])
    write_mcap(tmp_path / "recording.mcap", messages)
    with pytest.raises(FormatError, match="'/dvs/exposure': damaged"):
        readers.read(tmp_path / "recording.mcap")


def test_unknown_exposure_is_said(tmp_path):
    path = tmp_path / "recording.bag"
    write_bag1(path, davis_messages(False, exposures=False))
    source = readers.read(path)
    assert not source.exposure_known
    assert "exposure times" in source.missing[-1]
    assert [(f.exposure_start, f.exposure_end) for f in source.frames()] == [
        (EPOCH // 1000 + f.middle, EPOCH // 1000 + f.middle) for f in small_frames()
    ]


def test_exposures_are_those_recorded_nearest_to_the_images(tmp_path):
    # The first exposure of a recording may be missing, and the last image.
    path = tmp_path / "recording.bag"
    messages = davis_messages(False)
    first = next(m for m in messages if m[1] == "/dvs/exposure")
    last = [m for m in messages if m[1] == "/dvs/image_raw"][-1]
    write_bag1(path, [m for m in messages if m not in (first, last)])
    assert [f.exposure for f in readers.read(path).frames()] == [3001, 3001, 3002]


def test_late_images_are_put_in_order(tmp_path):
    path = tmp_path / "recording.bag"
    messages = davis_messages(False, exposures=False)
    images = [m for m in messages if "image" in m[1]]
    swapped = [(EPOCH + i, *m[1:]) for i, m in enumerate([images[1], images[0], *images[2:]])]
    write_bag1(path, swapped)
    middles = [f.exposure_start for f in readers.read(path).frames()]
    assert middles == sorted(middles)


def image_messages(images, encoding, topic="/dvs/image_raw"):
    """Events and exposures of the DAVIS driver with these images, each flattened to rows."""
    others = [m for m in davis_messages(False) if "image" not in m[1]]
    pictures = [picture.reshape(len(picture), -1) for picture in images]
    frames = zip(small_frames(), pictures, strict=True)
    return others + [
        (
            EPOCH + 1000 * frame.exposure_end + 4_000_000,
            topic,
            "sensor_msgs/msg/Image",
            widened(image(picture, EPOCH + 1000 * frame.middle, False, encoding), SIZE[1]),
        )
        for frame, picture in frames
    ]


def widened(message, width):
    """The message with another width: `image` takes that of the flattened rows."""
    at = message.index(struct.pack("<I", SIZE[0])) + 4
    return message[:at] + struct.pack("<I", width) + message[at + 4 :]


@pytest.mark.parametrize(
    ("encoding", "order", "dtype"),
    [
        ("rgb8", "rgb", "u1"),
        ("bgr8", "bgr", "u1"),
        ("rgba8", "rgba", "u1"),
        ("bgra16", "bgra", "<u2"),
        ("rgb16", "rgb", "<u2"),
    ],
)
def test_images_in_colour(tmp_path, encoding, order, dtype):
    path = tmp_path / "recording.bag"
    frames = colour_frames(dtype=np.dtype(dtype).type)
    stored = [np.stack([f.image[..., "rgba".index(c) % 3] for c in order], axis=-1) for f in frames]
    write_bag1(path, image_messages(stored, encoding, "/dvs/image_color"))
    source = readers.read(path)
    assert (source.sensor_size, source.mosaic) == (SIZE, None)
    assert same_frames(source.frames(), shifted_frames(frames))


@pytest.mark.parametrize("mosaic", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_raw_mosaics_say_their_pattern(tmp_path, mosaic, bits):
    path = tmp_path / "recording.bag"
    frames = [
        dataclasses.replace(f, image=f.image.astype(f"u{bits // 8}") << (bits - 8)) for f in small_frames()
    ]
    write_bag1(path, image_messages([f.image for f in frames], f"bayer_{mosaic}{bits}"))
    recording = kalux.open(path)
    assert recording.mosaic == mosaic.upper()
    assert [f.mosaic for f in recording.frames()] == [mosaic.upper()] * 4
    assert same_frames(recording.frames(), shifted_frames(frames))


def test_colour_made_of_a_mosaic_gives_pixels_their_channel_back(tmp_path):
    """As in CED: /dvs/image_color was demosaiced, its events see the colours of a DAVIS346; the bag does not say so."""
    path = tmp_path / "recording.bag"
    frames = colour_frames()
    write_bag1(path, image_messages([f.image for f in frames], "rgb8", "/dvs/image_color"))
    image_of = next(iter(kalux.open(path, mosaic="RGGB").frames())).image
    assert np.array_equal(image_of, sample_mosaic(frames[0].image, "RGGB"))


def test_unknown_encodings_are_refused_but_events_can_be_had(tmp_path):
    path = tmp_path / "recording.bag"
    write_bag1(path, image_messages([f.image for f in small_frames()], "yuv422"))
    with pytest.raises(FormatError, match=r"'yuv422'; known are mono8.*bayer_rggb8.*frames="):
        readers.read(path)
    source = readers.read(f"{path}?frames=")
    assert source.count_frames() == 0
    assert np.array_equal(all_events(source), shifted(small_events()))


@pytest.mark.parametrize(
    ("form", "red_first"),
    [
        ("png", False),
        ("", False),
        ("rgb8; png compressed bgr8", False),
        ("rgb8; png compressed", False),
        ("rgb8; png compressed rgb8", True),
        ("bgr8; png compressed rgb8", True),
    ],
)
def test_compressed_images_in_colour(tmp_path, form, red_first):
    """The first may be black, and is in colour like the others. OpenCV writes red and blue as it gets them."""
    path = tmp_path / "recording.bag"
    frames = colour_frames()
    frames[0] = dataclasses.replace(frames[0], image=np.zeros_like(frames[0].image))
    messages = []
    for frame in frames:
        png = cv2.imencode(".png", frame.image if red_first else frame.image[..., ::-1])[1].tobytes()
        data = bytes(Body(False).header(EPOCH + 1000 * frame.middle).text(form).blob(png).data)
        messages.append(
            (EPOCH + 1000 * frame.middle, "/c/compressed", "sensor_msgs/msg/CompressedImage", data)
        )
    write_bag1(path, messages)
    for found, frame in zip(readers.read(path).frames(), frames, strict=True):
        assert np.array_equal(found.image, frame.image)


@pytest.mark.parametrize(
    ("form", "mosaic"),
    [
        ("bayer_rggb8; png compressed ", "RGGB"),
        ("bayer_gbrg16; png compressed", "GBRG"),
        ("mono8; png compressed ", None),
        ("png", None),
    ],
)
def test_compressed_mosaics_say_their_pattern(tmp_path, form, mosaic):
    path = tmp_path / "recording.bag"
    picture = small_frames()[0].image.astype(np.uint16 if "16" in form else np.uint8)
    png = cv2.imencode(".png", picture)[1].tobytes()
    data = bytes(Body(False).header(EPOCH).text(form).blob(png).data)
    write_bag1(path, [(EPOCH, "/c/compressed", "sensor_msgs/msg/CompressedImage", data)])
    recording = kalux.open(path)
    assert recording.mosaic == mosaic
    assert np.array_equal(next(iter(recording.stamped_frames())).image, picture)


def test_drawings_of_events_alone_are_no_frames_unless_asked_for(tmp_path):
    path = tmp_path / "recording.bag"
    write_bag1(path, image_messages([f.image for f in colour_frames()], "bgr8", "/dvs_rendering"))
    assert readers.read(path).count_frames() == 0
    assert readers.read(f"{path}?frames=/dvs_rendering").count_frames() == 4


def test_colour_drawings_of_events_do_not_stand_in_the_way(tmp_path):
    path = tmp_path / "recording.bag"
    colour = image(np.zeros((30, 120), np.uint8), EPOCH, False, "bgr8")
    drawing = (EPOCH, "/dvs_rendering", "sensor_msgs/msg/Image", colour)
    write_bag1(path, [drawing, *davis_messages(False)])
    source = readers.read(path)
    assert source.count_frames() == 4
    assert source.missing == ("Other topics are not read: /dvs_rendering.",)


# Topics


def test_of_several_topics_the_only_pair_of_equal_size_is_read(tmp_path):
    path = tmp_path / "recording.bag"
    big = image(np.zeros((60, 80), np.uint8), EPOCH, False)
    messages = [*davis_messages(False), (EPOCH, "/rgb/image_raw", "sensor_msgs/msg/Image", big)]
    write_bag1(path, messages)
    source = readers.read(path)
    assert source.count_frames() == 4
    assert "/rgb/image_raw" in source.missing[0]


def test_several_pairs_need_a_choice(tmp_path):
    path = tmp_path / "recording.bag"
    left = davis_messages(False, prefix="/left")
    right = davis_messages(False, small_events(seed=5), small_frames(3), prefix="/right")
    write_bag1(path, sorted([*left, *right], key=lambda message: message[0]))
    with pytest.raises(InputError, match=r"/left/events \(40x30\).*recording.bag\?events="):
        readers.read(path)
    source = readers.read(f"{path}?events=/right/events&frames=/right/image_raw")
    assert np.array_equal(all_events(source), shifted(small_events(seed=5)))
    assert same_frames(source.frames(), shifted_frames(small_frames(3)))
    assert Recording(source).source.path == path
    # another camera's exposures, if asked for; or none
    source = readers.read(f"{path}?events=/right/events&frames=/right/image_raw&exposure=/left/exposure")
    assert source.exposure_known
    assert not readers.read(f"{path}?events=/left/events&frames=/left/image_raw&exposure=").exposure_known


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ("events=/nothing", "no topic '/nothing'; its topics are /dvs/events"),
        ("events=/dvs/exposure", "no events"),
        ("frames=/dvs/events", "no frames"),
        ("exposure=/dvs/events", "no exposure times"),
        ("topic=/dvs/events", "'topic' cannot be chosen"),
    ],
)
def test_a_choice_that_cannot_be_is_said(tmp_path, choice, message):
    path = tmp_path / "recording.bag"
    write_bag1(path, davis_messages(False))
    with pytest.raises(InputError, match=message):
        readers.read(f"{path}?{choice}")


def test_a_choice_in_another_format_is_refused(tmp_path):
    path = tmp_path / "recording.raw"
    path.write_bytes(b"% evt 3.0\n% geometry 40x30\n")
    with pytest.raises(InputError, match="nothing can be chosen"):
        readers.read(f"{path}?events=/a")


def test_topics_of_different_size_need_a_choice(tmp_path):
    path = tmp_path / "recording.bag"
    big = image(np.zeros((60, 80), np.uint8), EPOCH, False)
    messages = [m for m in davis_messages(False) if m[1] == "/dvs/events"]
    write_bag1(path, [*messages, (EPOCH, "/image", "sensor_msgs/msg/Image", big)])
    with pytest.raises(InputError, match=r"no two topics.*/image \(80x60\)"):
        readers.read(path)
    assert readers.read(f"{path}?frames=").count_events() == 500
    assert readers.read(f"{path}?events=").count_frames() == 1


def test_a_bag_without_events_and_images_is_refused(tmp_path):
    path = tmp_path / "recording.bag"
    write_bag1(path, [(1, "/a", "std_msgs/msg/Int32", exposure(1, False))])
    with pytest.raises(FormatError, match="neither events nor images, but std_msgs/Int32"):
        readers.read(path)


# Event packets


def mono(events):
    e = {name: events[name].astype(np.uint64) for name in "xyp"}
    dt = ((events["t"] - events["t"][0]) * 1000).astype(np.uint64)
    return (
        (dt | e["x"] << np.uint64(32) | e["y"] << np.uint64(48) | e["p"] << np.uint64(63))
        .astype("<u8")
        .tobytes()
    )


def libcaer(events):
    place = (
        events["p"].astype("<u4") << 1 | events["y"].astype("<u4") << 2 | events["x"].astype("<u4") << 17 | 1
    )
    return np.stack([place, (events["t"] & 0x7FFFFFFF).astype("<u4")], axis=1).tobytes()


def libcaer_compressed(events):
    """Without vectors, but for one event in two; times count from the first event."""
    words, high, low = [], 0, 0
    for i, (t, x, y, p) in enumerate(events.tolist()):
        t -= int(events["t"][0])
        if t >> 12 != high:
            high = t >> 12
            words.append(high)
        if t & 0xFFF != low:
            low = t & 0xFFF
            words.append(0x1000 | low)
        words.append(0x2000 | x)
        if i % 2:
            words.append(0x3000 | int(p) << 11 | y)
        else:
            words += [0x4000 | int(p) << 11 | y & ~7, 0x5000 | 1 << (y & 7)]
    return np.array(words, "<u2").tobytes()


@pytest.mark.parametrize("cdr", [False, True])
@pytest.mark.parametrize("encoding", ["mono", "libcaer", "libcaer_cmp"])
@pytest.mark.parametrize("kind", ["event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray"])
def test_event_packets(tmp_path, cdr, encoding, kind):
    path = tmp_path / ("recording.mcap" if cdr else "recording.bag")
    messages = []
    for part in np.array_split(small_events(), 7):
        first = int(part["t"][0])
        stamp = EPOCH + 1000 * first
        if encoding == "mono":  # counts from when the sensor was started
            packet = event_packet("mono", mono(part), stamp, 5000 + 1000 * first, cdr)
        elif encoding == "libcaer":
            packet = event_packet("libcaer", libcaer(part), stamp + 12345, EPOCH, cdr)
        else:
            packet = event_packet("libcaer_cmp", libcaer_compressed(part), stamp + 12345, stamp, cdr)
        messages.append((stamp, "/events", kind, packet))
    (write_mcap if cdr else write_bag1)(path, messages)
    source = readers.read(path)
    assert np.array_equal(all_events(source), shifted(small_events()))
    assert source.count_events() == 500
    assert source.triggers is None


def test_libcaer_times_go_on_where_they_wrap_around_within_a_packet(tmp_path):
    path = tmp_path / "recording.bag"
    t = np.array([(1 << 31) - 2, (1 << 31) - 1, 1 << 31, (1 << 31) + 5])
    events = make_events(t, [1, 2, 3, 4], [5, 6, 7, 8], [0, 1, 0, 1])
    packet = event_packet("libcaer", libcaer(events), EPOCH, EPOCH, False)
    write_bag1(path, [(1, "/events", "event_camera_msgs/msg/EventPacket", packet)])
    assert np.array_equal(all_events(readers.read(path)), shifted(events))


def packets(path, *contents):
    messages = [
        (i + 1, "/events", "event_camera_msgs/msg/EventPacket", content) for i, content in enumerate(contents)
    ]
    write_bag1(path, messages)
    return path


def test_evt3_packets_are_one_stream_and_times_those_of_ros(tmp_path):
    words = np.array([0x2001, 0x8001, 0x6005, 0x0003, 0x2002, 0x6007, 0xA101, 0x2804], "<u2").tobytes()
    parts = [words[:8], words[8:12], words[12:]]
    path = packets(
        tmp_path / "recording.bag",
        *(event_packet("evt3", part, EPOCH + 9_000 * i, 0, False) for i, part in enumerate(parts)),
    )
    source = readers.read(path)
    start = EPOCH // 1000  # the stamp of the first packet is that of its first time
    assert all_events(source).tolist() == [(start, 2, 3, False), (start + 2, 4, 3, True)]
    assert [chunk.tolist() for chunk in source.triggers()] == [[(start + 2, 1, True)]]


def evt3(t, *words):
    """Words after those that state a time, us."""
    return np.array([0x8000 | t >> 12 & 0xFFF, 0x6000 | t & 0xFFF, *words], "<u2").tobytes()


EVENT = (0x0003, 0x2802)  # at x = 2, y = 3


def evt3_times(path, parts):
    """Times of the events, after EPOCH, us. Parts: (stamp after EPOCH in us, words), perhaps with a number."""
    packed = [
        event_packet("evt3", content, EPOCH + 1000 * stamp, 0, False, seq=number[0] if number else 3)
        for stamp, content, *number in parts
    ]
    return (all_events(readers.read(packets(path, *packed)))["t"] - EPOCH // 1000).tolist()


def test_the_stamp_of_an_evt3_packet_is_that_of_its_first_time(tmp_path):
    """As event_camera_codecs has it. The first events may come much later, as with a cap on the lens."""
    dark = [(100 * k, evt3(1_000_000 + 100 * k)) for k in range(5)]
    late = (500, evt3(1_000_500, 0xA101, 0x6000 | (1_000_600 & 0xFFF), *EVENT))
    assert evt3_times(tmp_path / "recording.bag", [*dark, late]) == [600]


def test_a_time_high_without_a_time_low_is_a_time(tmp_path):
    high = [np.array([0x8000 | k, 0x2001], "<u2").tobytes() for k in (7, 8)]
    parts = [(0, high[0]), (4096, high[1]), (4098, evt3((8 << 12) + 3, *EVENT))]
    assert evt3_times(tmp_path / "recording.bag", parts) == [4099]


WRAP = 1 << 24  # us


@pytest.mark.parametrize("numbered", [True, False])
@pytest.mark.parametrize("joined", [1, 20, 1 << 16])
@pytest.mark.parametrize("gap", [9_000_000, WRAP - 1, WRAP, 20_000_000, 3 * WRAP + 5, 3_600_000_000])
def test_stamps_tell_the_time_after_a_gap(tmp_path, monkeypatch, gap, joined, numbered):
    """EVT3 states times only to 16.8 s. Stamps are not exact; drivers may give all packets the same number."""
    monkeypatch.setattr(evt3_packets, "_JOINED_WORDS", joined)
    times = [0, 10_000, 20_000, gap + 20_000, gap + 30_000]
    parts = [
        (t + late, evt3(12_000_000 + t, *EVENT), 10 * k if numbered else 3)
        for k, (t, late) in enumerate(zip(times, (0, 3000, -3000, 200_000, 3000), strict=True))
    ]
    assert evt3_times(tmp_path / "recording.bag", parts) == times


def test_clocks_may_drift(tmp_path):
    """By a thousandth, over 100 s."""
    times = list(range(0, 100_000_000, 1_000_000))
    parts = [(t + t // 1000, evt3(5 + t, *EVENT)) for t in times]
    assert evt3_times(tmp_path / "recording.bag", parts) == times


@pytest.mark.parametrize(
    ("parts", "stamp"),
    [
        # the sensor's clock begins anew
        ([(0, evt3(12_000_000)), (10_000, evt3(12_010_000)), (3_000_000, evt3(5_000))], "1600000003.000"),
        # so it does, as the numbers show, though it fits the stamps
        ([(0, evt3(0), 0), (10_000, evt3(10_000), 1), (WRAP, evt3(5_000), 0)], "1600000016.777"),
        # the computer's clock was set
        ([(0, evt3(0), 0), (2_010_000, evt3(10_000), 1)], "1600000002.010"),
    ],
)
@pytest.mark.parametrize("joined", [1, 1 << 16])
def test_a_clock_that_begins_anew_is_refused(tmp_path, monkeypatch, parts, stamp, joined):
    monkeypatch.setattr(evt3_packets, "_JOINED_WORDS", joined)
    with pytest.raises(FormatError, match=rf"'/events': the packet of {stamp} s .* cut the recording there"):
        evt3_times(tmp_path / "recording.bag", parts)


@pytest.mark.parametrize("joined", [1, 1 << 16])
def test_after_lost_packets_row_column_and_time_are_unknown_until_stated(tmp_path, monkeypatch, joined):
    monkeypatch.setattr(evt3_packets, "_JOINED_WORDS", joined)
    contents = [
        (0, evt3(0, 0x0003, 0x2802, 0x3004), 7),  # an event, and where a vector begins
        (1, np.array([0x5001, 0x2802], "<u2").tobytes(), 8),
        # Some are lost. The first words are of an unknown time.
        (9, np.array([0x6008, 0x0005, 0x2802], "<u2").tobytes(), 12),
        (20, np.array([0x2802, 0x6013], "<u2").tobytes() + evt3(20, 0x2802, 0x0006, 0x5001, 0x2803), 13),
        (30, evt3(30, 0x3005, 0x5003, 0x2802), 14),
    ]
    packed = [event_packet("evt3", c, EPOCH + 1000 * t, 0, False, seq=seq) for t, c, seq in contents]
    source = readers.read(packets(tmp_path / "recording.bag", *packed))
    found = [(t - EPOCH // 1000, x, y) for t, x, y, _ in all_events(source).tolist()]
    assert found == [(0, 2, 3), (0, 4, 3), (0, 2, 3), (20, 3, 6), (30, 5, 6), (30, 6, 6), (30, 2, 6)]
    assert source.count_events() == 7


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ([5, 6, 7, 8, 9], None),
        ([5, 6, 9, 10, 14, 15, 16], (5, 2)),
        ([0, 0, 0, 0], None),  # as written by programs that do not count
        ([1, 9, 2, 10, 3, 11], None),  # of two publishers
        ([7, 8, 9, 0, 1, 2], None),  # begun anew
        ([2, 4, 6, 8], None),  # one that counts otherwise
    ],
)
def test_numbers_of_packets_tell_what_is_lost(tmp_path, numbers, lost):
    """Those of an EventPacket, and those of headers in ROS 1; headers of ROS 2 have none."""
    contents = [evt3(10 * k, 0x0003, 0x2802) for k in range(len(numbers))]
    packed = [
        event_packet("evt3", content, EPOCH + 10_000 * k, 0, False, seq=number)
        for k, (content, number) in enumerate(zip(contents, numbers, strict=True))
    ]
    arrays = []
    for k, number in enumerate(numbers):
        data = packed_event_array(small_events()[k : k + 1], epoch=EPOCH + 10_000_000 * k)
        arrays.append(number.to_bytes(4, "little") + data[4:])
    start = EPOCH // 1000
    found = readers.read(packets(tmp_path / "packets.bag", *packed)).lost(0, start + 1000)
    assert found == (None if lost is None else (lost[0], start + 10 * lost[1]))
    path = tmp_path / "arrays.bag"
    write_bag1(
        path, [(k + 1, "/dvs/events", "dvs_msgs/msg/EventArray", data) for k, data in enumerate(arrays)]
    )
    of_arrays = readers.read(path).lost
    assert (of_arrays(0, 2**60) or (None,))[0] == (None if lost is None else lost[0])
    assert of_arrays(0, 0) is None
    if lost is not None:
        assert readers.read(tmp_path / "packets.bag").lost(0, start + 30).packets == 2
        # Before frames begin, nothing is missing in images.
        assert readers.read(tmp_path / "packets.bag").lost(start + 30, start + 1000) == (3, start + 40)
        assert of_arrays(2**59, 2**60) is None


def test_arrays_that_are_not_stamped_are_as_late_as_their_events(tmp_path):
    """Some drivers leave stamps 0: what is lost was before the recording then, and so it was though all was later."""
    arrays = []
    for k, number in enumerate([5, 6, 9, 10, 11]):
        data = packed_event_array(small_events()[k : k + 1], epoch=EPOCH + 10_000_000 * k)
        arrays.append(number.to_bytes(4, "little") + bytes(8) + data[12:])
    path = tmp_path / "arrays.bag"
    write_bag1(
        path, [(k + 1, "/dvs/events", "dvs_msgs/msg/EventArray", data) for k, data in enumerate(arrays)]
    )
    source = readers.read(path)
    times = [t for t, *_ in all_events(source).tolist()]
    assert source.lost(0, times[-1]) == (2, times[2])
    assert source.lost(0, times[1]) is None


def test_a_late_packet_that_goes_back_too_far_is_refused(tmp_path):
    parts = [(100_000, evt3(100_000, *EVENT), 8), (0, evt3(0, *EVENT), 7)]
    with pytest.raises(FormatError, match="clock goes back from 100000 to 0 us"):
        evt3_times(tmp_path / "recording.bag", parts)


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (event_packet("evt3", b"\0\0\0", EPOCH, 0, False), "damaged"),
        (event_packet("mono", b"", EPOCH, 0, False), "encoding changes"),
        (event_packet("evt3", b"", EPOCH, 0, False, size=(3, 4)), "encoding changes"),
        (event_packet("evt3", b"", EPOCH, 0, False, big=True), "big-endian"),
    ],
)
def test_packets_that_do_not_follow_are_refused(tmp_path, second, message):
    first = event_packet("evt3", b"\x01\x80\x01\x00\x01\x20", EPOCH, 0, False)
    source = readers.read(packets(tmp_path / "recording.bag", first, second))
    with pytest.raises(FormatError, match=message):
        all_events(source)


def test_an_unknown_encoding_is_refused(tmp_path):
    path = packets(tmp_path / "recording.bag", event_packet("evt4", b"", EPOCH, 0, False))
    with pytest.raises(
        FormatError, match=r"'/events'.*'evt4' is not one of evt3, libcaer_cmp, libcaer, mono"
    ):
        readers.read(path)


def test_a_clock_that_goes_back_is_refused(tmp_path):
    path = packets(
        tmp_path / "recording.bag",
        event_packet("mono", mono(small_events(1)), EPOCH, 10**9, False),
        event_packet("mono", mono(small_events(1)), EPOCH, 10**8, False),
    )
    with pytest.raises(FormatError, match="clock goes back"):
        all_events(readers.read(path))


# Damage, and what is not installed


@pytest.mark.parametrize("container", CONTAINERS)
def test_damage_gives_clear_errors(tmp_path, container):
    write, cdr = CONTAINERS[container]
    path = tmp_path / f"recording.{container}"
    write(path, davis_messages(cdr))
    file = path if path.is_file() else next(path.glob("*.db3"))
    whole = file.read_bytes()
    copy = tmp_path / f"damaged.{container}"
    assert_only_clear_errors(copy, damaged(whole, 150, header=4200))


@pytest.mark.parametrize("encoding", ["bgra8", "bayer_gbrg8"])
def test_damage_of_colours_gives_clear_errors(tmp_path, encoding):
    path = tmp_path / "recording.bag"
    picture = np.zeros((*SIZE, 4) if encoding == "bgra8" else SIZE, np.uint8)
    write_bag1(path, image_messages([picture] * 4, encoding))
    assert_only_clear_errors(tmp_path / "damaged.bag", damaged(path.read_bytes(), 100, header=4200))


@pytest.mark.parametrize("container", ["bag", "mcap"])
@pytest.mark.parametrize("share", [0.01, 0.5, 0.99])
def test_a_file_cut_short_is_refused(tmp_path, container, share):
    write, cdr = CONTAINERS[container]
    path = tmp_path / f"recording.{container}"
    write(path, davis_messages(cdr))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(FormatError, match=str(path)) as caught:
        readers.read(path)
    [note] = caught.value.__notes__
    assert note.startswith("if the recorder was killed, '")


def test_damaged_messages_give_clear_errors(tmp_path):
    whole = packed_event_array(small_events(20))
    for i, data in enumerate(damaged(whole, 60, header=60)):
        path = tmp_path / f"{i}.bag"
        write_bag1(path, [(1, "/events", "dvs_msgs/msg/EventArray", data)])
        message = complaint(path)
        assert not message or str(path) in message
        assert "\n" not in message


def test_unsorted_events_are_refused(tmp_path):
    path = tmp_path / "recording.bag"
    write_bag1(path, [(1, "/events", "dvs_msgs/msg/EventArray", packed_event_array(small_events()[::-1]))])
    with pytest.raises(EventError, match="sort the events"):
        list(Recording(readers.read(path)).events())


def test_another_sqlite_file_is_refused(tmp_path):
    import sqlite3

    path = tmp_path / "other.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics (id INTEGER)")
    with pytest.raises(FormatError, match="not a ROS 2 recording"):
        readers.read(path)


@pytest.mark.parametrize(("container", "library"), [("bag", "rosbags"), ("mcap", "mcap")])
def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch, container, library):
    write, cdr = CONTAINERS[container]
    path = tmp_path / f"recording.{container}"
    write(path, davis_messages(cdr))
    imported = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name.partition(".")[0] == library:
            raise ImportError(f"No module named {name!r}")
        return imported(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(MissingDependencyError, match=rf'{library}.*pip install "kalux\[ros\]"'):
        readers.read(path)


# Real payloads


@pytest.mark.parametrize("container", CONTAINERS)
def test_a_real_recording_transcoded_opens_identically(shared_data, tmp_path, container):
    """Real payload, our writer."""
    original = readers.read(shared_data / "street_davis346.aedat4")
    write, cdr = CONTAINERS[container]
    path = tmp_path / f"street.{container}"
    events, frames = all_events(original), list(original.frames())
    messages = [
        (1000 * int(part["t"][-1]), "/dvs/events", "dvs_msgs/msg/EventArray", street_events(part, cdr))
        for part in np.array_split(events, 70)
    ]
    for frame in frames:
        recorded = 1000 * frame.exposure_end
        picture = image(frame.image, 1000 * frame.middle, cdr)
        messages.append((recorded, "/dvs/image_raw", "sensor_msgs/msg/Image", picture))
        messages.append((recorded + 50, "/dvs/exposure", "std_msgs/msg/Int32", exposure(frame.exposure, cdr)))
    write(path, sorted(messages, key=lambda message: message[0]))
    source = readers.read(path)
    assert (source.sensor_size, source.exposure_known, source.missing) == ((260, 346), True, ())
    assert np.array_equal(all_events(source), events)
    assert same_frames(source.frames(), frames)
    assert (source.count_events(), source.count_frames()) == (78_830, 59)


def street_events(events, cdr):
    if not cdr:
        return packed_event_array(events, (260, 346), 0)
    head = Body(True).header(1000 * int(events["t"][0])).number("I", 260).number("I", 346)
    head.number("I", len(events))
    for t, x, y, p in events.tolist():
        head.number("H", x).number("H", y).number("I", t // 10**6).number("I", t % 10**6 * 1000).number(
            "B", p
        )
    return bytes(head.data)


# Real files


def by_rosbags(path):
    """(encoding, size, stamp in ns, time base, content) of the packets of a bag, as rosbags deserialises them."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    definition = (
        "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
        "bool is_bigendian\nuint8[] events"
    )
    store.register(get_types_from_msg(definition, "event_camera_msgs/msg/EventPacket"))
    if path.is_dir() and (mcap := next(path.glob("*.mcap"), None)):
        # rosbags refuses its metadata
        from mcap.reader import make_reader

        with mcap.open("rb") as file:
            raw = [message.data for _, _, message in make_reader(file).iter_messages()]
        return [store.deserialize_cdr(data, "event_camera_msgs/msg/EventPacket") for data in raw]
    with (rosbag2.Reader if path.is_dir() else rosbag1.Reader)(path) as bag:
        raw = [data for _, _, data in bag.messages()]
    if path.is_dir():
        return [store.deserialize_cdr(data, "event_camera_msgs/msg/EventPacket") for data in raw]
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(definition, "event_camera_msgs/msg/EventPacket"))
    return [store.deserialize_ros1(data, "event_camera_msgs/msg/EventPacket") for data in raw]


@pytest.mark.parametrize("name", ["event_packet_ros1.bag", "event_packet_ros2_db3"])
def test_real_evt3_packets_agree_with_rosbags_and_faery(shared_data, tmp_path, name):
    """The packets, deserialised by rosbags and put into a RAW file, as faery decodes it."""
    path = shared_data / "formats" / name
    source = readers.read(path)
    ours = all_events(source)
    assert (source.sensor_size, source.count_events(), source.count_frames()) == ((480, 640), 343_474, 0)
    assert source.missing == ("The recording has no frames.",)
    # The first event is 5 us after the first time, whose stamp is that of the packet.
    assert (ours["t"][0], ours["t"][-1] - ours["t"][0]) == (1_675_956_550_318_683, 2_078_178)
    assert sum(map(len, source.triggers())) == 4157
    faery = pytest.importorskip("faery")
    messages = by_rosbags(path)
    raw = tmp_path / "packets.raw"
    raw.write_bytes(b"% evt 3.0\n% geometry 640x480\n" + b"".join(bytes(m.events) for m in messages))
    theirs = np.concatenate(list(faery.events_stream_from_file(raw)))
    for field in "xyp":
        assert np.array_equal(ours[field], theirs[field])
    stamp = messages[0].header.stamp
    first = (stamp.sec * 10**9 + stamp.nanosec) // 1000
    assert np.array_equal(ours["t"] - first - 5, theirs["t"].astype(np.int64) - int(theirs["t"][0]))


@pytest.mark.parametrize("lost", [range(100, 150), range(9, 517, 10)])
def test_what_is_read_of_real_evt3_packets_after_a_loss_is_true(shared_data, tmp_path, lost):
    """Real payload, our writer."""
    path = shared_data / "formats" / "event_packet_ros1.bag"
    with rosbag1.Reader(path) as bag:
        messages = [
            (time, "/events", "event_camera_msgs/msg/EventPacket", bytes(data))
            for _, time, data in bag.messages()
        ]
    write_bag1(tmp_path / "lost.bag", [m for i, m in enumerate(messages) if i not in lost])
    whole, found = all_events(readers.read(path)), all_events(readers.read(tmp_path / "lost.bag"))
    assert {*found.tolist()} <= {*whole.tolist()}
    assert len(found) > (1 - 1.1 * len(lost) / len(messages)) * len(whole)
    assert np.array_equal(found[-100:], whole[-100:])


def test_real_libcaer_packets_agree_with_the_codec_as_described(shared_data):
    """An mcap whose metadata rosbags refuses; decoded word by word as in event_camera_codecs."""
    path = shared_data / "formats" / "event_packet_ros2_mcap"
    source = readers.read(path)
    ours = all_events(source)
    assert (source.sensor_size, len(ours), source.count_events()) == ((260, 346), 571_266, 571_266)
    assert (ours["t"][0], ours["t"][-1]) == (1_744_227_144_732_712, 1_744_227_145_732_708)
    theirs = []
    for message in by_rosbags(path)[:10]:
        high = low = x = y = polarity = 0
        for word in np.frombuffer(bytes(message.events), "<u2").tolist():
            kind, rest = word >> 12, word & 0xFFF
            if kind == 0:
                high = rest << 12
            elif kind == 1:
                low = rest
            elif kind == 2:
                x = rest & 0x7FF
            t = (message.time_base + 1000 * (high | low)) // 1000
            if kind == 3:
                theirs.append((t, x, rest & 0x7FF, bool(rest >> 11)))
            elif kind == 4:
                y, polarity = rest & 0x7FF, bool(rest >> 11)
            elif kind == 5:
                theirs += [(t, x, y + k, polarity) for k in range(8) if rest >> k & 1]
                y += 8
    assert ours[: len(theirs)].tolist() == theirs


@pytest.mark.parametrize("name", ["event_packet_ros1.bag", "event_packet_ros2_mcap/test_events_2_0.mcap"])
def test_a_damaged_real_file_gives_clear_errors(shared_data, tmp_path, name):
    data = (shared_data / "formats" / name).read_bytes()
    assert_only_clear_errors(tmp_path / "damaged.bag", damaged(data, 25, header=2000))


def test_containers_are_told_by_content(shared_data):
    found = [
        ros_bags.container(path) for path in sorted((shared_data / "formats").glob("e*")) if path.is_file()
    ]
    assert found == ["bag", None, None, None]
