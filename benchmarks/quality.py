"""Tables of reconstruction quality: HDR ground truth, and held-out frames of real recordings.

    python benchmarks/quality.py RECORDING ... [--ablation]
    python benchmarks/quality.py slider_depth --exposure 10000 --held-out

What `kalux evaluate` does, for the methods and the ablation of docs/tuning.md. A recording with ground truth (a
``.mat`` with a ``*_gt.npz`` beside it, or a kalux HDF5 with truth) is scored against it: MSE x 100, SSIM (Wang et al.;
data range: the largest radiance), log-MSE x 100 (of log(I + 0.02)). Of any other every second frame is dropped, and
the mean of five reads across the exposure of each dropped frame is compared with it, both scaled so that the 99.5th
percentile of all frames is 1, nothing clipped.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path

import kalux
from kalux.evaluation.baselines import filter_method, methods
from kalux.evaluation.held_out import evaluate_held_out, hold_out_frames
from kalux.evaluation.method import Method
from kalux.evaluation.scores import Scores
from kalux.evaluation.truth import evaluate_truth, load_truth, prepare_reference
from kalux.settings import PRESETS, Settings

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
            ("deblur variance 0", "events", {"deblur_variance": 0.0}),
            ("deblur variance 0.2", "events", {"deblur_variance": 0.2}),
            ("clipped from 0.98", "camera", {"saturation": 0.98}),
            ("no highlight prior", "filter", {"highlight_scale": 0.0}),
            ("no far highlights", "events", {"extrapolation_trust": 0.0}),
            ("unshown at their bounds", "filter", {"unshown_tail": 0.0}),
            ("no noise probability", "events", {"noise_rate": 0.0}),
            ("no threshold per pixel", "events", {"threshold_spread": 0.0}),
            ("no delay", "events", {"delay": 0}),
            ("no slope", "events", {"quantisation_variance": 0.0}),
            ("no trail", "events", {"trail": 0.0}),
            ("dark steps alike", "events", {"dark_steps": "none"}),
            ("no lag", "events", {"lag_variance": 0.0}),
            ("dark shares even", "filter", {"dark_shares": "even"}),
            ("no motion", "filter", {"motion": "off"}),
            ("no neighbours", "filter", {"neighbours": 0.0}),
            ("neighbours 0.15", "filter", {"neighbours": 0.15}),
            ("neighbours 0.6", "filter", {"neighbours": 0.6}),
            ("highlight scale 1", "filter", {"highlight_scale": 1.0}),
            ("highlight scale 3", "filter", {"highlight_scale": 3.0}),
            ("step variance 0.05", "events", {"step_variance": 0.05}),
            ("step variance 0.2", "events", {"step_variance": 0.2}),
            ("step variance 0.8", "events", {"step_variance": 0.8}),
            ("I_0 = 0.004", "camera", {"log_offset": 0.004}),
            ("I_0 = 0.03", "camera", {"log_offset": 0.03}),
            ("I_0 = 0.1", "camera", {"log_offset": 0.1}),
            ("frame noise / 3", "camera", {"frame_noise": 0.002}),
            ("frame noise x 3", "camera", {"frame_noise": 0.018}),
        ):
            part = dataclasses.replace(getattr(default, group), **change)
            chosen[f"default, {label}"] = dataclasses.replace(default, **{group: part})
    return chosen


def compared(ablation: bool, held_out: bool) -> list[Method]:
    names = ("hold", "mean") if held_out else ("hold",)
    simple = [methods()[name] for name in names]
    return simple + [
        filter_method(name, settings, smooth=name == SMOOTHED)
        for name, settings in variants(ablation).items()
    ]


def protocol(
    path: Path, recording: kalux.Recording, held_out: bool
) -> tuple[str, Callable[[Method], Scores]]:
    """What the recording is compared with, and how to score a method by it."""
    beside = path.with_name(path.stem + "_gt.npz")
    truth, mask = load_truth(beside) if beside.exists() else (recording.ground_truth(), None)
    if truth is None or held_out:
        held = hold_out_frames(recording)
        return held.described(), lambda method: evaluate_held_out(held, method)
    reference = prepare_reference(recording, truth, mask)
    return reference.described(), lambda method: evaluate_truth(recording, reference, method)


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
        described, score = protocol(path, recording, arguments.held_out)
        print(f"\n{path.name}: {described}")
        print(f"{'method':34} {'MSE x100':>9} {'SSIM':>6} {'log-MSE x100':>13} {'s':>6}")
        for method in compared(arguments.ablation, described.startswith("held-out")):
            start = time.perf_counter()
            found = score(method)
            seconds = time.perf_counter() - start
            similarity = math.nan if found.ssim is None else found.ssim
            print(
                f"{method.label:34} {100 * found.mse:9.3f} {similarity:6.3f} {100 * found.log_mse:13.2f} "
                f"{seconds:6.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
