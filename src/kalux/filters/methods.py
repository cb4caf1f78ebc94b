"""How each filter is driven from frame to frame: which moments segments join, and what each segment is.

A method cuts time at one moment per frame, its ``node``. Between two nodes lies a segment, whose augmentation
follows from the frames at both ends and the events in between; a memory value carries what later segments need.
`kalux.Reconstructor` is the only caller.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final, NamedTuple, Protocol

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation import bridge, deblur, interpolation
from kalux.augmentation.bridge import BridgedSegment, BridgeNoise, Latent, Thresholds, UnshownMemory
from kalux.augmentation.deblur import (
    EXPOSED,
    EXPOSURE_FIELDS,
    Exposure,
    ExposureIntegrals,
    all_between,
    count_chunks,
    relative_levels,
)
from kalux.augmentation.highlights import Unshown, begin_unshown, expected_excess, follow_unshown
from kalux.augmentation.trail import (
    Followed,
    FrameTrail,
    Trail,
    follow,
    given_trail,
    nothing_followed,
    polarity_of,
    trail_at,
)
from kalux.augmentation.unseen import UNKNOWN_CHANGE, forget_silence, silent_change
from kalux.compiled import apart
from kalux.errors import SettingsError
from kalux.events import EventArray
from kalux.filters import akf, complementary
from kalux.filters.akf import State
from kalux.filters.common import make_clock
from kalux.filters.uncertainty import WRONG_STEPS, Around
from kalux.frames import Frame
from kalux.models import colour
from kalux.models.camera import (
    Camera,
    black_ceiling,
    covariance,
    frame_log_covariance,
    inverse_response,
    log_bias,
    log_covariance,
    log_intensity,
)
from kalux.models.pixels import PixelCalibration
from kalux.settings import Settings

Array = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]

Chunks = Sequence[EventArray]
"""Events in time order, in a few arrays."""

USUAL_INTERVAL: Final = 40_000
"""us between frames, over which the information of the first one is spread until a second one is known."""

FAR_FUTURE: Final = 1 << 61
"""End of a segment that has no next frame, us."""


class Shot(NamedTuple):
    """A frame as the filters see it: what each of its levels says, so that functions of it are taken once per level.

    Attributes
    ----------
    start, middle, end
        Of the exposure, us.
    levels
        (H, W) whole numbers: which level a pixel has. Frames of floating point have one per pixel.
    level_intensity
        (N,) I of equation (3) at the reference exposure; 1 = a saturated pixel there.
    level_weight
        (N,) f^w of the response.
    level_clipped
        (N,) bool: saturated, so that the value is no measurement.
    white
        Intensity of a saturated pixel of this frame: the reference exposure over the frame's own.
    level_ceiling
        (N,) the most that I can be at levels that are black; inf at others.
    chroma, chroma_weight
        Of a frame in RGB: (H, W, 3) float32 ratio of each channel to the luminance, and (H, W) how reliable it is, 0
        where a channel is clipped to 1; else None.
    valid
        (H, W) bool: where the frame says anything at all; None: everywhere.
    trail
        Backward in time: how far the light is ahead of its events at the middle (K14).
    """

    start: int
    middle: int
    end: int
    levels: NDArray[np.integer[Any]]
    level_intensity: Array
    level_weight: Array
    level_clipped: NDArray[np.bool_]
    white: float
    level_ceiling: Array
    chroma: NDArray[np.float32] | None = None
    chroma_weight: NDArray[np.float32] | None = None
    valid: NDArray[np.bool_] | None = None
    trail: FrameTrail | None = None

    @property
    def intensity(self) -> Array:
        """(H, W) I."""
        intensity: Array = self.level_intensity[self.levels]
        return intensity

    @property
    def weight(self) -> Array:
        """(H, W) f^w."""
        weight: Array = self.level_weight[self.levels]
        return weight

    @property
    def clipped(self) -> NDArray[np.bool_]:
        """(H, W) bool."""
        clipped: NDArray[np.bool_] = self.level_clipped[self.levels]
        return clipped


_CLIPPED_SHARE: Final = 0.2
"""A clipped channel with a smaller share of the luminance (the blue of a sky) is an error of that share where it is
twice as bright as it can show: as little as a few events are off."""

_CHROMA_FLOOR: Final = 0.006
"""Noise of a pixel, white = 1, below which a ratio of channels says nothing; `CameraSettings.usual_frame_noise`."""


def take_shot(
    frame: Frame, camera: Camera, reference_exposure: float, gains: colour.Gains = (1.0, 1.0, 1.0)
) -> Shot:
    """Invert the response (3), scale to the reference exposure, weigh (5) and mark what is clipped.

    ``gains`` is the white balance of frames in RGB, of which the luminance is taken; mosaics are filtered as recorded.

    Raises
    ------
    SettingsError
        If the camera has a response per colour and the frame is grey.
    """
    ratio = reference_exposure / frame.exposure
    if frame.image.ndim == 3:
        return _colour_shot(frame, camera, ratio, gains)
    levels, response, intensity, weight, ceiling = _leveled(frame, camera, ratio)
    return Shot(
        start=frame.exposure_start,
        middle=frame.middle,
        end=frame.exposure_end,
        levels=levels,
        level_intensity=intensity,
        level_weight=weight,
        level_clipped=response >= camera.saturation,
        white=ratio,
        level_ceiling=ceiling,
        valid=frame.valid,
    )


class _Leveled(NamedTuple):
    """Which level every pixel has, and of every level its response, I, f^w and, where black, the most it can be."""

    levels: NDArray[np.integer[Any]]
    response: Array
    intensity: Array
    weight: Array
    ceiling: Array


def _leveled(frame: Frame, camera: Camera, ratio: float) -> _Leveled:
    """The levels of a grey frame or a mosaic; where colours have responses of their own, theirs follow each other."""
    levels: NDArray[np.integer[Any]]
    if frame.image.dtype.kind == "f":
        levels = np.arange(frame.image.size, dtype=np.int32).reshape(frame.image.shape)
        response = frame.normalised().ravel()
    else:
        levels = frame.image.copy()  # the caller's memory may be filled again
        values = np.arange(int(levels.max(initial=0)) + 1, dtype=levels.dtype)
        response = Frame(values, 0, 1, frame.white).normalised()
    if camera.colours is None:
        return _Leveled(levels, response, *_by_response(camera, response, ratio))
    if frame.mosaic is None:
        raise SettingsError("response: three responses are for frames in colour or mosaics; these are grey")
    levels = levels.astype(np.int32)
    for row, column in np.ndindex(2, 2):
        levels[row::2, column::2] += "RGB".index(frame.mosaic[2 * row + column]) * len(response)
    of_colours = zip(*(_by_response(camera.of_channel(c), response, ratio) for c in range(3)), strict=True)
    return _Leveled(levels, np.tile(response, 3), *(np.concatenate(values) for values in of_colours))


def _by_response(camera: Camera, response: Array, ratio: float) -> tuple[Array, Array, Array]:
    return (
        inverse_response(camera, response, ratio),
        camera.weight(np.clip(response, 0.0, 1.0)),
        black_ceiling(camera, response, ratio),
    )


def _colour_shot(frame: Frame, camera: Camera, ratio: float, gains: colour.Gains) -> Shot:
    """The luminance of an RGB frame, and its chromaticity (docs/colour.md).

    Errors of the channels are taken as common to them, as demosaicing and compression make them: standard deviations
    add. A pixel is clipped where clipped channels carry more than `_CLIPPED_SHARE` of the luminance.
    """
    parts = [_channel(frame, camera, ratio, c) for c in range(3)]
    rgb = np.stack([gain * part[0] for gain, part in zip(gains, parts, strict=True)], axis=-1)
    y = colour.luminance(rgb)
    shares = [w * g for w, g in zip(colour.LUMINANCE, gains, strict=True)]
    spread = sum(s / np.sqrt(np.maximum(part[1], 1e-6)) for s, part in zip(shares, parts, strict=True))
    of_clipped = sum(s * part[0] * part[2] for s, part in zip(shares, parts, strict=True))
    brightest = np.max(frame.image, axis=-1) / frame.white_value
    room = max(camera.saturation - colour.RELIABLE, 1e-6)
    return Shot(
        start=frame.exposure_start,
        middle=frame.middle,
        end=frame.exposure_end,
        levels=np.arange(y.size, dtype=np.int32).reshape(y.shape),
        level_intensity=y.ravel(),
        level_weight=(1 / np.square(spread)).ravel(),
        level_clipped=(of_clipped > _CLIPPED_SHARE * np.maximum(y, 0)).ravel(),
        white=ratio,
        level_ceiling=colour.luminance(
            np.stack([g * part[3] for g, part in zip(gains, parts, strict=True)], -1)
        ).ravel(),
        chroma=colour.chromaticity(rgb, _CHROMA_FLOOR * ratio),
        chroma_weight=np.clip((camera.saturation - brightest) / room, 0, 1).astype(np.float32),
        valid=frame.valid,
    )


def _channel(
    frame: Frame, camera: Camera, ratio: float, channel: int
) -> tuple[Array, Array, NDArray[np.bool_], Array]:
    """I, f^w, clipped, and the most that black can be, of one channel of an RGB frame, (H, W)."""
    own = dataclasses.replace(frame, image=np.ascontiguousarray(frame.image[..., channel]))
    levels, response, intensity, weight, ceiling = _leveled(own, camera.of_channel(channel), ratio)
    return intensity[levels], weight[levels], (response >= camera.saturation)[levels], ceiling[levels]


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

    def start(self, shot: Shot, events: Chunks) -> tuple[Any, Segment | None, State]:
        """From the first frame: memory, the segment before its node if there is one, and the first state."""

    def segment(self, memory: Any, shot: Shot, following: Shot | None, events: Chunks) -> tuple[Segment, Any]:
        """The segment from a frame to the next (None: not known, or none comes), and the memory after it.

        ``events`` are those after the frame's node, as far as known.
        """

    def begin(self, segment: Any, state: State) -> Any:
        """A cursor at the segment's start."""

    def advance(self, segment: Any, cursor: Any, events: EventArray) -> None:
        """Take the cursor over events, in place."""

    def read(self, segment: Any, cursor: Any, t: int) -> tuple[Floats, Floats]:
        """L and P at ``t``; P is infinite where the method has none."""

    def end(self, segment: Any, cursor: Any) -> State:
        """The state at the end of the segment. The cursor must not be used after it: its memory is."""

    def moving(self, segment: Any, cursor: Any) -> NDArray[np.bool_] | None:
        """(H, W): pixels with an event in this frame interval, also one to come, or the one before, or unmeasured."""

    def silent_change(self, segment: Any) -> Floats | None:
        """(H, W): `unseen.silent_change` of the segment; None: the method or the segment does not tell."""

    def around(self, segment: Any, t: int) -> Around | None:
        """What the two frames that a segment joins say of its pixels at ``t`` (K11); None: the method does not tell."""

    def trail(self, segment: Any, cursor: Any, t: int) -> Floats | None:
        """(H, W): how far the light is ahead of its events at ``t`` (K14); None: the method does not tell."""

    def unshown(self, segment: Any, variance: Floats, prior: float) -> Unshown | None:
        """Pixels that no frame has measured until then (K15), given P there; None: the method knows none.

        ``prior`` is how far above their bounds they are expected where none around has told.
        """


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
        self.offset = settings.camera.offset

    def moving(self, segment: Any, cursor: Any) -> NDArray[np.bool_] | None:
        return None

    def trail(self, segment: Any, cursor: Any, t: int) -> Floats | None:
        return None

    def silent_change(self, segment: Any) -> Floats | None:
        return None

    def around(self, segment: Any, t: int) -> Around | None:
        return None

    def unshown(self, segment: Any, variance: Floats, prior: float) -> Unshown | None:
        return None

    def log_frame(self, shot: Shot) -> Array:
        log_frame: Array = log_intensity(shot.level_intensity, self.offset)[shot.levels]
        return log_frame

    def counts(self, events: Chunks, start: int, end: int) -> tuple[Floats, Floats]:
        """Number of on and off events of every pixel with start < t <= end."""
        return count_chunks(all_between(events, start, end), self.shape, weighed=True)

    def unseen(self, shot: Shot) -> NDArray[np.bool_]:
        """(H, W) bool: where the frame says nothing."""
        return np.zeros(self.shape, bool) if shot.valid is None else ~shot.valid

    def unseen_variance(self, shot: Shot) -> float:
        """P of a pixel of which the first frame says nothing: it is distributed as the others are."""
        seen = self.log_frame(shot)[shot.valid]
        return max(self.settings.filter.initial_variance, float(np.var(seen)) if seen.size else 0.0)


