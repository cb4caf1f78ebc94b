"""The paths of what moves between frames, and the engine that follows them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalux import PRESETS, Frame, Reconstructor
from kalux.augmentation.along import Along
from kalux.augmentation.bridge import UNMEASURED
from kalux.augmentation.motion import HalfWay, _windows, behind, bent, find_path, unknown_bend
from kalux.events import make_events
from kalux.settings import altered
from textures import SHAPE, frame_of, texture, whole

INSIDE = (slice(16, -16), slice(16, -16))
EVENTS = np.ones(SHAPE, np.float32)


@pytest.mark.parametrize(("x", "y"), [(3.0, 0.0), (-1.5, 4.0), (6.0, -5.0), (0.0, 0.5)])
def test_the_path_is_what_a_texture_moves_by(x, y):
    path = find_path(frame_of(texture(0)), frame_of(texture(0, x, y)), -3.5, 1.0)
    np.testing.assert_allclose(np.median(path[0][INSIDE]), x, atol=0.1)
    np.testing.assert_allclose(np.median(path[1][INSIDE]), y, atol=0.1)
    assert path.shape == (2, *SHAPE)


def test_nothing_moves_where_frames_differ_by_their_noise():
    first = texture(0)
    noise = np.random.default_rng(1).normal(0, 0.05, (2, *SHAPE)).astype(np.float32)
    frames = [frame_of(first + part, 0.05**2) for part in noise]
    assert find_path(*frames, -3.5, 1.0) is None


def test_nothing_is_followed_where_frames_measure_nothing():
    frames = [frame_of(texture(0, x), UNMEASURED) for x in (0.0, 3.0)]
    assert find_path(*frames, -3.5, 1.0) is None


def test_a_sensor_of_a_few_rows_is_not_followed():
    frames = [frame_of(texture(0, x, shape=(31, 200))) for x in (0.0, 3.0)]
    assert find_path(*frames, -3.5, 1.0) is None


@pytest.mark.parametrize("late", [-0.8, 0.5, 1.2])
def test_the_path_is_bent_to_the_image_half_way(late):
    """A texture that moves by 4 pixels, but is not where 2 are half-way: the bend finds it, and it is seen there."""
    first, second = frame_of(texture(0)), frame_of(texture(0, 4.0))
    level, variance = texture(0, 2.0 + late), np.full(SHAPE, 1e-3, np.float32)
    motion = bent(
        first, second, find_path(first, second, -3.5, 1.0), HalfWay(level, variance, 0.0, 0.04, 0.04, EVENTS)
    )
    np.testing.assert_allclose(np.median(motion.bend[0][INSIDE]), -late, atol=0.1)
    np.testing.assert_allclose(np.median(motion.bend[1][INSIDE]), 0.0, atol=0.05)
    noisy = level + np.random.default_rng(1).normal(0, 0.1, SHAPE).astype(np.float32)
    joined, left = whole(Along(motion, 0.5), noisy, np.full(SHAPE, 0.01, np.float32))
    error = np.sqrt(np.mean(np.square(joined - level)[INSIDE]))
    assert error < 0.05
    assert (left <= 0.01).all()


def test_an_image_that_is_behind_the_light_bends_no_path():
    """Half-way it shows what was there a twentieth of the way before."""
    first, second = frame_of(texture(0)), frame_of(texture(0, 8.0))
    level, variance = texture(0, 3.6), np.full(SHAPE, 1e-3, np.float32)
    path = find_path(first, second, -3.5, 1.0)
    motion = bent(first, second, path, HalfWay(level, variance, 0.05, 0.04, 0.04, EVENTS))
    np.testing.assert_allclose(np.median(motion.bend[0][INSIDE]), 0.0, atol=0.05)
    noisy = level + np.random.default_rng(1).normal(0, 0.1, SHAPE).astype(np.float32)
    joined, _ = whole(Along(motion, 0.5), noisy, np.full(SHAPE, 0.03, np.float32))
    assert np.sqrt(np.mean(np.square(joined - texture(0, 4.0))[INSIDE])) < 0.06


@pytest.mark.parametrize("far", [(2.5, 0.0), (-2.0, 2.5)])
def test_a_camera_that_shakes_bends_the_path_by_more_than_its_length(far):
    """Silent pixels say that half-way there is the mean of both frames; those with events know better."""
    x, y = far
    first, second = frame_of(texture(0)), frame_of(texture(0, 1.0))
    level, variance = texture(0, 0.5 + x, y), np.full(SHAPE, 1e-3, np.float32)
    mean = (first.value + second.value) / 2
    events = (np.abs(level - mean) > 0.2).astype(np.float32)
    assert 0.2 < events.mean() < 0.8
    known = np.where(events > 0, level, mean)
    path = find_path(first, second, -3.5, 1.0)
    motion = bent(first, second, path, HalfWay(known, variance, 0.0, 0.04, 0.04, events))
    np.testing.assert_allclose(np.median(motion.bend[0][INSIDE]), -x, atol=0.25)
    np.testing.assert_allclose(np.median(motion.bend[1][INSIDE]), -y, atol=0.25)


def test_where_no_event_comes_the_path_is_bent_as_elsewhere_and_what_stands_still_is_not():
    """The image moves, but for its right third, which is faint; only the left third tells by how much half-way."""
    left, right = np.s_[:, : SHAPE[1] // 3], np.s_[:, -SHAPE[1] // 3 :]
    still, moved = texture(0), texture(0, 4.0)
    still[right] *= np.float32(0.02)
    moved[right] = still[right]
    first = frame_of(still)
    second = frame_of(moved)
    level, variance = (first.value + moved) / 2, np.full(SHAPE, 1e-3, np.float32)
    level[left] = texture(0, 3.0)[left]
    events = np.zeros(SHAPE, np.float32)
    events[left] = 1.0
    path = find_path(first, second, -3.5, 1.0)
    motion = bent(first, second, path, HalfWay(level, variance, 0.0, 0.04, 0.04, events))
    middle = np.s_[16:-16, SHAPE[1] // 2 - 4 : SHAPE[1] // 2 + 4]
    assert np.median(motion.bend[0][left]) == pytest.approx(-1.0, abs=0.15)
    assert np.median(motion.bend[0][middle]) < -0.5
    beside = np.s_[:, 2 * SHAPE[1] // 3 + 4 : 2 * SHAPE[1] // 3 + 12]
    assert np.abs(motion.bend[0][beside]).max() < 0.25


def test_what_is_not_known_of_a_bend():
    """At most what accelerations make of the time between frames; across an edge as much as its slopes tell."""
    nothing, edge, texture_both = ([0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [100.0, 100.0, 0.0])
    told = np.array([nothing, edge, texture_both], np.float32).T
    at_25, at_12 = (unknown_bend(told, interval) for interval in (0.04, 0.08))
    assert at_25[0] == pytest.approx((500 * 0.04**2 / 8) ** 2, rel=1e-4)
    assert at_12[0] == pytest.approx(16 * at_25[0], rel=1e-4)
    np.testing.assert_allclose(at_12[1:], 1 / (100 + 1 / at_12[0]), rtol=1e-3)


def test_it_is_behind_by_a_share_of_the_time_between_events_as_far_as_frames_let_it():
    assert behind(10_000, 40_000) == pytest.approx(0.02)
    assert behind(20_000, 40_000) == pytest.approx(0.04)
    assert behind(100_000, 40_000) == behind(1_000_000, 40_000) < 0.06


def test_a_wrong_path_is_not_believed():
    """Frames that have nothing to do with the image leave it as it is."""
    first, second = frame_of(texture(0)), frame_of(texture(1))
    level, variance = texture(2), np.full(SHAPE, 1e-3, np.float32)
    path = find_path(first, second, -3.5, 1.0)
    motion = bent(first, second, path, HalfWay(level, variance, 0.0, 0.04, 0.04, EVENTS))
    if motion is not None:
        joined, _ = whole(Along(motion, 0.5), level, variance)
        assert np.sqrt(np.mean(np.square(joined - level))) < 0.01


@given(told=st.lists(st.tuples(st.integers(0, 129), st.integers(0, 199)), min_size=1, max_size=6))
@settings(deadline=None)
def test_windows_hold_the_tiles_that_matter_once(told):
    """A motion that matters in a few places only is looked at there, and in no pixel twice."""
    gain = np.zeros((130, 200), np.float32)
    for row, column in told:
        gain[row // 64 * 64 : row // 64 * 64 + 64, column // 64 * 64 : column // 64 * 64 + 64] = 0.3
    times = np.zeros(gain.shape, int)
    for window in _windows(gain):
        times[window] += 1
    np.testing.assert_array_equal(times, gain > 0)


def test_tiles_beside_and_below_each_other_are_one_window():
    gain = np.zeros((130, 200), np.float32)
    gain[:, 64:192] = gain[:64, 192:] = 0.3
    assert _windows(gain) == [(slice(0, 64), slice(64, 200)), (slice(64, 130), slice(64, 192))]
    assert _windows(np.ones_like(gain)) == [(slice(0, 130), slice(0, 200))]
    assert _windows(np.zeros_like(gain)) == []


# --- the engine ----------------------------------------------------------------------------------------------


def moving_recording():
    """Frames of a texture that accelerates to the right, 3 to 8 pixels a frame, and its events of steps of 0.3."""
    places = np.cumsum(np.linspace(0.0, 0.8, 100)) / 4
    levels = [texture(0, place) for place in places]
    frames = [
        Frame(np.clip(255 * np.exp(level), 0, 255).astype(np.uint8), t - 500, t + 500)
        for t, level in list(zip(range(1_000, 101_000, 1_000), levels, strict=True))[::20]
    ]
    reference, rows = levels[0].copy(), []
    for t, level in zip(range(1_000, 101_000, 1_000), levels, strict=True):
        for _ in range(8):
            steps = np.trunc((level - reference) / 0.3).clip(-1, 1)
            y, x = np.nonzero(steps)
            rows += [(t, column, row, steps[row, column] > 0) for row, column in zip(y, x, strict=True)]
            reference += 0.3 * steps
    return frames, make_events(*(np.array(part) for part in zip(*rows, strict=True))), levels


@pytest.fixture(scope="module")
def moving():
    return moving_recording()


def engine(moving, motion="on", reference=None, **kwargs):
    frames, events, _ = moving
    chosen = altered(PRESETS["default"], "filter", motion=motion)
    chosen = altered(chosen, "camera", reference_exposure=reference)
    made = Reconstructor(
        SHAPE, settings=altered(chosen, "events", threshold_on=0.3, threshold_off=0.3, delay=0), **kwargs
    )
    for frame in frames:
        made.push_frame(frame)
    made.push_events(events)
    made.finish()
    return made


def error(made, levels, t, below=np.inf):
    """Of pixels below a log intensity; frames clip at 0."""
    found, level = np.log(np.maximum(made.read(t).intensity, 1e-3))[INSIDE], levels[t // 1_000 - 1][INSIDE]
    return np.sqrt(np.mean(np.square(found - level)[level < below]))


def test_images_between_frames_are_nearer_to_the_truth(moving):
    """Half-way and a quarter of the way."""
    made, without = engine(moving), engine(moving, motion="off")
    for t in (46_000, 51_000, 56_000):
        assert error(made, moving[2], t) < 0.8 * error(without, moving[2], t)


@pytest.mark.parametrize("exposures", [0.25, 1, 8])
def test_what_moves_is_followed_whatever_the_reference_exposure(moving, exposures):
    """Frames of an eighth of it are up to eight times as bright as its white, which is no highlight of theirs."""
    made = engine(moving, reference=round(1_000 * exposures))
    without = engine(moving, motion="off", reference=round(1_000 * exposures))

    def off(engine):
        found = np.log(np.maximum(engine.read(51_000).intensity / exposures, 1e-3))[INSIDE]
        return np.sqrt(np.mean(np.square(found - moving[2][50][INSIDE])))

    assert off(made) < 0.8 * off(without)


def test_images_at_frames_are_nearer_to_the_truth(moving):
    """The other frame, of which at the last one it is the one before, has noise of its own, here of 2 of 255."""
    frames, events, levels = moving
    rng = np.random.default_rng(1)
    noisy = [
        Frame(
            np.clip(frame.image + rng.normal(0.0, 2.0, SHAPE), 0, 255).astype(np.uint8),
            frame.exposure_start,
            frame.exposure_end,
        )
        for frame in frames
    ]
    made, without = engine((noisy, events, levels)), engine((noisy, events, levels), motion="off")
    for t in (21_000, 41_000, 61_000, 81_000):
        assert error(made, levels, t, below=-0.3) < 0.9 * error(without, levels, t, below=-0.3)


def test_what_moves_depends_neither_on_reads_nor_on_what_is_forgotten(moving):
    made, other, third = engine(moving), engine(moving), engine(moving)
    times = [41_000, 43_000, 48_000, 51_000, 58_000, 61_000]
    expected = [made.read(t) for t in times]
    other.forget(times[1])
    for t, image in list(zip(times, expected, strict=True))[:0:-1]:
        np.testing.assert_array_equal(other.read(t).intensity, image.intensity)
    for t, image in zip(times, expected, strict=True):
        again = third.image(third.estimate(t), with_variance=False)
        np.testing.assert_array_equal(again.intensity, image.intensity)
        assert np.isinf(again.variance).all()


def test_a_live_stream_looks_at_no_frame_ahead(moving):
    made, without = engine(moving, lookahead=False), engine(moving, motion="off", lookahead=False)
    np.testing.assert_array_equal(made.read(51_000).intensity, without.read(51_000).intensity)
