"""Pixels of frames that always show the same, and those that only look like it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import kalux
from kalux import Recording
from kalux.calibration.stuck_pixels import RangeWatch
from kalux.planning import plan

from builders import moving_blocks

SIZE = (32, 40)


def moving():
    made = moving_blocks(0.02, 1.5, duration=1_000_000)
    return made.events, made.frames


def with_pixels(frames, value, *pixels, channels=0):
    """Frames in which these (x, y) always have one value."""
    made = []
    for frame in frames:
        image = frame.image.copy()
        for x, y in pixels:
            image[y, x] = value
        image = np.stack([image] * channels, axis=-1) if channels else image
        made.append(dataclasses.replace(frame, image=image))
    return made


def found(events, frames, **options):
    source, watch = Recording.from_arrays(events, frames, sensor_size=SIZE, **options), RangeWatch()
    for frame in source.frames():
        watch.see(frame)
    stuck = watch.stuck(source)
    return [] if stuck is None else [(int(x), int(y)) for y, x in zip(*np.nonzero(stuck), strict=True)]


def test_none_is_found_where_none_is_stuck():
    assert found(*moving()) == []


@pytest.mark.parametrize("channels", [0, 3])
@pytest.mark.parametrize("value", [0, 128, 255])
def test_a_stuck_pixel_is_found(value, channels):
    events, frames = moving()
    assert found(events, with_pixels(frames, value, (20, 16), (0, 0), channels=channels)) == [
        (0, 0),
        (20, 16),
    ]


def dimmed(frames, share, least=0):
    """The frames with so much of their light, on top of a least level."""
    return [
        dataclasses.replace(frame, image=(least + share * frame.image).astype(frame.image.dtype))
        for frame in frames
    ]


def few(events, share):
    """Evenly spread events of every pixel, so that each has a share of its own."""
    order = np.lexsort((events["t"], events["x"], events["y"]))
    return events[np.sort(order[:: round(1 / share)])]


@pytest.mark.parametrize("mosaic", [None, "RGGB"])
@pytest.mark.parametrize("value", [0, 255])
def test_it_is_found_among_neighbours_that_change_little(value, mosaic):
    """Darker, or brighter, than each of them in every frame, by a twentieth of white."""
    events, frames = moving()
    dim = [dataclasses.replace(frame, mosaic=mosaic) for frame in dimmed(frames, 0.3, 20)]
    assert found(events, with_pixels(dim, value, (20, 16))) == [(20, 16)]
    assert found(events, with_pixels(dim, int(dim[0].image.min()) + 5, (20, 16))) == []


def test_few_events_are_enough_where_no_neighbour_is_like_it():
    events, frames = moving()
    median = np.median(np.bincount(events["y"].astype(int) * 40 + events["x"], minlength=32 * 40))
    dim = with_pixels(dimmed(frames, 0.3, 20), 255, (20, 16))
    assert found(few(events, 5 / median), dim) == [(20, 16)]
    assert found(few(events, 2 / median), dim) == []


def test_a_black_hole_is_stuck_without_any_event_and_a_dark_spot_is_not():
    """No lens draws a single pixel that is black while all around it are bright, in every frame."""
    events, frames = moving()
    still = [
        dataclasses.replace(frame, image=np.full_like(frame.image, 60 + i % 9))
        for i, frame in enumerate(frames)
    ]
    assert found(events[:0], with_pixels(still, 0, (20, 16))) == [(20, 16)]
    for level in (20, 255):
        assert found(events[:0], with_pixels(still, level, (20, 16))) == []


def test_two_side_by_side_are_found():
    events, frames = moving()
    assert found(events, with_pixels(frames, 0, (20, 16), (21, 16))) == [(20, 16), (21, 16)]


def test_what_has_no_events_is_a_lamp():
    events, frames = moving()
    events = events[(events["x"] != 20) | (events["y"] != 16)]
    assert found(events, with_pixels(frames, 255, (20, 16))) == []


def test_few_frames_tell_nothing():
    events, frames = moving()
    assert found(events, with_pixels(frames, 0, (20, 16))[:9]) == []


def test_a_caption_is_no_stuck_pixel():
    events, frames = moving()
    caption = [(x, y) for x in range(10, 20) for y in range(3, 8)]
    assert found(events, with_pixels(frames, 255, *caption)) == []


def test_a_plan_takes_the_neighbours_for_it():
    events, frames = moving()
    source = Recording.from_arrays(events, with_pixels(frames, 0, (20, 16)), sensor_size=SIZE)
    made = plan(source, at="frames")
    assert made.mends.faults is not None
    assert np.argwhere(made.mends.faults.stuck).tolist() == [[16, 20]]
    good = Recording.from_arrays(events, frames, sensor_size=SIZE)
    clean, mended = (
        np.stack([image.intensity[16, 20] for image in kalux.reconstruct(each, at="frames")])
        for each in (good, source)
    )
    assert np.abs(np.log(mended / clean)).mean() < 0.5
