"""Rows of a rolling shutter, in their own time and brought to that of their frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux import PRESETS, Recording, reconstruct
from kalux.augmentation.rolling import carried, in_time_of_rows
from kalux.datasets import SensorSettings, photograph_scene, simulate
from kalux.datasets.motion import pan
from kalux.event_slices import whole_row_delays
from kalux.events import make_events
from kalux.frames import GroundTruth
from kalux.planning import plan
from kalux.settings import altered

from builders import blocks

DELAYS = whole_row_delays(3, 1000.0)
streams = st.lists(
    st.tuples(st.integers(0, 20_000), st.integers(0, 1), st.integers(0, 2), st.booleans()), max_size=30
)


def events_of(stream):
    t, x, y, p = zip(*sorted(stream, key=lambda event: event[0]), strict=True) if stream else ((),) * 4
    return make_events(*(np.array(column, np.int64) for column in (t, x, y, p)))


@given(streams, st.integers(0, 30))
def test_an_exposure_has_the_events_of_each_row_while_it_is_exposed(stream, cut):
    events = events_of(stream)
    chunks = [part for part in np.split(events, [min(cut, len(events))]) if len(part)]
    found = in_time_of_rows(chunks, DELAYS, 8_000, 11_000)
    assert all((np.diff(part["t"]) >= 0).all() for part in found)
    expected = sorted((t - DELAYS[y], x, y, p) for t, x, y, p in stream if 8_000 < t - DELAYS[y] <= 11_000)
    assert sorted((t, x, y, p) for part in found for t, x, y, p in part.tolist()) == expected


@given(streams)
def test_events_between_the_middles_of_row_and_frame_are_carried(stream):
    """Those after an upper row's come on top, those before a lower row's are taken back."""
    on, off, around = carried([events_of(stream)], DELAYS, 10_000, 2, weighed=False)
    expected = np.zeros((3, 3, 2))
    for t, x, y, p in stream:
        expected[2, y, x] += 9_000 < t <= 11_000
        if y == 0:
            expected[0 if p else 1, y, x] += 9_000 < t <= 10_000
        if y == 2:
            expected[0 if p else 1, y, x] -= 10_000 < t <= 11_000
    np.testing.assert_array_equal([on, off, around], expected)


def recorded(row_time):
    """Light that moves by a pixel while rows are exposed."""
    sensor = SensorSettings(threshold_on=0.2, threshold_off=0.2, row_time=row_time, exposure=2_000)
    scene = photograph_scene(blocks(0.05, 0.6), pan(60.0), sensor_size=(32, 40), duration=500_000)
    return simulate(scene, sensor).recording()


def upside_down(recording):
    events = np.concatenate([*recording.events()])
    events["y"] = recording.sensor_size[0] - 1 - events["y"]
    frames = [replace(frame, image=np.ascontiguousarray(frame.image[::-1])) for frame in recording.frames()]
    truth = recording.ground_truth()
    return Recording.from_arrays(
        events,
        frames,
        sensor_size=recording.sensor_size,
        contrast_threshold=recording.contrast_threshold,
        ground_truth=GroundTruth(truth.times, [image[::-1] for image in truth.images]),
    )


def error(recording, row_time=0.0, *, smooth=False):
    """Root mean square of log intensity."""
    truth = recording.ground_truth()
    settings = altered(PRESETS["default"], "camera", row_time=row_time)
    images = reconstruct(recording, times=truth.times, settings=settings, smooth=smooth)
    off = [
        np.log(image.intensity + 0.03) - np.log(true + 0.03)
        for image, true in zip(images, truth.images, strict=True)
    ]
    return float(np.sqrt(np.mean(np.square(off))))


@pytest.mark.parametrize("smooth", [False, True])
def test_a_rolling_shutter_that_is_told_costs_little(smooth):
    """Whichever end it begins at."""
    at_once, rolling = error(recorded(0.0), smooth=smooth), recorded(500.0)
    assert error(rolling, 500.0, smooth=smooth) < 1.3 * at_once
    assert error(upside_down(rolling), -500.0, smooth=smooth) < 1.3 * at_once
    assert error(rolling, smooth=smooth) > 2 * at_once


def test_all_is_estimated_as_if_rows_were_exposed_at_once():
    recording = recorded(1_000.0)
    settings = altered(PRESETS["default"], "camera", row_time=1_000.0)
    rolling, ignored = (plan(recording, at="frames", settings=s) for s in (settings, PRESETS["default"]))
    assert rolling.settings.camera.row_time == 1_000.0
    assert ignored.settings.camera.row_time == 0.0
    assert rolling.settings.events.step_variance < 0.5 * ignored.settings.events.step_variance


@pytest.mark.parametrize("lookahead", [True, False])
def test_images_do_not_depend_on_how_events_come(lookahead):
    """Nor without lookahead, where the lower rows of a frame are exposed while images after its end are asked for."""
    recording = recorded(300.0)
    settings = altered(PRESETS["default"], "camera", row_time=300.0)
    events = np.concatenate([*recording.events()])
    found = []
    for length in (len(events), 37):
        recording.source = replace(
            recording.source,
            events=lambda n=length: (events[i : i + n] for i in range(0, len(events), n)),
        )
        images = reconstruct(recording, rate_hz=211, settings=settings, lookahead=lookahead)
        found.append([(image.intensity, image.variance) for image in images])
    np.testing.assert_array_equal(*found)
