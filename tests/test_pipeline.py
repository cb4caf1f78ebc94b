"""Whole recordings: what comes out, and how much is held on the way."""

from __future__ import annotations

import dataclasses
import threading
import tracemalloc

import numpy as np
import pytest

from kalux import Frame, Reconstructor, Recording, reconstruct
from kalux.datasets import SensorSettings
from kalux.errors import EventError, FrameError
from kalux.events import make_events
from kalux.filters.bridged_frames import BridgedFrames
from kalux.pipeline import execute
from kalux.planning import plan
from kalux.settings import altered

from builders import (
    VARIANTS,
    all_given,
    events,
    moving_blocks,
    own_threads,
    random_stream,
    recording,
    unlabelled,
)

every_variant = pytest.mark.parametrize("variant", VARIANTS)
both_modes = pytest.mark.parametrize("lookahead", [True, False], ids=["lookahead", "causal"])
every_number_of_threads = pytest.mark.parametrize("threads", [1, 4], ids="{} threads".format)


def assert_same(images, expected):
    images, expected = list(images), list(expected)
    assert [image.t for image in images] == [image.t for image in expected]
    for a, b in zip(images, expected, strict=True):
        np.testing.assert_array_equal(a.intensity, b.intensity)
        np.testing.assert_array_equal(a.variance, b.variance)
        assert a.final
        assert b.final


# --- the same as the engine -----------------------------------------------------------------------------


@every_variant
@both_modes
@pytest.mark.parametrize("chunk", [7, 1 << 20])
def test_the_pipeline_is_the_engine(variant, lookahead, chunk, monkeypatch):
    """However large the chunks of events are that a file comes in."""
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", chunk)
    rec = recording(1)
    made = plan(rec, rate_hz=400, settings=VARIANTS[variant], lookahead=lookahead)
    engine = Reconstructor(rec.sensor_size, settings=made.settings, lookahead=lookahead)
    for shot in rec.frames():
        engine.push_frame(shot)
    for part in rec.events():
        engine.push_events(part)
    engine.finish()
    expected = [engine.read(t) for t in made.times.tolist()]
    assert_same(execute(rec, made), expected)


@every_variant
def test_images_without_their_variance_are_the_same(variant):
    rec = recording(2)
    made = plan(rec, rate_hz=200, settings=VARIANTS[variant])
    whole, bare = list(execute(rec, made)), list(execute(rec, made, with_variance=False))
    for a, b in zip(whole, bare, strict=True):
        np.testing.assert_array_equal(a.intensity, b.intensity)
        assert b.variance.shape == a.variance.shape
        assert np.isposinf(b.variance).all()


@every_variant
def test_a_causal_image_is_what_a_robot_would_see(variant):
    """Cutting the recording off after an image does not change it."""
    stream = random_stream(2)
    times = [shot.exposure_end + 7_000 for shot in stream.frames]
    given = altered(VARIANTS[variant], "camera", reference_exposure=10_000)
    options = {"settings": altered(given, "filter", bright_tail=0.5), "lookahead": False}
    whole = list(reconstruct(recording(2), times=times, **options))
    for image in whole:
        seen = stream.events[stream.events["t"] <= image.t]
        frames = [shot for shot in stream.frames if shot.exposure_end <= image.t]
        cut = Recording.from_arrays(
            np.concatenate([seen, events((image.t + 1, 0, 0, 1))]),
            frames,
            sensor_size=stream.sensor_size,
            contrast_threshold=(0.25, 0.2),
        )
        assert_same(reconstruct(cut, times=[image.t], **options), [image])


@every_variant
@both_modes
def test_sparse_times_are_a_selection_of_dense_ones(variant, lookahead):
    dense = {
        image.t: image
        for image in reconstruct(recording(3), rate_hz=300, settings=VARIANTS[variant], lookahead=lookahead)
    }
    some = list(dense)[2::7]
    sparse = reconstruct(recording(3), times=some, settings=VARIANTS[variant], lookahead=lookahead)
    assert_same(sparse, [dense[t] for t in some])


@every_variant
@both_modes
def test_the_origin_of_time_does_not_matter(variant, lookahead):
    shift = 3_600_000_000
    here, there = (
        list(reconstruct(recording(4, shift=s), rate_hz=200, settings=VARIANTS[variant], lookahead=lookahead))
        for s in (0, shift)
    )
    assert [image.t + shift for image in here] == [image.t for image in there]
    for a, b in zip(here, there, strict=True):
        np.testing.assert_array_equal(a.intensity, b.intensity)