_DARKEST: Final = 0.001
"""What is black is taken to be spread evenly in log I from here, white = 1, a quarter of an 8-bit level."""

_CRUSHED: Final = 1.5 / 255
"""Intensity, white = 1, that black must hide to be no measurement: three times what it hides of a linear response."""

_BLACK_FRAMES: Final = 3.0
"""Black says the same in every frame: so many of them count as one, and all as no more (docs/equations.md, K7)."""


class BridgeMemory(NamedTuple):
    """The latest frame, deblurred; the pixels' thresholds; the frame interval in s (0: not known yet).

    In causal mode also the counts of events between the middle and the end of the latest exposure. Of pixels that the
    latest frames did not measure, the counts since one did (to the latest node); 0 elsewhere. ``since`` is the start of
    the first exposure, us. ``unshown`` is of the pixels that no frame has measured yet.
    """

    latent: Latent
    thresholds: Thresholds
    interval: float
    on: Floats
    off: Floats
    far_on: Floats
    far_off: Floats
    since: int
    followed: Followed
    at_middle: Followed
    unshown: UnshownMemory
    silent_change: Floats


class BridgedFrames(_Common):
    """The default: `bridge` from the middle of one exposure to that of the next, the exact filter.

    Causal mode (``lookahead=False``) goes from the end of one exposure to the end of the next, forward only.
    """

    def __init__(
        self,
        settings: Settings,
        thresholds: tuple[float, float],
        lookahead: bool,
        shape: tuple[int, int],
        pixels: PixelCalibration | None,
    ) -> None:
        super().__init__(settings, thresholds, lookahead, shape)
        # Fresh memory costs as much as filling it.
        self._spare: akf.BridgedCursor | None = None
        self._spare_exposure: NDArray[np.void] | None = None
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

    def __getstate__(self) -> dict[str, Any]:
        """Pickled without the free memory."""
        return {**self.__dict__, "_spare": None, "_spare_exposure": None}

    def node(self, shot: Shot) -> int:
        return shot.middle if self.lookahead else shot.end

    def begin_time(self, shot: Shot) -> int:
        return shot.start if self.lookahead else shot.end

    def needed_until(self, shot: Shot) -> int:
        return shot.end

    @property
    def noise(self) -> BridgeNoise:
        events, c2 = self.settings.events, self.on * self.off
        return BridgeNoise(self.on, self.off, events.step_noise * c2, events.quantisation_variance * c2)

    def latent(self, shot: Shot, events: Chunks, thresholds: Thresholds) -> Latent:
        """The frame without blur at the middle of its exposure, and its variance (K3)."""
        exposure = deblur.expose(
            events if self.settings.filter.deblur else (),
            shot.start,
            shot.end,
            (thresholds.on, thresholds.off),
            (self.on, self.off),
            weighed=True,
            spare=self._spare_exposure,
        )
        self._spare_exposure = exposure.pixels
        level_variance = frame_log_covariance(
            shot.level_intensity, shot.level_weight, self.settings.camera.noise, shot.white, self.offset
        )
        level_variance[shot.level_clipped] = bridge.UNMEASURED
        level_log = log_intensity(shot.level_intensity, self.offset)
        crushed = self.crushed(shot)
        if crushed is not None:
            level_log[crushed], level_variance[crushed] = self.black(shot.level_ceiling[crushed])
        latent = latent_frame(
            shot.levels,
            level_log,
            level_variance,
            exposure,
            duration=shot.end - shot.start,
            white=float(np.log(self.settings.camera.saturation * shot.white + self.offset)),
            event_variance=self.settings.events.deblur_variance * self.on * self.off,
        )
        if shot.valid is not None:
            latent.variance[~shot.valid] = bridge.UNSEEN
        if crushed is None:
            return latent
        room = np.where(crushed, np.log(shot.level_ceiling + self.offset) - level_log, np.inf)
        return latent._replace(ceiling=latent.value + room.astype(np.float32)[shot.levels])

    def crushed(self, shot: Shot) -> NDArray[np.bool_] | None:
        """(N,) levels that are black and hide more than a linear response's would; None where black does not.

        With a linear response 0 is a measurement like others.
        """
        black = np.isfinite(shot.level_ceiling)
        hides = shot.level_ceiling > _CRUSHED * shot.white
        return black & hides if hides[black].any() else None

    def black(self, ceiling: Array) -> tuple[Array, Array]:
        """What I up to ``ceiling`` says of log(I + I_0): its middle, and its variance (K7)."""
        middle = np.sqrt(_DARKEST * ceiling)
        range_ = np.log1p(ceiling / self.offset)
        return np.log(middle + self.offset), _BLACK_FRAMES * np.square(range_) / 12

    def start(self, shot: Shot, events: Chunks) -> tuple[BridgeMemory, Segment | None, State]:
        thresholds = self._prior
        latent = self.latent(shot, events, thresholds)
        begin = self.begin_time(shot)
        newest = make_clock(self.shape, begin - shot.start)
        lead_in, nothing = None, nothing_followed(self.shape)
        far = np.zeros(self.shape, np.float32)
        unknown = np.full(self.shape, UNKNOWN_CHANGE * self.on * self.off, np.float32)
        if self.lookahead:
            on, off, followed = self.follow(events, begin, shot.middle, nothing)
        else:
            # The clock begins at the end of the exposure: nothing is known of what came before.
            (on, off), followed = self.counts(events, shot.middle, shot.end), nothing
        memory = BridgeMemory(
            latent=latent,
            thresholds=thresholds,
            interval=0.0,
            on=on,
            off=off,
            far_on=far,
            far_off=far,
            since=shot.start,
            followed=followed,
            at_middle=followed,
            unshown=begin_unshown(latent),
            silent_change=unknown,
        )
        if self.lookahead:
            value, variance = latent.value, latent.variance
            if shot.middle > begin:
                lead_in = bridge.extend_backward(latent, on, off, thresholds, self.noise, begin, shot.middle)
                lead_in = lead_in._replace(
                    still_since=shot.start,
                    trail=self._lead_in_trail(shot, followed),
                    unshown=memory.unshown,
                )
                value = lead_in.augmented
                variance = lead_in.backward_variance + lead_in.step_variance * (on + off)
        else:
            carried = self._carried(memory, shot)
            value, variance = carried.value, carried.variance
        unmeasured = variance >= bridge.UNMEASURED
        variance = np.where(unmeasured, np.float32(self.settings.filter.initial_variance), variance)
        if shot.valid is not None:
            variance[~shot.valid] = self.unseen_variance(shot)
        return memory, lead_in, State(value, variance, newest)

    def segment(
        self, memory: BridgeMemory, shot: Shot, following: Shot | None, events: Chunks
    ) -> tuple[Segment, BridgeMemory]:
        start = self.node(shot)
        if following is None:
            seconds = memory.interval or USUAL_INTERVAL * 1e-6
            latent = memory.latent
            if not self.lookahead:
                latent = self._carried(memory, shot)
            alone = bridge.extend(latent, memory.thresholds, self.noise, start, FAR_FUTURE, seconds, None)
            if shot.trail is None:
                trail = self._trail(memory.followed, start, memory.followed.scale)
            else:
                trail = given_trail(shot.trail.before, np.zeros(self.shape, np.float32))
            alone = alone._replace(
                still_since=_still_since(memory, start, seconds),
                trail=trail,
                unshown=memory.unshown,
                silent_change=memory.silent_change,
            )
            return alone, memory
        interval = (following.middle - shot.middle) * 1e-6
        second = self.latent(following, events, memory.thresholds)
        on, off, at_middle = self.follow(events, start, following.middle, memory.followed)
        if self.lookahead:
            scale = at_middle.scale
            trail = self._trail(memory.followed, start, scale)
            at_end = self._trail_at(at_middle, following.middle, scale)
            if shot.trail is not None and following.trail is not None:
                at_end = following.trail.after
                trail = given_trail(shot.trail.before, at_end)
            grown = at_end - trail.start
            joined, learned = bridge.bridge(
                memory.latent,
                second._replace(value=second.value - grown),
                on,
                off,
                memory.thresholds,
                self.noise,
                start,
                following.middle,
            )
            net = bridge.net_change(joined, on, off, grown)
            unmeasured = memory.latent.variance >= bridge.UNMEASURED
            change = self._silent_change(joined)
            joined = joined._replace(
                bound=second,
                floor=bridge.floor_before(second, net, unmeasured),
                trail=trail,
                silent_change=change,
            )
            joined, far_on, far_off = self._drifting(joined, memory, second, on, off)
            unshown = follow_unshown(memory.unshown, second, net)
            after = memory._replace(
                latent=second,
                thresholds=learned,
                interval=interval,
                on=on,
                off=off,
                far_on=far_on,
                far_off=far_off,
                followed=at_middle,
                at_middle=at_middle,
                unshown=unshown,
                silent_change=change,
            )
            return joined._replace(unshown=unshown), after
        # Of what came before: what the segment holds is still to come when it is read.
        scale = memory.followed.scale
        grown = self._trail_at(at_middle, following.middle, scale)
        grown -= self._trail_at(memory.at_middle, shot.middle, scale)
        behind, learned = bridge.bridge(
            memory.latent,
            second._replace(value=second.value - grown),
            on + memory.on,
            off + memory.off,
            memory.thresholds,
            self.noise,
            shot.middle,
            following.middle,
        )
        tail_on, tail_off, followed = self.follow(events, following.middle, following.end, at_middle)
        net = bridge.net_change(behind, on + memory.on, off + memory.off, grown)
        after = memory._replace(
            latent=second,
            thresholds=learned,
            interval=interval,
            on=tail_on,
            off=tail_off,
            followed=followed,
            at_middle=at_middle,
            unshown=follow_unshown(memory.unshown, second, net),
            silent_change=self._silent_change(behind),
        )
        forward = bridge.extend(
            self._carried(memory, shot),
            memory.thresholds,
            self.noise,
            start,
            following.end,
            memory.interval or USUAL_INTERVAL * 1e-6,
            self._carried(after, following),
        )
        forward = forward._replace(
            trail=self._trail(memory.followed, start, scale),
            unshown=memory.unshown,
            silent_change=memory.silent_change,
        )
        forward, far_on, far_off = self._drifting(forward, memory, second, on + tail_on, off + tail_off)
        return forward, after._replace(far_on=far_on, far_off=far_off)

    def follow(
        self, events: Chunks, start: int, end: int, before: Followed
    ) -> tuple[Floats, Floats, Followed]:
        """`counts`, and what is known of the pixels' newest events at ``end`` (K14)."""
        return follow(all_between(events, start, end), before, start, end)

    def _trail(self, followed: Followed, start: int, scale: float) -> Trail:
        """By how much events trail the light in the segment from ``start`` on (K14)."""
        height = self.settings.events.trail
        return Trail(
            self._trail_at(followed, start, scale),
            polarity_of(followed.newest),
            scale,
            height * self.on,
            height * self.off,
        )

    def _lead_in_trail(self, shot: Shot, followed: Followed) -> Trail:
        """The same before the middle of the first exposure, where the frame keeps its level."""
        if shot.trail is not None:
            return given_trail(shot.trail.after, shot.trail.after)
        trail = self._trail(followed, shot.middle, followed.scale)
        return trail._replace(polarity=np.zeros(self.shape, np.int8))

    def _trail_at(self, followed: Followed, t: int, scale: float) -> NDArray[np.float32]:
        height = self.settings.events.trail
        return trail_at(followed.newest, t, (scale, height * self.on, height * self.off))

    def _silent_change(self, segment: BridgedSegment) -> Floats:
        return silent_change(segment, self.noise.quantisation_variance, self.on * self.off)

    def _drifting(
        self, segment: BridgedSegment, memory: BridgeMemory, second: Latent, on: Floats, off: Floats
    ) -> tuple[BridgedSegment, Floats, Floats]:
        """The segment with what its pixels may drift (K10), and the counts since they were measured, at its end."""
        far = memory.far_on, memory.far_off
        grown, far_on, far_off = bridge.drift(
            memory.latent, second, memory.thresholds, self.noise, far, (on, off)
        )
        if segment.silent_change is not None:
            q0 = self.noise.quantisation_variance
            forget_silence(grown, segment, second, (on, off), segment.silent_change, q0)
        if second.ceiling is not None:
            black = np.isfinite(second.ceiling)
            grown[black] = second.variance[black] / (_BLACK_FRAMES * (_BLACK_FRAMES + 1))
        segment = segment._replace(
            drift=grown,
            still_since=_still_since(memory, segment.start, memory.interval or USUAL_INTERVAL * 1e-6),
        )
        return segment, far_on, far_off

    def _carried(self, memory: BridgeMemory, shot: Shot) -> Latent:
        """The latest frame, ``shot``, from the middle to the end of its exposure, with the events between (10)."""
        step = self.on * memory.thresholds.on * memory.on - self.off * memory.thresholds.off * memory.off
        scale = memory.followed.scale
        step += self._trail_at(memory.followed, shot.end, scale)
        step -= self._trail_at(memory.at_middle, shot.middle, scale)
        return Latent(
            memory.latent.value + step,
            memory.latent.variance + self.noise.step_variance * (memory.on + memory.off),
            None if memory.latent.ceiling is None else memory.latent.ceiling + step,
        )

    def begin(self, segment: Any, state: State) -> akf.BridgedCursor:
        spare, self._spare = self._spare, None
        return akf.begin_bridged(segment, state, spare)

    def advance(self, segment: Any, cursor: akf.BridgedCursor, events: EventArray) -> None:
        settings = self.settings.events
        noise = akf.BridgedNoise(settings.background_rate, settings.step_noise, self.on * self.off)
        akf.advance_bridged(segment, cursor, events, noise)

    def read(self, segment: Any, cursor: akf.BridgedCursor, t: int) -> tuple[Floats, Floats]:
        return akf.read_bridged(segment, cursor, t)

    def end(self, segment: Any, cursor: akf.BridgedCursor) -> State:
        state = akf.end_bridged(segment, cursor)
        self._spare = cursor
        return state

    def moving(self, segment: Any, cursor: akf.BridgedCursor) -> NDArray[np.bool_]:
        return akf.moving_bridged(segment, cursor)

    def trail(self, segment: Any, cursor: akf.BridgedCursor, t: int) -> NDArray[np.float32] | None:
        return akf.trail_bridged(segment, cursor, t)

    def unshown(self, segment: BridgedSegment, variance: Floats, prior: float) -> Unshown | None:
        if segment.unshown is None:
            return None
        return expected_excess(segment.unshown, variance, self.settings.filter.initial_variance, prior)

    def silent_change(self, segment: BridgedSegment) -> Floats | None:
        return segment.silent_change

    def around(self, segment: BridgedSegment, t: int) -> Around:
        assert segment.events is not None
        share = (t - segment.start) / (segment.end - segment.start)
        between = 4.0 * share * (1.0 - share)
        return Around(
            segment.forward_variance,
            segment.backward_variance,
            segment.events,
            coming=(1.0 - share) * self.noise.step_variance,
            counted=0.0,
            quantisation_variance=self.noise.quantisation_variance,
            repeated=1.0 - between / 2.0,
            wrong=WRONG_STEPS * between * self.on * self.off,
        )


