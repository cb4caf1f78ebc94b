"""How each filter is driven from frame to frame: which moments segments join, and what each segment is.

A method cuts time at one moment per frame, its ``node``. Between two nodes lies a segment, whose augmentation
follows from the frames at both ends and the events in between; a memory value carries what later segments need.
`kalux.Reconstructor` is the only caller.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation import bridge, deblur, interpolation
from kalux.augmentation.bridge import BridgeNoise, Latent, Thresholds
from kalux.augmentation.deblur import ExposureIntegrals, between, count_events
from kalux.events import EventArray
from kalux.filters import akf, complementary
from kalux.filters.akf import State
from kalux.frames import Frame
from kalux.models.camera import (
    Camera,
    covariance,
    inverse_response,
    log_bias,
    log_covariance,
    log_intensity,
)
from kalux.models.pixels import PixelCalibration
from kalux.settings import Settings

Array = NDArray[np.float64]

FAR_FUTURE: Final = 1 << 61
"""End of a segment that has no next frame, us."""


class Shot(NamedTuple):
    """A frame as the filters see it.

    Attributes
    ----------
    start, middle, end
        Of the exposure, us.
    intensity
        (H, W) I of equation (3) at the reference exposure; 1 = a saturated pixel there.
    weight
        (H, W) f^w of its response.
    clipped
        (H, W) bool: saturated or masked, so that the value is no measurement.
    white
        Intensity of a saturated pixel of this frame: the reference exposure over the frame's own.
    """

    start: int
    middle: int
    end: int
    intensity: Array
    weight: Array
    clipped: NDArray[np.bool_]
    white: float


def take_shot(frame: Frame, camera: Camera, reference_exposure: float) -> Shot:
    """Invert the response (3), scale to the reference exposure, weigh (5) and mark what is clipped."""
    ratio = reference_exposure / frame.exposure
    intensity, weight, clipped = _per_level(frame, camera, ratio)
    return Shot(
        start=frame.exposure_start,
        middle=frame.middle,
        end=frame.exposure_end,
        intensity=intensity,
        weight=weight,
        clipped=clipped,
        white=ratio,
    )


def _per_level(frame: Frame, camera: Camera, ratio: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """I, f^w and clipped of every pixel; of integer images once per level, which is far quicker."""
    if frame.image.dtype.kind == "f":
        response = frame.normalised()
    else:
        levels = np.arange(int(frame.image.max()) + 1, dtype=frame.image.dtype)
        response = Frame(levels, 0, 1, frame.white).normalised()
    values = (
        inverse_response(camera, response, ratio),
        camera.weight(np.clip(response, 0.0, 1.0)),
        response >= camera.saturation,
    )
    if frame.image.dtype.kind == "f":
        return values
    intensity, weight, clipped = (table[frame.image] for table in values)
    return intensity, weight, clipped


class Segment(Protocol):
    """What all segments have: their span in us."""

    @property
    def start(self) -> int: ...
    @property
    def end(self) -> int: ...


class Method(Protocol):
    """One way to filter. Memory, segments and cursors are values of the method's own; only it looks inside."""

    lookahead: bool

    def node(self, shot: Shot) -> int:
        """The moment, us, at which a frame's segment begins."""

    def begin_time(self, shot: Shot) -> int:
        """The first moment, us, that can be read when ``shot`` is the first frame."""

    def needed_until(self, shot: Shot) -> int:
        """Events up to this time, us, are needed before the segment that ends at the frame is final."""

    def start(self, shot: Shot, events: EventArray) -> tuple[Any, Segment | None, State]:
        """From the first frame: memory, the segment before its node if there is one, and the first state."""

    def segment(
        self, memory: Any, shot: Shot, following: Shot | None, events: EventArray
    ) -> tuple[Segment, Any]:
        """The segment from a frame to the next (None: not known, or none comes), and the memory after it.

        ``events`` are those after the frame's node, as far as known.
        """

    def begin(self, segment: Any, state: State) -> Any:
        """A cursor at the segment's start."""

    def advance(self, segment: Any, cursor: Any, events: EventArray) -> None:
        """Take the cursor over events, in place."""

    def read(self, segment: Any, cursor: Any, t: int) -> tuple[Array, Array]:
        """L and P at ``t``; P is infinite where the method has none."""

    def newest(self, cursor: Any) -> NDArray[np.int64]:
        """The newest event of each pixel, us."""


