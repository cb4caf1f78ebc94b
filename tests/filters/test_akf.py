"""Equations of the filter that both of its forms use."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.filters import akf


@pytest.mark.parametrize("first", [1e-6, 1e-3, 1.0])
@pytest.mark.parametrize("ratio", [1 - 1e-9, 1.0, 1 + 1e-6, 1.00011, 0.5, 2.0, 100.0])
def test_integrals_of_a_linear_covariance(first, ratio):
    """int 1/R and its integral, against quadrature; the series near a constant R joins the logarithm."""
    single, double = akf.linear_covariance_integrals(first, first * ratio, 0.03)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    t = (nodes + 1) / 2
    w = weights / 2
    inner = 1 / (1 + (ratio - 1) * t)
    assert single == pytest.approx(0.03 / first * (w * inner).sum(), rel=1e-7)
    assert double == pytest.approx(0.03**2 / first * (w * inner * (1 - t)).sum(), rel=1e-7)
