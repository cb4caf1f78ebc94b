"""Calibration of the uncertainty: against errors of a known distribution."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from kalux.evaluation.calibration import LEVELS, ONE_SIGMA, Calibration, Calibrations
from kalux.evaluation.pairs import Pair

OFFSET = 0.03


def drawn(stated: float = 1.0, size=(200, 300), seed=0):
    """Images whose log has Gaussian errors of varying size, ``stated`` times smaller or larger than they say."""
    rng = np.random.default_rng(seed)
    reference = rng.uniform(0.05, 3, size)
    sigma = rng.uniform(0.005, 0.02, size)
    test = np.exp(np.log(reference + OFFSET) + sigma * rng.standard_normal(size)) - OFFSET
    return test, reference, (stated * sigma) ** 2


def found(stated: float = 1.0):
    collected = Calibration(OFFSET)
    test, reference, variance = drawn(stated)
    for part in np.array_split(np.arange(len(test)), 3):  # several images
        collected.add(test[part], reference[part], variance[part], np.ones(test[part].shape, bool))
    return collected.found()


@pytest.mark.parametrize("stated", [0.3, 0.1, 1e-3])
def test_the_median_of_methods_that_are_far_too_sure(stated):
    """Half of the errors lie beyond the widest band of the coverage."""
    assert found(stated)["median_z"] == pytest.approx(1 / stated, rel=0.03)


@pytest.mark.parametrize("stated", [1.0, 0.5, 2.0])
def test_gaussian_errors_are_within_a_band_as_often_as_they_must_be(stated):
    got = found(stated)
    assert got["pixels"] == 60_000
    assert got["rms_z"] == pytest.approx(1 / stated, rel=0.01)
    assert got["one_sigma"] == pytest.approx(2 * stats.norm.cdf(stated) - 1, abs=0.006)
    assert got["median_z"] == pytest.approx(1 / stated, rel=0.03)
    widths = stats.norm.ppf((1 + LEVELS) / 2)
    expected = 2 * stats.norm.cdf(stated * widths) - 1
    assert got["coverage"]["observed"] == pytest.approx(expected, abs=0.008)
    assert got["coverage"]["nominal"][0] == 0.05


def test_the_error_of_a_class_of_pixels_is_its_sigma_if_calibrated():
    classes = found()["by_sigma"]
    assert classes["rms_error"] == pytest.approx(classes["sigma"], rel=0.25)
    assert sum(classes["pixels"]) > 59_000
    assert pytest.approx(0.6827, abs=1e-4) == ONE_SIGMA


def test_one_pixel_by_hand():
    collected = Calibration(0.5)
    collected.add(np.array([1.5]), np.array([0.5]), np.array([0.25]), np.array([True]))
    got = collected.found()
    assert got["rms_error"] == pytest.approx(np.log(2))
    assert got["rms_z"] == pytest.approx(np.log(2) / 0.5)
    assert got["one_sigma"] == 0


def test_variances_that_say_nothing_are_counted_and_left_out():
    collected = Calibration(OFFSET)
    variance = np.array([np.inf, np.nan, 0.0, -1.0, 0.01])
    collected.add(np.ones(5), np.ones(5), variance, np.array([True] * 5))
    assert (collected.found()["pixels"], collected.found()["unusable"]) == (1, 4)
    assert Calibration(OFFSET).found() is None


def test_masked_pixels_and_clipped_references_do_not_count_and_highlights_are_told_apart():
    test, reference, variance = drawn(size=(4, 5))
    mask, clipped = np.ones((4, 5), bool), np.zeros((4, 5), bool)
    mask[0], clipped[1] = False, True
    test[0] = np.nan
    collected = Calibrations()
    collected.add(Pair(0, test, reference, mask, variance, clipped, OFFSET))
    got = collected.found()
    assert got["log_offset"] == OFFSET
    assert got["all"]["pixels"] == 10
    bright = int(np.count_nonzero(reference[2:] > 1))
    assert 0 < bright < 10
    assert (got["beyond_white"]["pixels"], got["up_to_white"]["pixels"]) == (bright, 10 - bright)


def test_the_noise_of_the_reference_is_no_error_of_the_method():
    test, reference, variance = drawn()
    rng = np.random.default_rng(1)
    noise = np.full(variance.shape, 0.02**2)
    noisy = np.exp(np.log(reference + OFFSET) + 0.02 * rng.standard_normal(noise.shape)) - OFFSET
    told, untold = Calibrations(), Calibrations()
    told.add(Pair(0, test, noisy, None, variance, log_offset=OFFSET, noise=noise))
    untold.add(Pair(0, test, noisy, None, variance, log_offset=OFFSET))
    assert told.found()["all"]["rms_z"] == pytest.approx(1.0, rel=0.01)
    assert untold.found()["all"]["rms_z"] > 1.7


def test_a_few_large_errors_raise_the_rms_and_not_the_median():
    collected = Calibration(OFFSET)
    test, reference, variance = drawn()
    test[:2] *= 1.3
    collected.add(test, reference, variance, np.ones(test.shape, bool))
    assert collected.found()["rms_z"] > 2
    assert collected.found()["median_z"] == pytest.approx(1.0, rel=0.05)


def test_a_method_without_variances_has_no_calibration():
    collected = Calibrations()
    collected.add(Pair(0, np.ones((2, 2)), np.ones((2, 2))))
    assert collected.found() is None
