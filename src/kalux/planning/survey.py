"""What one pass over all frames tells: their exposures, how bright pixels thin out, and which frames are faulty."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.frame_faults import FrameFaults, FrameWatch, find_frame_faults
from kalux.models.camera import BrightTail, Camera, count_bright
from kalux.models.colour import white_balance
from kalux.recording import Recording, no_frames
from kalux.settings import Settings, chosen_response


class Survey(NamedTuple):
    """All frames of a recording.

    Attributes
    ----------
    exposures
        (K, 2) int64 starts and ends of their exposures, us.
    tail
        How their bright pixels thin out towards white; None where it is not asked for.
    faults
        Frames that are not what they say, and stuck pixels; None: none, or not looked for.
    """

    exposures: NDArray[np.int64]
    tail: BrightTail | None
    faults: FrameFaults | None


def survey(recording: Recording, settings: Settings, *, with_tail: bool = False) -> Survey:
    """Look at all frames once, and at the events beside those that may be faulty.

    Parameters
    ----------
    recording
        Less its black level.
    settings
        With the saturation, and what of the frames may be mended.
    with_tail
        Whether the tail is asked for.

    Raises
    ------
    FrameError
        If there are no frames.
    """
    response = chosen_response(settings.camera.response, recording.response)
    camera = Camera.named(response, settings.camera.clipped_from)
    # As recorded, where the white balance is not measured yet: which channel clips hardly depends on it.
    gains = white_balance(settings.camera.white_balance) or (1.0, 1.0, 1.0)
    watch, exposures, tail = _watch(settings, camera), [], BrightTail()
    for frame in recording.frames():
        exposures.append((frame.exposure_start, frame.exposure_end))
        if with_tail:
            bright = count_bright(camera, frame.image, frame.white_value, frame.black, frame.valid, gains)
            tail = tail.joined(bright)
        if watch is not None:
            watch.see(frame)
    if not exposures:
        raise no_frames(recording)
    faults = None if watch is None else find_frame_faults(recording, settings.camera, watch) or None
    return Survey(np.array(exposures, np.int64), tail if with_tail else None, faults)


def _watch(settings: Settings, camera: Camera) -> FrameWatch | None:
    """What sees the frames go by, for as much as the settings let be mended; None for nothing."""
    chosen = settings.camera
    asked = (chosen.even_gain, chosen.leave_out_faulty, chosen.mend_stuck)
    if not settings.filter.joins_frames or not any(asked):
        return None
    gain, faulty, stuck = asked
    return FrameWatch(camera, gain=gain, faulty=faulty, stuck=stuck)
