"""What evaluations do with frames: no black level, one scale for all exposures, reads spread over an exposure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.black_level import with_known_black
from kalux.evaluation.pairs import Array
from kalux.filters.shots import take_shot
from kalux.frames import Frame
from kalux.models.camera import Camera
from kalux.planning.levels import with_saturation
from kalux.recording import Recording
from kalux.settings import CameraSettings, EventSettings, altered, preset


def compared_recording(recording: Recording, response: str, black_level: float | None = None) -> Recording:
    """The recording as every method is to see it: its frames without the black level, so that intensities are compared.

    Parameters
    ----------
    recording
        With known exposures.
    response
        As of `linear_frame`.
    black_level
        A share of white. None: what is known already, else what events say (`kalux.calibration.black_level`).
    """
    camera = CameraSettings(response=response, black_level=black_level)
    return with_known_black(recording, camera, EventSettings())[0]


def of_black(recording: Recording) -> str:
    """What was taken off the frames that are compared, as the end of a sentence."""
    level = recording.black_level
    return f"; black level of {level:.3g} of white taken off all frames" if level else ""


def linear_frame(frame: Frame, reference: float, response: str) -> Array:
    """A frame's intensity, 1 = a saturated pixel at the reference exposure (us): (H, W) float64.

    Of a mosaic each pixel's own channel, of RGB the luminance: what images have as their intensity. ``response`` is the
    camera's, named as in `kalux.settings.CameraSettings`.
    """
    return take_shot(frame, Camera.named(response, CameraSettings.usual_saturation), reference).intensity


class End(NamedTuple):
    """Where frames end.

    Attributes
    ----------
    clipped_from
        Response, white = 1, from which on a pixel counts as clipped.
    intensity
        Of a pixel that is as bright as the camera can show, white = 1 at the frame's own exposure.
    """

    clipped_from: float
    intensity: float


def end_of_frames(recording: Recording, response: str) -> End:
    """Where a recording's frames end, as `kalux.reconstruct` takes it by default; ``response`` as of `linear_frame`."""
    levels = with_saturation(recording, altered(preset("default"), "camera", response=response))
    clipped_from, ceiling = levels.settings.camera.clipped_from, levels.ceiling
    curve = Camera.named(response, clipped_from).response
    return End(clipped_from, 1.0 if ceiling is None else float(curve.inverse(np.array(ceiling.level))))


def exposure_times(frame: Frame, reads: int) -> NDArray[np.int64]:
    """Times evenly over an exposure, from its start to its end: (reads,) us."""
    return (frame.exposure_start + np.linspace(0, 1, reads) * frame.exposure).astype(np.int64)


def means_of(images: Iterable[NDArray[np.float32]], reads: int) -> Iterator[Array]:
    """The mean of every ``reads`` images: what an exposure saw."""
    total, count = None, 0
    for image in images:  # added at once: a method may write the next image into the same array
        total = np.asarray(image, np.float64) + (0.0 if total is None else total)
        count += 1
        if count == reads:
            yield total / count
            total, count = None, 0
    if total is not None:
        yield total / count
