"""The homography between two cameras without any calibration, by features that both see.

An event camera has no image, but what it says between two moments is what changes from one frame to another: both are
pictures of the same change of the log intensity, with sign. SIFT finds its features in these (Lowe 2004), several pairs
of frames give matches, and MAGSAC (Barath et al. 2019) the homography most of them agree with.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.calibration.alignment import Shots, levels
from kalux.calibration.homography import agreed_homography, alike, find_features
from kalux.calibration.registration import Registration
from kalux.calibration.rig import Lens
from kalux.errors import InputError
from kalux.events import EventArray

Array = NDArray[np.float64]

_PAIRS: Final = 12
_RATIO: Final = 0.85  # of the distances to the best and to the second match
_LEAST: Final = 20  # matches that agree; random ones seldom agree in more than 8
_TOLERANCE: Final = 3.0  # pixels of the frame camera, of the undistorted image
_SMOOTH: Final = 1.2  # pixels: single events are no picture


class Matched(NamedTuple):
    """A registration by features, how many matches agree with it, and of how many."""

    registration: Registration
    inliers: int
    matches: int


def match_cameras(
    shots: Shots, events: EventArray, events_lens: Lens, frames_lens: Lens, offset: float
) -> Matched:
    """The homography between two cameras that look at a distant scene.

    Parameters
    ----------
    shots
        Frames in which much changes.
    events
        Of their time.
    events_lens, frames_lens
        Of a calibration; without one `Lens.pinhole`, and the homography has to do for what the lenses bend.
    offset
        us, to be added to the frames' times; right to a third of a frame interval.

    Raises
    ------
    InputError
        If too few matches agree.
    """
    size = events_lens.sensor_size
    times = np.rint(shots.middles + offset).astype(np.int64)
    on, off = levels(events, size, times)
    net = on - off
    activity = [float(np.abs(b - a).sum()) for a, b in zip(shots.log[:-1], shots.log[1:], strict=True)]
    chosen = np.sort(np.argsort(activity)[::-1][:_PAIRS])
    # Frames are shrunk to about the event camera's pixels: their finer detail has no counterpart.
    shrink = min(1.0, 1.3 * size[1] / frames_lens.sensor_size[1])
    ours: list[Array] = []
    theirs: list[Array] = []
    for k in chosen.tolist():
        both = shots.usable[k] & shots.usable[k + 1]
        change = np.where(both, shots.log[k + 1] - shots.log[k], 0.0).astype(np.float32)
        small = cv2.resize(change, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        one, other = (
            find_features(_picture(image), width=0, most=3000, contrast=0.01)
            for image in (net[k + 1] - net[k], small)
        )
        here, there = alike(one, other, _RATIO)
        ours += list(here)
        theirs += list((there + 0.5) / shrink - 0.5)
    if len(ours) < _LEAST:
        raise _no_match(len(ours), 0)
    a, b = _straight(events_lens, np.array(ours)), _straight(frames_lens, np.array(theirs))
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    homography, agree = agreed_homography(a[known], b[known], _TOLERANCE)
    if homography is None or agree < _LEAST:
        raise _no_match(len(ours), agree)
    found = Registration(events_lens, frames_lens, homography)
    return Matched(found, agree, len(ours))


def _no_match(matches: int, agree: int) -> InputError:
    return InputError(
        f"registration: {agree} of {matches} features agree, {_LEAST} are needed; record a textured scene while the "
        "rig moves, see to it that the frames' times are right, or calibrate the rig (kalux calibrate rig)"
    )


def _straight(lens: Lens, pixels: Array) -> Array:
    """Undistorted pixels."""
    rays = lens.normalised(pixels)
    return rays @ lens.matrix[:2, :2].T + lens.matrix[:2, 2]


def _picture(change: NDArray[Any]) -> NDArray[np.uint8]:
    smooth = cv2.GaussianBlur(np.asarray(change, np.float32), (0, 0), _SMOOTH)
    scale = max(float(np.percentile(np.abs(smooth), 98)), 1e-6)
    return np.asarray(np.clip(128 + 110 * smooth / scale, 0, 255), np.uint8)
