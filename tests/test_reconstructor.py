"""The engine: the same bits whatever the way in, finality, every edge of a stream, and errors that say where."""

from __future__ import annotations

import re
import warnings
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalux import PRESETS, Calibration, Frame, Reconstructor, Recording, reconstruct
from kalux.errors import EventError, ExposureError, FrameError, InputError, KaluxError, SettingsError
from kalux.filters import bridged_frames
from kalux.models.camera import Camera, count_bright
from kalux.settings import altered

from builders import VARIANTS, Stream, events, frame, pixel_events, random_stream

HOUR = 3_600_000_000
THRESHOLD = (0.25, 0.2)

every_variant = pytest.mark.parametrize("variant", VARIANTS)
both_modes = pytest.mark.parametrize("lookahead", [True, False], ids=["lookahead", "causal"])


def engine(sensor_size, variant="default", lookahead=True, **arguments):
    arguments = {"contrast_threshold": THRESHOLD, "reference_exposure": 10_000} | arguments
    return Reconstructor(sensor_size, settings=VARIANTS[variant], lookahead=lookahead, **arguments)


def filled(stream: Stream, variant="default", lookahead=True, finished=True, **arguments):
    """An engine to which all of a stream has been pushed, frames first."""
    out = engine(stream.sensor_size, variant, lookahead, **arguments)
    for shot in stream.frames:
        out.push_frame(shot)
    out.push_events(stream.events)
    if finished:
        out.finish()
    return out


def target_times(stream: Stream):
    """From the first time that every variant can read to after the last frame: a grid, and all exposure edges."""
    first, last = stream.frames[0].exposure_end, stream.frames[-1].exposure_end
    edges = [t for f in stream.frames for t in (f.exposure_start, f.middle, f.exposure_end)]
    grid = range(first, last + 15_000, 3_001)
    return sorted({t for t in (*edges, *grid) if t >= first})


@lru_cache(maxsize=256)
def reference(seed, variant, lookahead):
    """Images of a random stream, all pushed at once and read in order, by time."""
    stream = random_stream(seed)
    whole = filled(stream, variant, lookahead)
    return {t: whole.read(t) for t in target_times(stream)}


def assert_same(image, expected):
    np.testing.assert_array_equal(image.intensity, expected.intensity)
    np.testing.assert_array_equal(image.variance, expected.variance)


@st.composite
def schedules(draw):
    """A seed of a stream, and one way to push it: frames and events cut anywhere, in any interleaving."""
    seed = draw(st.integers(0, 7))
    stream = random_stream(seed)
    count = len(stream.events)
    cuts = sorted(draw(st.lists(st.integers(0, count), max_size=8)))
    chunks = [("events", stream.events[a:b]) for a, b in zip([0, *cuts], [*cuts, count], strict=True)]
    shots = [("frame", shot) for shot in stream.frames]
    order = draw(st.permutations([0] * len(chunks) + [1] * len(shots)))
    queues = [iter(chunks), iter(shots)]
    return seed, [next(queues[k]) for k in order]


def push(target, kind, what):
    if kind == "frame":
        target.push_frame(what)
    else:
        target.push_events(what)


# --- the same bits --------------------------------------------------------------------------------------


@every_variant
@both_modes
@given(schedule=schedules(), probes=st.lists(st.integers(0, 130_000), max_size=6))
@settings(max_examples=25, deadline=None)
def test_any_split_and_interleaving_gives_the_same_bits(variant, lookahead, schedule, probes):
    """Also with reads in between, at any time that is allowed just then, forward and back."""
    seed, operations = schedule
    stream = random_stream(seed)
    live = engine(stream.sensor_size, variant, lookahead)
    probes = iter(probes)
    for kind, what in operations:
        push(live, kind, what)
        probe = next(probes, None)
        if probe is not None and live.begin_time is not None and probe >= live.begin_time:
            live.read(probe)
    live.finish()
    begin = live.begin_time
    for t, expected in reference(seed, variant, lookahead).items():
        if t > begin or begin == stream.frames[0].exposure_end:
            assert_same(live.read(t), expected)


class AtOnce(Executor):
    """Does a thing when it is submitted: a segment while the one before is in use."""

    def submit(self, work, /, *arguments):
        done = Future()
        done.set_result(work(*arguments))
        return done


class WhenAsked(Executor):
    """Does a thing when its result is asked for: a segment when the one before is gone, with its events."""

    def submit(self, work, /, *arguments):
        class Late(Future):
            def result(self, timeout=None):
                return work(*arguments)

        return Late()


@every_variant
@both_modes
@given(
    schedule=schedules(),
    probes=st.lists(st.integers(0, 130_000), max_size=6),
    opener=st.sampled_from([AtOnce, WhenAsked, lambda: ThreadPoolExecutor(1)]),
)
@settings(max_examples=25, deadline=None)
def test_segments_made_ahead_are_the_same(variant, lookahead, schedule, probes, opener):
    """Whenever they are made, and whatever is pushed, read and freed meanwhile."""
    seed, operations = schedule
    stream = random_stream(seed)
    expected = reference(seed, variant, lookahead)
    waiting, probes = list(expected), iter(probes)
    with opener() as pool:
        live = engine(stream.sensor_size, variant, lookahead, opener=pool)
        for kind, what in operations:
            push(live, kind, what)
            probe, until = next(probes, None), live.final_until
            while waiting and until is not None and waiting[0] <= until and probe is None:
                assert_same(live.read(waiting[0]), expected[waiting.pop(0)])
            if probe is not None and live.begin_time is not None and live.begin_time <= probe <= waiting[0]:
                live.read(probe)
        live.finish()
        for t in waiting:
            assert_same(live.read(t), expected[t])


def test_an_error_in_making_a_segment_ahead_is_raised_where_it_is_read():
    stream = random_stream(2)
    with ThreadPoolExecutor(1) as pool:
        live = filled(stream, finished=False, opener=pool)
        method = live._method
        middles = [shot.middle for shot in stream.frames]
        live.read(middles[1] - 1)
        live._coming.result()
        live.finish()

        def fail(*_):
            raise MemoryError("no room")

        method.segment = fail
        live.read(middles[1] + 1)  # made before; what follows is submitted now
        with pytest.raises(MemoryError, match="no room"):
            live.read(middles[2] + 1)


@every_variant
@both_modes
@given(schedule=schedules(), probes=st.lists(st.integers(0, 130_000), max_size=12))
@settings(max_examples=25, deadline=None)
def test_final_images_never_change(variant, lookahead, schedule, probes):
    """What is final at any moment is what it is when everything has been pushed, however late frames are."""
    seed, operations = schedule
    stream = random_stream(seed)
    live = engine(stream.sensor_size, variant, lookahead)
    expected = reference(seed, variant, lookahead)
    waiting, probes, known = list(expected), iter(probes), -1
    for kind, what in operations:
        push(live, kind, what)
        until = live.final_until
        assert until is None or until >= known
        known = known if until is None else until
        while waiting and waiting[0] <= known:
            image = live.read(waiting[0])
            assert image.final
            assert_same(image, expected[waiting.pop(0)])
        probe = next(probes, None)
        if probe is not None and live.begin_time is not None and probe >= live.begin_time:
            assert live.read(probe).final == (probe <= known)
    live.finish()
    for t in waiting:
        image = live.read(t)
        assert image.final
        assert_same(image, expected[t])


