"""Whole recordings: what is planned, what comes out, and how much is held on the way."""

from __future__ import annotations

import dataclasses
import tracemalloc
from functools import lru_cache, reduce

import numpy as np
import pytest

import kalux
from kalux import PRESETS, Frame, Reconstructor, Recording, pipeline, reconstruct
from kalux.datasets import SensorSettings
from kalux.errors import EventError, FrameError, InputError, SettingsError
from kalux.events import EVENT_DTYPE, make_events
from kalux.models.camera import BrightTail, Camera, count_bright
from kalux.pipeline import execute, plan

from builders import VARIANTS, altered, events, frame, moving_blocks, own_threads, random_stream, unlabelled

every_variant = pytest.mark.parametrize("variant", VARIANTS)
both_modes = pytest.mark.parametrize("lookahead", [True, False], ids=["lookahead", "causal"])


@lru_cache(maxsize=16)
def recording(seed=0, threshold=(0.25, 0.2), shift=0):
    stream = random_stream(seed, shift=shift)
    return Recording.from_arrays(
        stream.events, stream.frames, sensor_size=stream.sensor_size, contrast_threshold=threshold
    )


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


def test_images_before_the_damage_come_whatever_the_threads():
    """An error of reading comes after the images that do not need what could not be read."""
    whole = recording(6)
    made = plan(whole, rate_hz=300)
    stream = np.concatenate(list(whole.events()))

    def chunks():
        yield stream[: len(stream) // 2]
        raise EventError("damaged here")

    broken = Recording(dataclasses.replace(whole.source, events=chunks))
    one, two = [], []
    for seen, threads in ((one, 1), (two, 2)):
        with pytest.raises(EventError, match="damaged here"):
            seen.extend(execute(broken, made, threads=threads))
    assert 0 < len(one) < len(made.times)
    assert_same(one, list(execute(whole, made))[: len(one)])
    assert_same(two, one)
    assert not own_threads()


@pytest.mark.parametrize("smooth", [False, True])
def test_a_reconstruction_that_is_given_up_leaves_no_thread(smooth):
    rec = recording(7)
    images = execute(rec, plan(rec, rate_hz=300, smooth=smooth), threads=2)
    next(images)
    assert own_threads()
    images.close()
    assert not own_threads()


# --- which times ----------------------------------------------------------------------------------------


@every_variant
@both_modes
def test_the_first_image_is_at_the_first_time_that_can_be_read(variant, lookahead):
    made = plan(recording(), rate_hz=100, settings=VARIANTS[variant], lookahead=lookahead)
    engine = Reconstructor((3, 4), settings=VARIANTS[variant], lookahead=lookahead)
    engine.push_frame(next(iter(recording().frames())))
    assert made.times[0] == engine.begin_time


@pytest.mark.parametrize("rate", [1.0, 24.0, 30.0, 300.0, 59.94, 12_345.6])
def test_a_rate_is_a_grid_without_drift_up_to_the_last_exposure(rate):
    times = plan(recording(), rate_hz=rate).times
    frames = list(recording().frames())
    begin, end = frames[0].exposure_start, frames[-1].exposure_end
    assert times[0] == begin
    assert times[-1] <= end < times[-1] + 1e6 / rate + 1
    assert np.abs(times - begin - np.arange(len(times)) * 1e6 / rate).max() <= 0.5


def test_a_rate_ends_on_the_last_exposures_end_where_it_falls_there():
    rec = Recording.from_arrays(
        events(), [frame(9, 0, 10_000), frame(9, 90_000, 100_000)], sensor_size=(1, 1), contrast_threshold=0.2
    )
    assert plan(rec, rate_hz=30).times.tolist() == [0, 33333, 66667, 100_000]
    assert plan(rec, rate_hz=100).times.tolist() == list(range(0, 100_001, 10_000))


def test_at_the_frames():
    middles = [shot.middle for shot in recording().frames()]
    assert plan(recording(), at="frames").times.tolist() == middles
    assert plan(recording(), at="frames", lookahead=False).times.tolist() == middles[1:]
    assert [image.t for image in reconstruct(recording(), at="frames")] == middles


def test_given_times_may_repeat_and_reach_to_the_last_event():
    frames, last = list(recording().frames()), int(random_stream(0).events["t"][-1])
    assert last > frames[-1].exposure_end
    wanted = [frames[0].exposure_start, frames[1].middle, frames[1].middle, last]
    images = list(reconstruct(recording(), times=np.array(wanted, np.uint32)))
    assert [image.t for image in images] == wanted
    np.testing.assert_array_equal(images[1].intensity, images[2].intensity)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "exactly one of rate_hz, times and at"),
        ({"rate_hz": 10, "times": [1]}, "exactly one"),
        ({"rate_hz": 10, "at": "frames"}, "exactly one"),
        ({"times": [1], "at": "frames", "rate_hz": 1}, "exactly one"),
        ({"at": "events"}, "at is 'events'; only 'frames'"),
        ({"rate_hz": 0}, "rate is 0 Hz"),
        ({"rate_hz": -5}, "rate is -5 Hz"),
        ({"rate_hz": float("nan")}, "rate is nan Hz"),
        ({"rate_hz": float("inf")}, "rate is inf Hz"),
        ({"rate_hz": 2e6}, "at most 1e6"),
        ({"rate_hz": 1e-320}, "at least 1e-6"),
        ({"rate_hz": "100"}, "rate is '100' Hz"),
        ({"times": []}, "at least one"),
        ({"times": 30_000}, "times must be a list"),
        ({"times": [30_000.5]}, "whole microseconds"),
        ({"times": [30_000, np.nan]}, r"times\[1\] is nan; whole microseconds"),
        ({"times": [40_000, 39_999]}, r"times\[1\] is 39999 us, before 40000 us.*; times must increase"),
        ({"times": [19_999]}, "19999 us lies before 20000 us"),
        ({"times": [30_000, 10**9]}, "1000000000 us lies after the recording's end"),
    ],
)
def test_times_that_cannot_be(options, message):
    """Before the first image, not while iterating."""
    with pytest.raises(InputError, match=message):
        reconstruct(recording(), **options)