def _still_since(memory: BridgeMemory, start: int, seconds: float) -> int:
    """One frame interval before a segment, but not before the first exposure, us."""
    return max(start - round(seconds * 1e6), memory.since)


def latent_frame(
    levels: NDArray[np.integer[Any]],
    level_log: Array,
    level_variance: Array,
    exposure: Exposure,
    *,
    duration: int,
    white: float,
    event_variance: float,
) -> Latent:
    """A frame without blur at the middle of its exposure, and its variance (K3).

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
    white
        Log intensity from which a pixel is clipped: one that reached it within the exposure was, for a part of it.
    event_variance
        What each event of the exposure adds to the variance.
    """
    latent = apart(2, (levels.size,))
    scalars = np.float32(duration), np.float32(white), np.float32(event_variance)
    tables = level_log.astype(np.float32), level_variance.astype(np.float32)
    _latent_frame(levels.reshape(-1), *tables, exposure, *scalars, *latent)
    return Latent(*latent.reshape(2, *levels.shape))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _latent_frame(  # type: ignore[no-untyped-def]
    levels, level_log, level_variance, exposure, duration, white, event_variance, value, variance
):
    unmeasured = np.float32(bridge.UNMEASURED)
    fields = np.empty((EXPOSURE_FIELDS, EXPOSED), np.float32)
    middle, peak, events = (
        np.empty(EXPOSED, np.float32),
        np.empty(EXPOSED, np.float32),
        np.empty(EXPOSED, np.float32),
    )
    log_frame, known = np.empty(EXPOSED, np.float32), np.empty(EXPOSED, np.float32)
    for block in range(np.uint64(len(exposure.touched))):
        relative_levels(exposure, block, duration, fields, middle, peak, events)
        first = block * np.uint64(EXPOSED)
        count = min(np.uint64(len(levels)) - first, np.uint64(EXPOSED))
        for i in range(count):  # looking up is no vector code, the rest is
            log_frame[i] = level_log[levels[first + i]]
            known[i] = level_variance[levels[first + i]]
        for i in range(count):
            value[first + i] = log_frame[i] + middle[i]
        for i in range(count):
            doubt = known[i] + event_variance * events[i]
            clipped = log_frame[i] + peak[i] >= white or doubt >= unmeasured
            variance[first + i] = unmeasured if clipped else doubt


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

    _UNSEEN: Final = 1e6  # R_bar: worth nothing beside P, and integrals of 1/R over a linear R (7) stay exact

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
        return r_bar if shot.valid is None else np.where(shot.valid, r_bar, self._UNSEEN)

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
            variance[~shot.valid] = self.unseen_variance(shot)
        return memory, None, State(value, variance, np.full(self.shape, self.node(shot), np.int64))

    def segment(
        self, memory: InterpolationMemory, shot: Shot, following: Shot | None, events: Chunks
    ) -> tuple[Segment, InterpolationMemory]:
        if not self.lookahead:
            return self._causal(memory, shot, following, events)
        start_latent = deblur.latent_start(self.log_frame(shot), memory.integrals)
        # (17) as printed follows L^A wherever that goes, so that L^A must not go to values that are no measurements.
        unseen = self.unseen(shot)
        start_latent[unseen] = memory.forward[unseen]
        if following is None:
            segment = self._segment(memory, shot, None, start_latent, memory.scale, FAR_FUTURE)
            return segment, memory
        integrals = self.exposure(following, events)
        end_latent = deblur.latent_end(self.log_frame(following), integrals)
        integral = self.nominal(all_between(events, shot.start, following.end))
        scale = interpolation.threshold_scale(end_latent - start_latent, integral)  # (12)
        unseen_next = self.unseen(following)
        scale[unseen | unseen_next] = 1.0
        end_latent[unseen_next] = (start_latent + integral)[unseen_next]
        at_start = interpolation.backward(end_latent, scale, integral)  # (11)
        start_latent[unseen] = at_start[unseen]
        memory = memory._replace(forward=np.where(unseen, at_start, memory.forward))
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
        scale[self.unseen(shot) | self.unseen(following)] = 1.0
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

    def end(self, segment: Any, cursor: akf.InterpolatedCursor) -> State:
        return State(*self.read(segment, cursor, segment.end), cursor.newest)


