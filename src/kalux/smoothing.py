"""Both ways in time: the filter run backward too, and the two combined by their information.

A highlight that leaves saturation later tells what it was before. The backward filter is the same engine on the
recording in reverse: times negated, polarities flipped, exposures mirrored. With L and P of the forward filter and
L' and P' of the backward one, the estimate is the two-filter smoother (Fraser and Potter 1969)

    L_s = (L / P + L' / P') / (1 / P + 1 / P').

Where one of them knows no more than a bound, it counts as one (docs/equations.md, K15). Where a frame around the image
measures the pixel, both go along the same bridge, and err alike (`shared_errors`).

Memory is bounded: the recording is spilled to disk (`kalux.spill`), where it can be read backward, and the backward
pass is done twice, first to save its state before every window of images, then window by window for the images
themselves.
"""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.background import signal_shares
from kalux.augmentation.bridge import REPEATED, UNMEASURED
from kalux.augmentation.subthreshold import told_by_none
from kalux.augmentation.trail import FrameTrail, follow, nothing_followed, trail_at, with_surety
from kalux.event_slices import counted
from kalux.filters.highlights import obey_bounds, smoothed_unshown
from kalux.filters.uncertainty import Around
from kalux.frames import Frame
from kalux.images import Estimate
from kalux.models.pixels import PixelCalibration
from kalux.reconstructor import Reconstructor
from kalux.recording import Recording
from kalux.settings import Settings
from kalux.spill import Spill, spilling

_WINDOW_BYTES: Final = 256 << 20
"""Estimates of the backward pass that are held in memory at a time."""

_STANDS_STILL: Final = 0.005
"""Mean square change of silent pixels, in c^2, up to which nothing moves there: a tenth of the least under a moving
camera (`kalux.augmentation.subthreshold`)."""


class Trails:
    """How far the light is ahead of its events (K14) at the middle of every frame, on disk, for the backward filter.

    The light is ahead of the event before: the backward filter, for which that is still to come, must be told.

    Parameters
    ----------
    spill
        Of the recording.
    settings
        Of the forward filter, with its thresholds and its delay.
    hot
        (H, W) bool: pixels whose events are left out; None: none.
    measures
        Which pixels, (H, W) bool, a frame measures (`Reconstructor.measures`): the forward filter tells noise from
        signal by it (K5). None: it does not look ahead, and takes all events for signal here.
    on_events
        Told the number of events of every block that has been followed.
    """

    def __init__(
        self,
        spill: Spill,
        settings: Settings,
        hot: NDArray[np.bool_] | None,
        measures: Callable[[Frame], NDArray[np.bool_]] | None,
        on_events: Callable[[int], None] | None = None,
    ) -> None:
        events = settings.events
        rate = None if measures is None else events.noise_rate
        measured = np.zeros(spill.sensor_size, np.bool_)
        on, off = events.thresholds
        self._spill = spill
        self._heights = events.trail * on, events.trail * off
        self._scales: list[float] = []
        delay = events.lateness
        followed, start = nothing_followed(spill.sensor_size), spill.start
        for index in range(len(spill)):
            end = spill.middle(index)
            chunks = spill.events_between(start + delay, end + delay, hot)
            if on_events is not None:
                chunks = counted(chunks, on_events)
            before = followed
            counts_on, counts_off, followed = follow(chunks, before, start + delay, end + delay)
            if rate is not None and measures is not None:
                latest = measures(spill.reversed_frame(len(spill) - 1 - index))
                if index > 0:
                    seconds = (end - start) * 1e-6
                    shares = signal_shares(counts_on, counts_off, rate * seconds, ~(measured | latest))
                    followed = with_surety(before, followed, shares)
                measured = latest
            spill.save_newest_events(index, followed.newest - 2 * delay, followed.surety)
            self._scales.append(followed.scale)
            start = end

    def reversed_trail(self, index: int) -> FrameTrail:
        """Of the frame ``index`` of the reversed recording."""
        forward = len(self._spill) - 1 - index
        newest = self._spill.newest_events(forward)
        middle = self._spill.middle(forward)
        after = min(forward + 1, len(self._spill) - 1)
        return FrameTrail(
            *(trail_at(newest, middle, (self._scales[k], *self._heights)) for k in (forward, after))
        )