def make_method(
    settings: Settings,
    thresholds: tuple[float, float],
    lookahead: bool,
    shape: tuple[int, int],
    pixels: PixelCalibration | None = None,
) -> Method:
    """The method that the settings name, with the nominal (on, off) thresholds.

    ``pixels`` is what is known of single pixels beforehand; only the bridge uses it.
    """
    if settings.filter.kind == "cf":
        return HeldFrames(settings, thresholds, lookahead, shape)
    if settings.filter.augmentation == "bridge":
        return BridgedFrames(settings, thresholds, lookahead, shape, pixels)
    return InterpolatedFrames(settings, thresholds, lookahead, shape)


class _Common:
    def __init__(
        self, settings: Settings, thresholds: tuple[float, float], lookahead: bool, shape: tuple[int, int]
    ) -> None:
        self.settings, self.lookahead, self.shape = settings, lookahead, shape
        self.on, self.off = thresholds
        self.offset = settings.camera.log_offset

    def integrals(self, shot: Shot, events: EventArray, step_on: Array, step_off: Array) -> ExposureIntegrals:
        """EDI over the frame's exposure, or nothing moving where deblurring is off."""
        if not self.settings.filter.deblur:
            return deblur.still_exposure(self.shape)
        return deblur.integrate_exposure(events, shot.start, shot.end, step_on, step_off)

    def log_frame(self, shot: Shot) -> Array:
        return log_intensity(shot.intensity, self.offset)


class BridgeMemory(NamedTuple):
    """The latest frame, deblurred; the pixels' thresholds; the frame interval in s (0: not known yet).

    In causal mode also the counts of events between the middle and the end of the latest exposure.
    """

    latent: Latent
    thresholds: Thresholds
    interval: float
    on: Array
    off: Array