def test_times_may_be_floats_that_are_whole():
    times = np.linspace(30_000, 50_000, 3)
    assert [image.t for image in reconstruct(recording(), times=times)] == [30_000, 40_000, 50_000]


@pytest.mark.parametrize(
    ("first", "options", "message"),
    [
        ("night.aedat4", {}, "recording is a str; a kalux.Recording is needed, from kalux.open"),
        (None, {}, "recording is a NoneType; a kalux.Recording is needed"),
        (
            recording,
            {"settings": {"filter": {"kind": "cf"}}},
            "settings is a dict; a kalux.Settings is needed",
        ),
        (recording, {"calibration": "c.toml"}, "calibration is a str; a kalux.Calibration is needed"),
    ],
)
def test_arguments_of_the_wrong_type_are_named(first, options, message):
    with pytest.raises(InputError, match=message):
        reconstruct(first() if callable(first) else first, rate_hz=10, **options)


@every_variant
def test_times_outside_depend_on_the_mode(variant):
    first = next(iter(recording().frames()))
    options = {"settings": VARIANTS[variant], "lookahead": False}
    with pytest.raises(InputError, match=f"lies before {first.exposure_end} us"):
        reconstruct(recording(), times=[first.exposure_end - 1], **options)
    assert len(list(reconstruct(recording(), times=[first.exposure_end], **options))) == 1


# --- what is decided ------------------------------------------------------------------------------------


def test_thresholds_of_the_settings_come_first():
    chosen = altered(PRESETS["default"], "events", threshold_on=0.31, threshold_off=0.32)
    made = plan(recording(), rate_hz=10, settings=chosen, preset="cf")
    assert made.threshold_origin == "settings"
    assert made.estimate is None
    assert (made.settings.events.threshold_on, made.settings.events.threshold_off) == (0.31, 0.32)
    assert made.settings.filter.kind == "akf"


