"""From the state to an intensity, and the prior on highlights."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import lambertw

from kalux.filters import surfaces
from kalux.filters.readout import (
    BRIGHTEST,
    HighlightPrior,
    Subthreshold,
    believed_highlight,
    edge,
    read_out,
)
from kalux.settings import altered, preset

import naive
from builders import unmeasured

OFF = HighlightPrior(white=np.inf, scale2=0.0, unknown_scale=0.0, gain=1.0, growth=0.0)
NO_SUBTHRESHOLD = Subthreshold(0.0, 0.0)
excesses = st.floats(0.0, 12.0)
unknown_scales = st.floats(1e-4, 2.0)
growths = st.floats(0.0, 1.0)


def intensity(value, variance, offset, prior):
    return read_out(value, variance, offset, prior)[0]


def regularised(value, variance, moving, difference):
    """L after K12."""
    return np.log(read_out(value, variance, 0.0, OFF, moving=moving, difference=difference)[0])


def lambert(excess, variance, scale2, unknown_scale, growth):
    """Mode, variance that is left, and share of the normal prior in that of a highlight."""
    spread = scale2 + growth * max(excess**2 - variance, 0.0)
    trust, stretch = spread / (spread + variance), unknown_scale / np.sqrt(spread)
    w = lambertw(stretch * excess * trust).real
    return w / stretch, variance * trust * (np.exp(-w) / (1 + w)) ** 2, scale2 / spread


@given(excesses, st.floats(0.0, 3.0), st.floats(0.01, 9.0), unknown_scales, growths)
def test_highlights_are_lamberts_w_and_half_the_variance_that_is_left(
    excess, variance, scale2, unknown_scale, growth
):
    mode, left, normal = lambert(excess, variance, scale2, unknown_scale, growth)
    expected = min(mode + normal * min(left, mode * np.sqrt(left)) / 2, BRIGHTEST)
    found = believed_highlight(excess, variance, scale2, unknown_scale, 1.0, growth)
    assert found == pytest.approx(expected, rel=2e-6, abs=1e-12)


@given(st.floats(0.0, 11.0), st.floats(0.01, 9.0), unknown_scales, growths)
def test_the_mode_solves_its_equation(excess, scale2, unknown_scale, growth):
    """K6: without noise, d exp(s^2 d / S^(1/2)) is the excess."""
    d = believed_highlight(excess, 0.0, scale2, unknown_scale, 1.0, growth)
    stretch = unknown_scale / np.sqrt(scale2 + growth * excess**2)
    assert d * np.exp(stretch * d) == pytest.approx(excess, rel=1e-4, abs=1e-9)


@given(st.floats(1e-6, 12.0), st.floats(1e-3, 2.0), st.floats(0.0, 3.0), unknown_scales, growths)
def test_more_excess_is_more_highlight(excess, more, variance, unknown_scale, growth):
    low = believed_highlight(excess, variance, 1.0, unknown_scale, 1.0, growth)
    high = believed_highlight(excess + more, variance, 1.0, unknown_scale, 1.0, growth)
    assert 0.0 <= low < high or low == high == BRIGHTEST


@given(st.floats(0.0, 60.0), st.floats(0.0, 9.0), unknown_scales, growths)
def test_no_light_is_a_hundred_thousand_times_white(excess, variance, unknown_scale, growth):
    """K6: what events say has no bound, but light has."""
    found = believed_highlight(excess, variance, 4.0, unknown_scale, 1.0, growth)
    assert np.exp(found) <= 1.00001e5
    assert believed_highlight(60.0, 0.0, 4.0, 0.0, 1.0, 1.0) == BRIGHTEST


@given(st.floats(0.0, 3.0), st.floats(0.01, 9.0), growths)
def test_a_highlight_no_farther_than_its_noise_has_a_normal_prior(variance, scale2, growth):
    """K6: the prior grows only by what noise does not explain."""
    excess = 0.999 * np.sqrt(variance)
    normal = believed_highlight(excess, variance, scale2, 0.0, 1.0, 0.0)
    assert believed_highlight(excess, variance, scale2, 0.0, 1.0, growth) == normal


@given(st.floats(4.0, 12.0), st.floats(0.0, 1.0))
def test_far_highlights_are_hardly_shrunk(excess, variance):
    """K6: one that lies far beyond white, for its noise, tells how far highlights like it go."""
    spread = 4.0 + excess**2 - variance
    shrunk = excess * variance / (spread + variance)
    found = believed_highlight(excess, variance, 4.0, 0.0, 1.0, 1.0)
    assert min(excess - shrunk, BRIGHTEST) <= found + 1e-5
    assert found <= excess - shrunk + 2.0 * variance / spread + 1e-5


@given(st.floats(0.5, 3.0), st.floats(0.01, 0.3))
def test_the_mean_intensity_of_a_normal_posterior(excess, variance):
    """Where the posterior is normal and beyond white, the read-out is the log of its mean intensity."""
    scale2 = 1.0
    mean, left = excess * scale2 / (scale2 + variance), variance * scale2 / (scale2 + variance)
    draws = mean + np.sqrt(left) * np.random.default_rng(0).standard_normal(200_000)
    if mean > np.sqrt(left):
        found = believed_highlight(excess, variance, scale2, 0.0, 1.0, 0.0)
        assert found == pytest.approx(np.log(np.exp(draws).mean()), abs=5e-3)


def test_a_sure_estimate_is_believed():
    """No variance and no unknown scale: the estimate itself. Half where prior and noise are alike."""
    assert believed_highlight(1.5, 0.0, 1.0, 0.0, 1.0, 0.0) == 1.5
    assert believed_highlight(1.5, 1.0, 1.0, 0.0, 1.0, 0.0) == 0.75 + 0.5 * 0.5
    assert believed_highlight(0.0, 1.0, 1.0, 1.7, 1.0, 1.0) == pytest.approx(0.0, abs=1e-20)


@given(st.floats(0.0, 1.0), excesses, st.floats(0.0, 3.0), st.floats(0.01, 9.0), unknown_scales, growths)
def test_of_events_that_explain_frames_half_half_is_believed(
    gain, excess, variance, scale2, unknown_scale, growth
):
    found = believed_highlight(excess, variance, scale2, unknown_scale, gain, growth)
    assert found == pytest.approx(
        believed_highlight(gain * excess, variance, scale2, unknown_scale, 1.0, growth), rel=1e-5, abs=1e-9
    )


def test_the_short_cut_for_a_small_unknown_scale_is_seamless():
    below, above = (believed_highlight(1.0, 0.0, 1.0, s, 1.0, 0.0) for s in (0.99e-6, 1.01e-6))
    assert below == pytest.approx(above, rel=3e-6)


def test_white_is_one():
    """L = log(1 + I_0) is I = 1, L = log(I_0) is black."""
    value = np.log(np.array([[1.03, 0.53, 0.03]]))
    out = intensity(value, np.zeros((1, 3)), 0.03, OFF)
    np.testing.assert_allclose(out, [[1.0, 0.5, 0.0]], rtol=1e-6, atol=1e-7)
    assert out.dtype == np.float32


@given(st.floats(-30.0, 3.0), st.floats(0.0, 1.0), st.floats(1e-4, 1.0))
def test_intensity_is_never_negative_and_inverts_the_logarithm(value, variance, offset):
    out = intensity(np.array([[value]]), np.array([[variance]]), offset, OFF)[0, 0]
    assert out >= 0.0
    assert out == pytest.approx(max(np.exp(value) - offset, 0.0), rel=1e-5, abs=1e-6)


def test_the_prior_only_concerns_highlights():
    prior = HighlightPrior(white=np.log(1.03), scale2=1.0, unknown_scale=1.0, gain=1.0, growth=0.0)
    value, variance = np.log(np.array([[0.5, 1.03, 3.0]])), np.full((1, 3), 0.2)
    with_prior, without = intensity(value, variance, 0.03, prior), intensity(value, variance, 0.03, OFF)
    np.testing.assert_array_equal(with_prior[0, :2], without[0, :2])
    believed = believed_highlight(np.log(3.0 / 1.03), 0.2, 1.0, 1.0, 1.0, 0.0)
    assert with_prior[0, 2] == pytest.approx(1.03 * np.exp(believed) - 0.03, rel=1e-6)
    assert 1.0 < with_prior[0, 2] < without[0, 2]


def test_white_is_that_of_the_shortest_exposure():
    """A short exposure measures more than 1: what it can show is no highlight."""
    prior = HighlightPrior(white=np.log(4.03), scale2=1.0, unknown_scale=1.0, gain=1.0, growth=0.0)
    value, variance = np.log(np.array([[1.03, 2.0, 4.02]])), np.full((1, 3), 0.5)
    np.testing.assert_array_equal(
        intensity(value, variance, 0.03, prior), intensity(value, variance, 0.03, OFF)
    )


def test_the_white_level_is_continuous():
    prior = HighlightPrior(white=0.0, scale2=1.0, unknown_scale=1.7, gain=1.0, growth=0.0)
    low, high = intensity(np.array([[-1e-7, 1e-7]]), np.ones((1, 2)), 0.03, prior)[0]
    assert high == pytest.approx(low, abs=1e-6)


# --- neighbours ----------------------------------------------------------------------------------------------


def noisy_edge(seed=0, noise=0.1):
    """A step of 2 in log intensity between two even surfaces, with noise of known variance."""
    rng = np.random.default_rng(seed)
    truth = np.zeros((20, 30))
    truth[:, 15:] = 2.0
    return truth, (truth + noise * rng.standard_normal(truth.shape)).astype(np.float32)


def test_neighbours_lessen_noise_and_leave_the_edge():
    truth, noisy = noisy_edge()
    variance = np.full(truth.shape, 0.01, np.float32)
    smooth = regularised(noisy, variance, np.ones(truth.shape, bool), 0.1)
    assert np.mean((smooth - truth) ** 2) < 0.4 * np.mean((noisy - truth) ** 2)
    beside = np.s_[:, 14:16]
    assert np.mean((smooth - truth)[beside] ** 2) < 0.7 * np.mean((noisy - truth)[beside] ** 2)


def test_still_and_well_known_pixels_stay():
    truth, noisy = noisy_edge()
    moving = np.zeros(truth.shape, bool)
    variance = np.full(truth.shape, 0.01, np.float32)
    np.testing.assert_allclose(regularised(noisy, variance, moving, 0.1), noisy, atol=1e-6)
    moving[5, 5], variance[5, 5] = True, 1e-6
    np.testing.assert_allclose(regularised(noisy, variance, moving, 0.1), noisy, atol=2e-4)


@pytest.mark.parametrize("neighbour", [1e-6, 0.04, 1e6])
def test_the_variance_falls_by_what_neighbours_do_not_share(neighbour):
    """To 0.7 of it and 0.3 of what independent errors would leave."""
    variance, moving = np.full((5, 5), neighbour, np.float32), np.zeros((5, 5), bool)
    variance[2, 2], moving[2, 2] = 0.04, True
    left = read_out(np.zeros((5, 5)), variance, 0.0, OFF, moving=moving, difference=0.1)[1]
    independent = 1 / (1 / 0.04 + 4 / (neighbour + 0.01) + 4 / (neighbour + 0.02))
    assert left[2, 2] == pytest.approx(0.028 + 0.3 * independent, rel=1e-5)
    np.testing.assert_array_equal(left[~moving], variance[~moving])


def test_patches_tell_a_faint_edge_from_noise():
    """Of a difference of three standard deviations an edge keeps more than a single pixel, which is noise."""
    edge, single = np.zeros((2, 20, 30), np.float32)
    edge[:, 15:] = single[10, 15] = 0.3
    variance, moving = np.full((20, 30), 0.01, np.float32), np.ones((20, 30), bool)
    across = np.diff(regularised(edge, variance, moving, 0.1)[10, 14:16])[0]
    alone = regularised(single, variance, moving, 0.1)[10, 15]
    assert across > 0.2
    assert alone < 0.12


@given(st.floats(0.0, 1e6), st.floats(0.0, 1e6))
def test_likeness_is_a_share_and_falls(unlike, more):
    near, far = (float(1 / edge(np.float32(value)) ** 2) for value in (unlike, unlike + more))
    assert 0.0 < far <= near <= 1.0


def test_pixels_beyond_what_hears_change_nothing():
    """Where rows and columns without pixels that hear are passed over, those beside are what they are alone."""
    rng = np.random.default_rng(2)
    level = rng.normal(0.0, 0.3, (40, 200)).astype(np.float32)
    variance = np.full(level.shape, 0.005, np.float32)
    few = np.zeros(level.shape, bool)
    few[[3, 17, 18, 39], [2, 63, 64, 199]] = True
    alone, all_of_them = (regularised(level, variance, hears, 0.2) for hears in (few, np.ones_like(few)))
    np.testing.assert_array_equal(alone[few], all_of_them[few])
    np.testing.assert_allclose(alone[~few], level[~few], atol=1e-6)


def test_pixels_that_no_frame_has_shown_are_told_as_they_are_read():
    """Their variance is not lessened."""
    truth, noisy = noisy_edge()
    variance, pixels = np.full(truth.shape, 0.01, np.float32), np.array([0, 29, 30, 444, 599])
    moving = np.ones(truth.shape, bool)
    image, left, levels = read_out(noisy, variance, 0.0, OFF, moving=moving, difference=0.1, unshown=pixels)
    np.testing.assert_allclose(np.exp(levels), image.reshape(-1)[pixels], rtol=1e-6)
    np.testing.assert_array_equal(left.reshape(-1)[pixels], variance.reshape(-1)[pixels])
    assert np.count_nonzero(left == variance) == len(pixels)


@pytest.mark.parametrize(
    ("shape", "moves"), [((3, 5), 0.6), ((7, 100), 0.02), ((6, 64), 0.5), ((5, 1283), 0.05)]
)
@pytest.mark.parametrize(("pitch", "gain"), [(1, 1.0), (2, 0.6)])
@pytest.mark.parametrize("textured", [False, True])
def test_images_are_the_oracles(shape, moves, pitch, gain, textured):
    """K6, K11 and K12 pixel by pixel, over images narrower and wider than what is looked at together."""
    rng = np.random.default_rng(1)
    value, variance = rng.normal(-0.5, 1.0, shape), np.exp(rng.normal(-3.0, 2.0, shape))
    moving = rng.random(shape) < moves
    subthreshold, chosen = (
        Subthreshold(0.5, 0.03),
        altered(preset("default"), "events", extrapolation_gain=gain, extrapolation_trust=0.8),
    )
    change = rng.uniform(0, 0.05, shape).astype(np.float32)
    texture = np.full(shape, 0.3**2)
    if textured:
        texture = np.exp(rng.normal(-3.0, 1.0, shape))
    white, unknown_scale, offset = 0.8, 1.4, chosen.camera.offset
    prior = HighlightPrior(np.log(white + offset), chosen.filter.highlight_scale**2, unknown_scale, gain, 0.8)
    given = value.astype(np.float32), variance.astype(np.float32)
    found = read_out(
        *given,
        offset,
        prior,
        moving=moving,
        subthreshold=subthreshold,
        silent_change=change,
        difference=0.3,
        pitch=pitch,
        texture=texture.astype(np.float32) if textured else None,
    )
    total = variance + np.where(moving, subthreshold.moving, subthreshold.silent * change)
    level = np.empty(shape)
    for part in np.ndindex(pitch, pitch):  # a mosaic's colours know nothing of each other
        own = np.s_[part[0] :: pitch, part[1] :: pitch]
        level[own], total[own] = naive.regularised(
            value[own], total[own], moving[own], texture[own] * pitch**2
        )
    expected = np.vectorize(lambda v, p: naive.intensity(v, p, chosen, white, unknown_scale))(level, total)
    np.testing.assert_allclose(found[1], total, rtol=1e-5)
    np.testing.assert_allclose(found[0], expected, rtol=1e-5, atol=1e-6)
    assert (value > prior.white).sum() > 2


@pytest.mark.parametrize(("step", "share"), [(0.0, 0.9), (1.5, 1.0)])
def test_surfaces_that_no_frame_measures_are_smooth_and_their_edges_stay(step, share):
    """K12: neighbours count, and those twice as far away, where they differ by their noise alone."""
    rng = np.random.default_rng(3)
    truth = 0.5 + step * (np.arange(40) >= 20) * np.ones((30, 1))
    noisy, variance = truth + rng.normal(0.0, 0.2, truth.shape), np.full(truth.shape, 0.04)
    everywhere = np.ones(truth.shape, bool)
    usual, even = (
        np.log(read_out(noisy, variance, 0.0, OFF, moving=everywhere, difference=0.2, unmeasured=of)[0])
        for of in (None, unmeasured(everywhere))
    )
    assert (even - truth).std() < share * (usual - truth).std()
    np.testing.assert_allclose(np.diff(even, axis=1)[:, 19].mean(), step, atol=0.2)


@pytest.mark.parametrize("shape", [(8, 8), (7, 8)])
@pytest.mark.parametrize("white", [np.inf, -4.5])
def test_surfaces_are_the_oracles(shape, white):
    """K12 of surfaces, pixel by pixel, among moving and still pixels that frames measure; far beyond white, too."""
    rng = np.random.default_rng(4)
    level, variance = rng.normal(-1.0, 0.7, shape), np.exp(rng.normal(-3.0, 1.0, shape))
    moving, surface = rng.random((2, *shape)) < 0.5
    read = {"moving": moving | surface, "difference": 0.2}
    prior = OFF._replace(white=white)
    image, left, _ = read_out(level, variance, 0.0, prior, **read, unmeasured=unmeasured(surface))
    expected, doubt = naive.smoothed_surfaces(level, variance, surface, 0.2, white)
    np.testing.assert_allclose(np.log(image)[surface], expected[surface], atol=1e-5)
    np.testing.assert_allclose(left[surface], doubt[surface], rtol=1e-4)
    usual = naive.smoothed_surfaces(level, variance, surface, 0.2, np.inf)[0]
    assert (np.abs(usual - expected)[surface].max() > 0.05) == np.isfinite(white)
    others = read_out(level, variance, 0.0, OFF, **read)[0]
    np.testing.assert_array_equal(image[~surface], others[~surface])


@pytest.mark.parametrize("pitch", [1, 2])
def test_a_lamp_is_less_like_what_is_around_it_than_a_sky(pitch):
    """K12: what is far beyond white is rougher; a single bright pixel is not taken for a lamp."""
    rng = np.random.default_rng(6)
    shape = (24, 24)
    lamp, single = np.zeros((2, *shape), bool)
    lamp[8 : 8 + 3 * pitch, 8 : 8 + 3 * pitch] = True
    single[16, 16] = True
    variance, everywhere = np.full(shape, 0.3), unmeasured(np.ones(shape, bool))
    read = {"moving": np.ones(shape, bool), "difference": 0.2, "pitch": pitch, "unmeasured": everywhere}

    def kept(beyond, bright):
        level = beyond + 1.5 * bright + rng.normal(0.0, 0.01, shape)
        found = np.log(read_out(level, variance, 0.0, OFF._replace(white=0.0), **read)[0])
        return (found - beyond)[bright].mean() / 1.5

    assert kept(4.0, lamp) > kept(0.0, lamp) + 0.05
    assert kept(0.0, single) == pytest.approx(kept(-4.0, single), abs=0.05)


@pytest.mark.parametrize("pitch", [1, 2])
def test_surfaces_depend_on_nothing_beyond_what_their_means_look_at(pitch, monkeypatch):
    """Blocks that no mean looks at are left out: with all of them the surfaces are the same to the last bit."""
    rng = np.random.default_rng(5)
    level, variance = rng.normal(-1.0, 0.3, (62, 75)), np.exp(rng.normal(-3.0, 1.0, (62, 75)))
    surface = np.zeros(level.shape, bool)
    surface[25:37, 30:47] = rng.random((12, 17)) < 0.7

    def found():
        options = {"moving": surface, "difference": 0.2, "pitch": pitch}
        prior = OFF._replace(white=-4.0)
        return read_out(level, variance, 0.0, prior, **options, unmeasured=unmeasured(surface))[:2]

    of_blocks = found()
    monkeypatch.setattr(surfaces, "_blocks", lambda mask: np.ones((len(mask), -(-mask.shape[1] // 32)), bool))
    for plane, expected in zip(of_blocks, found(), strict=True):
        np.testing.assert_array_equal(plane, expected)


@pytest.mark.parametrize("pitch", [1, 2])
def test_surfaces_are_the_same_where_strips_meet(pitch):
    """Wide images are averaged 640 columns at a time: what lies across is as it is elsewhere."""
    rng = np.random.default_rng(7)
    level, variance = rng.normal(-1.0, 0.3, (24, 720)), np.exp(rng.normal(-3.0, 1.0, (24, 720)))
    surface = np.zeros(level.shape, bool)
    surface[3:20, 600:690] = rng.random((17, 90)) < 0.8

    def found(aside):
        """With all moved to the left."""
        told, doubt, mask = (np.roll(plane, -aside, axis=1) for plane in (level, variance, surface))
        options = {"moving": mask, "difference": 0.2, "pitch": pitch, "unmeasured": unmeasured(mask)}
        planes = read_out(told, doubt, 0.0, OFF._replace(white=-4.0), **options)[:2]
        return [np.roll(plane, aside, axis=1)[surface] for plane in planes]

    for plane, elsewhere in zip(found(0), found(80), strict=True):
        np.testing.assert_allclose(plane, elsewhere, rtol=1e-5)