class BridgedFrames(_Common):
    """The default: `bridge` from the middle of one exposure to that of the next, the exact filter.

    Causal mode (``lookahead=False``) goes from the end of one exposure to the end of the next, forward only.
    """

    _FIRST_INTERVAL: Final = 0.04  # s, spread of a single frame's information until a second one is known

    def __init__(
        self,
        settings: Settings,
        thresholds: tuple[float, float],
        lookahead: bool,
        shape: tuple[int, int],
        pixels: PixelCalibration | None,
    ) -> None:
        super().__init__(settings, thresholds, lookahead, shape)
        self._prior = (
            bridge.nominal_thresholds(shape, settings.events.threshold_spread)
            if pixels is None
            else Thresholds(pixels.on, pixels.off, pixels.on_variance, pixels.off_variance)
        )

    def node(self, shot: Shot) -> int:
        return shot.middle if self.lookahead else shot.end

    def begin_time(self, shot: Shot) -> int:
        return shot.start if self.lookahead else shot.end

    def needed_until(self, shot: Shot) -> int:
        return shot.end

    @property
    def noise(self) -> BridgeNoise:
        events, c2 = self.settings.events, self.on * self.off
        return BridgeNoise(self.on, self.off, events.step_variance * c2, events.quantisation_variance * c2)

    def latent(self, shot: Shot, events: EventArray, thresholds: Thresholds) -> Latent:
        """The frame without blur at the middle of its exposure, and its variance (K3)."""
        integrals = self.integrals(shot, events, self.on * thresholds.on, self.off * thresholds.off)
        log_frame = self.log_frame(shot)
        r_bar = covariance(shot.weight, (self.settings.camera.frame_noise * shot.white) ** 2, 1e-6)
        variance = log_covariance(shot.intensity, r_bar, self.offset)
        variance = variance + self.settings.events.deblur_variance * self.on * self.off * integrals.events
        white = np.log(self.settings.camera.saturation * shot.white + self.offset)
        clipped = shot.clipped | (deblur.latent_peak(log_frame, integrals) >= white)
        return Latent(
            deblur.latent_middle(log_frame, integrals), np.where(clipped, bridge.UNMEASURED, variance)
        )

    def start(self, shot: Shot, events: EventArray) -> tuple[BridgeMemory, Segment | None, State]:
        thresholds = self._prior
        latent = self.latent(shot, events, thresholds)
        begin = self.begin_time(shot)
        newest = np.full(self.shape, shot.start, np.int64)
        lead_in = None
        if self.lookahead:
            on, off = count_events(between(events, begin, shot.middle), self.shape)
            memory = BridgeMemory(latent, thresholds, 0.0, on, off)
            value, variance = latent
            if shot.middle > begin:
                lead_in = bridge.extend_backward(latent, on, off, thresholds, self.noise, begin, shot.middle)
                value, variance = lead_in.augmented, lead_in.backward_variance
        else:
            on, off = count_events(between(events, shot.middle, shot.end), self.shape)
            memory = BridgeMemory(latent, thresholds, 0.0, on, off)
            value, variance = self._carried(memory)
        unmeasured = variance >= bridge.UNMEASURED
        variance = np.where(unmeasured, self.settings.filter.initial_variance, variance)
        return memory, lead_in, State(value, variance, newest)

    def segment(
        self, memory: BridgeMemory, shot: Shot, following: Shot | None, events: EventArray
    ) -> tuple[Segment, BridgeMemory]:
        start = self.node(shot)
        if following is None:
            seconds = memory.interval or self._FIRST_INTERVAL
            latent = memory.latent
            if not self.lookahead:
                latent = self._carried(memory)
            unbound = np.full(self.shape, -np.inf)
            return (
                bridge.extend(latent, memory.thresholds, self.noise, start, FAR_FUTURE, seconds, unbound),
                memory,
            )
        interval = (following.middle - shot.middle) * 1e-6
        second = self.latent(following, events, memory.thresholds)
        on, off = count_events(between(events, start, following.middle), self.shape)
        if self.lookahead:
            joined, learned = bridge.bridge(
                memory.latent, second, on, off, memory.thresholds, self.noise, start, following.middle
            )
            return joined, BridgeMemory(second, learned, interval, on, off)
        _, learned = bridge.bridge(
            memory.latent,
            second,
            on + memory.on,
            off + memory.off,
            memory.thresholds,
            self.noise,
            shot.middle,
            following.middle,
        )
        tail = count_events(between(events, following.middle, following.end), self.shape)
        after = BridgeMemory(second, learned, interval, *tail)
        forward = bridge.extend(
            self._carried(memory),
            memory.thresholds,
            self.noise,
            start,
            following.end,
            memory.interval or self._FIRST_INTERVAL,
            bridge.lower_bound(self._carried(after)),
        )
        return forward, after

    def _carried(self, memory: BridgeMemory) -> Latent:
        """The latest frame from the middle to the end of its exposure, with the events between (10)."""
        step = self.on * memory.thresholds.on * memory.on - self.off * memory.thresholds.off * memory.off
        return Latent(
            memory.latent.value + step,
            memory.latent.variance + self.noise.step_variance * (memory.on + memory.off),
        )

    def begin(self, segment: Any, state: State) -> akf.BridgedCursor:
        return akf.begin_bridged(segment, state)

    def advance(self, segment: Any, cursor: akf.BridgedCursor, events: EventArray) -> None:
        settings = self.settings.events
        noise = akf.BridgedNoise(settings.noise_rate, settings.step_variance, self.on * self.off)
        akf.advance_bridged(segment, cursor, events, noise)

    def read(self, segment: Any, cursor: akf.BridgedCursor, t: int) -> tuple[Array, Array]:
        return akf.read_bridged(segment, cursor, t)

    def newest(self, cursor: akf.BridgedCursor) -> NDArray[np.int64]:
        return cursor.newest


