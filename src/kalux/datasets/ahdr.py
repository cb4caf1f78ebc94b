"""Artificial HDR recordings: real frames, clipped by an artificial camera, with the originals as their truth.

The protocol of the paper's AHDR data (section 5): an artificial camera response takes the dark and the bright end off
every frame, and what was there is what a reconstruction must find in the events. The authors publish five curves, cut
at 30, 50, 80, 100 and 115. Those files are not needed here: a cut of c makes levels below c black and those above
255 - c white (of cut 100 the paper says, "higher than 160 or lower than 100"), with a smooth S in between
(`kalux.models.camera.Response.s_curve`).

What makes the comparison fair: the artificial response is written into the recording, so that every method inverts it;
1 is the white of the artificial camera, and the truth goes beyond it. What it cannot tell: frames and truth share the
noise and the blur of the originals, so that the clipped frame itself is perfect where it is not clipped. Held-out
frames (``every``) do not have that flaw.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.frame_noise import estimate_frame_noise
from kalux.errors import FrameError, InputError
from kalux.frames import Frame, GroundTruth, median_exposure
from kalux.models.camera import Camera, Response, inverse_response
from kalux.models.colour import luminance
from kalux.recording import Recording
from kalux.settings import CameraSettings, chosen_response
from kalux.wording import how_many, ordinal


@dataclass(frozen=True)
class ArtificialCamera:
    """What an artificial camera sees of the intensity of a real one's frame.

    Attributes
    ----------
    low, high
        Intensities, 0 to 1 = a saturated pixel of the real camera, up to which it sees black and from which it sees
        white.

    Raises
    ------
    InputError
        If they are not in order within 0 to 1.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        if not 0 <= self.low < self.high <= 1:
            raise InputError(
                f"artificial camera: black up to {self.low:g} and white from {self.high:g}; 0 <= black < white <= 1 "
                "is needed"
            )

    @classmethod
    def with_cut(cls, cut: float) -> ArtificialCamera:
        """Both ends cut by as much, of 255: less than 127.5."""
        if not 0 <= cut < 127.5:
            raise InputError(
                f"artificial camera: a cut of {cut:g} leaves nothing; 0 to less than 127.5 is possible"
            )
        return cls(cut / 255, 1 - cut / 255)

    @property
    def response(self) -> str:
        """Its response, as in `kalux.settings.CameraSettings`: irradiance 1 is its white."""
        return f"s-curve:{float(self.low / self.high)!r}"


