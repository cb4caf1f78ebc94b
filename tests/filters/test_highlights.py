"""How pixels that no frame has shown are read out, and what smoothing makes of their bounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import kalux
from kalux.events import make_events
from kalux.filters.highlights import (
    calm_specks,
    keep_white,
    lifted,
    obey_bounds,
    read_unshown,
    smoothed_unshown,
    tempered,
)
from kalux.filters.readout import HighlightPrior, Subthreshold, read_out

import naive
from builders import unmeasured, unshown

OFFSET = 0.03
WHITE = float(np.log(1 + OFFSET))
PRIOR = HighlightPrior(WHITE, 2.25, 0.0, 1.0, 0.0)
OFF = HighlightPrior(WHITE, 0.0, 0.0, 1.0, 0.0)


def intensity(value, variance, offset, prior):
    return read_out(value, variance, offset, prior)[0]


def regularised(value, variance, moving, difference, pitch):
    """L after K12."""
    nothing = Subthreshold(0.0, 0.0)
    image = read_out(
        value, variance, OFFSET, OFF, moving=moving, subthreshold=nothing, difference=difference, pitch=pitch
    )[0]
    return np.log(image + OFFSET)


def read(level, where, difference=0.0, moving=None, pitch=1, prior=PRIOR):
    bound = np.asarray(level, np.float32)
    raised, spread = lifted(bound, np.full(bound.shape, 0.01, np.float32), where)
    subthreshold = Subthreshold(0.0, 0.0)
    image, _, heard = read_out(
        raised,
        spread,
        OFFSET,
        prior,
        moving=moving,
        subthreshold=subthreshold,
        difference=difference,
        pitch=pitch,
        unshown=where.pixels,
    )
    read_unshown(image, heard, bound, where, OFFSET, prior)
    return image


def test_at_white_it_is_the_mean_of_what_is_expected():
    """The log of the mean intensity of a normal distribution: mean and half the variance."""
    image = read(np.full((2, 2), WHITE), unshown([1], 0.4))
    assert image[0, 1] == pytest.approx(1.03 * np.exp(0.4 + 0.08) - 0.03, rel=1e-5)
    assert image[0, 0] == pytest.approx(1.0, abs=1e-6)


def test_where_much_is_expected_its_mean_stays_finite():
    """An exponential distribution of scale 1 or more has no mean intensity: what is added is half of the scale."""
    image = read(np.full((1, 1), WHITE), unshown([0], 2.0))
    assert image[0, 0] == pytest.approx(1.03 * np.exp(2.0 + 1.0) - 0.03, rel=1e-5)


def test_noise_of_the_events_draws_to_white():
    level = np.full((1, 2), WHITE + 1.0)
    assert read(level, unshown([0], 0.4, 1.0))[0, 0] < read(level, unshown([0], 0.4, 0.0))[0, 0]


def test_without_a_prior_events_are_not_doubted():
    off = HighlightPrior(WHITE, 0.0, 0.0, 1.0, 0.0)
    where, bound = unshown([0, 1], 0.4, 1.0), np.array([[WHITE, WHITE + 1.0]], np.float32)
    where.noise[0] = 0.0
    assert tempered(where, bound, off) is where
    np.testing.assert_allclose(read(bound, where, prior=off), np.exp(bound + 0.4 + 0.08) - OFFSET, rtol=1e-5)


@pytest.mark.parametrize("pitch", [1, 2])
def test_neighbours_are_heard_as_by_other_pixels(pitch):
    """K12 with the expected levels, of the pixels of the same colour."""
    rng = np.random.default_rng(3)
    level = (WHITE + 0.3 + 0.2 * rng.random((6, 7))).astype(np.float32)
    where = unshown(np.arange(0, 42, 3), 0.5, 0.02)
    moving = rng.random((6, 7)) < 0.8
    raised, spread = lifted(level, np.full((6, 7), 0.05, np.float32), where)
    image = np.zeros_like(level)
    told = read_out(
        raised, spread, OFFSET, PRIOR, moving=moving, difference=0.3, pitch=pitch, unshown=where.pixels
    )[2]
    read_unshown(image, told, level, where, OFFSET, PRIOR)
    heard = regularised(raised, spread, moving, 0.3, pitch).reshape(-1)[where.pixels]
    assert (heard != raised.reshape(-1)[where.pixels]).any()
    least = np.maximum(heard, level.reshape(-1)[where.pixels])
    expected = intensity((least + where.excess**2 / 2)[None], where.noise[None], OFFSET, PRIOR)[0]
    np.testing.assert_allclose(image.reshape(-1)[where.pixels], expected, rtol=1e-5)


def test_dark_neighbours_do_not_take_a_pixel_below_its_bound():
    level = np.full((3, 3), WHITE - 0.4, np.float32)
    level[1, 1] = WHITE
    image = read(level, unshown([4], 0.01), 0.3, np.ones((3, 3), bool))
    assert image[1, 1] >= 1.0


@pytest.mark.parametrize("how", [{}, {"lookahead": False}, {"smooth": True}], ids=["", "causal", "both ways"])
def test_a_lamp_that_every_frame_clips_stays_white(how):
    """It goes on with too few events, among grey pixels with whom it is compared."""
    frames = [kalux.Frame(np.full((9, 9), 128, np.uint8), k * 40_000, k * 40_000 + 10_000) for k in range(6)]
    for frame, lamp in zip(frames, (100, 100, 255, 255, 255, 255), strict=True):
        frame.image[4, 4] = lamp
    events = make_events([60_000, 70_000, 75_000], [4] * 3, [4] * 3, [True] * 3)
    recording = kalux.Recording.from_arrays(events, frames, sensor_size=(9, 9), contrast_threshold=(0.3, 0.3))
    late = [image.intensity for image in kalux.reconstruct(recording, rate_hz=50, **how) if image.t > 100_000]
    assert min(image[4, 4] for image in late) == pytest.approx(1.0, abs=0.08)
    assert max(image[4, 3] for image in late) < 0.52


def test_a_clipped_pixel_that_went_dark_between_the_frames_is_dark():
    image = np.full((1, 3), 0.5, np.float32)
    keep_white(image, np.array([[WHITE + 0.2, WHITE - 0.9, WHITE]]), np.array([0, 1]), OFFSET, PRIOR)
    np.testing.assert_allclose(image, [[1.0, 0.5, 0.5]], rtol=1e-6)


def everywhere(image):
    return unmeasured(np.ones(image.shape, bool))


@pytest.mark.parametrize("seed", range(5))
def test_specks_are_calmed_as_by_the_oracle(seed):
    rng = np.random.default_rng(seed)
    image = np.exp(rng.normal(0.5, 1.0, (9, 11))).astype(np.float32)
    variance = rng.uniform(1e-4, 0.3, image.shape).astype(np.float32)
    among = rng.random(image.shape) < 0.9
    expected = naive.calmed(image, variance, OFFSET, among)
    assert (expected < image).any()
    calm_specks(image, variance, OFFSET, unmeasured(among))
    np.testing.assert_allclose(image, expected, rtol=1e-5)


@given(row=st.floats(2.5, 3.5), column=st.floats(2.5, 3.5), ground=st.floats(1.0, 5.0))
def test_a_point_of_light_behind_a_lens_is_none(row, column, ground):
    """A Gaussian of half a pixel, wherever it falls, though all pixels are known exactly."""
    rows, columns = np.mgrid[:7, :7]
    point = np.exp(-2 * ((rows - row) ** 2 + (columns - column) ** 2))
    image = (ground + 100 * point).astype(np.float32)
    before = image.copy()
    calm_specks(image, np.zeros_like(image), OFFSET, everywhere(image))
    np.testing.assert_allclose(image, before, rtol=0.02)


def test_a_speck_in_a_white_is_no_brighter_than_its_surroundings_allow():
    """Neighbours may be too dark by their noise; where a frame measures one of them, it may be a lamp of its own."""
    image = np.full((5, 5), 1.1, np.float32)
    image[2, 2] = 30
    for noise, expected in ((0.0, 1.1), (0.01, 1.1 + 8.4 * 0.5 * 0.1 * (1.1 + OFFSET))):
        calmed = image.copy()
        calm_specks(calmed, np.full((5, 5), noise, np.float32), OFFSET, everywhere(image))
        assert calmed[2, 2] == pytest.approx(expected, rel=1e-5)
        np.testing.assert_array_equal(np.delete(calmed, 12), np.delete(image, 12))
    for known in (7, 11, 12, 13, 17):
        calmed = image.copy()
        calm_specks(
            calmed, np.zeros((5, 5), np.float32), OFFSET, unmeasured(np.arange(25).reshape(5, 5) != known)
        )
        np.testing.assert_array_equal(calmed, image)


def test_neighbours_take_a_bound_of_noisy_events_down_to_two_standard_deviations():
    level = np.full((3, 3), WHITE, np.float32)
    level[1, 1] += 0.4
    heard, where = np.full(1, WHITE + 0.1, np.float32), unshown([4], 0.0, 0.01)
    for noise, least in ((0.0, 0.4), (0.01, 0.2), (0.04, 0.1)):
        image = np.zeros((3, 3), np.float32)
        read_unshown(image, heard, level, where._replace(noise=np.full(1, noise, np.float32)), OFFSET, OFF)
        assert image[1, 1] == pytest.approx(1.03 * np.exp(least) - 0.03, rel=1e-5)


def test_far_beyond_white_less_is_expected_above():
    bound = np.array([[WHITE - 1, WHITE, WHITE + 2.25]], np.float32)
    found = tempered(unshown([0, 1, 2], 0.5), bound, PRIOR)
    np.testing.assert_allclose(found.excess, [0.5, 0.5, 1 / 3], rtol=1e-6)


def both(smoothed, first, second):
    """What `smoothed_unshown` finds, and the level afterwards, of bounds and `unshown` pixels of both directions."""
    level = np.array([smoothed])
    directions = ((np.array([bounds]), np.ones((1, len(bounds))), where) for bounds, where in (first, second))
    return smoothed_unshown(level, *directions), level[0]


def test_of_both_directions_only_what_neither_has_seen_is_left():
    alike = np.full(10, 1.0)
    first, second = unshown([1, 4, 7], 0.2, 0.3), unshown([4, 7, 9], 0.8, 0.1)
    found, level = both(alike, (alike, first), (alike, second))
    np.testing.assert_array_equal(found.pixels, [4, 7])
    np.testing.assert_allclose(found.excess, 0.4, rtol=1e-6)
    np.testing.assert_allclose(found.noise, 0.1, rtol=1e-6)
    np.testing.assert_allclose(found.doubt, (3 * 0.4) ** 2, rtol=1e-6)
    np.testing.assert_array_equal(level, alike)
    assert both(alike, (alike, found), (alike, None))[0] is None


@pytest.mark.parametrize(
    ("noise", "rise"),
    [(0.0, 0.6), (0.1, 0.4), (0.3, 0.0), (5.0, 0.0)],
    ids=["exact", "known", "as much as both differ", "anything"],
)
def test_the_higher_of_two_bounds_holds_as_far_as_its_events_are_exact(noise, rise):
    """What is expected above it, e, and not known of that, 3 e, are a scale of 0.5: noise v takes off v / 0.5."""
    expected = 0.5 / 10**0.5
    low = np.array([1.0]), unshown([0], 0.5 * expected, 0.01)
    high = np.array([2.2]), unshown([0], 2 * expected, noise)
    for first, second in ((low, high), (high, low)):
        found, level = both(np.array([1.6]), first, second)
        assert level[0] == pytest.approx(1.6 + rise, abs=1e-6)
        assert found.excess[0] == pytest.approx(expected / (1 + rise / 0.5), rel=1e-5)
        assert found.noise[0] == pytest.approx(noise if rise else min(noise, 0.01))


def obeyed(bound, noise, level, doubt, other=None):
    """Smoothed L and P."""
    smoothed = np.array([[-9.0]]), np.array([[-9.0]])
    only_bound = np.array([[bound]]), np.array([[1.0 + noise]]), unshown([0], 0.2, noise)
    obey_bounds(smoothed, only_bound, (np.array([[level]]), np.array([[doubt]]), other))
    return tuple(float(plane[0, 0]) for plane in smoothed)


def test_where_one_direction_knows_only_a_bound_the_other_counts():
    assert obeyed(0.0, 0.1, 1.5, 1e-3) == pytest.approx((1.5, 1e-3))
    assert obeyed(2.0, 0.0, 1.5, 1e-3) == pytest.approx((2.0, 1e-3))
    raised = 1.5 + 0.5 * 0.01 / (0.01 + 0.01)  # both are as sure
    assert obeyed(2.0, 0.01, 1.5, 0.01) == pytest.approx((raised, 0.01))


def test_a_bound_makes_nothing_surer():
    assert obeyed(0.0, 0.1, 1.5, 4.0) == pytest.approx((1.5, 4.0))


def test_where_neither_knows_more_nothing_changes():
    assert obeyed(0.0, 0.1, 1.5, 0.1, unshown([0], 0.2)) == (-9.0, -9.0)


def test_an_estimate_tells_which_pixels_neither_frame_around_measures():
    engine = kalux.Reconstructor((3, 3), contrast_threshold=(0.3, 0.3))
    for k, clipped in enumerate(([4, 5], [3, 4], [])):
        picture = np.full((3, 3), 128, np.uint8)
        picture.flat[clipped] = 255
        engine.push_frame(kalux.Frame(picture, k * 40_000, k * 40_000 + 10_000))
    engine.finish()
    assert engine.estimate(20_000).unmeasured.pixels.tolist() == [4]
    assert engine.estimate(60_000).unmeasured.pixels.tolist() == []