@every_variant
@both_modes
@given(schedule=schedules(), ends=st.integers(0, 8), look=st.booleans())
@settings(max_examples=25, deadline=None)
def test_forgetting_and_the_end_of_frames_change_nothing(variant, lookahead, schedule, ends, look):
    """Memory freed after every push, and the end of frames told some pushes after the last."""
    seed, operations = schedule
    stream = random_stream(seed)
    live = engine(stream.sensor_size, variant, lookahead)
    expected = reference(seed, variant, lookahead)
    waiting, frames = list(expected), 0
    for kind, what in [*operations, *[("events", stream.events[:0])] * 2]:
        push(live, kind, what)
        frames += kind == "frame"
        if frames == len(stream.frames):
            if ends == 0:
                live.end_frames()
            ends -= 1
        until = live.final_until
        while waiting and until is not None and waiting[0] <= until:
            image = live.read(waiting[0])
            assert image.final
            assert_same(image, expected[waiting.pop(0)])
        if waiting:
            live.forget(waiting[0])
            if look and frames:
                live.read(waiting[0])
    live.finish()
    for t in waiting:
        assert_same(live.read(t), expected[t])


def test_what_is_forgotten_cannot_be_read_and_is_freed():
    stream = random_stream(0)
    live = filled(stream)
    middle = (stream.frames[1].middle + stream.frames[2].middle) // 2
    live.forget(middle)
    assert live.begin_time == middle
    assert len(live._events) == np.sum(
        stream.events["t"] > stream.frames[1].middle
    )  # the segment's, to go back in it
    with pytest.raises(InputError, match=r"forget\(\) has freed"):
        live.read(middle - 1)
    assert_same(live.read(middle), filled(stream).read(middle))
    live.forget(middle - 5_000)  # an earlier promise is kept already
    assert live.begin_time == middle
    later = live.read(middle + 2_000)
    assert_same(live.read(middle + 1_000), filled(stream).read(middle + 1_000))
    assert_same(live.read(middle + 2_000), later)


def test_after_the_last_frame_what_is_forgotten_lets_reads_go_forward_only():
    """Events that led to an earlier image are gone: it would be another one."""
    live = engine((1, 1))
    live.push_frame(frame(100, 0, 10_000))
    live.push_events(pixel_events([12_000, 22_000, 32_000, 42_000], [1, 1, 0, 1]))
    live.finish()
    expected = live.read(25_000)
    live.forget(20_000)
    assert_same(live.read(25_000), expected)
    live.read(35_000)
    with pytest.raises(InputError, match="reads can then only go forward"):
        live.read(25_000)
    live.read(36_000)


def test_nothing_is_forgotten_that_is_not_final():
    live = engine((1, 1))
    live.forget(10**9)
    live.push_frame(frame(100, 0, 10_000))
    live.push_events(pixel_events([2_000, 6_000, 8_000], [1, 1, 0]))
    live.forget(10**9)
    assert live.begin_time == 0
    live.advance(20_000)
    live.forget(10**9)
    assert live.begin_time == 5_000
    live.read(5_000)


@every_variant
@both_modes
def test_a_robot_sees_the_same_as_a_recording(variant, lookahead):
    """Frames pushed the moment their exposure ends, events one by one, every time declared complete."""
    stream, expected = random_stream(3), reference(3, variant, lookahead)
    live, frames = engine(stream.sensor_size, variant, lookahead), list(stream.frames)
    images, taken = {}, 0
    for t in expected:
        while frames and frames[0].exposure_end <= t:
            live.push_frame(frames.pop(0))
        while taken < len(stream.events) and stream.events["t"][taken] <= t:
            live.push_events(stream.events[taken : taken + 1])
            taken += 1
        live.advance(t)
        image = live.read(t)
        if not lookahead:
            assert_same(image, expected[t])
        images[t] = image
    assert len(images) == len(expected)


def test_a_robot_whose_frames_stop_reads_on_and_forgets():
    """It forgets what lies a little behind its reads, though these have gone on; memory stays as it is."""
    live, held = engine((4, 4)), []
    live.push_frame(frame(90, 0, 10_000, (4, 4)))
    live.end_frames()
    whole = engine((4, 4))
    whole.push_frame(frame(90, 0, 10_000, (4, 4)))
    for now in range(20_000, 400_000, 10_000):
        some = pixel_events(range(now - 9_000, now + 1, 1_000), [1, 0] * 5)
        for each in (live, whole):
            each.push_events(some)
            each.advance(now)
        image = live.read(now)
        live.forget(now - 7_500)
        assert_same(image, whole.read(now))
        held.append(live._events.number(now) - live._events.first)
    assert max(held) <= 10


@every_variant
@both_modes
def test_reading_more_often_changes_nothing(variant, lookahead):
    """50 Hz and 300 Hz agree to the bit where they meet."""
    stream = random_stream(1)
    begin = stream.frames[0].exposure_end
    slow, fast = (filled(stream, variant, lookahead) for _ in range(2))
    at_300 = {t: fast.read(t) for t in (begin + np.rint(np.arange(0, 36) * 1e6 / 300)).astype(int)}
    at_50 = {t: slow.read(t) for t in range(begin, begin + 120_000, 20_000)}
    assert set(at_50) <= set(at_300)
    for t, image in at_50.items():
        assert_same(image, at_300[t])


@every_variant
@both_modes
@given(seed=st.integers(0, 7), data=st.data())
@settings(max_examples=15, deadline=None)
def test_reading_twice_and_back_within_a_segment(variant, lookahead, seed, data):
    stream = random_stream(seed)
    live, fresh = (filled(stream, variant, lookahead) for _ in range(2))
    first = data.draw(st.integers(live.begin_time, stream.frames[-1].exposure_end + 10_000))
    live.read(first)
    back = data.draw(st.integers(live.begin_time + 1, first + 1))
    again = live.read(back)
    assert_same(live.read(back), again)
    assert_same(fresh.read(back), again)
    assert_same(live.read(first + 1), fresh.read(first + 1))


@every_variant
@pytest.mark.parametrize("exposures", [(2_000, 2_000, 2_000, 2_000), (2_000, 4_000, 4_000, 1_000)])
def test_the_moment_between_two_segments_is_one_image(variant, exposures):
    """Read before and after later reads have passed it, also where exposures vary and highlights are bright."""
    live = engine((1, 2), variant, reference_exposure=2_000)
    for k, exposure in enumerate(exposures):
        live.push_frame(frame([[255, 100]], 40_000 * k, 40_000 * k + exposure))
        live.push_events(pixel_events(range(40_000 * k + 5_000, 40_000 * k + 39_000, 2_000), [1] * 17))
    live.finish()
    node = 80_000 if variant.startswith("iccv") else 80_000 + exposures[2] // 2
    before = live.read(node)
    live.read(node + 1)
    after = live.read(node)
    np.testing.assert_allclose(after.intensity, before.intensity, rtol=1e-6)


@every_variant
@both_modes
@pytest.mark.parametrize("shift", [HOUR, 1_700_000_000_000_000, -HOUR], ids=["hour", "epoch", "negative"])
def test_the_origin_of_time_does_not_matter(variant, lookahead, shift):
    moved = filled(random_stream(2, shift=shift), variant, lookahead)
    for t, expected in reference(2, variant, lookahead).items():
        image = moved.read(t + shift)
        assert image.t == t + shift
        assert_same(image, expected)


