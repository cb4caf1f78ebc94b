"""How far an image is from a reference: pure functions of two images.

Nothing is clipped or scaled. A value that is not finite is an error that says how many there are: it is never dropped.
Where a metric takes a ``mask`` (True = counted), what is not counted may hold anything, NaN included, and does not
touch the result. Computed in float64.
"""

from __future__ import annotations

import importlib
from numbers import Real
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from kalux.errors import InputError, MissingDependencyError
from kalux.evaluation.pairs import Array, check_none, checked_pair

__all__ = ["log_mse", "mse", "psnr", "ssim", "ssim_released"]

_SSIM_SIGMA: Final = 1.5
SSIM_WINDOW: Final = 11
"""Pixels along a side of its windows."""

_K1: Final = 0.01
_K2: Final = 0.03


def mse(test: ArrayLike, reference: ArrayLike, *, mask: ArrayLike | None = None) -> float:
    """Mean squared error.

    Parameters
    ----------
    test, reference
        Images of one shape.
    mask
        Boolean of that shape, True = counted; all by default.

    Raises
    ------
    InputError
        If the images cannot be compared, or counted values are not finite.
    """
    first, second, counted = checked_pair(test, reference, mask)
    if counted is not None:
        first, second = first[counted], second[counted]
    return float(np.mean((first - second) ** 2))


def psnr(test: ArrayLike, reference: ArrayLike, *, data_range: float, mask: ArrayLike | None = None) -> float:
    """Peak signal-to-noise ratio, dB: 10 log10(data_range^2 / MSE); infinite for equal images.

    Parameters
    ----------
    test, reference, mask
        As in `mse`.
    data_range
        The largest value less the smallest that an image can hold. HDR has none of its own: state the one used.
    """
    peak = _checked_range(data_range)
    error = mse(test, reference, mask=mask)
    return float(10 * np.log10(peak**2 / error)) if error > 0 else float("inf")


def log_mse(
    test: ArrayLike, reference: ArrayLike, *, offset: float = 0.02, mask: ArrayLike | None = None
) -> float:
    """Mean squared error of log(I + offset), which weighs shadows like highlights.

    Parameters
    ----------
    test, reference, mask
        As in `mse`.
    offset
        Added before the logarithm; 0.02 of a saturated frame pixel is where kalux takes dark noise to begin.

    Raises
    ------
    InputError
        As in `mse`, and if a counted value plus the offset is not positive.
    """
    if not (isinstance(offset, Real) and np.isfinite(offset) and offset >= 0):
        raise InputError(f"offset is {offset!r}; a number of at least 0 is needed, e.g. 0.02")
    first, second, counted = checked_pair(test, reference, mask)
    if counted is not None:
        first, second = first[counted], second[counted]
    for image, name in ((first, "test"), (second, "reference")):
        check_none(image + offset <= 0, name, f"not above -{offset:g}, so without a logarithm")
    return float(np.mean(np.log((first + offset) / (second + offset)) ** 2))


def ssim(test: ArrayLike, reference: ArrayLike, *, data_range: float, mask: ArrayLike | None = None) -> float:
    """Structural similarity of Wang et al. [1]_, by scikit-image with the settings of the paper.

    Gaussian windows of 11 x 11 pixels with a standard deviation of 1.5 pixels, population covariance, mean over the
    windows that lie inside the image and, with a mask, hold counted pixels only.

    Parameters
    ----------
    test, reference
        (H, W) images of at least 11 x 11 pixels.
    data_range
        As in `psnr`.
    mask
        As in `mse`.

    Raises
    ------
    InputError
        As in `mse`, and if no whole window is counted.
    MissingDependencyError
        If scikit-image is not installed.

    References
    ----------
    .. [1] Z. Wang, A. C. Bovik, H. R. Sheikh, E. P. Simoncelli, "Image quality assessment: from error visibility to
       structural similarity", IEEE Transactions on Image Processing 13(4), 2004.
    """
    peak = _checked_range(data_range)
    first, second, counted = checked_pair(test, reference, mask)
    if first.ndim != 2 or min(first.shape) < SSIM_WINDOW:
        raise InputError(f"ssim: images (H, W) of at least 11 x 11 pixels are needed, not {first.shape}")
    if counted is None:
        counted = np.ones(first.shape, bool)
    whole = whole_windows(counted)
    if not whole.any():
        raise InputError("ssim: no window of 11 x 11 counted pixels")
    _, similarity = _skimage_metrics().structural_similarity(
        np.where(counted, first, 0),
        np.where(counted, second, 0),
        data_range=peak,
        gaussian_weights=True,
        sigma=_SSIM_SIGMA,
        use_sample_covariance=False,
        full=True,
    )
    return float(similarity[whole].mean())


def whole_windows(counted: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where the windows of `ssim` have their middles that hold counted pixels only: (H, W) bool."""
    return np.asarray(ndimage.binary_erosion(counted, np.ones((SSIM_WINDOW, SSIM_WINDOW))), np.bool_)


def ssim_released(test: ArrayLike, reference: ArrayLike, *, data_range: float) -> float:
    """What the authors' released evaluation calls SSIM; for comparison with Table 1 of the paper only.

    It is not a structural similarity: there are no windows. The means m of each image are taken per column, the
    variances s and the covariance over the whole image (n - 1 in the divisor), so that numerator and denominator ::

        a = (2 m_x m_y + C_1) (2 s_xy + C_2)        b = (m_x^2 + m_y^2 + C_1) (s_xx + s_yy + C_2)

    are rows of one number per column, and MATLAB's ``a / b`` of two rows is the least-squares solution of
    value * b = a, that is a.b / b.b. C_1 = (0.01 data_range)^2 and C_2 = (0.03 data_range)^2.

    Parameters
    ----------
    test, reference
        (H, W) images. The authors multiply reconstructions in [0, 1] by 255, give references in the same unit, and set
        the reconstruction to 0 where the reference is 0.
    data_range
        255 in the authors' evaluation.
    """
    peak = _checked_range(data_range)
    first, second, _ = checked_pair(test, reference)
    if first.ndim != 2 or first.size < 2:
        raise InputError(f"ssim_released: images (H, W) are needed, not {first.shape}")
    c1, c2 = (_K1 * peak) ** 2, (_K2 * peak) ** 2
    mean_x, mean_y = first.mean(axis=0), second.mean(axis=0)
    (s_xx, s_xy), (_, s_yy) = np.cov(first.ravel(), second.ravel())
    numerator = (2 * mean_x * mean_y + c1) * (2 * s_xy + c2)
    denominator: Array = (mean_x**2 + mean_y**2 + c1) * (s_xx + s_yy + c2)
    return float(numerator @ denominator / (denominator @ denominator))


def _checked_range(data_range: float) -> float:
    if not (isinstance(data_range, Real) and np.isfinite(data_range) and data_range > 0):
        raise InputError(
            f"data_range is {data_range!r}; a positive number is needed, e.g. the reference's range"
        )
    return float(data_range)


def _skimage_metrics() -> Any:
    try:
        return importlib.import_module("skimage.metrics")
    except ImportError as error:
        raise MissingDependencyError("ssim needs scikit-image; pip install 'kalux[evaluation]'") from error
