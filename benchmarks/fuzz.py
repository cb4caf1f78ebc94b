"""Fuzzing of the readers: recordings with changed bytes must be read and checked, or refused with one clear line.

    python benchmarks/fuzz.py [--seconds 600] [--readers aedat4 ros ...] [--keep FOLDER]

For every reader, real files of ../shared/data (where they are) and small files by the writers of the tests are cut,
overwritten, and have blocks moved, removed and repeated, at random but reproducibly (``--seed``). Each changed
recording is read whole in a process of its own, which may take ``--limit`` seconds and ``--memory`` MB more than the
empty process. Allowed is a recording that passes all checks, or a `kalux.errors.KaluxError` on one line. Anything
else, a crash, another error, a hang, too much memory, is kept under ``--keep`` and listed, and the exit status is 1.
Linux only.
"""

from __future__ import annotations

import argparse
import faulthandler
import os
import random
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared" / "data"
LARGEST_SEED = 7_000_000  # bytes; larger real files are cut there: the rest is more of the same
ADDRESS_SPACE = 16 << 30  # more than any reader reserves, less than would disturb others

for folder in (ROOT / "tests", ROOT / "tests" / "readers"):
    sys.path.insert(0, str(folder))

import numpy as np  # noqa: E402

from kalux import readers  # noqa: E402
from kalux.errors import KaluxError  # noqa: E402
from kalux.recording import Recording  # noqa: E402


class Seed(NamedTuple):
    """A recording to change: a file, or a folder of which one file is changed."""

    reader: str
    path: Path

    @property
    def files(self) -> list[Path]:
        """The files that may be changed."""
        return sorted(p for p in self.path.rglob("*") if p.is_file()) if self.path.is_dir() else [self.path]


class Outcome(NamedTuple):
    """What became of one changed recording; ``failure`` is empty where that is allowed."""

    read: bool
    failure: str


# Seeds


def real_seeds(folder: Path) -> Iterator[Seed]:
    """Real recordings, cut where they are large; cut text and packets are changed files, too."""
    for name, path in (
        ("aedat4", "street_davis346.aedat4"),
        ("aedat4", "formats/dvxplorer.aedat4"),
        ("aedat4", "formats/test_data_gray16.aedat4"),
        ("aedat2", "formats/davis240_dvs_imu.aedat"),
        ("mat", "hdr_pan/Oxford_Church_noisy.mat"),
        ("raw", "formats/evt2.raw"),
        ("raw", "formats/evt3_small.raw"),
        ("dat", "formats/gen4.dat"),
        ("ros", "formats/event_packet_ros1.bag"),
        ("ros", "formats/event_packet_ros2_db3"),
        ("ros", "formats/event_packet_ros2_mcap"),
    ):
        source = SHARED / path
        if not source.exists():
            continue
        copy = folder / source.name
        if source.is_dir():
            shutil.copytree(source, copy, copy_function=shutil.copyfile)
            copy.chmod(0o755)
        else:
            copy.write_bytes(source.read_bytes()[:LARGEST_SEED])
        yield Seed(name, copy)


