"""The default method: `kalux.augmentation.bridge` joins successive frames, and the exact filter follows the bridge."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation import bridge, deblur
from kalux.augmentation.background import doubt, signal_shares
from kalux.augmentation.beyond import Beyond, follow_beyond, nothing_beyond
from kalux.augmentation.bridge import BridgedSegment, BridgeNoise, Latent, Thresholds, UnshownMemory
from kalux.augmentation.deblur import EXPOSED, EXPOSURE_FIELDS, Exposure, relative_levels
from kalux.augmentation.highlights import (
    FrameHighlights,
    Tail,
    Unshown,
    above_frames,
    begin_unshown,
    expected_excess,
    expected_of_shown,
    follow_unshown,
)
from kalux.augmentation.lost import add_lost_change, loss_between, lost_change, unheard_change
from kalux.augmentation.motion import HalfWay, Paths, Plane, behind, find_path
from kalux.augmentation.refractory import growth_with_period
from kalux.augmentation.rolling import carried, in_time_of_rows
from kalux.augmentation.subthreshold import (
    BLACK_CHANGE,
    UNKNOWN_CHANGE,
    Usual,
    add_missed_change,
    correlation,
    follow_silent,
    half_way,
    nothing_usual,
    silent_change,
    turns,
)
from kalux.augmentation.texture import Texture, frame_texture, shown_texture
from kalux.augmentation.trail import (
    Followed,
    Trail,
    follow,
    given_trail,
    nothing_followed,
    signed_surety,
    trail_at,
    trail_between,
    with_surety,
)
from kalux.compiled import ONE, apart, empty, larger, loop, smaller
from kalux.event_slices import all_between, whole_row_delays
from kalux.events import EventArray
from kalux.filters import akf_bridged
from kalux.filters.akf import State
from kalux.filters.common import make_clock
from kalux.filters.method import FAR_FUTURE, USUAL_INTERVAL, Chunks, Method, Segment
from kalux.filters.shots import Shot, level_variance
from kalux.filters.surfaces import Unmeasured
from kalux.filters.uncertainty import Around
from kalux.models.camera import CRUSHED, beyond_white, dark_scale, log_intensity
from kalux.models.dark_levels import dark_correction, dark_shares
from kalux.models.dark_steps import dark_step_variance, dark_steps
from kalux.models.pixels import PixelCalibration
from kalux.settings import Settings

Array = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]

Counts = tuple[Floats, Floats]
"""(H, W) on and off events of every pixel."""

_SHARES: Final = (np.arange(64) + 0.5) / 64
"""Quantiles at which the distribution of black pixels is sampled."""

_SATURATED: Final = 4.0
"""Variance of the change between two frames that both clip a pixel, in units of the squared `highlight_scale`: twice
that of the difference of two highlights, since some lie far out (docs/equations.md, K2)."""

_BLACK_FRAMES: Final = 3.0
"""Black frames of a pixel that count as one measurement, since their errors are the same (docs/equations.md, K7)."""

_DARKEST: Final = 10.0
"""Largest log intensity below white that is told apart, so that black, log 0, stays finite."""

_GROWTH: Final = (np.float32(1 / 12), np.float32(1 / 20))
"""By how much the variance of a correction grows with the events that make it, and with their square: fits squared
errors of 63 simulated scenes, from one event to thirty (docs/equations.md, K3)."""

_CORRECTION: Final = np.float32(0.01)
"""Variance of what an exposure's light asks of a correction, c^2 for each squared number of its events: of corrections
themselves it is 0.08 of one event, 0.013 of five, 0.02 to 0.03 of many."""

_TINY: Final = np.float32(1e-30)  # what is divided by at least

_LEAST_ERROR: Final = 1e-9
"""Least standard deviation of a threshold, log intensity, since it is divided by."""


class SinceMeasured(NamedTuple):
    """What events have told since a frame last measured each pixel; 0 where the latest frame does (K10).

    Attributes
    ----------
    on, off
        (H, W) number of events.
    by_period
        (H, W) log intensity: what the standard error of the refractory period adds to their change; None: the period is
        known.
    """

    on: Floats
    off: Floats
    by_period: Floats | None


class BridgeMemory(NamedTuple):
    """What later segments need of the frames until now.

    Attributes
    ----------
    latent, thresholds
        The latest frame, deblurred, and the pixels' thresholds as learned so far.
    interval
        Between the latest two frames, s; the usual one until there are two.
    since_middle
        Events from the middle of the latest exposure to its end; in causal mode only.
    since_measured
        Events since a frame last measured a pixel, to the latest node.
    first_start
        Start of the first exposure, us.
    followed, at_middle
        The pixels' newest events (K14) at the latest node, and at the middle of the latest exposure; they differ in
        causal mode only.
    unshown, tail
        Pixels that no frame has measured yet, and the distribution of highlights (K15).
    silent_change
        (H, W) mean square change of the silent pixels around each (K11).
    latest_change
        (H, W) change of silent pixels in the latest interval, NaN of others (`subthreshold.correlation`).
    usual
        What the latest intervals tell of silent pixels.
    texture
        What the latest frame tells of how neighbours differ (K12); None: nothing, as the first one.
    beyond
        Pixels that it clips, and that one before has measured (K7).
    """

    latent: Latent
    thresholds: Thresholds
    interval: float
    since_middle: Counts
    since_measured: SinceMeasured
    first_start: int
    followed: Followed
    at_middle: Followed
    unshown: UnshownMemory
    tail: Tail
    silent_change: Floats
    latest_change: Floats
    usual: Usual
    texture: Texture | None
    beyond: Beyond


class BridgedFrames(Method):
    """The default: `bridge` from the middle of one exposure to that of the next, the exact filter.

    Causal mode (``lookahead=False``) goes from the end of one exposure to the end of the next, forward only.
    """

    def __init__(
        self,
        settings: Settings,
        lookahead: bool,
        shape: tuple[int, int],
        pixels: PixelCalibration | None,
    ) -> None:
        super().__init__(settings, lookahead, shape)
        events, self._threshold2 = settings.events, self.on * self.off  # c^2
        scale2 = _SATURATED * settings.filter.highlight_scale**2
        self.noise = BridgeNoise(
            self.on,
            self.off,
            events.step_noise * self._threshold2,
            events.quantisation_variance * self._threshold2,
            scale2 if scale2 > 0 else bridge.UNMEASURED,
        )
        self._spread2 = events.believed_mismatch**2  # K11
        self._period_spread = events.refractory_doubt if events.refractory > 0 else 0.0
        delays = whole_row_delays(shape[0], settings.camera.row_time)
        self._dark_shares = dark_shares(settings.filter.dark_shares)
        self._dark_steps = dark_steps(settings.events.dark_steps)
        self._row_delays = delays if delays.any() else None
        self._follows_motion = settings.filter.follows_motion(shape)
        self._unlike = settings.filter.neighbours**2
        self._event_noise = akf_bridged.Noise(events.background_rate, events.step_noise, self._threshold2)
        self._prior = (
            bridge.nominal_thresholds(shape, settings.events.mismatch, np.float32)
            if pixels is None
            else Thresholds(
                *(
                    values.astype(np.float32)
                    for values in (pixels.on, pixels.off, pixels.on_variance, pixels.off_variance)
                )
            )
        )

    def node(self, shot: Shot) -> int:
        return shot.middle if self.lookahead else shot.end

    def begin_time(self, shot: Shot) -> int:
        return shot.start if self.lookahead else shot.end

    def needed_from(self, shot: Shot) -> int:
        return shot.start - self._reach

    def needed_until(self, shot: Shot) -> int:
        return shot.end + self._reach

    @property
    def _reach(self) -> int:
        """us from the middle of a frame to that of the row that is exposed first, or last."""
        return 0 if self._row_delays is None else int(np.abs(self._row_delays).max())

    def latent(self, shot: Shot, events: Chunks, thresholds: Thresholds) -> Latent:
        """The frame without blur at the middle of its exposure, and its variance (K3).

        Rows of a rolling shutter are brought there from the middle of their own exposures by events (K19).
        """
        inside = events
        if self._row_delays is not None:
            inside = in_time_of_rows(events, self._row_delays, shot.start, shot.end)
        exposure = deblur.expose(
            inside if self.settings.filter.deblur else (),
            shot.start,
            shot.end,
            (thresholds.on, thresholds.off),
            (self.on, self.off),
            weighed=True,
        )
        level_variance = self.level_variance(shot)
        level_variance[shot.level_clipped] = bridge.UNMEASURED
        level_log = self.level_log(shot)
        crushed = self.crushed(shot)
        if crushed is not None:
            level_log[crushed], level_variance[crushed] = self.black(shot, crushed)
        latent = latent_frame(
            shot.levels,
            level_log,
            level_variance,
            exposure,
            duration=shot.end - shot.start,
            deblur_variance=self.settings.events.deblur_variance,
            threshold2=self._threshold2,
        )
        if self._row_delays is not None:
            self._carry_rows(latent, shot, events, thresholds)
        if shot.valid is not None:
            latent.variance[~shot.valid] = bridge.MASKED
        if crushed is None:
            return latent
        room = np.where(crushed, np.log(shot.level_ceiling + self.offset) - level_log, np.inf)
        return latent._replace(ceiling=latent.value + room.astype(np.float32)[shot.levels])

    def _carry_rows(self, latent: Latent, shot: Shot, events: Chunks, thresholds: Thresholds) -> None:
        """Bring all rows to the middle of the frame, at the price of what events tell and do not (K19). In place."""
        assert self._row_delays is not None
        on, off, around = carried(events, self._row_delays, shot.middle, self.shape[1], weighed=True)
        latent.value[...] += np.float32(self.on) * thresholds.on * on
        latent.value[...] -= np.float32(self.off) * thresholds.off * off
        expected = around * (np.abs(self._row_delays) / (2 * self._reach))[:, np.newaxis].astype(np.float32)
        untold = np.minimum(
            np.float32(self._threshold2) * expected**2, np.float32(self.noise.quantisation_variance)
        )
        told = np.float32(self.noise.step_variance) * (np.abs(on) + np.abs(off))
        measured = latent.variance < bridge.UNMEASURED
        latent.variance[measured] += (told + untold)[measured]

    def level_log(self, shot: Shot) -> Array:
        """(N,) log(I + I_0) of each level, of dark ones such that the mean of noisy frames is right (K3).

        As it is where the noise is not known, or is not that of the levels: of a response that bends, and of colours.
        """
        told = log_intensity(shot.level_intensity, self.offset)
        camera = self.settings.camera
        if camera.frame_noise is None or not camera.is_linear or shot.chroma is not None:
            return told
        levels, shares = shot.level_intensity, self._dark_shares
        return told + dark_correction(levels, camera.noise, shot.white, self.offset, shot.gap, shares)

    def level_variance(self, shot: Shot) -> Array:
        """(N,) variance of log(I + I_0) of each level, by the noise of the frame alone."""
        return level_variance(shot, self.settings.camera.noise, self.offset)

    def crushed(self, shot: Shot) -> NDArray[np.bool_] | None:
        """(N,) black levels that cover more intensities than a linear response's; None: there are none.

        With a linear response 0 is a measurement like others.
        """
        black = np.isfinite(shot.level_ceiling)
        hides = shot.level_ceiling > CRUSHED * shot.white
        return black & hides if hides[black].any() else None

    def black(self, shot: Shot, crushed: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Mean and variance of log(I + I_0) of the black levels, (N,) each (K7)."""
        seen = shot.levels if shot.valid is None else shot.levels[shot.valid]
        counts = np.bincount(seen.ravel(), minlength=len(shot.level_intensity))
        ceilings, place = np.unique(shot.level_ceiling[crushed], return_inverse=True)
        scale = dark_scale(shot.level_intensity, counts, float(ceilings[-1]), shot.white)
        middle = np.log(ceilings * np.exp(-scale) + self.offset)
        away = np.log(ceilings[:, None] * _SHARES**scale + self.offset) - middle[:, None]
        return middle[place], _BLACK_FRAMES * np.square(away).mean(axis=1)[place]

    def start(self, shot: Shot, events: Chunks) -> tuple[BridgeMemory, Segment | None, State]:
        thresholds = self._prior
        latent = self.latent(shot, events, thresholds)
        begin = self.begin_time(shot)
        nothing, none = nothing_followed(self.shape), np.zeros(self.shape, np.float32)
        filtered = self.settings.filter
        tail = Tail(filtered.unshown_tail, beyond_white(shot.bright_tail), filtered.believed_unshown_scale)
        if self.lookahead:
            on, off, followed = self.follow(events, begin, shot.middle, nothing)
        else:
            # The clock begins at the end of the exposure: events before are not known.
            (on, off), followed = self.counts(events, shot.middle, shot.end), nothing
        memory = BridgeMemory(
            latent=latent,
            thresholds=thresholds,
            interval=USUAL_INTERVAL * 1e-6,
            since_middle=(on, off),
            since_measured=SinceMeasured(none, none, none if self._period_spread > 0 else None),
            first_start=shot.start,
            followed=followed,
            at_middle=followed,
            unshown=begin_unshown(latent, frame_highlights(shot), tail),
            tail=tail,
            silent_change=np.full(self.shape, UNKNOWN_CHANGE * self._threshold2, np.float32),
            latest_change=np.full(self.shape, np.nan, np.float32),
            usual=nothing_usual(self.shape),
            texture=None,
            beyond=nothing_beyond(),
        )
        lead_in, value, variance = None, latent.value, latent.variance
        if not self.lookahead:
            value, variance, _ = self._latent_at_end(memory, shot)
        elif shot.middle > begin:
            lead_in = bridge.extend_backward(latent, on, off, thresholds, self.noise, begin, shot.middle)
            lead_in = lead_in._replace(
                still_since=shot.start, trail=self._lead_in_trail(shot, followed), unshown=memory.unshown
            )
            value = lead_in.augmented
            variance = lead_in.backward_variance + lead_in.step_variance * (on + off)
        unmeasured = variance >= bridge.UNMEASURED
        variance = np.where(unmeasured, np.float32(self.settings.filter.initial_variance), variance)
        if shot.valid is not None:
            variance[~shot.valid] = self.masked_variance(shot)
        return memory, lead_in, State(value, variance, make_clock(self.shape, begin - shot.start))

    def segment(
        self, memory: BridgeMemory, shot: Shot, following: Shot | None, events: Chunks
    ) -> tuple[Segment, BridgeMemory]:
        if following is None:
            return self._open_segment(memory, shot), memory
        second = self.latent(following, events, memory.thresholds)
        join = self._lookahead_segment if self.lookahead else self._causal_segment
        return join(memory, shot, following, second, events)

    def _texture(self, latent: Latent, shot: Shot, steps: Counts) -> Texture | None:
        """What a frame tells of how neighbours differ (K12), given the events before it; None: K12 is off."""
        if self._unlike == 0:
            return None
        return frame_texture(latent, steps[0] + steps[1], self._unlike, shot.pitch)

    def _shown_texture(
        self, textures: Sequence[Texture | None], frames: Sequence[Latent]
    ) -> NDArray[np.float32] | None:
        """(H, W) the variance by which neighbours differ, by the textures of the frames around."""
        told = [texture for texture in textures if texture is not None]
        return shown_texture(told, frames, self._unlike) if told else None

    def _follow_unshown(
        self,
        memory: BridgeMemory,
        second: Latent,
        following: Shot,
        net: Floats,
        steps: Counts,
        seen: Callable[[], FrameHighlights],
    ) -> UnshownMemory:
        if len(memory.unshown.pixels) == 0:
            return memory.unshown
        levels = following.levels.reshape(-1)[memory.unshown.pixels]
        noise = self.level_variance(following)[levels]
        moved = self.off / 2
        return follow_unshown(memory.unshown, second, seen(), noise, net, steps, moved, memory.tail)

    def _beyond_bounds(
        self,
        segment: BridgedSegment,
        memory: BridgeMemory,
        second: Latent,
        change: Floats,
        seen: Callable[[], FrameHighlights],
    ) -> tuple[BridgedSegment, Beyond]:
        """The segment, in which L goes on beyond the bounds of the second frame (K7), and what later ones need of it.

        Where events are missing, nothing says how little an unheard change is.
        """
        if segment.lost is not None or memory.tail.share == 0:
            return segment, nothing_beyond()
        q0 = self.noise.quantisation_variance
        return follow_beyond(
            memory.beyond,
            segment,
            memory.latent,
            second,
            change,
            q0,
            lambda pixels: expected_of_shown(memory.unshown, seen(), pixels, memory.tail),
        )

    def _open_segment(self, memory: BridgeMemory, shot: Shot) -> BridgedSegment:
        """The segment from the latest frame on, while there is no next one."""
        start = self.node(shot)
        latent = memory.latent if self.lookahead else self._latent_at_end(memory, shot)
        alone = bridge.extend(latent, memory.thresholds, self.noise, start, FAR_FUTURE, memory.interval, None)
        if shot.trail is None:
            trail = self._trail(memory.followed, start, memory.followed.scale)
        else:
            trail = given_trail(shot.trail.before, np.zeros(self.shape, np.float32))
        return alone._replace(
            still_since=_still_since(memory, start),
            trail=trail,
            unshown=memory.unshown,
            silent_change=memory.silent_change,
            texture=self._shown_texture((memory.texture,), (memory.latent,)),
        )

    def _lookahead_segment(
        self, memory: BridgeMemory, shot: Shot, following: Shot, second: Latent, events: Chunks
    ) -> tuple[BridgedSegment, BridgeMemory]:
        """The segment from the middle of one exposure to that of the next, and the memory after it."""
        start, end = shot.middle, following.middle
        on, off, at_middle = self.follow(events, start, end, memory.followed)
        signal = self._signal_shares((on, off), (end - start) * 1e-6, (memory.latent, second))
        if signal is not None:
            at_middle = with_surety(memory.followed, at_middle, signal)
        trail, grown = self._trail_between(memory, shot, following, at_middle)
        steps = (on, off) if signal is None else (on * signal[0], off * signal[1])
        lost = self._lost_change(events, start, end, steps, memory.latent, second)
        dark = None if signal is None else self._of_dark_steps(memory.latent, second)
        joined, learned = bridge.bridge(
            memory.latent,
            second,
            (on, off),
            memory.thresholds,
            self.noise,
            start,
            end,
            grown=grown,
            signal=signal,
            untold=self._untold(lost),
            dark=dark,
        )
        if signal is not None:
            of_steps = doubt(signal, self.noise.step_variance, self._threshold2, dark)
            joined = joined._replace(doubt=of_steps, signal=signal)
        joined, change, remembered = self._with_silent(joined._replace(lost=lost), memory, second, steps)
        seen = functools.cache(functools.partial(frame_highlights, following))
        joined, beyond = self._beyond_bounds(joined, memory, second, change, seen)
        by_period = self._by_period(events, start, end, signal)
        # Where the second frame measures a pixel L^A is led back from it, also at the first frame, which bounds it.
        far = self._since_measured(memory, joined, memory.latent.value)
        assert joined.events is not None
        now_measured = bridge.become_measured(memory.latent, second, joined.events)
        known = memory.thresholds
        untied = bridge.untied_steps(now_measured, known, self.noise, far, (on, off), signal, by_period)
        joined, since_measured = self._with_drift(
            joined._replace(untied=untied), memory, second, (on, off), change, steps, far, by_period
        )
        assert joined.net is not None
        unshown = self._follow_unshown(memory, second, following, joined.net, steps, seen)
        after = remembered._replace(
            latent=second,
            thresholds=learned,
            interval=(end - start) * 1e-6,
            since_measured=since_measured,
            followed=at_middle,
            at_middle=at_middle,
            unshown=unshown,
            texture=self._texture(second, following, steps),
            beyond=beyond,
        )
        frames = memory.latent, second
        assert joined.events is not None
        joined = joined._replace(
            wrong=bridge.wrong_way_back(now_measured, known, self.noise, steps, joined.events),
            trail=trail,
            unshown=unshown,
            silent_change=remembered.silent_change,
            turns=turns(on, off),
            half_way=half_way(remembered.usual.told, self._threshold2),
            latents=frames if self._follows_motion and shot.pitch == 1 else None,
            brightest=max(shot.white, following.white),
            texture=self._shown_texture((memory.texture, after.texture), frames),
        )
        return joined, after

    def _causal_segment(
        self, memory: BridgeMemory, shot: Shot, following: Shot, second: Latent, events: Chunks
    ) -> tuple[BridgedSegment, BridgeMemory]:
        """The segment from the end of one exposure to that of the next, forward only, and the memory after it.

        The second frame is not known yet when the segment is read. The bridge to it is made for what later segments
        need: thresholds, silent pixels, highlights.
        """
        start = shot.end
        on, off, at_middle = self.follow(events, start, following.middle, memory.followed)
        scale = memory.followed.scale
        since_on, since_off = memory.since_middle
        grown = self._trail_at(at_middle, following.middle, scale)
        grown -= self._trail_at(memory.at_middle, shot.middle, scale)
        between = on + since_on, off + since_off
        lost = self._lost_change(events, start, following.end, between, memory.latent, second)
        untold = self._untold(lost)
        behind, learned = bridge.bridge(
            memory.latent,
            second,
            between,
            memory.thresholds,
            self.noise,
            shot.middle,
            following.middle,
            grown=grown,
            untold=untold,
        )
        assert behind.net is not None
        tail_on, tail_off, followed = self.follow(events, following.middle, following.end, at_middle)
        after = memory._replace(
            latent=second,
            thresholds=learned,
            interval=(following.middle - shot.middle) * 1e-6,
            since_middle=(tail_on, tail_off),
            followed=followed,
            at_middle=at_middle,
            unshown=self._follow_unshown(
                memory, second, following, behind.net, between, lambda: frame_highlights(following)
            ),
            silent_change=memory.silent_change if lost is not None else self._silent_change(behind, between),
            texture=self._texture(second, following, between),
        )
        forward = bridge.extend(
            self._latent_at_end(memory, shot),
            memory.thresholds,
            self.noise,
            start,
            following.end,
            memory.interval,
            self._latent_at_end(after, following),
        )._replace(untold=untold, lost=lost)
        counts, change = (on + tail_on, off + tail_off), memory.silent_change
        by_period = self._by_period(events, start, following.end, None)
        far = self._since_measured(memory, forward, forward.augmented)
        forward, since_measured = self._with_drift(
            forward, memory, second, counts, change, counts, far, by_period
        )
        forward = forward._replace(
            trail=self._trail(memory.followed, start, scale),
            unshown=memory.unshown,
            silent_change=change,
            texture=self._shown_texture((memory.texture,), (memory.latent,)),
        )
        return forward, after._replace(since_measured=since_measured)

    def follow(
        self, events: Chunks, start: int, end: int, before: Followed
    ) -> tuple[Floats, Floats, Followed]:
        """`counts`, and the pixels' newest events at ``end`` (K14)."""
        return follow(all_between(events, start, end), before, start, end)

    def _trail(self, followed: Followed, start: int, scale: float) -> Trail:
        """By how much events trail the light in the segment from ``start`` on (K14)."""
        at_start = self._trail_at(followed, start, scale)
        return Trail(at_start, signed_surety(followed.events), scale, *self._trail_heights)

    def _trail_between(
        self, memory: BridgeMemory, shot: Shot, following: Shot, at_end: Followed
    ) -> tuple[Trail, Floats]:
        """The same from the middle of one exposure to that of the next, and its growth until then."""
        if shot.trail is not None and following.trail is not None:
            before, after = shot.trail.before, following.trail.after
            return given_trail(before, after), after - before
        newest, heights = memory.followed.events, self._trail_heights
        span = shot.middle, following.middle
        at_start, grown = trail_between(newest, at_end.events, span, (at_end.scale, *heights))
        return Trail(at_start, signed_surety(newest), at_end.scale, *heights), grown

    def _lead_in_trail(self, shot: Shot, followed: Followed) -> Trail:
        """The same before the middle of the first exposure, where the frame's level stays as it is."""
        if shot.trail is not None:
            return given_trail(shot.trail.after, shot.trail.after)
        trail = self._trail(followed, shot.middle, followed.scale)
        return trail._replace(signed=np.zeros(self.shape, np.int8))

    def _trail_at(self, followed: Followed, t: int, scale: float) -> NDArray[np.float32]:
        return trail_at(followed.events, t, (scale, *self._trail_heights))

    def _signal_shares(
        self, counts: tuple[Floats, Floats], seconds: float, frames: tuple[Latent, Latent]
    ) -> tuple[Floats, Floats] | None:
        """Which share of the pixels' on and off events is signal (K5); None where their noise is not known."""
        rate = self.settings.events.noise_rate
        if rate is None:
            return None
        first, second = (frame.variance >= bridge.UNMEASURED for frame in frames)
        return signal_shares(*counts, rate * seconds, first & second)

    def _of_dark_steps(self, first: Latent, second: Latent) -> NDArray[np.float32] | None:
        """(H, W) what the variance of a step of dark pixels is more (K20); None: nothing."""
        if self._dark_steps is None:
            return None
        return dark_step_variance(first.value, second.value, self._dark_steps, self.offset, self._threshold2)

    @property
    def _trail_heights(self) -> tuple[float, float]:
        height = self.settings.events.trail
        return height * self.on, height * self.off

    def _lost_change(
        self, events: Chunks, start: int, end: int, steps: Counts, first: Latent, second: Latent
    ) -> Floats | None:
        """(H, W) variance of the change by events that are missing in an interval, given those that are there (K18).

        None where it is nowhere more than q_0, or nothing moved unheard.
        """
        loss = loss_between(all_between(events, start, end), start, end)
        if loss.time == 0 and not loss.unheard:
            return None
        told = np.float32(self.on) * steps[0] - np.float32(self.off) * steps[1]
        if loss.unheard:
            return unheard_change(first, second, told, self._threshold2)
        variance = lost_change(told, loss.time, end - start)
        return variance if float(variance.max()) > self.noise.quantisation_variance else None

    def _untold(self, lost: Floats | None) -> Floats | None:
        """(H, W) variance of all that no event has told: what is lost, and q_0. None: nothing is lost."""
        return None if lost is None else lost + np.float32(self.noise.quantisation_variance)

    def _with_silent(
        self, segment: BridgedSegment, memory: BridgeMemory, second: Latent, steps: Counts
    ) -> tuple[BridgedSegment, Floats, BridgeMemory]:
        """The segment in which silent pixels follow the frames (K1), their change in it, and the memory with both.

        Where events are missing, a pixel without one is not known to be silent: those that are change as before (K18).
        """
        if segment.lost is not None:
            unknown = np.full(self.shape, np.nan, np.float32)
            return segment, memory.silent_change, memory._replace(latest_change=unknown)
        quantisation, threshold2 = self.noise.quantisation_variance, self._threshold2
        change = self._silent_change(segment, steps)
        told, latest_change = correlation(memory.latest_change, segment, quantisation, threshold2)
        usual = memory.usual.with_interval(change, told)
        shown = self._with_black_change(
            usual.mixed(change, half_way(usual.told, threshold2)), memory.latent, second
        )
        followed = follow_silent(segment, memory.latent, change, quantisation, threshold2)
        remembered = memory._replace(silent_change=shown, latest_change=latest_change, usual=usual)
        return followed, change, remembered

    def _silent_change(self, segment: BridgedSegment, steps: Counts) -> Floats:
        """K11, given the on and the off events as far as they are signal."""
        active = np.minimum(steps[0] + steps[1], np.float32(1.0))
        return silent_change(segment, active, self.noise.quantisation_variance, self._threshold2)

    def _with_black_change(self, change: Floats, *frames: Latent) -> Floats:
        """The ``change`` of silent pixels, larger where a frame is black and cannot show that it is small (K11)."""
        for frame in frames:
            if frame.ceiling is not None:
                unknown = np.float32(BLACK_CHANGE * self._threshold2)
                change = np.where(np.isfinite(frame.ceiling), unknown, change)
        return change

    def _with_drift(
        self,
        segment: BridgedSegment,
        memory: BridgeMemory,
        second: Latent,
        counts: tuple[Floats, Floats],
        change: Floats,
        steps: Counts,
        far: SinceMeasured,
        by_period: Floats | None,
    ) -> tuple[BridgedSegment, SinceMeasured]:
        """The segment with the drift of its pixels (K10), and the events since they were last measured, at its end.

        ``counts`` are its on and off events, ``steps`` those as far as they are signal, ``far`` those since a frame
        last measured each pixel, ``by_period`` is what the error of the refractory period adds to ``steps``, ``change``
        the mean square change of silent pixels around each (K11).
        """
        grown, far_on, far_off = bridge.drift(
            memory.latent, second, memory.thresholds, self.noise, (far.on, far.off), steps
        )
        far_period = far.by_period
        if far_period is not None and by_period is not None:
            more, far_period = bridge.period_drift(second, far_period, by_period)
            np.maximum(grown + more, np.float32(0.0), out=grown)
        if segment.lost is not None:
            assert segment.untold is not None
            add_lost_change(grown, memory.latent, second, segment.untold, segment.lost)
        else:
            add_missed_change(grown, segment, second, counts, change, self.noise.quantisation_variance)
        if second.ceiling is not None:
            black = np.isfinite(second.ceiling)
            grown[black] = second.variance[black] / (_BLACK_FRAMES * (_BLACK_FRAMES + 1))
        segment = segment._replace(drift=grown, still_since=_still_since(memory, segment.start))
        return segment, SinceMeasured(far_on, far_off, far_period)

    def _by_period(
        self, events: Chunks, start: int, end: int, signal: tuple[Floats, Floats] | None
    ) -> Floats | None:
        """(H, W) log intensity: what the refractory period's standard error adds by the events of an interval (K10).

        As far as they are ``signal``, if that is known. None: the period is known.
        """
        if self._period_spread == 0:
            return None
        up: Floats
        down: Floats
        up, down = growth_with_period(all_between(events, start, end), self.shape)
        if signal is not None:
            up, down = up * signal[0], down * signal[1]
        return (
            np.float32(self._period_spread * self.on) * up - np.float32(self._period_spread * self.off) * down
        )

    def _since_measured(self, memory: BridgeMemory, segment: BridgedSegment, level: Floats) -> SinceMeasured:
        """What events have told since a frame measured each pixel, whose ``level`` the frame at the start bounds.

        Of a pixel that no frame has measured, at most as much as raises its bound above those by the frames (K15).
        """
        pixels, known = memory.unshown.pixels, memory.thresholds
        if len(pixels) == 0:
            return memory.since_measured
        above = above_frames(segment, level, pixels, memory.unshown.bound)
        on, off = memory.since_measured.on.copy(), memory.since_measured.off.copy()
        steps = (self.on, known.on_variance), (self.off, known.off_variance)
        for counts, (threshold, variance) in zip((on, off), steps, strict=True):
            each = np.maximum(threshold * np.sqrt(variance.reshape(-1)[pixels]), _LEAST_ERROR)
            counts.reshape(-1)[pixels] = np.minimum(counts.reshape(-1)[pixels], above / each)
        by_period = memory.since_measured.by_period
        if by_period is not None:
            by_period = by_period.copy()
            by_period.reshape(-1)[pixels] = np.clip(by_period.reshape(-1)[pixels], -above, above)
        return SinceMeasured(on, off, by_period)

    def _latent_at_end(self, memory: BridgeMemory, shot: Shot) -> Latent:
        """The latest frame, ``shot``, at the end of its exposure: moved there from its middle by events (10)."""
        on, off = memory.since_middle
        step = self.on * memory.thresholds.on * on - self.off * memory.thresholds.off * off
        scale = memory.followed.scale
        step += self._trail_at(memory.followed, shot.end, scale)
        step -= self._trail_at(memory.at_middle, shot.middle, scale)
        return Latent(
            memory.latent.value + step,
            memory.latent.variance + self.noise.step_variance * (on + off),
            None if memory.latent.ceiling is None else memory.latent.ceiling + step,
        )

    def begin(self, segment: Any, state: State) -> akf_bridged.Cursor:
        return akf_bridged.begin(segment, self._with_limited_bounds(segment, state))

    def _with_limited_bounds(self, segment: BridgedSegment, state: State) -> State:
        """The state at the segment's start, with P of pixels that no frame has measured limited (K15).

        Their bounds are too high by no more than their distance from the bounds by the frames.
        """
        if segment.unshown is None or len(segment.unshown.pixels) == 0:
            return state
        pixels, variance = segment.unshown.pixels, state.variance.copy()
        above = above_frames(segment, segment.augmented, pixels, state.log_intensity.reshape(-1)[pixels])
        most = self.settings.filter.initial_variance + above**2
        variance.reshape(-1)[pixels] = np.minimum(variance.reshape(-1)[pixels], most)
        return state._replace(variance=variance)

    def advance(self, segment: Any, cursor: akf_bridged.Cursor, events: EventArray) -> None:
        akf_bridged.advance(segment, cursor, events, self._event_noise)

    def read(self, segment: Any, cursor: akf_bridged.Cursor, t: int) -> tuple[Floats, Floats]:
        return akf_bridged.read(segment, cursor, t)

    def end(self, segment: Any, cursor: akf_bridged.Cursor) -> State:
        return akf_bridged.end(segment, cursor)

    def moving(self, segment: Any, cursor: akf_bridged.Cursor) -> NDArray[np.bool_]:
        return akf_bridged.moving_pixels(segment, cursor)

    def trail(self, segment: Any, cursor: akf_bridged.Cursor, t: int) -> NDArray[np.float32] | None:
        return akf_bridged.trail_ahead(segment, cursor, t)

    def unshown(self, segment: BridgedSegment, variance: Floats) -> Unshown | None:
        if segment.unshown is None:
            return None
        return expected_excess(segment.unshown, variance, self.settings.filter.initial_variance)

    def silent_change(self, segment: BridgedSegment) -> Floats | None:
        return segment.silent_change

    def texture(self, segment: BridgedSegment) -> Floats | None:
        return segment.texture

    def unmeasured(self, segment: Any, cursor: akf_bridged.Cursor) -> Unmeasured:
        return akf_bridged.unmeasured_pixels(segment, cursor)

    def path(self, segment: BridgedSegment) -> Plane | None:
        if segment.latents is None:
            return None
        limits = (float(np.log(intensity + self.offset)) for intensity in (0.0, segment.brightest))
        return find_path(*segment.latents, *limits)

    def paths(self, segment: BridgedSegment, path: Plane, level: Floats, variance: Floats) -> Paths:
        assert segment.latents is not None
        assert segment.trail is not None
        assert segment.events is not None
        interval = segment.end - segment.start
        late = behind(1e6 * segment.trail.scale, interval)
        image = HalfWay(level, variance, late, self._threshold2, 1e-6 * interval, segment.events)
        return Paths(*segment.latents, path, image)

    def turns(self, segment: BridgedSegment) -> float:
        return segment.turns

    def around(self, segment: BridgedSegment, t: int) -> Around:
        assert segment.events is not None
        share = (t - segment.start) / (segment.end - segment.start)
        between = bridge.bridge_variance(share)
        second = segment.backward_variance
        if segment.bound is not None and segment.bound.ceiling is not None:
            second = np.where(np.isfinite(segment.bound.ceiling), np.float32(bridge.REPEATED), second)
        wrong = bridge.WRONG_STEPS * self._spread2 * self._threshold2
        return Around(
            segment.forward_variance,
            second,
            segment.events,
            coming=(1.0 - share) * self.noise.step_variance,
            counted=0.0,
            untold=segment.untold,
            lost=segment.lost,
            quantisation_variance=self.noise.quantisation_variance,
            repeated=1.0 - between / 2.0,
            wrong=wrong * between,
            wrong_back=wrong * (1.0 - share) ** 2,
            share=share,
            half_way=segment.half_way,
        )


