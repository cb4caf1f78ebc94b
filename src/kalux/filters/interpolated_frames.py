"""The paper's method: frames are deblurred, and interpolated by (10) to (13)."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation import deblur, interpolation
from kalux.augmentation.deblur import ExposureIntegrals
from kalux.event_slices import all_between, count_chunks
from kalux.events import EventArray
from kalux.filters import akf_interpolated
from kalux.filters.akf import State
from kalux.filters.method import FAR_FUTURE, Chunks, Method, Segment
from kalux.filters.shots import Shot
from kalux.models.camera import covariance, log_bias, log_covariance

Array = NDArray[np.float64]


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


class InterpolatedFrames(Method):
    """The paper's augmentation (10)-(13) and filter, from the start of one exposure to that of the next.

    Causal mode goes from the end of one exposure to the end of the next with L^{A-} and the previous c_p.
    """

    _MASKED: Final = 1e6  # R_bar: worth nothing beside P, and integrals of 1/R over a linear R (7) stay exact

    def node(self, shot: Shot) -> int:
        return shot.start if self.lookahead else shot.end

    begin_time = node

    def needed_until(self, shot: Shot) -> int:
        return shot.end

    def nominal(self, events: Chunks) -> Array:
        """Sum of the nominal event steps, (H, W)."""
        on, off = (count.astype(np.float64) for count in count_chunks(events, self.shape, weighed=False))
        return self.on * on - self.off * off

    def exposure(self, shot: Shot, events: Chunks) -> ExposureIntegrals:
        if not self.settings.filter.deblur:
            return deblur.still_exposure(self.shape)
        steps = np.full(self.shape, self.on), np.full(self.shape, self.off)
        return deblur.integrate_exposure(events, shot.start, shot.end, *steps)

    def r_bar(self, shot: Shot) -> Array:
        """R_bar (6); scaling the intensity by the exposure scales its noise with it."""
        camera = self.settings.camera
        return covariance(shot.weight, shot.white**2 / camera.confidence, camera.weight_floor)

    def measured_r_bar(self, shot: Shot) -> Array:
        """R_bar as a measurement: without weight where the frame says nothing."""
        r_bar = self.r_bar(shot)
        return r_bar if shot.valid is None else np.where(shot.valid, r_bar, self._MASKED)

    def log_frame(self, shot: Shot) -> Array:
        """L^F of equation (8), with its bias."""
        return super().log_frame(shot) - log_bias(shot.intensity, self.r_bar(shot), self.offset)

    def start(self, shot: Shot, events: Chunks) -> tuple[InterpolationMemory, None, State]:
        integrals = self.exposure(shot, events)
        latent = deblur.latent_start(self.log_frame(shot), integrals)
        memory = InterpolationMemory(integrals, latent, np.ones(self.shape), None)
        value = latent if self.lookahead else deblur.latent_end(self.log_frame(shot), integrals)
        variance = np.full(self.shape, self.settings.filter.initial_variance)
        if shot.valid is not None:
            variance[~shot.valid] = self.masked_variance(shot)
        return memory, None, State(value, variance, np.full(self.shape, self.node(shot), np.int64))

    def segment(
        self, memory: InterpolationMemory, shot: Shot, following: Shot | None, events: Chunks
    ) -> tuple[Segment, InterpolationMemory]:
        if not self.lookahead:
            return self._causal(memory, shot, following, events)
        start_latent = deblur.latent_start(self.log_frame(shot), memory.integrals)
        # (17) as printed follows L^A wherever that goes, so that L^A must not go to values that are no measurements.
        masked = self.masked(shot)
        start_latent[masked] = memory.forward[masked]
        if following is None:
            segment = self._segment(memory, shot, None, start_latent, memory.scale, FAR_FUTURE)
            return segment, memory
        integrals = self.exposure(following, events)
        end_latent = deblur.latent_end(self.log_frame(following), integrals)
        integral = self.nominal(all_between(events, shot.start, following.end))
        scale = interpolation.threshold_scale(end_latent - start_latent, integral)  # (12)
        masked_next = self.masked(following)
        scale[masked | masked_next] = 1.0
        end_latent[masked_next] = (start_latent + integral)[masked_next]
        at_start = interpolation.backward(end_latent, scale, integral)  # (11)
        start_latent[masked] = at_start[masked]
        memory = memory._replace(forward=np.where(masked, at_start, memory.forward))
        segment = self._segment(memory, shot, following, at_start, scale, following.start)
        to_next = self.nominal(all_between(events, shot.start, following.start))
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
        here = self.measured_r_bar(shot)
        after = here if following is None else self.measured_r_bar(following)
        before = here if previous is None else self.measured_r_bar(previous)
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
        self, memory: InterpolationMemory, shot: Shot, following: Shot | None, events: Chunks
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
        integral = memory.integrals.to_end + self.nominal(all_between(events, shot.end, following.end))
        scale = interpolation.threshold_scale(end_latent - start_latent, integral)
        scale[self.masked(shot) | self.masked(following)] = 1.0
        return segment, InterpolationMemory(integrals, end_latent, scale, shot)

    @property
    def noise(self) -> akf_interpolated.Noise:
        events = self.settings.events
        return akf_interpolated.Noise(
            events.sigma_proc2,
            events.sigma_iso2,
            events.sigma_ref2,
            events.refractory_bound,
            self.settings.filter.solution == "printed",
        )

    def begin(self, segment: Any, state: State) -> akf_interpolated.Cursor:
        return akf_interpolated.begin(segment, state)

    def advance(self, segment: Any, cursor: akf_interpolated.Cursor, events: EventArray) -> None:
        akf_interpolated.advance(segment, cursor, events, self.noise)

    def read(self, segment: Any, cursor: akf_interpolated.Cursor, t: int) -> tuple[Array, Array]:
        return akf_interpolated.read(segment, cursor, t, self.noise)

    def end(self, segment: Any, cursor: akf_interpolated.Cursor) -> State:
        return State(*self.read(segment, cursor, segment.end), cursor.newest)
