"""Percentiles against NumPy's."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kalux.display import SAMPLES
from kalux.display.percentiles import percentiles, sampled


@given(
    st.sampled_from([(1, 1), (2, 3), (40, 50), (300, 400), (513, 600)]),
    st.sampled_from(["spread", "one value", "few values", "black"]),
    st.lists(st.floats(0.0, 100.0), min_size=1, max_size=3),
)
def test_percentiles_are_numpys(shape, kind, percents):
    """Of a sample of a few pixels where there are many; also where all numbers are alike."""
    rng = np.random.default_rng(0)
    image = {
        "spread": np.exp(rng.normal(0, 3, shape)),
        "one value": np.full(shape, 0.7),
        "few values": rng.integers(0, 3, shape) / 2,
        "black": np.zeros(shape),
    }[kind].astype(np.float32)
    step = {(300, 400): 2, (513, 600): 4}.get(shape, 1)
    assert sampled(image).size >= min(image.size, SAMPLES)
    expected = np.percentile(image[::step, ::step].astype(np.float64), percents)
    np.testing.assert_allclose(percentiles(sampled(image), percents), expected, rtol=1e-6)
