"""Robust regression on counts, with and without errors of their own."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kalux.calibration.regression import (
    NORMAL_MAD,
    huber_weights,
    products,
    ratio_error,
    robust_deviation,
    standard_errors,
    two_stage,
    weighted_least_squares,
)

from builders import printed_on_threads


def counts(rng, n=2000):
    """ON and OFF events, the latter negative: what explains changes."""
    return rng.integers(0, 9, (n, 2)) * np.array([1.0, -1.0])


@given(on=st.floats(0.02, 1.0), off=st.floats(0.02, 1.0), seed=st.integers(0, 1000))
@example(on=0.6342572905823858, off=0.6342572905823858, seed=42)
@settings(max_examples=30)
def test_the_fit_is_exact_without_noise(on, off, seed):
    """Even where rounding leaves most residuals, and with them the robust scale, exactly zero."""
    explained = counts(np.random.default_rng(seed))
    found = two_stage(explained @ np.array([on, off]), explained, explained)
    assert found.solution == pytest.approx([on, off], rel=1e-9)
    assert found.residual <= 1e-9


@pytest.mark.parametrize("n", [1, 2, 9, 1000, 1001])
def test_the_robust_scale_is_by_the_median_as_numpy_has_it(n):
    """Odd or even, bit for bit."""
    residuals = np.random.default_rng(n).standard_normal(n)
    expected = NORMAL_MAD * np.median(np.abs(residuals))
    assert robust_deviation(residuals) == huber_weights(residuals)[1] == expected


def test_products_are_those_of_matrices():
    first, second = np.random.default_rng(4).standard_normal((2, 3, 50_000))
    assert products(first, second[:2]) == pytest.approx(first @ second[:2].T, rel=1e-9, abs=1e-9)


def test_weighted_least_squares_are_those_of_numpy():
    rng = np.random.default_rng(7)
    explained, values, weights = rng.standard_normal((1000, 3)), rng.standard_normal(1000), rng.random(1000)
    root = np.sqrt(weights)
    expected = np.linalg.lstsq(explained * root[:, None], values * root, rcond=None)[0]
    assert weighted_least_squares(values, explained, weights) == pytest.approx(expected, rel=1e-9)


_SOLVED = """
import numpy as np
from kalux.calibration.regression import weighted_least_squares
rng = np.random.default_rng(0)
explained, values, weights = rng.standard_normal((400_000, 3)), rng.standard_normal(400_000), rng.random(400_000)
print(weighted_least_squares(values, explained, weights).tobytes().hex())
"""


def test_the_last_bits_do_not_depend_on_the_number_of_threads():
    """Those of OpenBLAS do, of as many samples."""
    assert len(printed_on_threads(_SOLVED)) == 1


def test_the_fit_stands_a_fifth_of_outliers():
    """Huber's weights bound what an outlier can do; least squares is twice as far off and more."""
    rng = np.random.default_rng(1)
    explained, truth = counts(rng, 20_000), np.array([0.2, 0.3])
    values = explained @ truth + 0.05 * rng.standard_normal(20_000)
    wrong = rng.random(20_000) < 0.2
    values[wrong] = rng.uniform(-3, 3, int(wrong.sum()))
    found = two_stage(values, explained, explained).solution
    assert found == pytest.approx(truth, rel=0.06)
    plain = np.linalg.lstsq(explained, values, rcond=None)[0]
    assert (abs(found - truth) < 0.5 * abs(plain - truth)).all()


def test_the_residual_is_a_standard_deviation():
    rng = np.random.default_rng(2)
    explained = counts(rng, 20_000)
    values = explained @ np.array([0.2, 0.3]) + 0.05 * rng.standard_normal(20_000)
    assert two_stage(values, explained, explained).residual == pytest.approx(0.05, rel=0.03)


def test_no_fit_where_a_coefficient_is_not_determined():
    explained = counts(np.random.default_rng(3))
    values = explained @ np.array([0.2, 0.3])
    never, alike = explained * np.array([1.0, 0.0]), np.repeat(explained[:, :1], 2, axis=1)
    for indistinct in (never, alike):
        assert two_stage(values, indistinct, indistinct) is None


def test_instruments_do_not_mind_errors_of_the_counts():
    """With errors as large as the counts themselves least squares finds half of the coefficients."""
    rng = np.random.default_rng(4)
    truth = 3 * rng.standard_normal((50_000, 2))
    explained, instruments = (truth + 3 * rng.standard_normal(truth.shape) for _ in range(2))
    values = truth @ np.array([0.2, 0.3])
    assert two_stage(values, explained, instruments).solution == pytest.approx([0.2, 0.3], rel=0.05)
    assert two_stage(values, explained, explained).solution == pytest.approx([0.1, 0.15], rel=0.05)


def test_standard_errors_are_the_spread_of_repetitions():
    """Where parts of the sensor do not differ; with fewer than four parts nothing is known."""
    rng, shape, n = np.random.default_rng(5), (64, 64), 4_000
    found, errors = [], []
    for _ in range(40):
        explained = counts(rng, n)
        values = explained @ np.array([0.2, 0.3]) + 0.1 * rng.standard_normal(n)
        pixel = rng.integers(0, 64 * 64, n)
        fit = two_stage(values, explained, explained)
        found.append(fit.solution)
        errors.append(standard_errors(values, explained, explained, fit.weights, pixel, shape))
    assert np.mean(errors, axis=0) == pytest.approx(np.std(found, axis=0), rel=0.3)
    together = np.zeros(n, np.int64)
    assert not np.isfinite(standard_errors(values, explained, explained, fit.weights, together, shape)).any()


def test_weights_fall_beyond_some_standard_deviations():
    residuals = np.random.default_rng(6).standard_normal(10_001)
    weights, scale = huber_weights(residuals)
    assert scale == pytest.approx(1.0, rel=0.05)
    assert (weights[abs(residuals) < 1.2] == 1).all()
    assert weights[np.argmax(residuals)] == pytest.approx(1.345 * scale / residuals.max())


def test_the_error_of_a_ratio_is_the_spread_of_repetitions():
    """Parts that nothing is divided by do not make it infinite; one part alone does."""
    rng, found, errors = np.random.default_rng(8), [], []
    for _ in range(200):
        below = rng.uniform(1.0, 2.0, 50)
        sums = np.column_stack([3.0 * below + rng.standard_normal(50), below])
        found.append(sums[:, 0].sum() / below.sum())
        errors.append(ratio_error(np.vstack([sums, [0.0, 0.0]])))
    assert np.mean(errors) == pytest.approx(np.std(found), rel=0.15)
    assert ratio_error(sums[:1]) == np.inf


def test_the_error_of_a_ratio_is_that_of_the_jackknife():
    sums = np.array([[1.0, 2.0], [3.0, 4.0], [2.0, 5.0], [0.0, 1.0]])
    left = [np.divide(*np.delete(sums, i, axis=0).sum(axis=0)) for i in range(4)]
    assert ratio_error(sums) == pytest.approx(np.sqrt(3 / 4 * np.sum((left - np.mean(left)) ** 2)))
