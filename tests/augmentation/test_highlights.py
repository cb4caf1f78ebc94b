"""What pixels that leave saturation tell of those that no frame has shown yet."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.augmentation.bridge import UNMEASURED, UNSEEN, Latent
from kalux.augmentation.highlights import begin_unshown, expected_excess, follow_unshown

SIZE = (40, 48)


def latent(clipped, value=0.0):
    """A frame that shows ``value`` where it is not clipped, and its bound, 0, elsewhere."""
    level = np.where(clipped, 0.0, value).astype(np.float32)
    return Latent(level, np.where(clipped, UNMEASURED, 1e-3).astype(np.float32))


def excess_at(memory, prior=0.2):
    found = expected_excess(memory, np.ones(SIZE, np.float32), 1.0, prior)
    out = np.full(SIZE, np.nan)
    out.reshape(-1)[found.pixels] = found.excess
    return out


def test_where_nothing_is_clipped_nothing_is_expected():
    memory = begin_unshown(latent(np.zeros(SIZE, bool)))
    assert expected_excess(memory, np.ones(SIZE), 1.0, 0.2) is None


def test_masked_pixels_have_no_bound():
    first = latent(np.ones(SIZE, bool))
    first.variance[:, 5] = UNSEEN
    assert not np.isin(np.arange(40) * 48 + 5, begin_unshown(first).pixels).any()


def test_without_pixels_that_tell_the_prior_holds():
    memory = begin_unshown(latent(np.ones(SIZE, bool)))
    np.testing.assert_allclose(excess_at(memory, 0.37), 0.37, rtol=1e-6)


def test_pixels_around_tell_and_far_ones_do_not():
    """Half of a block leaves saturation by events of -1, and is measured at -0.4: it was 0.6 above its bound."""
    left = np.zeros(SIZE, bool)
    left[:16, :8] = True
    memory = begin_unshown(latent(np.ones(SIZE, bool)))
    memory = follow_unshown(memory, latent(~left, -0.4), np.where(left, np.float32(-1.0), np.float32(0.0)))
    found = excess_at(memory)
    np.testing.assert_array_equal(np.isnan(found), left)
    assert found[4, 8] == pytest.approx(0.6, abs=0.05)
    assert found[-1, -1] == pytest.approx(0.2, abs=1e-3)
    assert (np.diff(found[4, 8:]) <= 1e-6).all()


def test_the_mean_of_a_part_is_that_of_its_pixels_and_of_ten_of_the_prior():
    """Every part alike, so that only the sums matter: weights of parts around, 64 pixels that tell 0.5 each."""
    told = np.zeros(SIZE, bool)
    told[::2] = True
    memory = begin_unshown(latent(np.ones(SIZE, bool)))
    memory = follow_unshown(memory, latent(~told, -0.5), np.where(told, np.float32(-1.0), np.float32(0.0)))
    near = (
        np.exp(-0.5 * np.subtract.outer(np.arange(5), np.arange(5)) ** 2),
        np.exp(-0.5 * np.subtract.outer(np.arange(6), np.arange(6)) ** 2),
    )
    count = 32 * near[0].sum(0)[2] * near[1].sum(0)[3]
    assert excess_at(memory)[2 * 8 + 3, 3 * 8 + 3] == pytest.approx(
        (0.5 * count + 10 * 0.2) / (count + 10), rel=2e-3
    )


def test_a_bound_rises_with_events_and_never_falls_below_a_clipped_frame():
    """Up by 2 and down by 2: where a frame was clipped in between, the level was 0 at least, and 2 at the top."""
    one = np.zeros(SIZE, bool)
    one[0, 0] = True
    memory = begin_unshown(latent(one))
    step = np.zeros(SIZE, np.float32)
    step[0, 0] = -2.0
    memory = follow_unshown(memory, latent(one), step)
    assert memory.bound[0] == 0.0
    memory = follow_unshown(memory, latent(one), -step)
    assert memory.bound[0] == 2.0
    memory = follow_unshown(memory, latent(~np.ones(SIZE, bool), -1.0), 1.5 * step)
    assert len(memory.pixels) == 0
    assert (memory.told.sum(), memory.tellers.sum()) == (0.0, 1.0)  # -1, as its bound had said


def test_what_came_to_the_variance_is_noise():
    memory = begin_unshown(latent(np.ones(SIZE, bool)))
    variance = np.full(SIZE, 1.25, np.float32)
    variance[0, 0] = 0.5
    noise = expected_excess(memory, variance, 1.0, 0.2).noise
    assert (noise[0], noise[1]) == (0.0, 0.25)