class InterpolationMemory(NamedTuple):
    """What the paper's interpolation needs of the frame before: nothing at the first.

    Attributes
    ----------
    integrals
        EDI of the latest frame.
    forward
        L^{A-} of the interval before the latest frame, at the start of its exposure.
    scale
        c_p of that interval.
    previous
        The frame before the latest, None at the first.
    """

    integrals: ExposureIntegrals
    forward: Array
    scale: Array
    previous: Shot | None


class InterpolatedFrames(_Common):
    """The paper's augmentation (10)-(13) and filter, from the start of one exposure to that of the next.

    Causal mode goes from the end of one exposure to the end of the next with L^{A-} and the previous c_p.
    """

    def node(self, shot: Shot) -> int:
        return shot.start if self.lookahead else shot.end

    begin_time = node

    def needed_until(self, shot: Shot) -> int:
        return shot.end

    def nominal(self, events: EventArray) -> Array:
        """Sum of the nominal event steps, (H, W)."""
        on, off = count_events(events, self.shape)
        return self.on * on - self.off * off

    def exposure(self, shot: Shot, events: EventArray) -> ExposureIntegrals:
        steps = np.full(self.shape, self.on), np.full(self.shape, self.off)
        return self.integrals(shot, events, *steps)

    def r_bar(self, shot: Shot) -> Array:
        """R_bar (6); scaling the intensity by the exposure scales its noise with it."""
        camera = self.settings.camera
        return covariance(shot.weight, shot.white**2 / camera.confidence, camera.weight_floor)

    def log_frame(self, shot: Shot) -> Array:
        """L^F of equation (8), with its bias."""
        return super().log_frame(shot) - log_bias(shot.intensity, self.r_bar(shot), self.offset)

    def start(self, shot: Shot, events: EventArray) -> tuple[InterpolationMemory, None, State]:
        integrals = self.exposure(shot, events)
        latent = deblur.latent_start(self.log_frame(shot), integrals)
        memory = InterpolationMemory(integrals, latent, np.ones(self.shape), None)
        value = latent if self.lookahead else deblur.latent_end(self.log_frame(shot), integrals)
        variance = np.full(self.shape, self.settings.filter.initial_variance)
        return memory, None, State(value, variance, np.full(self.shape, self.node(shot), np.int64))

    def segment(
        self, memory: InterpolationMemory, shot: Shot, following: Shot | None, events: EventArray
    ) -> tuple[Segment, InterpolationMemory]:
        if not self.lookahead:
            return self._causal(memory, shot, following, events)
        start_latent = deblur.latent_start(self.log_frame(shot), memory.integrals)
        if following is None:
            segment = self._segment(memory, shot, None, start_latent, memory.scale, FAR_FUTURE)
            return segment, memory
        integrals = self.exposure(following, events)
        end_latent = deblur.latent_end(self.log_frame(following), integrals)
        integral = self.nominal(between(events, shot.start, following.end))
        scale = interpolation.threshold_scale(end_latent - start_latent, integral)  # (12)
        at_start = interpolation.backward(end_latent, scale, integral)  # (11)
        segment = self._segment(memory, shot, following, at_start, scale, following.start)
        to_next = self.nominal(between(events, shot.start, following.start))
        forward = interpolation.forward(start_latent, scale, to_next)  # (10)
        return segment, InterpolationMemory(integrals, forward, scale, shot)

    def _segment(
        self,
        memory: InterpolationMemory,
        shot: Shot,
        following: Shot | None,
        backward: Array,
        scale: Array,
        end: int,
    ) -> interpolation.InterpolatedSegment:
        # At the first frame nothing comes before: L^{A-} and c_p are those of the interval after it.
        previous = memory.previous
        here = self.r_bar(shot)
        after = here if following is None else self.r_bar(following)
        before = here if previous is None else self.r_bar(previous)
        at = shot if previous is None else previous
        return interpolation.InterpolatedSegment(
            start=self.node(shot),
            exposure_end=shot.end,
            end=end,
            previous_middle=shot.middle - 1 if previous is None else previous.middle,
            middle=shot.middle,
            next_middle=FAR_FUTURE if following is None else following.middle,
            forward=memory.forward,
            backward=backward,
            scale_before=scale if previous is None else memory.scale,
            scale_after=scale,
            covariance_before=log_covariance(at.intensity, before, self.offset),
            covariance_at=log_covariance(at.intensity, here, self.offset),
            covariance_from=log_covariance(shot.intensity, here, self.offset),
            covariance_after=log_covariance(shot.intensity, after, self.offset),
            step_on=self.on,
            step_off=self.off,
        )

    def _causal(
        self, memory: InterpolationMemory, shot: Shot, following: Shot | None, events: EventArray
    ) -> tuple[Segment, InterpolationMemory]:
        value = deblur.latent_end(self.log_frame(shot), memory.integrals)
        end = FAR_FUTURE if following is None else following.end
        segment = self._segment(memory, shot, None, value, memory.scale, end)
        segment = segment._replace(forward=value, scale_before=memory.scale)
        if following is None:
            return segment, memory
        integrals = self.exposure(following, events)
        end_latent = deblur.latent_end(self.log_frame(following), integrals)
        start_latent = deblur.latent_start(self.log_frame(shot), memory.integrals)
        integral = memory.integrals.to_end + self.nominal(between(events, shot.end, following.end))
        scale = interpolation.threshold_scale(end_latent - start_latent, integral)
        return segment, InterpolationMemory(integrals, end_latent, scale, shot)

    @property
    def noise(self) -> akf.PaperNoise:
        events = self.settings.events
        return akf.PaperNoise(
            events.sigma_proc2,
            events.sigma_iso2,
            events.sigma_ref2,
            events.refractory_bound,
            self.settings.filter.solution == "printed",
        )

    def begin(self, segment: Any, state: State) -> akf.InterpolatedCursor:
        return akf.begin_interpolated(segment, state)

    def advance(self, segment: Any, cursor: akf.InterpolatedCursor, events: EventArray) -> None:
        akf.advance_interpolated(segment, cursor, events, self.noise)

    def read(self, segment: Any, cursor: akf.InterpolatedCursor, t: int) -> tuple[Array, Array]:
        return akf.read_interpolated(segment, cursor, t, self.noise)

    def newest(self, cursor: akf.InterpolatedCursor) -> NDArray[np.int64]:
        return cursor.newest


