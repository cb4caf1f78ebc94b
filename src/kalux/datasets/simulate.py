"""An event camera with frames, simulated.

Events follow ``log(radiance + log_offset)``, sampled adaptively and taken as linear between samples; every
threshold crossing gets its own interpolated time, and each pixel keeps an exact account of the level it last
reported. The approach is that of ESIM [1]_: rendering as often as the scene changes, rather than at a fixed
rate; per-pixel thresholds and background noise are as in v2e [2]_, the pixel's reset as in the original
DVS [3]_.

The order of things, each a function that later models replace or extend::

    scene -> log intensity -> segments (adaptive, linear) -> crossings (thresholds, refractory) -> events
                                                            background noise --------------------^
    scene -> exposure (mean radiance) -> shot noise -> response -> read noise -> clip, quantise -> frames

References
----------
.. [1] H. Rebecq, D. Gehrig, D. Scaramuzza, "ESIM: an Open Event Camera Simulator", CoRL 2018.
.. [2] Y. Hu, S.-C. Liu, T. Delbruck, "v2e: From Video Frames to Realistic DVS Events", CVPRW 2021.
.. [3] P. Lichtsteiner, C. Posch, T. Delbruck, "A 128x128 120 dB 15 us Latency Asynchronous Temporal Contrast
   Vision Sensor", IEEE J. Solid-State Circuits 43(2), 2008.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kalux.datasets.scenes import LOG_OFFSET, Scene
from kalux.errors import ExposureError, SettingsError
from kalux.events import EVENT_DTYPE, EventArray
from kalux.frames import Frame
from kalux.readers import GroundTruth
from kalux.recording import Recording

FloatArray = NDArray[np.float64]
Response = Callable[[FloatArray], FloatArray]
"""Camera response: irradiance 0 to 1 (1 = white) to response 0 to 1, monotonic, element-wise."""

# One stream of random numbers per cause, so that switching one on leaves the others as they were.
_MISMATCH, _NOISE, _CAMERA = 0, 1, 2

_LEAST_THRESHOLD: Final = 0.2
"""Least threshold of a pixel, as a fraction of the mean: below it a Gaussian is no description of a sensor,
and a threshold near zero would fire without end."""


def _require(settings: object, name: str, good: bool, what: str) -> None:
    if not good:
        raise SettingsError(f"{type(settings).__name__}: {name} is {getattr(settings, name)}; it {what}")


def linear_response(irradiance: FloatArray) -> FloatArray:
    """The response of an ideal camera: the irradiance itself."""
    return irradiance


@dataclass(frozen=True, kw_only=True)
class SensorSettings:
    """The sensor. The defaults are an ideal one: every imperfection is asked for.

    Attributes
    ----------
    threshold_on, threshold_off
        Mean step of (natural) log intensity that makes an event, positive. 0.2 is v2e's default [2]_.
    threshold_mismatch
        Relative standard deviation of each pixel's thresholds; Gaussian, drawn for on and off separately, and
        never below 0.2 of the mean. 0: all alike. v2e's default is 0.15 (0.03 of 0.2) [2]_.
    log_offset
        Radiance added before the logarithm, in units of white. See `kalux.datasets.scenes.LOG_OFFSET`.
    refractory
        us that a pixel is held in reset after each of its events [3]_: it ignores all changes, and then takes
        the intensity of that moment as its new reference, so that what happened meanwhile is lost. 0: none;
        the reference then moves by exactly one threshold per event.
    noise_rate
        Background events per pixel and second (both polarities together, equally likely), Poisson.
    noise_resets
        False: noise events are added to the stream and change nothing else. True: a noise event is an event
        of the pixel like any other: it resets the reference to the present intensity, starts the refractory
        period, and is lost within one, as in the circuit.
    timestamp_resolution
        us; times are rounded to multiples of it.
    frame_rate
        Frames per second. The middle of frame k is at (k + 1/2) / rate after the scene's start.
    exposure
        us, of every frame, unless `simulate` is given others. All rows expose at once (global shutter).
    reference_exposure
        The exposure, us, at which radiance 1.0 is white. None: the median of the exposures, as in
        reconstructions.
    response
        Camera response function.
    read_noise
        Standard deviation, in units of the response (1 = white).
    full_well
        Electrons at white: photon (shot) noise is Poisson with their number. None: no shot noise.
    bits
        Bits of a frame's pixel, 1 to 16: uint8 up to 8 bits, uint16 above.

    Raises
    ------
    SettingsError
        If a value is out of its range.
    """

    threshold_on: float = 0.2
    threshold_off: float = 0.2
    threshold_mismatch: float = 0.0
    log_offset: float = LOG_OFFSET
    refractory: float = 0.0
    noise_rate: float = 0.0
    noise_resets: bool = False
    timestamp_resolution: int = 1
    frame_rate: float = 24.0
    exposure: int = 10_000
    reference_exposure: int | None = None
    response: Response = linear_response
    read_noise: float = 0.0
    full_well: float | None = None
    bits: int = 8

    def __post_init__(self) -> None:
        for name in ("threshold_on", "threshold_off", "log_offset", "frame_rate", "exposure"):
            _require(self, name, getattr(self, name) > 0, "must be positive")
        for name in ("threshold_mismatch", "refractory", "noise_rate", "read_noise"):
            _require(self, name, getattr(self, name) >= 0, "must not be negative")
        for name in ("reference_exposure", "full_well"):
            value = getattr(self, name)
            _require(self, name, value is None or value > 0, "must be positive, or None")
        _require(self, "timestamp_resolution", self.timestamp_resolution >= 1, "must be 1 us or more")
        _require(self, "bits", 1 <= self.bits <= 16, "must be 1 to 16")


DEMO_SENSOR: Final = SensorSettings(
    threshold_on=0.2,
    threshold_off=0.24,
    threshold_mismatch=0.05,
    refractory=200.0,
    noise_rate=0.5,
    frame_rate=25.0,
    exposure=12_000,
    read_noise=0.006,
)
"""The sensor for `kalux.datasets.scenes.demo_scene`: an ordinary one, a little noisy, with unequal thresholds
and exposures long enough to blur."""


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How finely the scene is looked at: accuracy against time. Nothing of the sensor.

    Attributes
    ----------
    threshold_fraction
        A step is halved while a pixel changes by more than this fraction of the smaller mean threshold.
    min_step, max_step
        us. No step is halved to less than ``min_step``: a highlight's edge crosses many thresholds in
        hundredths of a pixel, and following it further buys accuracy below a real sensor's jitter. Changes
        that come and go within ``max_step`` may be missed.
    exposure_step
        us between the samples of an exposure (midpoint rule, at least 8 samples).

    Raises
    ------
    SettingsError
        If a value is out of its range.
    """

    threshold_fraction: float = 0.5
    min_step: float = 125.0
    max_step: float = 4000.0
    exposure_step: float = 500.0

    def __post_init__(self) -> None:
        for name in ("threshold_fraction", "min_step", "exposure_step"):
            _require(self, name, getattr(self, name) > 0, "must be positive")
        _require(self, "max_step", self.max_step >= self.min_step, "must not be less than min_step")


