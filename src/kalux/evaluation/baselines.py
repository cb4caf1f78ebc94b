"""What reconstructions are compared with, and kalux's own, as `kalux.evaluation.method.Method`."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from functools import partial
from itertools import chain, pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.deblur import integrate_exposure, latent_middle
from kalux.calibration.values import Calibration
from kalux.evaluation.exposures import linear_frame
from kalux.evaluation.method import Estimated, Image, Method, Times
from kalux.event_slices import between, count_events
from kalux.events import EVENT_DTYPE, EventArray
from kalux.frames import Frame
from kalux.models.camera import log_intensity
from kalux.pipeline import execute
from kalux.planning import Plan, plan
from kalux.recording import Recording, less_black, reference_exposure
from kalux.settings import AUTO, PRESETS, Settings, altered, chosen_response

_PLANS_KEPT: Final = 2
"""Of each settings: one of the recording without the frames that are held out, one with them for blur consistency."""


class Planner:
    """Plans reconstructions, and keeps the last two plans of each settings, which several methods may need.

    Parameters
    ----------
    calibration
        For all plans, as of `kalux.reconstruct`.
    """

    def __init__(self, calibration: Calibration | None = None) -> None:
        self._calibration = calibration
        self._kept: dict[tuple[Settings, bool], deque[tuple[Recording, Times, Plan]]] = {}

    def plan(
        self,
        recording: Recording,
        times: Times,
        settings: Settings,
        *,
        smooth: bool = False,
        watched: Recording | None = None,
    ) -> Plan:
        """The plan of `kalux.planning.plan`; ``watched`` is the same recording, read in its place for progress."""
        kept = self._kept.setdefault((settings, smooth), deque(maxlen=_PLANS_KEPT))
        for of_recording, of_times, made in kept:
            if of_recording is recording and np.array_equal(of_times, times):
                return made
        made = plan(
            recording if watched is None else watched,
            times=times,
            settings=settings,
            calibration=self._calibration,
            smooth=smooth,
        )
        kept.append((recording, times, made))
        return made


def hold_last_frame(recording: Recording, times: Times, *, response: str = AUTO) -> Iterator[Image]:
    """The last frame whose exposure's middle has passed; before the first, the first."""
    reference = reference_exposure(recording)
    response = chosen_response(response, recording.response)
    for before, after, _ in frames_around(recording.frames(), times):
        held = before or after
        assert held is not None
        yield linear_frame(held, reference, response).astype(np.float32)


def mean_of_neighbours(recording: Recording, times: Times, *, response: str = AUTO) -> Iterator[Image]:
    """The mean of the frames before and after, each by the middle of its exposure."""
    reference = reference_exposure(recording)
    response = chosen_response(response, recording.response)
    for before, after, _ in frames_around(recording.frames(), times):
        pair = [linear_frame(frame, reference, response) for frame in (before, after) if frame is not None]
        yield np.mean(pair, axis=0).astype(np.float32)


def edi_video(
    recording: Recording,
    times: Times,
    *,
    settings: Settings | None = None,
    planner: Planner | None = None,
) -> Iterator[Image]:
    """EDI: the nearest frame, deblurred by its events, and moved to the time by the events in between.

    The thresholds are nominal, the same for all pixels: those of the settings, the recording, or an estimate; so is the
    events' delay, which is taken off their times. Nothing is known of clipped pixels: they are taken as they are.
    """
    planner = planner or Planner()
    chosen = planner.plan(recording, times, settings or PRESETS["default"]).settings
    on, off = (np.full(recording.sensor_size, c) for c in chosen.events.thresholds)
    recording = less_black(recording, chosen.camera.black_level)
    camera, reference = chosen.camera, reference_exposure(recording)
    window = EventWindow(_earlier(recording.events(), chosen.events.lateness))
    for frame, wanted in nearest_frames(recording.frames(), times):
        first = min(frame.exposure_start, int(wanted[0]))
        events = window.between(first, max(frame.exposure_end, int(wanted[-1])))
        blurred = log_intensity(linear_frame(frame, reference, camera.response), camera.offset)
        integrals = integrate_exposure(events, frame.exposure_start, frame.exposure_end, on, off)
        sharp = latent_middle(blurred, integrals)
        for t in wanted.tolist():
            moved = sharp + _change(events, frame.middle, t, on, off)
            yield np.maximum(np.exp(moved) - camera.offset, 0.0).astype(np.float32)


def filtered(recording: Recording, times: Times, **options: Any) -> Iterator[Image]:
    """The images of `filtered_estimates`."""
    return (made.intensity for made in filtered_estimates(recording, times, **options))