def test_then_those_of_the_recording():
    made = plan(recording(), rate_hz=10)
    assert made.threshold_origin == "recording"
    assert (made.settings.events.threshold_on, made.settings.events.threshold_off) == (0.25, 0.2)
    half = plan(recording(), rate_hz=10, settings=altered(PRESETS["default"], "events", threshold_on=0.4))
    assert (half.settings.events.threshold_on, half.settings.events.threshold_off) == (0.4, 0.2)


def test_then_an_estimate():
    made = plan(unlabelled(moving_blocks(0.08, 0.9)), rate_hz=10)
    assert made.threshold_origin == "estimate"
    assert made.settings.events.threshold_on == made.estimate.on == pytest.approx(0.2, rel=0.12)
    assert made.settings.events.threshold_off == made.estimate.off == pytest.approx(0.2, rel=0.12)


def test_and_last_an_assumption():
    made = plan(recording(0, None), rate_hz=10)
    assert made.threshold_origin == "assumed"
    assert made.estimate is None
    assert made.settings.events.threshold_on == made.settings.events.threshold_off == 0.25
    assert (made.settings.events.threshold_spread, made.settings.events.delay) == (0.5, 0)


def test_of_a_sensor_the_usual_is_assumed():
    """One frame tells no threshold, no delay and no step."""
    frames = [frame(100, 0, 10_000)]
    alone = Recording.from_arrays(events(), frames, sensor_size=(1, 1))
    made = plan(alone, at="frames", preset="davis346")
    usual = PRESETS["davis346"].events
    found = made.settings.events
    assert made.threshold_origin == "assumed"
    assert (found.threshold_on, found.threshold_off) == (usual.usual_threshold_on, usual.usual_threshold_off)
    assert (found.delay, found.step_variance) == (usual.usual_delay, usual.usual_step_variance)
    assert found.threshold_spread == 0.2


def test_a_sensors_usual_thresholds_give_way_to_the_recordings():
    known = plan(recording(), at="frames", preset="davis346")
    assert known.threshold_origin == "recording"
    assert (known.settings.events.threshold_on, known.settings.events.threshold_off) == (0.25, 0.2)
    told = plan(unlabelled(moving_blocks(0.08, 0.9)), at="frames", preset="davis240c")
    assert told.threshold_origin == "estimate"
    assert told.settings.events.threshold_on == pytest.approx(0.2, rel=0.12)


@pytest.mark.parametrize(
    ("name", "preset", "part"),
    [("newton_davis346.aedat4", "davis346", 0.6), ("slider_depth", "davis240c", 1.05)],
)
def test_a_sensors_preset_helps_where_there_is_one_frame(shared_data, name, preset, part):
    """The next frame is nearer to what is made of the frame before it and of the events."""
    unknown = {} if "aedat4" in name else {"exposure": 10_000}
    whole = kalux.open(shared_data / name, **unknown)
    shown, wanted = list(whole.frames())[2:4]
    near = [e[(e["t"] >= shown.exposure_start) & (e["t"] <= wanted.exposure_end)] for e in whole.events()]
    alone = Recording.from_arrays(np.concatenate(near), [shown], sensor_size=whole.sensor_size)

    def error(preset: str) -> float:
        (image,) = reconstruct(alone, times=[wanted.middle], preset=preset)
        return float(np.mean((image.intensity - wanted.normalised()) ** 2))

    assert error(preset) < part * error("default")


def test_highlights_are_believed_less_where_the_threshold_is_an_estimate():
    """The same numbers, known and estimated."""
    simulation = moving_blocks(0.1, 4.0)
    guessed = plan(unlabelled(simulation), at="frames")
    known = plan(unlabelled(simulation), at="frames", settings=guessed.settings)
    assert (guessed.threshold_origin, known.threshold_origin) == ("estimate", "settings")
    sums = []
    for made in (guessed, known):
        images = [image.intensity for image in execute(unlabelled(simulation), made)]
        sums.append(sum(image[image > 1].sum() for image in images))
    assert sums[0] < sums[1]


