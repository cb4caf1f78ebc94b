"""The containers of ROS recordings: ROS 1 bag, and ROS 2 SQLite (db3) and MCAP, as one file or a folder of several.

They give the bytes of messages; nothing here knows what a message means. No ROS is needed: bags are read by
``rosbags``, MCAP by ``mcap``, SQLite by Python itself. What metadata beside the files say is not needed, and
often wrong, so it is not read.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import zstandard

from kalux.errors import FormatError, MissingDependencyError
from kalux.readers.source import natural_order, reading
from kalux.readers.streams import unzstd

BAG_MAGIC: Final = b"#ROSBAG V"
MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
SQLITE_MAGIC: Final = b"SQLite format 3\0"

_ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
_RECORD_LIMIT: Final = 1 << 30
# Commands of ROS and MCAP that make a recording whole that has no end.
_MENDED_BY: Final = {"bag": "rosbag reindex", "mcap": "mcap recover"}
# Whatever a wrong offset, size or compressed byte can lead to in the libraries.
DAMAGE: Final = (
    ValueError,
    EOFError,
    struct.error,
    AssertionError,
    LookupError,
    RuntimeError,
    MemoryError,
    OverflowError,
    TypeError,
    AttributeError,
    sqlite3.Error,
    zstandard.ZstdError,
)


class Topic(NamedTuple):
    """``kind`` is its type, as ``package/Name``; ``cdr``: how its messages are serialised, see `Message`."""

    name: str
    kind: str
    cdr: bool


class Record(NamedTuple):
    """``time`` of recording, ns, and content of a message."""

    time: int
    data: bytes


class Bag(Protocol):
    """What all containers offer."""

    @property
    def topics(self) -> tuple[Topic, ...]:
        """In order of their names."""

    def records(self, topic: Topic) -> Iterator[Record]:
        """The messages of a topic, as recorded."""

    def count(self, topic: Topic) -> int:
        """Number of messages of a topic."""


def open_bag(path: Path) -> Bag:
    """Open a file or folder that `recognised`.

    Raises
    ------
    MissingDependencyError
        If the library for it is not installed.
    FormatError
        If it is damaged.
    """
    if path.is_file():
        return _open_file(path)
    return _Folder(path, tuple(_open_file(file) for file in parts(path)))


def container(path: Path) -> str | None:
    """Which container a file is: ``"bag"``, ``"db3"``, ``"mcap"`` or none."""
    with path.open("rb") as file:
        start = file.read(16)
    for magic, name in ((BAG_MAGIC, "bag"), (SQLITE_MAGIC, "db3"), (MCAP_MAGIC, "mcap")):
        if start.startswith(magic):
            return name
    return None


def parts(folder: Path) -> list[Path]:
    """The files of a ROS 2 recording, in order."""
    found = [path for path in folder.iterdir() if path.is_file() and _is_part(path)]
    return sorted(found, key=natural_order)


def _is_part(path: Path) -> bool:
    if path.name.endswith((".db3.zstd", ".mcap.zstd")):
        return True
    return path.suffix in (".db3", ".mcap") and container(path) in ("db3", "mcap")


def _open_file(path: Path) -> Bag:
    if path.suffix == ".zstd":
        raise FormatError(f"{path}: compressed as a whole; decompress it first: zstd -d {path.name}")
    kinds: dict[str | None, type[_Bag1 | _Mcap | _Sqlite]] = {"bag": _Bag1, "db3": _Sqlite, "mcap": _Mcap}
    kind = container(path)
    bag = kinds[kind](path)
    try:
        with reading(path, *DAMAGE, *bag.damage):
            _ = bag.topics
    except FormatError as error:
        if kind in _MENDED_BY:
            error.add_note(f"if the recorder was killed, {_MENDED_BY[kind]!r} may mend it")
        raise
    return bag


def _kind(name: str) -> str:
    return name.replace("/msg/", "/")


def _uncompressed(data: bytes) -> bytes:
    """Messages may be compressed one by one; no message begins like zstd."""
    return unzstd(data) if data[:4] == _ZSTD_MAGIC else data


@dataclass(frozen=True)
class _Bag1:
    """A ROS 1 bag."""

    path: Path

    @property
    def damage(self) -> tuple[type[Exception], ...]:
        return (_rosbags().ReaderError,)

    @cached_property
    def topics(self) -> tuple[Topic, ...]:
        with self._open() as bag:
            return tuple(sorted({Topic(c.topic, _kind(c.msgtype), False) for c in bag.connections}))

    def records(self, topic: Topic) -> Iterator[Record]:
        with reading(self.path, *DAMAGE, *self.damage), self._open() as bag:
            connections = [c for c in bag.connections if c.topic == topic.name]
            for _, time, data in bag.messages(connections):
                yield Record(time, data)

    def count(self, topic: Topic) -> int:
        with reading(self.path, *DAMAGE, *self.damage), self._open() as bag:
            return sum(int(c.msgcount) for c in bag.connections if c.topic == topic.name)

    def _open(self) -> Any:
        return _rosbags().Reader(self.path)


def _rosbags() -> Any:
    try:
        from rosbags import rosbag1
    except ImportError as error:
        raise _missing("rosbags", "ROS 1 bags") from error
    return rosbag1


@dataclass(frozen=True)
class _Mcap:
    """An MCAP file with messages of ROS 2, or of ROS 1 where it was made of a bag."""

    path: Path

    @property
    def damage(self) -> tuple[type[Exception], ...]:
        return (_mcap().exceptions.McapError,)

    @cached_property
    def topics(self) -> tuple[Topic, ...]:
        with self._open() as reader:
            summary = reader.get_summary()
        if summary is None:
            raise ValueError(
                "it has no summary at its end, so it was not closed; mend it with 'mcap recover'"
            )
        found = set()
        for channel in summary.channels.values():
            schema = summary.schemas.get(channel.schema_id)
            if schema is not None and channel.message_encoding in ("cdr", "ros1"):
                found.add(Topic(channel.topic, _kind(schema.name), channel.message_encoding == "cdr"))
        return tuple(sorted(found))

    def records(self, topic: Topic) -> Iterator[Record]:
        with reading(self.path, *DAMAGE, *self.damage), self._open() as reader:
            # In order of time, chunks are loaded one by one; in the file's order the library would load all at once.
            # Without chunks, it is the other way round.
            chunks = bool(reader.get_summary().chunk_indexes)
            for _, _, message in reader.iter_messages(topics=[topic.name], log_time_order=chunks):
                yield Record(message.log_time, _uncompressed(message.data))

    def count(self, topic: Topic) -> int:
        return sum(1 for _ in self.records(topic))

    @contextmanager
    def _open(self) -> Iterator[Any]:
        mcap = _mcap()
        with self.path.open("rb") as file:
            yield mcap.reader.SeekingReader(file, record_size_limit=_RECORD_LIMIT)


def _mcap() -> Any:
    try:
        import mcap.exceptions
        import mcap.reader
    except ImportError as error:
        raise _missing("mcap", "MCAP files") from error
    return mcap


def _missing(library: str, files: str) -> MissingDependencyError:
    return MissingDependencyError(
        f'{files} are read by {library}, which is not installed: pip install "kalux[ros]"'
    )


@dataclass(frozen=True)
class _Sqlite:
    """A ROS 2 SQLite file."""

    path: Path

    damage: tuple[type[Exception], ...] = ()

    @cached_property
    def topics(self) -> tuple[Topic, ...]:
        with self._open() as database:
            tables = {
                name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            }
            if not {"topics", "messages"} <= tables:
                raise FormatError(f"{self.path}: an SQLite file, but not a ROS 2 recording")
            rows = database.execute("SELECT name, type, serialization_format FROM topics").fetchall()
        return tuple(
            sorted(Topic(str(name), _kind(str(kind)), True) for name, kind, form in rows if form == "cdr")
        )

    def records(self, topic: Topic) -> Iterator[Record]:
        with reading(self.path, *DAMAGE), self._open() as database:
            rows = database.execute(
                "SELECT timestamp, data FROM messages WHERE topic_id IN (SELECT id FROM topics WHERE name = ?) "
                "ORDER BY timestamp, id",
                (topic.name,),
            )
            for time, data in rows:
                yield Record(int(time), _uncompressed(bytes(data)))

    def count(self, topic: Topic) -> int:
        with reading(self.path, *DAMAGE), self._open() as database:
            row = database.execute(
                "SELECT COUNT(*) FROM messages WHERE topic_id IN (SELECT id FROM topics WHERE name = ?)",
                (topic.name,),
            ).fetchone()
        return int(row[0])

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        # Unchanging, so that nothing is written beside it, unless a journal has yet to be taken into account.
        journal = self.path.with_name(self.path.name + "-wal").exists()
        name = self.path.resolve().as_uri() + ("?mode=ro" if journal else "?immutable=1")
        with closing(sqlite3.connect(name, uri=True)) as database:
            yield database


@dataclass(frozen=True)
class _Folder:
    """Several files, one after the other."""

    path: Path
    files: tuple[Bag, ...]

    @property
    def topics(self) -> tuple[Topic, ...]:
        return tuple(sorted({topic for bag in self.files for topic in bag.topics}))

    def records(self, topic: Topic) -> Iterator[Record]:
        for bag in self.files:
            if topic in bag.topics:
                yield from bag.records(topic)

    def count(self, topic: Topic) -> int:
        return sum(bag.count(topic) for bag in self.files if topic in bag.topics)
