"""What silent pixels show of the change that no event tells."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from kalux.augmentation.bridge import UNMEASURED, BridgeNoise, Latent, bridge, nominal_thresholds
from kalux.augmentation.subthreshold import (
    Correlation,
    add_missed_change,
    correlation,
    follow_silent,
    half_way,
    nothing_usual,
    silent_change,
    turns,
)

SHAPE = (40, 60)
C2 = 0.04
NOISE = BridgeNoise(0.2, 0.2, 0.2 * C2, C2 / 6)
SECOND = 1_000_000


def joined(change, *, on=None, variance=1e-4, clipped=None):
    """A level that changes by ``change`` between two frames of a variance."""
    nothing = np.zeros(SHAPE, np.float32)
    variances = np.broadcast_to(np.asarray(variance, np.float32), SHAPE).copy()
    second = variances.copy()
    if clipped is not None:
        second[clipped] = UNMEASURED
    on = nothing if on is None else on
    level = np.asarray(np.broadcast_to(change, SHAPE), np.float32)
    segment, _ = bridge(
        Latent(nothing, variances),
        Latent(level, second),
        (on, nothing),
        nominal_thresholds(SHAPE, 0.1, np.float32),
        NOISE,
        0,
        SECOND,
    )
    return segment


def changes(change, **frames):
    """`silent_change` of the same."""
    segment = joined(change, **frames)
    active = np.minimum(segment.events, 1)
    return silent_change(segment, active, NOISE.quantisation_variance, C2)


def scattered(share):
    """(40, 60) events: a ``share`` of the pixels has one."""
    return (np.random.default_rng(0).random(SHAPE) < share).astype(np.float32)


def off_the_mean(*levels, variance=1e-8, on=None):
    """`half_way` between the last two frames that show these levels, by all of them."""
    usual, before = nothing_usual(SHAPE), np.full(SHAPE, np.nan, np.float32)
    for first, second in itertools.pairwise(levels):
        segment = joined(second - first, variance=variance, on=on)
        told, before = correlation(before, segment, NOISE.quantisation_variance, C2)
        usual = usual.with_interval(usual.change, told)
    return half_way(usual.told, C2)


def forgotten(variance, change, on, after=None):
    """What silence adds to P, of frames of a variance."""
    nothing = np.zeros(SHAPE, np.float32)
    frame = Latent(nothing, np.full(SHAPE, variance, np.float32))
    thresholds = nominal_thresholds(SHAPE, 0.1, np.float32)
    segment, _ = bridge(frame, frame, (nothing, nothing), thresholds, NOISE, 0, SECOND)
    grown, plane = nothing.copy(), np.full(SHAPE, change, np.float32)
    second = frame if after is None else Latent(nothing, after)
    add_missed_change(grown, segment, second, (on, nothing), plane, NOISE.quantisation_variance)
    return grown


def test_a_change_that_all_pixels_share():
    """The slope takes nearly all of it: the frames' noise is small."""
    np.testing.assert_allclose(changes(0.05, variance=1e-8), 0.05**2, rtol=1e-4)


def test_noise_is_no_change():
    """What it hides of one is as usual where nothing moves."""
    rng = np.random.default_rng(0)
    sigma = 0.02
    noise = sigma * np.sqrt(2) * rng.standard_normal(SHAPE)
    assert changes(noise, variance=sigma**2).mean() < 0.2 * 2 * sigma**2
    told = (1 + 2 * sigma**2 / NOISE.quantisation_variance) ** -2
    moved = changes(noise + 0.08, variance=sigma**2)
    assert moved.mean() == pytest.approx(told * 0.08**2 + (1 - told) * 0.003 * C2, rel=0.05)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2, 0.5, 0.8])
def test_the_more_pixels_have_events_the_more_the_others_change_that_noise_hides(share):
    """Next to nothing where nothing moves, and the more the more pixels around have events where the image moves."""
    on = scattered(share)
    found = changes(0.0, on=on, variance=100.0)
    moving = min(max(on.mean() / 0.25, 0.1), 1)
    assert found.mean() == pytest.approx((0.03 * moving + 0.62 * on.mean()) * C2, rel=0.06)


def test_what_noise_hides_is_told_by_the_events_around():
    """Of an image of which the lower half moves; the right is dark."""
    on, change, variance = scattered(0.5), np.zeros(SHAPE), np.full(SHAPE, 1e-8)
    on[:20], change[20:], variance[:, 30:] = 0, 0.1, 100.0
    found = changes(change, on=on, variance=variance)
    np.testing.assert_allclose(found[28:, :25], 0.1**2, rtol=1e-4)
    np.testing.assert_allclose(found[:12, :25], 0.0, atol=1e-7)
    assert found[28:, 35:].mean() == pytest.approx(0.34 * C2, rel=0.1)
    np.testing.assert_allclose(found[:12, 35:], 0.03 * C2, rtol=0.03)


