"""The whole way, from a file of events and frames to a file of images: faster than real time or not?

    python benchmarks/pipeline.py [--seconds 4 ...] [--rate 300] [--threads 1 2] [--only 346x260 mp4 aedat4 ...]
    python benchmarks/pipeline.py --seconds 10 60 --rounds 1 --threads 2     # does memory grow with the length?
    python benchmarks/pipeline.py --stages --threads 2                       # where the processor time goes
    python benchmarks/pipeline.py --only 346x260 mp4 -- --filter.motion off  # with further flags of kalux reconstruct
    python benchmarks/pipeline.py --recording pan.h5 --only mp4 --threads 2  # one of your own instead

Writes synthetic recordings (the stream of benchmarks/speed.py) as kalux HDF5 or AEDAT4, and runs ``kalux reconstruct``
on them in a process of its own, as a user would: start-up, checking, choosing settings and all. The settings that it
would otherwise estimate are given, ``--estimate`` leaves them to it; of a recording of your own all are estimated.
Shown are seconds on the clock and of all processor cores per second of recording (below 1 on the clock is faster than
real time), those on the clock of the part that makes and writes images, and the largest memory held. Where other work
runs, the processor time tells more: two cores cannot need less of the clock than half of it. ``--stages`` shows the
processor time of each thread and step instead.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import threading
import time
from collections import Counter
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
INPUTS = ("h5", "aedat4")
GIVEN = (
    *(
        "--events.delay",
        "0",
        "--camera.log-offset",
        "0.05",
        "--events.step-variance",
        "0.2",
        "--events.extrapolation-gain",
        "1",
        "--events.extrapolation-trust",
        "1",
    ),
    *("--events.threshold-on", "0.2", "--events.threshold-off", "0.2"),
    *("--events.refractory-period", "0", "--events.threshold-spread", "0.1", "--events.noise-rate", "0.1"),
    *("--filter.unshown-scale", "1"),
)


def write_recording(path, size, rate, seconds):
    """A recording of the sweeping edge, in the format of the file's name."""
    from kalux.writers import aedat4, hdf5

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
    if path.suffix == ".aedat4":
        aedat4.write(path, sensor_size=size, events=events(), frames=frames)
    else:
        threshold = (THRESHOLD, THRESHOLD)
        hdf5.write(path, sensor_size=size, events=events(), frames=frames, contrast_threshold=threshold)


def run(arguments):
    """``kalux`` in a process of its own: seconds on the clock, of the processor, in its last step, and megabytes."""
    with tempfile.TemporaryFile("w+") as output, open(os.devnull, "w") as nothing:
        actions = [(os.POSIX_SPAWN_DUP2, file.fileno(), k) for k, file in ((1, output), (2, nothing))]
        # As users have it: Python keeps its byte code.
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        start = time.perf_counter()
        command = [sys.executable, "-m", "kalux", *map(str, arguments)]
        _, status, used = os.wait4(
            os.posix_spawn(sys.executable, command, environment, file_actions=actions), 0
        )
        wall = time.perf_counter() - start
        output.seek(0)
        text = output.read()
    if status:
        sys.exit(f"kalux failed: {arguments}")
    written = float(re.search(r"in ([\d.]+) s", text.splitlines()[-1]).group(1))
    return wall, used.ru_utime + used.ru_stime, written, used.ru_maxrss / 1024


def stages(arguments):
    """``kalux`` in this process: processor seconds of its steps before images are made, and of each thread then."""
    from kalux.cli import app, reconstruct

    used = Counter({"importing": time.process_time()})
    lock = threading.Lock()
    run_thread = threading.Thread.run

    def timed_thread(thread):
        try:
            run_thread(thread)
        finally:
            with lock:
                used[f"thread {thread.name.removeprefix('kalux-').split('_')[0]}"] += time.thread_time()

    def timed(name, function):
        def call(*given):
            start = time.thread_time()
            try:
                return function(*given)
            finally:
                used[name] += time.thread_time() - start

        return call

    threading.Thread.run = timed_thread
    for title, name in (("planning", "make_plan"), ("thread main", "write_images")):
        setattr(reconstruct, name, timed(title, getattr(reconstruct, name)))
    with contextlib.redirect_stdout(io.StringIO()):
        if app.main([str(argument) for argument in arguments]):
            sys.exit(f"kalux failed: {arguments}")
    used["libraries' threads and the rest"] = time.process_time() - sum(used.values())
    return used


