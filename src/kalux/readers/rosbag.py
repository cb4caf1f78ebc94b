"""Recordings of ROS 1 and ROS 2: events, images and exposure times from the topics of a bag.

Times are those of the messages' header stamps, not of their recording. Topics are chosen by what they hold; where
that is not clear, the path says which: ``recording.bag?events=/dvs/events&frames=/dvs/image_raw``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError, InputError
from kalux.events import EventArray
from kalux.frames import MOSAICS, Frame, Mosaic
from kalux.readers import event_packet
from kalux.readers.event_packet import EVENT_ARRAYS, EVENT_PACKETS, EventTopic, Message
from kalux.readers.evt3_packets import RestartError
from kalux.readers.images import in_colour, read_image
from kalux.readers.ros_bags import BAG_MAGIC, DAMAGE, Bag, Topic, container, open_bag, parts
from kalux.readers.source import EXPOSURE_UNKNOWN, Lost, Source, TriggerArray, reading
from kalux.readers.streams import in_order


class _Encoding(NamedTuple):
    """``dtype`` without byte order; ``order`` of colours, none for grey; ``mosaic``."""

    dtype: str
    order: str = ""
    mosaic: Mosaic | None = None


_ORDERS: Final = ("rgb", "bgr", "rgba", "bgra")
_DRAWING: Final = "render"  # in the name of a topic: a drawing of the events, as of dvs_renderer
_IMAGE: Final = "sensor_msgs/Image"
_COMPRESSED: Final = "sensor_msgs/CompressedImage"
_EXPOSURE: Final = "std_msgs/Int32"
_ENCODINGS: Final = {
    **{name: _Encoding("u1") for name in ("mono8", "8UC1")},
    **{name: _Encoding("u2") for name in ("mono16", "16UC1")},
    **{f"bayer_{name.lower()}8": _Encoding("u1", mosaic=name) for name in MOSAICS},
    **{f"bayer_{name.lower()}16": _Encoding("u2", mosaic=name) for name in MOSAICS},
    **{
        f"{order}{bits}": _Encoding(kind, order)
        for order in _ORDERS
        for bits, kind in ((8, "u1"), (16, "u2"))
    },
}
_CHOICES: Final = ("events", "frames", "exposure")
_FIRST_IMAGES: Final = 10
# How types of many events may end; not ParameterEvent, which every ROS 2 recording may have.
_EVENT_TYPE: Final = re.compile(r"(Events|Event(Array|Packet|Batch|Buffer|List|Stream|Struct))(Msg)?$")
_SHOWN: Final = 60  # letters of a type, in a sentence


def recognises(path: Path) -> bool:
    """Whether this is a ROS 1 bag, a ROS 2 SQLite or MCAP file, or a folder with such."""
    if path.is_dir():
        return bool(parts(path))
    return path.is_file() and container(path) is not None


def read(path: Path, choice: str = "") -> Source:
    """Open a recording of ROS 1 or ROS 2.

    Parameters
    ----------
    path
        A bag, an SQLite (db3) or MCAP file, or the folder of a ROS 2 recording.
    choice
        The topics to read where that is not clear: ``events=/a&frames=/b&exposure=/c``. An empty name means none.

    Raises
    ------
    MissingDependencyError
        If the library for the container is not installed.
    FormatError
        If the file is damaged, or holds neither events nor images.
    InputError
        If it cannot be read, or it is not clear which topics are meant.
    """
    chosen = _parse_choice(path, choice)
    with reading(path):
        if path.is_file():
            _check_version(path)
        bag = open_bag(path)
    for name in chosen.values():
        if name and not any(topic.name == name for topic in bag.topics):
            names = ", ".join(topic.name for topic in bag.topics)
            raise InputError(f"{path}: has no topic {name!r}; its topics are {names}")
    events, images = _choose(path, bag, chosen)
    exposures = None if images is None else _exposures(path, bag, images.topic, chosen.get("exposure"))
    return _source(path, bag, events, images, exposures)


def _check_version(path: Path) -> None:
    with path.open("rb") as file:
        start = file.read(len(BAG_MAGIC) + 3)
    if start.startswith(BAG_MAGIC) and start != BAG_MAGIC + b"2.0":
        raise FormatError(f"{path}: a ROS bag of an old version; convert it with 'rosbag fix'")


def _parse_choice(path: Path, choice: str) -> dict[str, str]:
    pairs = parse_qsl(choice, keep_blank_values=True)
    chosen = dict(pairs)
    if unknown := [name for name in chosen if name not in _CHOICES]:
        raise InputError(
            f"{path}: {unknown[0]!r} cannot be chosen; after '?' go {', '.join(_CHOICES)}, as name=topic"
        )
    return chosen


# Which topics


@dataclass(frozen=True)
class _Events:
    topic: Topic
    content: EventTopic

    @property
    def size(self) -> tuple[int, int]:
        return self.content.size


@dataclass(frozen=True)
class _Images:
    """``fault``: why the images cannot be read, if so; ``colour``: whether they are RGB; ``mosaic``: of the sensor."""

    topic: Topic
    size: tuple[int, int]
    fault: FormatError | None
    colour: bool = False
    mosaic: Mosaic | None = None


def _choose(path: Path, bag: Bag, chosen: dict[str, str]) -> tuple[_Events | None, _Images | None]:
    """The topics asked for; else the only pair of equal size, or the only one.

    Raises
    ------
    InputError
        That lists the topics and says how to choose, where it is not clear.
    """
    event_topics = [
        _Events(topic, content)
        for topic in _candidates(bag, (*EVENT_ARRAYS, *EVENT_PACKETS), chosen.get("events"))
        if (content := _open_events(path, bag, topic)) is not None
    ]
    image_topics = [
        images
        for topic in _candidates(bag, (_IMAGE, _COMPRESSED), chosen.get("frames"))
        if (images := _open_images(path, bag, topic)) is not None
    ]
    for name, found in (("events", event_topics), ("frames", image_topics)):
        if chosen.get(name) and not found:
            raise InputError(f"{path}: topic {chosen[name]!r} has no {name} that kalux reads")
    if not event_topics and not image_topics:
        held = ", ".join(sorted({topic.kind for topic in bag.topics})) or "no topics of ROS messages"
        raise FormatError(f"{path}: holds neither events nor images, but {held[:200]}")
    # Images that cannot be read, such as coloured drawings of the events, do not stand in the way of others.
    readable = [images for images in image_topics if images.fault is None]
    if not chosen.get("frames"):
        # Nor do those in colour: a driver's own images are grey or raw, and drawings of the events are in colour.
        readable = [images for images in readable if not images.colour] or [
            images for images in readable if _DRAWING not in images.topic.name
        ]
    faults = [images.fault for images in image_topics if images.fault is not None]
    if faults and not readable:
        raise faults[0]
    if not readable and len(event_topics) == 1:
        return event_topics[0], None
    if not event_topics and len(readable) == 1:
        return None, readable[0]
    pairs = [(e, i) for e in event_topics for i in readable if e.size == i.size]
    if len(pairs) == 1:
        return pairs[0]
    fits = (
        "no two topics have"
        if event_topics and readable and not pairs
        else "several topics have, or may have,"
    )
    topics: list[_Events | _Images] = [*event_topics, *readable]
    listed = ", ".join(f"{t.topic.name} ({t.size[1]}x{t.size[0]})" for t in topics)
    raise InputError(
        f"{path}: {fits} the same size: {listed}; choose with '{path.name}?events=/topic&frames=/topic' "
        "(frames= for no frames)"
    )


def _candidates(bag: Bag, kinds: tuple[str, ...], name: str | None) -> list[Topic]:
    return [topic for topic in bag.topics if topic.kind in kinds and name in (None, topic.name)]


def _messages(bag: Bag, topic: Topic) -> Iterator[Message]:
    return (Message(record.data, topic.cdr) for record in bag.records(topic))


def _open_events(path: Path, bag: Bag, topic: Topic) -> EventTopic | None:
    """None where the topic has no messages."""
    if next(bag.records(topic), None) is None:
        return None
    with _decoding(path, topic):
        content = event_packet.open_topic(topic.kind, lambda: _messages(bag, topic))
    if min(content.size) < 1 or max(content.size) > 1 << 16:
        raise FormatError(f"{path}: topic {topic.name!r} states {content.size[1]}x{content.size[0]} pixels")
    return content


def _open_images(path: Path, bag: Bag, topic: Topic) -> _Images | None:
    with _decoding(path, topic):
        message = next(_messages(bag, topic), None)
        if message is None:
            return None
        if topic.kind == _COMPRESSED:
            compressed = _compressed(message)
            try:
                colour = _compressed_in_colour(path, bag, topic)
                size = _compressed_image(path, topic, compressed, colour).shape
            except FormatError as fault:
                return _Images(topic, (0, 0), fault)
            return _Images(topic, (size[0], size[1]), None, colour, compressed.mosaic)
        message.stamp()
        height, width = message.numbers("II")
        encoding = message.text()
    if encoding not in _ENCODINGS:
        return _Images(topic, (height, width), _unknown_encoding(path, topic, encoding))
    found = _ENCODINGS[encoding]
    return _Images(topic, (height, width), None, bool(found.order), found.mosaic)


@contextmanager
def _decoding(path: Path, topic: Topic) -> Iterator[None]:
    where = Path(f"{path}: topic {topic.name!r}")
    with reading(where, *DAMAGE):
        try:
            yield
        except RestartError as error:  # no damage, and no other copy is better
            raise FormatError(f"{where}: {error}") from error


def _unknown_encoding(path: Path, topic: Topic, encoding: str) -> FormatError:
    return FormatError(
        f"{path}: topic {topic.name!r}: its images are {encoding[:40]!r}; known are {', '.join(_ENCODINGS)} "
        f"('{path.name}?frames=' reads the events alone)"
    )


# Images


def _image(path: Path, topic: Topic, message: Message, colour: bool) -> tuple[int, NDArray[Any]]:
    """(stamp in us, image)."""
    if topic.kind == _COMPRESSED:
        compressed = _compressed(message)
        return compressed.stamp, _compressed_image(path, topic, compressed, colour)
    stamp = message.stamp() // 1000
    height, width = message.numbers("II")
    encoding = message.text()
    if encoding not in _ENCODINGS:
        raise _unknown_encoding(path, topic, encoding)
    found = _ENCODINGS[encoding]
    dtype = np.dtype(found.dtype).newbyteorder(">" if message.number("B") else "<")
    values = width * max(len(found.order), 1)
    step = message.number("I")
    start, length = message.sequence()
    if step < values * dtype.itemsize or length < height * step or step == 0:
        raise ValueError(f"{length} bytes in rows of {step} for {width}x{height} pixels of {encoding}")
    rows = np.frombuffer(message.data, np.uint8, height * step, start).reshape(height, step)
    pixels = (
        np.ascontiguousarray(rows[:, : values * dtype.itemsize]).view(dtype).astype(dtype.newbyteorder("="))
    )
    if found.order:
        pixels = pixels.reshape(height, width, len(found.order))
        pixels = np.ascontiguousarray(pixels[..., [found.order.index(c) for c in "rgb"]])
    return stamp, pixels


class _Compressed(NamedTuple):
    """``stamp`` in us; ``data``, a file; ``red_first``: whether it has red where its format has blue."""

    stamp: int
    data: bytes
    mosaic: Mosaic | None
    red_first: bool


def _compressed(message: Message) -> _Compressed:
    """An image of compressed_image_transport, whose format is as "rgb8; png compressed bgr8", or of others: "jpeg".

    The first part is what the image was, the last the order in which its channels were given to OpenCV, which takes
    blue to be first.
    """
    stamp = message.stamp() // 1000
    original, _, codec = message.text().partition(";")
    start, length = message.sequence()
    found = _ENCODINGS.get(original.strip())
    return _Compressed(
        stamp,
        message.data[start : start + length],
        None if found is None else found.mosaic,
        "compressed rgb" in codec,
    )


def _compressed_in_colour(path: Path, bag: Bag, topic: Topic) -> bool:
    """Whether any of the first images is in colour: one alone may be black."""
    first = [_compressed(message).data for message in islice(_messages(bag, topic), _FIRST_IMAGES)]
    return in_colour(path, first, lambda data: (topic.name, data))


def _compressed_image(path: Path, topic: Topic, compressed: _Compressed, colour: bool) -> NDArray[Any]:
    image = read_image(path, topic.name, compressed.data, colour=colour)
    return np.ascontiguousarray(image[..., ::-1]) if colour and compressed.red_first else image


# Exposure times


@dataclass(frozen=True)
class _Exposures:
    """``recorded``: when each message was recorded, ns, in order; ``exposure`` in us."""

    topic: Topic
    recorded: NDArray[np.int64]
    exposure: NDArray[np.int64]

    def of(self, recorded: int) -> int:
        """The exposure whose message was recorded nearest to that of an image."""
        after = int(np.searchsorted(self.recorded, recorded))
        nearest = [i for i in (after - 1, after) if 0 <= i < len(self.recorded)]
        return int(self.exposure[min(nearest, key=lambda i: abs(int(self.recorded[i]) - recorded))])


def _exposures(path: Path, bag: Bag, images: Topic, name: str | None) -> _Exposures | None:
    """The topic ``exposure`` beside that of the images, or as asked for."""
    found = _candidates(bag, (_EXPOSURE,), name)
    if name is None:
        found = [topic for topic in found if topic.name == f"{_namespace(images)}/exposure"]
    if not found:
        if name:
            raise InputError(f"{path}: topic {name!r} has no exposure times; they are {_EXPOSURE}, in us")
        return None
    with _decoding(path, found[0]):
        records = [
            (record.time, Message(record.data, found[0].cdr).number("i")) for record in bag.records(found[0])
        ]
        table = np.array(sorted(records), np.int64).reshape(-1, 2)  # MCAP has room for times beyond an int64
    if not records:
        return None
    return _Exposures(found[0], table[:, 0], table[:, 1])


def _namespace(images: Topic) -> str:
    """``/dvs`` of ``/dvs/image_raw`` and of ``/dvs/image_raw/compressed``."""
    name = images.name.removesuffix("/compressed") if images.kind == _COMPRESSED else images.name
    return name.rpartition("/")[0]


# The recording


def _source(
    path: Path, bag: Bag, events: _Events | None, images: _Images | None, exposures: _Exposures | None
) -> Source:
    def read_events() -> Iterator[EventArray]:
        if events is not None:
            with _decoding(path, events.topic):
                yield from events.content.events()

    def read_triggers() -> Iterator[TriggerArray]:
        if events is not None and events.content.triggers is not None:
            with _decoding(path, events.topic):
                yield from events.content.triggers()

    def lost(begin: int, until: int) -> Lost | None:
        if events is None or events.content.lost is None:
            return None
        with _decoding(path, events.topic):
            return events.content.lost(begin, until)

    def read_frames() -> Iterator[Frame]:
        return iter(()) if images is None else in_order(_frames(path, bag, images, exposures))

    @cache
    def count_events() -> int:
        if events is None:
            return 0
        with _decoding(path, events.topic):
            return events.content.count()

    missing = _unread(bag, events, images)
    if events is None:
        missing += (_without_events(bag),)
    if images is None:
        missing += ("The recording has no frames.",)
    elif exposures is None:
        missing += (EXPOSURE_UNKNOWN,)
    found = events or images
    assert found is not None
    return Source(
        path=path,
        format="ros",
        sensor_size=found.size,
        events=read_events,
        frames=read_frames,
        count_events=count_events,
        count_frames=lambda: 0 if images is None else bag.count(images.topic),
        exposure_known=images is None or exposures is not None,
        triggers=None if events is None or events.content.triggers is None else read_triggers,
        missing=missing,
        mosaic=None if images is None else images.mosaic,
        lost=lost,
    )


def _frames(path: Path, bag: Bag, images: _Images, exposures: _Exposures | None) -> Iterator[Frame]:
    topic = images.topic
    with _decoding(path, topic):
        for record in bag.records(topic):
            stamp, image = _image(path, topic, Message(record.data, topic.cdr), images.colour)
            if exposures is None:
                yield Frame(image, stamp, stamp)
                continue
            exposure = exposures.of(record.time)
            start = stamp - exposure // 2  # the driver stamps the middle
            yield Frame(image, start, start + exposure)


def _unread(bag: Bag, events: _Events | None, images: _Images | None) -> tuple[str, ...]:
    """A sentence about other topics that hold events or images, or seem to, if there are any."""
    kinds = (*EVENT_ARRAYS, *EVENT_PACKETS, _IMAGE, _COMPRESSED)
    read = [found.topic for found in (events, images) if found is not None]
    others = [topic.name for topic in bag.topics if topic.kind in kinds and topic not in read]
    others += [f"{topic.name} ({topic.kind[:_SHOWN]})" for topic in _of_unknown_events(bag)]
    return (f"Other topics are not read: {', '.join(others)}.",) if others else ()


def _without_events(bag: Bag) -> str:
    unknown = _of_unknown_events(bag)
    if not unknown:
        return "The recording has no events."
    return f"The recording has no events that kalux reads; known are {', '.join((*EVENT_ARRAYS, *EVENT_PACKETS))}."


def _of_unknown_events(bag: Bag) -> list[Topic]:
    """Topics of messages that are not read, but whose type has a name as of many events."""
    known = (*EVENT_ARRAYS, *EVENT_PACKETS)
    return [topic for topic in bag.topics if topic.kind not in known and _EVENT_TYPE.search(topic.kind)]