def frame_highlights(shot: Shot) -> FrameHighlights:
    """What a frame shows of highlights: its clipped pixels, and how far the others are below white."""
    clipped = shot.level_clipped
    white = shot.level_intensity[clipped].min() if clipped.any() else shot.white
    with np.errstate(divide="ignore"):
        darker = np.log(white) - np.log(shot.level_intensity)
    darker[clipped] = 0.0
    of_levels = np.clip(darker, 0.0, _DARKEST).astype(np.float32)
    saturated, far = shot.clipped, of_levels[shot.levels]
    if shot.valid is None:
        return FrameHighlights(saturated, far, ~saturated, shot.pitch)
    far[~shot.valid] = 0.0
    return FrameHighlights(saturated & shot.valid, far, ~saturated & shot.valid, shot.pitch)


def _still_since(memory: BridgeMemory, start: int) -> int:
    """us: pixels without an event since then are still; one frame interval before the segment that begins at ``start``,
    but not before the first exposure."""
    return max(start - round(memory.interval * 1e6), memory.first_start)


def latent_frame(
    levels: NDArray[np.integer[Any]],
    level_log: Array,
    level_variance: Array,
    exposure: Exposure,
    *,
    duration: int,
    deblur_variance: float,
    threshold2: float,
) -> Latent:
    """A frame without blur at the middle of its exposure, and its variance (K3).

    A pixel whose mean is below white is measured, however bright it was for a part of the exposure: a sensor adds up
    light and clips the sum.

    Parameters
    ----------
    levels
        (H, W) the level of every pixel.
    level_log, level_variance
        (N,) log(I + I_0) of each level, and its variance; `UNMEASURED` where clipped.
    exposure
        EDI, from `deblur.expose`.
    duration
        Of the exposure, us.
    deblur_variance, threshold2
        `kalux.settings.EventSettings.deblur_variance`, and c^2.
    """
    latent = apart(2, (levels.size,))
    scalars = np.float32(duration), np.float32(deblur_variance * threshold2), np.float32(threshold2)
    tables = level_log.astype(np.float32), level_variance.astype(np.float32)
    _latent_frame(levels.reshape(-1), *tables, exposure, *scalars, *latent)
    return Latent(*latent.reshape(2, *levels.shape))


