"""Truth from any recording: frames are held out, and compared with what is reconstructed without them.

A frame shows the mean of the intensity over its exposure, so it is compared with the mean of several reads across it.
Frames clip: by default nothing is clipped, and a method that reconstructs highlights beyond white is punished where
the held-out frame cannot show them. With ``clip`` the reconstruction is clipped as the camera would have.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral
from typing import Final

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.clock_rate import ClockRate, find_clock_rate
from kalux.calibration.frame_noise import estimate_frame_noise
from kalux.errors import FrameError, InputError, require_type
from kalux.evaluation.exposures import (
    End,
    compared_recording,
    end_of_frames,
    exposure_times,
    linear_frame,
    means_of,
    of_black,
)
from kalux.evaluation.lpips import LpipsWeights
from kalux.evaluation.method import METHOD_NEEDED, Method
from kalux.evaluation.pairs import Array, Pair
from kalux.evaluation.scores import Scores, score
from kalux.filters.shots import level_variance, take_shot
from kalux.frames import Frame
from kalux.models.camera import Camera
from kalux.recording import (
    RECORDING_NEEDED,
    Recording,
    reference_exposure,
    with_frames,
    with_shifted_frames,
)
from kalux.settings import AUTO, CameraSettings, chosen_response
from kalux.wording import how_many, ordinal

READS: Final = 5
"""Reads across the exposure of a held-out frame."""

MARGIN: Final = 3
"""Frames at either end that are never compared, so that a filter has started and has a frame ahead."""

SCALE_PERCENTILE: Final = 99.5
"""Of all frames' intensities: what becomes 1. Below white in a dark recording, so that scores are comparable."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A recording with frames held out.

    Attributes
    ----------
    whole, kept
        The recording with all frames, and without every n-th; less the black level, if it has one, and in the clock of
        the events, if the frames' is another.
    every
        n.
    compared
        (C,) int64, indices in ``whole`` of the held-out frames that are compared: those at least 3 from either end.
    times
        (C, reads) int64 us, across the exposures of these frames.
    reference_exposure
        us, of ``kept``: at this exposure a saturated pixel is 1.
    scale
        99.5th percentile of the intensities of all frames.
    response
        Of the camera, as in `kalux.settings.CameraSettings`.
    end
        Where the frames end.
    clock
        The rate of the frames' clock, where it was another.
    """

    whole: Recording
    kept: Recording
    every: int
    compared: NDArray[np.int64]
    times: NDArray[np.int64]
    reference_exposure: int
    scale: float
    response: str
    end: End
    clock: ClockRate | None = None

    @cached_property
    def noise(self) -> tuple[float, float]:
        """Read and shot noise of the frames, estimated from all of them: by it a held-out frame itself is off."""
        settings = CameraSettings(response=self.response)
        found = estimate_frame_noise(self.whole, settings)
        return (found.read, found.shot) if found is not None and found.is_reliable else settings.noise

    def frames(self) -> Iterator[Frame]:
        """The frames that are compared."""
        chosen = {*self.compared.tolist()}
        return (frame for i, frame in enumerate(self.whole.frames()) if i in chosen)

    def _of_clock(self) -> str:
        if self.clock is None:
            return ""
        return f"; times of frames stretched by {1e6 * self.clock.rate:.0f} us a second, to the events' clock"

    def described(self) -> str:
        """The protocol in words."""
        first, last = self.compared[0], self.compared[-1]
        which = f"number {first}" if first == last else f"numbers {first} to {last}"
        return (
            f"held-out frames: every {ordinal(self.every)} dropped, {len(self.compared)} of them compared "
            f"({which}, from 0), mean of {self.times.shape[1]} reads "
            f"across each exposure{of_black(self.whole)}{self._of_clock()}"
        )


def hold_out_frames(
    recording: Recording,
    every: int = 2,
    *,
    reads: int = READS,
    response: str = AUTO,
    black_level: float | None = None,
) -> HeldOut:
    """Hold out every ``every``-th frame (numbers every - 1, 2 every - 1 ..., from 0).

    Parameters
    ----------
    recording
        With known exposures.
    every
        At least 2.
    reads
        Reads across the exposure of every held-out frame, at least 2.
    response
        Of the camera, as in `kalux.settings.CameraSettings`.
    black_level
        A share of white, taken off the frames that are compared and those that methods are given alike. None: what is
        known already, else what the events of the whole recording say.

    Raises
    ------
    InputError
        If ``every`` or ``reads`` is less than 2 or not whole, or the recording something else.
    FrameError
        If there are too few frames to compare any, or all are black.
    """
    require_type("hold_out_frames: recording", recording, Recording, RECORDING_NEEDED)
    if not all(isinstance(number, Integral) and number >= 2 for number in (every, reads)):
        raise InputError(
            f"held-out frames: every is {every!r}, reads are {reads!r}; whole numbers, at least 2, are needed"
        )
    spans = [(frame.exposure_start, frame.exposure_end) for frame in recording.frames()]
    count = len(spans)
    compared = np.arange(MARGIN, count - MARGIN)
    compared = compared[compared % every == every - 1]
    if len(compared) == 0:
        raise FrameError(
            f"{recording.source.path}: {how_many(count, 'frame')}, too few to hold out every {ordinal(every)}: "
            f"a frame that is compared needs {MARGIN} before and {MARGIN} after it"
        )
    response = chosen_response(response, recording.response)
    recording = compared_recording(recording, response, black_level)
    clock = find_clock_rate(recording, CameraSettings(response=response), np.array(spans, np.int64))
    recording = with_shifted_frames(recording, None if clock is None else clock.shifts)
    kept = without_frames(recording, every)
    reference = reference_exposure(kept)
    chosen = {*compared.tolist()}
    times = [exposure_times(f, reads) for i, f in enumerate(recording.frames()) if i in chosen]
    scale = intensity_percentile(recording, SCALE_PERCENTILE, reference, response)
    if scale <= 0:
        raise FrameError(f"{recording.source.path}: the frames are black; there is nothing to compare")
    end = end_of_frames(recording, response)
    return HeldOut(recording, kept, every, compared, np.stack(times), reference, scale, response, end, clock)


def without_frames(recording: Recording, every: int) -> Recording:
    """The recording without every ``every``-th frame, and without its ground truth; nothing is copied."""

    def frames() -> Iterator[Frame]:
        return (frame for i, frame in enumerate(recording.frames()) if i % every != every - 1)

    return with_frames(recording, frames)


def evaluate_held_out(
    held: HeldOut,
    method: Method,
    *,
    clip: bool = False,
    hdr_vdp: bool = False,
    lpips: LpipsWeights | None = None,
    on_image: Callable[[], None] = lambda: None,
) -> Scores:
    """Compare a method's images with the frames that were held out.

    Parameters
    ----------
    held
        From `hold_out_frames`.
    method
        From `kalux.evaluation.baselines`, or one's own.
    clip
        Clip the reconstruction where the camera does, before it is compared.
    hdr_vdp
        Whether Q is computed, which takes most of the time.
    lpips
        Weights, if LPIPS is to be computed.
    on_image
        Called after every image.

    Raises
    ------
    InputError
        If ``held`` is not of `hold_out_frames`, or the method no `Method`.
    KaluxError
        Whatever the method or the metrics say.
    """
    require_type("evaluate_held_out: held", held, HeldOut, "a HeldOut is needed, from hold_out_frames")
    require_type("evaluate_held_out: method", method, Method, METHOD_NEEDED)
    return score(
        held_out_pairs(held, method, clip=clip),
        method=method.label,
        notes=method.notes,
        protocol=held.described(),
        data_range=1.0,
        scale=held.scale,
        clipped=clip,
        hdr_vdp=hdr_vdp,
        lpips=lpips,
        on_image=on_image,
    )


def held_out_pairs(held: HeldOut, method: Method, *, clip: bool = False) -> Iterator[Pair]:
    """A method's images with the frames that were held out; ``clip`` as in `evaluate_held_out`.

    The variance of the mean of the reads of an exposure is taken as the mean of theirs: reads a few milliseconds apart
    share their errors. The noise of the frame itself is that of `HeldOut.noise`; its fixed
    pattern is the method's, too.
    """
    offset = 0.0

    def read() -> Iterator[NDArray[np.float32]]:
        nonlocal offset
        for made in method.estimated(held.kept, held.times.ravel()):
            offset = made.log_offset
            yield np.stack([part for part in (made.intensity, made.variance_of_frames) if part is not None])

    camera = Camera.named(held.response, held.end.clipped_from)
    for frame, means in zip(held.frames(), means_of(read(), held.times.shape[1]), strict=True):
        image = clipped_as(means[0], frame, held.reference_exposure, held.end) if clip else means[0]
        shot = take_shot(frame, camera, held.reference_exposure)
        variance = means[1] if len(means) == 2 else None
        clipped = frame.normalised() >= held.end.clipped_from
        yield Pair(
            frame.middle,
            image,
            shot.intensity,
            frame.valid,
            variance=variance,
            clipped=clipped if clipped.ndim == 2 else np.asarray(clipped.any(axis=-1)),
            log_offset=offset,
            noise=None if variance is None else level_variance(shot, held.noise, offset)[shot.levels],
        )


def clipped_as(image: Array, frame: Frame, reference: int, end: End) -> Array:
    """An image (1 = white at the reference exposure, us) clipped where a frame of this exposure ends."""
    return np.clip(image, 0.0, end.intensity * reference / frame.amplified_exposure)


def intensity_percentile(recording: Recording, percent: float, reference: int, response: str) -> float:
    """A percentile of the intensities of all frames, in little memory: frames repeat their values.

    Raises
    ------
    FrameError
        If no pixel of any frame is valid.
    """
    values, counts = np.empty(0), np.empty(0, np.int64)
    for frame in recording.frames():
        linear = linear_frame(frame, reference, response)
        found, number = np.unique(linear if frame.valid is None else linear[frame.valid], return_counts=True)
        values, index = np.unique(np.concatenate([values, found]), return_inverse=True)
        counts = np.bincount(index, np.concatenate([counts, number])).astype(np.int64)
    if not len(counts):
        raise FrameError(
            f"{recording.source.path}: no pixel of any frame is valid, so that nothing can be compared"
        )
    return percentile_of_counts(values, counts, percent)


def percentile_of_counts(values: Array, counts: NDArray[np.int64], percent: float) -> float:
    """`numpy.percentile` of increasing values that occur ``counts`` times each."""
    last = np.cumsum(counts)
    position = percent / 100 * (int(last[-1]) - 1)
    below, above = values[np.searchsorted(last, [np.floor(position), np.ceil(position)], side="right")]
    return float(below + (above - below) * (position - np.floor(position)))
