"""A small recording, and the same seen backward in time."""

from __future__ import annotations

import numpy as np

from kalux import Frame, Recording
from kalux.events import make_events

SIZE = (6, 8)


def recording(seed=0, threshold=(0.2, 0.25), span=200_000, events=600):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, span, events))
    array = make_events(
        t, rng.integers(0, SIZE[1], events), rng.integers(0, SIZE[0], events), rng.random(events) < 0.5
    )
    starts = [0, 41_000, 80_001, 120_000, 163_000]
    frames = [
        Frame(rng.integers(0, 256, SIZE).astype(np.uint8), s, s + exposure)
        for s, exposure in zip(starts, (9_001, 5_000, 9_000, 20_000, 9_000), strict=True)
    ]
    return Recording.from_arrays(array, frames, sensor_size=SIZE, contrast_threshold=threshold)


def mirrored(source):
    """The recording seen backward, made without the code under test."""
    events = np.concatenate(list(source.events()))[::-1]
    on, off = source.contrast_threshold
    return Recording.from_arrays(
        make_events(-events["t"], events["x"], events["y"], ~events["p"]),
        [Frame(f.image, -f.exposure_end, -f.exposure_start) for f in list(source.frames())[::-1]],
        sensor_size=SIZE,
        contrast_threshold=(off, on),
    )
