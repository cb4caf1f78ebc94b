"""Blur consistency: does the reconstruction, integrated over an exposure, give the frame that was taken?

It needs no truth and holds nothing out. The frame is known to the method, so that a good value proves only that
images agree with their frames; a bad one tells of images whose motion, deblurring or brightness is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from typing import Final

import numpy as np

from kalux.errors import FrameError, require_type
from kalux.evaluation.exposures import (
    end_of_frames,
    exposure_times,
    linear_frame,
    means_of,
)
from kalux.evaluation.method import METHOD_NEEDED, Method
from kalux.evaluation.metrics import psnr
from kalux.frames import Frame
from kalux.recording import RECORDING_NEEDED, Recording, reference_exposure
from kalux.settings import AUTO, chosen_response

READS: Final = 9
"""Reads across an exposure."""


@dataclass(frozen=True)
class BlurConsistency:
    """How well integrated images agree with the frames.

    Attributes
    ----------
    method
        Label of the method.
    reads
        Images per exposure, from its start to its end.
    frames
        (t, pixels, PSNR in dB) of each frame with pixels that can be compared: its middle, us; how many are neither
        clipped nor black; data range: white.
    skipped
        Frames that are clipped or black everywhere.
    """

    method: str
    reads: int
    frames: tuple[tuple[int, int, float], ...]
    skipped: int

    @property
    def psnr(self) -> float:
        """Mean over the frames, dB."""
        return float(np.mean([decibel for _, _, decibel in self.frames]))

    @property
    def pixels(self) -> int:
        """How many pixels were compared, over all frames."""
        return sum(pixels for _, pixels, _ in self.frames)


def blur_consistency(
    recording: Recording,
    method: Method,
    *,
    response: str = AUTO,
    on_image: Callable[[], None] = lambda: None,
) -> BlurConsistency:
    """Integrate a method's images over every exposure but the first and the last, and compare them with the frames.

    Parameters
    ----------
    recording
        With known exposures.
    method
        From `kalux.evaluation.baselines`, or one's own.
    response
        Of the camera, as in `kalux.settings.CameraSettings`.
    on_image
        Called after every frame.

    Raises
    ------
    InputError
        If the recording or the method is something else.
    FrameError
        If there are fewer than three frames, or no pixel can be compared.
    KaluxError
        Whatever the method says.
    """
    require_type("blur_consistency: recording", recording, Recording, RECORDING_NEEDED)
    require_type("blur_consistency: method", method, Method, METHOD_NEEDED)
    reference = reference_exposure(recording)
    response = chosen_response(response, recording.response)
    inner = [exposure_times(frame, READS) for frame in recording.frames()][1:-1]
    if not inner:
        raise FrameError(f"{recording.source.path}: blur consistency needs at least three frames")
    end = end_of_frames(recording, response)
    made = method.estimated(recording, np.concatenate(inner))
    images = means_of((one.intensity for one in made), READS)
    found, skipped = [], 0
    frames = islice(recording.frames(), 1, 1 + len(inner))
    for image, frame in zip(images, frames, strict=True):
        valid = valid_pixels(frame, end.clipped_from)
        if valid.any():
            ratio = frame.amplified_exposure / reference
            taken = linear_frame(frame, frame.amplified_exposure, response)
            decibel = psnr(np.clip(image * ratio, 0, 1), taken, data_range=1.0, mask=valid)
            found.append((frame.middle, int(np.count_nonzero(valid)), decibel))
        else:
            skipped += 1
        on_image()
    if not found:
        raise FrameError(f"{recording.source.path}: all frames are clipped or black everywhere")
    return BlurConsistency(method.label, READS, tuple(found), skipped)


def valid_pixels(frame: Frame, clipped_from: float) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Where a frame is measured, and neither clipped (response, white = 1) nor black in any channel: (H, W) bool."""
    values = frame.normalised()
    inside = (values > 0) & (values < clipped_from)
    valid = inside.all(axis=-1) if inside.ndim == 3 else inside
    return np.asarray(valid if frame.valid is None else valid & frame.valid, np.bool_)
