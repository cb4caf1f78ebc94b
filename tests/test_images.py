"""From an estimate to an image: what is believed of highlights, what stands in for a variance, and colours."""

import dataclasses

import numpy as np
import pytest

from kalux.filters.uncertainty import Around
from kalux.images import Estimate, View, make_image
from kalux.models.camera import Response
from kalux.models.dark_levels import DarkDoubt

from builders import unmeasured, unshown

GREY = View(
    log_offset=0.05,
    threshold2=0.04,
    neighbours=0.0,
    highlight_scale=1.0,
    highlight_spread=0.1,
    highlight_gain=1.0,
    highlight_growth=1.0,
    unknown_variance=9.0,
    lag_variance=0.0,
    fixed_pattern=0.0,
    response=None,
    rounding=0.0,
    dark=None,
    mosaic=None,
    gains=(1.0, 1.0, 1.0),
)
WHITE = float(np.log(1.05))


def estimate(levels, variance=1e-4, **fields):
    """An estimate of linear ``levels``, all known alike."""
    level = np.log(np.asarray(levels, np.float32) + np.float32(0.05))
    return Estimate(7, level, np.full(level.shape, variance, np.float32), WHITE, True, **fields)


def test_what_is_known_well_is_shown_as_it_is():
    levels = [[0.0, 0.25, 1.0]]
    image = make_image(estimate(levels), GREY)
    np.testing.assert_allclose(image.intensity, levels, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(image.variance, 1e-4, rtol=1e-3)
    assert (image.t, image.final, image.log_offset, image.colour) == (7, True, 0.05, None)


def test_the_variance_counts_the_fixed_pattern_of_the_frames():
    """0.01 of white beside I + I_0 of 0.1 and 0.5; in units of the brightest level that frames show."""
    view = dataclasses.replace(GREY, fixed_pattern=0.01)
    still = np.zeros((1, 2), bool)
    known = estimate([[0.05, 0.45]], moving=still, silent_change=np.zeros((1, 2), np.float32))
    image = make_image(known, view)
    np.testing.assert_allclose(image.variance, [[1e-4 + 0.1**2, 1e-4 + 0.02**2]], rtol=1e-4)
    assert image.fixed_pattern == pytest.approx(0.01)
    np.testing.assert_array_equal(image.intensity, make_image(known, GREY).intensity)
    longer = dataclasses.replace(known, white=float(np.log(2.05)))
    assert make_image(longer, view).fixed_pattern == pytest.approx(0.02)


def test_offsets_of_stored_values_are_as_much_light_as_the_curve_is_steep():
    """0.01 of what is stored, v = sqrt(I / white): 2 v 0.01 of white."""
    view = dataclasses.replace(GREY, fixed_pattern=0.01, response=Response.gamma(2.0))
    still = np.zeros((1, 2), bool)
    known = estimate([[0.04, 0.64]], moving=still, silent_change=np.zeros((1, 2), np.float32))
    image = make_image(known, view)
    np.testing.assert_allclose(image.fixed_pattern, [[0.004, 0.016]], rtol=2e-3)
    np.testing.assert_allclose(
        image.variance, 1e-4 + np.array([[0.004 / 0.09, 0.016 / 0.69]]) ** 2, rtol=3e-3
    )
    longer = dataclasses.replace(known, white=float(np.log(4.05)))  # I / 4 is stored
    np.testing.assert_allclose(make_image(longer, view).fixed_pattern, [[0.008, 0.032]], rtol=3e-3)
    unwanted = make_image(known, view, with_variance=False)
    assert (np.isinf(unwanted.variance).all(), unwanted.fixed_pattern) == (True, 0.0)


def test_what_exposures_take_off_a_frame_is_not_known_there():
    """The image is the same, and a variance that is not wanted stays infinite."""
    plane = np.full((1, 2), 0.02, np.float32)
    told = Around(plane, plane, 0 * plane, 0.0, 0.0, 0.01, 1.0, 0.0, 0.0, share=1.0)
    seen = estimate([[0.2, 0.4]], moving=np.array([[False, True]]), silent_change=plane, around=told)
    blurred = dataclasses.replace(seen, exposed=0.8)
    image, before = make_image(blurred, GREY), make_image(seen, GREY)
    assert (image.variance > before.variance + 0.06 * 0.8**2 * 0.02).all()
    np.testing.assert_array_equal(image.intensity, before.intensity)
    assert np.isinf(make_image(blurred, GREY, with_variance=False).variance).all()


def test_still_pixels_are_no_surer_than_the_rounding_that_their_frames_share():
    """A half of 0.01^2 of white beside I + I_0 of 0.1; events make it another one in every frame."""
    view = dataclasses.replace(GREY, rounding=0.01)
    moving = np.array([[False, False, True]])
    known = estimate([[0.05, 0.95, 0.05]], moving=moving, silent_change=np.zeros((1, 3), np.float32))
    image, before = make_image(known, view), make_image(known, GREY)
    np.testing.assert_allclose(image.variance[0, 0], 0.1**2 / 2, rtol=1e-4)
    np.testing.assert_array_equal(image.variance[0, 1:], before.variance[0, 1:])
    np.testing.assert_array_equal(image.intensity, before.intensity)
    assert np.isinf(make_image(known, view, with_variance=False).variance).all()


def test_what_noise_hides_below_black_is_doubted_and_shown_as_before():
    view = dataclasses.replace(GREY, dark=DarkDoubt(0.1, np.array([0.5, 0.0], np.float32)))
    known = estimate(
        [[0.05, 0.95]], moving=np.zeros((1, 2), bool), silent_change=np.zeros((1, 2), np.float32)
    )
    image, before = make_image(known, view), make_image(known, GREY)
    np.testing.assert_allclose(image.variance - before.variance, [[0.25, 0.0]], rtol=1e-3, atol=1e-7)
    np.testing.assert_array_equal(image.intensity, before.intensity)
    assert np.isinf(make_image(known, view, with_variance=False).variance).all()


def test_a_doubtful_highlight_is_drawn_towards_white_and_no_other_pixel():
    image = make_image(estimate([[0.5, 3.0]], variance=1.0), GREY)
    assert image.intensity[0, 0] == pytest.approx(0.5, rel=1e-4)
    assert 1.0 < image.intensity[0, 1] < 2.5
    free = make_image(estimate([[0.5, 3.0]], variance=1.0), dataclasses.replace(GREY, highlight_scale=0.0))
    np.testing.assert_allclose(free.intensity, [[0.5, 3.0]], rtol=1e-4)


def test_an_image_tells_itself_in_a_line():
    image = make_image(estimate([[0.25, 0.5]]), GREY)
    assert repr(image) == "<kalux.Image at 7 us: 2 x 1 pixels, grey, intensity 0.25 to 0.5, final>"


def test_an_intensity_is_never_negative():
    assert make_image(estimate([[-0.04]]), GREY).intensity[0, 0] == 0.0


def test_a_variance_that_is_not_wanted_changes_no_intensity():
    moving = np.array([[True, False, True]])
    told = estimate([[0.1, 0.5, 2.0]], 0.1, moving=moving, between=0.5)
    with_it, without = make_image(told, GREY), make_image(told, GREY, with_variance=False)
    np.testing.assert_array_equal(with_it.intensity, without.intensity)
    assert np.isfinite(with_it.variance).all()
    assert np.isinf(without.variance).all()


def test_a_pixel_that_no_frame_has_shown_is_above_its_bound_and_doubtful():
    bounded = unshown([1], 0.7, 0.01, 2.0, shape=(1, 2))
    plain, lifted = (make_image(estimate([[0.5, 1.0]], unshown=u), GREY) for u in (None, bounded))
    assert lifted.intensity[0, 0] == plain.intensity[0, 0]
    assert lifted.intensity[0, 1] > 1.2
    assert lifted.variance[0, 1] == pytest.approx(0.7**2 + 0.01 + 0.25 * 2.0)


@pytest.mark.parametrize(("between", "alike"), [(0.0, False), (1.0, True)])
def test_neighbours_tell_more_of_a_pixel_that_no_frame_ties(between, alike):
    """At a frame it may be as far from where its events left it as half-way, where none is tied (K11, K12)."""
    view = dataclasses.replace(GREY, neighbours=0.2, highlight_scale=0.0)
    levels = [[0.5, 0.5, 0.5], [0.5, 0.51, 0.5], [0.5, 0.5, 0.5]]
    told = estimate(levels, moving=np.ones((3, 3), np.bool_), between=between)
    tied, untied = (
        make_image(
            dataclasses.replace(told, unmeasured=unmeasured(np.arange(9).reshape(3, 3) == of)), view
        ).intensity[1, 1]
        for of in (None, 4)
    )
    assert (untied == tied) if alike else (0.5 < untied < tied - 1e-3)


def test_frames_in_rgb_lend_their_ratios_to_the_intensity():
    chroma = np.array([[[2.0, 1.0, 0.5]]], np.float32)
    image = make_image(estimate([[0.3]], chroma=chroma), GREY)
    np.testing.assert_array_equal(image.colour, chroma * image.intensity[..., None])


def test_a_mosaic_has_colours_also_where_no_variance_is_wanted():
    view = dataclasses.replace(GREY, mosaic="RGGB", gains=(2.0, 1.0, 1.5))
    both = [
        make_image(estimate(np.full((4, 4), 0.2)), view, with_variance=wanted) for wanted in (True, False)
    ]
    np.testing.assert_array_equal(both[0].colour, both[1].colour)
    np.testing.assert_allclose(both[0].colour[2, 2], [0.4, 0.2, 0.3], rtol=1e-3)
    assert both[0].grey().colour is None


def test_a_mosaics_colours_are_the_same_where_no_variance_is_wanted():
    """Beyond white they depend on the variance, with what exposures hide and the rounding that frames share."""
    view = dataclasses.replace(GREY, mosaic="RGGB", gains=(2.0, 1.0, 1.5), rounding=0.3, fixed_pattern=0.2)
    plane = np.full((4, 4), 0.5, np.float32)
    told = Around(plane, plane, 0 * plane, 0.0, 0.0, 0.01, 1.0, 0.0, 0.0, share=0.0)
    seen = estimate(
        1.3 * np.ones((4, 4)), 0.2, moving=plane > 1, silent_change=plane, around=told, exposed=0.9
    )
    with_it, without = (make_image(seen, view, with_variance=wanted).colour for wanted in (True, False))
    np.testing.assert_array_equal(with_it, without)


def test_beyond_the_white_of_a_long_exposure_colours_are_doubtful():
    """A wall that frames of four times the reference exposure clip is as grey as in frames of the reference."""
    view = dataclasses.replace(GREY, mosaic="RGGB", gains=(1.8, 1.0, 1.4))
    wall = np.ones((4, 4))
    short = make_image(estimate(wall, 2.0), view).colour
    long_view = dataclasses.replace(view, log_offset=0.05 / 4)
    level = np.full((4, 4), np.log(0.25 + 0.05 / 4), np.float32)
    seen = Estimate(7, level, np.full((4, 4), 2.0, np.float32), float(level[0, 0]), True)
    long = make_image(seen, long_view).colour
    np.testing.assert_allclose(long, short / 4, rtol=1e-3)
    assert long[0, 0, 0] < 1.3 * long[0, 0, 1]