class BackwardPass:
    """The engine on a reversed recording, and how much of it has been pushed. It can be pickled."""

    def __init__(self, engine: Reconstructor) -> None:
        self.engine = engine
        self.frames = 0
        self.events = 0

    def reach(
        self,
        spill: Spill,
        trails: Trails | None,
        t: int,
        on_events: Callable[[int], None] | None = None,
    ) -> None:
        """Push until ``t`` (us, reversed) is final, freeing what lies before it."""
        engine = self.engine
        while True:
            if engine.final_until is not None and engine.final_until >= t:
                engine.forget(t)
                return
            newest = engine.newest_frame_end
            if newest is not None and not engine.covers(newest):
                self._push_events(spill, on_events)
            elif self.frames < len(spill):
                if engine.final_until is not None:
                    engine.forget(engine.final_until)
                trail = None if trails is None else trails.reversed_trail(self.frames)
                engine.push_frame(spill.reversed_frame(self.frames), trail=trail)
                self.frames += 1
            else:
                engine.end_frames()
                self._push_events(spill, on_events)

    def _push_events(self, spill: Spill, on_events: Callable[[int], None] | None) -> None:
        block = spill.reversed_events(self.events)
        if len(block) == 0:
            if self.frames == len(spill):
                self.engine.finish()
            else:
                newest = self.engine.newest_frame_end
                assert newest is not None
                self.engine.advance(newest + self.engine.settings.events.lateness)
            return
        self.engine.push_weighed(block)
        self.events += len(block)
        if on_events is not None:
            on_events(len(block))


