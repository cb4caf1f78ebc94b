"""The readers of Prophesee's files, on files written here word by word, and on real ones against faery."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from kalux import readers
from kalux.errors import FormatError
from kalux.events import make_events
from kalux.readers import CHUNK_EVENTS, evt
from recordings import (
    SIZE,
    all_events,
    assert_only_clear_errors,
    damaged,
    small_events,
)

# Writers, after the public descriptions of the encodings


def evt2_words(events, triggers=()):
    words, high = [], None
    marks = [(t, 0xA << 28 | (t & 63) << 22 | channel << 8 | value) for t, channel, value in triggers]
    marks += [(int(t), int(p) << 28 | (int(t) & 63) << 22 | int(x) << 11 | int(y)) for t, x, y, p in events]
    for t, word in sorted(marks, key=lambda mark: mark[0]):
        if t >> 6 != high:
            high = t >> 6
            words.append(0x8 << 28 | high & 0xFFFFFFF)
        words.append(word)
    return np.array(words, "<u4")


def evt21_words(events, legacy=False):
    words, high, i = [], None, 0
    while i < len(events):
        t, x, y, p = (int(v) for v in events[i])
        if t >> 6 != high:
            high = t >> 6
            words.append((0x8 << 28 | high & 0xFFFFFFF) << 32)
        valid = 0
        # as many of the next events as fit into one vector, columns ascending
        while i < len(events) and (int(events["t"][i]), int(events["y"][i]), bool(events["p"][i])) == (
            t,
            y,
            bool(p),
        ):
            offset = int(events["x"][i]) - x
            if not 0 <= offset < 32 or valid >> offset:
                break
            valid |= 1 << offset
            i += 1
        words.append((int(p) << 28 | (t & 63) << 22 | x << 11 | y) << 32 | valid)
    words = np.array(words, "<u8")
    return words << np.uint64(32) | words >> np.uint64(32) if legacy else words


def evt3_words(events):
    words, high, low, row = [], None, None, None
    for t, x, y, p in events:
        t, x, y, p = int(t), int(x), int(y), int(p)
        if t >> 12 != high:
            high, low = t >> 12, None
            words.append(0x8000 | high & 0xFFF)
        if t & 0xFFF != low:
            low = t & 0xFFF
            words.append(0x6000 | low)
        if y != row:
            row = y
            words.append(y)
        words.append(0x2000 | p << 11 | x)
    return np.array(words, "<u2")


def dat_words(events):
    e = {name: events[name].astype(np.uint64) for name in "txyp"}
    place = e["x"] | e["y"] << np.uint64(14) | e["p"] << np.uint64(28)
    return (e["t"] & np.uint64(0xFFFFFFFF) | place << np.uint64(32)).astype("<u8")


HEIGHT, WIDTH = SIZE
STATED = {
    "EVT2": f"% evt 2.0\n% format EVT2;height={HEIGHT};width={WIDTH}\n% end\n",
    "EVT21": f"% geometry {WIDTH}x{HEIGHT}\n% format EVT21\n% end\n",
    "EVT21 legacy": f"% format EVT21;height={HEIGHT};width={WIDTH};endianness=legacy\n% end\n",
    "EVT3": f"% Date 2023-10-19 03:51:23\n% evt 3.0\n% geometry {WIDTH}x{HEIGHT}\n",
    "DAT": f"% Data file containing CD events\n% Version 2\n% Width {WIDTH}\n% Height {HEIGHT}\n",
}
WORDS = {
    "EVT2": evt2_words,
    "EVT21": evt21_words,
    "EVT21 legacy": lambda events: evt21_words(events, legacy=True),
    "EVT3": evt3_words,
    "DAT": dat_words,
}
ENCODINGS = {
    "EVT2": evt.EVT2,
    "EVT21": evt.EVT21,
    "EVT21 legacy": evt.EVT21_LEGACY,
    "EVT3": evt.EVT3,
    "DAT": evt.DAT,
}


def prophesee_file(kind, words, header=None):
    text = STATED[kind] if header is None else header
    return text.encode() + (bytes([12, 8]) if kind == "DAT" else b"") + words.tobytes()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "recording.raw"


@pytest.mark.parametrize("kind", WORDS)
def test_reads_what_was_written(path, kind):
    path.write_bytes(prophesee_file(kind, WORDS[kind](small_events())))
    source = readers.read(path)
    assert source.format == ("prophesee-dat" if kind == "DAT" else "prophesee-raw")
    assert source.sensor_size == SIZE
    for _ in range(2):
        assert np.array_equal(all_events(source), small_events())
    assert (source.count_events(), source.count_frames(), list(source.frames())) == (500, 0, [])
    assert any("no frames" in sentence for sentence in source.missing)


@pytest.mark.parametrize("kind", WORDS)
def test_the_cut_of_the_blocks_makes_no_difference(kind):
    words = WORDS[kind](small_events())
    whole = np.concatenate(list(evt.decode_events(ENCODINGS[kind], [words], SIZE)))
    for size in (1, 3, 64):
        blocks = [words[i : i + size] for i in range(0, len(words), size)]
        assert np.array_equal(np.concatenate(list(evt.decode_events(ENCODINGS[kind], blocks, SIZE))), whole)


@pytest.mark.parametrize("kind", ["EVT2", "EVT3", "DAT"])
def test_chunks_are_full_but_the_last(path, kind):
    events = np.repeat(small_events(1), CHUNK_EVENTS + 10)
    path.write_bytes(prophesee_file(kind, WORDS[kind](events[:1]) if kind != "DAT" else dat_words(events)))
    if kind != "DAT":
        words = WORDS[kind](events[:1])
        words = np.concatenate([words, np.repeat(words[-1:], CHUNK_EVENTS + 9)])
        path.write_bytes(prophesee_file(kind, words))
    assert [len(chunk) for chunk in readers.read(path).events()] == [CHUNK_EVENTS, 10]


@pytest.mark.parametrize(("kind", "wrap"), [("EVT2", 34), ("EVT21", 34), ("EVT3", 24), ("DAT", 32)])
def test_times_go_on_where_their_bits_wrap_around(kind, wrap):
    t = np.arange(1, 60) * (1 << wrap) // 16 + 77
    events = make_events(t, np.arange(59) % WIDTH, np.arange(59) % HEIGHT, np.arange(59) % 2)
    decoded = np.concatenate(list(evt.decode_events(ENCODINGS[kind], [WORDS[kind](events)], SIZE)))
    assert np.array_equal(decoded, events)


def evt3(*words, size=SIZE):
    found = list(evt.decode_events(evt.EVT3, [np.array(words, "<u2")], size))
    return [tuple(int(v) for v in event) for chunk in found for event in chunk]


def test_evt3_vectors():
    start = (0x8001, 0x6002, 0x0003)
    vectors = (0x3000 | 1 << 11 | 4, 0x4801, 0x4002, 0x5081)
    t = 4096 + 2
    expected = [(t, x, 3, 1) for x in (4, 4 + 11, 16 + 1, 28, 28 + 7)]
    assert evt3(*start, *vectors) == expected
    # columns beyond the sensor are dropped
    assert evt3(*start, *vectors, size=(30, 20)) == expected[:3]


def test_evt3_before_the_first_time_and_row_is_ignored():
    assert evt3(0x6005, 0x0001, 0x2007, 0x8001, 0x2006, 0x0002, 0x2005) == [(4096, 5, 2, 0)]


def test_evt3_rows_outside_and_of_another_camera_are_dropped():
    assert evt3(0x8001, 0x0000 | HEIGHT, 0x2001, 0x0801, 0x2001, 0x0001, 0x2002) == [(4096, 2, 1, 0)]


def test_evt3_time_never_decreases():
    # a low time that goes back, and a high time that is wrong for once
    row = (0x8005, 0x6010, 0x0001)
    assert [t for t, *_ in evt3(*row, 0x2001, 0x6008, 0x2001, 0x6011, 0x2001)] == [20496, 20496, 20497]
    assert [t for t, *_ in evt3(*row, 0x8003, 0x2001, 0x8005, 0x6012, 0x2001)] == [20496, 20498]
    # ... also around a wrap
    assert [t for t, *_ in evt3(0x8FFF, 0x0001, 0x8000, 0x2001, 0x8FFF, 0x2001, 0x8001, 0x2001)] == [
        1 << 24,
        1 << 24,
        (1 << 24) + 4096,
    ]


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("EVT2", [0x80001000, 0, 0x80000000]),
        ("EVT21", [0x80001000 << 32, 1, 0x80000000 << 32]),
        ("EVT3", [0x8100, 0x8000]),
        ("DAT", [100_000, 7]),
    ],
)
def test_a_clock_that_goes_back_is_refused(path, kind, words):
    path.write_bytes(prophesee_file(kind, np.array(words, ENCODINGS[kind].word)))
    source = readers.read(path)
    with pytest.raises(FormatError, match=r"clock goes back from \d+ to \d+ us at word [12]"):
        all_events(source)


def test_triggers_are_kept(path):
    expected = [(10, 0, True), (70, 3, False), (5000, 0, True)]
    path.write_bytes(prophesee_file("EVT2", evt2_words(small_events(), expected)))
    source = readers.read(path)
    assert np.array_equal(all_events(source), small_events())
    assert [tuple(edge) for chunk in source.triggers() for edge in chunk.tolist()] == expected
    words = np.array([0x8001, 0x6002, 0xA000 | 2 << 8 | 1, 0xA000 | 2 << 8], "<u2")
    path.write_bytes(prophesee_file("EVT3", words))
    edges = [tuple(edge) for chunk in readers.read(path).triggers() for edge in chunk.tolist()]
    assert edges == [(4098, 2, True), (4098, 2, False)]
    many = np.concatenate([words[:2], np.repeat(words[2:3], 10_000)])
    path.write_bytes(prophesee_file("EVT3", many))
    assert sum(len(chunk) for chunk in readers.read(path).triggers()) == 10_000


@pytest.mark.parametrize(
    ("header", "size", "said"),
    [
        ("% evt 3.0\n% plugin_name hal_plugin_gen41_evk3\n", (720, 1280), True),
        ("% evt 3.0\n% plugin_name hal_plugin_gen31_fx3\n", (480, 640), True),
        ("% evt 3.0\n", (30, 40), False),
    ],
)
def test_size_where_it_is_not_stated(path, header, size, said):
    path.write_bytes(prophesee_file("EVT3", evt3_words(small_events()), header))
    source = readers.read(path)
    assert source.sensor_size == size
    assert said != any("size" in sentence for sentence in source.missing)
    assert np.array_equal(all_events(source), small_events())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"% evt 4.0\n\0\0", "EVT 4.0"),
        (b"% format HISTO3D;width=3\n\0\0", "HISTO3D"),
        (b"% format EVT3;endianness=big\n\0\0", "'big' order"),
        (b"% evt 3.0\n", "no events"),
        (b"% Version 1\n\x0c\x08", "version '1'"),
        (b"% Version 2\n\x0e\x08", "trigger inputs"),
        (b"% Version 2\n\x63\x08", "type 99"),
    ],
)
def test_what_cannot_be_read_is_said(path, content, message):
    path.write_bytes(content)
    with pytest.raises(FormatError, match=message):
        readers.read(path)


@pytest.mark.parametrize("kind", WORDS)
def test_a_file_that_ends_within_a_word_is_refused(path, kind):
    path.write_bytes(prophesee_file(kind, WORDS[kind](small_events()))[:-1])
    with pytest.raises(FormatError, match="cut short"):
        readers.read(path)


@pytest.mark.parametrize("kind", WORDS)
def test_damage_gives_clear_errors(path, kind):
    whole = prophesee_file(kind, WORDS[kind](small_events()))
    assert_only_clear_errors(path, damaged(whole, 150, header=120))


# Real files


@pytest.mark.parametrize(
    ("name", "size", "count", "span"),
    [
        ("evt2.raw", (480, 640), 521_252, (913_716_224, 913_812_095)),
        ("evt3.raw", (720, 1280), 1_218_618, (11_200_224, 21_968_221)),
        ("evt3_small.raw", (720, 1280), 219_596, (11_718_656, 11_727_467)),
        ("gen4.dat", (720, 1280), 1_218_618, (5_856, 10_773_853)),
    ],
)
def test_real_recordings_agree_with_faery(shared_data, name, size, count, span):
    path = shared_data / "formats" / name
    source = readers.read(path)
    ours = all_events(source)
    assert (source.sensor_size, source.count_events(), len(ours)) == (size, count, count)
    assert (ours["t"][0], ours["t"][-1]) == span
    faery = pytest.importorskip("faery")
    theirs = np.concatenate(list(faery.events_stream_from_file(path, dimensions_fallback=size[::-1])))
    for field in "txyp":
        assert np.array_equal(ours[field], theirs[field])


def test_raw_and_dat_of_the_same_scene_are_the_same_events(shared_data):
    raw = all_events(readers.read(shared_data / "formats" / "evt3.raw"))
    dat = all_events(readers.read(shared_data / "formats" / "gen4.dat"))
    for field in "xyp":
        assert np.array_equal(raw[field], dat[field])
    # The vendor's program that wrote the DAT counts time from the first high time.
    assert set(raw["t"] - dat["t"]) == {2733 << 12}


@pytest.mark.parametrize("name", ["evt2.raw", "evt3_small.raw"])
def test_a_damaged_real_file_gives_clear_errors(shared_data, path, name):
    data = (shared_data / "formats" / name).read_bytes()[:200_000]
    assert_only_clear_errors(path, damaged(data, 60))


@pytest.mark.parametrize("comment", [b"% a comment\n", b"% format t,x,y,p\n", b"% evt data\n"])
def test_other_files_with_comments_are_not_mistaken_for_these(path, comment):
    path.write_bytes(comment + struct.pack("<4f", 1, 2, 3, 4))
    with pytest.raises(FormatError, match="not a recording that kalux knows"):
        readers.read(path)
