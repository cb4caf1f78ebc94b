"""The check of a recording, alone and beside other work."""

from __future__ import annotations

import dataclasses
import threading

import numpy as np
import pytest

from kalux import Recording
from kalux.cli.checking import check_beside, check_recording
from kalux.errors import EventError, InputError
from kalux.readers.source import Lost

from builders import events, frame, moving_blocks, random_stream

STREAM = random_stream(5)
WHOLE = Recording.from_arrays(STREAM.events, STREAM.frames, sensor_size=STREAM.sensor_size)


def in_parts(parts):
    return Recording(dataclasses.replace(WHOLE.source, events=lambda: iter(parts)))


BACKWARDS = in_parts([STREAM.events[100:], STREAM.events[:100]])


def test_contents():
    start, end = STREAM.frames[0].exposure_start, STREAM.frames[-1].exposure_end
    counts = []
    found = check_recording(in_parts([STREAM.events[:100], STREAM.events[100:]]), counts.append)
    assert counts == [100, len(STREAM.events) - 100]
    assert (found.frames, found.events, found.start, found.end) == (
        len(STREAM.frames),
        len(STREAM.events),
        start,
        end,
    )
    t = STREAM.events["t"]
    assert found.events_between == ((t >= start) & (t <= end)).sum()


def test_events_in_another_unit_are_doubted():
    """Of nanoseconds taken as microseconds a thousandth lies between the frames."""
    late = STREAM.events.copy()
    late["t"] = (late["t"] - late["t"][0]) * 1000 + late["t"][0]
    found = check_recording(in_parts([late]), lambda count: None)
    assert 0 < found.events_between < 0.1 * found.events
    assert any("same unit and clock" in text for text in found.warnings())
    assert not list(check_recording(WHOLE, lambda count: None).warnings())


def test_of_one_frame_no_clock_is_doubted():
    """Nothing lies between the first frame and the last but its exposure."""
    frames = list(WHOLE.frames())[:1]
    one = Recording.from_arrays(STREAM.events, frames, sensor_size=WHOLE.sensor_size)
    assert not list(check_recording(one, lambda count: None).warnings())


def test_a_last_exposure_longer_than_the_frame_intervals_is_doubted():
    *others, last = STREAM.frames
    damaged = [*others, dataclasses.replace(last, exposure_end=last.exposure_end + 10**6)]
    doubtful = Recording(dataclasses.replace(WHOLE.source, frames=lambda: iter(damaged)))
    (warning,) = check_recording(doubtful, lambda count: None).warnings()
    assert warning.startswith("the last frame is exposed for")


def test_enough_are_those_after_the_first_frame_begins():
    first = STREAM.frames[0].exposure_start
    early = STREAM.events[:60].copy()
    early["t"] = np.arange(first - 60, first)
    later = STREAM.events[STREAM.events["t"] >= first]
    wrong = STREAM.events[:1]
    parts = [early, later[:100], later[100:130], later[130:140], wrong]
    found = check_recording(in_parts(parts), lambda count: None, 101)
    assert (found.events, found.complete) == (190, False)
    assert found.events_between == (later["t"][:130] <= STREAM.frames[-1].exposure_end).sum()
    assert not list(found.warnings())
    with pytest.raises(EventError, match="event 200"):
        check_recording(in_parts(parts), lambda count: None, 131)
    assert check_recording(in_parts(parts[:4]), lambda count: None, 131).complete


def test_a_long_time_without_a_frame_is_told():
    def frames(*starts):
        return Recording.from_arrays(
            events(), [frame(9, t, t + 1000) for t in starts], sensor_size=(1, 1), contrast_threshold=0.2
        )

    usual = range(0, 200_000, 40_000)
    found = check_recording(frames(*usual, 20_000_000), lambda _: None)
    assert found.gap == (161_000, 20_000_000)
    assert check_recording(frames(*usual, 5_000_000), lambda _: None).gap is None
    slow = (0, 60_000_000, 120_000_000, 300_000_000)  # a picture a minute, two missed
    assert check_recording(frames(*slow), lambda _: None).gap is None
    assert check_recording(frames(0), lambda _: None).gap is None


def test_events_that_are_missing_while_frames_change_are_told():
    made = moving_blocks(duration=1_000_000)
    t = made.events["t"]

    def silence(missing, frames=made.frames):
        source = Recording.from_arrays(made.events[~missing], frames, sensor_size=made.scene.sensor_size)
        found = check_recording(source, lambda _: None)
        return found.silence, list(found.warnings())

    assert silence(t < 0) == (None, [])
    for first, last in ((0, 0.4), (0.3, 0.7), (0.6, 1.0)):
        (begin, end), told = silence((t >= 1e6 * first) & (t <= 1e6 * last))
        assert (begin, end) == (
            pytest.approx(max(1e6 * first, made.frames[0].exposure_start), abs=10_000),
            pytest.approx(min(1e6 * last, made.frames[-1].exposure_end), abs=10_000),
        )
        assert "there is no event from" in told[0]
    still = [
        dataclasses.replace(f, image=made.frames[7].image) if 300_000 < f.middle < 700_000 else f
        for f in made.frames
    ]
    assert silence((t >= 300_000) & (t <= 700_000), still) == (None, [])