class HeldFrames(_Common):
    """The complementary filter on held frames: each from the middle of its exposure, or its end if causal."""

    def node(self, shot: Shot) -> int:
        return shot.middle if self.lookahead else shot.end

    begin_time = node

    def needed_until(self, shot: Shot) -> int:
        return shot.end

    def start(self, shot: Shot, events: Chunks) -> tuple[None, None, State]:
        return None, None, self._state(self.frame(shot))

    def frame(self, shot: Shot) -> Floats:
        """log(I + I_0), (H, W) float32."""
        log_frame: Floats = log_intensity(shot.level_intensity, self.offset).astype(np.float32)[shot.levels]
        return log_frame

    def segment(
        self, memory: None, shot: Shot, following: Shot | None, events: Chunks
    ) -> tuple[Segment, None]:
        end = FAR_FUTURE if following is None else self.node(following)
        gain = np.full(self.shape, 2 * np.pi * self.settings.filter.cutoff, np.float32)
        if shot.valid is not None:
            gain[~shot.valid] = 0.0
        held = complementary.HeldSegment(self.node(shot), end, self.frame(shot), gain, self.on, self.off)
        return held, None

    def begin(self, segment: Any, state: State) -> complementary.Cursor:
        return complementary.begin(segment, state.log_intensity)

    def advance(self, segment: Any, cursor: complementary.Cursor, events: EventArray) -> None:
        complementary.advance(segment, cursor, events)

    def read(self, segment: Any, cursor: complementary.Cursor, t: int) -> tuple[Floats, Floats]:
        return complementary.read(segment, cursor, t), np.full(self.shape, np.inf, np.float32)

    def end(self, segment: Any, cursor: complementary.Cursor) -> State:
        return self._state(complementary.read(segment, cursor, segment.end))

    def _state(self, log_intensity: Floats) -> State:
        """It has neither a variance nor a memory of events."""
        return State(log_intensity, np.empty(0), np.empty(0, np.int64))
