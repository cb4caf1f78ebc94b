"""The camera response function from images of one scene at several exposure times.

Debevec & Malik 1997 (`kalux.calibration.debevec`) and Robertson et al. 2003 (as in OpenCV, made monotone and smooth)
give an irradiance for every level of the response. They are judged by prediction: the radiance of every pixel is
merged from all images but one, and says what that one must show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.debevec import debevec_response
from kalux.calibration.values import Calibration
from kalux.errors import FrameError, InputError
from kalux.models.camera import Response

Array = NDArray[np.float64]
ImageArray = NDArray[np.uint8]
MethodName = Literal["debevec", "robertson"]
CalibrationName = Literal["auto", "debevec", "robertson"]

KNOTS: Final = 33
"""Of the curve: every eighth level of 8 bits. Finer steps of a measured curve are noise."""

_LEVELS: Final = 256
_TRUSTED: Final = (4 / 255, 250 / 255)  # of the response: beyond, images say only that it is dark or clipped
_WIDTH: Final = 1.5  # of the smoothing, in knots
_LEAST_PIXELS: Final = 500
_MOST_PIXELS: Final = 40_000  # that Robertson's curve is fitted to, and both are compared on


class ResponseFit(NamedTuple):
    """A curve of one method.

    Attributes
    ----------
    method
        Its name.
    knots
        (33,) irradiance at equally spaced levels of the response, from 0 to 1.
    residual
        Root mean square, in shares of full scale, of images predicted from the others.
    """

    method: MethodName
    knots: Array
    residual: float


@dataclass(frozen=True, eq=False)
class ResponseCalibration:
    """A measured camera response.

    Attributes
    ----------
    curves
        One for all channels, or one per channel.
    fits
        What the other method found, too: per curve, the preferred one first.
    residuals
        (images, curves) root mean square of each image predicted from the merged radiance, share of full scale.
    left_out
        The same from the radiance merged from all others.
    exposures
        (images,) s, increasing.
    """

    curves: tuple[Response, ...]
    fits: tuple[tuple[ResponseFit, ...], ...]
    residuals: Array
    left_out: Array
    exposures: Array

    @property
    def residual(self) -> float:
        """Root mean square over all images and curves, share of full scale."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def setting(self) -> str:
        """For `kalux.settings.CameraSettings.response`; of several channels separated by ``;``."""
        return ";".join(curve_text(fits[0].knots) for fits in self.fits)

    def calibration(self) -> Calibration:
        """As a setting, with the residual."""
        return Calibration(
            {"camera": {"response": self.setting}},
            {},
            {
                "residual_full_scale": self.residual,
                "left_out_full_scale": float(np.sqrt(np.mean(self.left_out**2))),
                "method": ", ".join(fits[0].method for fits in self.fits),
                "exposures": [float(t) for t in self.exposures],
            },
        )


def curve_text(knots: Array) -> str:
    """The setting that `Response.named` reads."""
    return "curve:" + " ".join(f"{value:.5g}" for value in knots)


def calibrate_response(
    images: Sequence[ImageArray],
    exposures: Sequence[float],
    *,
    per_channel: bool = False,
    method: CalibrationName = "auto",
) -> ResponseCalibration:
    """Measure the response from images of one still scene.

    Parameters
    ----------
    images
        (H, W) or (H, W, 3) uint8, all alike, at least three.
    exposures
        Their exposure times, s.
    per_channel
        One curve per colour channel; otherwise one for all, which is what most cameras have.
    method
        As of `fit_response`.

    Raises
    ------
    InputError, FrameError
        If there are fewer than three images or exposure times, or images differ in size or type, or too few pixels are
        well exposed twice.
    """
    times = np.asarray(exposures, np.float64)
    _check(images, times)
    order = np.argsort(times, kind="stable")
    times = times[order]
    stack = aligned(np.stack([np.atleast_3d(images[i]) for i in order.tolist()]))  # (K, H, W, C)
    if per_channel:
        channels = [stack[..., c] for c in range(stack.shape[-1])]
    else:
        channels = [side_by_side(stack)]
    fits, residuals, left_out = [], [], []
    for channel in channels:
        found = fit_response(channel, times, method)
        fits.append(found)
        best = Response.curve(found[0].knots)
        strip = channel.reshape(len(times), 1, -1)
        residuals.append(prediction_residuals(best, strip, times, leave_out=False))
        left_out.append(prediction_residuals(best, strip, times))
    curves = tuple(Response.curve(found[0].knots) for found in fits)
    return ResponseCalibration(
        curves, tuple(fits), np.stack(residuals, axis=1), np.stack(left_out, axis=1), times
    )


_SHIFT_BITS: Final = 3  # of whole pixels: shifts up to 7
_GREATEST_SHIFT: Final = 6


