"""What an evaluation finds: scores per image, their means, and what was done to the images beforehand."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kalux.display import encode_srgb
from kalux.errors import InputError
from kalux.evaluation.calibration import Calibrations
from kalux.evaluation.hdr_vdp import hdrvdp
from kalux.evaluation.lpips import LpipsWeights
from kalux.evaluation.lpips import lpips as lpips_distance
from kalux.evaluation.metrics import SSIM_WINDOW, log_mse, mse, psnr, ssim, whole_windows
from kalux.evaluation.pairs import Array, Pair
from kalux.wording import how_many

LOG_OFFSET: Final = 0.02
"""Of the log-MSE, in units of white."""

DISPLAY_LUMINANCE: Final = 255.0
"""cd/m2 at which HDR-VDP is shown an intensity of 1, as in the paper's evaluation."""

METRICS: Final = ("mse", "psnr", "ssim", "log_mse", "q", "lpips")
UNCERTAINTY: Final = ("one_sigma", "rms_z", "median_z")
"""Of `kalux.evaluation.calibration.Calibration.found`: 0.683, 1 and 1 are calibrated and Gaussian."""


@dataclass(frozen=True)
class ImageScores:
    """One image against its reference.

    Attributes
    ----------
    t
        Time of the reference, us; the middle of a frame.
    pixels
        How many were compared.
    mse, psnr, ssim, log_mse
        As in `kalux.evaluation.metrics`; psnr in dB, log_mse of log(I + 0.02). ssim is None where a mask leaves no
        whole window.
    q
        HDR-VDP's Q; None where it was not asked for.
    lpips
        LPIPS of the pictures that sRGB's curve makes of intensity over the data range; None where it was not asked
        for.
    """

    t: int
    pixels: int
    mse: float
    psnr: float
    ssim: float | None
    log_mse: float
    q: float | None
    lpips: float | None = None


@dataclass(frozen=True)
class Scores:
    """A method's images against their references. The means are over images, of SSIM over those that have one.

    Attributes
    ----------
    method
        Label of the method.
    protocol
        What the images were compared with.
    images
        Scores of every image, in time order.
    data_range
        That of PSNR and SSIM, in units of the compared images.
    scale
        Images and references were both divided by this before they were compared.
    clipped
        Whether the images were clipped as the camera clips before they were compared.
    negative
        How many compared values of the method's images are below 0. They count as 0 in log-MSE, HDR-VDP and LPIPS.
    notes
        Of the method.
    calibration
        Whether its variances tell the truth, as `kalux.evaluation.calibration.Calibrations.found` says; None: there are
        none.
    """

    method: str
    protocol: str
    images: tuple[ImageScores, ...]
    data_range: float
    scale: float
    clipped: bool
    negative: int
    notes: tuple[str, ...] = ()
    calibration: Mapping[str, Any] | None = None

    @property
    def pixels(self) -> int:
        """How many pixels were compared, over all images."""
        return sum(image.pixels for image in self.images)

    @property
    def mse(self) -> float:
        """Mean of the images' MSE."""
        return self._mean("mse")

    @property
    def psnr(self) -> float:
        """Mean of the images' PSNR, dB."""
        return self._mean("psnr")

    @property
    def ssim(self) -> float | None:
        """Mean of the images' SSIM; None where none has one."""
        known = [image.ssim for image in self.images if image.ssim is not None]
        return float(np.mean(known)) if known else None

    @property
    def log_mse(self) -> float:
        """Mean of the images' log-MSE."""
        return self._mean("log_mse")

    @property
    def q(self) -> float | None:
        """Mean of the images' HDR-VDP Q; None where it was not asked for."""
        return None if self.images[0].q is None else self._mean("q")

    @property
    def lpips(self) -> float | None:
        """Mean of the images' LPIPS; None where it was not asked for."""
        return None if self.images[0].lpips is None else self._mean("lpips")

    def uncertainty(self) -> dict[str, float | None]:
        """Of all pixels with a variance: `UNCERTAINTY` by name; None where the method has none."""
        whole = None if self.calibration is None else self.calibration["all"]
        return {name: None if whole is None else whole[name] for name in UNCERTAINTY}

    def means(self) -> dict[str, float | None]:
        """All means by name."""
        return {name: getattr(self, name) for name in METRICS}

    def adjustments(self) -> list[str]:
        """What was done to the images, and what else the method says of itself, in words; empty: nothing."""
        done = []
        if self.scale != 1.0:
            done.append(f"intensities divided by {self.scale:.4g}")
        if self.clipped:
            done.append("the reconstruction clipped where the camera clips")
        lacking = sum(image.ssim is None for image in self.images)
        if lacking:
            done.append(
                f"SSIM without {how_many(lacking, 'image')} whose mask leaves no window of {SSIM_WINDOW} x "
                f"{SSIM_WINDOW} pixels"
            )
        if self.negative:
            done.append(f"{self.negative} negative values taken as 0 in log-MSE, HDR-VDP and LPIPS")
        return [*done, *self.notes]

    def _mean(self, name: str) -> float:
        return float(np.mean([getattr(image, name) for image in self.images]))


