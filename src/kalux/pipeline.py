"""Reconstruct a whole recording: drive the engine over the file as planned, nothing else."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from kalux import memory
from kalux.calibration.values import Calibration
from kalux.driver import EventFeed, engine_of
from kalux.errors import KaluxError
from kalux.events import EventArray
from kalux.images import Estimate, Image
from kalux.planning import UNCERTAIN_ORIGINS, Plan, plan
from kalux.reconstructor import Reconstructor
from kalux.recording import Recording, with_corrected_frames, with_event_layout, with_shifted_frames
from kalux.settings import Settings
from kalux.smoothing import Backward, combine, reversed_pixels, reversed_settings
from kalux.spill import temporary_folder
from kalux.threads import ahead, made_ahead

_MOST_AHEAD: Final = 20
"""Estimates, or images made of them, that wait to be written: at 300 images/s more than between two frames. While the
filter looks for motion at a frame, which takes as long as some ten images, other cores have these to go on with."""

_MOST_MAKERS: Final = 3
"""Images that are made at a time: where all of a DAVIS346 moves an image takes 2.5 times as long as its estimate."""

_AHEAD_BYTES: Final = 20 << 20
"""Memory of these, at most: on a sensor of VGA or more there are fewer."""

_BUSY: Final = 2
"""Threads that filtering and images keep busy: with segments made ahead by a third, two cores take 6 % less time at
640x480, 4 % more at 346x260, and at the former 35 to 50 MB more. What the filter's thread does itself becomes half."""


def reconstruct(
    recording: Recording,
    *,
    rate_hz: float | None = None,
    times: Any = None,
    at: Literal["frames"] | None = None,
    preset: str = "default",
    settings: Settings | None = None,
    calibration: Calibration | None = None,
    lookahead: bool = True,
    smooth: bool = False,
) -> Iterator[Image]:
    """Images of a recording, in time order; memory is bounded whatever the recording's length.

    Parameters
    ----------
    recording
        From `kalux.open` or `Recording.from_arrays`.
    rate_hz
        Images per second, from the start of the first exposure to the end of the last.
    times
        (N,) us, in order of time; the same one may come again.
    at
        ``"frames"``: one image at the middle of each exposure.
    preset, settings
        Name of a preset, or whole `Settings`, which win.
    calibration
        From `kalux.load_calibration`: what was measured replaces the preset's settings (not those of ``settings``), and
        what is known of single pixels is used.
    lookahead
        Whether an image uses the frame after it too; False: causal, as a robot needs it.
    smooth
        Whether an image uses everything after it: the filter runs backward too (`kalux.smoothing`). Takes
        three times as long, and room for the events and some states in the folder for temporary files.

    Raises
    ------
    InputError
        If not exactly one of rate_hz, times and at is given, times lie outside the recording, or ``smooth`` is asked of
        the causal mode or the complementary filter.
    SettingsError
        If the preset or a setting is unknown.
    FrameError
        If the recording has no frames.
    ExposureError
        If the frames' exposures are not known.
    EventError, FrameError, ExposureError
        If the recording is damaged; images before the damage may have been returned.
    OutputError
        If ``smooth`` finds no room for temporary files.
    """
    return execute(
        recording,
        plan(
            recording,
            rate_hz=rate_hz,
            times=times,
            at=at,
            preset=preset,
            settings=settings,
            calibration=calibration,
            lookahead=lookahead,
            smooth=smooth,
        ),
    )


def execute(
    recording: Recording,
    plan: Plan,
    on_events: Callable[[int], None] | None = None,
    on_backward: Callable[[int], None] | None = None,
    *,
    threads: int = 1,
    with_variance: bool = True,
) -> Generator[Image, None, None]:
    """Carry out a plan.

    Parameters
    ----------
    recording, plan
        From `kalux.planning.plan`, with the same recording.
    on_events, on_backward
        Called with the number of events of every chunk read, for progress: in the pass that makes the images, and, if
        it is smoothed, in the backward pass and those that prepare it. With several threads, in the one that filters.
    threads
        With more than one, reading and filtering have a thread each, and so many, up to three, make images of the
        estimates: all of them ahead of the caller. With more than two the filter's segments are made ahead, too. The
        images are the same.
    with_variance
        Without, grey images have an infinite variance and are made faster.
    """
    memory.give_back()  # that planning and checking have used
    recording = with_shifted_frames(recording, plan.mends.moved.shifts)
    recording = with_corrected_frames(recording, plan.mends.corrections)
    if plan.mends.layout is not None:
        recording = with_event_layout(recording, plan.mends.layout.found)
    several = threads > 1
    with _opener(threads) as opener:  # ends after the thread that filters, which gives it work
        engine = _engine(recording, plan, opener)
        if plan.smooth:
            estimates = _smoothed_estimates(recording, engine, plan, on_events, on_backward, several)
        else:
            estimates = _forward_estimates(recording, engine, plan, on_events, several)
        make = functools.partial(engine.image, with_variance=with_variance)
        if several:
            makers = min(threads, _MOST_MAKERS)
            yield from made_ahead(
                estimates, make, _ahead(recording.sensor_size), makers, ("filter", "images")
            )
        else:
            with contextlib.closing(estimates):
                yield from map(make, estimates)