def test_it_belongs_to_the_place_where_it_is_seen():
    change = np.zeros(SHAPE)
    change[:, 30:] = 0.1
    found = changes(change, variance=1e-8)
    assert found[:, :28].max() < 1e-7
    np.testing.assert_allclose(found[:, 32:], 0.01, rtol=1e-4)
    np.testing.assert_allclose(found[5:-5, 30], 0.01 * 3 / 5, rtol=1e-4)


def test_pixels_with_events_do_not_count_but_are_told_of_their_neighbours():
    on = np.zeros(SHAPE, np.float32)
    on[20, 30] = 1
    change = np.full(SHAPE, 0.05)
    change[20, 30] = 5.0
    np.testing.assert_allclose(changes(change, on=on, variance=1e-8), 0.05**2, rtol=1e-4)


def test_no_more_than_a_threshold_can_be_hidden():
    np.testing.assert_allclose(changes(3.0, variance=1e-8), C2, rtol=1e-4)


def test_where_no_silent_pixel_is_near_or_a_frame_does_not_measure_it_it_is_as_usual():
    on = np.ones(SHAPE, np.float32)
    np.testing.assert_allclose(changes(0.0, on=on), 0.65 * C2, rtol=1e-5)
    on[10, 10] = 0
    clipped = np.zeros(SHAPE, bool)
    clipped[10, 10] = True
    found = changes(0.0, on=on, clipped=clipped)
    assert found[10, 10] == pytest.approx((0.03 + 0.62 * 80 / 81) * C2, rel=1e-5)
    assert found[0, 0] == pytest.approx(0.65 * C2, rel=1e-5), "at the border those count that there are"
    still = changes(0.0, clipped=clipped)
    assert np.delete(still.ravel(), 10 * SHAPE[1] + 10).max() == 0.0


def test_silent_pixels_follow_the_frames_by_as_much_as_they_change():
    """Of those with events, and where a frame does not measure the pixel, the bridge stays as it is."""
    on = np.zeros(SHAPE, np.float32)
    on[0, 0] = 1
    clipped = np.zeros(SHAPE, bool)
    clipped[0, 1] = True
    segment = joined(0.1, on=on, variance=0.01, clipped=clipped)
    first = Latent(np.zeros(SHAPE, np.float32), np.full(SHAPE, 0.01, np.float32))
    scalars = NOISE.quantisation_variance, C2
    for change in (0.0, 0.002, 0.05):
        followed = follow_silent(segment, first, np.full(SHAPE, change, np.float32), *scalars)
        variance = max(change, 0.003 * C2)
        mismatch = 0.1 / (0.02 + variance)
        np.testing.assert_allclose(followed.slope[1:], variance * mismatch, rtol=1e-4)
        np.testing.assert_allclose(followed.augmented[1:], 0.01 * mismatch, rtol=1e-4)
        np.testing.assert_allclose(followed.untold[1:], variance, rtol=1e-6)
        for plane, before in ((followed.slope, segment.slope), (followed.augmented, segment.augmented)):
            np.testing.assert_array_equal(plane[0, :2], before[0, :2])
        np.testing.assert_allclose(followed.untold[0, :2], NOISE.quantisation_variance, rtol=1e-6)
    assert follow_silent(segment, first, on, 0.0, C2) is segment
    as_before = follow_silent(segment, first, np.full(SHAPE, scalars[0], np.float32), *scalars)
    np.testing.assert_allclose(as_before.slope, segment.slope, rtol=1e-5)


def test_a_silent_pixel_forgets_what_the_slope_does_not_take():
    on = np.zeros(SHAPE, np.float32)
    on[:, 30:] = 1
    assert forgotten(1e-8, 0.01, on).max() < 1e-12  # precise frames: the slope takes all
    noisy = forgotten(100.0, 0.01, on)
    np.testing.assert_allclose(noisy[:, :30], 0.01, rtol=1e-3)
    assert (noisy[:, 30:] == 0).all()
    alike = forgotten(NOISE.quantisation_variance / 2, 0.01, on)  # half of the mismatch is the slope's
    np.testing.assert_allclose(alike[:, :30], 0.01 / 4, rtol=1e-5)
    assert (forgotten(100.0, 0.01, on, np.full(SHAPE, UNMEASURED, np.float32)) == 0).all()