def built_seeds(folder: Path) -> Iterator[Seed]:
    """Small files by the writers of the tests, of every format."""
    import test_aedat2
    import test_aedat3
    import test_aedat4
    import test_es
    import test_evreal
    import test_hdf5_layouts
    import test_ijrr
    import test_mat
    import test_npz_folder
    import test_prophesee
    import test_rosbag
    import test_table

    from recordings import SIZE, colour_frames, small_events, small_frames, write_kalux

    events, frames = small_events(), small_frames()

    def put(reader: str, name: str, write: Callable[[Path], object]) -> Seed:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path)
        return Seed(reader, path)

    for compression in (0, 1, 3):
        data = test_aedat4.small_file(compression=compression)
        yield put("aedat4", f"compression{compression}.aedat4", lambda p, d=data: p.write_bytes(d))
    coloured = [(1, test_aedat4.colour_packet(frame, 16)) for frame in colour_frames()]
    data = test_aedat4.aedat4_file(coloured, camera="DAVIS346_1")
    yield put("aedat4", "colour.aedat4", lambda p, d=data: p.write_bytes(d))
    data = test_aedat4.jaer_file(test_aedat4.jaer_frames())
    yield put("aedat4", "jaer.aedat4", lambda p, d=data: p.write_bytes(d))
    words = test_aedat2.in_time(
        test_aedat2.event_words(test_aedat2.small_events()),
        *(test_aedat2.samples(frame) for frame in test_aedat2.frames_of(2)),
    )
    yield put("aedat2", "davis.aedat", lambda p: p.write_bytes(test_aedat2.header() + words.tobytes()))
    packets = [test_aedat3.polarity(part) for part in np.array_split(events, 5)]
    packets += [test_aedat3.frame(frame) for frame in test_aedat3.wide(frames)]
    yield put("aedat3", "caer.aedat", lambda p: p.write_bytes(test_aedat3.header() + b"".join(packets)))
    yield put("kalux", "kalux.h5", write_kalux)
    for name, save in (
        ("5", test_mat.save_5),
        ("5_plain", test_mat.save_5_plain),
        ("73", test_mat.save_73),
    ):
        yield put("mat", f"{name}.mat", lambda p, s=save: s(p, test_mat.variables()))
    for kind, encode in test_prophesee.WORDS.items():
        data = test_prophesee.prophesee_file(kind, encode(events))
        reader = "dat" if kind == "DAT" else "raw"
        yield put(reader, f"{kind}.{reader}", lambda p, d=data: p.write_bytes(d))
    for name, write, cdr in (
        ("plain.bag", test_rosbag.write_bag1, False),
        ("folder_db3", test_rosbag.write_db3, True),
        ("plain.mcap", test_rosbag.write_mcap, True),
    ):
        messages = test_rosbag.davis_messages(cdr)
        yield put("ros", name, lambda p, w=write, m=messages: w(p, m))
    yield put("dsec", "dsec", lambda p: test_hdf5_layouts.write_dsec_folder(p, events, frames, SIZE))
    for name, write in (
        ("hqf", test_hdf5_layouts.write_hqf),
        ("mvsec", test_hdf5_layouts.write_mvsec),
        ("v2e", test_hdf5_layouts.write_v2e),
        ("metavision", test_hdf5_layouts.write_metavision),
        ("hdf5", test_hdf5_layouts.write_plain),
        ("hdf5", test_hdf5_layouts.write_plain_table),
    ):
        yield put(name, f"{write.__name__}.h5", lambda p, w=write: w(p, events, frames, SIZE))
    yield put("es", "stream.es", lambda p: p.write_bytes(test_es.encoded(events, SIZE, resets=7)))
    columns = {name: events[name] for name in "xyp"} | {"t_us": events["t"]}
    yield put("numpy", "packed.npz", lambda p: np.savez_compressed(p, **columns))
    yield put("numpy", "plain.npz", lambda p: np.savez(p, **columns, height=SIZE[0], width=SIZE[1]))
    yield put("numpy", "plain.npy", lambda p: np.save(p, events))
    for name, write in test_npz_folder.WRITERS.items():
        yield put("npz-folder", name, lambda p, w=write: w(p, events, frames))
    yield put("evreal", "evreal", lambda p: test_evreal.write_evreal(p, events, frames))
    ijrr = put("ijrr", "ijrr", test_ijrr.write_folder)
    yield ijrr
    yield put("ijrr", "ijrr.zip", lambda p: test_ijrr.zipped(ijrr.path, p))
    yield put("table", "events.csv", lambda p: p.write_text(test_table.written()))
    yield put("table", "events.txt", lambda p: p.write_text(test_table.written("# t x y p", separator=" ")))
    lines = [f"{t / 1e6:.6f} {x} {y} {int(p)}\n" for t, x, y, p in events.tolist()]
    yield put("table", "sized.txt", lambda p: p.write_text(f"{SIZE[1]} {SIZE[0]}\n{''.join(lines)}"))
    rows = [f"{x},{y},{int(p)},{t}\n" for t, x, y, p in events.tolist()]
    yield put(
        "table", "geometry.csv", lambda p: p.write_text(f"%geometry:{SIZE[1]},{SIZE[0]}\n{''.join(rows)}")
    )


