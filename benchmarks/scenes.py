"""Many scenes at random: where is the default filter worse than something simpler, or its variance wrong?

    python benchmarks/scenes.py PHOTOGRAPH ... -o OUT [--count 200] [--seed 1] [--processes N]
        [--size 160x120] [--duration 1.2] [--truth-rate HZ]

Simulates recordings of 160x120 pixels and 1.2 s, or others, over HDR photographs: sensors, thresholds, noise, motions,
exposures, responses and things that pass are drawn by ``--seed``, so that the same command makes the same recordings
(`kalux simulate`).
Then it scores them against their truth (`kalux benchmark`, whose report lies in OUT/results) and prints a summary, and
what stands out, with the flags that make it again. What is drawn goes farther than most cameras do: settings that are
estimated from a recording show here where they fail. 200 scenes take an hour or two of one core. An interrupted run
goes on where it was.
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kalux.wording import how_many

METHODS = ("hold", "edi", "iccv2021", "default", "smooth")
MOTIONS = (
    "pan",
    "pan+handheld",
    "rotate+shake",
    "dolly+handheld",
    "shake",
    "handheld",
    "pan+rotate",
    "pan+dolly",
)


class Scene(NamedTuple):
    """A recording to simulate: its name, the photograph, and the flags of ``kalux simulate``."""

    name: str
    photograph: Path
    flags: tuple[str, ...]


def draw(
    photographs: list[Path],
    count: int,
    seed: int,
    size: str = "160x120",
    duration: float = 1.2,
    truth_rate: float | None = None,
) -> list[Scene]:
    """The scenes, photographs in turns. The first of many are those of few."""
    truth = () if truth_rate is None else ("--truth-rate", str(truth_rate))
    scenes = []
    for k in range(count):
        photograph = photographs[k % len(photographs)]
        flags = tuple(map(str, _flags(random.Random(1000 * seed + k), k, size, duration)))
        scenes.append(Scene(f"{k:03d}_{photograph.stem}", photograph, flags + truth))
    return scenes


def _flags(rng: random.Random, k: int, size: str, duration: float) -> Iterable[object]:
    preset = rng.choice(["ideal", "ideal", "davis240c", "davis346", "prophesee-vga"])
    motion = rng.choice(MOTIONS)
    yield from ("--preset", preset, "--motion", motion, "--seed", k, "--size", size, "--duration", duration)
    if "pan" in motion:
        yield from ("--speed", rng.choice([20, 60, 120, 250]), "--direction", rng.choice([0, 30, 90, 135]))
    if "rotate" in motion:
        yield from ("--turn", rng.choice([20, 60]))
    if preset == "ideal":
        threshold = rng.choice([0.1, 0.15, 0.2, 0.3])
        off = rng.choice([threshold, threshold, round(1.3 * threshold, 3)])
        yield from ("--sensor.threshold-on", threshold, "--sensor.threshold-off", off)
        yield from ("--sensor.noise-rate", rng.choice([0, 0.5, 2, 5]))
        yield from ("--sensor.threshold-mismatch", rng.choice([0, 0.05, 0.1]))
        yield from ("--sensor.refractory", rng.choice([0, 0, 300, 1000]))
        yield from ("--sensor.read-noise", rng.choice([0, 0.003, 0.01]))
    yield from ("--frame-rate", rng.choice([10, 20, 30, 40]))
    if rng.random() < 0.25:
        yield from ("--auto-exposure", rng.choice([0.2, 0.35]), "--exposure", 8000)
    else:
        yield from ("--exposure", rng.choice([2000, 8000, 20000]))
    for share, *flags in (
        (0.3, "--foreground", "ball", "--foreground-speed", [60, 200, 500]),
        (0.15, "--sensor.response", ["srgb", "gamma:2.2"]),
        (0.2, "--sensor.bits", [10, 12]),
        (0.25, "--saturate", [0.02, 0.3]),
        (0.2, "--sensor.hot-pixels", [0.002]),
    ):
        if rng.random() < share:
            yield from (rng.choice(flag) if isinstance(flag, list) else flag for flag in flags)


def claim(folder: Path, scenes: list[Scene]) -> None:
    """Note in a folder which scenes it holds, or end where it holds others: recordings that are there are kept."""
    listed = folder / "scenes.txt"
    drawn = [f"{scene.photograph} {' '.join(scene.flags)}" for scene in scenes]
    before = listed.read_text().splitlines() if listed.exists() else []
    if before[: len(drawn)] != drawn[: len(before)]:
        raise SystemExit(f"{folder}: has other scenes; choose another folder")
    folder.mkdir(parents=True, exist_ok=True)
    listed.write_text("\n".join(max(before, drawn, key=len)) + "\n")


def simulate(scene: Scene, folder: Path) -> None:
    """Simulate a scene, unless it is there."""
    made = folder / f"{scene.name}.h5"
    if made.exists():
        return
    command = [sys.executable, "-m", "kalux", "simulate", str(scene.photograph), "-o", str(made), "--quiet"]
    done = subprocess.run([*command, *scene.flags], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{scene.name}: {done.stderr.strip()}")


def scores_of(table: Path) -> dict[str, dict[str, dict[str, float]]]:
    """Scores by scene, method and metric, from ``results.csv``."""
    found: dict[str, dict[str, dict[str, float]]] = defaultdict(lambda: defaultdict(dict))
    with table.open() as rows:
        for row in csv.DictReader(rows):
            found[row["sequence"]][row["method"]][row["metric"]] = float(row["value"])
    return found


def oddities(scores: dict[str, dict[str, float]]) -> list[str]:
    """What should not be, of one scene."""
    hold, default, smooth = (scores[name] for name in ("hold", "default", "smooth"))
    checks = (
        ("MSE above that of the last frame", default["mse"] > hold["mse"]),
        ("SSIM below that of the last frame", default["ssim"] < hold["ssim"]),
        ("MSE above EDI's", default["mse"] > scores["edi"]["mse"]),
        ("log-MSE above half of iccv2021's", default["log_mse"] > scores["iccv2021"]["log_mse"] / 2),
        ("both ways worse than forward", smooth["mse"] > 1.05 * default["mse"]),
        ("rms z", not all(0.8 <= one["rms_z"] <= 1.2 for one in (default, smooth))),
    )
    return [text for text, wrong in checks if wrong]


def summary(scores: dict[str, dict[str, dict[str, float]]]) -> str:
    """Over all scenes: means of errors relative to those of the last frame, and of how right the variance is."""
    lines = [
        f"{how_many(len(scores), 'scene')}: MSE of that of the last frame, log-MSE of that of iccv2021, rms z"
    ]
    for name, title in (("default", "forward"), ("smooth", "both ways")):
        of_hold, of_paper, z = np.array(
            [
                (
                    one[name]["mse"] / one["hold"]["mse"],
                    one[name]["log_mse"] / one["iccv2021"]["log_mse"],
                    one[name]["rms_z"],
                )
                for one in scores.values()
            ]
        ).T
        lines.append(
            f"{title:10} mean {of_hold.mean():.3f}, median {np.median(of_hold):.3f}; at most {of_paper.max():.2f}; "
            f"median {np.median(z):.2f}, within 0.8 to 1.2 in {np.mean((z >= 0.8) & (z <= 1.2)):.0%}, "
            f"root mean square of its logarithm {np.sqrt(np.mean(np.log(z) ** 2)):.3f}"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photographs", nargs="+", type=Path, metavar="PHOTOGRAPH", help=".hdr or .exr")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for recordings and results")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--size", default="160x120", metavar="WxH", help="pixels of the sensor")
    parser.add_argument("--duration", type=float, default=1.2, help="s")
    parser.add_argument(
        "--truth-rate",
        type=float,
        metavar="HZ",
        help="true images at this rate, at any time between frames, instead of at frames and half-way",
    )
    options = parser.parse_args()
    drawn = options.count, options.seed, options.size, options.duration, options.truth_rate
    scenes = draw(options.photographs, *drawn)
    recordings, results = options.out / "recordings", options.out / "results"
    claim(options.out, scenes)
    recordings.mkdir(exist_ok=True)
    with ThreadPoolExecutor(options.processes) as pool:
        for k, _ in enumerate(pool.map(lambda scene: simulate(scene, recordings), scenes), 1):
            print(f"\rsimulated {k}/{len(scenes)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    made = [str(recordings / f"{scene.name}.h5") for scene in scenes]
    command = [sys.executable, "-m", "kalux", "benchmark", *made, "-o", str(results)]
    command += ["--methods", ",".join(METHODS), "--processes", str(options.processes)]
    done = subprocess.run(command, stdout=subprocess.DEVNULL)
    if done.returncode:
        raise SystemExit("kalux benchmark failed; the same command goes on where it was")
    scores = scores_of(results / "results.csv")
    print(summary(scores))
    for scene in scenes:
        found = oddities(scores[scene.name])
        if found:
            default, smooth, hold = (scores[scene.name][name] for name in ("default", "smooth", "hold"))
            print(
                f"{scene.name}: {', '.join(found)}; of the last frame's MSE {default['mse'] / hold['mse']:.3f}, "
                f"{smooth['mse'] / hold['mse']:.3f}, rms z {default['rms_z']:.2f}, {smooth['rms_z']:.2f}\n"
                f"    {' '.join(scene.flags)}"
            )


if __name__ == "__main__":
    main()