def score(
    pairs: Iterable[Pair],
    *,
    method: str,
    protocol: str,
    data_range: float,
    scale: float = 1.0,
    clipped: bool = False,
    notes: tuple[str, ...] = (),
    hdr_vdp: bool = False,
    lpips: LpipsWeights | None = None,
    on_image: Callable[[], None] = lambda: None,
) -> Scores:
    """Score every pair; ``on_image`` is called after each, ``lpips`` asks for LPIPS, the rest is as in `Scores`.

    Raises
    ------
    InputError
        If there are no pairs, or a pair cannot be compared; says which.
    MissingDependencyError
        If scikit-image is not installed.
    """
    images, negative, calibrations = [], 0, Calibrations()
    for pair in pairs:
        t, test, reference, mask, *_ = pair
        test, reference = np.asarray(test) / scale, np.asarray(reference) / scale
        try:
            images.append(
                score_image(t, test, reference, data_range, mask=mask, hdr_vdp=hdr_vdp, lpips=lpips)
            )
        except InputError as error:
            raise InputError(f"{method}, image at {t} us: {error}") from error
        calibrations.add(pair)
        negative += int(np.count_nonzero(test < 0 if mask is None else (test < 0) & mask))
        on_image()
    if not images:
        raise InputError(f"{method}: no images to compare")
    return Scores(
        method, protocol, tuple(images), data_range, scale, clipped, negative, notes, calibrations.found()
    )


def score_image(
    t: int,
    test: ArrayLike,
    reference: ArrayLike,
    data_range: float,
    *,
    mask: NDArray[np.bool_] | None = None,
    hdr_vdp: bool = False,
    lpips: LpipsWeights | None = None,
) -> ImageScores:
    """All metrics of one image; see `ImageScores`.

    HDR-VDP and LPIPS are shown the reference where pixels are not compared.
    """
    test, reference = np.asarray(test, np.float64), np.asarray(reference, np.float64)
    error = mse(test, reference, mask=mask)
    lit = np.maximum(test, 0.0)
    return ImageScores(
        t=t,
        pixels=test.size if mask is None else int(np.count_nonzero(mask)),
        mse=error,
        psnr=psnr(test, reference, data_range=data_range, mask=mask),
        ssim=_similarity(test, reference, data_range, mask),
        log_mse=log_mse(lit, reference, offset=LOG_OFFSET, mask=mask),
        q=None if not hdr_vdp else _quality(*_compared(lit, reference, mask)),
        lpips=None if lpips is None else _perceptual(*_compared(lit, reference, mask), data_range, lpips),
    )


def _compared(test: Array, reference: Array, mask: NDArray[np.bool_] | None) -> tuple[Array, Array]:
    """Both images, alike where nothing is compared."""
    if mask is None:
        return test, reference
    shown = np.where(mask, reference, 0.0)
    return np.where(mask, test, shown), shown


def _similarity(
    test: Array, reference: Array, data_range: float, mask: NDArray[np.bool_] | None
) -> float | None:
    if mask is not None and min(mask.shape) >= SSIM_WINDOW and mask.any() and not whole_windows(mask).any():
        return None
    return ssim(test, reference, data_range=data_range, mask=mask)


def _quality(test: Array, reference: Array) -> float:
    return hdrvdp(DISPLAY_LUMINANCE * test, DISPLAY_LUMINANCE * reference).Q


def _perceptual(test: Array, reference: Array, data_range: float, weights: LpipsWeights) -> float:
    pictures = (encode_srgb(np.maximum(i / data_range, 0.0).astype(np.float32)) for i in (test, reference))
    return lpips_distance(*pictures, data_range=1.0, weights=weights)


def finite_or_none(value: Any) -> Any:
    """Plain values for JSON, which has no infinity (PSNR of equal images) and no NaN: those are None."""
    if isinstance(value, dict):
        return {key: finite_or_none(part) for key, part in value.items()}
    if isinstance(value, list):
        return [finite_or_none(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def require_dependencies() -> None:
    """Find out before the work whether the metrics can be computed.

    Raises
    ------
    MissingDependencyError
        If scikit-image is not installed; names the extra.
    """
    blank = np.zeros((11, 11))
    ssim(blank, blank, data_range=1.0)
