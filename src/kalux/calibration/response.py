"""The camera response function from images of one scene at several exposure times.

Debevec & Malik 1997 and Robertson et al. 2003, both as in OpenCV, give an irradiance for every level of the response.
It is made monotone and smooth, and judged by prediction: the radiance of every pixel is merged from all images but one,
and says what that one must show. The better of the two methods is taken.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.values import Calibration
from kalux.errors import FrameError, InputError, MissingDependencyError
from kalux.events import EventArray
from kalux.frames import Frame
from kalux.models.camera import Response
from kalux.recording import Recording

Array = NDArray[np.float64]
ImageArray = NDArray[np.uint8]
MethodName = Literal["debevec", "robertson"]

KNOTS: Final = 33
"""Of the curve: every eighth level of 8 bits. Finer steps of a measured curve are noise."""

_LEVELS: Final = 256
_GREY_SAMPLES: Final = 1_600  # pixels of Debevec's least squares, which has 256 unknowns besides
_SMOOTHNESS: Final = 60.0  # Debevec's lambda
_TRUSTED: Final = (4 / 255, 250 / 255)  # of the response: beyond, images say only that it is dark or clipped
_WIDTH: Final = 1.5  # of the smoothing, in knots
_LEAST_PIXELS: Final = 500
_MOST_PIXELS: Final = 40_000  # that the curve is fitted to; it is judged by all


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
        What the other method found, too: per curve, best first.
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
    images: Sequence[ImageArray], exposures: Sequence[float], *, per_channel: bool = False
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
    stack = aligned(np.stack([np.atleast_3d(images[i]) for i in order]))  # (K, H, W, C)
    if per_channel:
        channels = [stack[..., c] for c in range(stack.shape[-1])]
    else:
        channels = [np.concatenate([stack[..., c] for c in range(stack.shape[-1])], axis=2)]
    fits, residuals, left_out = [], [], []
    for channel in channels:
        flat = _flat_pixels(channel)
        strip = channel.reshape(len(times), 1, -1)
        _require_pixels(strip)
        methods: tuple[MethodName, ...] = ("debevec", "robertson")
        some = np.ascontiguousarray(strip[..., flat[:: max(1, len(flat) // _MOST_PIXELS)]])
        fitted = [fit for method in methods if (fit := _fitted(method, some, times)) is not None]
        if not fitted:
            raise InputError(
                "response: no curve fits the images; do they show one still scene, with these times?"
            )
        found = sorted(fitted, key=lambda fit: fit.residual)
        fits.append(tuple(found))
        best = Response.curve(found[0].knots)
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


def _fitted(method: MethodName, strip: ImageArray, times: Array) -> ResponseFit | None:
    """One method's curve; ``strip`` (K, H, W) uint8. None where it diverges."""
    if method == "debevec":
        table = _debevec(strip, times)
    else:
        images = [cv2.merge([image] * 3) for image in strip]  # OpenCV 5.0 crashes on one channel
        calibrator = cv2.createCalibrateRobertson(max_iter=60, threshold=0.001)
        table = np.asarray(calibrator.process(images, times.astype(np.float32)), np.float64).reshape(
            _LEVELS, -1
        )[:, 0]
    if np.count_nonzero(np.isfinite(table) & (table > 0)) < _LEVELS // 2:
        return None
    knots = smooth_knots(table, _level_counts(strip))
    response = Response.curve(knots)
    residual = float(np.sqrt(np.mean(prediction_residuals(response, strip, times) ** 2)))
    return ResponseFit(method, knots, residual)


def _debevec(strip: ImageArray, times: Array) -> Array:
    """OpenCV's Debevec on pixels chosen over the whole range of brightness, rather than on a grid of the image."""
    chosen = _spread_pixels(strip, _GREY_SAMPLES)
    side = int(np.sqrt(len(chosen)))
    images = [
        np.ascontiguousarray(image.ravel()[chosen[: side * side]].reshape(side, side)) for image in strip
    ]
    calibrator = cv2.createCalibrateDebevec(samples=side * side, lambda_=_SMOOTHNESS, random=False)
    table = calibrator.process(images, times.astype(np.float32))
    return np.asarray(table, np.float64).reshape(_LEVELS, -1)[:, 0]


def _spread_pixels(strip: ImageArray, count: int) -> NDArray[np.int64]:
    """Indices of pixels evenly over ranks of brightness, of those that are well exposed twice."""
    low, high = _TRUSTED
    flat = strip.reshape(len(strip), -1)
    good = np.flatnonzero(((flat > 255 * low) & (flat < 255 * high)).sum(axis=0) >= 2)
    ranked = good[np.argsort(flat[:, good].sum(axis=0, dtype=np.int64), kind="stable")]
    return ranked[np.linspace(0, len(ranked) - 1, min(count, len(ranked))).astype(np.int64)]


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


# --- where images come from -----------------------------------------------------------------------------------


