"""Two frames joined by events: conservation, its limits, and what it learns of the thresholds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.augmentation.bridge import (
    MASKED,
    UNMEASURED,
    BridgeNoise,
    Latent,
    Thresholds,
    become_measured,
    bridge,
    extend,
    extend_backward,
    nominal_thresholds,
    period_drift,
    raise_to_bound,
    untied_steps,
    wrong_way_back,
)

NOISE = BridgeNoise(threshold_on=0.3, threshold_off=0.2, step_variance=0.012, quantisation_variance=0.01)
START, END = 10_000, 50_000
SECONDS = 0.04


def latent(value, variance):
    value, variance = np.broadcast_arrays(np.asarray(value, float), np.asarray(variance, float))
    return Latent(np.atleast_2d(value).copy(), np.atleast_2d(variance).copy())


def counts(*values):
    return np.atleast_2d(np.array(values, float))


def join(first, second, on, off, thresholds=None, noise=NOISE):
    thresholds = thresholds or nominal_thresholds(first.value.shape, 0.1)
    return bridge(first, second, (on, off), thresholds, noise, START, END)


def reached(segment, on, off):
    """L^A at the end: from the start by all steps and by the slope."""
    seconds = (segment.end - segment.start) * 1e-6
    return segment.augmented + segment.step_on * on - segment.step_off * off + segment.slope * seconds


variances = st.floats(1e-8, 1.0) | st.just(UNMEASURED)


# --- noise ----------------------------------------------------------------------------------------------


def test_events_that_are_all_signal_are_what_they_were():
    first, second, on, off = (
        latent([0.0, -1.0], 0.01),
        latent([0.5, UNMEASURED], 0.02),
        counts(3, 2),
        counts(1, 0),
    )
    sure = np.ones((1, 2))
    plain, learned = join(first, second, on, off)
    told, as_well = bridge(
        first, second, (on, off), nominal_thresholds((1, 2), 0.1), NOISE, START, END, signal=(sure, sure)
    )
    for one, other in zip(
        (*learned, plain.step_on, plain.slope), (*as_well, told.step_on, told.slope), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_events_of_noise_move_nothing():
    """K5: a pixel whose events are noise is joined as a silent one is, and its thresholds stay."""
    first, second, none = latent(0.0, 0.01), latent(0.1, 0.02), np.zeros((1, 1))
    thresholds = nominal_thresholds((1, 1), 0.1)
    noisy, learned = bridge(
        first, second, (counts(2), counts(1)), thresholds, NOISE, START, END, signal=(none, none)
    )
    silent, _ = join(first, second, none, none)
    assert noisy.step_on == noisy.step_off == 0.0
    np.testing.assert_array_equal(noisy.slope, silent.slope)
    np.testing.assert_array_equal(noisy.augmented, silent.augmented)
    assert learned.on == thresholds.on
    assert learned.off == thresholds.off


def test_an_event_in_doubt_takes_what_the_frames_leave_to_it():
    """Its expected step is half a threshold; sure frames that say there was none take nearly all of it back."""
    sure, half = latent(0.0, 1e-9), np.full((1, 1), 0.5)
    noise = BridgeNoise(0.2, 0.2, 0.1 * 0.04, 1e-6)
    thresholds = nominal_thresholds((1, 1), 0.0)
    one, none = counts(1), counts(0)
    told, _ = bridge(sure, sure, (one, none), thresholds, noise, START, END, signal=(half, half))
    free = latent(0.0, UNMEASURED)
    untold, _ = bridge(sure, free, (one, none), thresholds, noise, START, END, signal=(half, half))
    assert untold.step_on[0, 0] == pytest.approx(0.1)
    assert abs(told.step_on[0, 0]) < 1e-4


# --- conservation ---------------------------------------------------------------------------------------


@given(
    values=st.tuples(st.floats(-4, 1), st.floats(-4, 1)),
    spreads=st.tuples(st.floats(1e-8, 1.0), variances),
    on=st.integers(0, 60),
    off=st.integers(0, 60),
    scales=st.tuples(st.floats(0.3, 3.0), st.floats(0.3, 3.0)),
    doubts=st.tuples(st.floats(0.0, 0.3), st.floats(0.0, 0.3)),
    noise=st.tuples(st.floats(0.0, 0.1), st.floats(1e-6, 0.1)),
)
def test_the_mismatch_is_shared_out_to_the_last_bit(values, spreads, on, off, scales, doubts, noise):
    """K1: what frames, thresholds, steps and slope take is the mismatch: L^A ends at the second frame's posterior."""
    first, second = latent(values[0], spreads[0]), latent(values[1], spreads[1])
    on, off = counts(on), counts(off)
    thresholds = Thresholds(*(np.full((1, 1), v) for v in (*scales, *doubts)))
    scalars = BridgeNoise(0.3, 0.2, *noise)
    segment, _ = bridge(first, second, (on, off), thresholds, scalars, START, END)
    gain = (segment.slope * SECONDS) / scalars.quantisation_variance
    np.testing.assert_allclose(segment.augmented, first.value + gain * first.variance, rtol=1e-9, atol=1e-9)
    if spreads[1] < UNMEASURED:
        expected = second.value - gain * second.variance
        np.testing.assert_allclose(reached(segment, on, off), expected, rtol=1e-7, atol=1e-7)


