"""Loops of a reconstruction run once on a scene that is made up, so that they are compiled and kept.

`kalux.cli.loops` starts ``python -m kalux.cli.rehearsal PART`` beside a command that has to compile: what that would
come to later is then ready. Nothing is written but numba's cache, and no result depends on it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Final

import numpy as np

from kalux.augmentation.highlights import Unshown
from kalux.cli.loops import prepare_loops
from kalux.display import Auto, DisplaySettings, fill_levels, measure, quantised
from kalux.events import EVENT_DTYPE
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
    """From L to an intensity, and on to the levels of a video and to a PNG."""
    level = np.random.default_rng(0).normal(-1.0, 1.0, _SIZE).astype(np.float32)
    some, ones = np.arange(100), np.ones(100, np.float32)
    estimate = Estimate(
        0,
        level,
        np.abs(level),
        white=0.0,
        final=True,
        moving=level > 0.0,
        silent_change=np.abs(level),
        unshown=Unshown(some, ones, ones, ones),
        unmeasured=some,
    )
    view = View(0.02, 0.04, 0.1, 1.0, 0.3, 1.0, 0.0, None, (1.0, 1.0, 1.0))
    intensity = make_image(estimate, view, with_variance=False).intensity
    display = DisplaySettings(Auto())
    statistics = measure(intensity, display.curve)
    fill_levels(intensity, display, statistics, (16.0, 235.0), np.empty(_SIZE, np.uint8))
    png_bytes(quantised(intensity, display, statistics, np.uint16))


PARTS: Final[dict[str, Callable[[], None]]] = {"images": rehearse_images, "filter": rehearse_filter}
"""What can be compiled by itself, in about the same time each; the estimates before them take as long again."""

if __name__ == "__main__":
    prepare_loops()
    for name in sys.argv[1:]:
        PARTS[name]()