# Changes


def changed(data: bytes, rng: random.Random) -> bytes:
    """One to four changes, half of them near the beginning, where the structure is."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        if out:
            rng.choice(_CHANGES)(out, rng)
    return bytes(out)


def _place(data: bytearray, rng: random.Random) -> int:
    near = min(len(data), rng.choice((64, 512, 4096)))
    return rng.randrange(near if rng.random() < 0.5 else len(data))


def _length(data: bytearray, rng: random.Random) -> int:
    return rng.randint(1, max(1, min(len(data), rng.choice((4, 64, 1024, 65536)))))


def _cut(data: bytearray, rng: random.Random) -> None:
    del data[_place(data, rng) :]


def _flip(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.choice((1, 1, 3, 16))):
        data[_place(data, rng)] ^= 1 << rng.randrange(8)


def _overwrite(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.choice((1, 2, 8))):
        data[_place(data, rng)] = rng.randrange(256)


_NUMBERS = (
    0,
    1,
    -1,
    2,
    127,
    128,
    255,
    256,
    0x7FFF,
    0x8000,
    0xFFFF,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFF,
    1 << 62,
)


def _number(data: bytearray, rng: random.Random) -> None:
    """An integer at the edge of its range, of 2, 4 or 8 bytes."""
    size = rng.choice((2, 4, 8))
    place = _place(data, rng)
    value = (rng.choice(_NUMBERS) & ((1 << 8 * size) - 1)).to_bytes(size, rng.choice(("little", "big")))
    data[place : place + size] = value[: len(data) - place]


def _remove(data: bytearray, rng: random.Random) -> None:
    place = _place(data, rng)
    del data[place : place + _length(data, rng)]


def _repeat(data: bytearray, rng: random.Random) -> None:
    place = _place(data, rng)
    data[place:place] = data[place : place + _length(data, rng)]


def _move(data: bytearray, rng: random.Random) -> None:
    """Bytes from one place over those of another."""
    source, target, size = _place(data, rng), _place(data, rng), _length(data, rng)
    piece = data[source : source + size]
    data[target : target + len(piece)] = piece


def _blank(data: bytearray, rng: random.Random) -> None:
    place = _place(data, rng)
    size = min(_length(data, rng), len(data) - place)
    data[place : place + size] = bytes([rng.choice((0, 255, 32, 48))]) * size


_CHANGES = (_cut, _flip, _flip, _overwrite, _overwrite, _number, _number, _remove, _repeat, _move, _blank)


def write_changed(seed: Seed, rng: random.Random, folder: Path) -> Path:
    """The recording with one of its files changed, under the name of the seed."""
    target = folder / seed.path.name
    file = rng.choice(seed.files)
    if seed.path.is_dir():
        for other in seed.files:
            copy = target / other.relative_to(seed.path)
            copy.parent.mkdir(parents=True, exist_ok=True)
            if other != file:
                os.link(other, copy)
        (target / file.relative_to(seed.path)).write_bytes(changed(file.read_bytes(), rng))
    else:
        target.write_bytes(changed(file.read_bytes(), rng))
    return target


# Attempts


def read_all(path: Path) -> bool:
    """Read and check all of a recording; whether kalux took it."""
    try:
        recording = Recording(readers.read(path))
        for _ in recording.events():
            pass
        for _ in recording.stamped_frames():
            pass
        recording.ground_truth()
        for _ in recording.source.triggers() if recording.source.triggers is not None else ():
            pass
    except KaluxError as error:
        if "\n" in str(error) or str(path) not in str(error) or len(str(error)) > 600 + len(str(path)):
            raise AssertionError(f"the message is not one line about the file: {error}") from error
        return False
    return True


_READ, _REFUSED, _FAILED = 0, 3, 4


def attempt(path: Path, limit: float, memory_mb: int, log: Path) -> Outcome:
    """Read in a process of its own."""
    receive, send = os.pipe()
    child = os.fork()
    if child == 0:
        status = _FAILED
        try:
            # What it begins with: less than its parent has, since pages of files are not passed on.
            os.write(send, Path("/proc/self/statm").read_text().split()[1].encode())
            resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(descriptor, 1)
            os.dup2(descriptor, 2)
            faulthandler.enable(file=2)
            status = _READ if read_all(path) else _REFUSED
        except BaseException as error:
            in_one_line = f"{type(error).__name__}: {' '.join(str(error).split())}"
            os.write(2, f"{traceback.format_exc()}\n{in_one_line}\n".encode(errors="replace"))
        finally:
            os._exit(status)
    os.close(send)
    watch = os.pidfd_open(child)
    try:
        finished = bool(select.select([watch], [], [], limit)[0])
    finally:
        os.close(watch)
    if not finished:
        os.kill(child, signal.SIGKILL)
    _, status, usage = os.wait4(child, 0)
    begun_mb = int(os.read(receive, 32) or b"0") * resource.getpagesize() / (1 << 20)
    os.close(receive)
    held_mb = usage.ru_maxrss / 1024 - begun_mb
    if not finished:
        return Outcome(False, f"not done after {limit:g} s")
    if os.WIFSIGNALED(status):
        return Outcome(False, f"crash: {signal.Signals(os.WTERMSIG(status)).name}")
    if held_mb > memory_mb:
        return Outcome(False, f"memory: {held_mb:.0f} MB")
    if os.WEXITSTATUS(status) not in (_READ, _REFUSED):
        lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
        return Outcome(False, lines[-1][:200] if lines else f"exit status {os.WEXITSTATUS(status)}")
    return Outcome(os.WEXITSTATUS(status) == _READ, "")


def fuzz(name: str, seeds: list[Seed], options: argparse.Namespace, work: Path) -> int:
    """Change and read recordings of one format for a while; the number of failures."""
    for seed in seeds:  # compiled loops and imports are loaded before the processes divide
        read_all(seed.path)
    counts: Counter[str] = Counter()
    failures: Counter[str] = Counter()
    end, number = time.monotonic() + options.seconds, 0
    longest = 0.0
    while time.monotonic() < end:
        number += 1
        rng = random.Random(f"{options.seed} {name} {number}")
        folder = work / "attempt"
        folder.mkdir()
        seed = rng.choice(seeds)
        path = write_changed(seed, rng, folder)
        start = time.monotonic()
        outcome = attempt(path, options.limit, options.memory, work / "log")
        longest = max(longest, time.monotonic() - start)
        counts["read" if outcome.read else "failed" if outcome.failure else "refused"] += 1
        if outcome.failure:
            failures[outcome.failure] += 1
            if failures[outcome.failure] <= 3:
                kept = options.keep / name / f"{options.seed}-{number}"
                shutil.rmtree(kept, ignore_errors=True)
                shutil.copytree(folder, kept)
                shutil.copyfile(work / "log", kept / "log.txt")
                print(f"{name}: {outcome.failure}: {kept}", file=sys.stderr, flush=True)
        shutil.rmtree(folder)
    print(
        f"| {name} | {len(seeds)} | {number} | {counts['read']} | {counts['refused']} | {counts['failed']} | "
        f"{longest:.1f} |",
        flush=True,
    )
    return counts["failed"]


def main() -> int:
    """Run from the command line."""
    names = [reader.name for reader in readers.READERS]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600, help="for each reader (600)")
    parser.add_argument("--readers", nargs="+", choices=names, default=names, metavar="NAME")
    parser.add_argument("--limit", type=float, default=20, help="seconds for one recording (20)")
    parser.add_argument("--memory", type=int, default=1500, help="MB for one recording (1500)")
    parser.add_argument("--seed", type=int, default=0, help="of the changes (0)")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-failures"), help="where failures are kept")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    failed = 0
    with tempfile.TemporaryDirectory(prefix="kalux-fuzz-") as name:
        work = Path(name)
        (work / "built").mkdir()
        (work / "real").mkdir()
        seeds = [*built_seeds(work / "built"), *real_seeds(work / "real")]
        print("| reader | files | changed | read | refused | failed | longest, s |")
        print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |", flush=True)
        for reader in options.readers:
            failed += fuzz(reader, [seed for seed in seeds if seed.reader == reader], options, work)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
