"""A reference image, registered to every frame of a recording of the same scene: ground truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.black_level import with_known_black
from kalux.calibration.homography import Features, find_features
from kalux.datasets.warping import match_features, refined, tone_compressed, warped, warped_mask
from kalux.errors import InputError
from kalux.frames import Frame, GroundTruth
from kalux.models.camera import Camera, Response, inverse_response
from kalux.models.colour import luminance as luminance_of
from kalux.recording import Recording, reference_exposure
from kalux.settings import AUTO, CameraSettings, EventSettings, chosen_response

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]


class RegisteredFrame(NamedTuple):
    """What became of a frame.

    Attributes
    ----------
    number, time
        Of the frame: from 0, and the middle of its exposure, us.
    matrix
        (3, 3), from the frame's pixels to the reference's; None: it could not be registered.
    inliers
        Features that agree.
    deviation
        Robust standard deviation between frame and reference, log intensity, where the frame is well exposed.
    scale
        What the reference must be multiplied by, so that 1 is a saturated pixel at the recording's median exposure.
    failure
        Why it is left out; empty if it is not.
    """

    number: int
    time: int
    matrix: Array | None
    inliers: int
    deviation: float
    scale: float
    failure: str


@dataclass(frozen=True, eq=False)
class RegisteredTruth:
    """A reference image in the pixels of the frames that it could be registered to.

    Attributes
    ----------
    frames
        All frames of the recording, also those that are left out.
    scale
        The one that the truth has: the median of the frames'.
    truth
        An image at the middle of every registered frame's exposure; linear, 1 = a saturated pixel at the median
        exposure; 0 where it is not valid.
    masks
        (T, H, W) bool: where it is valid.
    """

    frames: list[RegisteredFrame]
    scale: float
    truth: GroundTruth
    masks: NDArray[np.bool_]


class _Reference(NamedTuple):
    """The image that is registered: (H', W') linear luminance, and where it is valid."""

    luminance: NDArray[Any]
    valid: Mask


class _Seen(NamedTuple):
    """A frame as it is compared: (H, W) intensity, of RGB the luminance, and where it is measured and exposed well."""

    intensity: Array
    exposed: Mask

    @property
    def log_intensity(self) -> Array:
        """(H, W), with an offset."""
        return np.asarray(np.log(np.maximum(self.intensity, 0.0) + _LOG_OFFSET), np.float64)


_LOG_OFFSET: Final = 0.02  # white = 1; the noise of dark pixels must not be magnified by the logarithm
_EXPOSED: Final = (0.03, 0.96)  # of the frame's response
_LEAST_CORRELATION: Final = 0.7  # of log intensities: blur and noise lower it to 0.9, a wrong place below 0.5
_LEAST_MEASURED: Final = 0.02  # share of the frame's pixels that must be comparable
_SCALE_TOLERANCE: Final = 0.15  # relative; more is another exposure or another light


def register_frames(
    luminance: NDArray[Any],
    valid: Mask,
    recording: Recording,
    *,
    response: str = AUTO,
    blur: float = 0.0,
    on_frame: Callable[[], None] = lambda: None,
) -> RegisteredTruth:
    """Register a reference image to every frame, as in section 5 of the paper.

    The scene must be static and far away, or the camera only rotate: then a homography says it all.

    Parameters
    ----------
    luminance
        (H, W) linear, any scale: of any size, but showing all that the frames show.
    valid
        (H, W) bool.
    recording
        With known exposures. The black level of its frames is taken off, if it is known or events tell it.
    response
        Of its frame camera, as in `kalux.settings.CameraSettings`; by default what the recording states.
    blur
        Standard deviation, pixels of the frame, by which the frames' lens blurs more than the reference's; the size
        of the frame's pixels is accounted for without it.
    on_frame
        Called after every frame.

    Raises
    ------
    InputError
        If no frame can be registered, or each is of another brightness.
    """
    recording, _ = with_known_black(recording, CameraSettings(response=response), EventSettings())
    camera = Camera(Response.named(chosen_response(response, recording.response)))
    exposure = reference_exposure(recording)
    reference = _Reference(luminance, valid)
    found: list[RegisteredFrame] = []
    features: Features | None = None
    for index, frame in enumerate(recording.frames()):
        seen = _seen(frame, camera, exposure)
        known = [f.scale for f in found if not f.failure]
        if features is None or len(known) in (0, 1):  # once more when the scale is known
            features = _reference_features(reference, seen, known)
        guess = float(np.median(known)) if known else None
        found.append(_registered(reference, features, seen, guess, number=index, time=frame.middle))
        on_frame()
    _require_any(recording, found)
    scale = float(np.median([f.scale for f in found if not f.failure]))
    found = [_checked_scale(f, scale) for f in found]
    _require_any(recording, found)
    size = recording.sensor_size
    images, masks, times = [], [], []
    for placed in found:
        if placed.matrix is not None and not placed.failure:
            mask = warped_mask(valid, placed.matrix, size)
            image = warped(np.where(valid, luminance, 0.0), placed.matrix, size)
            image = _blurred(np.nan_to_num(image), mask, blur)
            images.append(np.where(mask, scale * image, 0.0).astype(np.float32))
            masks.append(mask)
            times.append(placed.time)
    truth = GroundTruth(np.array(times, np.int64), np.stack(images))
    return RegisteredTruth(found, scale, truth, np.stack(masks))


def _require_any(recording: Recording, found: list[RegisteredFrame]) -> None:
    reasons = {f.failure for f in found}
    if "" not in reasons:
        raise InputError(
            f"{recording.source.path}: the reference cannot be registered to any of {len(found)} frames "
            f"({'; '.join(sorted(reasons)[:3])}); do they show the same scene?"
        )


def _blurred(image: Image, mask: Mask, sigma: float) -> Image:
    """An image blurred, of its valid pixels only."""
    if sigma <= 0:
        return image
    weight = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), sigma)
    total = cv2.GaussianBlur(np.where(mask, image, 0).astype(np.float32), (0, 0), sigma)
    return np.asarray(total / np.maximum(weight, 1e-6), np.float32)


def _registered(
    reference: _Reference, features: Features, seen: _Seen, guess: float | None, *, number: int, time: int
) -> RegisteredFrame:
    """What becomes of a frame; ``guess`` is its scale, if that is about known."""

    def failed(why: str, inliers: int = 0) -> RegisteredFrame:
        return RegisteredFrame(number, time, None, inliers, np.inf, np.nan, why)

    if seen.exposed.mean() < _LEAST_MEASURED:
        return failed(f"{100 * seen.exposed.mean():.1f} % of its pixels are exposed well")
    scale = guess or _guessed_scale(reference, seen)
    size = (seen.exposed.shape[0], seen.exposed.shape[1])
    level = seen.log_intensity
    picture = tone_compressed(level, *_tone_range(level))
    match = match_features(find_features(picture, np.ones(size, bool)), features)
    if match.matrix is None:
        return failed(f"{match.inliers} of {match.matches} common features agree", match.inliers)
    matrix, deviation = match.matrix, np.inf
    for _ in range(2):  # the logarithm has an offset, so the scale must be right for the refinement to be
        scale = _fitted_scale(reference, seen, matrix) or scale
        relative = np.log(scale * reference.luminance + _LOG_OFFSET)
        matrix, deviation = refined(level, relative, seen.exposed, reference.valid, matrix)
    scale = _fitted_scale(reference, seen, matrix) or 0.0
    compared = seen.exposed & warped_mask(reference.valid, matrix, size)
    if not scale or compared.mean() < _LEAST_MEASURED:
        return failed("too little of it is both exposed well and in the reference", match.inliers)
    placed = np.log(scale * np.nan_to_num(warped(reference.luminance, matrix, size)) + _LOG_OFFSET)
    correlation = float(np.corrcoef(placed[compared], level[compared])[0, 1])
    if not correlation >= _LEAST_CORRELATION:
        return failed(f"correlates by {correlation:.2f} with the reference", match.inliers)
    return RegisteredFrame(number, time, matrix, match.inliers, deviation, scale, "")


def _seen(frame: Frame, camera: Camera, exposure: int) -> _Seen:
    """A frame at an exposure, us."""
    level = frame.normalised()
    intensity = inverse_response(camera, level, exposure / frame.amplified_exposure)
    exposed = (level > _EXPOSED[0]) & (level < _EXPOSED[1])
    if level.ndim == 3:
        intensity, exposed = luminance_of(intensity), np.asarray(exposed.all(axis=2))
    return _Seen(intensity, exposed if frame.valid is None else exposed & frame.valid)


def _reference_features(reference: _Reference, seen: _Seen, known_scales: list[float]) -> Features:
    """Features of the reference, shown with the tones of a frame."""
    scale = known_scales[0] if known_scales else _guessed_scale(reference, seen)
    tones = _tone_range(seen.log_intensity)
    shown = tone_compressed(np.log(scale * reference.luminance + _LOG_OFFSET), *tones)
    return find_features(shown, reference.valid)


def _guessed_scale(reference: _Reference, seen: _Seen) -> float:
    """Until it is known from a frame: both show the same scene, so their medians are alike."""
    median = np.median(reference.luminance[reference.valid])
    return float(max(np.median(seen.intensity), 1e-3) / max(median, 1e-12))


def _tone_range(seen: Array) -> tuple[float, float]:
    low, high = np.percentile(seen, (1, 99.5))
    return float(low), float(high)


def _fitted_scale(reference: _Reference, seen: _Seen, matrix: Array) -> float | None:
    """Median ratio of the frame's intensity to the reference's, where both are measured and not dark."""
    intensity = seen.intensity
    size = (intensity.shape[0], intensity.shape[1])
    image = np.nan_to_num(warped(reference.luminance, matrix, size).astype(np.float64))
    compared = seen.exposed & warped_mask(reference.valid, matrix, size) & (image > 0)
    if np.count_nonzero(compared) < 100:
        return None
    # The brighter half: noise and black level matter least there.
    compared &= intensity >= np.median(intensity[compared])
    return float(np.median(intensity[compared] / image[compared]))


def _checked_scale(frame: RegisteredFrame, scale: float) -> RegisteredFrame:
    if frame.failure or abs(frame.scale / scale - 1) <= _SCALE_TOLERANCE:
        return frame
    return frame._replace(failure=f"{frame.scale / scale:.2f} times as bright as the other frames")
