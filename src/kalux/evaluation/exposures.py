"""What evaluations do with frames: one scale of intensity for all exposures, and reads spread over an exposure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FrameError
from kalux.evaluation.pairs import Array
from kalux.frames import Frame
from kalux.models.camera import Camera, Response, inverse_response
from kalux.recording import Recording


def reference_exposure(recording: Recording) -> int:
    """The exposure, us, at which a saturated pixel is 1: the median, as `kalux.reconstruct` takes it.

    Raises
    ------
    FrameError
        If the recording has no frames.
    """
    exposures = [frame.exposure for frame in recording.frames()]
    if not exposures:
        raise FrameError(f"{recording.source.path}: no frames; an evaluation needs frames")
    return round(float(np.median(exposures)))


def linear_frame(frame: Frame, reference: int, response: str) -> Array:
    """A frame's intensity, 1 = a saturated pixel at the reference exposure (us): (H, W) float64.

    ``response`` is the camera's, named as in `kalux.settings.CameraSettings`.
    """
    camera = Camera(Response.named(response))
    return inverse_response(camera, frame.normalised(), reference / frame.exposure)


def exposure_times(frame: Frame, reads: int) -> NDArray[np.int64]:
    """Times evenly over an exposure, from its start to its end: (reads,) us."""
    return (frame.exposure_start + np.linspace(0, 1, reads) * frame.exposure).astype(np.int64)


def means_of(images: Iterable[NDArray[np.float32]], reads: int) -> Iterator[Array]:
    """The mean of every ``reads`` images: what an exposure saw."""
    remaining = iter(images)
    while group := list(islice(remaining, reads)):
        yield np.mean(group, axis=0, dtype=np.float64)
