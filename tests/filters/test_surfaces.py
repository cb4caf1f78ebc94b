"""Which pixels make up surfaces that no frame measures, and how rough these are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from kalux.augmentation.parts import PART, interpolated, part_grid, weighted_sums
from kalux.filters.surfaces import BLOCK, Unmeasured, rougher_where_bright, surface_of, surface_variance

from builders import unmeasured

SHAPES = [(21, 75), (16, 64), (17, 5)]


def patches(shape, seed=0):
    """A mask of surfaces with ragged borders and holes."""
    rng = np.random.default_rng(seed)
    return ndimage.gaussian_filter(rng.normal(size=shape), 2) + rng.normal(0.0, 0.03, shape) > 0.02


def test_single_pixels_are_no_surface():
    mask = np.zeros((40, 40), bool)
    mask[4:12, 4:12] = mask[30, 30] = True
    surface = unmeasured(mask).surface(None, 1)
    mask[30, 30] = False
    np.testing.assert_array_equal(surface.mask, mask)
    np.testing.assert_array_equal(surface.pixels, np.flatnonzero(mask))


def test_a_surface_is_found_once_for_all_images_between_two_frames():
    """As long as no frame has shown the same pixels, which do not belong to it, and neighbours are as far away."""
    mask = np.ones((16, 40), bool)
    pixels, unshown = unmeasured(mask), np.arange(3)
    found = pixels.surface(unshown, 1)
    assert pixels.surface(unshown.copy(), 1) is found
    np.testing.assert_array_equal(found.pixels, np.arange(3, mask.size))
    assert pixels.surface(unshown, 2) is not found
    np.testing.assert_array_equal(pixels.surface(None, 1).pixels, np.arange(mask.size))
    np.testing.assert_array_equal(pixels.surface(np.arange(1, 4), 1).pixels[:2], [0, 4])
    assert pixels.mask.all()


@pytest.mark.parametrize("pitch", [1, 2])
@pytest.mark.parametrize("shape", SHAPES)
def test_blocks_hold_all_that_means_of_a_surface_look_at(shape, pitch):
    surface = surface_of(np.flatnonzero(patches(shape)), shape, pitch)
    assert len(surface.pixels)
    around = ndimage.binary_dilation(surface.mask, np.ones((8 * pitch + 1,) * 2))
    own, seen = (
        np.add.reduceat(mask, np.arange(0, shape[1], BLOCK), axis=1) > 0 for mask in (surface.mask, around)
    )
    np.testing.assert_array_equal(surface.own, own)
    np.testing.assert_array_equal(surface.seen, seen)
    for row, block in np.argwhere(own):
        assert surface.compared[max(row - 4 * pitch, 0) : row + 1, block].all()


@pytest.mark.parametrize("pitch", [1, 2])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_surface_is_rough_by_what_its_neighbours_differ_beyond_their_noise(shape, pitch):
    """K12, pair by pair: each counts once, in the part of the first of its pixels that is on the surface."""
    rng = np.random.default_rng(1)
    level, variance = rng.normal(0.0, 0.3, shape), np.exp(rng.normal(-3.0, 1.0, shape))
    surface, usual = surface_of(np.flatnonzero(patches(shape)), shape, pitch), 0.04
    excess, certainty = np.zeros((2, *part_grid(shape)))
    for row, column in np.argwhere(surface.mask):
        for down, right in np.ndindex(3, 3):
            other = row + (down - 1) * pitch, column + (right - 1) * pitch
            if (down, right) == (1, 1) or not (0 <= other[0] < shape[0] and 0 <= other[1] < shape[1]):
                continue
            if surface.mask[other] and other < (row, column):
                continue
            distance2 = ((down - 1) ** 2 + (right - 1) ** 2) * pitch**2
            noise = variance[row, column] + variance[other]
            expected = noise + usual * distance2
            square = min((level[row, column] - level[other]) ** 2, 4 * expected)
            excess[row // PART, column // PART] += distance2 * (square - 0.7 * noise) / expected**2
            certainty[row // PART, column // PART] += distance2**2 / expected**2
    prior = 6 / usual**2
    found = (weighted_sums(excess) + prior * usual) / (weighted_sums(certainty) + prior)
    limited = np.clip(found, 0.01 * usual, 1.25**2 * usual).astype(np.float32)
    everywhere = interpolated(limited, np.arange(level.size), shape[1]).reshape(shape)
    near = ndimage.binary_dilation(surface.mask, np.ones((4 * pitch + 1,) * 2))
    expected = np.where(surface.mask, everywhere, np.where(near, (everywhere + usual) / 2, usual))
    rough = np.full(shape, np.nan, np.float32)
    planes = level.astype(np.float32), variance.astype(np.float32)
    surface_variance(*planes, surface, np.float32(usual), pitch, rough)
    seen = np.repeat(surface.seen, BLOCK, axis=1)[:, : shape[1]]
    np.testing.assert_allclose(rough[seen], expected[seen], rtol=1e-4)
    assert np.isnan(rough[~seen]).all()


@pytest.mark.parametrize("pitch", [1, 2])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("white", [-3.0, -1.5, 0.0])
def test_lamps_are_rough_by_the_median_around_a_pixel(shape, pitch, white):
    """By (1 + 0.4 (m - 2))^2, m from 2 to 4 beyond white; of a mosaic, of the pixels of one colour."""
    level = np.random.default_rng(2).normal(0.0, 1.0, shape).astype(np.float32)
    own = surface_of(np.flatnonzero(patches(shape)), shape, pitch).own
    medians = np.empty_like(level)
    for part in np.ndindex(pitch, pitch):
        of_colour = np.s_[part[0] :: pitch, part[1] :: pitch]
        medians[of_colour] = ndimage.median_filter(level[of_colour], 3, mode="nearest")
    expected = (1 + 0.4 * (np.clip(medians - white, 2.0, 4.0) - 2.0)) ** 2
    found = np.full(shape, np.nan, np.float32)
    rougher_where_bright(level, own, np.float32(white), pitch, found)
    filled = np.repeat(own, BLOCK, axis=1)[:, : shape[1]]
    np.testing.assert_allclose(found[filled], expected[filled], rtol=1e-5)
    assert np.isnan(found[~filled]).all()
    assert (found[filled] > 1.0).any() == (white < 0.0)


def test_pixels_are_known_by_their_places():
    pixels = Unmeasured(np.array([1, 5]), (2, 3))
    np.testing.assert_array_equal(pixels.mask, [[False, True, False], [False, False, True]])
