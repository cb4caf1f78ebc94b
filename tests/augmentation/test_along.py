"""What frames show along the paths of what moves between them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalux.augmentation.along import (
    Along,
    Motion,
    as_seen,
    log_taken,
    put,
    put_intensity,
    taken,
    unmoved_difference,
)
from kalux.augmentation.bridge import UNMEASURED, Latent
from kalux.augmentation.resampling import readable
from textures import SHAPE, frame_of, texture, whole

import naive


def moving_right(first, second):
    """By 2 pixels, everywhere."""
    path = np.zeros((2, *SHAPE), np.float32)
    path[0] = 2.0
    return Motion(
        readable(first),
        readable(second),
        path,
        np.zeros_like(path),
        np.zeros_like(path[0]),
        unmoved_difference(first, second),
        0.04,
        ((slice(0, SHAPE[0]), slice(0, SHAPE[1])),),
    )


@given(
    seed=st.integers(0, 1000),
    share=st.sampled_from([0.0, 0.1, 0.25, 0.5, 0.75, 1.0]),
    moved=st.sampled_from([0, 1, 2.5]),
)
@settings(max_examples=20, deadline=None)
def test_it_is_the_oracle(seed, share, moved):
    """To what float32 leaves."""
    rng = np.random.default_rng(seed)
    shape = (14, 17)
    first, second = (texture(seed, x, shape=shape) for x in (0.0, moved))
    variances = rng.uniform(1e-4, 1e-2, (2, *shape)).astype(np.float32)
    variances[:, 3:5, 2:6] = UNMEASURED
    path, bend = rng.integers(-32, 33, (2, 2, *shape)).astype(np.float32) / 8
    level = texture(seed, moved / 2, shape=shape) + rng.normal(0, 0.05, shape).astype(np.float32)
    variance = rng.uniform(1e-4, 1e-2, shape).astype(np.float32)
    frames = Latent(first, variances[0]), Latent(second, variances[1])
    unmoved = naive.around((first.astype(float) - second) ** 2, 2).astype(np.float32)
    unsure = rng.uniform(0.0, 0.3, shape).astype(np.float32)
    windows = ((slice(0, 14), slice(0, 17)),)
    motion = Motion(*map(readable, frames), path, bend, unsure, unmoved, 0.04, windows)
    found = whole(Along(motion, share), level, variance)
    expected = naive.joined_along(
        *((frame.value.astype(float), frame.variance.astype(float)) for frame in frames),
        path,
        bend,
        unsure.astype(float),
        share,
        level.astype(float),
        variance.astype(float),
        0.04,
    )
    np.testing.assert_allclose(found[0], expected[0], atol=1e-5)
    np.testing.assert_allclose(found[1], expected[1], rtol=3e-4)


@pytest.mark.parametrize(
    ("share", "second"), [(0.0, 0.999), (0.25, 0.4375), (0.5, 0.5), (0.75, 0.5625), (1.0, 0.001)]
)
def test_at_a_frame_it_is_the_other_frame_that_tells_more(share, second):
    assert Along(moving_right(frame_of(texture(0)), frame_of(texture(0, 2.0))), share).weight == second


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.8, 1.0])
def test_nothing_is_seen_of_what_either_frame_does_not_measure(share):
    """At a frame, too, where the other one alone counts."""
    noise = np.random.default_rng(0).normal(0.0, 0.1, SHAPE).astype(np.float32)
    level = texture(0, 2 * share) + noise
    frames = [frame_of(texture(0, x)) for x in (0.0, 2.0)]
    clipped = [slice(32, 34), slice(60, 62)]  # of the image, at all shares
    for frame, columns in zip(frames, (slice(30, 34), slice(60, 64)), strict=True):
        frame.variance[30:34, columns] = UNMEASURED
    along = Along(moving_right(*frames), share)
    joined, left = whole(along, level, np.full(SHAPE, 0.01, np.float32))
    assert np.abs(joined - level + noise)[10:25, 10:80].mean() < 0.3 * np.abs(noise[10:25, 10:80]).mean()
    for columns in clipped:
        np.testing.assert_allclose(joined[30:34, columns], level[30:34, columns], atol=1e-6)
        np.testing.assert_allclose(left[30:34, columns], 0.01, rtol=1e-4)


@pytest.mark.parametrize("path", [0.0, 3e-16, 1e-15, 3e-15, -1e-15, 1e-7])
def test_a_variance_stays_positive_beside_what_no_frame_measures(path):
    """A path that ends next to nothing before a pixel takes no negative share of its neighbour."""
    frames = [frame_of(texture(0)) for _ in range(2)]
    for frame in frames:
        frame.variance[:, 1::2] = UNMEASURED
    motion = dataclasses.replace(moving_right(*frames), path=np.full((2, *SHAPE), path, np.float32))
    for share in (0.0, 0.3, 0.5, 1.0):
        joined, left = whole(Along(motion, share), texture(0), np.full(SHAPE, 0.01, np.float32))
        assert np.isfinite(joined).all()
        assert left.min() > 0


@pytest.mark.parametrize(
    "windows",
    [
        [(slice(0, 72), slice(0, 40)), (slice(0, 72), slice(40, 96))],
        [(slice(0, 71), slice(0, 96)), (slice(71, 72), slice(0, 95)), (slice(71, 72), slice(95, 96))],
        [(slice(0, 30), slice(0, 96)), (slice(30, 72), slice(0, 50)), (slice(30, 72), slice(50, 96))],
    ],
)
def test_windows_show_what_the_whole_image_does(windows):
    """To what the order of a sum leaves: every pixel sees its neighbours, in its window or not."""
    rng = np.random.default_rng(0)
    frames = [frame_of(texture(0, x)) for x in (0.0, 3.0)]
    path = np.zeros((2, *SHAPE), np.float32)
    path[0] = 3.0
    bend = rng.normal(0, 0.3, path.shape).astype(np.float32)
    unsure = rng.uniform(0.0, 0.3, SHAPE).astype(np.float32)
    level, variance = texture(0, 1.2), np.full(SHAPE, 1e-3, np.float32)
    readable_frames = [readable(frame) for frame in frames]
    all_of_it = (slice(0, 72), slice(0, 96))
    found = [
        whole(
            Along(
                Motion(*readable_frames, path, bend, unsure, unmoved_difference(*frames), 0.04, tuple(parts)),
                0.4,
            ),
            level,
            variance,
        )
        for parts in ([all_of_it], windows)
    ]
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


def test_a_bend_that_is_not_known_leaves_slopes_less_known():
    """Half-way only the variance tells of it, and at the frames nothing: there is no bend."""
    sure = moving_right(frame_of(texture(0)), frame_of(texture(0, 2.0)))
    unsure = dataclasses.replace(sure, unsure=np.full(SHAPE, 0.2, np.float32))
    variance = np.full(SHAPE, 0.01, np.float32)
    for share, differs in ((0.0, False), (0.5, True), (1.0, False)):
        level = texture(0, 2 * share)
        one, other = (whole(Along(motion, share), level, variance) for motion in (sure, unsure))
        np.testing.assert_array_equal(one[0], other[0])
        assert (other[1] >= one[1]).all()
        assert (other[1] > 1.5 * one[1]).mean() > 0.5 if differs else np.array_equal(one[1], other[1])


def test_even_frames_do_not_tell_that_a_path_is_right():
    """They agree along any: a hundredth of the image's variance is left, however well they are known."""
    even = Latent(np.full(SHAPE, -1.0, np.float32), np.full(SHAPE, 1e-7, np.float32))
    variance = np.full(SHAPE, 0.01, np.float32)
    level, left = whole(Along(moving_right(even, even), 0.5), np.full(SHAPE, -1.02, np.float32), variance)
    inside = np.s_[:, 4:-4]  # beside these one of the frames shows nothing
    np.testing.assert_allclose(left[inside], 0.01 * variance[inside], rtol=1e-6)
    np.testing.assert_allclose(level[inside], -1.0, atol=1e-4)


