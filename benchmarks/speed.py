"""How fast: events per second of CPU time, per preset, sensor and output rate, and as a ratio to a plain loop.

    python benchmarks/speed.py [--events 10000000]

The stream is synthetic: an edge 40 columns wide that sweeps over the sensor, with frames at 25 Hz whose exposures are
10 ms. "memory only" is the rate of a compiled loop that only stores each event's time at its pixel, in the same run.
"""

from __future__ import annotations

import argparse
import time

import numba as nb
import numpy as np

import kalux
from kalux.events import EVENT_DTYPE

SENSORS = {"DAVIS346": (260, 346), "VGA": (480, 640)}


def stream(size, count, seconds=2.0, seed=0):
    height, width = size
    rng = np.random.default_rng(seed)
    events = np.zeros(count, EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(0, int(seconds * 1e6), count))
    events["x"] = (events["t"] // 100 % width + rng.integers(0, 40, count)) % width
    events["y"] = rng.integers(0, height, count)
    events["p"] = rng.random(count) < 0.5
    frames = [
        kalux.Frame(rng.integers(0, 256, size).astype(np.uint8), start, start + 10_000)
        for start in range(0, int(seconds * 1e6), 40_000)
    ]
    return kalux.Recording.from_arrays(events, frames, sensor_size=size, contrast_threshold=0.2), events


@nb.njit
def store(t, x, y, newest):
    for i in range(len(t)):
        newest[y[i], x[i]] = t[i]


def cpu_seconds(function, repeats=3):
    """Best of several, after one to warm up."""
    function()
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        function()
        best = min(best, time.process_time() - start)
    return best


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--events", type=int, default=10_000_000)
    count = parser.parse_args().events
    print(f"{'sensor':10} {'what':28} {'million events/s':>17} {'of memory only':>15}")
    for name, size in SENSORS.items():
        recording, events = stream(size, count)
        columns = [np.ascontiguousarray(events[field]) for field in "txy"]
        memory = count / cpu_seconds(lambda c=columns, s=size: store(*c, np.zeros(s, np.int64))) / 1e6
        print(f"{name:10} {'memory only':28} {memory:17.1f} {'100 %':>15}")
        for preset in ("default", "iccv2021", "cf"):
            settings = kalux.preset(preset)
            settings = kalux.settings.from_dict({"events": {"delay": 0}}, settings)
            for label, wanted in (("at the frames", {"at": "frames"}), ("300 images/s", {"rate_hz": 300})):

                def work(wanted=wanted, recording=recording, settings=settings):
                    for _ in kalux.reconstruct(recording, settings=settings, **wanted):
                        pass

                rate = count / cpu_seconds(work, repeats=2) / 1e6
                print(
                    f"{name:10} {f'{preset}, {label}':28} {rate:17.1f} {100 * rate / memory:13.1f} %",
                    flush=True,
                )


if __name__ == "__main__":
    main()