def filtered_estimates(
    recording: Recording,
    times: Times,
    *,
    settings: Settings,
    planner: Planner,
    smooth: bool = False,
) -> Iterator[Estimated]:
    """`kalux.reconstruct` with given settings, the AKF or the complementary filter: images and their variances."""
    for image in execute(recording, planner.plan(recording, times, settings, smooth=smooth)):
        yield Estimated(image.intensity, image.variance, image.log_offset, image.fixed_pattern)


_FILTERS: Final = {
    "cf": "CF",
    "iccv2021": "AKF iccv2021",
    "iccv2021-flir": "AKF iccv2021-flir",
    "default": "AKF default",
    "davis240c": "AKF davis240c",
    "davis346": "AKF davis346",
    "prophesee-flir": "AKF prophesee-flir",
}

OPTIONAL: Final = ("iccv2021-flir", "davis240c", "davis346", "prophesee-flir")
"""Not among those that are compared if nothing is said: for one camera only."""


def methods(
    response: str = AUTO, calibration: Calibration | None = None, planner: Planner | None = None
) -> dict[str, Method]:
    """All methods by name; ``response`` is the camera's, as in `kalux.settings.CameraSettings`.

    A calibration changes the settings of all filters. A ``planner`` of the same calibration, if there is one already,
    makes their plans.
    """
    known = Calibration() if calibration is None else calibration
    planner = planner or Planner(calibration)
    presets = {name: known.apply(altered(PRESETS[name], "camera", response=response)) for name in _FILTERS}
    return {
        "hold": Method("hold the last frame", partial(hold_last_frame, response=response)),
        "mean": Method("mean of the neighbours", partial(mean_of_neighbours, response=response), True),
        "edi": Method("EDI video", partial(edi_video, settings=presets["default"], planner=planner)),
        **{name: filter_method(label, presets[name], planner) for name, label in _FILTERS.items()},
        "smooth": filter_method("AKF default, both ways", presets["default"], planner, smooth=True),
    }


def filter_method(
    label: str, settings: Settings, planner: Planner | None = None, *, smooth: bool = False
) -> Method:
    """`kalux.reconstruct` with these settings as a method; of the planner's calibration the pixels are taken."""
    planner = planner or Planner()
    with_variance = partial(filtered_estimates, settings=settings, planner=planner, smooth=smooth)
    return Method(
        label,
        partial(filtered, settings=settings, planner=planner, smooth=smooth),
        estimates=None if settings.filter.kind == "cf" else with_variance,
        settings=settings,
    )


def frames_around(frames: Iterable[Frame], times: Times) -> Iterator[tuple[Frame | None, Frame | None, int]]:
    """For every time (ascending, us) the last frame with its middle at or before it, the next one, and the time."""
    remaining = iter(frames)
    before, after = None, next(remaining, None)
    for t in times.tolist():
        while after is not None and after.middle <= t:
            before, after = after, next(remaining, None)
        yield before, after, t


def nearest_frames(frames: Iterable[Frame], times: Times) -> Iterator[tuple[Frame, Times]]:
    """The frames with the times (ascending, us) that are nearer to their middles than to others'; none without."""
    first = 0
    for frame, following in pairwise(chain(frames, [None])):
        assert frame is not None
        last = len(times)
        if following is not None:
            last = int(np.searchsorted(times, (frame.middle + following.middle) // 2, side="right"))
        if last > first:
            yield frame, times[first:last]
            first = last


def _earlier(chunks: Iterable[EventArray], delay: int) -> Iterator[EventArray]:
    """Copies of the events at the times of their light, ``delay`` us before their stamps."""
    for chunk in chunks:
        moved = chunk.copy()
        moved["t"] -= delay
        yield moved


class EventWindow:
    """Events by ever later intervals, of a stream that is read once and forgotten."""

    def __init__(self, chunks: Iterable[EventArray]) -> None:
        self._chunks = iter(chunks)
        self._held: EventArray = np.empty(0, EVENT_DTYPE)

    def between(self, start: int, end: int) -> EventArray:
        """The events with start < t <= end, us; later calls may not start earlier."""
        while len(self._held) == 0 or self._held["t"][-1] <= end:
            chunk = next(self._chunks, None)
            if chunk is None:
                break
            kept = between(self._held, start, np.iinfo(np.int64).max)
            self._held = np.concatenate([kept, chunk])
        return between(self._held, start, end)


def _change(
    events: EventArray, start: int, end: int, on: NDArray[np.float64], off: NDArray[np.float64]
) -> NDArray[np.float64]:
    """What events say of the log intensity from start to end (us), which may be earlier."""
    rises, falls = count_events(between(events, min(start, end), max(start, end)), on.shape)
    change = on * rises - off * falls
    return change if end >= start else -change
