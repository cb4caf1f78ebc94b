"""An image and what it is compared with, and the checks that every metric makes of the two."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kalux.errors import FormatError, InputError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Pair(NamedTuple):
    """An image and what it is compared with.

    Attributes
    ----------
    t
        Of the reference, us.
    test, reference
        (H, W) linear intensity.
    mask
        (H, W) bool, True = compared; None: all.
    variance
        (H, W), what the method says of its log(intensity + log_offset); None: nothing.
    clipped
        (H, W) bool, True where the reference itself is clipped; None: nowhere.
    log_offset
        I_0 of the variance.
    given
        (H, W) bool, True where the method was given the reference itself, noise and all; None: nowhere.
    noise
        (H, W), variance of log(reference + log_offset) by the noise of the reference itself; None: it has none, or
        none that is known.
    """

    t: int
    test: NDArray[Any]
    reference: NDArray[Any]
    mask: NDArray[np.bool_] | None = None
    variance: NDArray[Any] | None = None
    clipped: NDArray[np.bool_] | None = None
    log_offset: float = 0.0
    noise: NDArray[Any] | None = None
    given: NDArray[np.bool_] | None = None


_LARGEST_WHOLE: Final = 16
"""Times white: images of whole numbers that are larger are levels of 8 or 16 bits, not intensities."""


def check_intensity(path: Path, images: NDArray[Any]) -> None:
    """Require real numbers of a file to be intensities, not levels.

    Raises
    ------
    FormatError
        If they are whole numbers far beyond white.
    """
    if images.dtype.kind in "iu" and images.size and images.max() > _LARGEST_WHOLE:
        raise FormatError(
            f"{path}: the images are {images.dtype}, up to {images.max()}; linear intensity is needed, 1 = a saturated "
            "pixel of a frame: floats"
        )


def checked_pair(
    test: ArrayLike, reference: ArrayLike, mask: ArrayLike | None = None
) -> tuple[Array, Array, Mask | None]:
    """Both images as float64, and the mask, once it is sure that they can be compared.

    Parameters
    ----------
    test, reference
        Real numbers of one shape.
    mask
        Boolean of the same shape, True = counted; what is not counted may hold anything.

    Raises
    ------
    InputError
        If shapes differ, nothing is counted, or a counted value is not finite.
    """
    first, second = _numbers(test, "test"), _numbers(reference, "reference")
    if first.shape != second.shape:
        raise InputError(f"test image {first.shape} and reference {second.shape} differ in shape")
    if first.size == 0:
        raise InputError(f"test image and reference are empty: shape {first.shape}")
    counted = None if mask is None else _checked_mask(mask, first.shape)
    check_none(~np.isfinite(first), "test", "not finite", counted)
    check_none(~np.isfinite(second), "reference", "not finite", counted)
    return first, second, counted


def check_none(bad: Mask, image: str, what: str, counted: Mask | None = None) -> None:
    """Raise an `InputError` with the number of counted pixels that are bad, if any."""
    within = bad if counted is None else bad & counted
    number = int(np.count_nonzero(within))
    if number:
        total = bad.size if counted is None else int(np.count_nonzero(counted))
        raise InputError(
            f"{image}: {number} of {total} values are {what}; mend them, or mask them where the metric takes a mask"
        )


def _numbers(image: ArrayLike, name: str) -> Array:
    if isinstance(image, np.ma.MaskedArray):
        raise InputError(
            f"{name}: a masked array; give its data, and mask=~numpy.ma.getmaskarray(...) where one is taken"
        )
    given = np.asarray(image)
    if given.dtype.kind not in "fiub":
        raise InputError(f"{name}: an image of real numbers is needed, not {given.dtype}")
    return given.astype(np.float64)


def _checked_mask(mask: ArrayLike, shape: tuple[int, ...]) -> Mask:
    given = np.asarray(mask)
    if given.dtype != bool:
        raise InputError(f"mask: booleans are needed (True = counted), not {given.dtype}")
    if given.shape != shape:
        raise InputError(f"mask {given.shape} and images {shape} differ in shape")
    if not given.any():
        raise InputError("mask: no pixel is counted")
    return given
