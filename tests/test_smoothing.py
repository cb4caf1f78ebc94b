"""Both ways in time."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import kalux
from kalux import PRESETS, Frame, Recording, smoothing, spill
from kalux.augmentation.bridge import REPEATED, UNMEASURED
from kalux.calibration.values import Calibration
from kalux.datasets import SensorSettings, demo_scene, simulate
from kalux.datasets.ahdr import ArtificialCamera, artificial_hdr
from kalux.errors import InputError
from kalux.events import make_events
from kalux.filters.shots import take_shot
from kalux.filters.uncertainty import Around
from kalux.images import Estimate
from kalux.models.camera import Camera
from kalux.planning import plan
from kalux.reconstructor import Reconstructor
from kalux.settings import altered
from kalux.smoothing import Trails, combine, reversed_settings
from kalux.spill import Spill
from mirrored import SIZE, mirrored, recording

from builders import unshown

STEPS = altered(PRESETS["default"], "events", trail=0.0)
"""Nothing is known between two events (no K14), so that both directions of time are alike."""


def engine_over(source, chosen=None):
    settings = plan(source, rate_hz=10, settings=STEPS if chosen is None else chosen).settings
    engine = Reconstructor(SIZE, settings=settings)
    for frame in source.frames():
        engine.push_frame(frame)
    for chunk in source.events():
        engine.push_events(chunk)
    engine.finish()
    return engine


def test_smoothing_is_two_filters_combined_by_information():
    source = recording()
    chosen = dataclasses.replace(STEPS, filter=dataclasses.replace(STEPS.filter, unshown_tail=0.0))
    forward, backward = (engine_over(of, chosen) for of in (source, mirrored(source)))
    times = list(range(1_000, 172_000, 7_000))
    middles = [frame.middle for frame in source.frames()]
    seen_backward = {t: backward.estimate(-t) for t in times[::-1]}
    images = kalux.reconstruct(source, times=times, settings=chosen, smooth=True)
    for image, t in zip(images, times, strict=True):
        a, b = forward.estimate(t), seen_backward[t]
        weights = 1 / a.variance, 1 / b.variance
        level = (weights[0] * a.log_intensity + weights[1] * b.log_intensity) / (weights[0] + weights[1])
        known = [e.silent_change for e in (a, b) if e.silent_change is not None]
        change = np.mean(known, axis=0)
        after = min(max(int(np.searchsorted(middles, t)), 1), len(middles) - 1)
        share = (t - middles[after - 1]) / (middles[after] - middles[after - 1])
        correlation, around = 0.0, a.around
        if a.around is not None and b.around is not None:
            first, second = (variance < UNMEASURED for variance in a.around[:2])
            same = np.where(first, 1 - share, 0) + np.where(second, share, 0)
            unsignalled = np.minimum(0.2 * 0.25 / 6 / np.sqrt(a.variance * b.variance), 1)  # c^2 / 6
            correlation = unsignalled + (1 - unsignalled) * same
            half_way = (a.around.half_way + b.around.half_way) / 2
            at_frame = t in middles  # which neither direction counts yet
            around = a.around._replace(counted=0.0 if at_frame else UNMEASURED, half_way=half_way)
        either = dataclasses.replace(
            a,
            log_intensity=level,
            variance=(sum(weights) + 2 * correlation * np.sqrt(weights[0] * weights[1])) / sum(weights) ** 2,
            signalled_variance=1 / sum(weights),
            moving=np.where(change > 0.005 * 0.2 * 0.25, a.moving | b.moving, a.moving & b.moving),
            silent_change=change,
            around=around,
            since=None if a.since is None else min(a.since, b.since),
        )
        expected = forward.image(either)
        np.testing.assert_allclose(image.intensity, expected.intensity, rtol=1e-6)
        np.testing.assert_allclose(image.variance, expected.variance, rtol=1e-6)


@pytest.mark.parametrize("calibrated", [False, True])
def test_the_mirrored_recording_gives_the_mirrored_video(calibrated):
    """Nothing in a smoothed image knows the direction of time, but for K14; nor do thresholds of single pixels."""
    source = recording(1)
    rise, fall = (np.random.default_rng(k).uniform(low, 1.5 * low, SIZE) for k, low in enumerate((0.8, 0.6)))
    names = ["threshold_on", "threshold_on_variance", "threshold_off", "threshold_off_variance"]
    known, mirror = None, None
    if calibrated:
        known = Calibration(maps=dict(zip(names, (rise, 1e-4 * rise, fall, 1e-3 * fall), strict=True)))
        mirror = Calibration(maps=dict(zip(names, (fall, 1e-3 * fall, rise, 1e-4 * rise), strict=True)))
    times = np.arange(2_500, 171_000, 8_000)  # no event or edge falls on them
    ahead = list(kalux.reconstruct(source, times=times, settings=STEPS, calibration=known, smooth=True))
    reverse = kalux.reconstruct(
        mirrored(source), times=-times[::-1], settings=STEPS, calibration=mirror, smooth=True
    )
    back = list(reverse)[::-1]
    for one, other in zip(ahead, back, strict=True):
        # The middle of an exposure of an odd number of microseconds is rounded to the other side. The frames around are
        # those of the forward filter, whose variance has their correction (K3) by the thresholds learned until then:
        # 2e-4 c^2 either way, unless thresholds are known.
        learned = 0.0 if calibrated else 2e-4 * 0.2 * 0.25
        np.testing.assert_allclose(one.variance, other.variance, rtol=1e-3, atol=learned)
        np.testing.assert_allclose(one.intensity, other.intensity, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("window", [1, 16 * 48 * 3, 16 * 48 * 1000])
@pytest.mark.parametrize("block", [1, 100, 10_000])
def test_windows_and_blocks_change_nothing(monkeypatch, window, block):
    source = recording(2)
    times = np.sort(np.r_[np.arange(0, 172_000, 5_000), 45_000, 80_001])
    expected = list(kalux.reconstruct(source, times=times, smooth=True))
    monkeypatch.setattr(smoothing, "_WINDOW_BYTES", window)
    monkeypatch.setattr(spill, "_BLOCK_EVENTS", block)
    for one, other in zip(kalux.reconstruct(source, times=times, smooth=True), expected, strict=True):
        np.testing.assert_array_equal(one.intensity, other.intensity)
        np.testing.assert_array_equal(one.variance, other.variance)


@pytest.mark.parametrize("delay", [0, 2_500])
@pytest.mark.parametrize("hot", [False, True])
def test_the_backward_filter_is_told_what_the_forward_one_knows(tmp_path, delay, hot):
    """K14: f at the middles of the frames, with the s of the intervals on either side."""
    source = recording(4)
    broken = np.zeros(SIZE, bool)
    broken[2, 3] = hot
    settings = plan(source, rate_hz=10, settings=altered(PRESETS["default"], "events", delay=delay)).settings
    engine = Reconstructor(SIZE, settings=settings)
    trails = Trails(Spill(source, tmp_path), settings, broken if hot else None, engine.measures)
    events = np.concatenate(list(source.events()))
    frames = list(source.frames())
    for frame in frames:
        engine.push_frame(frame)
    engine.push_events(events[~broken[events["y"], events["x"]]])
    engine.finish()
    for k, frame in enumerate(frames):
        told = trails.reversed_trail(len(frames) - 1 - k)
        np.testing.assert_allclose(engine.trail(frame.middle), told.before, atol=1e-6)
        np.testing.assert_allclose(engine.trail(frame.middle + 1), told.after, atol=1e-3)
    assert np.abs(told.after).max() > 0.01


def test_smoothing_follows_a_steady_change_between_its_events():
    """Both filters are ahead of their events as the light is; without K14 both hold the same step."""
    times = np.arange(1, 10) * 16_667
    zeros = np.zeros(len(times), np.int64)
    frames = [
        Frame(np.full((1, 1), 0.25 * np.exp(12e-6 * (t - 79_500)) - 0.004, np.float32), t, t + 1_000, 1.0)
        for t in range(0, 160_000, 40_000)
    ]
    source = Recording.from_arrays(
        make_events(times, zeros, zeros, zeros + 1), frames, sensor_size=(1, 1), contrast_threshold=0.2
    )
    reads = np.arange(42_000, 118_000, 1_000)

    def error(trail):
        settings = altered(PRESETS["default"], "events", trail=trail, noise_rate=0.0, delay=0)
        settings = altered(settings, "camera", log_offset=0.004)
        images = kalux.reconstruct(source, times=reads, settings=settings, smooth=True)
        found = np.log([image.intensity[0, 0] + 0.004 for image in images])
        return np.sqrt(np.mean((found - np.log(0.25) - 12e-6 * (reads - 80_000)) ** 2))

    assert error(0.4) < 0.8 * error(0.0)


def test_steps_without_variance_are_the_limit_of_sure_ones():
    """Pixels that only the first or the second frame measures, a quarter of the way between them."""
    levels = np.full(SIZE, 120, np.uint8)
    first, second = levels.copy(), levels.copy()
    first[:2], second[-2:] = 255, 255
    frames = [Frame(first, 0, 4_000), Frame(second, 40_000, 44_000)]
    events = np.concatenate(list(recording(events=200).events()))
    source = Recording.from_arrays(events, frames, sensor_size=SIZE, contrast_threshold=0.2)
    images = []
    for variance in (1e-7, 0.0):
        chosen = altered(
            altered(PRESETS["default"], "events", step_variance=variance), "camera", log_offset=0.03
        )
        images += kalux.reconstruct(source, times=[12_000], settings=chosen, smooth=True)
    np.testing.assert_allclose(images[1].intensity, images[0].intensity, rtol=1e-3)


def test_after_the_last_frame_the_forward_pass_is_alone():
    source = recording(3)
    times = [171_000, 190_000, 199_000]
    smooth = list(kalux.reconstruct(source, times=times, smooth=True))
    forward = list(kalux.reconstruct(source, times=times))
    for one, other in zip(smooth[1:], forward[1:], strict=True):
        np.testing.assert_array_equal(one.intensity, other.intensity)


@pytest.mark.parametrize("events", [0, 5])
def test_a_recording_with_few_events(events):
    source = recording(4, events=events)
    images = list(kalux.reconstruct(source, at="frames", smooth=True))
    assert len(images) == 5
    assert all(np.isfinite(image.intensity).all() for image in images)


def test_smoothing_is_closer_to_the_truth():
    """A dim room with a bright window: the highlights, most of the error, are told from both sides."""
    sensor = SensorSettings(threshold_on=0.2, threshold_off=0.24, noise_rate=1.0, read_noise=0.004)
    simulation = simulate(demo_scene(sensor_size=(60, 80), duration=600_000), sensor, seed=3)
    source = simulation.recording()
    truth = source.ground_truth()
    errors = []
    for smooth in (False, True):
        images = list(kalux.reconstruct(source, times=truth.times, smooth=smooth))
        logs = [
            (np.log(i.intensity + 0.02), np.log(g + 0.02)) for i, g in zip(images, truth.images, strict=True)
        ]
        errors.append(np.mean([(a - b) ** 2 for a, b in logs]))
    assert errors[1] < 0.9 * errors[0]


def test_smoothing_is_closer_to_the_truth_of_a_real_recording(shared_data):
    """Artificial HDR of twenty frames, where the originals are not saturated themselves."""
    whole = kalux.open(shared_data / "slider_depth", exposure=10_000)
    frames = list(whole.frames())[30:50]
    begin, end = frames[0].exposure_start, frames[-1].exposure_end
    events = np.concatenate([e[(e["t"] > begin) & (e["t"] < end)] for e in whole.events()])
    part = Recording.from_arrays(events, frames, sensor_size=whole.sensor_size)
    source = artificial_hdr(part, ArtificialCamera(10 / 255, 90 / 255), saturation=108 / 255)
    truth = source.ground_truth()
    errors = []
    for smooth in (False, True):
        images = kalux.reconstruct(source, times=truth.times, smooth=smooth)
        intensities = np.array([image.intensity for image in images])
        errors.append(np.square(intensities - truth.images)[truth.masks].mean())
    assert errors[1] < 0.9 * errors[0]


def test_thresholds_change_sides():
    settings = PRESETS["default"]
    events = dataclasses.replace(settings.events, threshold_on=0.1, threshold_off=0.3)
    found = reversed_settings(dataclasses.replace(settings, events=events)).events
    assert (found.threshold_on, found.threshold_off) == (0.3, 0.1)


def test_where_one_filter_knows_nothing_the_other_is_taken():
    level, ones = np.array([[1.0]]), np.ones((1, 1))
    forward = Estimate(5, level, ones * 0.01, 0.0, final=True)
    backward = Estimate(-5, level + 3, ones * 1e9, 0.0, final=True)
    assert combine(forward, None) is forward
    found = combine(forward, backward)
    assert found.log_intensity[0, 0] == pytest.approx(1.0, abs=1e-9)
    assert found.t == 5
    assert found.variance[0, 0] == pytest.approx(0.01, rel=1e-9)


def estimates_around(first, second, share=0.5, ends=None, hidden=0.2 * 0.1 * 0.2):
    """Of both directions, P = 0.01 and 0.04, at the share of the way from one frame to the next, with the variances of
    these; ``ends`` is the second's for the forward filter, where that is another. ``hidden``: q_0 of K1."""
    shape = len(first), 1
    first, second, ends = (np.reshape(v, shape) for v in (first, second, second if ends is None else ends))
    ones, level = np.ones(shape), np.zeros(shape)
    return tuple(
        Estimate(
            t, level, p * ones, 0.0, True, around=Around(*frames, ones, 0.0, 0.0, hidden, 1.0, 0.0, 0.0, way)
        )
        for t, p, frames, way in ((5, 0.01, (first, ends), share), (-5, 0.04, (second, first), 1 - share))
    )


