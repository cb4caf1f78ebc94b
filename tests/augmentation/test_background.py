"""Which share of a pixel's events is signal."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.augmentation.background import doubt, signal_shares
from kalux.models.events import threshold_noise

SHAPE = (60, 80)
NONE = np.zeros(SHAPE, bool)  # are hidden


def noise(seed, expected, shape=SHAPE):
    """Events of background noise in an interval, of either polarity."""
    return np.random.default_rng(seed).poisson(expected / 2.0, (2, *shape)).astype(np.float32)


def bands(seed):
    """Events of edges that pass over a third of the image: up to five of one polarity a pixel."""
    events = np.random.default_rng(seed).integers(0, 6, (2, *SHAPE)).astype(np.float32)
    events[0, :, 14:] = events[1, :, :40] = events[1, :, 54:] = 0.0
    return events


@pytest.mark.parametrize("expected", [0.05, 0.15, 0.4])
def test_as_many_events_are_taken_for_noise_as_are_noise(expected):
    """Nobody is told which they are; the few pixels of a prior that believes events take a fifth at most."""
    own, of_edges = noise(1, expected), bands(2)
    counts = own + of_edges
    shares = np.array(signal_shares(*counts, expected, NONE))
    assert ((1.0 - shares) * counts).sum() == pytest.approx(own.sum(), rel=0.2)
    # Two pixels beside an edge nobody knows that it has ended.
    away = np.s_[0, :, 17:]
    assert shares[away][own[away] > 0].mean() < 0.15
    assert np.average(shares[0, :, 2:12], weights=of_edges[0, :, 2:12]) > 0.9


def test_without_noise_all_events_are_signal():
    for share in signal_shares(*bands(3), 0.0, NONE):
        np.testing.assert_array_equal(share, np.ones(SHAPE, np.float32))


def test_noise_alone_is_not_believed():
    counts = noise(4, 0.2)
    shares = np.array(signal_shares(*counts, 0.2, NONE))
    assert shares[counts > 0].mean() < 0.1


def test_what_no_frame_measures_is_counted_by_itself():
    """Half of the image is a clipped sky where nothing moves; below it many pixels have a single event of signal."""
    size = (120, 160)
    own = noise(7, 0.2, size)
    texture = np.random.default_rng(8).random((2, *size)) < 0.1
    texture[:, :60] = False
    counts = (own + texture).astype(np.float32)
    sky = np.zeros(size, bool)
    sky[:60] = True
    told, untold = (np.array(signal_shares(*counts, 0.2, hidden)) for hidden in (sky, np.zeros(size, bool)))
    inside, below = counts[:, :57] > 0, counts[:, 63:] > 0
    assert untold[:, :57][inside].mean() > 0.25
    assert told[:, :57][inside].mean() < 0.1
    # Half of the other events are signal, and nearer to that than without is what is believed.
    assert untold[:, 63:][below].mean() < 0.42
    assert told[:, 63:][below].mean() == pytest.approx(0.5, abs=0.05)


def test_a_few_hidden_pixels_are_as_all_others():
    counts = noise(9, 0.2) + bands(10)
    few = np.zeros(SHAPE, bool)
    few[30, 10:14] = True
    told, untold = (np.array(signal_shares(*counts, 0.2, hidden)) for hidden in (few, NONE))
    np.testing.assert_allclose(told[:, few], untold[:, few], atol=0.06)


def test_a_burst_has_no_more_noise_than_any_other_pixel():
    """Of 40 events of one pixel, at most those that noise makes everywhere."""
    counts = noise(5, 0.2)
    counts[0, 30, 40] = 40.0
    on, _ = signal_shares(*counts, 0.2, NONE)
    assert 1.0 - on[30, 40] == pytest.approx(0.1 / 40.0, rel=1e-4)


@given(seed=st.integers(0, 50), expected=st.floats(0.0, 3.0))
def test_shares_are_probabilities_that_know_no_direction(seed, expected):
    counts = np.round(noise(seed, 1.0, (9, 12)) * np.random.default_rng(seed).uniform(1.0, 6.0, (9, 12)), 2)
    hidden = np.random.default_rng(seed + 1).random((9, 12)) < 0.4
    on, off = signal_shares(*counts, expected, hidden)
    for share in (on, off):
        assert share.dtype == np.float32
        assert ((share >= 0.0) & (share <= 1.0)).all()
    # On and off, left and right, top and bottom may change places.
    other_off, other_on = signal_shares(
        counts[1, ::-1, ::-1], counts[0, ::-1, ::-1], expected, hidden[::-1, ::-1]
    )
    np.testing.assert_array_equal(on[::-1, ::-1], other_on)
    np.testing.assert_array_equal(off[::-1, ::-1], other_off)


def test_any_number_of_events_has_a_class():
    counts = np.full((2, 5, 6), 3e6, np.float32)
    on, _ = signal_shares(*counts, 0.3, np.zeros((5, 6), bool))
    assert on.min() > 0.999


def test_images_of_one_pixel_have_no_neighbours():
    """One pixel says nothing of what is usual: its event is noise as often as noise is expected."""
    on, _ = signal_shares(np.ones((1, 1)), np.zeros((1, 1)), 0.4, np.zeros((1, 1), bool))
    assert on[0, 0] == pytest.approx(0.8)


def test_doubt_by_hand():
    """A sure event has none; of an even chance half its own variance is left, and a coin's is added; noise has none."""
    shares = tuple(np.full((1, 1), f, np.float32) for f in (1.0, 0.5))
    on, off = doubt(shares, 0.2 * 0.04, 0.04)
    assert on[0, 0] == 0.0
    assert threshold_noise(0.2, 0.04, 1.0) + off[0, 0] == pytest.approx(0.5 * 0.2 * 0.04 + 0.25 * 0.04)
    none, _ = doubt((np.zeros((1, 1), np.float32),) * 2, 0.2 * 0.04, 0.04)
    assert threshold_noise(0.2, 0.04, 1.0) + none[0, 0] == pytest.approx(0.0, abs=1e-9)


def test_what_steps_vary_more_in_the_dark_counts_as_far_as_they_are_signal():
    shares = tuple(np.full((1, 2), f, np.float32) for f in (1.0, 0.5))
    dark = np.array([[0.0, 0.06]], np.float32)
    plain, more = doubt(shares, 0.2 * 0.04, 0.04), doubt(shares, 0.2 * 0.04, 0.04, dark)
    for without, with_dark, share in zip(plain, more, (1.0, 0.5), strict=True):
        np.testing.assert_allclose(with_dark - without, [[0.0, share * 0.06]], atol=1e-8)