def test_the_callers_arrays_may_be_reused():
    """Drivers fill the same buffer again; what was pushed must not change with it."""
    stream = random_stream(0)
    expected = reference(0, "default", True)
    live = engine(stream.sensor_size)
    for shot in stream.frames:
        pixels = shot.image.copy()
        live.push_frame(Frame(pixels, shot.exposure_start, shot.exposure_end))
        pixels[:] = 0
    buffer = stream.events.copy()
    live.push_events(buffer)
    buffer["p"] = ~buffer["p"]
    live.finish()
    for t, image in expected.items():
        assert_same(live.read(t), image)


def test_events_in_any_layout():
    stream, dtype = random_stream(0), [("x", "i2"), ("y", "i2"), ("timestamp", "i8"), ("polarity", "i1")]
    other = np.empty(len(stream.events), dtype)
    for name, field in zip("xytp", other.dtype.names, strict=True):
        other[field] = stream.events[name]
    other["polarity"] = np.where(stream.events["p"], 1, -1)
    live = filled(stream._replace(events=other))
    for t, image in reference(0, "default", True).items():
        assert_same(live.read(t), image)


def test_events_in_seconds_and_without_names():
    stream = random_stream(0)
    rows = np.stack([stream.events["t"] * 1e-6, *(stream.events[name] for name in "xyp")], axis=1)
    live = filled(stream._replace(events=stream.events[:0]), finished=False)
    live.push_events(rows, columns="txyp", time_unit="s")
    live.finish()
    for t, image in reference(0, "default", True).items():
        assert_same(live.read(t), image)


# --- images ---------------------------------------------------------------------------------------------


@every_variant
@both_modes
def test_what_an_image_holds(variant, lookahead):
    for t, image in reference(4, variant, lookahead).items():
        assert image.t == t
        assert isinstance(image.t, int)
        assert image.intensity.dtype == np.float32
        assert image.intensity.shape == (3, 4)
        assert np.isfinite(image.intensity).all()
        assert (image.intensity >= 0).all()
        assert image.variance.dtype == np.float32
        assert image.variance.shape == (3, 4)
        assert (image.variance > 0).all()
        assert np.isfinite(image.variance).all() == (variant != "cf")  # which has none


def test_an_image_becomes_final_one_frame_later():
    live = engine((1, 1))
    live.push_frame(frame(100, 0, 1000))
    assert live.final_until is None
    assert not live.read(0).final
    live.push_events(pixel_events([5_000], [1]))
    assert live.final_until == 500
    assert live.read(500).final
    assert not live.read(501).final
    live.push_frame(frame(120, 40_000, 41_000))
    assert not live.read(20_000).final
    live.advance(40_999)
    assert not live.read(20_000).final
    live.advance(41_000)
    assert live.final_until == 40_500
    assert live.read(40_500).final
    assert not live.read(40_501).final
    live.finish()
    assert live.read(10**9).final


def test_an_image_at_a_first_exposure_of_one_microsecond_is_final_with_the_next_frame():
    """No segment ends there: until the next frame is known, the one that begins there is not."""
    live = engine((1, 1))
    live.push_frame(frame(100, 0, 1))
    live.push_events(pixel_events([5_000], [1]))
    assert live.final_until is None
    provisional = live.read(0)
    assert not provisional.final
    live.push_frame(frame(120, 40_000, 40_001))
    live.advance(40_001)
    assert live.final_until == 40_000
    image = live.read(0)
    assert image.final
    live.finish()
    assert_same(live.read(0), image)


def test_what_moves_is_not_forgotten_after_eighteen_minutes():
    """Then the clock's origin moves on; a read before that changes none after it."""
    minute = 60_000_000

    def late(*before):
        made = engine((3, 3))
        for start in (0, 40_000, 40_000 + 30 * minute):
            made.push_frame(Frame(np.full((3, 3), 100, np.uint8), start, start + 10_000))
        made.push_events(events((20_000, 0, 0, 1), (40_000 + 20 * minute, 2, 2, 1)))
        made.finish()
        for t in before:
            made.read(t)
        return made.read(25 * minute)

    assert_same(late(), late(60_000))


def test_light_that_is_ahead_of_its_event_goes_on_over_eighteen_minutes():
    """As after a clock's origin has moved on, if none moves it since the sensor is silent."""

    def rise(event):
        made = engine((3, 3))
        made.push_frame(Frame(np.full((3, 3), 100, np.uint8), 0, 10_000))
        made.push_events(events((5_000 + event, 1, 1, 1)))
        made.finish()
        at, later = (made.read(5_000 + event + after).intensity[1, 1] for after in (1, 100_000))
        return later / at

    assert rise((1 << 30) - 10_000) == pytest.approx(rise((1 << 30) + 10_000), rel=1e-3) != 1.0


def test_an_estimates_image_does_not_depend_on_what_came_after_it():
    """Another thread makes images while the filter goes on: here, to a frame of finer levels, which round less."""
    settings = altered(VARIANTS["default"], "camera", frame_noise=0.0005)
    out = Reconstructor((6, 8), settings=settings, contrast_threshold=THRESHOLD)
    image = np.full((6, 8), 100, np.uint8)
    for number in range(2):
        out.push_frame(Frame(image, exposure_start=20_000 * number, exposure_end=20_000 * number + 10_000))
    out.advance(40_000)
    estimate = out.estimate(15_000)
    at_once = out.image(estimate)
    out.push_frame(Frame(image.astype(np.uint16) * 257, exposure_start=40_000, exposure_end=50_000))
    assert_same(out.image(estimate), at_once)


def test_no_image_without_a_frame():
    estimate = filled(random_stream(0)).estimate(target_times(random_stream(0))[0])
    with pytest.raises(InputError, match="no frame has been pushed"):
        engine(random_stream(0).sensor_size).image(estimate)


def test_a_later_frame_changes_what_was_provisional():
    live = engine((1, 1), reference_exposure=1_000)
    live.push_frame(frame(100, 0, 1000))
    live.advance(1000)
    alone = live.read(30_000).intensity[0, 0]
    live.push_frame(frame(200, 40_000, 41_000))
    live.advance(41_000)
    joined = live.read(30_000).intensity[0, 0]
    assert alone == pytest.approx(100 / 255, rel=1e-4)
    assert 100 / 255 < joined < 200 / 255


def test_a_frame_that_comes_late_to_a_causal_reader():
    """Until it is there, the images do without it; afterwards they are what they would have been in time."""
    late, in_time = (engine((1, 1), lookahead=False, reference_exposure=1_000) for _ in range(2))
    for target in (late, in_time):
        target.push_frame(frame(100, 0, 1000))
    in_time.push_frame(frame(200, 40_000, 41_000))
    for target in (late, in_time):
        target.advance(80_000)
    assert late.read(60_000).intensity[0, 0] == pytest.approx(100 / 255, rel=1e-4)
    late.push_frame(frame(200, 40_000, 41_000))
    assert late.read(60_000).intensity[0, 0] > 120 / 255
    for t in (50_000, 60_000, 70_000):
        assert_same(late.read(t), in_time.read(t))


@every_variant
def test_a_causal_image_does_not_know_the_next_frame(variant):
    """A frame that is pushed already but exposed later changes nothing, also with another exposure time."""
    images = []
    for knows in (False, True):
        live = engine((1, 1), variant, lookahead=False)
        live.push_frame(frame(200, 0, 10_000))
        live.push_events(pixel_events(range(12_000, 28_000, 2_000), [1] * 8))
        live.advance(30_000)
        if knows:
            live.push_frame(frame(50, 40_000, 41_000))
        images.append(live.read(29_000))
    assert_same(*images)