def test_half_way_light_is_off_the_mean_of_its_ends_as_its_changes_turn_back():
    """Straight on not at all, at random by a quarter of its change, and by three where no frame is like the other."""
    one, two, three = 0.05 * np.random.default_rng(3).standard_normal((3, *SHAPE))
    assert off_the_mean(0 * one, one, 2 * one) == pytest.approx(0.0, abs=0.01)
    assert off_the_mean(0 * one, one, one + two) == pytest.approx(0.25, abs=0.03)
    assert off_the_mean(one, two, three) == pytest.approx(0.75, abs=0.05)


def test_noise_of_the_frame_between_does_not_turn_light_back():
    """Unless changes are less than the noise: then they are taken to go at random."""
    rng = np.random.default_rng(4)
    level, *noise = rng.standard_normal((4, *SHAPE))

    def found(change, variance):
        return off_the_mean(*(k * change * level + 0.02 * n for k, n in enumerate(noise)), variance=variance)

    assert found(0.04, 1e-8) > 0.07  # where the frames are believed
    assert found(0.04, 0.02**2) < 0.04
    assert found(0.001, 0.03**2) == pytest.approx(0.25, abs=0.02)


def test_what_is_not_known_to_go_on_goes_at_random():
    one, two = 0.05 * np.random.default_rng(5).standard_normal((2, *SHAPE))
    assert off_the_mean(0 * one, one) == 0.25  # no interval before
    assert off_the_mean(0 * one, one, 2 * one, on=np.ones(SHAPE, np.float32)) == 0.25  # no pixel is silent
    assert off_the_mean(*3 * [two]) == pytest.approx(0.25, abs=1e-3)  # nothing moves


def test_one_interval_that_is_unlike_the_others_does_not_tell_the_next():
    """Light that turns back all the time, but for one pair of intervals in which it went straight on."""
    rng = np.random.default_rng(6)
    shaken = list(0.05 * rng.standard_normal((8, *SHAPE)))
    onward = [*shaken, 2 * shaken[-1] - shaken[-2]]
    assert off_the_mean(*onward[-3:]) == pytest.approx(0.0, abs=0.02)
    assert off_the_mean(*shaken) == pytest.approx(0.75, abs=0.05)
    assert off_the_mean(*onward) > 0.3


def test_what_is_usual_is_the_mean_of_eight_intervals_and_then_forgets():
    usual, nothing = nothing_usual(SHAPE), Correlation(0.0, 0.0, 0.0)
    for number in range(8):
        usual = usual.with_interval(np.full(SHAPE, number, np.float32), nothing)
    np.testing.assert_allclose(usual.change, 3.5, rtol=1e-6)
    told = Correlation(8.0, 16.0, 24.0)
    usual = usual.with_interval(np.full(SHAPE, 11.5, np.float32), told)
    np.testing.assert_allclose(usual.change, 4.5, rtol=1e-6)
    assert usual.told == pytest.approx(
        (1.0, 2.0, 3.0)
    )  # of eight pairs: the first interval had none before it


def test_what_goes_straight_on_changes_as_now_and_what_turns_back_as_lately():
    now, lately = np.full(SHAPE, 0.01, np.float32), np.full(SHAPE, 0.03, np.float32)
    usual = nothing_usual(SHAPE).with_interval(lately, Correlation(0.0, 0.0, 0.0))
    for off, expected in ((0.0, 0.01), (0.125, 0.02), (0.25, 0.03), (0.75, 0.03)):
        np.testing.assert_allclose(usual.mixed(now, off), expected, rtol=1e-5)


def test_light_turns_where_events_of_both_signs_come():
    """Pixels with 3 and 1, 2 and 2, 4 and 0 events of either sign, and one without: six turns in three pixels."""
    on, off = np.array([[3.0, 2.0, 4.0, 0.0]], np.float32), np.array([[1.0, 2.0, 0.0, 0.0]], np.float32)
    assert turns(on, off) == pytest.approx(2.0)
    assert turns(0 * on, 0 * off) == 0


def test_a_pixel_that_a_frame_clips_changes_as_those_around_it():
    """K7 asks by how much it may have risen beyond white."""
    clipped = np.zeros(SHAPE, bool)
    clipped[20, 30] = True
    found = changes(0.05, variance=1e-8, clipped=clipped)
    assert found[20, 30] == pytest.approx(0.05**2, rel=1e-3)
    assert found[20, 30] == pytest.approx(found[5, 5], rel=1e-3)