def test_white_is_the_median_exposure_unless_set():
    frames = [frame(100, 40_000 * k, 40_000 * k + e) for k, e in enumerate((2_000, 8_000, 4_000))]
    rec = Recording.from_arrays(events(), frames, sensor_size=(1, 1), contrast_threshold=0.2)
    assert plan(rec, at="frames").settings.camera.reference_exposure == 4_000
    images = list(reconstruct(rec, at="frames"))
    found = [image.intensity[0, 0] for image in images]
    np.testing.assert_allclose(found, np.array([2.0, 0.5, 1.0]) * 100 / 255, rtol=0.1)
    doubled = altered(PRESETS["default"], "camera", reference_exposure=8_000)
    twice = [image.intensity[0, 0] for image in reconstruct(rec, at="frames", settings=doubled)]
    assert twice[1] == pytest.approx(100 / 255, rel=0.1)


def test_a_recording_without_frames():
    rec = Recording.from_arrays(events((1, 0, 0, 1)), [], sensor_size=(1, 1), name="dark.aedat4")
    with pytest.raises(
        FrameError,
        match=r"dark\.aedat4: no frames; kalux needs frames .* join images or a video with --frames",
    ):
        reconstruct(rec, rate_hz=10)


def test_a_recording_without_events():
    frames = [frame(100, 40_000 * k, 40_000 * k + 4_000) for k in range(3)]
    rec = Recording.from_arrays(events(), frames, sensor_size=(1, 1))
    for image in reconstruct(rec, rate_hz=100):
        assert image.intensity[0, 0] == pytest.approx(100 / 255, rel=1e-4)


def test_unknown_preset():
    with pytest.raises(SettingsError, match="unknown preset 'iccv'"):
        reconstruct(recording(), rate_hz=10, preset="iccv")


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
    chosen = altered(PRESETS["default"], "events", delay=0, step_variance=0.2, refractory_period=0)
    chosen = altered(chosen, "events", threshold_spread=0.1, noise_rate=3.0)
    chosen = altered(chosen, "camera", log_offset=0.03, frame_noise=0.006)
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


# --- memory ---------------------------------------------------------------------------------------------


class Watched(Reconstructor):
    """Remembers how many events and frames it ever held at once."""

    most_events = most_frames = 0

    def read(self, t):
        self._look()
        return super().read(t)

    def push_events(self, array):
        super().push_events(array)
        self._look()

    def _look(self):
        Watched.most_events = max(Watched.most_events, len(self._events))
        Watched.most_frames = max(Watched.most_frames, len(self._shots))


@pytest.fixture
def watched(monkeypatch):
    monkeypatch.setattr(pipeline, "Reconstructor", Watched)
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", 250)
    Watched.most_events = Watched.most_frames = 0
    return Watched


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
def test_memory_is_bounded(lookahead, watched):
    """A few frames' worth of 20,000 events."""
    count = sum(1 for _ in reconstruct(long_recording(), rate_hz=50, lookahead=lookahead))
    assert count == pytest.approx(100, abs=2)
    assert watched.most_events <= 1_000
    assert watched.most_frames <= 5


@pytest.mark.parametrize("when", ["end", "both ends"])
@both_modes
def test_memory_is_bounded_however_few_images_are_wanted(when, lookahead, watched):
    rec = long_recording()
    times = [4_000, 1_990_000] if when == "both ends" else [1_990_000]
    assert len(list(reconstruct(rec, times=times, lookahead=lookahead))) == len(times)
    assert watched.most_events <= 1_000
    assert watched.most_frames <= 5


def test_memory_is_bounded_where_events_end_early(watched):
    rec = long_recording()
    few = Recording.from_arrays(
        next(iter(rec.events())), rec.frames(), sensor_size=(4, 5), contrast_threshold=0.2
    )
    assert list(reconstruct(few, rate_hz=50))
    assert watched.most_frames <= 5


def test_memory_is_bounded_where_frames_begin_late(watched):
    """Events before the first exposure say nothing and need not be kept."""
    assert list(reconstruct(long_recording(first_frame=190), rate_hz=50))
    assert watched.most_events <= 1_000