# --- the edges of a stream ------------------------------------------------------------------------------


@every_variant
@both_modes
def test_equal_frames_without_events_are_the_image(variant, lookahead):
    levels = np.array([[0, 1, 30], [100, 200, 240]], np.uint8)
    live = engine((2, 3), variant, lookahead)
    for k in range(3):
        live.push_frame(frame(levels, 40_000 * k, 40_000 * k + 10_000))
    live.finish()
    for t in range(live.begin_time, 150_000, 7_000):
        np.testing.assert_allclose(live.read(t).intensity, levels / 255, rtol=2e-5, atol=2e-6)


@every_variant
@both_modes
def test_one_frame_is_held(variant, lookahead):
    live = engine((1, 1), variant, lookahead)
    live.push_frame(frame(100, 0, 10_000))
    live.finish()
    for t in (live.begin_time, 10_000, 10_001, 500_000, HOUR):
        assert live.read(t).intensity[0, 0] == pytest.approx(100 / 255, rel=1e-5)


@every_variant
@both_modes
@pytest.mark.parametrize(("polarity", "step"), [(1, 0.25), (0, -0.2)])
def test_one_frame_and_one_event(variant, lookahead, polarity, step):
    """A step of the threshold in log(I + I_0); a little less where a lonely event may be noise."""
    offset = VARIANTS[variant].camera.offset
    live = engine((1, 1), variant, lookahead)
    live.push_frame(frame(100, 0, 10_000))
    live.push_events(pixel_events([12_000], [polarity]))
    live.finish()
    before, after = (np.log(live.read(t).intensity[0, 0] + offset) for t in (11_999, 12_000))
    assert 0.6 <= (after - before) / step <= 1.0001
    if variant != "default":
        assert after - before == pytest.approx(step, rel=1e-3)


@every_variant
@both_modes
def test_silent_pixels_do_not_see_the_events_of_others(variant, lookahead, monkeypatch):
    """But for what is hidden of them (K11): that is what silent neighbours show, and events make these fewer."""
    unknown = np.full((3, 4), 0.01, np.float32)
    monkeypatch.setattr(bridged_frames, "silent_change", lambda *_: unknown)
    stream = random_stream(5)
    silent = (stream.events["x"] != 0) | (stream.events["y"] != 0)
    quiet = filled(stream._replace(events=stream.events[:0]), variant, lookahead)
    busy = filled(stream._replace(events=stream.events[silent]), variant, lookahead)
    for t in target_times(stream):
        a, b = quiet.estimate(t), busy.estimate(t)
        assert a.log_intensity[0, 0] == b.log_intensity[0, 0]
        assert a.variance[0, 0] == b.variance[0, 0]
        if a.moving is None or not a.moving[0, 0]:  # one that no frame measures hears its neighbours (K12)
            assert quiet.image(a).intensity[0, 0] == busy.image(b).intensity[0, 0]


@every_variant
@both_modes
def test_events_before_and_after_everything_are_harmless(variant, lookahead):
    """Before the first exposure they say nothing; after the last frame they still move the image."""
    stream = random_stream(6)
    extra = np.concatenate([events((1, 0, 0, 1), (2, 3, 2, 0)), stream.events])
    live, usual = (
        filled(stream._replace(events=extra), variant, lookahead),
        filled(stream, variant, lookahead),
    )
    for t in target_times(stream):
        assert_same(live.read(t), usual.read(t))
    end = int(stream.events["t"][-1])
    held = filled(
        stream._replace(events=stream.events[stream.events["t"] <= end - 8_000]), variant, lookahead
    )
    assert (live.read(end).intensity != held.read(end).intensity).any()


def test_events_before_the_first_exposure_say_nothing_while_it_is_provisional():
    images = []
    for early in (0, 3):
        live = engine((1, 1))
        live.push_events(pixel_events(range(1_000, 1_000 + early), [1] * early))
        live.push_events(pixel_events([16_000], [1]))
        live.push_frame(frame(100, 10_000, 20_000))
        image = live.read(18_000)
        assert not image.final
        images.append(image)
    assert_same(*images)


@every_variant
@both_modes
def test_events_on_the_edges_belong_to_what_ends_there(variant, lookahead):
    """An event at the first moment that can be read is in it already, and not counted twice."""
    live = engine((1, 1), variant, lookahead)
    live.push_frame(frame(100, 10_000, 20_000))
    begin = live.begin_time
    live.push_events(pixel_events([begin], [1]))
    live.finish()
    first, later = live.read(begin).intensity[0, 0], live.read(begin + 3_000_000).intensity[0, 0]
    if begin == 10_000:
        assert first == pytest.approx(100 / 255, rel=1e-5)
    assert later == pytest.approx(first, rel=0.3)


def test_an_exposure_of_one_microsecond():
    """Its event at the end is not lost: as with an exposure of two."""
    images = []
    for exposure in (1, 2):
        live = engine((1, 1), reference_exposure=exposure)
        live.push_frame(frame(100, 0, exposure))
        live.push_events(pixel_events([exposure], [1]))
        live.push_frame(frame(135, 40_000, 40_000 + exposure))
        live.finish()
        images.append(live.read(5_000).intensity[0, 0])
    assert images[0] == pytest.approx(images[1], rel=0.01)


@every_variant
@both_modes
def test_exposure_changes_do_not_show(variant, lookahead):
    """A still scene under automatic exposure, times four and back: the same intensity within quantisation."""
    truth = np.linspace(0.02, 0.24, 12).reshape(3, 4)
    live = engine((3, 4), variant, lookahead, reference_exposure=4_000)
    for k, exposure in enumerate((4_000, 16_000, 16_000, 4_000, 8_000)):
        image = np.rint(truth * exposure / 4_000 * 255)
        live.push_frame(frame(image, 40_000 * k, 40_000 * k + exposure))
    live.finish()
    for t in range(live.begin_time, 190_000, 5_000):
        np.testing.assert_allclose(live.read(t).intensity, truth, atol=0.6 / 255)


def test_the_reference_exposure_is_the_first_frames_unless_given():
    for given_one, scale in ((None, 1.0), (20_000, 2.0), (5_000, 0.5)):
        live = engine((1, 1), reference_exposure=given_one)
        live.push_frame(frame(100, 0, 10_000))
        live.finish()
        assert live.read(5_000).intensity[0, 0] == pytest.approx(scale * 100 / 255, rel=1e-4)


@both_modes
def test_short_exposures_measure_beyond_one(lookahead):
    """At a quarter of the reference exposure, half of the range is 2.0: measured, so not doubted."""
    live = engine((1, 1), "default", lookahead, reference_exposure=16_000, threshold_is_estimate=True)
    for k in range(3):
        live.push_frame(frame(128, 40_000 * k, 40_000 * k + 4_000))
    live.finish()
    for t in range(live.begin_time, 130_000, 5_000):
        assert live.read(t).intensity[0, 0] == pytest.approx(4 * 128 / 255, rel=1e-4)


@both_modes
def test_a_clipped_frame_says_nothing(lookahead):
    """The default keeps what shorter exposures have told; a pull to white would be 0.25 here."""
    live = engine((1, 1), "default", lookahead, reference_exposure=4_000)
    for k, (level, exposure) in enumerate(((128, 4_000), (255, 16_000), (255, 16_000), (128, 4_000))):
        live.push_frame(frame(level, 40_000 * k, 40_000 * k + exposure))
    live.finish()
    for t in range(live.begin_time, 150_000, 5_000):
        assert live.read(t).intensity[0, 0] == pytest.approx(128 / 255, rel=0.01)