@given(st.floats(-4, 1), st.floats(-4, 1), st.integers(0, 30), st.integers(0, 30))
def test_sure_frames_are_both_hit(a, b, on, off):
    segment, _ = join(latent(a, 1e-14), latent(b, 1e-14), counts(on), counts(off))
    np.testing.assert_allclose(segment.augmented, a, atol=1e-10)
    np.testing.assert_allclose(reached(segment, counts(on), counts(off)), b, atol=1e-10)


def test_posterior_by_hand():
    """Two frames of variance .02 and .03, nothing else uncertain but .01 of quantisation: shares 2, 3 and 1 of 6."""
    noise = BridgeNoise(0.3, 0.2, 0.0, 0.01)
    segment, _ = join(latent(0.0, 0.02), latent(0.6, 0.03), counts(0), counts(0), noise=noise)
    np.testing.assert_allclose(segment.augmented, 0.2, rtol=1e-12)
    np.testing.assert_allclose(segment.slope * SECONDS, 0.1, rtol=1e-12)
    np.testing.assert_allclose(reached(segment, 0, 0), 0.3, rtol=1e-12)


def test_steps_of_dark_pixels_take_the_mismatch_as_if_all_varied_by_so_much():
    first, second = latent([0.0, 0.0], 0.02), latent([0.9, 0.9], 0.03)
    events, known = (counts(2, 2), counts(1, 1)), nominal_thresholds((1, 2), 0.1)
    dark = np.array([[0.0, 0.05]], np.float32)
    found, learned = bridge(first, second, events, known, NOISE, START, END, dark=dark)
    for pixel, more in enumerate(dark[0]):
        noise = NOISE._replace(step_variance=NOISE.step_variance + float(more))
        expected, expected_thresholds = join(first, second, *events, known, noise)
        for name in ("augmented", "slope", "step_on", "step_off"):
            one, other = getattr(found, name)[0, pixel], getattr(expected, name)[0, pixel]
            assert one == pytest.approx(other, rel=1e-12), name
        for one, other in zip(learned, expected_thresholds, strict=True):
            assert one[0, pixel] == pytest.approx(other[0, pixel], rel=1e-12)
    assert found.augmented[0, 1] < found.augmented[0, 0]


def test_the_threshold_takes_the_mismatch_where_it_is_what_is_unknown():
    """Then it is equation (12): four events of 0.3 nominal span 1.6, so each is a step of 0.4."""
    thresholds = nominal_thresholds((1, 1), 10.0)
    noise = BridgeNoise(0.3, 0.2, 1e-12, 1e-12)
    segment, learned = join(latent(0.0, 1e-9), latent(1.6, 1e-9), counts(4), counts(0), thresholds, noise)
    np.testing.assert_allclose(segment.step_on, 0.4, rtol=1e-6)
    np.testing.assert_allclose(learned.on, 0.4 / 0.3, rtol=1e-6)
    np.testing.assert_allclose(segment.slope, 0.0, atol=1e-6)


def test_on_and_off_thresholds_move_in_opposite_directions():
    """The pixel got brighter than its events tell: on steps were larger, off steps smaller."""
    segment, learned = join(latent(0.0, 1e-6), latent(0.9, 1e-6), counts(3), counts(3))
    assert segment.step_on > NOISE.threshold_on
    assert segment.step_off < NOISE.threshold_off
    assert learned.on > 1 > learned.off