def test_what_two_filters_know_adds_up():
    """Information does, and the frame between them is not counted a third time."""
    forward, backward = estimates_around([0.01], [0.01])
    late = dataclasses.replace(backward, since=0.5)
    found = combine(forward, late)
    assert found.signalled_variance[0, 0] == pytest.approx(0.008)
    assert found.around.counted == UNMEASURED
    assert found.since is None
    assert combine(dataclasses.replace(forward, since=0.2), late).since == 0.2


def test_a_frame_is_counted_at_its_middle():
    """Both directions come to it there, and neither has it yet."""
    forward, beside = estimates_around([0.01], [0.02], share=1.0)
    here = dataclasses.replace(beside, around=beside.around._replace(share=1.0))
    assert combine(forward, here).around.counted == 0.0
    assert combine(forward, beside).around.counted == UNMEASURED


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_filters_that_go_by_the_same_frames_err_alike(share):
    """As far as a frame around measures a pixel; of the rest both miss where the light is between two events."""
    clipped = UNMEASURED
    forward, backward = estimates_around(
        [0.01, 0.01, clipped, clipped], [0.02, clipped, 0.02, clipped], share
    )
    found = combine(forward, backward).variance[:, 0]
    errors = 0.8 * 0.1, 0.2 * 0.2  # by weights of 4 to 1
    expected = [
        errors[0] ** 2 + errors[1] ** 2 + 2 * (0.2 + 0.8 * same) * errors[0] * errors[1]
        for same in (1.0, 1 - share, share, 0.0)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize(("threshold", "alike"), [(0.12, 0.12), (0.3, 0.75), (3.0, 1.0)])
def test_filters_that_go_by_events_alone_miss_the_same_between_two_of_them(threshold, alike):
    """Covariance c^2 / 6, the variance of a walk that starts in the middle between two walls, but no more than all."""
    forward, backward = estimates_around([UNMEASURED], [UNMEASURED], hidden=threshold**2 / 6)
    found = combine(forward, backward).variance[0, 0]
    np.testing.assert_allclose(found, 0.08**2 + 0.04**2 + 2 * alike * 0.08 * 0.04, rtol=1e-6)


def test_black_tells_both_filters_the_same():
    """What it hides is the same before and after (K7), but it is not noise, which neighbours could take away."""
    forward, backward = estimates_around([0.01, 2.0], [0.02, 2.0], ends=[0.02, REPEATED])
    found = combine(forward, backward)
    np.testing.assert_allclose(found.signalled_variance[:, 0], [0.008, 0.0144], rtol=1e-6)
    np.testing.assert_allclose(found.variance[:, 0], [0.0144, 0.008], rtol=1e-6)


def test_what_moves_before_or_after_moves_where_its_surroundings_do():
    forward, backward = (
        dataclasses.replace(
            e, moving=np.array(m)[:, None], silent_change=np.array([[0.0], [0.0], [0.1], [0.1]])
        )
        for e, m in zip(
            estimates_around([0.01] * 4, [0.01] * 4),
            ([True, True, True, False], [True, False, False, True]),
            strict=True,
        )
    )
    assert combine(forward, backward, None, 0.04).moving[:, 0].tolist() == [True, False, True, True]


def test_where_one_filter_knows_only_a_bound_it_is_one():
    """Of three pixels the first filter has bounds, the second measured two, one of them below its bound."""
    bounds = unshown([0, 1, 2], 0.4, noise=0.1, shape=(1, 3))
    first = Estimate(5, np.zeros((1, 3)), np.full((1, 3), 1.1), 0.0, True, unshown=bounds)
    seen = unshown([2], 0.1, noise=0.3, shape=(1, 3))
    level, variance = np.array([[0.5, -0.2, 0.0]]), np.array([[1e-3, 0.1, 1.3]])
    found = combine(first, Estimate(-5, level, variance, 0.0, True, unshown=seen))
    np.testing.assert_allclose(found.log_intensity, [[0.5, -0.1, 0.0]], atol=1e-5)
    np.testing.assert_allclose(found.variance[0, :2], [1e-3, 0.1])
    assert found.unshown.pixels.tolist() == [2]
    assert found.unshown.excess[0] == pytest.approx(0.2)  # the mean of the logarithms
    assert found.unshown.doubt[0] == pytest.approx((3 * 0.2) ** 2)


@pytest.mark.parametrize(
    ("change", "message"), [({"lookahead": False}, "causal"), ({"preset": "cf"}, "has no variance")]
)
def test_what_cannot_be_smoothed(change, message):
    with pytest.raises(InputError, match=message):
        list(kalux.reconstruct(recording(), rate_hz=50, smooth=True, **change))


def test_black_hides_as_much_of_two_filters_as_of_one():
    """All black frames together say no more than one (K7): neither the next one nor the other filter tells anything."""
    levels = np.full(SIZE, 120, np.uint8)
    levels[3, 4] = 0
    frames = [Frame(levels, t, t + 5_000) for t in range(0, 400_000, 40_000)]
    events = make_events(np.array([1_000]), np.array([0]), np.array([0]), np.array([True]))
    source = Recording.from_arrays(events, frames, sensor_size=SIZE, contrast_threshold=0.2)
    black = altered(PRESETS["default"], "camera", response="s-curve:0.2", log_offset=0.03, fixed_pattern=0.0)
    shot = take_shot(frames[0], Camera.named("s-curve:0.2", 0.99), 5_000)
    # No pixel is just above black: log I falls off with the largest scale, 2, of which this is the mean square.
    share = (np.arange(1000) + 0.5) / 1000
    middle = np.log(shot.level_ceiling[0] * np.exp(-2) + 0.03)
    hidden = np.square(np.log(shot.level_ceiling[0] * share**2 + 0.03) - middle).mean()
    for smooth in (False, True):
        (image,) = kalux.reconstruct(source, times=[222_500], settings=black, smooth=smooth)
        # P falls from V/3 to V/4 within an interval, and grows by V/12 at the frame.
        assert 0.75 * hidden < image.variance[3, 4] < 1.05 * hidden


def test_what_is_lost_is_unknown_to_both_directions():
    """Where one frame measures a pixel, their errors are the same by half, half-way, and the more the less events told
    (K1, K18)."""
    shape = (1, 2)
    plane = np.full(shape, 0.01, np.float32)
    unmeasured = np.full(shape, UNMEASURED, np.float32)
    lost = np.array([[0.0, 0.3]], np.float32)
    scalars = {"coming": 0.0, "counted": 0.0, "quantisation_variance": 0.007, "repeated": 1.0}
    scalars |= {"wrong": 0.0, "wrong_back": 0.0, "share": 0.5}
    around = Around(plane, unmeasured, plane, **scalars)
    information = np.full(shape, 2.0, np.float32)
    same = smoothing.shared_errors(around, around, information)
    np.testing.assert_allclose(same, 0.014 + (1 - 0.014) / 2, rtol=1e-5)
    known = around._replace(untold=lost + np.float32(0.007), lost=lost)
    same = smoothing.shared_errors(known, known, information)
    np.testing.assert_allclose(same, [[0.014 + (1 - 0.014) / 2, 0.614 + (1 - 0.614) / 2]], rtol=1e-5)