def test_highlights_beyond_white_come_from_events():
    """Clipped in both frames, with five events between: brighter than white, and doubted when c is a guess."""
    believed = []
    for estimate in (False, True):
        live = engine((1, 1), threshold_is_estimate=estimate)
        live.push_frame(frame(240, 0, 10_000))
        live.push_events(pixel_events(range(20_000, 25_000, 1_000), [1] * 5))
        live.push_frame(frame(255, 40_000, 50_000))
        live.finish()
        believed.append(live.read(30_000).intensity[0, 0])
    assert 1.0 < believed[1] < believed[0] <= 1.03 * np.exp(5 * 0.25)


@pytest.mark.parametrize(
    ("estimate", "tail", "goes_far"), [(False, 0.3, True), (True, 0.3, False), (True, 2.0, True)]
)
def test_far_highlights_are_believed_where_events_are_trusted(estimate, tail, goes_far):
    """K6: twenty events beyond white; of a scene that hardly saturates, under thresholds that are a guess, no more."""
    read = []
    for trust in (0.0, 1.0):
        chosen = altered(PRESETS["default"], "events", extrapolation_trust=trust)
        chosen = altered(chosen, "filter", bright_tail=tail)
        live = Reconstructor((1, 1), settings=chosen, contrast_threshold=0.3, threshold_is_estimate=estimate)
        live.push_frame(frame(240, 0, 10_000))
        live.push_events(pixel_events(range(15_000, 35_000, 1_000), [1] * 20))
        live.push_frame(frame(255, 40_000, 50_000))
        live.finish()
        read.append(float(live.read(35_000).intensity[0, 0]))
    if goes_far:
        assert 1.1 * read[0] < read[1] < 1.1 * np.exp(20 * 0.3)
    else:
        assert read[1] == pytest.approx(read[0], rel=0.05)


@pytest.mark.parametrize("channels", [(), (3,)])
def test_a_live_stream_takes_the_bright_tail_of_its_first_frame(channels):
    """As if it were stated; of colour, pixels count that are clipped, which are few here."""
    first = np.random.default_rng(0).integers(0, 240, (12, 14, *channels)).astype(np.uint8)
    first[3:9, 4:10] = 255
    tail = count_bright(Camera.named("linear", 0.98), first, 255.0).scale
    images = []
    for stated in (None, tail, 1.2 * tail):
        settings = altered(PRESETS["default"], "filter", bright_tail=stated)
        live = Reconstructor((12, 14), settings=settings)
        live.push_frame(Frame(first, 0, 10_000))
        live.push_events(pixel_events([20_000, 21_000], [1, 1], x=6, y=6))
        live.push_frame(Frame(first, 40_000, 50_000))
        live.finish()
        images.append(live.read(30_000).intensity)
    np.testing.assert_array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])


@both_modes
def test_a_mean_below_white_is_measured_however_bright_the_pixel_was_meanwhile(lookahead):
    """Twice white for a third of each exposure, a tenth of white else: a sensor clips the sum of the light."""
    settings = altered(altered(PRESETS["default"], "camera", log_offset=0.004), "events", trail=0.0)
    step = float(np.log(2.004 / 0.104)) / 12
    live = Reconstructor((1, 1), settings=settings, lookahead=lookahead, contrast_threshold=step)
    for start in (0, 40_000, 80_000):
        live.push_frame(frame(round(255 * (2.0 + 0.1 + 0.1) / 3), start, start + 30_000))
        live.push_events(pixel_events([start + 10_000] * 12, [1] * 12))
        live.push_events(pixel_events([start + 20_000] * 12, [0] * 12))
    live.finish()
    read = live.read(95_000 if lookahead else 110_000)
    assert read.variance[0, 0] < 0.5  # 1 and more where nothing is measured
    assert read.intensity[0, 0] == pytest.approx(2.0 if lookahead else 0.1, rel=0.1)


@pytest.mark.parametrize(
    ("image", "white"),
    [
        (np.full((1, 1), 0.5, np.float32), None),
        (np.full((1, 1), 0.5, np.float64), None),
        (np.full((1, 1), 32768, np.uint16), None),
        (np.full((1, 1), 512, np.uint16), 1023),
        (np.full((1, 1), 127.5, np.float32), 255.0),
    ],
)
def test_frames_of_any_depth(image, white):
    live = engine((1, 1))
    live.push_frame(Frame(image, 0, 10_000, white))
    live.finish()
    assert live.read(5_000).intensity[0, 0] == pytest.approx(0.5, rel=2e-3)


def test_a_released_weight_table_is_used():
    """Where the table says the level is worthless, the paper's filter believes it least."""
    variances = []
    for table in (None, 7e5 * np.linspace(1.0, 0.0, 256)):
        live = engine((1, 1), "iccv2021", inverse_covariance=table)
        for k in range(2):
            live.push_frame(frame(250, 40_000 * k, 40_000 * k + 10_000))
        live.finish()
        variances.append(live.read(40_000).variance[0, 0])
    assert variances[1] > 5 * variances[0]


# --- where one may read ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("variant", "lookahead", "begin"),
    [
        ("default", True, 1000),
        ("default", False, 3000),
        ("iccv2021", True, 1000),
        ("iccv2021", False, 3000),
        ("cf", True, 2000),
        ("cf", False, 3000),
    ],
)
def test_the_first_time_that_can_be_read(variant, lookahead, begin):
    live = engine((1, 1), variant, lookahead)
    assert live.begin_time is None
    live.push_events(pixel_events([500], [1]))
    assert live.begin_time is None
    with pytest.raises(InputError, match="no frame has been pushed yet"):
        live.read(1000)
    live.push_frame(frame(100, 1000, 3000))
    assert live.begin_time == begin
    with pytest.raises(InputError, match=f"{begin - 1} us lies before {begin} us, the earliest time"):
        live.read(begin - 1)
    live.read(begin)
    live.finish()
    live.read(begin)


def test_what_later_reads_have_passed_cannot_be_read_again():
    live = filled(random_stream(0))
    nodes = [shot.middle for shot in random_stream(0).frames]
    live.read(nodes[2] + 1)
    assert live.begin_time == nodes[2]
    with pytest.raises(InputError, match="what later reads have passed"):
        live.read(nodes[2] - 1)
    live.read(nodes[2])


def test_memory_is_bounded_when_one_reads_along():
    live, held = engine((4, 4)), []
    rng = np.random.default_rng(0)
    for k in range(300):
        t = 10_000 * k
        times = np.sort(rng.integers(t, t + 10_000, 50))
        rows = [(int(u), int(rng.integers(4)), int(rng.integers(4)), int(rng.integers(2))) for u in times]
        live.push_frame(frame(np.full((4, 4), 100), t, t + 5_000))
        live.push_events(events(*rows))
        if live.final_until is not None:
            live.read(live.final_until)
        held.append((len(live._events), len(live._shots)))
    assert max(count for count, _ in held) <= 200
    assert max(shots for _, shots in held) <= 4


# --- errors ---------------------------------------------------------------------------------------------


def test_nothing_may_come_after_the_end():
    live = filled(random_stream(0))
    with pytest.raises(InputError, match=r"finish\(\) was called"):
        live.push_events(events())
    with pytest.raises(InputError, match=r"finish\(\) was called"):
        live.push_frame(frame(np.zeros((3, 4)), HOUR, HOUR + 1))


