"""Metrics against their formulas and against scikit-image."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from kalux.errors import InputError, MissingDependencyError
from kalux.evaluation import log_mse, mse, psnr, ssim, ssim_released

MASKED = [
    pytest.param(mse, {}, id="mse"),
    pytest.param(psnr, {"data_range": 1.0}, id="psnr"),
    pytest.param(log_mse, {}, id="log_mse"),
    pytest.param(ssim, {"data_range": 1.0}, id="ssim"),
]
ALL = [*MASKED, pytest.param(ssim_released, {"data_range": 1.0}, id="ssim_released")]


@pytest.fixture
def pair():
    rng = np.random.default_rng(3)
    reference = rng.random((40, 52))
    return reference + rng.normal(0, 0.1, reference.shape).clip(-reference, None), reference


def test_values_by_hand():
    test, reference = np.array([[1.0, 2.0], [0.0, 4.0]]), np.array([[1.0, 0.0], [0.0, 1.0]])
    assert mse(test, reference) == 13 / 4
    assert psnr(test, reference, data_range=10) == pytest.approx(10 * np.log10(100 / 3.25))
    expected = (np.log(2.5 / 0.5) ** 2 + np.log(4.5 / 1.5) ** 2) / 4
    assert log_mse(test, reference, offset=0.5) == pytest.approx(expected)


def test_ssim_is_that_of_scikit_image(pair):
    metrics = pytest.importorskip("skimage.metrics")
    expected = metrics.structural_similarity(
        *pair, data_range=1.7, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    assert ssim(*pair, data_range=1.7) == pytest.approx(expected, rel=1e-12)


def test_the_released_ssim_is_a_least_squares_quotient(pair):
    x, y = (255 * image for image in pair)
    c1, c2 = 2.55**2, 7.65**2
    covariance = ((x - x.mean()) * (y - y.mean())).sum() / (x.size - 1)
    a = (2 * x.mean(0) * y.mean(0) + c1) * (2 * covariance + c2)
    b = (x.mean(0) ** 2 + y.mean(0) ** 2 + c1) * (x.var(ddof=1) + y.var(ddof=1) + c2)
    value = np.linalg.lstsq(b[:, None], a, rcond=None)[0][0]
    assert ssim_released(x, y, data_range=255) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(("metric", "options"), ALL)
def test_equal_images(metric, options, pair):
    best = {"mse": 0.0, "log_mse": 0.0, "psnr": np.inf, "ssim": 1.0, "ssim_released": 1.0}[metric.__name__]
    assert metric(pair[1], pair[1], **options) == pytest.approx(best, abs=1e-12)


@pytest.mark.parametrize(("metric", "options"), ALL)
def test_symmetry(metric, options, pair):
    assert metric(*pair, **options) == pytest.approx(metric(*pair[::-1], **options), rel=1e-9)


@pytest.mark.parametrize(("metric", "options"), MASKED)
def test_a_full_mask_changes_nothing(metric, options, pair):
    whole = np.ones(pair[0].shape, bool)
    assert metric(*pair, mask=whole, **options) == metric(*pair, **options)


@pytest.mark.parametrize(("metric", "options"), MASKED)
def test_what_is_masked_does_not_count(metric, options, pair):
    test, reference = pair
    mask = np.ones(test.shape, bool)
    mask[:, 30:] = False
    other = np.where(mask, test, np.nan)
    found = metric(other, reference, mask=mask, **options)
    assert found == pytest.approx(metric(test[:, :30], reference[:, :30], **options), rel=1e-12)


@pytest.mark.parametrize(("metric", "options"), ALL)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_counted(metric, options, value, pair):
    test, reference = pair
    test[4, 5:9] = value
    with pytest.raises(InputError, match=r"test: 4 of 2080 values are not finite"):
        metric(test, reference, **options)
    with pytest.raises(InputError, match=r"reference: 4 of 2080 values are not finite"):
        metric(reference, test, **options)


@pytest.mark.parametrize(("metric", "options"), ALL)
def test_nothing_is_clipped_or_scaled(metric, options, pair):
    test, reference = pair
    test[7, 7] += 100
    assert metric(test, reference, **options) != pytest.approx(metric(test.clip(0, 1), reference, **options))


@pytest.mark.parametrize(("metric", "options"), ALL)
def test_shapes_and_types(metric, options, pair):
    test, reference = pair
    with pytest.raises(InputError, match="differ in shape"):
        metric(test, reference[:, 1:], **options)
    with pytest.raises(InputError, match="empty"):
        metric(test[:0], reference[:0], **options)
    with pytest.raises(InputError, match="real numbers"):
        metric(test.astype(complex), reference, **options)
    whole = [(255 * image.clip(0, 1)).astype(np.uint8) for image in pair]
    of_floats = metric(*(image.astype(np.float64) for image in whole), **options)
    assert metric(*whole, **options) == pytest.approx(of_floats, rel=1e-6)


@pytest.mark.parametrize(("metric", "options"), ALL)
def test_a_masked_array_is_refused(metric, options, pair):
    """What it hides would be counted."""
    for images in ((np.ma.masked_less(pair[0], 0.5), pair[1]), (pair[0], np.ma.array(pair[1]))):
        with pytest.raises(InputError, match="a masked array; give its data, and mask="):
            metric(*images, **options)


@pytest.mark.parametrize(("metric", "options"), MASKED)
def test_masks_are_checked(metric, options, pair):
    whole = np.ones(pair[0].shape, bool)
    with pytest.raises(InputError, match="booleans"):
        metric(*pair, mask=whole.astype(int), **options)
    with pytest.raises(InputError, match="differ in shape"):
        metric(*pair, mask=whole[1:], **options)
    with pytest.raises(InputError, match="no pixel is counted"):
        metric(*pair, mask=~whole, **options)


def test_ssim_needs_a_whole_window(pair):
    mask = np.zeros(pair[0].shape, bool)
    mask[:10, :] = True
    with pytest.raises(InputError, match="no window"):
        ssim(*pair, data_range=1.0, mask=mask)
    with pytest.raises(InputError, match="11 x 11"):
        ssim(pair[0][:10], pair[1][:10], data_range=1.0)


@pytest.mark.parametrize("metric", [psnr, ssim, ssim_released])
def test_the_data_range_must_be_given_and_positive(metric, pair):
    with pytest.raises(TypeError, match="data_range"):
        metric(*pair)
    for bad in (0, -1, np.nan, None, "1"):
        with pytest.raises(InputError, match="data_range"):
            metric(*pair, data_range=bad)


def test_log_mse_needs_a_logarithm(pair):
    test, reference = pair
    test[0, :2] = -0.5
    with pytest.raises(InputError, match=r"test: 2 of 2080 values are not above -0.02"):
        log_mse(test, reference)
    with pytest.raises(InputError, match="offset"):
        log_mse(*pair, offset=-1)
    with pytest.raises(InputError, match="offset is None"):
        log_mse(*pair, offset=None)


def test_ssim_names_the_extra_that_brings_scikit_image(pair, monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage.metrics", None)
    with pytest.raises(MissingDependencyError, match=r"kalux\[evaluation\]"):
        ssim(*pair, data_range=1.0)