# --- limits ---------------------------------------------------------------------------------------------


def test_a_silent_pixel_is_a_straight_line():
    segment, learned = join(latent(-1.0, 1e-14), latent(-0.8, 1e-14), counts(0), counts(0))
    np.testing.assert_allclose(segment.augmented, -1.0, atol=1e-10)
    np.testing.assert_allclose(segment.slope, 0.2 / SECONDS, rtol=1e-9)
    np.testing.assert_allclose([learned.on, learned.off], 1.0, rtol=1e-12)


@pytest.mark.parametrize("clipped", ["first", "second", "both"])
def test_a_clipped_end_leaves_the_steps_alone(clipped):
    """Where events lead above its bound."""
    on, off = counts(5), counts(2)
    first = latent(-3.0 if clipped == "first" else 0.5, UNMEASURED if clipped != "second" else 1e-4)
    second = latent(-1.0, UNMEASURED if clipped != "first" else 1e-4)
    segment, learned = join(first, second, on, off)
    np.testing.assert_allclose(segment.step_on, 0.3, rtol=1e-9)
    np.testing.assert_allclose(segment.step_off, 0.2, rtol=1e-9)
    np.testing.assert_allclose(segment.slope, 0.0, atol=1e-9)
    np.testing.assert_allclose([learned.on, learned.off], 1.0, rtol=1e-9)
    if clipped == "first":  # back from the end: -1.0 - (5 x 0.3 - 2 x 0.2)
        np.testing.assert_allclose(segment.augmented, -2.1, rtol=1e-3)
    elif clipped == "second":
        np.testing.assert_allclose(segment.augmented, 0.5, rtol=1e-9)


@pytest.mark.parametrize("on", [0, 3])
def test_a_bound_that_events_lead_below_is_reached(on):
    """From the frame that measures the pixel, and back from it: by the slope, and by the events, which are too small.

    But thresholds are not learned of a bound.
    """
    rising, falling = counts(on), counts(0)
    segment, learned = join(latent(-1.5, 1e-9), latent(0.0, UNMEASURED), rising, falling)
    np.testing.assert_allclose(segment.augmented, -1.5, atol=1e-6)
    np.testing.assert_allclose(reached(segment, rising, falling), 0.0, atol=1e-6)
    np.testing.assert_allclose([learned.on, learned.off], 1.0, rtol=1e-12)
    assert (segment.slope > 0).all()
    assert on == 0 or (segment.step_on > NOISE.threshold_on).all()
    back, learned = join(latent(0.0, UNMEASURED), latent(-1.5, 1e-9), falling, rising)
    np.testing.assert_allclose(back.augmented, 0.0, atol=1e-6)
    np.testing.assert_allclose(reached(back, falling, rising), -1.5, atol=1e-6)
    np.testing.assert_allclose([learned.on, learned.off], 1.0, rtol=1e-12)


def test_a_masked_pixel_is_no_bound():
    segment, _ = join(latent(-1.0, 1e-9), latent(0.0, MASKED), counts(0), counts(0))
    np.testing.assert_allclose(reached(segment, 0.0, 0.0), -1.0, atol=1e-6)


@given(value=st.floats(-3.0, 3.0), on=st.integers(0, 20), off=st.integers(0, 20), is_first=st.booleans())
def test_a_bridge_keeps_to_the_bound_of_a_clipped_end(value, on, off, is_first):
    ends = latent(0.0, UNMEASURED), latent(value, 1e-6)
    first, second = ends if is_first else ends[::-1]
    rising, falling = counts(on), counts(off)
    segment, _ = join(first, second, rising, falling)
    clipped = segment.augmented if is_first else reached(segment, rising, falling)
    assert (clipped >= -1e-5).all()


def test_information_goes_from_one_end_to_the_other():
    """Each event moves its variance; all events together leave what the frame at the other end has."""
    segment, _ = join(latent(0.0, 0.02), latent(0.1, 0.03), counts(4), counts(3))
    assert (segment.start, segment.end) == (START, END)
    np.testing.assert_allclose(segment.forward_variance, 0.02, rtol=1e-12)
    np.testing.assert_allclose(segment.backward_variance, 0.03, rtol=1e-12)
    np.testing.assert_array_equal(segment.events, 7)
    assert segment.step_variance == NOISE.step_variance
    np.testing.assert_allclose(segment.rate * SECONDS, 0.5, rtol=1e-12)


