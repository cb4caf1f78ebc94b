"""By how much neighbours differ, as frames show."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.augmentation.bridge import MASKED, UNMEASURED, Latent
from kalux.augmentation.parts import PART
from kalux.augmentation.texture import frame_texture, neighbour_variance, shown_texture

USUAL = 0.04


def latent(value, variance):
    value = np.asarray(value, np.float32)
    return Latent(value, np.broadcast_to(np.float32(variance), value.shape).copy())


def told(frame, pitch=1, events=1.0):
    return frame_texture(frame, np.full(frame.value.shape, events, np.float32), USUAL, pitch)


def found(*frames):
    return neighbour_variance([told(frame) for frame in frames], USUAL)


@given(
    st.integers(0, 2**32 - 1),
    st.tuples(st.integers(1, 20), st.integers(1, 20)),
    st.sampled_from([1, 2]),
)
def test_every_pair_of_neighbours_counts_once_in_the_part_of_its_upper_pixel(seed, shape, pitch):
    """And none of which one is not measured, or has had less than half an event."""
    rng = np.random.default_rng(seed)
    value, variance = rng.normal(0, 0.3, shape), rng.uniform(0, 0.1, shape)
    variance[rng.random(shape) < 0.2] = UNMEASURED
    frame = Latent(value.astype(np.float32), variance.astype(np.float32))
    events = rng.choice([0.4, 0.6, 1.0, 3.0], shape)
    excess, certainty = np.zeros((2, -(-shape[0] // PART), -(-shape[1] // PART)))
    for (row, column), (down, right) in itertools.product(
        np.ndindex(shape), ((0, 1), (1, -1), (1, 0), (1, 1))
    ):
        other, beside = row + pitch * down, column + pitch * right
        if other >= shape[0] or not 0 <= beside < shape[1]:
            continue
        explained = variance[row, column] + variance[other, beside]
        if explained >= UNMEASURED or min(events[row, column], events[other, beside]) < 0.5:
            continue
        distance2 = pitch**2 * (down**2 + right**2)
        weight = distance2 / (explained + distance2 * USUAL) ** 2
        part = row // PART, column // PART
        excess[part] += weight * ((value[other, beside] - value[row, column]) ** 2 - 0.7 * explained)
        certainty[part] += weight * distance2
    found = frame_texture(frame, events, USUAL, pitch)
    np.testing.assert_allclose(found.certainty, certainty, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found.excess, excess, rtol=1e-3, atol=2e-4 * (certainty.max() + 1))


@pytest.mark.parametrize("scale", [0.05, 0.1, 0.15])
def test_it_is_found_whatever_the_noise_of_the_frames(scale):
    """Of steps from row to row and from column to column that have nothing to do with one another; and noise of which
    neighbours have a part in common."""
    rng = np.random.default_rng(1)
    steps = rng.normal(0, scale, (2, 64))
    texture = np.add.outer(*steps.cumsum(axis=1))
    for noise in (0.0, 0.05, 0.1):
        own = (rng.normal(0, noise * 0.7**0.5, texture.shape) for _ in range(2))
        noisy = [latent(texture + part, noise**2) for part in own]
        assert found(*noisy).mean() == pytest.approx(np.mean(steps**2), rel=0.15)


def test_an_even_frame_has_the_least():
    assert found(latent(np.zeros((48, 48)), 0.0)) == pytest.approx(0.01 * USUAL)
    assert found(latent(np.zeros((48, 48)), 0.01)) == pytest.approx(0.01 * USUAL)


def test_neighbours_differ_by_no_more_than_usual():
    rough = np.random.default_rng(0).normal(0, 1.0, (24, 24))
    assert (found(latent(rough, 1e-4)) == np.float32(USUAL)).all()


def test_nothing_tells_of_frames_that_clip_all():
    assert found(latent(np.zeros((16, 16)), UNMEASURED)) == pytest.approx(USUAL)
    assert found(latent(np.zeros((16, 16)), MASKED)) == pytest.approx(USUAL)


def test_nothing_tells_where_nothing_moves():
    still = told(latent(np.zeros((16, 16)), 1e-4), events=0.4)
    assert neighbour_variance([still], USUAL) == pytest.approx(USUAL)


def test_pixels_that_a_frame_does_not_measure_differ_as_usual():
    even, clipped = latent(np.zeros((20, 30)), 1e-4), latent(np.zeros((20, 30)), 1e-4)
    clipped.variance[3, 4], clipped.variance[5, 6] = UNMEASURED, MASKED
    frames = even, clipped
    shown = shown_texture([told(frame) for frame in frames], frames, USUAL)
    assert shown.shape == (20, 30)
    lamps = np.zeros(shown.shape, bool)
    lamps[3, 4] = lamps[5, 6] = True
    assert (shown[lamps] == np.float32(USUAL)).all()
    # Half-way, as logarithms are, from 0.01 of it.
    np.testing.assert_allclose(shown[~lamps], 0.1 * USUAL, rtol=0.01)


def test_it_goes_from_part_to_part_in_a_straight_line():
    """Between the middles of two parts."""
    rng = np.random.default_rng(0)
    frame = latent(np.concatenate([np.zeros((96, 96)), rng.normal(0, 1, (96, 96))], axis=1), 1e-4)
    shown = shown_texture([told(frame)], [frame], USUAL)
    row = shown[48]
    assert row[8] == pytest.approx(0.1 * USUAL, rel=0.01)
    assert row[-8] == np.float32(USUAL)
    assert np.allclose(np.diff(row[4:-4], 2).reshape(-1)[:6], 0.0, atol=1e-6)
