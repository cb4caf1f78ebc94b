"""Runs loops of a reconstruction once, on made-up data, so that numba compiles them and keeps them in its cache.

`kalux.cli.loops` starts ``python -m kalux.cli.rehearsal PART`` beside a command that has to compile, which then finds
the loops that it needs later in the cache. No result depends on it.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from typing import Final

import numpy as np

from kalux.augmentation.background import doubt, signal_shares
from kalux.augmentation.bridge import UNMEASURED, BridgeNoise, Latent, bridge, drift, nominal_thresholds
from kalux.augmentation.highlights import FrameHighlights, Tail, begin_unshown, expected_excess
from kalux.augmentation.motion import HalfWay, Paths
from kalux.augmentation.subthreshold import (
    add_missed_change,
    correlation,
    follow_silent,
    silent_change,
    turns,
)
from kalux.augmentation.trail import Trail, nothing_followed, signed_surety, trail_between, with_surety
from kalux.cli.loops import prepare_loops
from kalux.compiled import apart
from kalux.display import Auto, DisplaySettings, fill_levels, measure, quantised
from kalux.events import EVENT_DTYPE
from kalux.filters import akf_bridged
from kalux.filters.akf import State
from kalux.filters.common import make_clock
from kalux.filters.surfaces import Unmeasured
from kalux.frames import Frame
from kalux.images import Estimate, View, make_image
from kalux.reconstructor import Reconstructor
from kalux.settings import altered, preset
from kalux.writers.png import png_bytes

_SIZE: Final = (256, 320)
"""Four times `kalux.display.SAMPLES`, so that percentiles look at every other pixel, as of any sensor."""

_PERIOD: Final = 20_000
"""From frame to frame, us; they are exposed for half of it."""


def rehearse_filter() -> None:
    """The default filter, between frames that show white and black in some places, and noise elsewhere."""
    settings = altered(preset("default"), "events", threshold_on=0.2, threshold_off=0.2)
    engine = Reconstructor(_SIZE, settings=settings)
    random = np.random.default_rng(0)
    for number in range(6):
        start = number * _PERIOD
        pixels = random.integers(0, 256, _SIZE, np.uint8)
        pixels[:40], pixels[40:80] = 255, 0
        engine.push_frame(Frame(pixels, exposure_start=start, exposure_end=start + _PERIOD // 2))
        events = np.zeros(20_000, EVENT_DTYPE)
        events["t"] = np.sort(random.integers(start, start + _PERIOD, len(events)))
        events["y"], events["x"] = (random.integers(0, side, len(events)) for side in _SIZE)
        events["p"] = random.integers(0, 2, len(events))
        engine.push_events(events)
        if number > 1:
            estimate = engine.estimate(start - _PERIOD // 2)
            engine.forget(estimate.t)


def rehearse_images() -> None:
    """From an estimate to an image, without and with its variance."""
    level = np.random.default_rng(0).normal(-1.0, 1.0, _SIZE).astype(np.float32)
    clipped = level > 0.0
    seen = FrameHighlights(clipped, np.maximum(-level, np.float32(0.0)), ~clipped)
    bounds = Latent(level, np.where(clipped, np.float32(UNMEASURED), np.float32(0.01)))
    unshown = expected_excess(begin_unshown(bounds, seen, Tail(0.5, 0.5)), bounds.variance, UNMEASURED)
    estimate = Estimate(
        0,
        level,
        np.abs(level),
        white=0.0,
        final=True,
        moving=clipped,
        silent_change=np.abs(level),
        unshown=unshown,
        unmeasured=Unmeasured(np.arange(5000), _SIZE),
    )
    view = View(
        0.02, 0.04, 0.1, 1.0, 0.3, 1.0, 1.0, 1.0, 0.0, 0.005, None, 0.001, None, None, (1.0, 1.0, 1.0)
    )
    make_image(estimate, view, with_variance=False)
    even, known = np.zeros(_SIZE, np.float32), np.ones(_SIZE, np.float32)
    frame, aside = Latent(even, known), np.ones((2, *_SIZE), np.float32)
    paths = Paths(frame, frame, aside, HalfWay(even, known, 0.0, 0.1, 0.04, known))
    moving = dataclasses.replace(estimate, log_intensity=even, variance=known, paths=paths, share=0.5)
    make_image(moving, view)


def rehearse_display() -> None:
    """From an intensity to the levels of a video and to a PNG."""
    intensity = np.random.default_rng(0).random(_SIZE, np.float32)
    display = DisplaySettings(Auto())
    statistics = measure(intensity, display.curve)
    fill_levels(intensity, display, statistics, (16.0, 235.0), np.empty(_SIZE, np.uint8))
    png_bytes(quantised(intensity, display, statistics, np.uint16))


def rehearse_segment() -> None:
    """A segment between two frames, from the counts of its events to its last state."""
    random = np.random.default_rng(0)
    seconds, variance, change = 1e-6 * _PERIOD, 0.01, np.full(_SIZE, np.nan, np.float32)
    planes = apart(8, _SIZE)
    planes[:] = random.random(planes.shape, np.float32)
    first, second = Latent(planes[0], planes[1]), Latent(planes[2], planes[3])
    on, off, far_on, far_off = planes[4:]
    thresholds = nominal_thresholds(_SIZE, 0.1, np.float32)
    noise = BridgeNoise(0.2, 0.2, variance, variance, variance)
    signal = signal_shares(on, off, 0.1, np.zeros(_SIZE, np.bool_))
    nothing = nothing_followed(_SIZE)
    newest = with_surety(nothing, nothing, signal).events
    start, grown = trail_between(newest, newest, (0, _PERIOD), (seconds, 0.1, 0.1))
    joined, _ = bridge(first, second, (on, off), thresholds, noise, 0, _PERIOD, grown=grown, signal=signal)
    of_silent = silent_change(joined, on, variance, variance)
    correlation(change, joined, variance, variance)
    joined = follow_silent(joined, first, of_silent, variance, variance)
    drifted, _, _ = drift(first, second, thresholds, noise, (far_on, far_off), (on, off))
    add_missed_change(drifted, joined, second, (on, off), of_silent, variance)
    turns(on, off)
    trail = Trail(start, signed_surety(newest), seconds, 0.1, 0.1)
    segment = joined._replace(
        trail=trail, drift=drifted, doubt=doubt(signal, variance, variance), signal=signal
    )
    cursor = akf_bridged.begin(segment, State(first.value, first.variance, make_clock(_SIZE, 0)))
    akf_bridged.advance(segment, cursor, np.zeros(1, EVENT_DTYPE), akf_bridged.Noise(0.1, variance, variance))
    akf_bridged.moving_pixels(segment, cursor)
    akf_bridged.end(segment, cursor)


PARTS: Final[dict[str, Callable[[], None]]] = {
    "images": rehearse_images,
    "segment": rehearse_segment,
    "display": rehearse_display,
    "filter": rehearse_filter,
}
"""Parts that can be compiled by themselves: a fifth, a quarter and a fifteenth of all, and the rest of the filter, a
tenth."""

if __name__ == "__main__":
    prepare_loops()
    for name in sys.argv[1:]:
        PARTS[name]()
