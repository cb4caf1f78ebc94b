"""Pixels of a recording under auto-exposure that see no events: images of a still scene at several exposure times."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.errors import InputError
from kalux.event_slices import between
from kalux.events import EventArray
from kalux.frames import Frame
from kalux.recording import Recording
from kalux.wording import how_many

ImageArray = NDArray[Any]

_STILL_PIXELS: Final = 2_000
_MOST_FRAMES: Final = 400


def still_pixels(recording: Recording) -> tuple[list[ImageArray], list[float]]:
    """Pixels of one recording under auto-exposure that see no events, as images at several exposure times.

    Looks for the longest run of frames that keeps enough valid pixels (2000) without an event in their 3x3
    neighbourhood, and takes one frame for each exposure time in it, in steps of at least 10 %. Where frames state a
    gain, their exposure times are multiplied by it.

    Returns
    -------
    (1, N) uint8 images, and exposure times, s.

    Raises
    ------
    InputError
        If no run has three exposure times, e.g. because the exposure is fixed.
    """
    frames = list(islice(recording.frames(), _MOST_FRAMES))
    best: tuple[list[Frame], NDArray[np.bool_]] | None = None
    for run, still in _still_runs(recording, frames):
        chosen = _distinct(run)
        if best is None or len(chosen) > len(best[0]):
            best = chosen, still
    if best is None or len(best[0]) < 3:
        found = 0 if best is None else len(best[0])
        raise InputError(
            f"{recording.source.path}: still pixels are seen at {how_many(found, 'exposure time')}, three are needed; "
            "record a still scene while the exposure changes, or give images at several exposures"
        )
    images = [
        np.rint(255 * frame.normalised()[best[1]]).clip(0, 255).astype(np.uint8)[None] for frame in best[0]
    ]
    return images, [frame.amplified_exposure * 1e-6 for frame in best[0]]


def _still_runs(recording: Recording, frames: list[Frame]) -> Iterator[tuple[list[Frame], NDArray[np.bool_]]]:
    """Runs of frames, from each that follows a run's end, with the pixels that stay still in them."""
    kernel = np.ones((3, 3), np.uint8)
    chunks = iter(recording.events())
    pending: list[EventArray] = []
    run: list[Frame] = []
    moved = np.zeros(recording.sensor_size, np.uint8)
    for frame in frames:
        seen = np.zeros(recording.sensor_size, np.uint8)
        while not pending or pending[-1]["t"][-1] <= frame.exposure_end:
            chunk = next(chunks, None)
            if chunk is None:
                break
            pending.append(chunk)
        start = run[-1].exposure_end if run else frame.exposure_start
        for chunk in pending:
            inside = between(chunk, start - 1, frame.exposure_end)
            seen[inside["y"], inside["x"]] = 1
        pending = [chunk for chunk in pending if chunk["t"][-1] > frame.exposure_end]
        hidden = np.zeros_like(moved) if frame.valid is None else (~frame.valid).view(np.uint8)
        after = np.maximum(np.maximum(moved, hidden), cv2.dilate(seen, kernel))
        if run and np.count_nonzero(after == 0) < _STILL_PIXELS:
            yield run, moved == 0
            run, after = [], hidden
        run.append(frame)
        moved = after
    if run:
        yield run, moved == 0


def _distinct(run: list[Frame]) -> list[Frame]:
    """One frame per exposure time, in steps of at least 10 %."""
    chosen: list[Frame] = []
    for frame in sorted(run, key=lambda f: f.amplified_exposure):
        if not chosen or frame.amplified_exposure >= 1.1 * chosen[-1].amplified_exposure:
            chosen.append(frame)
    return chosen
