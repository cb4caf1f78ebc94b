"""Events of a scene, as a stream: segments of time, cut where the scene changes, taken through all pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.datasets.pixels import (
    Buffer,
    FloatArray,
    Pixels,
    Segment,
    advance,
    empty_buffer,
    first_waits,
    largest_change,
)
from kalux.datasets.scenes import Scene
from kalux.datasets.sensors import Sampling, SensorSettings
from kalux.events import EVENT_DTYPE, EventArray
from kalux.writers.files import uninterrupted

# One stream of random numbers per cause, so that switching one on leaves the others as they were.
MISMATCH, NOISE, CAMERA, RATES, HOT, PHASE, FIXED = range(7)

_LEAST_THRESHOLD: Final = 0.2
"""Least threshold of a pixel, as a fraction of the mean: below it a Gaussian is no description of a sensor,
and a threshold near zero would fire without end."""

_CHUNK: Final = 1 << 16


def draw_thresholds(
    sensor_size: tuple[int, int], settings: SensorSettings, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Thresholds of each pixel, on and off: (height, width) float64, positive."""
    rng = np.random.default_rng([seed, MISMATCH])
    spread = rng.standard_normal((2, *sensor_size)) * settings.threshold_mismatch
    on, off = np.maximum(1.0 + spread, _LEAST_THRESHOLD)
    return on * settings.threshold_on, off * settings.threshold_off


def draw_rates(
    sensor_size: tuple[int, int], settings: SensorSettings, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Leak and (dark) noise rates of each pixel, Hz: (height, width) float64."""
    spread = np.random.default_rng([seed, RATES]).standard_normal((2, *sensor_size))
    leak, noise = 10.0 ** (spread * settings.noise_spread)
    hot = np.random.default_rng([seed, HOT]).random(sensor_size) < settings.hot_pixels
    return np.where(hot, settings.hot_rate, leak * settings.leak_rate), noise * settings.noise_rate


def event_chunks(
    scene: Scene,
    settings: SensorSettings,
    *,
    seed: int,
    sampling: Sampling,
    chunk: int = _CHUNK,
    on_time: Callable[[float], None] = lambda t: None,
) -> Iterator[EventArray]:
    """All events of a scene in time order, in chunks.

    Parameters
    ----------
    scene, settings, seed, sampling
        As of `kalux.datasets.simulate`.
    chunk
        Events after which a chunk is given out. Whatever it is, the events are the same.
    on_time
        Told up to which time, us, the scene has been seen.

    Yields
    ------
    `EVENT_DTYPE`, sorted by t, then y, then x, across chunks too; several events of one pixel in one tick in the order
    in which they happened.
    """
    width, resolution = scene.sensor_size[1], settings.timestamp_resolution
    pixels = _pixels(scene, settings, seed)
    buffer, count = empty_buffer(_CHUNK), 0
    for segment in _segments(scene, settings, sampling):
        with uninterrupted():  # an exception while compiled code makes a named tuple would crash the process
            buffer, count = advance(segment, pixels, buffer, count)
        if count >= chunk:
            # Events still to be found are later than this tick, or in it.
            horizon = np.rint((segment.t1 + settings.latency) / resolution) * resolution
            ready, buffer, count = _split(buffer, count, horizon, resolution)
            yield _sorted_events(ready, width, resolution)
        on_time(segment.t1)
    yield _sorted_events(_first(buffer, count), width, resolution)


def _pixels(scene: Scene, settings: SensorSettings, seed: int) -> Pixels:
    """All pixels as they are at the scene's start."""
    on, off = (values.ravel() for values in draw_thresholds(scene.sensor_size, settings, seed))
    leak, noise = (values.ravel() for values in draw_rates(scene.sensor_size, settings, seed))
    level = _sample(scene, settings, scene.start).level
    reference = level.copy()
    if settings.settled:
        reference += np.random.default_rng([seed, PHASE]).uniform(-on, off)
    random = np.random.default_rng([seed, NOISE]).integers(0, 1 << 64, on.size, np.uint64)
    return Pixels(
        on=on,
        off=off,
        tau=1e6 / (2 * np.pi * settings.cutoff) if settings.cutoff else 0.0,
        leak=leak * on * 1e-6,
        noise=noise * 1e-6,
        at_white=settings.noise_at_white,
        log_offset=settings.log_offset,
        resets=settings.noise_resets,
        refractory=float(settings.refractory),
        latency=float(settings.latency),
        reference=reference,
        level=level.copy(),
        release=np.full(on.size, -np.inf),
        wait=first_waits(random),
        random=random,
    )


# --- segments ---------------------------------------------------------------------------------------------


class _Sample(NamedTuple):
    """What the event pixels see at a moment: (N,) radiance plus log offset, and its logarithm."""

    light: FloatArray
    level: FloatArray


def _sample(scene: Scene, settings: SensorSettings, t: float) -> _Sample:
    """Precise as the scene's own dtype."""
    light = scene.at(t).ravel() + settings.log_offset
    return _Sample(np.asarray(light, np.float64), np.asarray(np.log(light), np.float64))


def _segments(scene: Scene, settings: SensorSettings, sampling: Sampling) -> Iterator[Segment]:
    """Cut the scene's time into segments, halving each as long as a pixel changes too much in it."""
    limit = sampling.threshold_fraction * min(settings.threshold_on, settings.threshold_off)
    coarse = np.linspace(scene.start, scene.end, int(np.ceil(scene.duration / sampling.max_step)) + 1)
    t0, before = float(scene.start), _sample(scene, settings, scene.start)
    for stop in coarse[1:]:
        pending = [(float(stop), _sample(scene, settings, float(stop)))]
        while pending:
            t1, after = pending[-1]
            if t1 - t0 >= 2 * sampling.min_step and largest_change(before.level, after.level) > limit:
                middle = (t0 + t1) / 2
                pending.append((middle, _sample(scene, settings, middle)))
            else:
                yield Segment(t0, t1, before.level, after.level, before.light, after.light)
                t0, before = pending.pop()


# --- events in order --------------------------------------------------------------------------------------


def _first(buffer: Buffer, count: int) -> Buffer:
    return Buffer(buffer.t[:count], buffer.pixel[:count], buffer.p[:count])


def _split(buffer: Buffer, count: int, horizon: float, resolution: int) -> tuple[Buffer, Buffer, int]:
    """Events before a tick, and a buffer with the rest and its count."""
    found = _first(buffer, count)
    ready = np.rint(found.t / resolution) * resolution < horizon
    kept = count - int(np.count_nonzero(ready))
    taken = Buffer(found.t[ready], found.pixel[ready], found.p[ready])
    for column, rest in zip(buffer, (found.t[~ready], found.pixel[~ready], found.p[~ready]), strict=True):
        column[:kept] = rest
    return taken, buffer, kept


def _sorted_events(found: Buffer, width: int, resolution: int) -> EventArray:
    """Round the times and sort by t, y, x; events of one pixel in one tick keep their order."""
    ticks = np.rint(found.t / resolution).astype(np.int64) * resolution
    order = np.lexsort((found.t, found.pixel, ticks))
    events: EventArray = np.empty(len(ticks), EVENT_DTYPE)
    events["t"] = ticks[order]
    events["y"], events["x"] = np.divmod(found.pixel[order], width)
    events["p"] = found.p[order]
    return events


def all_events(chunks: Iterator[EventArray]) -> EventArray:
    """Chunks as one array."""
    found: list[NDArray[np.void]] = list(chunks)
    return np.concatenate([np.empty(0, EVENT_DTYPE), *found])