class HeldFrames(_Common):
    """The complementary filter on held frames: each from the middle of its exposure, or its end if causal."""

    def node(self, shot: Shot) -> int:
        return shot.middle if self.lookahead else shot.end

    begin_time = node

    def needed_until(self, shot: Shot) -> int:
        return shot.end

    def start(self, shot: Shot, events: EventArray) -> tuple[None, None, State]:
        newest = np.full(self.shape, self.node(shot), np.int64)
        return None, None, State(self.log_frame(shot), np.full(self.shape, np.inf), newest)

    def segment(
        self, memory: None, shot: Shot, following: Shot | None, events: EventArray
    ) -> tuple[Segment, None]:
        end = FAR_FUTURE if following is None else self.node(following)
        gain = 2 * np.pi * self.settings.filter.cutoff
        return (
            complementary.HeldSegment(self.node(shot), end, self.log_frame(shot), gain, self.on, self.off),
            None,
        )

    def begin(self, segment: Any, state: State) -> complementary.Cursor:
        return complementary.begin(segment, state.log_intensity)

    def advance(self, segment: Any, cursor: complementary.Cursor, events: EventArray) -> None:
        complementary.advance(segment, cursor, events)

    def read(self, segment: Any, cursor: complementary.Cursor, t: int) -> tuple[Array, Array]:
        return complementary.read(segment, cursor, t), np.full(self.shape, np.inf)

    def newest(self, cursor: complementary.Cursor) -> NDArray[np.int64]:
        return cursor.since
