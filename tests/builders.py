"""Small recordings for tests, by hand, at random, and simulated; and pixels that no frame has shown."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import threading
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from kalux import EVENT_DTYPE, PRESETS, Frame, Recording
from kalux.augmentation.bridge import Revealed, Texture, UnshownMemory
from kalux.augmentation.highlights import Unshown
from kalux.augmentation.parts import part_grid
from kalux.datasets import (
    ColourScene,
    SensorSettings,
    Simulation,
    colour_photograph,
    demo_scene,
    pan,
    photograph_scene,
    simulate,
    simulate_colour,
)
from kalux.events import make_events
from kalux.filters.surfaces import Unmeasured
from kalux.settings import Settings, altered


def own_threads() -> list[str]:
    """Names of kalux's threads that are alive."""
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("kalux-")]


def events(*rows):
    """Rows of (t, x, y, p), in us and 0-based, to an event array."""
    columns = list(zip(*rows, strict=True)) if rows else [(), (), (), ()]
    return make_events(*(np.array(column, np.int64) for column in columns))


def pixel_events(times, polarities, x=0, y=0):
    """Events of one pixel."""
    return events(*((t, x, y, p) for t, p in zip(times, polarities, strict=True)))


def frame(value, start, end, size=(1, 1), dtype=np.uint8):
    """A frame of one value, or of an array."""
    return Frame(np.broadcast_to(np.asarray(value, dtype), np.shape(value) or size).copy(), start, end)


VARIANTS = {
    "default": PRESETS["default"],
    "iccv2021": PRESETS["iccv2021"],
    "iccv2021-exact": altered(PRESETS["iccv2021"], "filter", solution="exact"),
    "cf": PRESETS["cf"],
}


def all_given() -> Settings:
    """The default settings, of which all that a plan would estimate is given, but contrast thresholds."""
    chosen = altered(PRESETS["default"], "events", delay=0, step_variance=0.2, refractory_period=0)
    chosen = altered(chosen, "events", lag_variance=0.0, dark_steps="none")
    chosen = altered(
        chosen, "events", threshold_spread=0.1, noise_rate=3.0, leave_out_hot=False, mend_layout=False
    )
    chosen = altered(chosen, "events", extrapolation_gain=1.0, extrapolation_trust=1.0)
    chosen = altered(chosen, "filter", unshown_scale=1.0, dark_shares="even")
    chosen = altered(chosen, "camera", log_offset=0.03, frame_noise=0.006, black_level=0.0)
    chosen = altered(chosen, "camera", even_gain=False, leave_out_faulty=False)
    return altered(chosen, "camera", mend_stuck=False, mend_times=False)


class Stream(NamedTuple):
    """Events and frames to push."""

    sensor_size: tuple[int, int]
    events: np.ndarray
    frames: list[Frame]


