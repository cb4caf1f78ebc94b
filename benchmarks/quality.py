"""Tables of reconstruction quality: HDR ground truth, and held-out frames of real recordings.

    python benchmarks/quality.py RECORDING ... [--methods hold cf iccv2021 default] [--ablation]
    python benchmarks/quality.py slider_depth --exposure 10000 --held-out

A recording with ground truth (a ``.mat`` with a ``*_gt.npz`` beside it, or a kalux HDF5 with truth) is scored against
it: MSE x 100, SSIM (Wang et al.; data range: the largest radiance), log-MSE x 100 (of log(I + 0.02)). Of any other
every second frame is
dropped, and the mean of five reads across the exposure of each dropped frame is compared with it, both scaled so
that the 99.5th percentile of all frames is 1, nothing clipped.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

import numpy as np
from skimage.metrics import structural_similarity

import kalux
from kalux.settings import PRESETS, Settings

LOG_OFFSET = 0.02


def ssim(a, b, data_range):
    return structural_similarity(
        a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=data_range
    )


def scores(estimate, truth, data_range):
    estimate, truth = estimate.astype(np.float64), truth.astype(np.float64)
    mse = np.mean((estimate - truth) ** 2)
    log = np.mean((np.log(np.maximum(estimate, 0) + LOG_OFFSET) - np.log(truth + LOG_OFFSET)) ** 2)
    structure = np.mean([ssim(a, b, data_range) for a, b in zip(estimate, truth, strict=True)])
    return 100 * mse, structure, 100 * log


SMOOTHED = "default, both ways"


def variants(ablation: bool) -> dict[str, Settings]:
    chosen = {name: PRESETS[name] for name in ("cf", "iccv2021")}
    exact = dataclasses.replace(PRESETS["iccv2021"].filter, solution="exact")
    chosen["iccv2021, exact"] = dataclasses.replace(PRESETS["iccv2021"], filter=exact)
    default = PRESETS["default"]
    chosen["default"] = chosen[SMOOTHED] = default
    if ablation:
        for label, group, change in (
            ("no deblurring", "filter", {"deblur": False}),
            ("no highlight prior", "filter", {"highlight_scale": 0.0}),
            ("no noise probability", "events", {"noise_rate": 0.0}),
            ("no threshold per pixel", "events", {"threshold_spread": 0.0}),
            ("no slope", "events", {"quantisation_variance": 0.0}),
            ("step variance / 4", "events", {"step_variance": 0.05}),
            ("step variance x 4", "events", {"step_variance": 0.8}),
            ("I_0 = 0.01", "camera", {"log_offset": 0.01}),
            ("I_0 = 0.1", "camera", {"log_offset": 0.1}),
            ("frame noise / 3", "camera", {"frame_noise": 0.002}),
            ("frame noise x 3", "camera", {"frame_noise": 0.018}),
        ):
            part = dataclasses.replace(getattr(default, group), **change)
            chosen[f"default, {label}"] = dataclasses.replace(default, **{group: part})
    return chosen


def truth_of(path: Path, recording):
    beside = path.with_name(path.stem + "_gt.npz")
    if beside.exists():
        data = np.load(beside)
        return data["times_us"].astype(np.int64), data["gt"].astype(np.float32)
    found = recording.ground_truth()
    return None if found is None else (found.times, found.images)


def ascending(recording, times, settings, smooth):
    """Images at times in any order."""
    order = np.argsort(times, kind="stable")
    out = None
    images = kalux.reconstruct(recording, times=np.asarray(times)[order], settings=settings, smooth=smooth)
    for index, image in zip(order, images, strict=True):
        out = np.empty((len(times), *image.intensity.shape), np.float32) if out is None else out
        out[index] = image.intensity
    return out


def with_truth(recording, times, truth, chosen):
    frames = list(recording.frames())
    reference = float(np.median([frame.exposure for frame in frames]))
    middles = np.array([frame.middle for frame in frames])
    index = np.maximum(np.searchsorted(middles, times, side="right") - 1, 0)
    held = np.stack([frames[i].normalised() * reference / frames[i].exposure for i in index])
    top = float(truth.max())
    yield "hold the last frame", scores(held, truth, top)
    for name, settings in chosen.items():
        yield name, scores(ascending(recording, times, settings, name == SMOOTHED), truth, top)


def held_out(recording, chosen):
    frames = list(recording.frames())
    events = np.concatenate(list(recording.events()))
    kept = kalux.Recording.from_arrays(
        events,
        frames[::2],
        sensor_size=recording.sensor_size,
        contrast_threshold=recording.contrast_threshold,
    )
    dropped = np.arange(3, len(frames) - 3, 2)
    values = np.stack([frame.normalised() for frame in frames])
    scale = np.percentile(values, 99.5)
    truth = values[dropped] / scale
    yield "hold the last frame", scores(values[dropped - 1] / scale, truth, 1.0)
    yield (
        "mean of the neighbours",
        scores((values[dropped - 1] + values[dropped + 1]) / 2 / scale, truth, 1.0),
    )
    fractions = np.linspace(0, 1, 5)
    times = np.concatenate(
        [(frames[i].exposure_start + fractions * frames[i].exposure).astype(np.int64) for i in dropped]
    )
    for name, settings in chosen.items():
        images = ascending(kept, times, settings, name == SMOOTHED)
        mean = images.reshape(len(dropped), len(fractions), *recording.sensor_size).mean(axis=1)
        yield name, scores(mean / scale, truth, 1.0)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--exposure", type=int, help="us, for recordings that do not store it")
    parser.add_argument(
        "--held-out", action="store_true", help="drop frames even where there is ground truth"
    )
    parser.add_argument(
        "--ablation", action="store_true", help="the default with each part off or changed in turn"
    )
    arguments = parser.parse_args()
    for path in arguments.recordings:
        recording = kalux.open(path)
        if not recording.exposure_known:
            recording = kalux.open(path, exposure=arguments.exposure)
        truth = None if arguments.held_out else truth_of(path, recording)
        chosen = variants(arguments.ablation)
        rows = held_out(recording, chosen) if truth is None else with_truth(recording, *truth, chosen)
        print(f"\n{path.name}: {'held-out frames' if truth is None else 'ground truth'}")
        print(f"{'method':34} {'MSE x100':>9} {'SSIM':>6} {'log-MSE x100':>13} {'s':>6}")
        start = time.perf_counter()
        for name, (mse, structure, log) in rows:
            seconds, start = time.perf_counter() - start, time.perf_counter()
            print(f"{name:34} {mse:9.3f} {structure:6.3f} {log:13.2f} {seconds:6.1f}", flush=True)


if __name__ == "__main__":
    main()
