"""Memory that reading takes, of files of 2 GB of every format that can be made here.

    python benchmarks/memory.py [--megabytes 2000] [--formats kalux aedat4 ...] [--folder /tmp]

One file after the other is written, by kalux or by the writers of the tests, with events at random places (and, where
the format has them here, frames), and read whole, with all checks, by a process of its own. Shown are the largest
memory that this process held, by the kernel's count, and events per second of its processor time. The exit status is
1 where ``--limit`` MB (1500) are exceeded or events are lost. Each file is removed before the next is written.
Linux only.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
for folder in (ROOT / "tests", ROOT / "tests" / "readers"):
    sys.path.insert(0, str(folder))

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from kalux.events import EVENT_DTYPE, EventArray  # noqa: E402
from kalux.frames import Frame  # noqa: E402

SIZE = (260, 346)
BLOCK = 1 << 18
SPAN = 1_000_000  # us, of a block
ADDRESS_SPACE = 8 << 30  # stops a reader that takes the machine's memory


def block() -> EventArray:
    """Events of one second."""
    rng = np.random.default_rng(0)
    events = np.zeros(BLOCK, EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(0, SPAN, BLOCK))
    events["x"], events["y"] = rng.integers(0, SIZE[1], BLOCK), rng.integers(0, SIZE[0], BLOCK)
    events["p"] = rng.integers(0, 2, BLOCK)
    return events


def blocks(count: int) -> Iterator[EventArray]:
    """Events of so many seconds."""
    first = block()
    for index in range(count):
        later = first.copy()
        later["t"] += index * SPAN
        yield later


def frames(count: int) -> Iterator[Frame]:
    """Two per second."""
    image = np.random.default_rng(1).integers(0, 256, SIZE, np.uint8)
    for index in range(2 * count):
        start = index * SPAN // 2
        yield Frame(np.roll(image, index), start, start + 5_000)


# Writers: each writes ``count`` blocks


def write_kalux(path: Path, count: int) -> None:
    from kalux.writers import hdf5

    hdf5.write(path, sensor_size=SIZE, events=blocks(count), frames=frames(count))


def write_aedat4(path: Path, count: int) -> None:
    from kalux.writers import aedat4

    aedat4.write(path, sensor_size=SIZE, events=blocks(count), frames=frames(count))


def _text(path: Path, count: int, header: str, line: Callable[[EventArray], list[str]]) -> None:
    """``@@@@`` in the lines of a block stands for the second."""
    body = "".join(line(block())).encode()
    with path.open("wb") as file:
        file.write(header.encode())
        for index in range(count):
            file.write(body.replace(b"@@@@", b"%d" % (1000 + index)))


def write_ijrr(path: Path, count: int) -> None:
    path.mkdir()
    _text(
        path / "events.txt",
        count,
        f"{SIZE[1]} {SIZE[0]}\n",
        lambda events: [f"@@@@.{t:06d} {x} {y} {int(p)}\n" for t, x, y, p in events.tolist()],
    )


def write_table(path: Path, count: int) -> None:
    _text(
        path,
        count,
        "t_us,x,y,p\n",
        lambda events: [f"@@@@{t:06d},{x},{y},{int(p)}\n" for t, x, y, p in events.tolist()],
    )


def write_npy(path: Path, count: int) -> None:
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(
            file,
            {
                "descr": np.lib.format.dtype_to_descr(EVENT_DTYPE),
                "fortran_order": False,
                "shape": (count * BLOCK,),
            },
        )
        for events in blocks(count):
            file.write(events.tobytes())


def write_npz(path: Path, count: int) -> None:
    first = block()
    times = (first["t"][None] + SPAN * np.arange(count)[:, None]).ravel()
    columns = {name: np.tile(first[name], count) for name in "xyp"}
    np.savez(path, t_us=times, **columns, height=SIZE[0], width=SIZE[1])


def _repeated(path: Path, header: bytes, body: bytes, count: int) -> None:
    with path.open("wb") as file:
        file.write(header)
        for _ in range(count):
            file.write(body)


def _evt3_block() -> NDArray[np.uint16]:
    """A block over the whole range of the encoding's times, 2^24 us, which then wrap around."""
    import test_prophesee

    events = block()
    events["t"] *= 16
    words: NDArray[np.uint16] = test_prophesee.evt3_words(events)
    return words


def write_evt3(path: Path, count: int) -> None:
    header = f"% evt 3.0\n% geometry {SIZE[1]}x{SIZE[0]}\n".encode()
    _repeated(path, header, _evt3_block().tobytes(), count)


def write_dat(path: Path, count: int) -> None:
    import test_prophesee

    with path.open("wb") as file:
        file.write(f"% Version 2\n% Width {SIZE[1]}\n% Height {SIZE[0]}\n".encode() + bytes([12, 8]))
        for events in blocks(count):
            file.write(test_prophesee.dat_words(events).tobytes())


def write_es(path: Path, count: int) -> None:
    import test_es

    whole = test_es.encoded(block(), SIZE)
    _repeated(path, whole[:20], whole[20:], count)  # times are differences


def write_bag(path: Path, count: int) -> None:
    import test_rosbag

    def messages() -> Iterator[tuple[int, str, str, bytes]]:
        for events in blocks(count):
            for part in np.array_split(events, 30):
                data = test_rosbag.packed_event_array(part, SIZE)
                at = test_rosbag.EPOCH + 1000 * int(part["t"][-1])
                yield at, "/dvs/events", "dvs_msgs/msg/EventArray", data

    test_rosbag.write_bag1(path, messages())