@loop
def _latent_frame(  # type: ignore[no-untyped-def]
    levels, level_log, level_variance, exposure, duration, deblur_variance, threshold2, value, variance
):
    unmeasured, (linear, quadratic) = np.float32(bridge.UNMEASURED), _GROWTH
    fields = empty((EXPOSURE_FIELDS, EXPOSED), np.float32)
    middle, events = empty(EXPOSED, np.float32), empty(EXPOSED, np.float32)
    log_frame, known = empty(EXPOSED, np.float32), empty(EXPOSED, np.float32)
    for block in range(np.uint64(len(exposure.touched))):
        relative_levels(exposure, block, duration, fields, middle, events)
        first = block * np.uint64(EXPOSED)
        count = smaller(np.uint64(len(levels)) - first, np.uint64(EXPOSED))
        for i in range(count):  # looking up is no vector code, the rest is
            log_frame[i] = level_log[levels[first + i]]
            known[i] = level_variance[levels[first + i]]
        for i in range(count):
            value[first + i] = log_frame[i] + middle[i]
        for i in range(count):
            n = events[i]
            error = deblur_variance * (ONE + n * (linear + n * quadratic))
            wrong = error / larger(error + _CORRECTION * threshold2 * n * n, _TINY)
            doubt = known[i] + wrong * wrong * middle[i] * middle[i] + (ONE - wrong) * error
            variance[first + i] = smaller(doubt, unmeasured)
