"""White balance from a recording: the gains that make its mean grey."""

from __future__ import annotations

from itertools import islice
from typing import Final

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.intervals import WELL_EXPOSED
from kalux.errors import FrameError
from kalux.frames import Frame
from kalux.models.camera import Camera
from kalux.models.colour import Gains, scaled_gains
from kalux.recording import Recording
from kalux.settings import CameraSettings

_MOST_FRAMES: Final = 60


def grey_world(recording: Recording, camera: CameraSettings) -> Gains:
    """Gains of red, green and blue by which the mean of well exposed pixels becomes grey (Buchsbaum 1980).

    Of the first 60 frames, the pixels (of mosaics the cells of 2x2) of which no channel is dark or near clipping.

    Raises
    ------
    FrameError
        If there is none.
    """
    model = Camera.named(camera.response, camera.clipped_from)
    total = np.zeros(3)
    for frame in islice(recording.frames(), _MOST_FRAMES):
        cells = _cells(frame)
        low, high = WELL_EXPOSED
        chosen = cells[((cells > low) & (cells < high)).all(axis=-1)]
        total += [
            model.of_channel(c).response.inverse(chosen[:, c]).sum() / frame.amplified_exposure
            for c in range(3)
        ]
    if not (total > 0).all():
        raise FrameError(
            f"{recording.source.path}: no pixel is well exposed in all colours; give white_balance as gains"
        )
    return scaled_gains(1 / total)


def _cells(frame: Frame) -> NDArray[np.float64]:
    """Responses of red, green and blue, (..., 3): of pixels, or of a mosaic's cells, green the mean of two.

    What is not valid is not a number.
    """
    values = frame.normalised()
    if frame.valid is not None:
        values[~frame.valid] = np.nan
    if frame.mosaic is None:
        return values
    height, width = (n - n % 2 for n in values.shape)
    cells = values[:height, :width].reshape(height // 2, 2, width // 2, 2).transpose(0, 2, 1, 3)
    four = cells.reshape(height // 2, width // 2, 4)
    return np.stack(
        [four[..., [i for i, c in enumerate(frame.mosaic) if c == colour]].mean(axis=-1) for colour in "RGB"],
        axis=-1,
    )