def test_wrong_thresholds_count_on_the_way_back_that_no_frame_ties():
    """A tenth of what K10 makes of as many events, per squared event; noise among these moves nothing."""
    first = latent([0.0, 0.0, 0.0, 0.0, 0.0], [UNMEASURED, UNMEASURED, 0.01, UNMEASURED, MASKED])
    second = latent(np.ones(5), [0.02, UNMEASURED, 0.02, 0.02, 0.02])
    on, off = counts(3, 3, 3, 0, 0), counts(1, 1, 1, 0, 2)
    thresholds = nominal_thresholds((1, 5), 0.1)
    pixels = become_measured(first, second, on + off)
    found = wrong_way_back(pixels, thresholds, NOISE, (0.5 * on, off), on + off)
    of_both = 0.1 * 0.1**2 * ((0.3 * 1.5) ** 2 + 0.2**2) / 4**2
    np.testing.assert_allclose(found, [[of_both, 0, 0, 0, 0.1 * 0.1**2 * 0.2**2]], rtol=1e-12)
    assert (
        wrong_way_back(become_measured(second, second, on + off), thresholds, NOISE, (on, off), on + off)
        is None
    )


def test_every_event_adds_its_share_of_what_wrong_thresholds_add_until_a_frame_measures_the_pixel():
    """v c^2 ((N + n)^2 - N^2) over the n events that come, as far as they are signal; the same of the period."""
    first = latent([0.0, 0.0, 0.0, 0.0, 0.0], [UNMEASURED, UNMEASURED, 0.01, UNMEASURED, MASKED])
    second = latent(np.ones(5), [0.02, UNMEASURED, 0.02, 0.02, 0.02])
    on, off = counts(4, 3, 3, 0, 0), counts(1, 1, 1, 0, 2)
    far_on, far_off = counts(3, 3, 0, 3, 0), counts(2, 2, 0, 2, 0)
    thresholds = nominal_thresholds((1, 5), 0.1)

    pixels = become_measured(first, second, on + off)

    def untied(by_period=(None, None), signal=None):
        far = far_on, far_off, by_period[0]
        return untied_steps(pixels, thresholds, NOISE, far, (on, off), signal, by_period[1])

    found = untied()
    np.testing.assert_array_equal(found.pixels, [0, 4])
    per_on, per_off = (0.1 * 0.3) ** 2, (0.1 * 0.2) ** 2
    assert found.on[0] * 4 == pytest.approx(per_on * (7**2 - 3**2))
    assert found.off[0] * 1 == pytest.approx(per_off * (3**2 - 2**2))
    assert found.off[1] * 2 == pytest.approx(per_off * 2**2)
    half = untied(signal=(np.full((1, 5), 0.5), np.ones((1, 5))))
    assert half.on[0] * 4 == pytest.approx(per_on * (5**2 - 3**2))
    np.testing.assert_array_equal(half.off, found.off)
    doubted = untied(by_period=(np.full((1, 5), 0.1), np.full((1, 5), 0.2)))
    np.testing.assert_allclose(doubted.on[0] - found.on[0], (0.3**2 - 0.1**2) / 5, rtol=1e-5)
    np.testing.assert_allclose(doubted.off[1] - found.off[1], (0.3**2 - 0.1**2) / 2, rtol=1e-5)
    back = untied(by_period=(np.full((1, 5), 0.5), np.full((1, 5), -0.5)))
    assert back.on[0] == 0, "what it takes off leaves at least nothing"
    pixels = become_measured(second, second, on + off)
    assert untied() is None


def test_what_a_wrong_refractory_period_adds_on_the_way_up_it_takes_off_on_the_way_down():
    """Of pixels that no frame measures; others begin anew."""
    frames = [latent([[0.0, 0.0, 0.0]], [[UNMEASURED, MASKED, 0.01]]) for _ in range(3)]
    far, variance = np.zeros((1, 3), np.float32), np.zeros((1, 3), np.float32)
    seen = []
    for frame, step in zip(frames, (0.5, 0.25, -0.75), strict=True):
        grown, far = period_drift(frame, far, np.full((1, 3), step, np.float32))
        variance += grown
        seen.append(variance.copy())
    np.testing.assert_allclose(np.concatenate(seen), [[0.25, 0.25, 0], [0.5625, 0.5625, 0], [0, 0, 0]])