def aligned(stack: ImageArray) -> ImageArray:
    """Images (K, H, W, C), in order of exposure, shifted by whole pixels onto one another, and cut to what all show.

    By median threshold bitmaps (Ward 2003), each onto the next, from the middle outwards: a camera on a tripod moves
    when its button is pressed, and one pixel is 0.5 % of full scale in the residual. A shift of more than 6 pixels is
    not believed (images that are dark all over), and images of less than 64 pixels a side are left as they are.
    """
    count, height, width = stack.shape[:3]
    if min(height, width) < 64:
        return stack
    grey = [np.ascontiguousarray(image.mean(axis=-1).astype(np.uint8)) for image in stack]
    matcher = cv2.createAlignMTB(max_bits=_SHIFT_BITS)
    shifts = np.zeros((count, 2), np.int64)
    middle = count // 2
    for k, towards in [
        *((k, k - 1) for k in range(middle + 1, count)),
        *((k, k + 1) for k in range(middle)[::-1]),
    ]:
        found = np.array(matcher.calculateShift(grey[towards], grey[k]), np.int64)
        believed = found if np.abs(found).max() <= _GREATEST_SHIFT else np.zeros(2, np.int64)
        shifts[k] = shifts[towards] + believed
    most = int(np.abs(shifts).max())
    parts = [
        image[most - dy : height - most - dy, most - dx : width - most - dx]
        for image, (dx, dy) in zip(stack, shifts, strict=True)
    ]
    return np.stack(parts)


def _check(images: Sequence[ImageArray], times: Array) -> None:
    if len(images) != len(times):
        raise InputError(
            f"response: {len(images)} images and {len(times)} exposure times; one for each is needed"
        )
    if not (np.isfinite(times).all() and (times > 0).all()):
        raise InputError("response: exposure times must be positive, in s")
    if len(images) < 3 or len(np.unique(times)) < 3:
        raise InputError("response: images at three exposure times at least are needed")
    for index, image in enumerate(images):
        if image.dtype != np.uint8:
            raise FrameError(f"response: image {index} has dtype {image.dtype}; 8 bits (uint8) are needed")
        if image.shape != images[0].shape or image.ndim not in (2, 3):
            raise FrameError(
                f"response: image {index} is {image.shape}, the first {images[0].shape}; all must be alike"
            )


def _require_pixels(strip: ImageArray) -> None:
    low, high = _TRUSTED
    twice = int(np.count_nonzero(((strip > 255 * low) & (strip < 255 * high)).sum(axis=0) >= 2))
    if twice < _LEAST_PIXELS:
        raise InputError(
            f"response: {twice} pixels are well exposed in two images, {_LEAST_PIXELS} are needed; "
            "take images at exposure times nearer to one another"
        )


def _flat_pixels(images: ImageArray) -> NDArray[np.int64]:
    """Indices of the half of the pixels (H, W) whose neighbours differ least: the others move with the camera."""
    if min(images.shape[1:]) < 3:
        return np.arange(images[0].size)
    kernel = np.ones((3, 3), np.uint8)
    steepest = np.max([cv2.morphologyEx(image, cv2.MORPH_GRADIENT, kernel) for image in images], axis=0)
    return np.flatnonzero(steepest.ravel() <= np.median(steepest))


def side_by_side(stack: ImageArray) -> ImageArray:
    """Images (K, H, W, C) with their channels next to one another, (K, H, W C): one response for all."""
    return np.concatenate([stack[..., c] for c in range(stack.shape[-1])], axis=2)


