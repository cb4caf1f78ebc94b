"""Intervals between frames, which all calibrations look at."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from kalux import Frame, Recording
from kalux.calibration.intervals import (
    APART,
    APART_IN_TIME,
    SOON_FOR_THRESHOLDS,
    frames_apart,
    intervals,
    spread,
)
from kalux.events import EVENT_DTYPE
from kalux.settings import CameraSettings

from builders import frame, pixel_events, random_stream

CAMERA = CameraSettings(reference_exposure=10_000)


def recording(stream, chunk):
    whole = Recording.from_arrays(stream.events, stream.frames, sensor_size=stream.sensor_size)
    parts = [stream.events[i : i + chunk] for i in range(0, len(stream.events), chunk)]
    return Recording(dataclasses.replace(whole.source, events=lambda: iter(parts)))


@pytest.mark.parametrize("chunk", [1, 7, 10_000])
@pytest.mark.parametrize("margin", [0, 12_000])
def test_every_interval_has_its_events_whatever_the_chunks(chunk, margin):
    """Also those of the margin before the first frame, where a chunk ends within it."""
    stream = random_stream(4)
    found = list(intervals(recording(stream, chunk), CAMERA, margin=margin, most_frames=100))
    middles = [shot.middle for shot in stream.frames]
    assert [(i.start, i.end) for i in found] == list(itertools.pairwise(middles))
    for interval in found:
        t = stream.events["t"]
        inside = (t > interval.start - margin) & (t <= interval.end + margin)
        np.testing.assert_array_equal(interval.events, stream.events[inside])


def frames_at(*milliseconds):
    """Frames with these middles."""
    return [frame([[100]], 1_000 * t - 500, 1_000 * t + 500) for t in milliseconds]


@pytest.mark.parametrize(
    ("recorded", "left"),
    [
        (range(0, 200, 40), [0, 40, 80, 120, 160]),
        (range(0, 100, 20), [0, 20, 40, 60, 80]),  # of 50 a second all
        (range(0, 125, 10), [0, 40, 80, 120]),
        (range(0, 125, 2), [0, 38, 76, 114]),
        ([0, 2, 30, 32, 34, 60, 61], [0, 30, 60]),  # after a gap the next one
        ([], []),
    ],
)
def test_frames_that_follow_too_soon_are_passed_over(recorded, left):
    found = frames_apart(frames_at(*recorded), APART)
    assert [each.middle for each in found] == [1_000 * t for t in left]


@pytest.mark.parametrize(
    ("recorded", "left"),
    [
        (range(0, 140, 33), [0, 33, 66, 99, 132]),  # of 30 a second all
        (range(0, 110, 25), [0, 50, 100]),
        (range(0, 100, 20), [0, 40, 80]),
        (range(0, 125, 10), [0, 40, 80, 120]),
    ],
)
def test_frames_for_thresholds_are_farther_apart(recorded, left):
    found = frames_apart(frames_at(*recorded), APART, SOON_FOR_THRESHOLDS)
    assert [each.middle for each in found] == [1_000 * t for t in left]


def test_delays_are_looked_for_in_short_intervals_whatever_is_soon():
    found = frames_apart(frames_at(*range(0, 100, 20)), APART_IN_TIME, SOON_FOR_THRESHOLDS)
    assert len(list(found)) == 5


def test_intervals_of_frames_that_follow_soon_are_long_and_have_all_their_events():
    """Events during the frames passed over, too; and only the frames that are left are counted."""
    events = pixel_events(range(500, 200_000, 1_000), [1] * 200)
    rec = Recording.from_arrays(events, frames_at(*range(1, 200, 2)), sensor_size=(1, 1))
    found = list(intervals(rec, CAMERA, margin=0, most_frames=4))
    assert [(i.start, i.end) for i in found] == [(1_000, 39_000), (39_000, 77_000), (77_000, 115_000)]
    assert [len(i.events) for i in found] == [38, 38, 38]
    assert len(list(intervals(rec, CAMERA, margin=0, most_frames=4, apart=18_000))) == 3
    successive = list(intervals(rec, CAMERA, margin=0, most_frames=100, apart=0))
    assert [i.end - i.start for i in successive] == [2_000] * 99


def test_change_level_and_what_is_usable():
    frames = [frame([[51, 255, 0]], 0, 10_000), frame([[102, 100, 100]], 40_000, 50_000)]
    events = pixel_events([20_000], [1])
    rec = Recording.from_arrays(events, frames, sensor_size=(1, 3))
    (interval,) = intervals(rec, CAMERA, margin=0, most_frames=2)
    assert interval.usable.tolist() == [[True, False, False]]  # saturated, black
    assert interval.change[0, 0] == pytest.approx(np.log(0.43 / 0.23))
    assert interval.level[0, 0] == pytest.approx(0.3)


def test_what_a_stated_saturation_clips_is_not_usable():
    """A sensor that ends at 112 of 255 stays there however bright it is: its events seem to change nothing."""
    frames = [frame([[51, 112, 90]], 0, 10_000), frame([[102, 112, 120]], 40_000, 50_000)]
    rec = Recording.from_arrays(pixel_events([20_000], [1]), frames, sensor_size=(1, 3))
    camera = dataclasses.replace(CAMERA, saturation=0.43)
    (interval,) = intervals(rec, camera, margin=0, most_frames=2)
    assert interval.usable.tolist() == [[True, False, False]]


def test_no_more_frames_than_asked_for():
    assert len(list(intervals(recording(random_stream(4), 50), CAMERA, margin=0, most_frames=2))) == 1


def test_pixels_that_are_not_valid_are_not_usable():
    frames = [frame([[51, 60, 70]], 0, 10_000), frame([[102, 100, 100]], 40_000, 50_000)]
    masks = np.array([[True, True, False]]), np.array([[True, False, True]])
    masked = [dataclasses.replace(f, valid=m) for f, m in zip(frames, masks, strict=True)]
    rec = Recording.from_arrays(pixel_events([20_000], [1]), masked, sensor_size=(1, 3))
    (interval,) = intervals(rec, CAMERA, margin=0, most_frames=2)
    assert interval.usable.tolist() == [[True, False, False]]


def test_of_many_pixels_some_are_taken_evenly():
    chosen = np.arange(100).reshape(10, 10) % 3 == 0  # 34 pixels
    np.testing.assert_array_equal(spread(chosen, 34), np.arange(0, 100, 3))
    np.testing.assert_array_equal(spread(chosen, 17), np.arange(0, 100, 6))
    some = spread(chosen, 7)
    assert len(some) == 7
    assert set(np.diff(some)) == {12, 15}
    assert len(spread(chosen, 0)) == 0


def test_what_a_response_that_is_steep_in_the_dark_shows_brightly_is_not_well_exposed():
    """A twentieth of the light is 0.25 of an sRGB frame's white, and what it shows at 0.12 is lost in I_0 and noise."""
    values = np.array([[10, 30, 70, 200, 250]], np.uint8)
    frames = [Frame(values, t, t + 10_000) for t in (0, 40_000)]
    silent = Recording.from_arrays(np.empty(0, EVENT_DTYPE), frames, sensor_size=values.shape)
    for response, expected in (("linear", [0, 1, 1, 1, 0]), ("srgb", [0, 0, 1, 1, 0])):
        camera = CameraSettings(response=response, log_offset=0.03, reference_exposure=10_000)
        (interval,) = intervals(silent, camera, margin=0, most_frames=2)
        np.testing.assert_array_equal(interval.usable[0], expected)