def test_extend_holds_one_frame():
    frame, thresholds = latent([0.1, -2.0], [0.02, UNMEASURED]), nominal_thresholds((1, 2), 0.1)
    segment = extend(frame, thresholds, NOISE, START, END, SECONDS, frame)
    assert segment.bound is frame
    np.testing.assert_array_equal(segment.augmented, frame.value)
    np.testing.assert_array_equal(segment.forward_variance, frame.variance)
    assert (segment.slope == 0).all()
    assert (segment.backward_variance >= UNMEASURED).all()
    np.testing.assert_allclose((segment.step_on, segment.step_off), ([[0.3, 0.3]], [[0.2, 0.2]]))
    assert segment.rate == 1 / SECONDS


def test_extend_backward_arrives_at_the_frame():
    on, off = counts(2, 0), counts(1, 0)
    frame, thresholds = latent([0.1, -2.0], [0.02, 0.03]), nominal_thresholds((1, 2), 0.1)
    segment = extend_backward(frame, on, off, thresholds, NOISE, START, END)
    np.testing.assert_allclose(reached(segment, on, off), frame.value, rtol=1e-12)
    np.testing.assert_allclose(segment.augmented, [[0.1 - 0.4, -2.0]], rtol=1e-12)
    np.testing.assert_array_equal(segment.backward_variance, frame.variance)
    np.testing.assert_array_equal(segment.events, [[3, 0]])
    assert (segment.forward_variance >= UNMEASURED).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_only_what_is_clipped_is_a_bound(dtype):
    """K7: up to it, never down, and a measured pixel says nothing of the kind. The first is just short of clipped."""
    frame = Latent(*np.array([[[0.5, 0.5, 0.5, 0.5]], [[1e11, UNMEASURED, UNMEASURED, 0.1]]], dtype))
    level = np.array([[0.0, 0.0, 2.0, 0.0]], dtype)
    raise_to_bound(level, frame)
    np.testing.assert_array_equal(level, np.array([[0.0, 0.5, 2.0, 0.0]], dtype))


def test_float32_frames_make_a_float32_segment():
    """Of the same numbers, to its rounding: the arithmetic is float64 either way."""
    rng = np.random.default_rng(2)
    shape = (5, 6)
    frames = [Latent(rng.normal(size=shape), rng.uniform(1e-4, 0.1, shape)) for _ in range(2)]
    on, off = rng.integers(0, 9, (2, *shape)).astype(float)
    wide = join(*frames, on, off)
    narrow = join(
        *(Latent(*(part.astype(np.float32) for part in frame[:2])) for frame in frames),
        on.astype(np.float32),
        off.astype(np.float32),
        nominal_thresholds(shape, 0.1, np.float32),
    )
    for a, b in zip(wide, narrow, strict=True):
        for name, values in a._asdict().items():
            if isinstance(values, np.ndarray):
                assert getattr(b, name).dtype == np.float32
                np.testing.assert_allclose(getattr(b, name), values, rtol=2e-6, atol=2e-6, err_msg=name)


# --- learning -------------------------------------------------------------------------------------------


@given(
    mismatch=st.floats(-3, 3),
    spread=variances,
    on=st.integers(0, 200),
    off=st.integers(0, 200),
    before=st.floats(1e-6, 0.2),
)
def test_variances_stay_positive_and_never_grow_but_by_drift(mismatch, spread, on, off, before):
    thresholds = Thresholds(np.ones((1, 1)), np.ones((1, 1)), counts(before), counts(before))
    _, learned = join(latent(0.0, 1e-4), latent(mismatch, spread), counts(on), counts(off), thresholds)
    for after, count in ((learned.on_variance, on), (learned.off_variance, off)):
        assert 0 < after <= before + 1.001e-5
        if count >= 5 and spread < 0.01 and before > 0.01 and on + off == count:
            assert after < before
    assert 0.3 <= learned.on <= 3.0
    assert 0.3 <= learned.off <= 3.0


