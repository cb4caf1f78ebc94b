"""How the variance of errors of the moment grows in the dark, where pixels are slow (docs/equations.md, K11)."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.compiled import inner, larger, loop

LEVEL: Final = 0.02
"""Intensity, white = 1, at which it is stated: darker than most of a scene, and not yet the noise of frames."""

DARKEST: Final = 0.005
"""Below this intensity it grows no more: nothing tells it there."""


def lag_growth(intensity: NDArray[Any]) -> NDArray[np.float32]:
    """The variance at an intensity, in units of that at `LEVEL`: (0.02 / I)^1.5, at most 8.

    A photoreceptor's time constant goes by 1 / I, so that what a pixel lags behind light that changes steadily has a
    variance that goes by 1 / I^2, and less where the light turns before it has caught up. On four simulated scenes of a
    slow sensor it grows by 1.7 to 3.5 for each halving of the light.
    """
    growth = np.empty(intensity.shape, np.float32)
    _fill_growth(np.ascontiguousarray(intensity, np.float32).reshape(-1), growth.reshape(-1))
    return growth


@inner
def lag_growth_at(intensity):  # type: ignore[no-untyped-def]
    """`lag_growth` at one intensity, float32."""
    share = np.float32(LEVEL) / larger(intensity, np.float32(DARKEST))
    return share * np.sqrt(share)


@loop
def _fill_growth(intensity, growth):  # type: ignore[no-untyped-def]
    for i in range(np.uint64(len(growth))):
        growth[i] = lag_growth_at(intensity[i])
