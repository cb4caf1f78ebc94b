"""The whole way, from a file of events and frames to a file of images: faster than real time or not?

    python benchmarks/pipeline.py [--seconds 4] [--rate 300] [--threads 1 2] [--only 346x260 mp4 ...]

Writes synthetic recordings (the stream of benchmarks/speed.py) as kalux HDF5, and runs ``kalux reconstruct`` on them
in a process of its own, as a user would: start-up, checking, choosing settings and all. The settings that it would
otherwise estimate are given, ``--estimate`` leaves them to it. Shown are seconds on the clock and of all processor
cores per second of recording (below 1 on the clock is faster than real time), those on the clock of the part that
makes and writes images, and the largest memory held. Where other work runs, the processor time tells more: two cores
cannot need less of the clock than half of it.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import time
from pathlib import Path

import kalux

SENSORS = {"346x260": ((260, 346), 5_000_000), "640x480": ((480, 640), 15_000_000)}
"""Height and width, and events per second."""

OUTPUTS = {
    "mp4": ("out.mp4",),
    "png": ("out", "--format", "png"),
    "exr": ("out", "--format", "exr"),
    "npy": ("out", "--format", "npy"),
}
GIVEN = (
    "--events.delay",
    "0",
    "--camera.log-offset",
    "0.05",
    "--events.step-variance",
    "0.2",
    "--events.refractory-period",
    "0",
)


def write_recording(path, size, rate, seconds):
    """A recording of the sweeping edge; returns the number of its events."""
    from kalux.readers import hdf5

    from speed import EXPOSURE, FRAME, THRESHOLD, picture, stream

    length = 1 << 22
    piece = stream(size, length, rate=rate)
    span = int(piece["t"][-1])
    end = int(1e6 * seconds)

    def events():
        for start in range(0, end, span):
            moved = piece.copy()
            moved["t"] += start
            yield moved[moved["t"] < end]

    pictures = [picture(size, k) for k in range(4)]
    frames = [
        kalux.Frame(pictures[k % 4], FRAME * k, FRAME * k + EXPOSURE)
        for k in range((end - EXPOSURE) // FRAME + 1)
    ]
    hdf5.write(
        path,
        sensor_size=size,
        events=events(),
        frames=frames,
        contrast_threshold=(THRESHOLD, THRESHOLD),
    )
    return kalux.open(path).source.count_events()


def run(arguments):
    """``kalux`` in a process of its own: seconds on the clock, of the processor, in its last step, and megabytes."""
    with tempfile.TemporaryFile("w+") as output, open(os.devnull, "w") as nothing:
        actions = [(os.POSIX_SPAWN_DUP2, file.fileno(), k) for k, file in ((1, output), (2, nothing))]
        start = time.perf_counter()
        command = [sys.executable, "-m", "kalux", *map(str, arguments)]
        _, status, used = os.wait4(
            os.posix_spawn(sys.executable, command, os.environ, file_actions=actions), 0
        )
        wall = time.perf_counter() - start
        output.seek(0)
        text = output.read()
    if status:
        sys.exit(f"kalux failed: {arguments}")
    written = float(re.search(r"in ([\d.]+) s", text.splitlines()[-1]).group(1))
    return wall, used.ru_utime + used.ru_stime, written, used.ru_maxrss / 1024


def apart(function, *arguments):
    """Call a function in another process: the memory of this one, which those it starts inherit, stays small."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def encoder_seconds(size, count):
    """Processor seconds that OpenEXR alone takes for images of the recording's kind."""
    from kalux.writers.images import exr_bytes

    from speed import EXPOSURE, FRAME, THRESHOLD, picture, stream

    engine = kalux.Reconstructor(size, contrast_threshold=THRESHOLD)
    for k in range(2):
        engine.push_frame(kalux.Frame(picture(size, k), FRAME * k, FRAME * k + EXPOSURE))
    engine.push_events(stream(size, 1 << 18))
    engine.finish()
    image = engine.read(EXPOSURE + 5_000)
    start = time.process_time()
    for _ in range(10):
        exr_bytes(image)
    return (time.process_time() - start) / 10 * count


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=4.0, help="length of the recordings")
    parser.add_argument("--rate", type=int, default=300, help="images per second")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=3, help="of which the fastest counts")
    parser.add_argument("--estimate", action="store_true", help="let kalux estimate delay, offset and noise")
    parser.add_argument("--only", nargs="+", choices=[*SENSORS, *OUTPUTS], default=[])
    options = parser.parse_args()
    sensors = [name for name in SENSORS if name in options.only] or list(SENSORS)
    outputs = [name for name in OUTPUTS if name in options.only] or ["mp4", "png", "exr"]
    print(
        f"Per second of recording, {options.rate} images/s, {options.seconds:g} s long, {os.cpu_count()} cores\n"
        f"{'sensor':9}{'M ev/s':>7} {'output':8}{'threads':>7}{'clock':>8}{'CPU':>8}{'images':>8}{'MB':>7}"
    )
    with tempfile.TemporaryDirectory(prefix="kalux-speed-") as folder:
        for name in sensors:
            size, rate = SENSORS[name]
            recording = Path(folder) / f"{name}.h5"
            apart(write_recording, recording, size, rate, options.seconds)
            for kind in outputs:
                for threads in options.threads:
                    least = None
                    for _ in range(options.rounds):
                        out, *flags = OUTPUTS[kind]
                        made = Path(folder) / out
                        flags += () if options.estimate else GIVEN
                        command = ["reconstruct", recording, "-o", made, "--rate", options.rate, *flags]
                        found = run([*command, "--threads", threads])
                        shutil.rmtree(made, ignore_errors=True)
                        made.unlink(missing_ok=True)
                        Path(f"{made}.kalux.toml").unlink(missing_ok=True)
                        least = found if least is None or found < least else least
                    wall, cpu, written, memory = least
                    print(
                        f"{name:9}{rate / 1e6:7.0f} {kind:8}{threads:7}{wall / options.seconds:8.2f}"
                        f"{cpu / options.seconds:8.2f}{written / options.seconds:8.2f}{memory:7.0f}",
                        flush=True,
                    )
            if "exr" in outputs:
                print(f"{name:9}{'':7} OpenEXR alone {'':9}{apart(encoder_seconds, size, options.rate):8.2f}")


if __name__ == "__main__":
    main()