class Backward:
    """The backward pass over a recording, ready to be asked for its estimates in ascending order of time.

    Parameters
    ----------
    recording, engine
        The recording, and a fresh engine for the reversed one.
    times
        (N,) int64 us, ascending: the images that will be asked for.
    folder
        An existing folder for what is spilled, the caller's to remove.
    on_events
        Told the number of events of every block that is copied, that is followed, and that the first pass has taken: of
        each event up to three times.
    trail
        Settings and hot pixels of the forward filter, if it tells how far the light is ahead of its events (K14).

    Raises
    ------
    OutputError
        The folder cannot be written.
    """

    def __init__(
        self,
        recording: Recording,
        engine: Reconstructor,
        times: NDArray[np.int64],
        folder: Path,
        on_events: Callable[[int], None] | None = None,
        *,
        trail: tuple[Settings, NDArray[np.bool_] | None] | None = None,
    ) -> None:
        height, width = recording.sensor_size
        self._spill = Spill(recording, folder, engine.settings.events.refractory, on_events)
        measures = engine.measures if engine.lookahead else None
        self._trails = None if trail is None else Trails(self._spill, *trail, measures, on_events)
        times = times[times <= self._spill.end]
        window = max(1, _WINDOW_BYTES // (16 * height * width))
        self._windows = [times[i : i + window] for i in range(0, len(times), window)]
        self._folder = folder
        self._current: dict[int, Estimate] = {}
        self._next_window = 0
        backward = BackwardPass(engine)
        for index in reversed(range(len(self._windows))):
            backward.reach(self._spill, self._trails, -int(self._windows[index][-1]), on_events)
            self._save(index, backward)

    def estimate(self, t: int) -> Estimate | None:
        """L' and P' at ``t`` (us), one of the times announced, in ascending order; None after the last frame."""
        if t > self._spill.end:
            return None
        while t not in self._current:
            self._load()
        return self._current[t]

    def _load(self) -> None:
        """Run the next window."""
        backward: BackwardPass = pickle.loads(self._state_path(self._next_window).read_bytes())
        self._current = {}
        for t in self._windows[self._next_window][::-1].tolist():
            if t in self._current:
                continue
            backward.reach(self._spill, self._trails, -t)
            self._current[t] = dataclasses.replace(backward.engine.estimate(-t), chroma=None)
        self._state_path(self._next_window).unlink()
        self._next_window += 1

    def _save(self, index: int, backward: BackwardPass) -> None:
        with spilling(self._folder):
            self._state_path(index).write_bytes(pickle.dumps(backward, pickle.HIGHEST_PROTOCOL))

    def _state_path(self, index: int) -> Path:
        return self._folder / f"state_{index:06d}.pickle"


def combine(
    forward: Estimate,
    backward: Estimate | None,
    trail: NDArray[np.floating[Any]] | None = None,
    threshold2: float = 0.0,
) -> Estimate:
    """The smoothed estimate of two filters, in the forward one's time.

    Parameters
    ----------
    forward, backward
        Estimates of one moment. None, after the last frame: the forward one stands alone.
    trail
        (H, W) how far, in log intensity, the light is ahead of its events (K14), which the backward filter's estimates
        are without; None: nowhere.
    threshold2
        c^2.
    """
    if backward is None:
        return forward
    first, second = 1.0 / forward.variance, 1.0 / backward.variance
    information = first + second
    behind = backward.log_intensity if trail is None else backward.log_intensity + trail
    level = (first * forward.log_intensity + second * behind) / information
    directions = (
        (forward.log_intensity, forward.variance, forward.unshown),
        (behind, backward.variance, backward.unshown),
    )
    variance, signalled = 1.0 / information, None
    mean = np.sqrt(first * second)
    shared = shared_errors(forward.around, backward.around, mean)
    if shared is not None:
        together = (information + 2.0 * shared * mean) / information**2
        black = _black(forward.around, backward.around)
        variance, signalled = np.where(black, variance, together), np.where(black, together, variance)
    smoothed = (level, variance) if signalled is None else (level, variance, signalled)
    obey_bounds(smoothed, *directions)
    obey_bounds(smoothed, *directions[::-1])
    unshown = smoothed_unshown(level, *directions)
    change = _mean_of_both(forward.silent_change, backward.silent_change)
    return Estimate(
        t=forward.t,
        log_intensity=level,
        variance=variance,
        white=forward.white,
        final=forward.final,
        moving=_moving(forward.moving, backward.moving, change, threshold2),
        between=forward.between,
        chroma=forward.chroma,
        unshown=unshown,
        silent_change=change,
        around=_around(forward.around, backward.around),
        unmeasured=forward.unmeasured,
        exposed=forward.exposed,
        since=_shorter(forward.since, backward.since),
        signalled_variance=signalled,
        paths=forward.paths,
        share=forward.share,
        texture=forward.texture,
    )


def _around(forward: Around | None, backward: Around | None) -> Around | None:
    """The forward one, with the next frame counted already, and what both directions say of half-way.

    At the middle of a frame both are about to count that.
    """
    if forward is None:
        return None
    if backward is None:
        return forward._replace(counted=UNMEASURED)
    half_way = (forward.half_way + backward.half_way) / 2.0
    by_none = forward.share == backward.share == 1.0
    return forward._replace(counted=0.0 if by_none else UNMEASURED, half_way=half_way)


def shared_errors(
    forward: Around | None, backward: Around | None, information: NDArray[np.floating[Any]]
) -> NDArray[np.floating[Any]] | None:
    """(H, W) correlation of the errors of the two directions: how far both go by the same frames.

    From the first frame around to the second both go along one bridge (K1), and each knows the one ahead of it through
    this bridge as well as the other knows it from behind. With s the share of the way to the second frame, their
    errors are the same by 1 - s where the first frame measures the pixel, and by s where the second does: all where
    both do, and none where neither does and each direction comes from a frame of its own. What else they know, neither
    is told where the light is between its latest event and its next: the variance that no event tells (K1, K18), out of
    one over ``information``, (H, W), the geometric mean of both. None: not told.
    """
    if forward is None or backward is None:
        return None
    untold = told_by_none(forward.untold, forward.quantisation_variance, information.shape)
    unsignalled: NDArray[Any] = np.minimum(untold * information, np.float32(1.0))
    share = np.float32(forward.share)
    first, second = forward.first < UNMEASURED, forward.second < UNMEASURED
    same = (np.float32(1.0) - share) * first + share * second
    return unsignalled + (np.float32(1.0) - unsignalled) * same


def _black(forward: Around | None, backward: Around | None) -> NDArray[np.bool_]:
    """(H, W): where a frame around is black, which tells both directions the same (K7).

    That is no noise, which neighbours could take away (K12): it counts in the variance that is given out alone.
    """
    assert forward is not None
    assert backward is not None
    ends = (around.second for around in (forward, backward))
    first, second = ((end >= REPEATED) & (end < UNMEASURED) for end in ends)
    return first | second


def _moving(
    first: NDArray[np.bool_] | None,
    second: NDArray[np.bool_] | None,
    change: NDArray[np.floating[Any]] | None,
    threshold2: float,
) -> NDArray[np.bool_] | None:
    """Pixels that move in both directions, or in one where what is silent around them changes, too.

    Where the surroundings stand still, what comes by before or after says nothing against the texture that frames show.
    """
    if first is None or second is None:
        return None
    if change is None:
        return first | second
    return (first & second) | ((first | second) & (change > _STANDS_STILL * threshold2))


def _shorter(first: float | None, second: float | None) -> float | None:
    """`Estimate.since` of both: where there is only one frame, one filter may not know the usual interval yet."""
    return None if first is None or second is None else min(first, second)


def _mean_of_both(
    first: NDArray[np.floating[Any]] | None, second: NDArray[np.floating[Any]] | None
) -> NDArray[np.floating[Any]] | None:
    """Before the first frame and after the last only one of them knows."""
    if first is None or second is None:
        return second if first is None else first
    return (first + second) / 2


def reversed_settings(settings: Settings) -> Settings:
    """Those of the reversed recording: an on event is a step down by the on threshold, and late is early."""
    events = dataclasses.replace(
        settings.events,
        threshold_on=settings.events.threshold_off,
        threshold_off=settings.events.threshold_on,
        delay=-settings.events.lateness,
        trail=0.0,
    )
    camera = dataclasses.replace(settings.camera, row_time=-settings.camera.row_time)
    # Images have the forward filter's.
    filtered = dataclasses.replace(settings.filter, motion="off", neighbours=0.0)
    return dataclasses.replace(settings, camera=camera, events=events, filter=filtered)


def reversed_pixels(pixels: PixelCalibration | None) -> PixelCalibration | None:
    """What is known of single pixels, of the reversed recording: on and off change places."""
    if pixels is None:
        return None
    return dataclasses.replace(
        pixels,
        on=pixels.off,
        off=pixels.on,
        on_variance=pixels.off_variance,
        off_variance=pixels.on_variance,
    )