def _opener(threads: int) -> AbstractContextManager[Executor | None]:
    """The thread that makes the engine's segments ahead; None with ``threads`` for which there is no core left."""
    return ThreadPoolExecutor(1, "kalux-segments") if threads > _BUSY else contextlib.nullcontext()


def _ahead(sensor_size: tuple[int, int]) -> int:
    """How many estimates or images wait."""
    height, width = sensor_size
    log_intensity_and_variance = 8 * height * width
    return min(max(_AHEAD_BYTES // log_intensity_and_variance, 4), _MOST_AHEAD)


def _smoothed_estimates(
    recording: Recording,
    engine: Reconstructor,
    plan: Plan,
    on_events: Callable[[int], None] | None,
    on_backward: Callable[[int], None] | None,
    read_ahead: bool,
) -> Generator[Estimate, None, None]:
    """The forward filter's estimates, each combined with the backward filter's at the same time."""
    trail = _trail(plan)
    reverse = dataclasses.replace(
        plan, settings=reversed_settings(plan.settings), pixels=reversed_pixels(plan.pixels)
    )
    on, off = engine.thresholds
    with temporary_folder() as folder:
        backward = Backward(
            recording, _engine(recording, reverse), plan.times, folder, on_backward, trail=trail
        )
        for estimate in _forward_estimates(recording, engine, plan, on_events, read_ahead):
            ahead_of_events = None if trail is None else engine.trail(estimate.t)
            yield combine(estimate, backward.estimate(estimate.t), ahead_of_events, on * off)


def _trail(plan: Plan) -> tuple[Settings, NDArray[np.bool_] | None] | None:
    """What the backward pass needs to follow the trail (K14): settings and hot pixels; None: it is not followed."""
    if plan.settings.filter.augmentation != "bridge" or plan.settings.events.trail == 0:
        return None
    hot = None if plan.pixels is None or not plan.pixels.hot.any() else plan.pixels.hot
    return plan.settings, hot


def _engine(recording: Recording, plan: Plan, opener: Executor | None = None) -> Reconstructor:
    return engine_of(
        recording,
        plan.settings,
        plan.pixels,
        threshold_is_estimate=plan.threshold_origin in UNCERTAIN_ORIGINS,
        lookahead=plan.lookahead,
        opener=opener,
    )


def _forward_estimates(
    recording: Recording,
    engine: Reconstructor,
    plan: Plan,
    on_events: Callable[[int], None] | None,
    read_ahead: bool,
) -> Generator[Estimate, None, None]:
    """Drive the engine over the recording, reading each time of the plan as soon as it is final."""
    events, times = recording.events(), deque(plan.times.tolist())
    reading: AbstractContextManager[Iterator[EventArray]] = (
        contextlib.closing(ahead(events, 1, "read")) if read_ahead else contextlib.nullcontext(iter(events))
    )
    with reading as chunks:
        feed = EventFeed(engine, chunks, on_events)
        finals = _push_frames(recording, engine, feed)
        with contextlib.closing(_one_later(finals) if engine.opener is not None else finals) as until:
            for final_until in until:
                yield from _final_estimates(engine, times, final_until)
                if not times:
                    return
        engine.end_frames()
        while not feed.ended and times:
            feed.push_next()
            yield from _final_estimates(engine, times, engine.final_until)
        engine.finish()
        yield from _final_estimates(engine, times, engine.final_until)


def _push_frames(
    recording: Recording, engine: Reconstructor, feed: EventFeed
) -> Generator[int | None, None, None]:
    """Push all frames, each with the events up to its end; until when (us) images are final then."""
    for frame in recording.frames():
        engine.push_frame(frame)
        feed.cover(frame.exposure_end)
        yield engine.final_until


def _one_later(items: Generator[int | None, None, None]) -> Generator[int | None, None, None]:
    """None, and then the items, each once the next one is known, or there is none, or an error in its place.

    Images of one segment are so read when the next can be made (`Reconstructor`'s opener).
    """
    latest = None
    with contextlib.closing(items):
        try:
            for item in items:
                yield latest
                latest = item
        except KaluxError:
            yield latest
            raise
        yield latest


def _final_estimates(engine: Reconstructor, times: deque[int], until: int | None) -> Iterator[Estimate]:
    """Estimates at the first of ``times`` up to ``until``; these are removed, and memory is freed."""
    if until is None:
        return
    while times and times[0] <= until:
        yield engine.estimate(times.popleft())
    if times:
        # Beyond, the engine would wait for the segment that is made ahead.
        engine.forget(min(times[0], until))