BAD_FRAMES = {
    "zero exposure": (frame(1, 9_000, 9_000), ExposureError, "frame 1 has an exposure of 0 us"),
    "negative exposure": (frame(1, 9_000, 8_000), ExposureError, "frame 1 has an exposure of -1000 us"),
    "nan": (frame([[1.0, np.nan]], 9_000, 9_500, dtype=np.float32), FrameError, "frame 1 .* x=1, y=0"),
    "infinite": (frame([[np.inf, 1.0]], 9_000, 9_500, dtype=np.float64), FrameError, "frame 1 .* x=0, y=0"),
    "wrong size": (frame([[1], [2]], 9_000, 9_500), FrameError, "frame 1 is 1x2 pixels, the sensor is 2x1"),
    "colour": (
        frame(np.ones((1, 2, 3)), 9_000, 9_500),
        FrameError,
        "frame 1 is RGB, those before it are grey",
    ),
    "wrong type": (frame([[1, 2]], 9_000, 9_500, dtype=np.int32), FrameError, "frame 1 has dtype int32"),
    "earlier": (frame([[1, 2]], 0, 1_000), FrameError, "frame 1 starts at 0 us, not after"),
    "overlap": (frame([[1, 2]], 1_999, 3_000), ExposureError, "frame 1 starts at 1999 us"),
}


@pytest.mark.parametrize("name", BAD_FRAMES)
def test_bad_frames_are_named_and_leave_the_engine_as_it_was(name):
    bad, kind, message = BAD_FRAMES[name]
    if bad.image.shape == (1, 1):
        bad = Frame(np.ones((1, 2), np.uint8), bad.exposure_start, bad.exposure_end)
    good = frame([[100, 50]], 1_000, 2_000), frame([[120, 60]], 9_000, 9_500)
    live, other = engine((1, 2)), engine((1, 2))
    live.push_frame(good[0])
    other.push_frame(good[0])
    with pytest.raises(kind, match=message):
        live.push_frame(bad)
    for target in (live, other):
        target.push_frame(good[1])
        target.finish()
    for t in (1_500, 5_000, 12_000):
        assert_same(live.read(t), other.read(t))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(50, 0, 0, 1)], "event 2 at 50 us comes after one at 100 us"),
        ([(100, 0, 0, 1), (300, 0, 0, 1), (299, 0, 0, 1)], "event 4 at 299 us comes after one at 300 us"),
        ([(100, 0, 0, 1), (300, 2, 0, 1)], "event 3 at x=2, y=0 is outside the sensor of 2x1"),
        ([(300, 0, 1, 1)], "event 2 at x=0, y=1 is outside"),
    ],
)
def test_bad_events_are_named_by_their_place_in_the_stream(rows, message):
    live = engine((1, 2))
    live.push_events(events((10, 0, 0, 1), (100, 1, 0, 0)))
    with pytest.raises(EventError, match=message):
        live.push_events(events(*rows))
    live.push_events(events((100, 0, 0, 1)))  # the same time is fine, and nothing was taken
    with pytest.raises(EventError, match="event 3 at 99 us"):
        live.push_events(events((99, 0, 0, 1)))


@pytest.mark.parametrize("complete", [5_000, -5_000])
def test_events_that_come_after_their_time_was_declared_complete(complete):
    live = engine((1, 1))
    live.advance(complete)
    with pytest.raises(EventError, match=f"event 0 at {complete} us"):
        live.push_events(pixel_events([complete], [1]))
    live.push_events(pixel_events([complete + 1], [1]))


def test_events_of_an_unknown_layout():
    with pytest.raises(EventError, match="cannot read"):
        engine((1, 1)).push_events([1, 2, 3])


def test_events_that_were_refused_leave_the_engine_as_it_was():
    live = engine((1, 1))
    live.push_frame(Frame(np.full((1, 1), 100, np.uint8), 0, 10_000))
    live.push_events({"t": [20_000], "x": [0], "y": [0], "p": [1]})
    before = live.read(30_000)
    for t in ([19_999], [21_000, 20_500], [2**62]):
        with pytest.raises(EventError, match="event"):
            live.push_events({"t": t, "x": [0] * len(t), "y": [0] * len(t), "p": [1] * len(t)})
        assert np.array_equal(live.read(30_000).intensity, before.intensity)
    live.push_events({"t": [20_000], "x": [0], "y": [0], "p": [1]})
    assert live.read(30_000).intensity > before.intensity


def test_no_frame_may_come_after_the_last():
    """Its events may have been freed, and images that it would change have been final."""
    live = engine((1, 1))
    live.push_frame(Frame(np.full((1, 1), 100, np.uint8), 0, 10_000))
    live.end_frames()
    with pytest.raises(InputError, match=r"end_frames\(\) was called, .* a new Reconstructor"):
        live.push_frame(Frame(np.full((1, 1), 100, np.uint8), 20_000, 30_000))
    live.push_events({"t": [20_000], "x": [0], "y": [0], "p": [1]})


@pytest.mark.parametrize("t", ["1", None, np.nan, np.inf, 0.5, 10**30])
def test_times_that_are_none_are_refused_everywhere(t):
    live = engine((1, 1))
    live.push_frame(Frame(np.full((1, 1), 100, np.uint8), 0, 10_000))
    live.advance(30_000)
    before = live.read(20_000)
    for call, name in ((live.advance, "advance"), (live.forget, "forget"), (live.read, "read")):
        with pytest.raises(InputError, match=f"{name}: the time is .*; whole microseconds"):
            call(t)
    assert np.array_equal(live.read(20_000).intensity, before.intensity)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"settings": {}}, "settings is a dict; a kalux.Settings is needed, from kalux.preset"),
        ({"settings": "cf"}, "settings is a str; a kalux.Settings"),
        (
            {"pixels": np.ones((1, 1))},
            "pixels is a ndarray; a kalux.models.pixels.PixelCalibration is needed",
        ),
        ({"reference_exposure": -1}, "reference_exposure is -1 us; it must be positive"),
        ({"reference_exposure": 0}, "reference_exposure is 0 us"),
        ({"reference_exposure": np.nan}, "reference_exposure is nan; whole microseconds"),
    ],
)
def test_arguments_that_cannot_be(arguments, message):
    with pytest.raises(InputError, match=message):
        Reconstructor((1, 1), **arguments)


@pytest.mark.parametrize("size", [(0, 3), (3, 0), (-1, 3)])
def test_a_sensor_without_pixels(size):
    with pytest.raises(InputError, match="sensor_size"):
        Reconstructor(size)


@pytest.mark.parametrize("threshold", [0.0, -0.2, float("nan"), float("inf"), (0.2, 0.0), "high", (1, 2, 3)])
def test_a_threshold_that_is_none(threshold):
    with pytest.raises(InputError, match="must be positive"):
        Reconstructor((1, 1), contrast_threshold=threshold)


@pytest.mark.parametrize("threshold", [0.2, np.float32(0.2), np.float64(0.2), (0.2, 0.2), [0.2, 0.2], 1])
def test_thresholds_of_any_type(threshold):
    found = Reconstructor((1, 1), contrast_threshold=threshold).thresholds
    assert found == pytest.approx((1, 1) if threshold == 1 else (0.2, 0.2))