@lru_cache(maxsize=64)
def random_stream(seed: int, *, frames: int = 4, count: int = 150, shift: int = 0) -> Stream:
    """Exposures of uneven length, clipped pixels, events on the exposures' edges and at the same times."""
    rng = np.random.default_rng(seed)
    height, width = 3, 4
    t, shots, edges = 20_000, [], []
    for _ in range(frames):
        length = int(rng.integers(2_000, 16_000))
        levels = rng.integers(0, 300, (height, width)).clip(0, 255).astype(np.uint8)
        shots.append(Frame(levels, t + shift, t + length + shift))
        edges += [t, t + length // 2, t + length]
        t += length + int(rng.integers(0, 25_000))
    times = rng.integers(0, t + 20_000, count)
    on_edge = rng.random(count) < 0.3
    times[on_edge] = rng.choice(edges, int(on_edge.sum()))
    times.sort()
    out = np.empty(count, EVENT_DTYPE)
    out["t"] = times + shift
    out["x"], out["y"] = rng.integers(0, width, count), rng.integers(0, height, count)
    out["p"] = rng.random(count) < 0.5
    return Stream((height, width), out, shots)


@lru_cache(maxsize=16)
def recording(seed=0, threshold=(0.25, 0.2), shift=0):
    """Of `random_stream`."""
    stream = random_stream(seed, shift=shift)
    return Recording.from_arrays(
        stream.events, stream.frames, sensor_size=stream.sensor_size, contrast_threshold=threshold
    )


def blocks(low=0.02, high=0.6, *, shape=(300, 300), seed=0, count=400):
    """A picture of overlapping rectangles of radiance ``low`` to ``high``, evenly in the logarithm."""
    rng = np.random.default_rng(seed)
    picture = np.full(shape, np.sqrt(low * high))
    for _ in range(count):
        y, x = rng.integers(0, shape[0]), rng.integers(0, shape[1])
        h, w = rng.integers(6, 40, 2)
        picture[y : y + h, x : x + w] = np.exp(rng.uniform(np.log(low), np.log(high)))
    return picture


@lru_cache(maxsize=8)
def moving_blocks(
    low: float = 0.02,
    high: float = 0.6,
    *,
    sensor: SensorSettings | None = None,
    exposures: tuple[int, ...] | None = None,
    duration: int = 500_000,
    size: tuple[int, int] = (32, 40),
    speed: float = 60.0,
) -> Simulation:
    """A camera that pans over `blocks`, ``speed`` in pixels/s; what is more than 1 saturates."""
    scene = photograph_scene(blocks(low, high), pan(speed), sensor_size=size, duration=duration)
    return simulate(scene, sensor, exposures=exposures)


def without_events(source: Recording, begin: int, end: int) -> Recording:
    """A recording whose sensor has dropped its events from ``begin`` to ``end``, us."""
    events = np.concatenate([*source.events()])
    kept = events[(events["t"] < begin) | (events["t"] > end)]
    return Recording.from_arrays(kept, [*source.frames()], sensor_size=source.sensor_size)


@lru_cache(maxsize=1)
def quick_frames() -> Simulation:
    """The demonstration's scene before a sensor whose frames come every 2 ms, its events 5 ms late."""
    sensor = SensorSettings(
        threshold_on=0.3,
        threshold_off=0.35,
        threshold_mismatch=0.1,
        latency=5_000.0,
        frame_rate=500.0,
        exposure=1_000,
        read_noise=0.002,
        noise_rate=1.0,
    )
    return simulate(demo_scene(sensor_size=(60, 80), duration=500_000), sensor)


@lru_cache(maxsize=4)
def slow_scene(cutoff: float, mismatch: float = 0.0) -> Recording:
    """A second with thresholds of 0.15; pixels are as fast as light (0), or slower by ``cutoff``, Hz at white."""
    sensor = SensorSettings(
        threshold_on=0.15,
        threshold_off=0.15,
        threshold_mismatch=mismatch,
        log_offset=0.004,
        cutoff=cutoff,
        frame_rate=25.0,
    )
    return simulate(demo_scene(sensor_size=(90, 120), duration=1_000_000), sensor, seed=1).recording()


def with_frame_noise(source: Recording, deviation: float) -> Recording:
    """A recording with noise in its frames, of so many of 255 levels."""
    rng = np.random.default_rng(0)
    frames = [
        dataclasses.replace(
            frame,
            image=np.clip(frame.image + rng.normal(0, deviation, frame.image.shape), 0, 255).astype(np.uint8),
        )
        for frame in source.frames()
    ]
    return Recording.from_arrays(np.concatenate([*source.events()]), frames, sensor_size=source.sensor_size)


def with_noise_events(source: Recording, rate: float) -> Recording:
    """A recording with ``rate`` more events a second in every pixel, of either polarity, that nothing makes."""
    rng = np.random.default_rng(0)
    own = np.concatenate([*source.events()])
    begin, end = int(own["t"][0]), int(own["t"][-1])
    height, width = source.sensor_size
    noise = np.zeros(rng.poisson(rate * (end - begin) * 1e-6 * height * width), EVENT_DTYPE)
    noise["t"] = rng.integers(begin, end, len(noise))
    noise["x"], noise["y"] = rng.integers(0, width, len(noise)), rng.integers(0, height, len(noise))
    noise["p"] = rng.random(len(noise)) < 0.5
    both = np.concatenate([own, noise])
    both = both[np.argsort(both["t"], kind="stable")]
    return Recording.from_arrays(both, [*source.frames()], sensor_size=source.sensor_size)


def without_any_events(source: Recording) -> Recording:
    """Its frames alone, before a sensor that has no events."""
    return Recording.from_arrays(events(), [*source.frames()], sensor_size=source.sensor_size)


def dark_scene(seed=0):
    """A pan over texture from 0.005 to 1 of white."""
    noise = np.random.default_rng(seed).standard_normal((40, 90))
    for _ in range(3):
        noise = (noise + np.roll(noise, 1, 0) + np.roll(noise, 1, 1)) / 3
    share = (noise - noise.min()) / np.ptp(noise)
    image = 0.005 * 200**share
    return photograph_scene(image, pan(80), sensor_size=(36, 48), duration=600_000)


@lru_cache(maxsize=4)
def colour_blocks(
    mosaic: str | None = None,
    *,
    high: float = 0.6,
    sensor: SensorSettings | None = None,
    size: tuple[int, int] = (40, 48),
    duration: int = 400_000,
) -> tuple[ColourScene, Simulation]:
    """A camera that pans over rectangles of many colours, and what a sensor with or without a mosaic records of it."""
    painted = np.stack([blocks(0.02, high, seed=seed) for seed in range(3)], axis=-1).astype(np.float32)
    scene = colour_photograph(painted, pan(60.0, 20.0), sensor_size=size, duration=duration)
    return scene, simulate_colour(scene, sensor or SensorSettings(), mosaic=mosaic)


def unlabelled(simulation: Simulation) -> Recording:
    """The simulated recording without its contrast thresholds."""
    return Recording.from_arrays(
        simulation.events, simulation.frames, sensor_size=simulation.scene.sensor_size, name="unlabelled"
    )


def sky(brightest: float) -> np.ndarray:
    """Dark and bright surfaces with texture, a third of it a sky without any, at ``brightest``."""
    rng = np.random.default_rng(2)
    blocks = np.kron(np.exp(rng.uniform(np.log(0.05), np.log(1.0), (16, 24))), np.ones((5, 5)))
    blocks[blocks > np.quantile(blocks, 0.67)] = 1.0
    return brightest * blocks


def textured(brightest: float) -> np.ndarray:
    """Small surfaces of different brightness up to ``brightest``, white = 1."""
    rng = np.random.default_rng(3)
    return brightest * np.kron(np.exp(rng.uniform(np.log(0.05), 0.0, (20, 30))), np.ones((4, 4)))


def passing_by(picture: np.ndarray, cut: int = 255, **sensor) -> Recording:
    """A picture that moves by, recorded with thresholds of 0.2 by a camera whose frames end at ``cut``."""
    scene = photograph_scene(picture, pan(60.0), sensor_size=(48, 64), duration=500_000)
    made = simulate(
        scene, SensorSettings(threshold_on=0.2, threshold_off=0.2, exposure=2_000, **sensor), seed=1
    ).recording()
    frames = [dataclasses.replace(frame, image=np.minimum(frame.image, cut)) for frame in made.frames()]
    return Recording.from_arrays(
        np.concatenate(list(made.events())), frames, sensor_size=made.sensor_size, name="cut"
    )


def damaged(source: Recording) -> Recording:
    """The recording with a frame that is the one before once more, a step of the gain, and a stuck pixel."""
    frames = list(source.frames())
    frames[3] = dataclasses.replace(frames[3], image=frames[2].image)
    row, column = (side // 2 for side in source.sensor_size)
    half = len(frames) // 2
    for index, frame in enumerate(frames):
        image = np.rint(frame.image * (1.0 if index < half else 0.5)).astype(np.uint8)
        image[row, column] = 0
        frames[index] = dataclasses.replace(frame, image=image)
    return Recording.from_arrays(
        np.concatenate(list(source.events())), frames, sensor_size=source.sensor_size, name="damaged"
    )


def lifted(source: Recording, black: int, *, stated: bool = False) -> Recording:
    """The recording of a camera that reads ``black`` of 255 in the dark, and may state it."""
    frames = [
        dataclasses.replace(
            frame,
            image=np.rint(black + frame.image * ((255 - black) / 255)).astype(np.uint8),
            black=float(black) if stated else 0.0,
        )
        for frame in source.frames()
    ]
    return Recording.from_arrays(
        np.concatenate(list(source.events())), frames, sensor_size=source.sensor_size, name="lifted"
    )


def from_black(noise_rate: float = 0.0) -> Recording:
    """A scene from black, over half of it, to white."""
    return passing_by(np.maximum(textured(1.3) - 0.25, 0), noise_rate=noise_rate)


def printed_on_threads(code: str, *arguments: object) -> set[str]:
    """What a program prints where BLAS has one thread and where it has two."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return {
        subprocess.check_output(command, env={**os.environ, "OPENBLAS_NUM_THREADS": threads}, text=True)
        for threads in ("1", "2")
    }


def unmeasured(mask) -> Unmeasured:
    return Unmeasured(np.flatnonzero(mask), mask.shape)


def unshown(pixels, excess, noise=0.0, doubt=0.0, shape=(1, 10)):
    """Pixels that no frame has shown, of which their surroundings alone make ``excess`` expected (K15)."""
    parts = part_grid(shape)
    nothing = [np.zeros(parts) for _ in range(4)]
    expected = np.full(len(pixels), excess, np.float32)
    memory = UnshownMemory(
        pixels=np.array(pixels),
        bound=np.zeros(len(pixels), np.float32),
        shape=shape,
        excess=expected,
        limited=expected,
        expected=expected,
        doubt=9 * expected**2,
        revealed=Revealed(*nothing[:3], 0.0, 0.0),
        texture=Texture(*nothing),
        hardness=np.ones(parts),
        near=0,
        clipped=len(pixels),
        times=1.0,
    )
    planes = (np.full(len(pixels), value, np.float32) for value in (noise, doubt))
    return Unshown(memory.pixels, expected, *planes, memory)


def busy(where, frames=12):
    """Events of the pixels of a mask, between any two frames."""
    y, x = np.nonzero(where)
    t = np.arange(frames).repeat(len(x)) * 40_000 + 20_000
    return make_events(t, np.tile(x, frames), np.tile(y, frames), np.ones(len(t), np.int64))
