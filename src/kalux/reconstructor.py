"""The engine: push events, push frames, read at any time.

Time is cut into segments, one per frame (`kalux.filters.method`). The engine holds the filter's state at the
start of the current segment and a cursor that has moved over some of its events. Reading evaluates the
cursor's closed form and changes nothing, so results depend neither on when and how often one reads nor on how
events were split into pushes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from concurrent.futures import Executor, Future
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.highlights import Unshown
from kalux.augmentation.motion import Paths
from kalux.augmentation.refractory import EventClock
from kalux.augmentation.trail import FrameTrail
from kalux.compiled import event_words
from kalux.errors import EventError, InputError, SettingsError, require_type
from kalux.events import (
    EVENT_DTYPE,
    NEVER,
    EventArray,
    as_events,
    check_events,
    checked_size,
    checked_thresholds,
)
from kalux.filters.akf import State
from kalux.filters.buffer import EventBuffer
from kalux.filters.method import USUAL_INTERVAL, Method, Segment
from kalux.filters.methods import make_method
from kalux.filters.shots import Shot, take_shot
from kalux.filters.uncertainty import changed_within, subthreshold_variance
from kalux.frames import Frame, check_frame, with_black_level
from kalux.images import Estimate, Image, View, make_image
from kalux.models.camera import Camera, beyond_white, count_bright, repeated_rounding, rounding_error
from kalux.models.colour import Gains, white_balance
from kalux.models.dark_levels import DarkDoubt, dark_doubt, dark_shares
from kalux.models.pixels import CALIBRATION_NEEDED, Measured, PixelCalibration, require_size
from kalux.moments import Moment
from kalux.settings import SETTINGS_NEEDED, USUAL_PATTERN, Settings
from kalux.settings import preset as named_preset
from kalux.white import WhiteCheck

_PIXELS_NEEDED: Final = (
    "a kalux.models.pixels.PixelCalibration is needed, from kalux.load_calibration(...).pixels"
)


_SAME_CLOCK: Final = 3_600_000_000
"""us, an hour: by more than that the beginnings of events and frames hardly differ in one clock. Clocks of hosts and
sensors are years apart."""


class _Progress:
    """A segment under way: its cursor, and which of the buffered events it has taken."""

    def __init__(self, segment: Segment, memory: Any, cursor: Any, ready: bool, starts_frame: bool) -> None:
        self.segment, self.memory, self.cursor = segment, memory, cursor
        self.ready = ready  # the segment will not change any more
        self.starts_frame = starts_frame  # False for the lead-in before the first frame's node
        self.taken = 0  # number of the first event that the cursor has not taken, or an earlier one
        self.latest = segment.start  # time of the last event taken
        self.paths: Paths | None = None  # of what moves, once it has been looked for
        self.looked = False


class Reconstructor:
    """Reconstruct from a live stream, or from anything that can be pushed in time order.

    Frames and events may arrive in any interleaving; each kind must be in time order. ``read(t)`` returns the
    best estimate that what was pushed allows.

    Parameters
    ----------
    sensor_size
        (height, width), pixels.
    preset, settings
        Name of a preset, or a whole `Settings`, which wins.
    calibration
        A `kalux.Calibration`, from `kalux.load_calibration`: what was measured replaces the preset's settings (not
        those of ``settings``), and what is known of single pixels is used.
    lookahead
        True: an image uses the frame after it too (11)-(13), so that it is final one frame later. False: only
        the past, for robots.
    contrast_threshold
        Log-intensity step of an event, or (on, off). Settings win. Default: the preset's usual ones, and the pixels'
        own are learned.
    threshold_is_estimate
        Whether the threshold was estimated: highlights beyond white, where no frame corrects its error, are then
        shrunk more towards white.
    reference_exposure
        Exposure time, us, at which a saturated pixel is 1.0; default: that of the first frame. Settings win.
    inverse_covariance
        A released ``f_Q``: 1 / R_bar for each level of the response, its shape used as f^w (5).
    pixels
        Calibration of single pixels: priors of their thresholds, and hot ones, whose events are left out. Default:
        those of ``calibration``.
    tells_doubts
        Whether to warn of what can hardly be right; of a `Recording` that has been told.
    opener
        Makes the segment after the one that is read in the meantime, once all that it needs has been pushed: a thread
        of its own, such as ``ThreadPoolExecutor(1)``, which the caller ends. Results are the same. None: a segment is
        made when it is first read.

    Raises
    ------
    SettingsError
        If a setting or preset is unknown or out of range.
    InputError
        If ``pixels`` are of a sensor of another size, or an argument has a value or a type that cannot be.

    Warns
    -----
    UserWarning
        From `push_frame` and `push_events`: if what is taken for white of the first frame can hardly be right, or
        frames and events begin more than an hour apart, which are hardly times of one clock.
    """

    def __init__(
        self,
        sensor_size: tuple[int, int],
        *,
        preset: str = "default",
        settings: Settings | None = None,
        calibration: Measured | None = None,
        lookahead: bool = True,
        contrast_threshold: float | tuple[float, float] | None = None,
        threshold_is_estimate: bool = False,
        reference_exposure: int | None = None,
        inverse_covariance: NDArray[np.float64] | None = None,
        pixels: PixelCalibration | None = None,
        tells_doubts: bool = True,
        opener: Executor | None = None,
    ) -> None:
        self.sensor_size = checked_size(sensor_size)
        if settings is not None:
            require_type("settings", settings, Settings, SETTINGS_NEEDED)
        if calibration is not None:
            require_type("calibration", calibration, Measured, CALIBRATION_NEEDED)
            settings = settings or calibration.apply(named_preset(preset))
            pixels = pixels or calibration.pixels_of(settings.events.mismatch)
        if reference_exposure is not None and _whole(reference_exposure, "reference_exposure") <= 0:
            raise InputError(f"reference_exposure is {reference_exposure} us; it must be positive")
        self.settings = settings if settings is not None else named_preset(preset)
        self.lookahead, self.opener = lookahead, opener
        stated = self.settings.events.with_thresholds(*checked_thresholds(contrast_threshold) or (None, None))
        self._thresholds_estimated = threshold_is_estimate or stated.threshold_on is None
        events = stated.assuming()
        self.thresholds = events.thresholds
        self._delay = events.lateness
        camera = self.settings.camera
        self._camera = Camera.named(camera.response, camera.clipped_from)
        if inverse_covariance is not None:
            self._camera = Camera.from_inverse_covariance(
                inverse_covariance, self._camera.response, camera.clipped_from
            )
        self._gains = white_balance(camera.white_balance)
        self._reference_exposure = camera.reference_exposure or reference_exposure
        if pixels is not None:
            require_type("pixels", pixels, PixelCalibration, _PIXELS_NEEDED)
            require_size(pixels, self.sensor_size)
        self._hot = pixels.hot if pixels is not None and pixels.hot.any() else None
        used = dataclasses.replace(self.settings, events=events)
        self._method: Method = make_method(used, lookahead, self.sensor_size, pixels)
        self._shots: list[Shot] = []  # from the current segment's frame on
        clock = EventClock(self.sensor_size, events.refractory)
        self._events = EventBuffer(clock)  # those after the current segment's start
        self._state: State | None = None  # at the current segment's start
        self._memory: Any = None
        self._progress: _Progress | None = None
        # The segment after it, which is being made, and the memory after that.
        self._coming: Future[tuple[Segment, Any]] | None = None
        self._last_frame: Frame | None = None
        self._frame_count = 0
        self._tells_doubts = tells_doubts
        self._begins: dict[str, int] = {}  # us, of events and of frames
        self._frame_interval = USUAL_INTERVAL  # between the latest two frames whose segment is committed, us
        self._bright_tail = self.settings.filter.bright_tail  # None: that of the first frame
        self._view: View | None = None  # once there is a frame
        self._event_count = 0
        self._last_event: int | None = None
        self._complete_until: int | None = None
        self._frames_ended = False
        self._finished = False
        self._earliest: int | None = None  # what `forget` was told
        self._freed: int | None = None  # events of the current segment up to this time are gone
        self._at_boundary: Estimate | None = None  # the latest of the end of a segment, if it is final

    # Pushing.

    def push_frame(self, frame: Frame, *, trail: FrameTrail | None = None) -> None:
        """Add the next frame.

        ``trail`` is for the backward filter of `kalux.smoothing`: how far the light is ahead of its events (K14).

        Raises
        ------
        FrameError, ExposureError
            Wrong size, not finite, out of order, empty exposure.
        InputError
            If no more frames were to come: images that they would change have been final.
        """
        self._require_open()
        if self._frames_ended:
            raise InputError(
                "push: end_frames() was called, no frame can be pushed after it; a new Reconstructor can begin with it"
            )
        check_frame(frame, self.sensor_size, index=self._frame_count, previous=self._last_frame)
        if self._frame_count == 0:
            self._doubt_white(frame)
            self._doubt_clock("frames", frame.exposure_start)
        frame = with_black_level(frame, self.settings.camera.black_level)
        self._reference_exposure = self._reference_exposure or frame.exposure
        if self._bright_tail is None:
            bright = count_bright(
                self._camera, frame.image, frame.white_value, frame.black, frame.valid, self._gains_of(frame)
            )
            self._bright_tail = bright.scale
        if self._view is None:
            self._view = self._view_by(frame, self._bright_tail)
        shot = take_shot(frame, self._camera, self._reference_exposure, self._gains_of(frame))
        self._shots.append(shot._replace(trail=trail, bright_tail=self._bright_tail))
        self._last_frame = frame
        self._frame_count += 1
        self._open_ahead()

    def measures(self, frame: Frame) -> NDArray[np.bool_]:
        """(H, W): pixels that a frame, pushed or not, measures: neither saturated nor masked."""
        frame = with_black_level(frame, self.settings.camera.black_level)
        return take_shot(frame, self._camera, frame.exposure, self._gains_of(frame)).measured

    def _gains_of(self, frame: Frame) -> Gains:
        """The white balance, which grey frames do not need."""
        if frame.colours == "grey":
            return (1.0, 1.0, 1.0)
        if self._gains is None:
            raise SettingsError(
                "white_balance: grey-world is measured by kalux.reconstruct over a recording; a live stream needs "
                "as-recorded or gains, e.g. 1.8;1;1.4"
            )
        return self._gains

    def push_events(self, events: Any, *, columns: str | None = None, time_unit: str | None = None) -> None:
        """Add the next events, in any layout that `as_events` takes, with its ``columns`` and ``time_unit``.

        Raises
        ------
        EventError
            Unknown layout, unsorted, older than what was pushed or declared complete, outside the sensor.
        """
        self._push(as_events(events, columns=columns, time_unit=time_unit), weighed=False)

    def push_weighed(self, events: EventArray) -> None:
        """Add the next events, which carry weights (`kalux.augmentation.refractory`), as a backward pass has them.

        Raises
        ------
        EventError
            As `push_events`.
        """
        self._push(events, weighed=True)

    def _push(self, array: EventArray, *, weighed: bool) -> None:
        self._require_open()
        previous = self._last_event
        if self._complete_until is not None:
            earliest = self._complete_until + 1 + self._delay
            previous = earliest if previous is None else max(previous, earliest)
            self._require_not_complete(array, self._complete_until + self._delay)
        kept = array
        if self._hot is not None:
            check_events(array, self.sensor_size, first_index=self._event_count, previous_t=previous)
            words = event_words(array)[~self._hot[array["y"], array["x"]]]
            kept = words.reshape(-1).view(EVENT_DTYPE)  # words keep the weights
        if not self._events.append(
            kept, self.sensor_size, earliest=previous, delay=self._delay, weighed=weighed
        ):
            check_events(array, self.sensor_size, first_index=self._event_count, previous_t=previous)
        if len(array) == 0:
            return
        if self._event_count == 0:
            self._doubt_clock("events", int(array["t"][0]))
        self._event_count += len(array)
        self._last_event = int(array["t"][-1])
        self.advance(self._last_event - 1)  # more events may carry the last one's time
        if self._needed_from is not None:
            self._events.drop(self._needed_from)

    def _doubt_white(self, first: Frame) -> None:
        check = WhiteCheck()
        check.see(first)
        doubt = check.doubt()
        if doubt is not None and self._tells_doubts:
            warnings.warn(f"frame 0: {doubt}", stacklevel=3)

    def _doubt_clock(self, what: Literal["events", "frames"], begin: int) -> None:
        """Warn once both are there, ``what`` from ``begin`` (us) on, if they begin too far from each other."""
        self._begins[what] = begin
        events, frames = (self._begins.get(each) for each in ("events", "frames"))
        if not self._tells_doubts or events is None or frames is None or abs(events - frames) <= _SAME_CLOCK:
            return
        warnings.warn(
            f"events begin at {events} us and frames at {frames} us, more than an hour apart; do both have the same "
            "clock?",
            stacklevel=4 if what == "events" else 3,
        )

    def _require_not_complete(self, array: EventArray, complete: int) -> None:
        """Refuse events up to ``complete`` (us), as `advance` was told; others are told by `check_events`."""
        if len(array) == 0:
            return
        first = int(array["t"][0])
        if first <= complete and (self._last_event is None or first >= self._last_event):
            raise EventError(
                f"events: event {self._event_count} at {first} us is late: advance() has declared all events up to "
                f"{complete} us pushed"
            )

    def advance(self, t: int) -> None:
        """Declare that all events stamped up to ``t`` (us) have been pushed: silence is information too.

        Raises
        ------
        InputError
            If ``t`` is not a whole number.
        """
        t = _whole(t, "advance: the time") - self._delay
        self._complete_until = t if self._complete_until is None else max(t, self._complete_until)
        self._open_ahead()

    @property
    def newest_frame_end(self) -> int | None:
        """End of the newest frame's exposure, us; None before the first frame."""
        return None if self._last_frame is None else self._last_frame.exposure_end

    def covers(self, t: int) -> bool:
        """Whether all events up to ``t`` (us, in the frames' clock) are known to be here."""
        return self._finished or (self._complete_until is not None and self._complete_until >= t)

    def end_frames(self) -> None:
        """Declare that no more frames come: without one, images after the last are final, and memory can be freed."""
        self._frames_ended = True

    def finish(self) -> None:
        """Declare that nothing more comes: what is left becomes final."""
        self._finished = self._frames_ended = True

    def forget(self, t: int) -> None:
        """Promise not to read before ``t`` (us), so that the memory of what led there can be freed.

        Frees what is final; reading frees in the same way, but only up to the segment that is read. Where no frame is
        to come (`end_frames`), reads can then only go forward.

        Raises
        ------
        InputError
            If ``t`` is not a whole number.
        """
        t = _whole(t, "forget: the time")
        final_until = self.final_until
        if (
            not self._shots
            or final_until is None
            or (self._state is None and not self._is_complete(self._shots[0]))
        ):
            return
        begin = self.begin_time
        limit = min(t, final_until)
        if begin is None or limit <= begin:
            return
        if self._freed is not None and self._progress is not None and limit < self._progress.latest:
            # What led to a read ahead of ``limit`` is gone: reads go on from there, and need no event before it.
            self._earliest, self._freed = limit, self._progress.latest
            self._events.drop(self._freed)
            return
        progress = self._progress_to(limit)
        endless = self._frames_ended and len(self._shots) == 1
        if progress.ready or endless:  # no frame will change it
            self._earliest = limit
        if endless:
            self._take(progress, limit)
            self._events.drop(progress.latest)
            self._freed = limit

    # Reading.

    @property
    def begin_time(self) -> int | None:
        """The first time, us, that can be read; None before the first frame."""
        if self._state is None and self._shots:
            return self._method.begin_time(self._shots[0])
        start = self._start_time()
        return start if start is None or self._earliest is None else max(start, self._earliest)

    @property
    def final_until(self) -> int | None:
        """Images up to this time, us, are final; None if none is. It grows with what is pushed."""
        if not self._shots:
            return None
        if self._finished:
            return np.iinfo(np.int64).max
        if self._frames_ended and self._is_complete(self._shots[-1]):
            return self._complete_until
        if not self.lookahead:
            # A frame that is still to come ends after the last one, and changes images from there on.
            # So does one whose rows are not all exposed.
            until = self._complete_until
            waiting = (shot.end - 1 for shot in self._shots if not self._is_complete(shot))
            return None if until is None else min(until, self._shots[-1].end, *waiting)
        for shot in reversed(self._shots):
            if self._is_complete(shot):
                node = self._method.node(shot)
                # At the first frame of all no segment ends where the first one begins at its middle.
                begins = shot is self._shots[0] and self._frame_count == len(self._shots)
                return None if begins and self._method.begin_time(shot) == node else node
        return self._start_time()

    def read(self, t: int) -> Image:
        """The image at time ``t`` (us). Does not change the result of another read. See `estimate`."""
        return self.image(self.estimate(t))

    def estimate(self, t: int) -> Estimate:
        """The filter's estimate at time ``t`` (us), for `image`. Does not change the result of another read.

        Reads may repeat, and go back as far as the newest frame that is final. Only of the very moment at which two
        segments meet (`kalux.filters.method`) the estimate depends on whether it is read before later ones: it is then
        that of the segment which ends there, else of the one that begins.

        Raises
        ------
        InputError
            If ``t`` is not a whole number, no frame has been pushed, or ``t`` lies before what can still be read.
        """
        t = _whole(t, "read: the time")
        if not self._shots:
            raise InputError("read: no frame has been pushed yet; events alone say nothing of the intensity")
        begin = self.begin_time
        assert begin is not None
        if t < begin:
            raise InputError(
                f"read: {t} us lies before {begin} us, the earliest time that can be read "
                "(the first frame, or what later reads have passed or forget() has freed)"
            )
        passed = self._at_boundary
        if passed is not None and passed.t == t == self._start_time():
            return passed
        progress = self._progress_to(t)
        self._take(progress, t)
        log_intensity, variance = self._method.read(progress.segment, progress.cursor, t)
        final_until = self.final_until
        final = final_until is not None and t <= final_until
        moment = self._moment(progress, t)
        estimate = Estimate(
            t,
            log_intensity,
            variance,
            white=moment.white(self.settings.camera.offset),
            final=final,
            moving=self._method.moving(progress.segment, progress.cursor),
            between=moment.between,
            chroma=moment.chroma(),
            unshown=self._unshown(progress, variance),
            silent_change=self._method.silent_change(progress.segment),
            around=None if moment.after is None else self._method.around(progress.segment, t),
            unmeasured=self._method.unmeasured(progress.segment, progress.cursor),
            exposed=changed_within(moment.exposed, self._method.turns(progress.segment)),
            since=moment.since(self._frame_interval),
            paths=self._paths(progress, moment),
            share=moment.share,
            texture=self._method.texture(progress.segment),
        )
        if final and t == progress.segment.end:
            self._at_boundary = estimate
        return estimate

    def trail(self, t: int) -> NDArray[np.floating[Any]] | None:
        """(H, W) how far, in log intensity, the light is ahead of its events at ``t`` (us), K14.

        ``t`` is a time that can be read. None: the method does not follow it.
        """
        progress = self._progress_to(t)
        self._take(progress, t)
        return self._method.trail(progress.segment, progress.cursor, t)

    def image(self, estimate: Estimate, *, with_variance: bool = True) -> Image:
        """The image of an estimate, with the prior on highlights (K6, K15) and averaging of neighbours (K12).

        Where the variance is not wanted it is infinite: computing it (K11) takes a seventh of the time. Nothing that
        is pushed after the first frame changes the image, so that another thread may make it.

        Raises
        ------
        InputError
            If no frame has been pushed.
        """
        if self._view is None:
            raise InputError(
                "image: no frame has been pushed yet, so that the camera's properties are not known"
            )
        return make_image(estimate, self._view, with_variance=with_variance)

    def _view_by(self, frame: Frame, bright_tail: float) -> View:
        """The settings and the camera's properties, of its first frame, by which images are made."""
        filtered, events = self.settings.filter, self.settings.events
        # The prior on highlights needs a variance, which the complementary filter has not.
        scale = filtered.highlight_scale if filtered.kind == "akf" else 0.0
        spread, growth = events.believed_mismatch, events.believed_trust
        if self._thresholds_estimated:
            likely = filtered.highlight_tail * beyond_white(bright_tail)
            if likely < scale:  # a scene that does not go far beyond white tells nothing of far highlights
                scale, growth = likely, growth * (likely / scale) ** 4
            spread = events.believed_extrapolation
        on, off = self.thresholds
        return View(
            log_offset=self.settings.camera.offset,
            threshold2=on * off,
            neighbours=filtered.neighbours,
            highlight_scale=scale,
            highlight_spread=spread,
            highlight_gain=events.believed_gain,
            highlight_growth=growth,
            unknown_variance=filtered.initial_variance,
            lag_variance=on * off * (events.lag_variance or 0.0),
            fixed_pattern=self._pattern_of(frame),
            response=None if self._camera.response.is_linear else self._camera.response,
            rounding=repeated_rounding(frame, self.settings.camera),
            dark=self._dark_doubt(frame),
            mosaic=frame.mosaic,
            gains=(1.0, 1.0, 1.0) if frame.mosaic is None else self._gains_of(frame),
        )

    def _dark_doubt(self, frame: Frame) -> DarkDoubt | None:
        """What noise hides below black; None where it is not known, or not that of the levels (K3)."""
        camera = self.settings.camera
        if camera.frame_noise is None or not camera.is_linear or frame.image.ndim == 3:
            return None
        shares = dark_shares(self.settings.filter.dark_shares)
        return dark_doubt(camera.noise, camera.offset, 2.0 * rounding_error(frame), shares)

    def _pattern_of(self, frame: Frame) -> float:
        """The fixed pattern that the variance counts: the usual one where no plan has looked for it in grey frames."""
        camera = self.settings.camera
        if camera.fixed_pattern is not None:
            return camera.fixed_pattern
        grey = self._camera.colours is None and frame.image.ndim == 2
        return USUAL_PATTERN if grey and self.settings.filter.joins_frames else 0.0

    def _unshown(self, progress: _Progress, variance: NDArray[np.floating[Any]]) -> Unshown | None:
        """Pixels that no frame has measured yet (K15), where highlights are looked at."""
        filtered = self.settings.filter
        if filtered.highlight_scale == 0 or filtered.unshown_tail == 0:
            return None
        return self._method.unshown(progress.segment, variance)

    def _moment(self, progress: _Progress, t: int) -> Moment:
        """The time ``t`` in a segment under way, with the frames at both its ends where it uses both."""
        segment = progress.segment
        if not (self.lookahead and progress.ready and progress.starts_frame):
            return Moment(t, self._shots[0], None, 0.0)
        share = (t - segment.start) / (segment.end - segment.start)
        return Moment(t, self._shots[0], self._shots[1], share)

    def _paths(self, progress: _Progress, moment: Moment) -> Paths | None:
        """Of what moves between the frames around an image (K16); None where there is one alone."""
        if moment.after is None:
            return None
        self._look_for_motion(progress)
        return progress.paths

    def _look_for_motion(self, progress: _Progress) -> None:
        """Look for what moves in a segment that is final, once, while all of its events are here."""
        if progress.looked:
            return
        progress.looked = True
        segment = progress.segment
        path = self._method.path(segment)
        if path is None:
            return
        assert self._state is not None
        half_way = (segment.start + segment.end) // 2
        cursor = self._method.begin(segment, self._state)
        self._take(_Progress(segment, progress.memory, cursor, ready=True, starts_frame=True), half_way)
        level, variance = self._method.read(segment, cursor, half_way)
        on, off = self.thresholds
        progress.paths = self._method.paths(
            segment, path, level, variance + subthreshold_variance(1.0, on * off).moving
        )

    # Segments.

    @property
    def _needed_from(self) -> int | None:
        """No event up to this time is needed any more."""
        start = self._start_time()
        if start is None:
            return self._method.needed_from(self._shots[0]) if self._shots else None
        return start if self._freed is None else max(start, self._freed)

    def _require_open(self) -> None:
        if self._finished:
            raise InputError("push: finish() was called, nothing can be pushed after it")

    def _is_complete(self, shot: Shot) -> bool:
        """Whether all events that the frame's segment boundary needs are here."""
        return self.covers(self._method.needed_until(shot))

    def _start_time(self) -> int | None:
        """Start of the current segment."""
        if self._progress is not None:
            return self._progress.segment.start
        if self._state is not None:
            return self._method.node(self._shots[0])
        return None

    def _progress_to(self, t: int) -> _Progress:
        """The segment that holds ``t``, with a cursor that has taken no event after it; commits those before.

        Raises
        ------
        InputError
            If events that lead to ``t`` are gone.
        """
        if self._state is None:
            if not self._is_complete(self._shots[0]):
                return self._provisional(t)
            self._begin()
        while True:
            progress = self._open()
            if t <= progress.segment.end:
                if t >= progress.latest:
                    return progress
                if self._freed is not None:
                    raise InputError(
                        f"read: {t} us lies before an event at {progress.latest} us that was read, and forget() has "
                        "freed what led there: after the last frame, reads can then only go forward"
                    )
                return self._restart(progress)
            self._take(progress, progress.segment.end)
            self._commit(progress)

    def _begin(self) -> None:
        """Take the first frame, now that the events of its exposure are here."""
        shot = self._shots[0]
        self._memory, lead_in, self._state = self._method.start(shot, self._events.chunks)
        self._events.drop(self._method.begin_time(shot))
        if lead_in is not None:
            self._progress = _Progress(
                lead_in,
                self._memory,
                self._method.begin(lead_in, self._state),
                ready=True,
                starts_frame=False,
            )

    def _provisional(self, t: int) -> _Progress:
        """As `_progress_to`, while events of the first exposure are still to come: by those that are here.

        Nothing of it is kept, since the first state depends on all of them.
        """
        shot, chunks = self._shots[0], self._events.chunks
        memory, lead_in, state = self._method.start(shot, chunks)
        segment, starts_frame = lead_in, False
        if segment is not None and t > segment.end:
            lead = _Progress(
                segment, memory, self._method.begin(segment, state), ready=False, starts_frame=False
            )
            lead.taken = self._events.number(segment.start)
            self._take(lead, segment.end)
            state, segment = self._method.end(lead.segment, lead.cursor), None
        if segment is None:
            segment, memory = self._method.segment(memory, shot, None, chunks)
            starts_frame = True
        cursor = self._method.begin(segment, state)
        progress = _Progress(segment, memory, cursor, ready=False, starts_frame=starts_frame)
        progress.taken = self._events.number(segment.start)
        return progress

    def _open(self) -> _Progress:
        """The current segment; made anew when what was pushed meanwhile completes it."""
        assert self._state is not None
        following = self._complete_frame(1)
        complete = following is not None
        if self._progress is None or (complete and not self._progress.ready):
            coming, self._coming = self._coming, None
            if coming is not None:
                segment, memory = coming.result()
            else:
                segment, memory = self._method.segment(
                    self._memory, self._shots[0], following, self._events.chunks
                )
            cursor = self._method.begin(segment, self._state)
            self._progress = _Progress(segment, memory, cursor, ready=complete, starts_frame=True)
            self._open_ahead()
        return self._progress

    def _open_ahead(self) -> None:
        """Have the segment after the current one made by the opener, if all that it needs is here.

        It follows from frames, events and the memory before, not from the filter's state.
        """
        progress = self._progress
        if self.opener is None or self._coming is not None or progress is None or not progress.ready:
            return
        index = int(progress.starts_frame)  # the lead-in is followed by the segment of its own frame
        following = self._complete_frame(index + 1)
        if following is None:
            return
        first = self._events.number(progress.segment.end)  # those before will have been dropped
        events = list(self._events.after(first, self._method.needed_until(following)))
        self._coming = self.opener.submit(
            self._method.segment, progress.memory, self._shots[index], following, events
        )

    def _complete_frame(self, index: int) -> Shot | None:
        """The frame ``index`` after that of the current segment, once all events that its boundary needs are here."""
        if index >= len(self._shots) or not self._is_complete(self._shots[index]):
            return None
        return self._shots[index]

    def _commit(self, progress: _Progress) -> None:
        """Move the state to the end of a final segment; forget its frame and events."""
        self._state = self._method.end(progress.segment, progress.cursor)
        self._memory = progress.memory
        self._progress = None
        if progress.starts_frame:
            self._frame_interval = self._shots[1].middle - self._shots[0].middle
            self._shots.pop(0)
        self._events.drop(progress.segment.end)

    def _restart(self, progress: _Progress) -> _Progress:
        """The same segment with a fresh cursor, to read at an earlier time."""
        assert self._state is not None
        progress.cursor = self._method.begin(progress.segment, self._state)
        progress.taken, progress.latest = 0, progress.segment.start
        return progress

    def _take(self, progress: _Progress, t: int) -> None:
        """Take the cursor over the events up to ``t`` that it has not taken yet."""
        taken = max(progress.taken, self._events.first)
        for events in self._events.after(taken, t):
            self._method.advance(progress.segment, progress.cursor, events)
            progress.latest = int(events["t"][-1])
            taken += len(events)
        progress.taken = taken


def _whole(t: Any, what: str) -> int:
    """A time as an int. Fractions are refused, not cut off: they may be seconds."""
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        if int(t) == t and NEVER < t < -NEVER:  # room for times of frames and events, with their delay
            return int(t)
    raise InputError(f"{what} is {t!r}; whole microseconds, at most 10^18, are needed")
