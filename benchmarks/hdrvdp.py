"""Time of HDR-VDP per pair, in seconds of processor time.

    OMP_NUM_THREADS=1 python benchmarks/hdrvdp.py [HEIGHT WIDTH] [--pairs N]

Pairs are a smooth scene over three decades of luminance with multiplicative noise; all pixels differ, the slowest case.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy import ndimage

from kalux.evaluation import hdrvdp


def pair(height, width, seed):
    rng = np.random.default_rng(seed)
    scene = ndimage.gaussian_filter(rng.normal(size=(height, width)), 8)
    reference = 10 ** (1.5 + scene / scene.std() / 2)
    return reference * np.exp(rng.normal(0, 0.2, reference.shape)), reference


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "size", type=int, nargs="*", default=[480, 640], metavar="SIZE", help="height and width"
    )
    parser.add_argument("--pairs", type=int, default=10)
    options = parser.parse_args()
    height, width = options.size

    hdrvdp(*pair(height, width, 0))  # compiles, and fills the caches of filters
    times = []
    for seed in range(options.pairs):
        images = pair(height, width, seed)
        start = time.process_time()
        hdrvdp(*images)
        times.append(time.process_time() - start)
    print(f"{width} x {height}: median {np.median(times):.3f} s, slowest {max(times):.3f} s per pair")


if __name__ == "__main__":
    main()
