"""Pictures of what each setting does, for docs/tuning.md.

    python benchmarks/pictures.py [--data ../shared/data] [--output docs/images] [--only neighbours ...]

Each picture shows one place of one recording: the truth or the frame that was held out, the default, and the default
with one setting changed. The place is where the images differ most, of all moments that are compared, so that a
difference looks larger than it would elsewhere. All parts of a picture have one tone curve, that of the reference.
The recordings are those of the tables of docs/tuning.md, and for lost events the scene of `kalux demo`, whose pixels
are blind for 2 ms after an event.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

import kalux
from kalux.datasets import DEMO_SENSOR, demo_scene, simulate
from kalux.display import DisplaySettings, Reinhard, apply, measure, to_uint8
from kalux.evaluation.baselines import filter_method
from kalux.evaluation.held_out import held_out_pairs, hold_out_frames
from kalux.evaluation.method import Method
from kalux.evaluation.pairs import Pair
from kalux.evaluation.truth import load_truth, prepare_reference, truth_pairs
from kalux.settings import PRESETS
from kalux.writers import contact_sheet

DEFAULT = PRESETS["default"]
DISPLAY = DisplaySettings(Reinhard())
WINDOW = (72, 96)
"""Height and width of the place that is shown."""

LOG_OFFSET = 0.03
"""Where images differ most is told by log(I + this): white is 1."""

MOMENTS = 24
"""At most so many of the moments that can be compared, evenly spread."""

RECORDINGS = {
    "clean": "hdr_pan/Oxford_Church_clean.mat",
    "blur": "hdr_pan/Oxford_Church_blur.mat",
    "noisy": "hdr_pan/Oxford_Church_noisy.mat",
    "slider_depth": "slider_depth",
    "newton": "newton_davis346.aedat4",
    "street": "street_davis346.aedat4",
}
BLIND = "blind for 2 ms"


class Change(NamedTuple):
    """What is changed of the default, as tables of settings, or both ways in time instead of forward."""

    label: str
    settings: dict[str, dict[str, Any]]
    both_ways: bool = False


def one(key: str, *values: float | bool) -> tuple[Change, ...]:
    """One setting, at each of some values."""
    group, name = key.split(".")
    return tuple(Change(f"{name} {value:g}", {group: {name: value}}) for value in values)


PICTURES = {
    "smooth": ("clean", (Change("both ways", {}, True),)),
    "deblur": ("blur", (Change("not deblurred", {"filter": {"deblur": False}}),)),
    "highlight-scale": ("clean", one("filter.highlight_scale", 0, 3)),
    "highlight-tail": ("street", one("filter.highlight_tail", 0.5, 10)),
    "unshown-tail": ("noisy", one("filter.unshown_tail", 0, 1)),
    "motion": ("slider_depth", (Change("not along the paths", {"filter": {"motion": "off"}}),)),
    "neighbours": ("noisy", one("filter.neighbours", 0, 0.6)),
    "step-variance": ("noisy", one("events.step_variance", 0.02, 2)),
    "noise-rate": ("noisy", one("events.noise_rate", 0, 30)),
    "threshold-spread": ("noisy", one("events.threshold_spread", 0, 0.3)),
    "quantisation-variance": ("slider_depth", one("events.quantisation_variance", 0)),
    "delay": ("newton", one("events.delay", 0)),
    "trail": ("newton", one("events.trail", 0)),
    "refractory-period": (BLIND, one("events.refractory_period", 0)),
    "log-offset": ("newton", one("camera.log_offset", 0.004, 0.1)),
    "frame-noise": ("slider_depth", one("camera.frame_noise", 0.018)),
}
"""Recording, and changes, of every picture."""


class Source(NamedTuple):
    """A recording, and what its images are compared with."""

    name: str
    data: Path

    def pairs(self, method: Method) -> Iterator[Pair]:
        if self.name == BLIND:
            sensor = dataclasses.replace(DEMO_SENSOR, refractory=2000.0)
            recording = simulate(demo_scene(), sensor).recording()
            truth, mask = recording.ground_truth(), None
        else:
            path = self.data / RECORDINGS[self.name]
            recording = kalux.open(path)
            if not recording.exposure_known:
                recording = kalux.open(path, exposure=10_000)
            beside = path.with_name(path.stem + "_gt.npz")
            truth, mask = load_truth(beside) if beside.exists() else (None, None)
        if truth is None:
            return held_out_pairs(hold_out_frames(recording), method)
        return truth_pairs(recording, prepare_reference(recording, truth, mask), method)


@cache
def references(source: Source) -> list[Pair]:
    """The default's images with those that they are compared with."""
    return spread(list(source.pairs(filter_method("default", DEFAULT))))


def spread(pairs: list[Pair]) -> list[Pair]:
    """Some of them, evenly."""
    return pairs[:: -(-len(pairs) // MOMENTS)]


def changed(source: Source, change: Change) -> list[Pair]:
    """The same with a change."""
    parts = {
        group: dataclasses.replace(getattr(DEFAULT, group), **values)
        for group, values in change.settings.items()
    }
    method = filter_method(change.label, dataclasses.replace(DEFAULT, **parts), smooth=change.both_ways)
    return spread(list(source.pairs(method)))


def place(images: list[list[NDArray[Any]]]) -> tuple[int, int, int]:
    """Number of the moment, row and column of the window in which images, by change and moment, differ most."""
    height, width = WINDOW
    best, found = -1.0, (0, 0, 0)
    for moment, shown in enumerate(zip(*images, strict=True)):
        logs = np.log(np.maximum(np.stack(shown), 0.0) + LOG_OFFSET)
        mean = cv2.blur(np.var(logs, axis=0), (width, height))
        inner = mean[height // 2 : -(height // 2), width // 2 : -(width // 2)]
        row, column = np.unravel_index(np.argmax(inner), inner.shape)
        if inner[row, column] > best:
            best, found = float(inner[row, column]), (moment, int(row), int(column))
    return found


def sheet(source: Source, changes: tuple[Change, ...]) -> NDArray[np.uint8]:
    """The picture, RGB but grey."""
    default = references(source)
    others = [changed(source, change) for change in changes]
    shown = [[pair.test for pair in pairs] for pairs in (default, *others)]
    moment, row, column = place(shown)
    reference = default[moment].reference.astype(np.float32)
    statistics = measure(reference, DISPLAY.curve)
    there = slice(row, row + WINDOW[0]), slice(column, column + WINDOW[1])
    simulated = default[moment].clipped is None
    images = [reference, *(pairs[moment] for pairs in shown)]
    labels = ["truth" if simulated else "held-out frame", "default", *(change.label for change in changes)]
    return contact_sheet(
        [
            (label, to_uint8(apply(np.asarray(image[there], np.float32), DISPLAY, statistics)))
            for label, image in zip(labels, images, strict=True)
        ],
        smallest_height=WINDOW[0] * 3,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--output", type=Path, default=Path("docs/images"))
    parser.add_argument("--only", nargs="*", choices=list(PICTURES), help="some pictures (default: all)")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    for name in arguments.only or PICTURES:
        recording, changes = PICTURES[name]
        path = arguments.output / f"tuning-{name}.png"
        grey = sheet(Source(recording, arguments.data), changes)[..., 0]
        cv2.imwrite(str(path), grey, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        print(path, flush=True)


if __name__ == "__main__":
    main()