def fit_response(
    images: ImageArray, times: Array, method: CalibrationName = "auto"
) -> tuple[ResponseFit, ...]:
    """The response by every method that succeeds, the preferred one first.

    Parameters
    ----------
    images
        (K, H, W) uint8 of one scene, in place, in order of exposure.
    times
        (K,) exposures, ascending, in any unit.
    method
        The only one to try. ``"auto"``: both; Debevec's is preferred unless Robertson's predicts images from one
        another with an error at least 10 % smaller. On simulated photographs the former's curve is the better one
        by far.

    Raises
    ------
    InputError
        If too few pixels are well exposed twice, or no curve fits.
    """
    _require_pixels(images)
    flat = _flat_pixels(images)
    strip = images.reshape(len(times), 1, -1)
    some = np.ascontiguousarray(strip[..., flat[:: max(1, len(flat) // _MOST_PIXELS)]])
    tables: list[tuple[MethodName, Array | None]] = []
    if method != "robertson":
        tables.append(("debevec", _debevec(strip[..., flat], times)))
    if method != "debevec":
        tables.append(("robertson", _robertson(some, times)))
    found: list[ResponseFit] = []
    for name, knots in tables:
        if knots is not None:
            left = prediction_residuals(Response.curve(knots), some, times)
            found.append(ResponseFit(name, knots, float(np.sqrt(np.mean(left**2)))))
    if not found:
        raise InputError(
            "response: no curve fits the images; do they show one still scene, with these times?"
        )
    return tuple(
        sorted(found, key=lambda fit: fit.residual * (_PREFERENCE if fit.method == "debevec" else 1.0))
    )


_PREFERENCE: Final = 0.9


def _debevec(strip: ImageArray, times: Array) -> Array | None:
    """33 knots; None where too little is exposed well in neighbouring images."""
    try:
        curve = debevec_response(list(strip), times.tolist())
    except InputError:
        return None
    knots = curve.inverse(np.linspace(0.0, 1.0, KNOTS))
    # The smallest step that the curve's text and its inverse keep apart.
    knots = np.maximum.accumulate(knots + np.arange(KNOTS) * 1e-7)
    return np.asarray((knots - knots[0]) / (knots[-1] - knots[0]))


def _robertson(strip: ImageArray, times: Array) -> Array | None:
    """33 knots; None where it diverges, or finds no curve that increases."""
    images = [cv2.merge([image] * 3) for image in strip]  # OpenCV 5.0 crashes on one channel
    calibrator = cv2.createCalibrateRobertson(max_iter=60, threshold=0.001)
    found = np.asarray(calibrator.process(images, times.astype(np.float32)), np.float64)
    table = found.reshape(_LEVELS, -1)[:, 0]
    if np.count_nonzero(np.isfinite(table) & (table > 0)) < _LEVELS // 2:
        return None
    knots = smooth_knots(table, _level_counts(strip))
    return knots if (np.diff(knots) > 0).all() else None


def _level_counts(strip: ImageArray) -> Array:
    return np.bincount(strip.ravel(), minlength=_LEVELS).astype(np.float64)


def smooth_knots(table: Array, counts: Array) -> Array:
    """A curve of 33 knots, increasing strictly from 0 to 1, near the irradiance of 256 levels.

    Parameters
    ----------
    table
        (256,) irradiance of every level, any scale.
    counts
        (256,) how often each level occurs: levels that hardly occur say little.
    """
    from scipy.optimize import isotonic_regression

    level = np.linspace(0.0, 1.0, _LEVELS)
    low, high = _TRUSTED
    inside = (level >= low) & (level <= high) & np.isfinite(table) & (table > 0)
    weights = 1.0 + np.minimum(counts, np.median(counts) + 1.0)
    rising = isotonic_regression(table[inside], weights=weights[inside]).x
    knots_at = np.linspace(0.0, 1.0, KNOTS)
    width = 1.0 / (KNOTS - 1)
    kernel = np.exp(-0.5 * ((knots_at[:, None] - level[inside]) / (_WIDTH * width)) ** 2) * weights[inside]
    values = np.array(
        [_local_line(k, level[inside], rising, w) for k, w in zip(knots_at, kernel, strict=True)]
    )
    values -= values[0]
    least = 1e-4 * values[-1] * width
    values = np.concatenate([[0.0], np.cumsum(np.maximum(np.diff(values), least))])
    return np.asarray(values / values[-1])


def _local_line(at: float, x: Array, y: Array, weight: Array) -> float:
    """Weighted straight line through (x, y), at ``at``: no bias at the ends, where data lie on one side only."""
    weight = weight + 1e-300
    mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
    slope = np.sum(weight * (x - mean_x) * (y - mean_y)) / max(np.sum(weight * (x - mean_x) ** 2), 1e-300)
    return float(mean_y + slope * (at - mean_x))


def prediction_residuals(
    response: Response, strip: NDArray[Any], times: Array, *, leave_out: bool = True
) -> Array:
    """How well images are predicted from the radiance merged from them: (K,) root mean square, share of full scale.

    The radiance of every pixel is merged from all images, weighted by certainty and exposure, where it is well exposed
    in them; the response at each exposure is compared with its image, clipped pixels included. With ``leave_out``
    the image itself is not among those that are merged. Pixels that none of these shows well exposed are left out.
    """
    low, high = _TRUSTED
    level = np.linspace(0.0, 1.0, _LEVELS)
    inverse = response.inverse(level)
    weight = np.where((level >= low) & (level <= high), response.weight(level) + 1e-3, 0.0)
    flat = strip.reshape(len(strip), -1)
    sums, totals = np.zeros(flat.shape), np.zeros(flat.shape)
    for k, t in enumerate(times):
        # Variance of irradiance / t is 1 / (weight t^2).
        sums[k] = weight[flat[k]] * inverse[flat[k]] * t
        totals[k] = weight[flat[k]] * t**2
    out = np.empty(len(times))
    for k, t in enumerate(times):
        total = totals.sum(axis=0) - leave_out * totals[k]
        known = total > 1e-6 * totals.max()
        radiance = (sums.sum(axis=0) - leave_out * sums[k])[known] / total[known]
        error = response(np.minimum(radiance * t, 1.0)) - flat[k, known] / 255
        out[k] = np.sqrt(np.mean(error**2)) if known.any() else 0.0
    return out