def test_memory_is_bounded_where_frames_end_early(watched):
    rec = long_recording(last_frame=10)
    times = list(range(0, 1_990_000, 10_000))
    assert len(list(reconstruct(rec, times=times))) == len(times)
    assert watched.most_events <= 1_000


def test_peak_memory_does_not_grow_with_length(monkeypatch):
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", 250)
    peaks = []
    for frames in (50, 50, 400):  # the first also pays for what is compiled and cached
        rec = long_recording(frames)
        tracemalloc.start()
        for _ in reconstruct(rec, rate_hz=20):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] < 1.5 * peaks[1] + 50_000


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


def test_the_frame_noise_comes_from_the_frames_and_can_be_given():
    rng = np.random.default_rng(0)
    ramp = np.broadcast_to(np.linspace(20, 200, 80), (60, 80))
    frames = [
        Frame((ramp + rng.normal(0, 2, ramp.shape)).round().astype(np.uint8), t, t + 1000)
        for t in range(0, 400_000, 50_000)
    ]
    source = Recording.from_arrays(np.empty(0, EVENT_DTYPE), frames, sensor_size=ramp.shape)
    made = plan(source, at="frames")
    assert made.frame_noise.read == made.settings.camera.frame_noise == pytest.approx(2 / 255, rel=0.1)
    assert made.frame_noise.shot == made.settings.camera.shot_noise
    for given, expected in (
        ({"frame_noise": 0.004}, (0.004, 0.0)),
        ({"frame_noise": 0.004, "shot_noise": 1e-4}, (0.004, 1e-4)),
        ({"shot_noise": 1e-4}, (made.frame_noise.read, 1e-4)),
    ):
        settings = altered(PRESETS["default"], "camera", **given)
        assert plan(source, at="frames", settings=settings).settings.camera.noise == expected
    unknown = plan(recording(), at="frames")  # its pixels are too few to tell
    assert unknown.frame_noise is None
    assert unknown.settings.camera.noise == (unknown.settings.camera.usual_frame_noise, 0.0)
    paper = plan(source, at="frames", preset="iccv2021").settings
    assert paper.camera.frame_noise is None  # it has a confidence instead


def test_the_bright_tail_comes_from_the_frames_and_can_be_given():
    doubted = recording(0, None)
    made = plan(doubted, at="frames").settings
    counts = [count_bright(Camera.named("linear", 0.98), f.normalised()) for f in doubted.frames()]
    expected = reduce(BrightTail.joined, counts).scale
    assert made.filter.bright_tail == expected
    given = altered(PRESETS["default"], "filter", bright_tail=0.7)
    assert plan(doubted, at="frames", settings=given).settings.filter.bright_tail == 0.7


def test_the_bright_tail_is_not_looked_for_where_nothing_asks_for_it():
    """Thresholds are stated, and no highlight is expected above its bound."""
    chosen = altered(PRESETS["default"], "filter", unshown_tail=0.0)
    assert plan(recording(), at="frames", settings=chosen).settings.filter.bright_tail is None
    assert plan(recording(), at="frames").settings.filter.bright_tail is not None
    assert plan(recording(), at="frames", preset="iccv2021").settings.filter.bright_tail is None


def test_highlights_are_believed_less_where_thresholds_are_estimated():
    """A pixel that events take beyond white: by a prior of the tail's scale, rather than 1.5."""
    frames = [Frame(np.full((4, 4), 200, np.uint8), t, t + 1000) for t in (0, 50_000)]
    rise = np.zeros(8, EVENT_DTYPE)
    rise["t"], rise["p"] = np.arange(60_000, 68_000, 1000), True
    source = Recording.from_arrays(rise, frames, sensor_size=(4, 4))
    stated = altered(PRESETS["default"], "events", threshold_on=0.2, threshold_off=0.2)
    seen = []
    for origin in ("settings", "estimate"):
        chosen = dataclasses.replace(plan(source, times=[67_000], settings=stated), threshold_origin=origin)
        (image,) = execute(source, chosen)
        seen.append(image.intensity[0, 0])
    assert seen[0] > seen[1] > 1