def test_moments_without_events_between_frames_are_told_where_there_are_many():
    made = moving_blocks(duration=1_000_000)
    t = made.events["t"]

    def told(length, *moments):
        missing = np.any([(t > moment) & (t < moment + length) for moment in moments], axis=0)
        source = Recording.from_arrays(made.events[~missing], made.frames, sensor_size=made.scene.sensor_size)
        found = check_recording(source, lambda _: None)
        return found, list(found.warnings())

    middles = [frame.middle for frame in made.frames]
    found, (warning,) = told(15_000, *(middle + 8_000 for middle in middles[3:15:2]))
    assert (found.missing.intervals, found.missing.lossy) == (len(made.frames) - 1, 6)
    assert found.missing.time == pytest.approx(6 * 15_000, rel=0.05)
    assert found.missing.first == middles[3]
    assert "in 6 of 23 intervals between frames, the first after" in warning
    assert "what changed then is told by the frames alone" in warning
    once, nothing = told(5_000, middles[3] + 8_000)
    assert (once.missing.lossy, once.missing.time < 5_500, nothing) == (1, True, [])


def test_packets_that_are_missing_are_told_from_the_first_frame_up_to_what_was_checked():
    made, asked = moving_blocks(), []
    rec = made.recording()
    last = int(made.events["t"][-1])
    rec.source = dataclasses.replace(rec.source, lost=lambda *times: asked.append(times) or Lost(3, 250_000))
    found = check_recording(rec, lambda _: None)
    assert asked == [(found.start, min(last, found.end))]
    told = f"3 packets of events are missing by their numbers, the first before {(250_000 - found.start) * 1e-6:.3f} s"
    assert [text for text in found.warnings() if text.startswith(told)]


def test_every_silence_counts():
    """The longest is named, the others are counted."""
    made = moving_blocks(duration=1_000_000)
    t = made.events["t"]
    kept = made.events[((t < 100_000) | (t > 350_000)) & ((t < 500_000) | (t > 900_000))]
    source = Recording.from_arrays(kept, made.frames, sensor_size=made.scene.sensor_size)
    found = check_recording(source, lambda _: None)
    assert found.more_silences == 1
    (told,) = found.warnings()
    assert ", nor in 1 more such time, though" in told
    (told,) = found.warnings(of_images=False)
    assert told.endswith("were events lost?")


@pytest.mark.parametrize("polarity", [True, False])
def test_events_of_one_polarity_alone_are_told(polarity):
    made = moving_blocks()
    kept = made.events[made.events["p"] == polarity]
    source = Recording.from_arrays(kept, made.frames, sensor_size=made.scene.sensor_size)
    (told,) = check_recording(source, lambda _: None).warnings()
    assert told.startswith(f"all {len(kept):,} events are {'ON' if polarity else 'OFF'}")


@pytest.mark.parametrize("moves_beside", [True, False])
def test_events_of_a_part_of_the_sensor_are_told_if_frames_change_elsewhere(moves_beside):
    """Of a region of interest; not where nothing else moves."""
    made = moving_blocks()
    e = made.events
    kept = e[(e["y"] >= 8) & (e["y"] < 20) & (e["x"] >= 10) & (e["x"] < 25)]
    frames = []
    for each in made.frames:
        image = each.image.copy() if moves_beside else np.full_like(each.image, 40)
        image[8:20, 10:25] = each.image[8:20, 10:25]
        frames.append(dataclasses.replace(each, image=image))
    source = Recording.from_arrays(kept, frames, sensor_size=made.scene.sensor_size)
    found = check_recording(source, lambda _: None)
    told = [*found.warnings()]
    assert (found.region is not None) == moves_beside
    assert any("outside rows 8 to 19 and columns 10 to 24" in text for text in told) == moves_beside


@pytest.mark.parametrize(("level", "shows"), [(0, False), (255, False), (252, False), (30, True)])
def test_frames_that_are_all_black_or_all_white_show_nothing(level, shows):
    made = moving_blocks()
    flat = [dataclasses.replace(f, image=np.full_like(f.image, level)) for f in made.frames]
    source = Recording.from_arrays(made.events, flat, sensor_size=made.scene.sensor_size)
    told = [*check_recording(source, lambda _: None).warnings()]
    assert any("no pixel of the frames lies between black and white" in text for text in told) != shows


@pytest.mark.parametrize("threads", [1, 2])
def test_both_results_come_back(threads):
    ran_in = []
    found, made = check_beside(
        WHOLE, lambda _: ran_in.append(threading.current_thread()), lambda: "made", threads
    )
    assert (found, made) == (check_recording(WHOLE, lambda _: None), "made")
    assert (ran_in[0] is threading.current_thread()) == (threads == 1)


@pytest.mark.parametrize("threads", [1, 2])
def test_what_is_wrong_with_the_recording_is_told_first(threads):
    def refuse():
        raise InputError("the work has failed")

    with pytest.raises(EventError, match="event 50"):
        check_beside(BACKWARDS, lambda _: None, refuse, threads)
    with pytest.raises(EventError, match="event 50"):
        check_beside(BACKWARDS, lambda _: None, lambda: None, threads)
    with pytest.raises(InputError, match="the work has failed"):
        check_beside(WHOLE, lambda _: None, refuse, threads)


def test_an_interrupt_of_the_work_ends_the_check():
    """Within a chunk: the parts of this recording would never end."""
    begun = threading.Event()
    counts = []

    def parts():
        yield STREAM.events
        begun.set()
        while True:
            yield STREAM.events[-1:]

    def interrupted():
        begun.wait(10)
        raise KeyboardInterrupt

    endless = Recording(dataclasses.replace(WHOLE.source, events=parts))
    with pytest.raises(KeyboardInterrupt):
        check_beside(endless, counts.append, interrupted, 2)
    assert counts
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("kalux-check")]