def artificial_hdr(
    recording: Recording,
    camera: ArtificialCamera,
    *,
    response: str = "auto",
    black: float = 0.0,
    saturation: float = CameraSettings.usual_saturation,
    every: int | None = None,
) -> Recording:
    """A recording as an artificial camera would have made it, with the original frames as ground truth.

    Events are untouched. Frames keep their exposures, and have 8 bits. The truth is at the middle of exposures, 1 = the
    white of the artificial camera at the recording's median exposure, of frames in RGB the luminance; masked where the
    original was saturated itself, or measured nothing (`Frame.valid`).

    Parameters
    ----------
    recording
        With known exposures.
    camera
        The artificial one.
    response
        Of the real one, as in `kalux.settings.CameraSettings`.
    black
        Response, 0 to 1, that is black in the original frames (14 of 255 in the authors' data).
    saturation
        Response, 0 to 1, from which a pixel of the real camera is saturated, and no truth. Many sensors saturate far
        below full scale: slider_depth's at 0.44 (docs/datasets.md).
    every
        Leave out every ``every``-th frame (numbers every - 1, 2 every - 1 ..., from 0); the truth is then those
        frames alone. At least 2. None: all frames are kept, and all are truth.

    Raises
    ------
    InputError
        If ``every``, ``black`` or ``saturation`` is out of its range.
    FrameError
        If there are too few frames, or none that ``every`` leaves out, or all are black.
    """
    _check_every(every)
    check_originals(camera, black, saturation)
    real = Camera(Response.named(chosen_response(response, recording.response)))
    artificial = Response.named(camera.response)
    kept = [frame.exposure for frame in _taken_frames(recording, every)]
    if len(kept) < 2:
        raise FrameError(
            f"{recording.source.path}: {how_many(len(kept), 'frame')}, too few for artificial HDR"
        )
    if every is not None and len(kept) < every:
        raise FrameError(
            f"{recording.source.path}: {how_many(len(kept), 'frame')}, too few to leave out every {ordinal(every)} as "
            "truth"
        )

    def frames() -> Iterator[Frame]:
        for frame in _taken_frames(recording, every):
            intensity = _intensity(frame, real, black, 1.0)
            level = artificial(np.minimum(intensity / camera.high, 1.0))
            levels = np.rint(255 * level).astype(np.uint8)
            yield dataclasses.replace(frame, image=levels, white=None, black=0.0)

    reference = median_exposure(kept)

    def truth() -> GroundTruth:
        times, images, masks = [], [], []
        for frame in _truth_frames(recording, every):
            image = _intensity(frame, real, black, reference / frame.amplified_exposure) / camera.high
            times.append(frame.middle)
            grey = image if image.ndim == 2 else luminance(image)
            images.append(np.maximum(grey, 0.0).astype(np.float32))
            masks.append(_measured(frame, saturation))
        whole = np.stack(masks)
        return GroundTruth(
            np.array(times, np.int64),
            np.stack(images),
            None if whole.all() else whole,
            _noise(recording, response, black, camera.high),
        )

    if recording.source.count_frames() and not any(f.image.any() for f in recording.frames()):
        raise FrameError(f"{recording.source.path}: all frames are black; there is nothing to cut")
    return Recording(
        dataclasses.replace(
            recording.source,
            events=lambda: iter(recording.events()),
            frames=frames,
            count_frames=lambda: len(kept),
            exposure_known=True,
            inverse_covariance=None,  # of the real camera
            ground_truth=truth,
            response=camera.response,
            mosaic=recording.mosaic,
        )
    )


def check_originals(camera: ArtificialCamera, black: float, saturation: float) -> None:
    """Require levels of the original frames, as of `artificial_hdr`, to be possible.

    Raises
    ------
    InputError
        If they are not.
    """
    if not 0 <= black < 1:
        raise InputError(f"artificial HDR: black is {black:.4g} of full scale; 0 to less than 1 is possible")
    if not camera.low < saturation <= 1:
        raise InputError(
            f"artificial HDR: the original saturates at {saturation:g}; more than the artificial camera's black, "
            f"{camera.low:g}, and at most 1 is possible"
        )


def _check_every(every: int | None) -> None:
    if every is not None and every < 2:
        raise InputError(f"artificial HDR: every is {every}; at least 2 is needed")


def _taken_frames(recording: Recording, every: int | None) -> Iterator[Frame]:
    """The frames that the artificial camera takes."""
    return (f for i, f in enumerate(recording.frames()) if every is None or i % every != every - 1)


def _truth_frames(recording: Recording, every: int | None) -> Iterator[Frame]:
    """The original frames that are the truth: those held out, or all."""
    return (f for i, f in enumerate(recording.frames()) if every is None or i % every == every - 1)


def _measured(frame: Frame, saturation: float) -> NDArray[np.bool_]:
    """(H, W) where a frame is neither saturated in any of its colours nor masked."""
    below = np.asarray(frame.normalised() < saturation)
    measured = below if below.ndim == 2 else below.all(axis=-1)
    return np.asarray(measured if frame.valid is None else measured & frame.valid)


def _noise(recording: Recording, response: str, black: float, high: float) -> tuple[float, float] | None:
    """Read and shot noise of the original frames, 1 = ``high``; None: not linear, or no estimate is reliable."""
    name = chosen_response(response, recording.response)
    if name not in ("auto", "linear"):
        return None
    found = estimate_frame_noise(recording, CameraSettings(response=name))
    if found is None or not found.is_reliable:
        return None
    scale = high * (1.0 - black)
    return found.read / scale, found.shot / scale


def _intensity(frame: Frame, camera: Camera, black: float, exposure_ratio: float) -> NDArray[np.float64]:
    """Intensity of a frame, its black taken off, 1 = saturated."""
    level = (frame.normalised() - black) / (1.0 - black)
    return inverse_response(camera, level, exposure_ratio)