@dataclass(frozen=True, eq=False)
class Simulation:
    """What `simulate` made, and from what.

    Attributes
    ----------
    scene, settings, seed
        As given.
    events
        `EVENT_DTYPE`, sorted by t, then y, then x.
    frames
        In time order.
    threshold_on, threshold_off
        (height, width) float64: the thresholds of each pixel.
    """

    scene: Scene
    settings: SensorSettings
    seed: int
    events: EventArray
    frames: list[Frame] = field(repr=False)
    threshold_on: FloatArray = field(repr=False)
    threshold_off: FloatArray = field(repr=False)

    def truth_times(self) -> NDArray[np.int64]:
        """Middles of the frames and halfway between them, second frame to last but one; (T,) int64 us."""
        middles = np.array([frame.middle for frame in self.frames[1:-1]], np.int64)
        return np.sort(np.concatenate([middles, (middles[1:] + middles[:-1]) // 2]))

    def truth(self, times: ArrayLike | None = None) -> GroundTruth:
        """True radiance, without blur, noise or saturation.

        Parameters
        ----------
        times
            (T,) int us, within the scene. Default: `truth_times`.
        """
        at = self.truth_times() if times is None else np.asarray(times, np.int64)
        images = np.empty((len(at), *self.scene.sensor_size), np.float32)
        for i, t in enumerate(at):
            images[i] = self.scene.at(float(t))
        return GroundTruth(at, images)

    def recording(self, times: ArrayLike | None = None) -> Recording:
        """The events and frames as a recording, with the ground truth at ``times`` (as in `truth`)."""
        return Recording.from_arrays(
            self.events,
            self.frames,
            sensor_size=self.scene.sensor_size,
            contrast_threshold=(self.settings.threshold_on, self.settings.threshold_off),
            ground_truth=self.truth(times),
            name=self.scene.name,
        )


def simulate(
    scene: Scene,
    settings: SensorSettings | None = None,
    *,
    seed: int = 0,
    exposures: Sequence[int] | None = None,
    sampling: Sampling | None = None,
) -> Simulation:
    """Look at a scene with an event camera that also takes frames.

    Parameters
    ----------
    scene
        What there is to see.
    settings
        The sensor. Default: an ideal one.
    seed
        Not negative. The same arguments give the same bits.
    exposures
        us, one per frame: a camera with automatic exposure. The number of frames is the scene's duration
        times the frame rate, rounded down. Default: ``settings.exposure`` for all.
    sampling
        Accuracy.

    Returns
    -------
    Simulation
        Events, frames and access to the truth.

    Raises
    ------
    SettingsError
        If the seed is negative.
    ExposureError
        If exposures overlap, or are not one per frame.
    InputError
        If the scene returns an image of the wrong size, negative or not finite.
    """
    settings = settings if settings is not None else SensorSettings()
    sampling = sampling if sampling is not None else Sampling()
    if seed < 0:
        raise SettingsError(f"simulate: seed is {seed}; it must not be negative")
    threshold_on, threshold_off = draw_thresholds(scene.sensor_size, settings, seed)
    events = simulate_events(scene, settings, threshold_on, threshold_off, seed, sampling)
    frames = simulate_frames(scene, settings, seed, exposures, sampling)
    return Simulation(scene, settings, seed, events, frames, threshold_on, threshold_off)


# --- events -----------------------------------------------------------------------------------------------


def draw_thresholds(
    sensor_size: tuple[int, int], settings: SensorSettings, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Thresholds of each pixel, on and off: (height, width) float64, positive."""
    rng = np.random.default_rng([seed, _MISMATCH])
    spread = rng.standard_normal((2, *sensor_size)) * settings.threshold_mismatch
    on, off = np.maximum(1.0 + spread, _LEAST_THRESHOLD)
    return on * settings.threshold_on, off * settings.threshold_off


def simulate_events(
    scene: Scene,
    settings: SensorSettings,
    threshold_on: FloatArray,
    threshold_off: FloatArray,
    seed: int,
    sampling: Sampling,
) -> EventArray:
    """All events of a scene, sorted; thresholds as from `draw_thresholds`."""
    noise = draw_noise(scene, settings, seed)
    pixels = _Pixels(
        on=threshold_on.ravel(),
        off=threshold_off.ravel(),
        refractory=settings.refractory,
        reference=_log_intensity(scene, settings, scene.start),
        release=np.full(threshold_on.size, -np.inf),
    )
    inside = noise if settings.noise_resets else _no_noise(threshold_on.size)
    buffer, count = _empty_buffer(1 << 16), 0
    for segment in _segments(scene, settings, sampling):
        buffer, count = _advance(segment, pixels, inside, buffer, count)
    t, pixel, p = buffer.t[:count], buffer.pixel[:count], buffer.p[:count]
    if not settings.noise_resets:
        t, p = np.concatenate([t, noise.t]), np.concatenate([p, noise.p])
        pixel = np.concatenate([pixel, np.repeat(np.arange(threshold_on.size), noise.end - noise.next)])
    return _sorted_events(t, pixel, p, scene.sensor_size[1], settings.timestamp_resolution)


def draw_noise(scene: Scene, settings: SensorSettings, seed: int) -> _Noise:
    """Background events: a Poisson process per pixel, polarities equally likely."""
    rng = np.random.default_rng([seed, _NOISE])
    height, width = scene.sensor_size
    counts = rng.poisson(settings.noise_rate * scene.duration * 1e-6, height * width)
    t = rng.uniform(scene.start, scene.end, int(counts.sum()))
    order = np.lexsort((t, np.repeat(np.arange(height * width), counts)))
    end = np.cumsum(counts)
    return _Noise(t[order], rng.random(len(t)) < 0.5, end - counts, end)


def _log_intensity(scene: Scene, settings: SensorSettings, t: float) -> FloatArray:
    """(height * width,) float64: what an event pixel compares. Precise as the scene's own dtype."""
    return np.asarray(np.log(scene.at(t) + settings.log_offset), np.float64).ravel()


class _Segment(NamedTuple):
    """A stretch of time over which each pixel's log intensity is linear; times in us."""

    t0: float
    t1: float
    before: FloatArray
    after: FloatArray


class _Pixels(NamedTuple):
    """State of all pixels: the level last reported, and until when each is held in reset (us)."""

    on: FloatArray
    off: FloatArray
    refractory: float
    reference: FloatArray
    release: FloatArray


class _Noise(NamedTuple):
    """Noise events sorted by pixel, then time (us); those of pixel i still to come are next[i] to end[i]."""

    t: FloatArray
    p: NDArray[np.bool_]
    next: NDArray[np.int64]
    end: NDArray[np.int64]


class _Buffer(NamedTuple):
    """Events as they are found: t in us, not rounded."""

    t: FloatArray
    pixel: NDArray[np.int64]
    p: NDArray[np.bool_]


def _no_noise(size: int) -> _Noise:
    return _Noise(np.empty(0), np.empty(0, bool), np.zeros(size, np.int64), np.zeros(size, np.int64))


def _empty_buffer(capacity: int) -> _Buffer:
    return _Buffer(np.empty(capacity), np.empty(capacity, np.int64), np.empty(capacity, bool))


def _segments(scene: Scene, settings: SensorSettings, sampling: Sampling) -> Iterator[_Segment]:
    """Cut the scene's time into segments, halving each as long as a pixel changes too much in it."""
    limit = sampling.threshold_fraction * min(settings.threshold_on, settings.threshold_off)
    coarse = np.linspace(scene.start, scene.end, int(np.ceil(scene.duration / sampling.max_step)) + 1)
    t0, before = float(scene.start), _log_intensity(scene, settings, scene.start)
    for stop in coarse[1:]:
        pending = [(float(stop), _log_intensity(scene, settings, float(stop)))]
        while pending:
            t1, after = pending[-1]
            if t1 - t0 >= 2 * sampling.min_step and _largest_change(before, after) > limit:
                middle = (t0 + t1) / 2
                pending.append((middle, _log_intensity(scene, settings, middle)))
            else:
                yield _Segment(t0, t1, before, after)
                t0, before = pending.pop()


@numba.njit(cache=True)
def _largest_change(before: FloatArray, after: FloatArray) -> float:
    largest = 0.0
    for i in range(len(before)):
        largest = max(largest, abs(after[i] - before[i]))
    return largest


@numba.njit(cache=True)
def _advance(
    segment: _Segment, pixels: _Pixels, noise: _Noise, buffer: _Buffer, count: int
) -> tuple[_Buffer, int]:
    """Take all pixels through a segment and append their events; returns the buffer and its new count."""
    # Arrays are taken out of their tuples, and quiet pixels passed over here: nearly all pixels are quiet in
    # a segment, and this loop is where the time goes.
    t0, t1, after = segment.t0, segment.t1, segment.after
    on, off, reference, release = pixels.on, pixels.off, pixels.reference, pixels.release
    with_noise = len(noise.t) > 0
    for i in range(len(after)):
        change = after[i] - reference[i]
        quiet = -off[i] < change < on[i] and release[i] <= t0
        if quiet and not (with_noise and _noise_time(noise, i) <= t1):
            continue
        buffer, count = _advance_pixel(segment, pixels, noise, buffer, count, i)
    return buffer, count


@numba.njit(cache=True)
def _noise_time(noise: _Noise, i: int) -> float:
    """Time of pixel i's next noise event, us; infinite if there is none."""
    t: float = noise.t[noise.next[i]] if noise.next[i] < noise.end[i] else np.inf
    return t


@numba.njit(cache=True)
def _advance_pixel(
    segment: _Segment, pixels: _Pixels, noise: _Noise, buffer: _Buffer, count: int, i: int
) -> tuple[_Buffer, int]:
    """Take pixel i through a segment, one event after the other."""
    t = segment.t0
    while True:
        if pixels.release[i] > t:
            if pixels.release[i] > segment.t1:
                return buffer, count
            t = pixels.release[i]
            pixels.reference[i] = _level(segment, t, i)
            while _noise_time(noise, i) <= t:
                noise.next[i] += 1
        crossing, p = _next_crossing(segment, pixels, i)
        chance = _noise_time(noise, i)
        if min(crossing, chance) > segment.t1:
            return buffer, count
        if crossing <= chance:
            t = max(t, crossing)
            pixels.reference[i] += pixels.on[i] if p else -pixels.off[i]
        else:
            t, p = chance, noise.p[noise.next[i]]
            noise.next[i] += 1
            pixels.reference[i] = _level(segment, t, i)
        if pixels.refractory > 0.0:
            pixels.release[i] = t + pixels.refractory
        if count == len(buffer.t):
            buffer = _grown(buffer)
        buffer.t[count], buffer.pixel[count], buffer.p[count] = t, i, p
        count += 1


@numba.njit(cache=True)
def _level(segment: _Segment, t: float, i: int) -> float:
    """Log intensity of pixel i at a time within the segment."""
    share = (t - segment.t0) / (segment.t1 - segment.t0)
    level: float = segment.before[i] + share * (segment.after[i] - segment.before[i])
    return level


@numba.njit(cache=True)
def _next_crossing(segment: _Segment, pixels: _Pixels, i: int) -> tuple[float, bool]:
    """Time (us) and polarity of pixel i's next threshold crossing; infinite if not in this segment."""
    before, after = segment.before[i], segment.after[i]
    brighter = after > before
    level = pixels.reference[i] + (pixels.on[i] if brighter else -pixels.off[i])
    if after == before or (after < level if brighter else after > level):
        return np.inf, brighter
    share = (level - before) / (after - before)
    return min(segment.t0 + share * (segment.t1 - segment.t0), segment.t1), brighter


@numba.njit(cache=True)
def _grown(buffer: _Buffer) -> _Buffer:
    """The buffer with twice its room."""
    n = len(buffer.t)
    t, pixel, p = np.empty(2 * n), np.empty(2 * n, np.int64), np.empty(2 * n, np.bool_)
    t[:n], pixel[:n], p[:n] = buffer.t, buffer.pixel, buffer.p
    return _Buffer(t, pixel, p)


def _sorted_events(
    t: FloatArray, pixel: NDArray[np.int64], p: NDArray[np.bool_], width: int, resolution: int
) -> EventArray:
    """Round the times and sort by t, y, x; events of one pixel in one tick keep their order."""
    ticks = np.rint(t / resolution).astype(np.int64) * resolution
    order = np.lexsort((t, pixel, ticks))
    events = np.empty(len(t), EVENT_DTYPE)
    events["t"] = ticks[order]
    events["y"], events["x"] = np.divmod(pixel[order], width)
    events["p"] = p[order]
    return events


# --- frames -----------------------------------------------------------------------------------------------


def simulate_frames(
    scene: Scene,
    settings: SensorSettings,
    seed: int,
    exposures: Sequence[int] | None,
    sampling: Sampling,
) -> list[Frame]:
    """All frames of a scene; arguments as in `simulate`."""
    rng = np.random.default_rng([seed, _CAMERA])
    intervals = _exposure_intervals(scene, settings, exposures)
    if not len(intervals):
        return []
    lengths = intervals[:, 1] - intervals[:, 0]
    reference = settings.reference_exposure or float(np.median(lengths))
    white = (1 << settings.bits) - 1
    stated_white = None if settings.bits in (8, 16) else float(white)
    frames = []
    for (start, end), length in zip(intervals.tolist(), lengths.tolist(), strict=True):
        irradiance = mean_radiance(scene, start, end, sampling.exposure_step) * (length / reference)
        image = quantise(respond(irradiance, settings, rng), settings.bits)
        frames.append(Frame(image, start, end, stated_white))
    return frames


def mean_radiance(scene: Scene, start: int, end: int, step: float) -> FloatArray:
    """Radiance averaged over an exposure (times and step in us): (height, width) float64.

    The midpoint rule: exact where radiance changes linearly.
    """
    count = max(8, int(np.ceil((end - start) / step)))
    total = np.zeros(scene.sensor_size)
    for k in range(count):
        total += scene.at(start + (k + 0.5) / count * (end - start))
    return total / count


def respond(irradiance: FloatArray, settings: SensorSettings, rng: np.random.Generator) -> FloatArray:
    """Irradiance (1 = white, more where saturated) to camera response, noisy and clipped to 0 to 1."""
    if settings.full_well is not None:
        irradiance = rng.poisson(irradiance * settings.full_well) / settings.full_well
    response = settings.response(np.minimum(irradiance, 1.0))
    # What exceeds white is kept until the noise is in, or noise would lift half of the saturated pixels
    # out of saturation.
    response = response + np.maximum(irradiance - 1.0, 0.0)
    if settings.read_noise > 0:
        response = response + settings.read_noise * rng.standard_normal(response.shape)
    return np.clip(response, 0.0, 1.0)


def quantise(response: FloatArray, bits: int) -> NDArray[Any]:
    """Response 0 to 1 to the nearest integer of ``bits`` bits, uint8 or uint16."""
    return np.rint(response * ((1 << bits) - 1)).astype(np.uint8 if bits <= 8 else np.uint16)


def _exposure_intervals(
    scene: Scene, settings: SensorSettings, exposures: Sequence[int] | None
) -> NDArray[np.int64]:
    """(K, 2) int64: start and end of each exposure, us."""
    period = 1e6 / settings.frame_rate
    count = int(np.floor(scene.duration / period + 1e-9))
    lengths = np.full(count, settings.exposure) if exposures is None else np.asarray(exposures, np.int64)
    if lengths.shape != (count,):
        raise ExposureError(
            f"simulate: {len(lengths)} exposures for {count} frames "
            f"({scene.duration} us at {settings.frame_rate} frames per second)"
        )
    if count and lengths.min() <= 0:
        raise ExposureError(f"simulate: an exposure is {lengths.min()} us; it must be positive")
    middles = scene.start + (np.arange(count) + 0.5) * period
    starts = np.rint(middles - lengths / 2).astype(np.int64)
    ends = starts + lengths
    if count and (starts[0] < scene.start or ends[-1] > scene.end or (starts[1:] < ends[:-1]).any()):
        raise ExposureError(
            f"simulate: exposures up to {lengths.max()} us do not fit into frames {period:.0f} us apart"
        )
    return np.stack([starts, ends], axis=1)
