"""Decoding rates of the readers, in million events per second of processor time.

    python benchmarks/readers.py RECORDING ...

Each recording is read whole, in chunks that are counted and dropped, as often as fits into about two seconds, at least
three times; the best is shown. Compiled loops are loaded before. ``memory`` is the largest that the process has held
since it was started, so list large recordings first to see theirs.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

from kalux import readers
from kalux.readers import Source


def seconds(source: Source) -> float:
    start = time.process_time()
    for _ in source.events():
        pass
    return time.process_time() - start


def best_seconds(source: Source, budget: float = 2.0, least: int = 3) -> float:
    seconds(source)
    taken: list[float] = []
    while len(taken) < least or sum(taken) < budget:
        taken.append(seconds(source))
    return min(taken)


def size(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*")) if path.is_dir() else path.stat().st_size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", nargs="+", metavar="RECORDING")
    print("| recording | format | size, MB | million events | million events/s | memory, MB |")
    print("| --- | --- | ---: | ---: | ---: | ---: |")
    for name in parser.parse_args().recordings:
        source = readers.read(name)
        count = source.count_events() / 1e6
        taken = best_seconds(source)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(
            f"| {source.path.name} | {source.format} | {size(source.path) / 1e6:.1f} | {count:.2f} | "
            f"{count / taken:.0f} | {memory:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