def test_thresholds_of_the_pixels_are_learned():
    """Thirty intervals of a pixel population with a spread of 10 %, frames noisy: the errors fall to less than half."""
    rng = np.random.default_rng(0)
    shape = (40, 50)
    true_on, true_off = 1 + 0.1 * rng.standard_normal((2, *shape))
    noise = BridgeNoise(0.3, 0.2, 0.0, 0.3 * 0.2 / 6)
    thresholds = nominal_thresholds(shape, 0.1)
    level = np.zeros(shape)
    spreads = [thresholds.on_variance.mean()]
    for _ in range(30):
        on, off = rng.integers(0, 8, (2, *shape)).astype(float)
        change = 0.3 * true_on * on - 0.2 * true_off * off
        change *= change**2 / (change**2 + 2.4 * noise.quantisation_variance)  # what frames show of it
        unseen = np.sqrt(noise.quantisation_variance) * rng.standard_normal(shape)
        seen = latent(level, 1e-4), latent(level + change + unseen, 1e-4)
        _, thresholds = bridge(*seen, (on, off), thresholds, noise, START, END)
        spreads.append(thresholds.on_variance.mean())
    assert np.abs(thresholds.on - true_on).mean() < np.abs(1 - true_on).mean() / 2.5
    assert np.abs(thresholds.off - true_off).mean() < np.abs(1 - true_off).mean() / 2.5
    assert (np.diff(spreads) < 0).all()


def test_learned_thresholds_are_right_on_average_where_small_changes_are_the_most_frequent():
    """What has one event has mostly changed by less than a threshold, for which no pixel's threshold is to blame."""
    rng = np.random.default_rng(5)
    shape = (60, 60)
    true = 1 + 0.1 * rng.standard_normal(shape)
    noise = BridgeNoise(0.2, 0.2, 0.0, 0.2**2 / 6)
    thresholds, frame = nominal_thresholds(shape, 0.1), latent(np.zeros(shape), 1e-4)
    for _ in range(30):
        change = rng.pareto(1.5, shape) * rng.choice([-1, 1], shape)  # thresholds
        net = np.rint(change + np.sqrt(1 / 6) * rng.standard_normal(shape))
        seen = latent(0.2 * true * change, 1e-4)
        events = np.maximum(net, 0.0), np.maximum(-net, 0.0)
        _, thresholds = bridge(frame, seen, events, thresholds, noise, START, END)
    for learned in (thresholds.on, thresholds.off):
        assert abs(learned.mean() - true.mean()) < 0.01
        assert np.abs(learned - true).mean() < 0.6 * np.abs(1 - true).mean()


def test_the_learned_variance_tells_the_error():
    """The posterior is calibrated: errors over their standard deviation have a variance of about 1."""
    rng = np.random.default_rng(1)
    shape = (60, 60)
    true_on = 1 + 0.1 * rng.standard_normal(shape)
    noise = BridgeNoise(0.3, 0.2, 0.005, 0.01)
    thresholds, none = nominal_thresholds(shape, 0.1), np.zeros(shape)
    for _ in range(10):
        on = rng.integers(1, 6, shape).astype(float)
        error = np.sqrt(2 * 1e-3 + 0.005 * on + 0.01) * rng.standard_normal(shape)
        second = latent(0.3 * true_on * on + error, 1e-3)
        _, thresholds = bridge(latent(none, 1e-3), second, (on, none), thresholds, noise, START, END)
    z2 = (thresholds.on - true_on) ** 2 / thresholds.on_variance
    assert 0.85 < z2.mean() < 1.15


def test_thresholds_of_saturated_pixels_let_their_events_cancel():
    """A pixel that goes up and down above white for ten frames: its events bring it back after they are learned."""
    saturated, none = latent(0.0, UNMEASURED), nominal_thresholds((1, 1), 0.1)
    noise = NOISE._replace(saturated_variance=8.0)
    on, off = counts(40.0), counts(66.0)  # 12 and 13.2 of nominal thresholds
    thresholds, drifts = none, []
    for _ in range(10):
        segment, thresholds = join(saturated, saturated, on, off, thresholds, noise)
        drifts.append(abs(float((segment.step_on * on - segment.step_off * off)[0, 0])))
        assert segment.augmented[0, 0] == 0.0
    assert drifts[0] < 1.2
    assert drifts[-1] < 0.4
    # One frame that says nothing of the pixel, or a prior that is turned off, teach nothing.
    masked = latent(0.0, MASKED)
    for first, second, chosen in (
        (masked, saturated, noise),
        (saturated, masked, noise),
        (saturated,) * 2 + (NOISE,),
    ):
        _, learned = join(first, second, on, off, none, chosen)
        assert learned.on[0, 0] == pytest.approx(1.0, abs=1e-6)