def test_windows_are_taken_with_their_margins_and_put_back_without():
    """Of two that lie beside each other the margins overlap, and end with the image."""
    image = np.arange(20 * 30, dtype=np.float32).reshape(20, 30)
    windows = (slice(0, 8), slice(10, 20)), (slice(8, 20), slice(10, 14))
    nothing = np.zeros((2, *image.shape), np.float32)
    along = Along(Motion(nothing, nothing, nothing, nothing, image, image, 0.04, windows), 0.5)
    values = taken(along, image)
    np.testing.assert_array_equal(values, np.concatenate([image[:12, 6:24].ravel(), image[4:, 6:18].ravel()]))
    found = -image
    put(along, found, values)
    expected = -image
    for window in windows:
        expected[window] = image[window]
    np.testing.assert_array_equal(found, expected)


def test_an_image_is_looked_along_by_its_log_intensity():
    image = np.geomspace(1e-4, 50.0, 20 * 30, dtype=np.float32).reshape(20, 30)
    nothing = np.zeros((2, *image.shape), np.float32)
    windows = ((slice(2, 18), slice(3, 20)),)
    along = Along(Motion(nothing, nothing, nothing, nothing, image, image, 0.04, windows), 0.5)
    level = log_taken(along, image, 0.01)
    np.testing.assert_allclose(level, np.log(taken(along, image).astype(np.float64) + 0.01), atol=1e-6)
    found = image.copy()
    put_intensity(along, found, level - 1.0, 0.01)
    expected = image.copy()
    expected[windows[0]] = np.maximum((image[windows[0]] + 0.01) / np.e - 0.01, 0.0)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)
    assert found.min() == 0.0


def test_a_black_pixel_measures_nothing_and_a_frame_may_be_in_float64():
    value, ceiling = np.zeros((3, 4)), np.full((3, 4), np.inf)
    ceiling[1, 2] = 0.5
    seen = as_seen(Latent(value, value + 0.1, ceiling))
    expected = np.full((3, 4), 0.1, np.float32)
    expected[1, 2] = UNMEASURED
    np.testing.assert_array_equal(seen.variance, expected)
    assert seen.value.dtype == seen.variance.dtype == np.float32
    assert seen.ceiling is None
