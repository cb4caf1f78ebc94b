"""The description of a recording: numbers worked out by hand, absent streams, real recordings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux import recording
from kalux.events import EVENT_DTYPE, make_events
from kalux.frames import Frame, GroundTruth
from kalux.info import describe, format_description, summarise_events, summarise_frames
from kalux.recording import Recording
from kalux.writers import hdf5
from recordings import SIZE, small_events, small_frames


def events_at(times):
    times = np.array(times, np.int64)
    zeros = np.zeros(len(times), np.int64)
    return make_events(times, zeros, zeros, np.arange(len(times)) % 2)


def test_events_by_hand():
    summary = summarise_events([events_at([1_000, 2_000, 10_500]), events_at([10_900, 40_000, 101_000])])
    assert (summary.count, summary.on_share, summary.first, summary.last) == (
        6,
        2 / 6,
        1_000,
        101_000,
    )
    assert summary.mean_rate == pytest.approx(60)
    assert summary.peak_rate == pytest.approx(400)  # four in the first 10 ms, over two chunks
    assert summary.largest_gap == 61_000


@given(st.lists(st.integers(0, 300_000), max_size=60).map(sorted), st.integers(1, 20))
def test_event_numbers_do_not_depend_on_chunks(times, size):
    whole = events_at(times)
    parts = [whole[i : i + size] for i in range(0, len(whole), size)]
    assert summarise_events(parts) == summarise_events([whole])
    if times:
        bins = np.bincount((np.array(times) - times[0]) // 10_000)
        assert summarise_events(parts).peak_rate == pytest.approx(bins.max() * 100)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ([0, 2_500, 5_000], "600 events/s on average"),
        ([0, 2_500, 5_000, 7_500, 10_000, 12_500], "480 events/s on average"),
        ([0, 2_500, 5_000, 7_500, 20_000], "250 events/s on average, 400 events/s in the busiest 10 ms"),
    ],
)
def test_no_10_ms_are_the_busiest_that_have_less_than_on_average(times, said):
    """Of a short recording the busiest 10 ms were said to have fewer events a second than the average."""
    recording = Recording.from_arrays(events_at(times), [], sensor_size=(1, 1))
    lines = format_description(describe(recording)).splitlines()
    assert [line.strip() for line in lines if "on average" in line] == [said]


def test_frames_by_hand():
    image = np.zeros((10, 10), np.uint8)
    image[0] = 255
    image[1] = 253  # at least 0.99 of white
    image[2] = 252
    image[3] = 6  # over 2 % of white
    starts = [0, 1_000, 2_000, 4_000, 5_000]
    summary = summarise_frames([Frame(image, start, start + 100 + i) for i, start in enumerate(starts)])
    assert (summary.count, summary.first, summary.last) == (5, 0, 5_104)
    assert summary.rate == pytest.approx(1_000)
    assert (summary.exposure_min, summary.exposure_median, summary.exposure_max) == (100, 102, 104)
    assert summary.saturated_share == pytest.approx(0.2)
    assert summary.near_black_share == pytest.approx(0.6)
    assert (summary.gap_count, summary.largest_gap) == (1, 2_000)


def test_white_of_each_type_counts():
    image = np.array([[0, 20, 21, 1013, 1023]], np.uint16)
    summary = summarise_frames([Frame(image, 0, 1, white=1023)])
    assert (summary.near_black_share, summary.saturated_share) == (0.4, 0.4)


def test_of_colours_pixels_count_not_channels():
    """Saturated is a pixel with a channel that is; near black one of which all are."""
    image = np.zeros((1, 4, 3), np.uint8)
    image[0, 0], image[0, 1], image[0, 2] = (255, 255, 153), (0, 0, 255), (0, 0, 90)
    summary = summarise_frames([Frame(image, 0, 1)])
    assert (summary.near_black_share, summary.saturated_share) == (0.25, 0.5)


def test_a_whole_recording():
    reference = GroundTruth(np.array([1]), np.ones((1, *SIZE), np.float32))
    rec = Recording.from_arrays(
        small_events(),
        small_frames(),
        sensor_size=SIZE,
        contrast_threshold=(0.1, 0.2),
        ground_truth=reference,
    )
    found = describe(rec)
    assert found.overlap == 63_003 - max(0, found.events.first)
    assert found.has_ground_truth
    text = format_description(found)
    for part in (
        "40 x 30 pixels",
        "500",
        "ON 0.1, OFF 0.2 as recorded",
        "ground truth",
    ):
        assert part in text
    assert not text.endswith("\n")


@pytest.mark.parametrize(
    ("mosaic", "image", "said"),
    [
        (None, np.zeros((4, 6), np.uint8), None),
        (None, np.zeros((4, 6, 3), np.uint8), "RGB frames; events are taken as those of a sensor without"),
        ("RGGB", np.zeros((4, 6), np.uint8), "Bayer mosaic RGGB"),
        ("RGGB", np.zeros((4, 6, 3), np.uint8), "Bayer mosaic RGGB, stored as RGB that was made of it"),
    ],
)
def test_colours_are_said(mosaic, image, said):
    made = Recording.from_arrays(np.empty(0, EVENT_DTYPE), [Frame(image, 0, 10)], sensor_size=(4, 6))
    text = format_description(describe(Recording(made.source, mosaic=mosaic)))
    lines = [line.split(maxsplit=1)[1] for line in text.splitlines() if line.split()[0] == "colour"]
    assert [line.startswith(said) for line in lines] == ([True] if said else [])


def test_a_last_exposure_that_is_doubtful_is_noted():
    *others, last = small_frames()
    with pytest.warns(UserWarning, match="the last frame is exposed"):
        rec = Recording.from_arrays(
            small_events(),
            [*others, Frame(last.image, last.exposure_start, last.exposure_end + 10**6)],
            sensor_size=SIZE,
        )
    assert "note       the last frame is exposed for" in format_description(describe(rec))
    assert summarise_frames(rec.frames(), exposure_known=False).doubt is None


def test_streams_that_do_not_overlap():
    late = small_events()
    late["t"] += 10**6
    with pytest.warns(UserWarning, match="none of the 500 events lies between"):
        recording = Recording.from_arrays(late, small_frames(), sensor_size=SIZE)
    found = describe(recording)
    assert found.overlap == 0
    assert "do not overlap" in format_description(found)


@pytest.mark.parametrize("events", [[], [7], [7, 7]])
@pytest.mark.parametrize("frames", [0, 1, 2])
def test_little_or_nothing(events, frames):
    rec = Recording.from_arrays(events_at(events), small_frames(frames), sensor_size=SIZE)
    found = describe(rec)
    assert (found.events.count, found.frames.count) == (len(events), frames)
    assert (found.overlap is None) == (not events or not frames)
    text = format_description(found)
    assert ("events     none" in text) == (not events)
    assert ("frames     none" in text) == (not frames)
    assert "nan" not in text
    assert "None" not in text


def test_unknown_exposures(tmp_path):
    path = tmp_path / "stamped.h5"
    frames = [Frame(frame.image, frame.middle, frame.middle) for frame in small_frames()]
    hdf5.write(path, sensor_size=SIZE, events=[small_events()], frames=frames, exposure_known=False)
    found = describe(recording.open(path))
    assert found.frames.exposure_min is found.frames.exposure_median is found.frames.exposure_max is None
    assert "exposure   unknown" in format_description(found)
    given_exposure = describe(recording.open(path, exposure=700))
    assert "exposure   700 us" in format_description(given_exposure)


def test_real_recordings(shared_data):
    street = describe(recording.open(shared_data / "street_davis346.aedat4"))
    assert street.events.count == 78_830
    assert street.frames.exposure_min == street.frames.exposure_max == 500
    assert street.frames.rate == pytest.approx(25, rel=0.01)
    assert street.frames.saturated_share == pytest.approx(0.0145, abs=0.001)
    assert street.frames.near_black_share == pytest.approx(0.019, abs=0.001)
    events_only = format_description(describe(recording.open(shared_data / "formats" / "dvxplorer.aedat4")))
    assert "frames     none" in events_only
    assert "The file has no frames." in events_only


@pytest.mark.parametrize(
    ("response", "told"),
    [("s-curve:0.1", "s-curve:0.1, as recorded"), ("curve:0 0.2 1", "curve of 3 knots, as recorded")],
)
def test_a_response_that_is_recorded_is_told(tmp_path, response, told):
    path = tmp_path / "rec.h5"
    hdf5.write(path, sensor_size=SIZE, events=[small_events()], frames=small_frames(), response=response)
    assert told in format_description(describe(recording.open(path)))
