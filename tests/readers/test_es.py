"""Event Stream: our writer from the published description, damage, and a real payload transcoded by it."""

from __future__ import annotations

import numpy as np
import pytest

from kalux import readers
from kalux.errors import FormatError
from kalux.readers import es
from recordings import SIZE, all_events, assert_only_clear_errors, damaged, small_events


def encoded(events, size, *, version=b"\x02\x00\x00", kind=1, resets=0):
    """The bytes of an Event Stream file; rows are counted from the bottom."""
    height, width = size
    out = bytearray(b"Event Stream" + version + bytes([kind]))
    out += width.to_bytes(2, "little") + height.to_bytes(2, "little")
    now = 0
    for index, (t, x, y, p) in enumerate(events.tolist()):
        overflows, rest = divmod(t - now, 127)
        out += b"\xff" * overflows + bytes([rest << 1 | p])
        out += x.to_bytes(2, "little") + (height - 1 - y).to_bytes(2, "little")
        if resets and index % resets == 0:
            out += b"\xfe" * 5
        now = t
    return bytes(out)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "recording.es"


@pytest.mark.parametrize("resets", [0, 7])
def test_events(path, resets):
    path.write_bytes(encoded(small_events(), SIZE, resets=resets))
    source = readers.read(path)
    assert (source.format, source.sensor_size, source.count_frames()) == ("es", SIZE, 0)
    for _ in range(2):
        assert np.array_equal(all_events(source), small_events())
    assert source.count_events() == 500
    assert list(source.frames()) == []


def test_bytes_as_described(path):
    """By hand from the description: 3 overflows and 5 us, OFF, x = 300, y = 2 from the bottom of 4 rows."""
    path.write_bytes(
        b"Event Stream\x02\x00\x00\x01\x40\x01\x04\x00" + b"\xff\xff\xff" + b"\x0a\x2c\x01\x02\x00"
    )
    source = readers.read(path)
    assert source.sensor_size == (4, 320)
    assert all_events(source).tolist() == [(3 * 127 + 5, 300, 1, False)]


def test_blocks_join_without_a_seam(path, monkeypatch):
    path.write_bytes(encoded(small_events(), SIZE, resets=3))
    monkeypatch.setattr(es, "CHUNK_EVENTS", 3)
    chunks = list(readers.read(path).events())
    assert len(chunks) > 100
    assert np.array_equal(np.concatenate(chunks), small_events())


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"version": b"\x01\x00\x00"}, r"Event Stream 1\.0\.0"),
        ({"kind": 2}, "type ATIS"),
        ({"kind": 9}, r"type unknown \(9\)"),
    ],
)
def test_other_versions_and_types_are_named(path, changes, told):
    path.write_bytes(encoded(small_events(), SIZE, **changes))
    with pytest.raises(FormatError, match=told):
        readers.read(path)


def test_a_file_cut_short(path):
    data = encoded(small_events(), SIZE)
    for length in (14, 19):
        path.write_bytes(data[:length])
        with pytest.raises(FormatError, match="within its header"):
            readers.read(path)
    path.write_bytes(data[:-2])
    with pytest.raises(FormatError, match="cut short, 3 bytes into an event"):
        all_events(readers.read(path))


@pytest.mark.parametrize("size", [(0, 40), (30, 0), (0, 0)])
def test_a_sensor_without_pixels_is_damage(path, size):
    path.write_bytes(encoded(small_events()[:0], size))
    with pytest.raises(FormatError, match=f"has {size[1]}x{size[0]} pixels; its header is damaged"):
        readers.read(path)


def test_an_event_outside_the_sensor_is_located(path):
    path.write_bytes(encoded(small_events(), SIZE) + b"\x00\x28\x00\x00\x00")
    with pytest.raises(FormatError, match=r"outside the sensor of 40x30 pixels \(byte \d+\)"):
        all_events(readers.read(path))


def test_damage_gives_clear_errors(path):
    assert_only_clear_errors(path, damaged(encoded(small_events(), SIZE), 300, 25))


def test_a_real_payload(shared_data, path):
    """Real payload, our writer."""
    source = readers.read(shared_data / "street_davis346.aedat4")
    events = all_events(source)
    events["t"] -= events["t"][0]  # the format counts from 0, with a byte per 127 us
    path.write_bytes(encoded(events, source.sensor_size))
    assert np.array_equal(all_events(readers.read(path)), events)