def test_settings_win_over_arguments():
    chosen = altered(PRESETS["default"], "events", threshold_on=0.4)
    chosen = altered(chosen, "camera", reference_exposure=20_000)
    live = Reconstructor(
        (1, 1), settings=chosen, preset="cf", contrast_threshold=(0.1, 0.15), reference_exposure=10_000
    )
    assert live.thresholds == (0.4, 0.15)
    assert live.settings is chosen
    live.push_frame(frame(100, 0, 10_000))
    live.finish()
    assert live.read(5_000).intensity[0, 0] == pytest.approx(200 / 255, rel=1e-4)


def test_unknown_presets_and_responses():
    with pytest.raises(SettingsError, match="unknown preset"):
        Reconstructor((1, 1), preset="best")
    assert issubclass(SettingsError, KaluxError)


def test_an_unknown_threshold_is_learned():
    """Two events a frame interval, each truly 0.125 while 0.25 is assumed: the steps come down towards the truth."""
    live = engine_without_threshold()
    for k in range(8):
        level = round(80 * np.exp(0.25 * (k % 2)))
        live.push_frame(frame(level, 40_000 * k, 40_000 * k + 2_000))
        start = 40_000 * k
        live.push_events(pixel_events([start + 10_000, start + 20_000], [1, 1] if k % 2 == 0 else [0, 0]))
    live.read(40_000 * 6 + 5_000)
    thresholds = live._memory.thresholds
    assert 0.4 < thresholds.on[0, 0] < 0.75
    assert 0.4 < thresholds.off[0, 0] < 0.75


def test_a_calibration_of_the_sensor_is_used():
    """Its settings in place of the preset's, but not of those that are given; its pixels unless others are."""
    hot = np.zeros((4, 6), np.bool_)
    hot[1, 2] = True
    known = Calibration({"events": {"threshold_on": 0.31, "threshold_off": 0.29}}, maps={"hot": hot})
    live = Reconstructor((4, 6), preset="davis346", calibration=known)
    assert live.thresholds == (0.31, 0.29)
    assert live.settings == known.apply(PRESETS["davis346"])
    same = Reconstructor((4, 6), settings=live.settings, pixels=known.pixels)
    for each in (live, same):
        each.push_frame(frame(90, 0, 10_000, (4, 6)))
        each.push_events(events((12_000, 2, 1, True), (13_000, 3, 1, True)))
    assert_same(live.read(20_000), same.read(20_000))
    assert (
        live.read(20_000).intensity[1, 2] < live.read(20_000).intensity[1, 3]
    )  # a hot pixel's events say nothing
    given = altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2)
    assert Reconstructor((4, 6), settings=given, calibration=known).thresholds == (0.2, 0.2)


@pytest.mark.parametrize("clips", [True, False])
def test_an_edge_into_a_highlight_is_no_surer_before_the_next_frame_than_after_it(clips):
    """Ten events of 0.2 with thresholds 10 or 30 % off: P knows as they come, if no frame is to tie them (K10)."""
    levels = {}
    for spread in (0.1, 0.3):
        known = {"threshold_on": 0.2, "threshold_off": 0.2, "threshold_spread": spread}
        engine = Reconstructor((1, 2), settings=altered(PRESETS["default"], "events", **known))
        for t, level in ((0, 50), (100_000, 255 if clips else 200)):
            engine.push_frame(Frame(np.array([[50, level]], np.uint8), t, t + 10_000))
        engine.push_events(pixel_events(range(50_000, 60_000, 1_000), [1] * 10, x=1))
        engine.finish()
        times = (49_000, 54_500, 70_000, 105_000)
        levels[spread] = np.array([engine.estimate(t).variance[0, 1] for t in times])
    drift = (0.3**2 - 0.1**2) * (10 * 0.2) ** 2
    found = (levels[0.3] - levels[0.1]) / drift
    np.testing.assert_allclose(found, [0, 0.5, 1, 1] if clips else 0, atol=0.03)


@pytest.mark.parametrize("lookahead", [True, False])
def test_an_edge_into_a_highlight_is_as_doubtful_as_the_refractory_period_makes_it(lookahead):
    """Ten events of which each hides one threshold, and two as much: 10 % of the period is then two thresholds (K10).

    As many of the other polarity take it off again, but for what thresholds may be off by.
    """
    variances = {}
    for spread in (None, 0.1):
        known = {
            "threshold_on": 0.2,
            "threshold_off": 0.2,
            "refractory_period": 400,
            "refractory_spread": spread,
        }
        engine = Reconstructor(
            (1, 2), settings=altered(PRESETS["default"], "events", **known), lookahead=lookahead
        )
        for t, level in ((0, 50), (100_000, 255), (200_000, 255), (300_000, 255)):
            engine.push_frame(Frame(np.array([[50, level]], np.uint8), t, t + 10_000))
        up, down = 50_000 + 800 * np.arange(12), 150_000 + 800 * np.arange(12)
        engine.push_events(pixel_events([*up, *down], [1] * 12 + [0] * 12, x=1))
        engine.finish()
        variances[spread] = np.array([engine.estimate(t).variance[0, 1] for t in (49_000, 115_000, 215_000)])
    more = variances[0.1] - variances[None]
    growth = 10 * (1 + 1) + 2 * 1  # thresholds: the paces, of each event but the first, and their own growth
    assert more[0] == 0
    assert more[1] == pytest.approx((0.1 * growth * 0.2) ** 2, rel=0.15)
    assert abs(more[2]) < 0.1 * more[1]


def test_events_alone_lead_back_into_a_highlight_as_far_as_thresholds_are_known():
    """Twenty events of 0.2 lead back from the next frame to 27 times white: half of that way if thresholds are known,
    less if these may be 50 % off (K4). At the next frame nothing of that is left."""
    levels = {}
    for spread in (0.01, 0.5):
        known = {"threshold_on": 0.2, "threshold_off": 0.2, "threshold_spread": spread}
        engine = Reconstructor((1, 2), settings=altered(PRESETS["default"], "events", **known))
        for t, level in ((0, 255), (100_000, 128)):
            engine.push_frame(Frame(np.array([[50, level]], np.uint8), t, t + 10_000))
        engine.push_events(pixel_events(range(60_000, 100_000, 2_000), [0] * 20, x=1))
        engine.finish()
        found = [engine.estimate(t) for t in (55_000, 105_000)]
        levels[spread] = np.array([np.exp(each.log_intensity[0, 1]) for each in found])
    assert levels[0.01][0] > 8
    assert 2 < levels[0.5][0] < 3.5
    np.testing.assert_allclose(levels[0.5][1], levels[0.01][1], rtol=0.01)


@pytest.mark.parametrize("smooth", [False, True])
def test_the_noise_of_frames_averages_out_where_nothing_moves(smooth):
    """Twenty frames of a grey with a noise of 0.02: an image has less than half of it, at a frame and between two."""
    rng = np.random.default_rng(0)
    frames = [
        Frame(
            np.clip(np.rint(128 + 5.1 * rng.standard_normal((24, 32))), 0, 255).astype(np.uint8), t, t + 5_000
        )
        for t in range(0, 600_000, 30_000)
    ]
    recording = Recording.from_arrays(events(), frames, sensor_size=(24, 32))
    chosen = altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2)
    chosen = altered(chosen, "filter", neighbours=0.0)
    for image in reconstruct(recording, times=[302_500, 317_500], settings=chosen, smooth=smooth):
        assert np.std(image.intensity) < 0.5 * 0.02
        error = np.log(image.intensity + image.log_offset) - np.log(128 / 255 + image.log_offset)
        assert 0.6 < np.sqrt(np.square(error).mean() / image.variance.mean()) < 1.2