def write_packets(name: str) -> Callable[[Path, int], None]:
    """ROS 2, with the words of `write_evt3` in messages of some hundred events."""

    def write(path: Path, count: int) -> None:
        import test_rosbag

        words = _evt3_block()

        def messages() -> Iterator[tuple[int, str, str, bytes]]:
            for index in range(count):
                for number, part in enumerate(np.array_split(words, 400)):
                    ns = test_rosbag.EPOCH + ((index << 24) + (number << 24) // 400) * 1000
                    data = test_rosbag.event_packet("evt3", part.tobytes(), ns, 0, True, SIZE)
                    yield ns, "/camera/events", "event_camera_msgs/msg/EventPacket", data

        getattr(test_rosbag, f"write_{name}")(path, messages())

    return write


def write_aedat2(path: Path, count: int) -> None:
    import test_aedat2

    with path.open("wb") as file:
        file.write(test_aedat2.header("eu.seebetter.ini.chips.davis.DAVIS346B"))
        for events in blocks(count):
            file.write(test_aedat2.event_words(events, SIZE).tobytes())


def write_aedat3(path: Path, count: int) -> None:
    import test_aedat3

    with path.open("wb") as file:
        file.write(test_aedat3.header(sensor="DAVIS346B"))
        for events in blocks(count):
            for part in np.array_split(events, 50):
                file.write(test_aedat3.polarity(part, overflow=int(part["t"][0]) >> 31))


def write_hdf5_of(name: str) -> Callable[[Path, int], None]:
    """Layouts whose writers take all events at once."""

    def write(path: Path, count: int) -> None:
        import test_hdf5_layouts

        events = np.concatenate(list(blocks(count)))
        getattr(test_hdf5_layouts, f"write_{name}")(path, events, list(frames(count)), SIZE)

    return write


WRITERS: dict[str, tuple[str, float, Callable[[Path, int], None]]] = {
    # name of the file, bytes of an event (with its share of the frames), writer
    "kalux": ("r.h5", 4.1, write_kalux),
    "aedat4": ("r.aedat4", 9.6, write_aedat4),
    "ijrr": ("r", 21.5, write_ijrr),
    "table": ("r.csv", 20.6, write_table),
    "npy": ("r.npy", 16, write_npy),
    "npz": ("r.npz", 13, write_npz),
    "evt3": ("r.raw", 6, write_evt3),
    "dat": ("r.dat", 8, write_dat),
    "es": ("r.es", 5, write_es),
    "bag": ("r.bag", 13, write_bag),
    "mcap": ("r.mcap", 6, write_packets("mcap")),
    "db3": ("r_db3", 6, write_packets("db3")),
    "aedat2": ("r.aedat", 8, write_aedat2),
    "aedat3": ("r3.aedat", 8, write_aedat3),
    "hqf": ("r.hdf5", 20.5, write_hdf5_of("hqf")),
}


def read(path: Path) -> None:
    """Read all of a recording; print what it took as JSON."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    import kalux

    start = time.process_time()
    recording = kalux.open(path)
    events = sum(len(chunk) for chunk in recording.events())
    images = sum(1 for _ in recording.stamped_frames())
    seconds = time.process_time() - start
    # Not ru_maxrss: that begins with what the parent held.
    status = Path("/proc/self/status").read_text()
    peak = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1024
    print(json.dumps({"events": events, "frames": images, "seconds": seconds, "peak_mb": peak}))


def size(path: Path) -> int:
    """Bytes of a file or folder."""
    return sum(file.stat().st_size for file in (path.rglob("*") if path.is_dir() else [path]))


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--megabytes", type=float, default=2000, help="of each file (2000)")
    parser.add_argument("--formats", nargs="+", choices=list(WRITERS), default=list(WRITERS), metavar="NAME")
    parser.add_argument("--folder", type=Path, help="where the files are written; default: the system's")
    parser.add_argument("--limit", type=float, default=1500, help="MB (1500)")
    parser.add_argument("--read", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.read is not None:
        read(options.read)
        return 0
    print("| format | size, MB | million events | frames | memory, MB | million events/s |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |", flush=True)
    failed = False
    for name in options.formats:
        file_name, event_bytes, write = WRITERS[name]
        count = max(int(options.megabytes * 1e6 / event_bytes / BLOCK), 1)
        with tempfile.TemporaryDirectory(prefix="kalux-memory-", dir=options.folder) as folder:
            path = Path(folder) / file_name
            write(path, count)
            megabytes = size(path) / 1e6
            done = subprocess.run(
                [sys.executable, __file__, "--read", str(path)], capture_output=True, text=True, check=False
            )
            shutil.rmtree(folder)
            Path(folder).mkdir()
        if done.returncode != 0:
            failed = True
            print(f"| {name} | {megabytes:.0f} | failed: {done.stderr.strip()[-300:]} | | | |", flush=True)
            continue
        found = json.loads(done.stdout)
        failed |= found["peak_mb"] > options.limit or found["events"] != count * BLOCK
        print(
            f"| {name} | {megabytes:.0f} | {found['events'] / 1e6:.0f} of {count * BLOCK / 1e6:.0f} | "
            f"{found['frames']} | {found['peak_mb']:.0f} | {found['events'] / found['seconds'] / 1e6:.0f} |",
            flush=True,
        )
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
