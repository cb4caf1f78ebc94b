"""The AEDAT 2 reader.

The real file has events and inertial samples, and is compared with eventcv. No real file with frames could be had:
those here are written by `samples`, from the layout's description, some with the real frames and events
of another format.
"""

from __future__ import annotations

import numpy as np
import pytest

import kalux
from kalux import readers
from kalux.errors import EventError, FormatError
from kalux.events import make_events
from kalux.frames import Frame
from kalux.readers import CHUNK_EVENTS, aedat2, evt
from kalux.recording import Recording
from recordings import all_events, assert_only_clear_errors, damaged, same_frames

CHIP = "eu.seebetter.ini.chips.davis.DAVIS240C"
SIZE = (180, 240)
RESET = 900


# A writer, after the description of the layout


def header(chip=CHIP, *lines):
    names = [f"# AEChip: {chip}"] if chip else []
    text = ["#!AER-DAT2.0", "# This is a raw AE data file - do not edit", *names, *(f"#{n}" for n in lines)]
    return "".join(line + "\r\n" for line in text).encode()


def words(address, t):
    pairs = np.empty((len(address), 2), ">u4")
    pairs[:, 0], pairs[:, 1] = address, np.asarray(t) & 0xFFFFFFFF
    return pairs


def event_words(events, size=SIZE):
    e = {name: events[name].astype(np.int64) for name in "txyp"}
    return words((size[0] - 1 - e["y"]) << 22 | (size[1] - 1 - e["x"]) << 12 | e["p"] << 11, e["t"])


def samples(frame, rolling=False, first=(0, 0)):
    """Reads of a frame, column by column in 1 us each, of which the first is at a corner, ``first``, from the bottom.

    Of a global shutter the last resets are read as the exposure begins, of a rolling one the first.
    """
    height, width = frame.image.shape
    columns = np.arange(width)[:: -1 if first[1] else 1]
    rows = np.arange(height)[:: -1 if first[0] else 1]
    column, row = (grid.ravel() for grid in np.meshgrid(columns, rows, indexing="ij"))
    value = frame.image[height - 1 - row, column].astype(np.int64)
    place = 1 << 31 | row << 22 | column << 12
    late = np.repeat(np.arange(width), height)
    begin = frame.exposure_start - (0 if rolling else width - 1)
    resets = words(place | RESET, begin + late)
    signals = words(place | 1 << 10 | RESET - value, frame.exposure_end + late)
    return in_time(resets, signals)


def in_time(*parts):
    joined = np.concatenate(parts)
    return joined[np.argsort(joined[:, 1], kind="stable")].astype(">u4")  # concatenated in native order


def inertial(t):
    return words([1 << 31 | 3 << 10 | code << 28 | 0x155 for code in range(7)], [t] * 7)


def small_events(count=400, seed=0, last=100_000):
    rng = np.random.default_rng(seed)
    return make_events(
        np.sort(rng.integers(0, last, count)),
        rng.integers(0, SIZE[1], count),
        rng.integers(0, SIZE[0], count),
        rng.integers(0, 2, count),
    )


def frames_of(count, exposure=3_000, seed=0):
    rng = np.random.default_rng(seed)
    return [
        Frame(
            rng.integers(0, RESET, SIZE, dtype=np.uint16),
            20_000 * i + 5_000,
            20_000 * i + 5_000 + exposure,
            1023,
        )
        for i in range(count)
    ]


def write(path, *parts, head=None):
    path.write_bytes((header() if head is None else head) + in_time(*parts).tobytes())
    return readers.read(path)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "recording.aedat"


def test_reads_what_was_written(path):
    events, frames = small_events(), frames_of(3)
    source = write(path, event_words(events), *map(samples, frames), inertial(500), inertial(30_000))
    assert (source.format, source.sensor_size, source.exposure_known) == ("aedat2", SIZE, True)
    for _ in range(2):
        assert np.array_equal(all_events(source), events)
        assert same_frames(source.frames(), frames)
    assert (source.count_events(), source.count_frames()) == (len(events), 3)
    recording = Recording(source)
    assert sum(1 for _ in recording.frames()) == 3