def read_exposure(path: str | Path) -> float:
    """The exposure time of a photograph, s, from its EXIF.

    Where it holds the shutter speed as a power of two (APEX), that is taken: the exposure time beside it is rounded
    to what is customary, 1/30 s for 1/32 s.

    Raises
    ------
    MissingDependencyError
        If Pillow is not installed.
    InputError
        If the file cannot be read, or says no exposure time.
    """
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as error:
        raise MissingDependencyError(
            "exposure times of photographs are read by Pillow; pip install 'kalux[hdr]', or give --times"
        ) from error
    try:
        with Image.open(path) as image:
            exif = image.getexif().get_ifd(0x8769)
    except (OSError, UnidentifiedImageError) as error:
        raise InputError(f"{path}: cannot be read as a photograph: {error}") from error
    if 0x829A not in exif or not float(exif[0x829A]) > 0:
        raise InputError(f"{path}: its EXIF says no exposure time; give the times of all images (--times, s)")
    nominal = float(exif[0x829A])
    exact = 2.0 ** -float(exif.get(0x9201, -np.log2(nominal)))
    return exact if abs(exact / nominal - 1.0) < 0.1 else nominal


def read_image(path: str | Path) -> ImageArray:
    """An image of 8 bits: (H, W), or (H, W, 3) RGB.

    Raises
    ------
    InputError
        If it cannot be read, or has more than 8 bits.
    """
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(f"{path}: cannot be read as an image")
    if image.dtype != np.uint8:
        raise InputError(f"{path}: has {image.dtype} pixels; images of 8 bits are needed")
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGRA2RGB if image.shape[2] == 4 else cv2.COLOR_BGR2RGB)
    return np.asarray(image, np.uint8)


def still_pixels(recording: Recording, most_frames: int = 400) -> tuple[list[ImageArray], list[float]]:
    """Pixels of one recording under auto-exposure that see no events, as images at several exposure times.

    Looks for the longest run of frames that keeps enough pixels (2000) without an event in their 3x3
    neighbourhood, and takes one frame for each exposure time in it, in steps of at least 10 %.

    Returns
    -------
    (1, N) uint8 images, and exposure times, s.

    Raises
    ------
    InputError
        If no run has three exposure times, e.g. because the exposure is fixed.
    """
    frames = []
    for frame in recording.frames():
        frames.append(frame)
        if len(frames) == most_frames:
            break
    best: tuple[list[Frame], NDArray[np.bool_]] | None = None
    for run, still in _still_runs(recording, frames):
        chosen = _distinct(run)
        if best is None or len(chosen) > len(best[0]):
            best = chosen, still
    if best is None or len(best[0]) < 3:
        found = 0 if best is None else len(best[0])
        raise InputError(
            f"{recording.source.path}: still pixels are seen at {found} exposure times, three are needed; record a "
            "still scene while the exposure changes, or give images at several exposures"
        )
    images = [
        np.rint(255 * frame.normalised()[best[1]]).clip(0, 255).astype(np.uint8)[None] for frame in best[0]
    ]
    return images, [frame.exposure * 1e-6 for frame in best[0]]


_STILL_PIXELS: Final = 2_000


def _still_runs(recording: Recording, frames: list[Frame]) -> Iterator[tuple[list[Frame], NDArray[np.bool_]]]:
    """Runs of frames, from each that follows a run's end, with the pixels that stay still in them."""
    kernel = np.ones((3, 3), np.uint8)
    chunks = iter(recording.events())
    pending: list[EventArray] = []
    run: list[Frame] = []
    moved = np.zeros(recording.sensor_size, np.uint8)
    for frame in frames:
        seen = np.zeros(recording.sensor_size, np.uint8)
        while not pending or pending[-1]["t"][-1] <= frame.exposure_end:
            chunk = next(chunks, None)
            if chunk is None:
                break
            pending.append(chunk)
        start = run[-1].exposure_end if run else frame.exposure_start
        for chunk in pending:
            inside = chunk[
                chunk["t"].searchsorted(start) : chunk["t"].searchsorted(frame.exposure_end, "right")
            ]
            seen[inside["y"], inside["x"]] = 1
        pending = [chunk for chunk in pending if chunk["t"][-1] > frame.exposure_end]
        after = np.maximum(moved, cv2.dilate(seen, kernel))
        if run and np.count_nonzero(after == 0) < _STILL_PIXELS:
            yield run, moved == 0
            run, after = [], np.zeros_like(moved)
        run.append(frame)
        moved = after
    if run:
        yield run, moved == 0


def _distinct(run: list[Frame]) -> list[Frame]:
    """One frame per exposure time, in steps of at least 10 %."""
    chosen: list[Frame] = []
    for frame in sorted(run, key=lambda f: f.exposure):
        if not chosen or frame.exposure >= 1.1 * chosen[-1].exposure:
            chosen.append(frame)
    return chosen