def test_events_out_of_a_highlight_are_doubted_as_they_come_where_the_next_frame_measures_the_pixel():
    """Eight events up, then twenty-eight down, though the next frame shows hardly less than the one before, clipped.

    Wrong thresholds explain that, or a highlight far above white. The more they may be off, the less P trusts these
    events, and the sooner L is where the frame to come has it (K10)."""
    levels, variances = {}, {}
    for spread in (0.01, 0.3):
        known = {"threshold_on": 0.2, "threshold_off": 0.2, "threshold_spread": spread}
        engine = Reconstructor((1, 2), settings=altered(PRESETS["default"], "events", **known))
        for t, level in ((0, 255), (100_000, 230)):
            engine.push_frame(Frame(np.array([[50, level]], np.uint8), t, t + 8_000))
        times = [*range(50_000, 58_000, 1_000), *range(76_600, 99_000, 800)]
        engine.push_events(pixel_events(times, [1] * 8 + [0] * 28, x=1))
        engine.finish()
        found = engine.estimate(98_000)
        levels[spread], variances[spread] = found.log_intensity[0, 1], found.variance[0, 1]
    frame = np.log(230 / 255)
    assert frame - levels[0.01] > 0.4
    assert abs(levels[0.3] - frame) < 0.1
    assert variances[0.3] > 2 * variances[0.01]


def test_light_that_was_white_comes_from_there_though_events_lead_from_less():
    """Ten events down, then twenty-eight up, to less than white: where a frame clips, the pixel is no darker (K7)."""
    engine = Reconstructor(
        (1, 2), settings=altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2)
    )
    for t, level in ((0, 255), (100_000, 230)):
        engine.push_frame(Frame(np.array([[50, level]], np.uint8), t, t + 8_000))
    times = [*range(50_000, 60_000, 1_000), *range(76_600, 99_000, 800)]
    engine.push_events(pixel_events(times, [0] * 10 + [1] * 28, x=1))
    engine.finish()
    before, after = (engine.estimate(t).log_intensity[0, 1] for t in (49_000, 98_000))
    assert abs(before) < 0.1
    assert abs(after - np.log(230 / 255)) < 0.2


def test_the_fixed_pattern_of_a_live_stream_is_the_usual_one():
    """Of grey frames: it is in every image, whatever is averaged."""
    grey, colour = (np.full(shape, 9, np.uint8) for shape in ((4, 6), (4, 6, 3)))
    for image, variant, expected in (
        (grey, "default", 0.005),
        (colour, "default", 0.0),
        (grey, "iccv2021", 0.0),
    ):
        live = Reconstructor((4, 6), preset=variant)
        live.push_frame(Frame(image, 0, 10_000))
        assert live.read(10_000).fixed_pattern == expected
    stated = Reconstructor((4, 6), settings=altered(PRESETS["default"], "camera", fixed_pattern=0.002))
    stated.push_frame(Frame(grey, 0, 10_000))
    assert stated.read(10_000).fixed_pattern == 0.002
    curved = Reconstructor((4, 6), settings=altered(PRESETS["default"], "camera", response="gamma:2"))
    curved.push_frame(Frame(np.full((4, 6), 51, np.uint8), 0, 10_000))
    # A stored value of 0.2 is 0.2^2 of the light, and 0.005 of it 2 * 0.2 * 0.005.
    np.testing.assert_allclose(curved.read(10_000).fixed_pattern, 0.002, rtol=0.02)


@pytest.mark.parametrize(
    ("image", "white", "told"),
    [
        (np.full((4, 6), 1500, np.uint16), None, "if the camera has 12 bits, give --white 4095 .white=4095."),
        (np.full((4, 6), 90.0), None, "which are floats, go up to 90"),
        (np.full((4, 6), 1500, np.uint16), 4095, None),
        (np.full((4, 6), 90, np.uint8), None, None),
    ],
)
def test_a_white_that_can_hardly_be_right_is_told(image, white, told):
    live, first = Reconstructor((4, 6)), Frame(image, 0, 10_000, white)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        live.push_frame(first)
        live.push_frame(Frame(image, 40_000, 50_000, white))
    assert len(found) == (told is not None)
    if told is not None:
        assert re.match(f"frame 0: .*{told}", str(found[0].message))
        assert found[0].filename == __file__


@pytest.mark.parametrize("events_first", [True, False])
def test_clocks_that_are_hardly_the_same_are_told(events_first):
    for begin, count in ((3 * HOUR, 1), (HOUR // 2, 0)):
        live = Reconstructor((4, 6))
        pushes = [
            lambda live=live, t=begin: live.push_events(events((t, 2, 1, True))),
            lambda live=live: live.push_frame(frame(90, 0, 10_000, (4, 6))),
        ]
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            for push_one in pushes if events_first else pushes[::-1]:
                push_one()
            live.push_frame(frame(90, 40_000, 50_000, (4, 6)))
        assert len(found) == count
        if count:
            assert "do both have the same clock?" in str(found[0].message)
            assert found[0].filename == __file__


def test_a_live_stream_takes_what_is_usual_of_the_sensor():
    live, usual = Reconstructor((1, 1), preset="davis346"), PRESETS["davis346"].events
    assert live.thresholds == (usual.usual_threshold_on, usual.usual_threshold_off)
    live.push_frame(frame(100, 0, 2_000))
    live.push_events(pixel_events([12_000], [1]))
    early, late = (
        float(live.read(t).intensity[0, 0]) for t in (12_000 - usual.usual_delay + d for d in (-500, 500))
    )
    assert late > early  # the event is taken to have happened as much earlier
    stated = Reconstructor((1, 1), preset="davis346", contrast_threshold=0.2)
    assert stated.thresholds == (0.2, 0.2)


def engine_without_threshold():
    """Without K14: the levels of the tests stand still between two events."""
    return Reconstructor((1, 1), settings=altered(PRESETS["default"], "events", trail=0.0))


@every_variant
@both_modes
def test_a_moment_between_segments_that_was_read_stays_the_same_image(variant, lookahead):
    """The next segment begins with the same state, but knows other frames around."""
    stream = random_stream(7)
    live = filled(stream, variant, lookahead)
    moments = [t for f in stream.frames for t in (f.exposure_start, f.middle, f.exposure_end)]
    for node in moments[3:-3]:
        first = live.read(node)
        live.read(node + 1)
        assert_same(live.read(node), first)


def test_the_mask_of_a_frame_may_be_filled_again():
    images = []
    for again in (False, True):
        live, valid = engine((2, 3)), np.ones((2, 3), bool)
        live.push_frame(Frame(np.full((2, 3), 50, np.uint8), 0, 1_000, valid=valid))
        if again:
            valid[:] = False
        live.push_frame(frame(np.full((2, 3), 90, np.uint8), 40_000, 41_000))
        live.finish()
        images.append(live.read(30_000))
    assert_same(*images)


def test_events_of_a_time_that_was_declared_complete_are_told_so():
    live = engine((1, 1))
    live.push_frame(frame(50, 0, 10))
    live.advance(1_000)
    with pytest.raises(
        EventError, match=r"event 0 at 500 us is late: advance\(\) has declared all events up to 1000 us"
    ):
        live.push_events(pixel_events([500], [True]))