# --- threads --------------------------------------------------------------------------------------------


@every_variant
@pytest.mark.parametrize("smooth", [False, True], ids=["forward", "smooth"])
def test_threads_change_nothing(variant, smooth, monkeypatch):
    if smooth and VARIANTS[variant].filter.kind == "cf":
        pytest.skip("the complementary filter cannot be smoothed")
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", 50)
    rec = recording(5)
    made = plan(rec, rate_hz=300, settings=VARIANTS[variant], smooth=smooth)
    expected = list(execute(rec, made))
    for threads in (2, 4):
        counts = []
        assert_same(execute(rec, made, counts.append, threads=threads), expected)
        assert sum(counts) <= rec.source.count_events()
        assert counts


def broken_off(whole: Recording, part: str) -> Recording:
    """The same recording, whose events or frames end half-way with an error."""
    stream, shots = np.concatenate(list(whole.events())), list(whole.frames())
    left, error = {
        "events": ([stream[: len(stream) // 2]], EventError),
        "frames": (shots[: len(shots) // 2], FrameError),
    }[part]

    def read():
        yield from left
        raise error("damaged here")

    return Recording(dataclasses.replace(whole.source, **{part: read}))


@pytest.mark.parametrize("part", ["events", "frames"])
def test_images_before_the_damage_come_whatever_the_threads(part):
    """An error of reading comes after the images that do not need what could not be read."""
    whole = recording(6)
    made = plan(whole, rate_hz=300)
    broken = broken_off(whole, part)
    seen = {threads: [] for threads in (1, 2, 4)}
    for threads, images in seen.items():
        with pytest.raises((EventError, FrameError), match="damaged here"):
            images.extend(execute(broken, made, threads=threads))
        assert_same(images, seen[1])
    assert 0 < len(seen[1]) < len(made.times)
    assert_same(seen[1], list(execute(whole, made))[: len(seen[1])])
    # Who wants no more than these is not told.
    few = dataclasses.replace(made, times=made.times[: len(seen[1])])
    for threads in seen:
        assert_same(execute(broken, few, threads=threads), seen[1])
    assert not own_threads()


@pytest.mark.parametrize(("threads", "expected"), [(1, False), (2, False), (3, True)])
def test_segments_are_made_ahead_where_a_core_is_free_for_it(threads, expected, monkeypatch):
    makers, segment = [], BridgedFrames.segment

    def watched(*arguments):
        makers.append(threading.current_thread().name.startswith("kalux-segments"))
        return segment(*arguments)

    rec = recording(5)
    made = plan(rec, rate_hz=300)
    monkeypatch.setattr(BridgedFrames, "segment", watched)
    for _ in execute(rec, made, threads=threads):
        pass
    assert len(makers) == len(list(rec.frames()))
    # After the last frame there is nothing to be ahead of.
    assert sum(makers) == (len(makers) - 1 if expected else 0)


@pytest.mark.parametrize("threads", [2, 4])
@pytest.mark.parametrize("smooth", [False, True])
def test_a_reconstruction_that_is_given_up_leaves_no_thread(smooth, threads):
    rec = recording(7)
    images = execute(rec, plan(rec, rate_hz=300, smooth=smooth), threads=threads)
    next(images)
    assert own_threads()
    images.close()
    assert not own_threads()


@every_variant
@both_modes
def test_the_first_image_is_at_the_first_time_that_can_be_read(variant, lookahead):
    made = plan(recording(), rate_hz=100, settings=VARIANTS[variant], lookahead=lookahead)
    engine = Reconstructor((3, 4), settings=VARIANTS[variant], lookahead=lookahead)
    engine.push_frame(next(iter(recording().frames())))
    assert made.times[0] == engine.begin_time


# --- what it leaves alone, and damage ------------------------------------------------------------------


def test_nothing_is_changed_by_a_reconstruction():
    rec = recording(5)
    before = [part.copy() for part in rec.events()], [shot.image.copy() for shot in rec.frames()]
    assert_same(reconstruct(rec, rate_hz=100), list(reconstruct(rec, rate_hz=100)))
    for a, b in zip(before[0], rec.events(), strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(before[1], rec.frames(), strict=True):
        np.testing.assert_array_equal(a, b.image)


def test_images_before_the_damage_are_returned(monkeypatch):
    """Events that run backwards late in a file: what came before is given, then the error with the place."""
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", 10)
    stream = random_stream(6)
    # All is given: to estimate it reads ahead, and would find the damage before the first image.
    chosen = all_given()
    good = list(reconstruct(recording(6), at="frames", settings=chosen))
    place = int(stream.events["t"].searchsorted(stream.frames[2].exposure_end)) + 12
    broken = stream.events.copy()
    broken["t"][place] = 0
    source = dataclasses.replace(recording(6).source, events=lambda: iter(np.array_split(broken, 15)))
    images = reconstruct(Recording(source), at="frames", settings=chosen)
    assert_same([next(images), next(images)], good[:2])
    with pytest.raises(EventError, match=f"event {place} at 0 us"):
        list(images)


def test_progress_counts_every_event(monkeypatch):
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", 40)
    told: list[int] = []
    rec = recording()
    last = int(random_stream(0).events["t"][-1])
    assert len(list(execute(rec, plan(rec, times=[last]), told.append))) == 1
    assert told == [40, 40, 40, 30]


def test_progress_of_what_comes_before_a_smoothed_reconstruction(monkeypatch):
    """Copying tells of every event, before anything is filtered; following and the backward pass tell, too."""
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", 40)
    told: list[int] = []
    rec = recording()
    next(execute(rec, plan(rec, at="frames", smooth=True), None, told.append))
    count = sum(len(chunk) for chunk in rec.events())
    copied = int(np.searchsorted(np.cumsum(told), count)) + 1
    assert sum(told[:copied]) == count
    assert max(told[:copied]) == 40
    assert count < sum(told) <= 3 * count


# --- memory ---------------------------------------------------------------------------------------------


class Watched(Reconstructor):
    """Remembers how many events and frames it ever held at once."""

    most_events = most_frames = 0

    def estimate(self, t):
        self._look()
        return super().estimate(t)

    def push_events(self, array):
        super().push_events(array)
        self._look()

    def _look(self):
        Watched.most_events = max(Watched.most_events, len(self._events))
        Watched.most_frames = max(Watched.most_frames, len(self._shots))


@pytest.fixture
def watched(monkeypatch):
    """The pipeline's engine, which must have held something."""
    monkeypatch.setattr("kalux.driver.Reconstructor", Watched)
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", 250)
    Watched.most_events = Watched.most_frames = 0
    yield Watched
    assert Watched.most_events > 0
    assert Watched.most_frames > 0


def long_recording(frames=200, per_frame=100, first_frame=0, last_frame=10**9):
    """100 events and one frame every 10 ms; frames only from the given one to the other."""
    rng = np.random.default_rng(0)
    count = frames * per_frame
    times = np.sort(rng.integers(0, frames * 10_000, count))
    array = make_events(times, *(rng.integers(0, n, count) for n in (5, 4, 2)))
    shots = [
        Frame(np.full((4, 5), 100, np.uint8), 10_000 * k, 10_000 * k + 4_000)
        for k in range(frames)
        if first_frame <= k <= last_frame
    ]
    return Recording.from_arrays(array, shots, sensor_size=(4, 5), contrast_threshold=0.2)


@both_modes
@every_number_of_threads
def test_memory_is_bounded(lookahead, watched, threads):
    """A few frames' worth of 20,000 events; here and below without estimates, which the engine does not make."""
    rec = long_recording()
    made = plan(rec, rate_hz=50, lookahead=lookahead, settings=all_given())
    count = sum(1 for _ in execute(rec, made, threads=threads))
    assert count == pytest.approx(100, abs=2)
    assert watched.most_events <= 1_000
    assert watched.most_frames <= 5


@pytest.mark.parametrize("when", ["end", "both ends"])
@both_modes
@every_number_of_threads
def test_memory_is_bounded_however_few_images_are_wanted(when, lookahead, watched, threads):
    rec = long_recording()
    times = [4_000, 1_990_000] if when == "both ends" else [1_990_000]
    images = list(
        execute(rec, plan(rec, times=times, lookahead=lookahead, settings=all_given()), threads=threads)
    )
    assert len(images) == len(times)
    assert watched.most_events <= 1_000
    assert watched.most_frames <= 5


@every_number_of_threads
def test_memory_is_bounded_where_events_end_early(watched, threads):
    rec = long_recording()
    few = Recording.from_arrays(
        next(iter(rec.events())), rec.frames(), sensor_size=(4, 5), contrast_threshold=0.2
    )
    assert list(execute(few, plan(few, rate_hz=50, settings=all_given()), threads=threads))
    assert watched.most_frames <= 5


@every_number_of_threads
def test_memory_is_bounded_where_frames_begin_late(watched, threads):
    """Events before the first exposure say nothing and need not be kept."""
    with pytest.warns(UserWarning, match="of the 20,000 events lie between"):
        rec = long_recording(first_frame=190)
    assert list(execute(rec, plan(rec, rate_hz=50, settings=all_given()), threads=threads))
    assert watched.most_events <= 1_000


@every_number_of_threads
def test_memory_is_bounded_where_frames_end_early(watched, threads):
    with pytest.warns(UserWarning, match="of the 20,000 events lie between"):
        rec = long_recording(last_frame=10)
    times = list(range(0, 1_990_000, 10_000))
    assert len(list(execute(rec, plan(rec, times=times, settings=all_given()), threads=threads))) == len(
        times
    )
    assert watched.most_events <= 1_000


def test_peak_memory_does_not_grow_with_length(monkeypatch):
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", 250)
    for _ in reconstruct(long_recording(100), rate_hz=20):  # pays for what is compiled and cached
        pass
    peaks = []
    for frames in (200, 800):  # estimates look at some hundred frames at most
        rec = long_recording(frames)
        tracemalloc.start()
        for _ in reconstruct(rec, rate_hz=20):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0] + 50_000


# --- quality --------------------------------------------------------------------------------------------


def errors(simulation, images, inside=lambda truth: np.isfinite(truth)):
    """MSE of images at the ground truth's times, and of the last frame held."""
    truth = simulation.truth()
    found, held = [], []
    for image, reference in zip(images, truth.images, strict=True):
        last = [shot for shot in simulation.frames if shot.exposure_end <= image.t][-1]
        mask = inside(reference)
        found.append(np.mean((image.intensity - reference)[mask] ** 2))
        held.append(np.mean((last.normalised() - reference)[mask] ** 2))
    return np.mean(found), np.mean(held)


SENSOR = SensorSettings(
    threshold_on=0.18,
    threshold_off=0.22,
    threshold_mismatch=0.05,
    noise_rate=0.5,
    read_noise=0.006,
    exposure=12_000,
)


@both_modes
@pytest.mark.parametrize("labelled", [True, False], ids=["known", "estimated"])
def test_better_than_holding_the_last_frame(lookahead, labelled):
    """A noisy sensor with blur and a tenth of the picture saturated."""
    simulation = moving_blocks(0.03, 2.0, sensor=SENSOR)
    assert 0.05 < np.mean([shot.image == 255 for shot in simulation.frames]) < 0.3
    rec = simulation.recording() if labelled else unlabelled(simulation)
    images = reconstruct(rec, times=simulation.truth_times(), lookahead=lookahead)
    found, held = errors(simulation, images)
    assert found < held / (3 if lookahead else 2)


def test_saturated_pixels_are_better_than_held():
    simulation = moving_blocks(0.1, 4.0, sensor=SENSOR)
    images = reconstruct(simulation.recording(), times=simulation.truth_times())
    found, held = errors(simulation, images, lambda truth: truth > 1.05)
    assert found < held / 3


@pytest.mark.parametrize("preset", ["iccv2021", "iccv2021-flir", "cf"])
def test_the_other_presets_run_and_default_is_better_where_frames_can_tell(preset):
    simulation = moving_blocks(0.03, 2.0, sensor=SENSOR)
    times, rec = simulation.truth_times(), simulation.recording()
    other, held = errors(simulation, reconstruct(rec, times=times, preset=preset))
    assert other < held / 2
    unsaturated = lambda truth: truth < 0.95  # noqa: E731
    default, _ = errors(simulation, reconstruct(rec, times=times), unsaturated)
    other, _ = errors(simulation, reconstruct(rec, times=times, preset=preset), unsaturated)
    assert default < other
