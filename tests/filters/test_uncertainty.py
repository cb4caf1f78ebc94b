"""The variance that an image is given."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.augmentation.bridge import REPEATED, UNMEASURED, bridge_variance
from kalux.filters.readout import CORRELATED, Subthreshold
from kalux.filters.uncertainty import (
    BEFORE_AVERAGING,
    CORRELATED_UNMEASURED,
    SUBTHRESHOLD_MOVING,
    UNMEASURED_SHARE,
    Around,
    add_blurred,
    add_dark_doubt,
    add_lag,
    add_pattern,
    before_averaging,
    changed_within,
    given_variance,
    keep_rounding,
    known_variance,
    subthreshold_variance,
)
from kalux.models.dark_levels import DarkDoubt

C2 = 0.04
STILL = np.zeros((1, 2), bool)
NO_CHANGE = np.zeros((1, 2), np.float32)
NOTHING = Subthreshold(0.0, 0.0)
variances = st.floats(1e-5, 1.0)


def plane(value):
    return np.full((1, 2), value, np.float32)


def around(first=UNMEASURED, second=UNMEASURED, events=0.0, **changes):
    scalars = {"coming": 0.0, "counted": 0.0, "quantisation_variance": C2 / 6, "repeated": 1.0}
    scalars |= {"wrong": 0.0, "wrong_back": 0.0, "share": 0.5}
    return Around(plane(first), plane(second), plane(events), **{**scalars, **changes})


def test_without_frames_and_events_p_is_given():
    p = np.array([[0.01, 3.0]], np.float32)
    np.testing.assert_array_equal(given_variance(p, STILL, NO_CHANGE, NOTHING, None), p)
    np.testing.assert_allclose(given_variance(p, STILL, NO_CHANGE, NOTHING, around()), p, rtol=1e-6)


@pytest.mark.parametrize(("exposed", "turns"), [(0.2, 8.0), (0.7, 1.0), (0.5, 0.05)])
def test_what_an_exposure_hides_of_light_that_turns(exposed, turns):
    """By the covariances of its samples: 12 times how far the mean is off the middle, over the change of frames."""
    t = (np.arange(2001) / 2000 - 0.5) * exposed
    to_middle, to_all = np.exp(-turns * np.abs(t)), np.exp(-turns * np.abs(t[:, None] - t))
    off = 1.0 + to_all.mean() - 2.0 * to_middle.mean()
    expected = 12.0 * off / (2.0 * (1.0 - np.exp(-turns)))
    assert changed_within(exposed, turns) == pytest.approx(expected, rel=5e-3)


def test_light_that_does_not_turn_is_a_random_walk():
    assert changed_within(0.3, 0.0) == 0.3
    assert changed_within(0.3, 0.04) == pytest.approx(0.3, rel=0.03)
    assert changed_within(0.0, 5.0) == 0.0


def test_what_exposures_hide_counts_at_frames_for_what_they_measure():
    """With as much as silent pixels change, or usually do where there are events, and the square of the exposure."""
    change = np.array([[0.0, 0.01, 0.02, 0.02, 0.02]], np.float32)
    first = np.array([[0.1, 0.1, UNMEASURED, 0.1, UNMEASURED]], np.float32)
    second = np.array([[0.1, 0.1, 0.1, 0.1, UNMEASURED]], np.float32)
    events = np.array([[0.0, 0.0, 0.0, 3.0, 0.0]], np.float32)
    full = np.array([[0.0, 0.01, 0.02, 0.1 * C2, 0.0]])
    for share, counts in ((0.0, 1.0), (0.25, 0.25), (0.5, 0.0), (1.0, 1.0)):
        told = around()._replace(first=first, second=second, events=events, share=share)
        for exposed in (0.0, 0.5, 1.2):
            variance = np.full((1, 5), 0.5, np.float32)
            add_blurred(variance, change, told, exposed, C2)
            np.testing.assert_allclose(variance - 0.5, 0.06 * exposed**2 * counts * full, atol=1e-7)


def test_offsets_of_pixels_count_as_the_light_they_are_beside():
    variance = np.array([[0.25, 0.5]], np.float32)
    add_pattern(variance, np.array([[0.0, 0.3]], np.float32), 0.1, 0.02)
    np.testing.assert_allclose(variance, [[0.25 + 0.2**2, 0.5 + 0.05**2]], rtol=1e-5)


def test_rounding_that_frames_share_bounds_the_variance_of_still_pixels():
    """A half of that of one frame, beside I + I_0 of 0.1 and 0.4."""
    variance = np.array([[1e-4, 1e-4, 1e-4, 0.5]], np.float32)
    intensity = np.array([[0.0, 0.3, 0.0, 0.0]], np.float32)
    keep_rounding(variance, intensity, np.array([[False, False, True, False]]), 0.1, 0.02)
    np.testing.assert_allclose(variance, [[0.2**2 / 2, 0.05**2 / 2, 1e-4, 0.5]], rtol=1e-5)


def test_what_noise_hides_below_black_is_doubted_by_the_intensity():
    """Between those at which it is told it is interpolated, and none beyond the last."""
    variance = np.full((1, 5), 0.5, np.float32)
    intensity = np.array([[0.0, 0.005, 0.01, 0.02, 3.0]], np.float32)
    add_dark_doubt(variance, intensity, DarkDoubt(0.01, np.array([0.4, 0.2, 0.0], np.float32)))
    np.testing.assert_allclose(variance, [[0.9, 0.8, 0.7, 0.5, 0.5]], rtol=1e-6)


def test_slow_pixels_are_off_between_frames_and_more_so_in_the_dark():
    """Half-way by 1.5 times the variance at 0.02 of white, an eighth of that at four times it, 8 times in black."""
    variance, intensity = np.zeros((1, 3), np.float32), np.float32([[0.02, 0.08, 0.0]])

    def added(share, **frames):
        given = np.zeros_like(variance)
        planes = {name: np.full_like(variance, value) for name, value in frames.items()}
        add_lag(given, intensity, around()._replace(share=share, **planes), 0.1)
        return given

    known = {"first": 0.1, "second": UNMEASURED, "events": 2.0}
    np.testing.assert_allclose(added(0.5, **known), [[0.15, 0.15 / 8, 1.2]], rtol=1e-6)
    np.testing.assert_allclose(added(0.25, **known), 0.75 * added(0.5, **known), rtol=1e-6)
    for share, frames in (
        (0.0, known),
        (1.0, known),
        (0.5, {**known, "events": 0.0}),
        (0.5, {**known, "first": UNMEASURED}),
    ):
        assert (added(share, **frames) == 0).all()


@given(variances, variances, st.floats(0.0, 30.0), st.floats(0.0, 0.1), st.floats(0.0, 0.1))
def test_the_next_frame_tells_of_the_image_before_it(p, second, events, coming, wrong):
    """As much as it knows, and as the events between are sure, all together where no frame ties them before (K4); not
    where it is counted already."""
    for first, all_wrong in ((UNMEASURED, wrong), (1e9, 0.0)):
        pixel = np.float32([p, first, second, events])
        found = known_variance(*pixel, C2 / 6, 0.0, (coming, 0.0, 1.0, 0.0, wrong, 0.0, 0.0))
        behind = second + coming * events + all_wrong * events**2
        assert 1 / found == pytest.approx(1 / p + 1 / behind, rel=1e-4)
        counted = known_variance(*pixel, C2 / 6, 0.0, (coming, UNMEASURED, 1.0, 0.0, wrong, 0.0, 0.0))
        assert counted == pytest.approx(p, rel=1e-6)


@given(variances, variances, st.floats(0.01, 1.0), st.floats(0.0, 1.0))
def test_what_is_lost_is_told_by_the_next_frame_alone(p, second, lost, share):
    """That knows less of what came before it, and half-way a quarter of the lost change is not known (K18)."""
    frames = around(0.1, second, coming=0.0)._replace(share=share, untold=plane(lost), lost=plane(lost))
    found = given_variance(plane(p), STILL, NO_CHANGE, NOTHING, frames)[0, 0]
    behind = second + (1 - share) * lost
    common = (lost / (0.1 + second + lost)) ** 2 * min(0.1, second)
    known = max(p * behind / (p + behind), common)
    assert found == pytest.approx(known + share * (1 - share) * lost, rel=1e-4)


def test_noise_that_the_slope_follows_is_in_every_image():
    """However many frames have been seen: with precise frames all of it, with noisy ones next to nothing."""
    p = plane(1e-9)
    precise, noisy = (
        given_variance(p, STILL, NO_CHANGE, NOTHING, around(v, v, counted=UNMEASURED))[0, 0]
        for v in (1e-5, 1.0)
    )
    assert precise == pytest.approx(1e-5, rel=0.02)
    assert noisy < 1e-4
    still = around(1e-3, 1e-3, counted=UNMEASURED)._replace(
        untold=plane(1e-5)
    )  # changes little: follows little
    followed = given_variance(p, STILL, NO_CHANGE, NOTHING, still)[0, 0]
    assert followed == pytest.approx(1e-3 * (1e-5 / (2e-3 + 1e-5)) ** 2, rel=0.02)
    half = given_variance(p, STILL, NO_CHANGE, NOTHING, around(1e-5, 1e-5, counted=UNMEASURED, repeated=0.5))
    assert half[0, 0] == pytest.approx(precise / 2, rel=1e-5)


def test_steps_that_are_wrong_alike_add_up():
    one, ten = (
        given_variance(plane(0.01), STILL, NO_CHANGE, NOTHING, around(events=n, wrong=1e-4))[0, 0] - 0.01
        for n in (1.0, 10.0)
    )
    assert ten == pytest.approx(100 * one, rel=1e-3)
    assert one == pytest.approx(1e-4, rel=1e-3)


def test_more_is_hidden_between_frames_in_long_exposures_and_where_things_move():
    moving = np.array([[True, False]])
    change = plane(0.1 * C2)

    def subthreshold(between, threshold2=C2, exposed=0.0):
        given = subthreshold_variance(between, threshold2, exposed)
        return given_variance(plane(0.0), moving, change * threshold2 / C2, given, None)

    assert (subthreshold(0.0) == 0).all()
    assert (subthreshold(1.0) > subthreshold(0.5)).all()
    assert subthreshold(1.0)[0, 0] > subthreshold(1.0)[0, 1] > 0
    assert (subthreshold(0.0, exposed=0.5) > 0).all()
    np.testing.assert_array_equal(subthreshold(1.0, exposed=0.5), subthreshold(1.0))
    np.testing.assert_allclose(subthreshold(1.0, 4 * C2), 4 * subthreshold(1.0), rtol=1e-5)


def test_still_pixels_hide_what_silent_ones_around_them_show():
    change = np.array([[0.0, 0.02]], np.float32)
    for half_way in (0.0, 0.25, 0.7):
        subthreshold = subthreshold_variance(1.0, C2, half_way=half_way)
        found = given_variance(plane(0.01), STILL, change, subthreshold, None) - 0.01
        np.testing.assert_allclose(found, [[0.0, half_way * 0.02]], atol=1e-8)


def test_a_pixel_that_waits_for_its_next_event_lies_between_still_and_moving_ones():
    """One with an event of late, none in this interval; or silent, and measured by one of the frames alone."""
    moving, change, p = np.array([[True, False]]), plane(0.02), plane(0.01)
    subthreshold = Subthreshold(0.5, 0.004, 0.004)

    def found(first, second, events):
        told = around(first, second, events, counted=UNMEASURED, quantisation_variance=0.0, half_way=0.5)
        return given_variance(p, moving, change, subthreshold, told) - p

    waits = 0.5 * 0.5 * 0.02 + 0.25 * 0.004
    np.testing.assert_allclose(found(1e-6, 1e-6, 0.0), [[waits, 0.01]], rtol=1e-4)
    np.testing.assert_allclose(found(1e-6, 1e-6, 1.0), [[0.004, 0.01]], rtol=1e-4)
    np.testing.assert_allclose(found(UNMEASURED, 1e-6, 0.0), [[waits, waits]], rtol=1e-4)
    np.testing.assert_allclose(found(UNMEASURED, UNMEASURED, 0.0), [[0.004, 0.01]], rtol=1e-4)


@pytest.mark.parametrize(
    ("share", "of_first"), [(1e-6, 0.0), (0.25, 0.625), (0.75, 1.125), (1 - 1e-6, 1.0), (1.0, 0.0)]
)
def test_nothing_ties_a_pixel_at_a_frame_that_does_not_measure_it(share, of_first):
    """Its variance grows from the other frame on, until P itself does at the end of the interval."""
    change, p = plane(0.02), plane(0.01)
    subthreshold = subthreshold_variance(bridge_variance(share), C2, half_way=0.5)
    waits = 0.5 * 0.5 * 0.02 + 0.25 * SUBTHRESHOLD_MOVING * C2

    def found(first, second, share):
        told = around(first, second, 0.0, counted=UNMEASURED, share=share, half_way=0.5)
        return given_variance(p, STILL, change, subthreshold, told) - p

    np.testing.assert_allclose(found(1e-6, UNMEASURED, share), of_first * waits, rtol=1e-3, atol=1e-7)
    if share < 1:
        np.testing.assert_allclose(found(UNMEASURED, 1e-6, 1 - share), of_first * waits, rtol=1e-3, atol=1e-7)


def test_without_a_next_frame_nothing_holds_the_other_end():
    """Of a change that goes on from the frame, at most all."""
    silent = [subthreshold_variance(1.0, C2, 0.0, since).silent for since in (0.0, 0.5, 1.0, 8.0)]
    assert silent == [0.0, 0.5, 1.0, 1.0]


@pytest.mark.parametrize("between", [0.0, 0.5, 1.0])
def test_what_neither_frame_measures_hides_as_much_at_a_frame_as_half_way(between):
    """Nothing ties it there; one that a frame measures is tied."""
    subthreshold, moving = subthreshold_variance(between, C2), np.ones((1, 2), np.bool_)
    left = plane(0.2 + before_averaging(subthreshold).untied)  # no neighbour tells anything

    def hidden(first):
        told = around(first, first, 1.0, counted=UNMEASURED)
        known = 0.2 if first < UNMEASURED else UNMEASURED_SHARE * 0.2
        return given_variance(plane(0.2), moving, NO_CHANGE, subthreshold, told, left) - known

    np.testing.assert_allclose(hidden(UNMEASURED), 0.09 * C2, rtol=1e-3)
    np.testing.assert_allclose(hidden(1e-6), 0.09 * C2 * between, rtol=1e-3, atol=1e-7)


def test_what_no_frame_ties_hides_more_in_long_exposures_of_light_that_turns():
    """As much as other pixels where these hide more: that is what averaging began with."""
    subthreshold, moving = subthreshold_variance(0.0, C2, 3.0), np.ones((1, 2), np.bool_)
    assert subthreshold.moving > subthreshold.untied
    before = before_averaging(subthreshold)
    left = plane(0.2 + max(before.untied, before.moving))  # no neighbour tells anything
    told = around(UNMEASURED, UNMEASURED, 1.0, counted=UNMEASURED)
    given = given_variance(plane(0.2), moving, NO_CHANGE, subthreshold, told, left)
    np.testing.assert_allclose(given, UNMEASURED_SHARE * 0.2 + subthreshold.moving, rtol=1e-4)


def test_averaging_takes_a_part_of_it():
    assert before_averaging(Subthreshold(0.1, 0.2, 0.3)) == pytest.approx(
        (0.1 * BEFORE_AVERAGING, 0.2 * BEFORE_AVERAGING, 0.3 * BEFORE_AVERAGING)
    )


def test_what_neighbours_take_of_a_pixel_that_neither_frame_measures_is_not_given():
    """Errors of neighbours are less alike than highlights are doubted by."""
    p, mean = 0.2, 0.05  # of neighbours and pixel together
    left = plane(CORRELATED * p + (1 - CORRELATED) * mean)
    averaged = given_variance(plane(p), STILL, NO_CHANGE, NOTHING, around(), left)
    kept = CORRELATED_UNMEASURED * p + (1 - CORRELATED_UNMEASURED) * mean
    np.testing.assert_allclose(averaged, UNMEASURED_SHARE * kept, rtol=1e-5)
    for frames in ((0.01, UNMEASURED), (UNMEASURED, 0.01)):
        measured = around(*frames, counted=UNMEASURED)
        np.testing.assert_allclose(
            given_variance(plane(p), STILL, NO_CHANGE, NOTHING, measured, left), p, rtol=1e-5
        )
    for second, missed in ((UNMEASURED, True), (REPEATED, False)):
        assert around(second=second).misses_some(np.arange(2)) is missed
    assert not around().misses_some(np.arange(0))
