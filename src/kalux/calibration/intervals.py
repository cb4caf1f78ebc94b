"""Pairs of successive frames with the events around them: what every calibration from a recording looks at."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.deblur import between
from kalux.events import EVENT_DTYPE, EventArray
from kalux.filters.methods import Shot, take_shot
from kalux.models.camera import Camera, log_intensity
from kalux.recording import Recording
from kalux.settings import CameraSettings, chosen_response

Array = NDArray[np.float64]

_WELL_EXPOSED: Final = (0.05, 0.95)  # of the response: away from black, noise and saturation


class Interval(NamedTuple):
    """From the middle of one exposure to that of the next.

    Attributes
    ----------
    start, end
        The two middles, us.
    change
        (H, W) difference of log(I + I_0).
    level
        (H, W) mean of I at both ends.
    usable
        (H, W) bool: valid and well exposed at both ends.
    events
        Those between ``start`` and ``end``, and those of the margin before and after.
    first, second
        The frames at both ends.
    """

    start: int
    end: int
    change: Array
    level: Array
    usable: NDArray[np.bool_]
    events: EventArray
    first: Shot
    second: Shot


def intervals(
    recording: Recording, camera: CameraSettings, *, margin: int, most_frames: int
) -> Iterator[Interval]:
    """The intervals between the first ``most_frames`` frames, with the events up to ``margin`` us around each."""
    response = chosen_response(camera.response, recording.response)
    model = Camera.named(response, camera.saturation)
    low, high = _WELL_EXPOSED
    chunks = iter(recording.events())
    buffer: EventArray = np.empty(0, EVENT_DTYPE)
    previous: tuple[Shot, NDArray[np.bool_]] | None = None
    reference = float(camera.reference_exposure or 0)
    for index, frame in enumerate(recording.frames()):
        if index == most_frames:
            return
        reference = reference or float(frame.exposure)
        shot = take_shot(frame, model, reference)
        level = frame.normalised()
        inside = (level > low) & (level < high)
        usable = np.asarray(inside.all(axis=-1) if inside.ndim == 3 else inside, np.bool_)
        if frame.valid is not None:
            usable &= frame.valid
        while len(buffer) == 0 or buffer["t"][-1] <= shot.middle + margin:
            chunk = next(chunks, None)
            if chunk is None:
                break
            if previous is None:  # only the margin before the first interval needs to be kept
                buffer = buffer[buffer["t"].searchsorted(shot.middle - margin, "right") :]
            buffer = np.concatenate([buffer, chunk])
        if previous is not None:
            before, was_usable = previous
            yield Interval(
                start=before.middle,
                end=shot.middle,
                change=log_intensity(shot.intensity, camera.offset)
                - log_intensity(before.intensity, camera.offset),
                level=(shot.intensity + before.intensity) / 2,
                usable=usable & was_usable,
                events=between(buffer, before.middle - margin, shot.middle + margin),
                first=before,
                second=shot,
            )
        buffer = buffer[buffer["t"].searchsorted(shot.middle - margin, "right") :]
        previous = shot, usable
