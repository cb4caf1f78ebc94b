"""Pictures of calibrations; matplotlib is imported only here, and only when one is made."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from typing import Final

import numpy as np

from kalux.errors import MissingDependencyError
from kalux.models.camera import Response


def require_matplotlib() -> None:
    """Find out before the work whether pictures can be made.

    Raises
    ------
    MissingDependencyError
        If matplotlib is not installed; names the extra.
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError("pictures need matplotlib; pip install 'kalux[plots]'") from error


_FLOOR: Final = 0.02
"""Least f^w, which caps the covariance shown."""


def response_figure(curves: Sequence[Response]) -> bytes:
    """A PNG like Figure 2 of the paper: response, certainty (4), weighting (5), and covariance (6) with sigma_im = 1.

    Parameters
    ----------
    curves
        One, or one per colour channel (red, green, blue).

    Raises
    ------
    MissingDependencyError
        If matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    colours = ["black"] if len(curves) == 1 else ["tab:red", "tab:green", "tab:blue"]
    figure = Figure(figsize=(10, 7), layout="constrained")
    axes = figure.subplots(2, 2)
    level = np.linspace(0, 1, 256)
    for curve, colour in zip(curves, colours, strict=False):
        irradiance = curve.inverse(level)
        axes[0, 0].plot(irradiance, level, color=colour)
        axes[0, 1].plot(level, curve.certainty(level), color=colour)
        axes[1, 0].plot(level, curve.weight(level), color=colour)
        axes[1, 1].plot(level, 1 / np.maximum(curve.weight(level), _FLOOR), color=colour)
    texts = (
        ("response (3)", "irradiance", "response"),
        ("certainty (4)", "irradiance", "f^c"),
        ("weighting (5)", "response", "f^w"),
        ("covariance (6), sigma_im = 1", "response", "R_bar"),
    )
    for axis, (title, x, y) in zip(axes.ravel(), texts, strict=True):
        axis.set(title=title, xlabel=x, ylabel=y, xlim=(0, 1))
        axis.grid(alpha=0.3)
    out = BytesIO()
    figure.savefig(out, format="png", dpi=100, metadata={"Software": None})
    return out.getvalue()