@pytest.mark.parametrize("first", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_sensors_may_read_from_any_corner(path, first):
    frames = frames_of(2)
    source = write(path, event_words(small_events()), *(samples(frame, first=first) for frame in frames))
    assert same_frames(source.frames(), frames)


def test_orientation_is_that_of_jaer(path):
    """Rows from the bottom; columns of events from the right, of samples from the left."""
    address = [3 << 22 | 5 << 12 | 1 << 11]
    assert [tuple(e) for e in all_events(write(path, words(address, [7]))).tolist()] == [
        (7, SIZE[1] - 1 - 5, SIZE[0] - 1 - 3, True)
    ]
    image = np.zeros(SIZE, np.uint16)
    image[SIZE[0] - 1 - 3, 5] = 321
    reads = samples(Frame(image, 5_000, 8_000))
    bright = reads[reads[:, 0] == (1 << 31 | 3 << 22 | 5 << 12 | 1 << 10 | RESET - 321)]
    assert len(bright) == 1
    assert np.array_equal(next(write(path, reads).frames()).image, image)


@pytest.mark.parametrize(
    ("name", "stated", "rolling", "said"),
    [
        ("DAVIS240C.APS.GlobalShutter", "false", True, "rolling shutter"),
        ("DAVIS240C.APS.GlobalShutter", "true", False, None),
        ("DAVIS240B.APS.GlobalShutter", "false", False, "does not say"),
    ],
)
def test_the_header_says_how_the_shutter_works(path, name, stated, rolling, said):
    frames = frames_of(2)
    head = header(CHIP, f'                <entry key="{name}" value="{stated}"/>')
    source = write(path, *(samples(frame, rolling=rolling) for frame in frames), head=head)
    assert same_frames(source.frames(), frames)
    assert all(said is not None and said in sentence for sentence in source.missing)
    assert bool(source.missing) == (said is not None)


@pytest.mark.parametrize("rolling", [False, True])
def test_preferences_of_older_versions_count_where_there_are_no_newer_ones(path, rolling):
    """jAER keeps what it once wrote under another name."""
    older = f'                <entry key="DAVIS240C.GlobalShutter" value="{str(not rolling).lower()}"/>'
    newer = older.replace("GlobalShutter", "APS.GlobalShutter")
    opposite = older.replace(str(not rolling).lower(), str(rolling).lower())
    frames = frames_of(2)
    reads = [samples(frame, rolling=rolling) for frame in frames]
    for lines in ((older,), (newer, opposite), (opposite, newer)):
        source = write(path, *reads, head=header(CHIP, *lines))
        assert same_frames(source.frames(), frames)
        assert any("rolling shutter;" in sentence for sentence in source.missing) == rolling
    # Of the same age, and not agreed: it is not known.
    source = write(path, *reads, head=header(CHIP, older, opposite.replace("Global", "global")))
    assert any("does not say" in sentence for sentence in source.missing)


def test_reads_that_are_interleaved_are_of_a_rolling_shutter(path):
    frames = frames_of(2, exposure=100)  # shorter than the readout
    source = write(path, *(samples(frame, rolling=True) for frame in frames))
    assert same_frames(source.frames(), frames)
    assert any("rolling" in sentence for sentence in source.missing)


def at_one_time(frame):
    """All reads of a frame at the time at which its exposure begins, as aedat4to2 writes them."""
    reads = samples(frame)
    reads[:, 1] = frame.exposure_start
    return np.concatenate([reads[reads[:, 0] & 0xC00 == 0], reads[reads[:, 0] & 0xC00 == 0x400]])


@pytest.mark.parametrize("stated", [None, "false", "true"])
def test_reads_that_all_have_one_time_say_nothing_of_the_exposure(path, stated):
    """It is unknown, not 0."""
    frames = frames_of(3)
    lines = [f'<entry key="DAVIS240C.APS.GlobalShutter" value="{stated}"/>'] if stated else []
    source = write(path, event_words(small_events()), *map(at_one_time, frames), head=header(CHIP, *lines))
    assert not source.exposure_known
    assert source.missing == ("The exposure times of the frames are not recorded.",)
    assert [(f.exposure_start, f.exposure_end) for f in source.frames()] == [
        (f.exposure_start, f.exposure_start) for f in frames
    ]
    recording = kalux.open(path, exposure=3_000, stamp="start")
    assert same_frames(recording.frames(), frames)


def test_frames_that_may_be_of_eight_bits_are_noted(path):
    frames = frames_of(2)
    small = [Frame(f.image % 256, f.exposure_start, f.exposure_end, 1023) for f in frames]
    noted = [
        any(
            "No pixel of the frames is above 255, and 1023 is taken for white" in text
            for text in source.missing
        )
        for source in (write(path, *map(samples, frames)), write(path, *map(samples, small)))
    ]
    assert noted == [False, True]


@pytest.mark.parametrize("cut", [1_000, SIZE[0] * SIZE[1] + 1_000])
def test_frames_that_are_incomplete_are_left_out(path, cut):
    """A recording begins within the resets or the signals of a frame, and words are lost."""
    frames = frames_of(5)
    reads = [samples(frame) for frame in frames]
    reads[0] = reads[0][cut:]
    reads[3] = np.delete(reads[3], 60_000, axis=0)
    source = write(path, event_words(small_events()), *reads)
    assert same_frames(source.frames(), [frames[1], frames[2], frames[4]])
    assert source.count_frames() == 3
    assert any("incomplete" in sentence for sentence in source.missing)


def test_a_signal_above_its_reset_is_black(path):
    reads = samples(frames_of(1)[0])
    reads[reads[:, 0] & 0xC00 == 0x400, 0] |= 0x3FF
    assert next(write(path, reads).frames()).image.max() == 0


def test_external_events_are_triggers_not_events(path):
    outside = words([1 << 10 | 3, 1 << 10 | 2, 1 << 10, 1 << 10 | 4, 3 << 10], [10, 20, 30, 40, 50])
    source = write(path, outside, event_words(small_events()))
    assert np.array_equal(all_events(source), small_events())
    edges = [tuple(edge) for chunk in source.triggers() for edge in chunk.tolist()]
    assert edges == [(10, 0, True), (20, 0, False)]


def test_times_go_on_where_their_bits_wrap_around(path):
    t = np.arange(1, 60) * (1 << 29) + 77
    events = make_events(t, np.arange(59), np.arange(59), np.arange(59) % 2)
    source = (path.write_bytes(header() + event_words(events).tobytes()), readers.read(path))[1]
    assert np.array_equal(all_events(source), events)


def test_times_may_begin_below_zero_and_stand_still_where_they_go_back_a_little(path):
    t = [0xFFFFFFF0, 0xFFFFFFF8, 0xFFFFFFF4, 5]
    path.write_bytes(header() + words([0] * 4, t).tobytes())
    assert all_events(readers.read(path))["t"].tolist() == [-16, -8, -8, 5]


def test_a_clock_that_goes_back_is_refused(path):
    path.write_bytes(header() + words([0] * 3, [50_000, 100_000, 7]).tobytes())
    with pytest.raises(FormatError, match="clock goes back from 100000 to 7 us at word 2"):
        readers.read(path)


def test_the_cut_of_the_blocks_makes_no_difference():
    frames = frames_of(2)
    data = in_time(event_words(small_events()), *map(samples, frames))
    joined = data.astype(np.uint64)
    joined = joined[:, 0] << np.uint64(32) | joined[:, 1]
    for size in (777, 50_000, len(joined)):
        blocks = [joined[i : i + size] for i in range(0, len(joined), size)]
        found = np.concatenate(list(evt.decode_events(aedat2._DAVIS, blocks, SIZE)))
        assert np.array_equal(found, small_events())
        images = [image for image, _ in aedat2.decode_frames(iter(blocks), SIZE)]
        assert all(np.array_equal(a, b.image) for a, b in zip(images, frames, strict=True))


def test_chunks_are_full_but_the_last(path):
    source = write(path, np.repeat(event_words(small_events(1)), CHUNK_EVENTS + 10, axis=0))
    assert [len(chunk) for chunk in source.events()] == [CHUNK_EVENTS, 10]


V2E = (
    b"#!AER-DAT2.0\r\n# This is a raw AE data file created by AEDat2Output in v2e (see https://github.com/SensorsINI/"
    b"v2e) as specified at https://inivation.com\r\n# Timestamps tick is 1 us\r\n# User name: peer\r\n"
)


@pytest.mark.parametrize("size", [(180, 240), (260, 346)])
def test_v2e_names_no_sensor_but_its_events_tell(path, size):
    """It writes files for two, which differ in their size."""
    events = small_events()
    if size != SIZE:
        events["x"][5], events["y"][5] = 3, 259
    path.write_bytes(V2E + event_words(events, size).tobytes())
    source = readers.read(path)
    assert (source.sensor_size, source.count_events()) == (size, len(events))
    assert np.array_equal(all_events(source), events)
    assert any("of the two that v2e writes" in text for text in source.missing)


def test_v2e_files_without_events_are_read(path):
    path.write_bytes(V2E)
    assert readers.read(path).count_events() == 0


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8", "gbk"])
@pytest.mark.parametrize("before", [True, False])
def test_a_header_may_have_letters_of_any_encoding(path, encoding, before):
    """Java writes the names of users and folders in the computer's own."""
    lines = header().splitlines(keepends=True)
    name = "张伟" if encoding == "gbk" else "Müller"
    lines.insert(1 if before else len(lines), f"# User name: {name}\r\n".encode(encoding))
    events = small_events()
    assert np.array_equal(all_events(write(path, event_words(events), head=b"".join(lines))), events)


def test_an_event_may_begin_with_the_byte_of_a_header_line(path):
    first = words([0x23 << 24 | 9 << 12, 0x23 << 24 | 0x0A << 12], [5, 10])
    assert len(all_events(write(path, first))) == 2
    # Of other bytes, too, that are no text but end as a line.
    first = words([0x2320E90A], [0x0D0A0D0A])
    assert len(all_events(write(path, first))) == 1


@pytest.mark.parametrize(
    ("chip", "message"),
    [
        (None, "does not say which sensor"),
        ("ch.unizh.ini.jaer.chip.retina.DVS128", "sensor DVS128 cannot be read"),
        ("eu.seebetter.ini.chips.davis.DavisRGBW640", "colour pixels"),
    ],
)
def test_what_cannot_be_read_is_said(path, chip, message):
    with pytest.raises(FormatError, match=message):
        write(path, event_words(small_events()), head=header(chip))


@pytest.mark.parametrize(
    ("chip", "size"), [("Davis346red", (260, 346)), ("Davis640", (480, 640)), ("DAVI346", (260, 346))]
)
def test_other_sensors_are_known(path, chip, size):
    source = write(path, event_words(small_events(), size), head=header(chip))
    assert source.sensor_size == size
    assert np.array_equal(all_events(source), small_events())


@pytest.mark.parametrize(
    ("chip", "mosaic"),
    [
        ("Davis346redColor", "RGGB"),
        ("Davis346BColor", "RGGB"),
        ("Davis640Color", "RGGB"),
        ("Davis128Color", "GRBG"),
        ("DAVIS346blue", None),
    ],
)
def test_sensors_in_colour_are_known_by_their_name(path, chip, mosaic):
    """The patterns of jAER begin at the lower left pixel; here rows are counted from the top."""
    events = event_words(small_events(), (100, 100))
    assert write(path, events, head=header(f"eu.seebetter.ini.chips.davis.{chip}")).mosaic == mosaic


def test_an_event_outside_the_sensor_is_refused(path):
    source = write(path, words([250 << 12], [5]))
    with pytest.raises(EventError, match="outside the sensor"):
        list(Recording(source).events())


def test_a_file_that_ends_within_an_event_is_refused(path):
    path.write_bytes(header() + event_words(small_events()).tobytes()[:-3])
    with pytest.raises(FormatError, match="cut short"):
        readers.read(path)


def test_damage_gives_clear_errors(path):
    data = header() + in_time(event_words(small_events()), samples(frames_of(1)[0])).tobytes()
    assert_only_clear_errors(path, damaged(data, 100, header=200))


# Real files


def test_a_real_recording_agrees_with_eventcv(shared_data):
    path = shared_data / "formats" / "davis240_dvs_imu.aedat"
    source = readers.read(path)
    ours = all_events(source)
    assert (source.sensor_size, source.count_events(), len(ours)) == (SIZE, 162_771, 162_771)
    assert (ours["t"][0], ours["t"][-1]) == (294_976_755, 297_049_406)
    assert list(source.frames()) == []
    assert any("no complete frames" in sentence for sentence in source.missing)
    eventcv = pytest.importorskip("eventcv")
    x, y, t, p = eventcv.load(str(path)).numpy().T.astype(np.int64)
    assert np.array_equal(ours["t"], t)
    assert np.array_equal(ours["x"], SIZE[1] - 1 - x)  # eventcv leaves the columns mirrored
    assert np.array_equal(ours["y"], y)
    assert np.array_equal(ours["p"], p > 0)


def test_a_damaged_real_file_gives_clear_errors(shared_data, path):
    data = (shared_data / "formats" / "davis240_dvs_imu.aedat").read_bytes()[:300_000]
    assert_only_clear_errors(path, damaged(data, 60))


def test_real_frames_and_events_come_back(shared_data, path):
    """Real payload, our writer: Newton's cradle, whose 8-bit frames are written as 10-bit samples."""
    real = readers.read(shared_data / "newton_davis346.aedat4")
    start = int(all_events(real)["t"][0]) - 1_000_000
    events = all_events(real)
    events["t"] -= start
    frames = [
        Frame(f.image.astype(np.uint16) * 3, f.exposure_start - start, f.exposure_end - start, 1023)
        for f in real.frames()
    ]
    head = header(
        "eu.seebetter.ini.chips.davis.Davis346blue",
        '<entry key="Davis346blue.APS.GlobalShutter" value="true"/>',
    )
    source = write(path, event_words(events, (260, 346)), *map(samples, frames), head=head)
    assert np.array_equal(all_events(source), events)
    assert same_frames(source.frames(), frames)
    assert source.missing == ()