def apart(function, *arguments):
    """Call a function in another process: the memory of this one, which those it starts inherit, stays small."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def encoder_seconds(size, count):
    """Processor seconds that OpenEXR's own library alone takes for images of the recording's kind."""
    import OpenEXR

    from speed import EXPOSURE, FRAME, THRESHOLD, picture, stream

    engine = kalux.Reconstructor(size, contrast_threshold=THRESHOLD)
    for k in range(2):
        engine.push_frame(kalux.Frame(picture(size, k), FRAME * k, FRAME * k + EXPOSURE))
    engine.push_events(stream(size, 1 << 18))
    engine.finish()
    image = engine.read(EXPOSURE + 5_000)
    start = time.process_time()
    for _ in range(10):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Y": image.intensity, "variance": image.variance}).write(io.BytesIO())
    return (time.process_time() - start) / 10 * count


def command_for(recording, folder, kind, options, threads):
    """The arguments of ``kalux``, and what they make."""
    out, *flags = OUTPUTS[kind]
    made = Path(folder) / out
    estimate = options.estimate or options.recording
    given = (*(() if estimate else GIVEN), *options.flags)
    arguments = ["reconstruct", recording, "-o", made, "--rate", options.rate, "--threads", threads]
    return [*arguments, *flags, *given], made


def remove(made):
    """Remove an output."""
    shutil.rmtree(made, ignore_errors=True)
    made.unlink(missing_ok=True)
    Path(f"{made}.kalux.toml").unlink(missing_ok=True)


def measure(recording, folder, kind, options, threads):
    """The fastest of several runs."""
    least = None
    for _ in range(options.rounds):
        arguments, made = command_for(recording, folder, kind, options, threads)
        found = run(arguments)
        remove(made)
        least = found if least is None or found < least else least
    return least


def measure_stages(recording, folder, kind, options, threads):
    """Of every step and thread, the least of several runs."""
    least = {}
    for _ in range(options.rounds):
        arguments, made = command_for(recording, folder, kind, options, threads)
        for name, seconds in apart(stages, arguments).items():
            least[name] = min(seconds, least.get(name, seconds))
        remove(made)
    return least


def named(size):
    """A sensor, by its height and width."""
    return f"{size[1]}x{size[0]}"


def recordings_for(options, folder):
    """What is reconstructed: height and width, format, events per second, seconds, and file, one after the other."""
    if options.recording:
        yield from map(described, options.recording)
        return
    sensors = [name for name in SENSORS if name in options.only] or list(SENSORS)
    inputs = [name for name in INPUTS if name in options.only] or ["h5"]
    for name, kind, seconds in itertools.product(sensors, inputs, options.seconds):
        size, rate = SENSORS[name]
        path = Path(folder) / f"{name}.{kind}"
        apart(write_recording, path, size, rate, seconds)
        yield size, kind, rate, seconds, path
        path.unlink()


def described(path):
    """The same of a recording that is there."""
    from kalux.info import summarise_events

    recording = kalux.open(path)
    events = summarise_events(recording.events())
    if events.mean_rate is None:
        sys.exit(f"{path}: fewer than two events, whose time could be compared")
    return recording.sensor_size, path.suffix[1:], events.mean_rate, (events.last - events.first) / 1e6, path


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, nargs="+", default=[4.0], help="lengths of the recordings")
    parser.add_argument("--rate", type=int, default=300, help="images per second")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=3, help="of which the fastest counts")
    parser.add_argument("--estimate", action="store_true", help="let kalux estimate thresholds, delay, noise")
    parser.add_argument("--stages", action="store_true", help="processor time of each step and thread")
    parser.add_argument("--only", nargs="+", choices=[*SENSORS, *OUTPUTS, *INPUTS], default=[])
    parser.add_argument(
        "--recording", type=Path, nargs="+", default=[], help="your own, instead of synthetic ones"
    )
    parser.add_argument("flags", nargs="*", help="after --: further ones of kalux reconstruct")
    options = parser.parse_args()
    outputs = [name for name in OUTPUTS if name in options.only] or ["mp4", "png", "exr"]
    print(f"Per second of recording, {options.rate} images/s, {os.cpu_count()} cores")
    titles = f"{'clock':>8}{'CPU':>8}{'images':>8}{'MB':>7}"
    print(
        f"{'sensor':9}{'M ev/s':>7} {'input':8}{'seconds':>8} {'output':8}{'threads':>7}"
        f"{'' if options.stages else titles}"
    )
    sizes = []
    with tempfile.TemporaryDirectory(prefix="kalux-speed-") as folder:
        for size, kind_in, rate, seconds, recording in recordings_for(options, folder):
            name = named(size)
            sizes.append(size)
            for kind, threads in itertools.product(outputs, options.threads):
                row = f"{name:9}{rate / 1e6:7.3g} {kind_in:8}{seconds:8.3g} {kind:8}{threads:7}"
                if options.stages:
                    print(row)
                    for step, used in measure_stages(recording, folder, kind, options, threads).items():
                        print(f"{'':9}{step:34}{used / seconds:8.2f}", flush=True)
                    continue
                wall, cpu, written, memory = measure(recording, folder, kind, options, threads)
                times = "".join(f"{value / seconds:8.2f}" for value in (wall, cpu, written))
                print(f"{row}{times}{memory:7.0f}", flush=True)
    if "exr" in outputs and not options.stages:
        for size in dict.fromkeys(sizes):
            alone = apart(encoder_seconds, size, options.rate)
            print(f"{named(size):9} OpenEXR's own library, which kalux does not write with: CPU {alone:.2f}")


if __name__ == "__main__":
    main()
