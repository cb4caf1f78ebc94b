"""What the tests of readers share: a small recording, and damage to files."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from kalux import readers
from kalux.errors import KaluxError
from kalux.events import EVENT_DTYPE, make_events
from kalux.frames import Frame, GroundTruth
from kalux.readers.source import SeekableEvents
from kalux.recording import Recording
from kalux.writers import hdf5

SIZE = (30, 40)
REFERENCE = GroundTruth(
    np.array([10, 20, 30]), np.random.default_rng(0).uniform(0, 9, (3, *SIZE)).astype(np.float32)
)


def small_events(count: int = 500, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return make_events(
        np.sort(rng.integers(0, 100_000, count)),
        rng.integers(0, SIZE[1], count),
        rng.integers(0, SIZE[0], count),
        rng.integers(0, 2, count),
    )


def small_frames(count: int = 4, seed: int = 0) -> list[Frame]:
    rng = np.random.default_rng(seed)
    return [
        Frame(rng.integers(0, 256, SIZE, dtype=np.uint8), 20_000 * i, 20_000 * i + 3_000 + i)
        for i in range(count)
    ]


def colour_frames(count: int = 4, seed: int = 0, dtype: type = np.uint8) -> list[Frame]:
    """RGB, of which no two channels are alike."""
    rng = np.random.default_rng(seed)
    top = np.iinfo(dtype).max
    return [
        Frame(rng.integers(0, top, (*SIZE, 3), dtype, endpoint=True), 20_000 * i, 20_000 * i + 3_000 + i)
        for i in range(count)
    ]


def write_kalux(path: Path, **changes) -> None:
    """Of all that kalux HDF5 can hold, most."""
    found = {
        "sensor_size": SIZE,
        "events": [small_events()],
        "frames": small_frames(),
        "contrast_threshold": (0.1, 0.2),
        "inverse_covariance": np.linspace(1, 2, 256),
        "ground_truth": REFERENCE,
    }
    hdf5.write(path, **(found | changes))


def all_events(source) -> np.ndarray:
    return np.concatenate([np.empty(0, EVENT_DTYPE), *source.events()])


def same_frames(left, right) -> bool:
    return all(
        np.array_equal(a.image, b.image)
        and a.image.dtype == b.image.dtype
        and (a.exposure_start, a.exposure_end, a.white_value)
        == (b.exposure_start, b.exposure_end, b.white_value)
        for a, b in zip(left, right, strict=True)
    )


def complaint(path: Path) -> str:
    """Read all of a recording; what kalux says against it, or nothing."""
    try:
        recording = Recording(readers.read(path))
        for _ in recording.events():
            pass
        for _ in recording.events_since(50_000):
            pass
        for _ in recording.stamped_frames():
            pass
        recording.ground_truth()
    except KaluxError as error:
        return str(error)
    return ""


def damaged(data: bytes, count: int, header: int = 400) -> Iterator[bytes]:
    """Files cut short, with changes near their beginning, and with changes anywhere; the same each time."""
    for seed in range(count):
        rng = random.Random(seed)
        changed = bytearray(data)
        if seed % 3 == 0:
            yield bytes(changed[: rng.randrange(len(data))])
            continue
        end = min(header, len(data)) if seed % 3 == 1 else len(data)
        for _ in range(rng.randint(1, 6)):
            changed[rng.randrange(end)] = rng.randrange(256)
        yield bytes(changed)


def assert_only_clear_errors(path: Path, variants: Iterator[bytes]) -> None:
    """Whatever is in the file, kalux reads it or says on one line, with the path, what is wrong."""
    for data in variants:
        path.write_bytes(data)
        message = complaint(path)
        assert not message or str(path) in message
        assert "\n" not in message
        assert len(message) < 600 + len(str(path))


def read_by_dv_processing(path):
    """Events and frames of an AEDAT 4 file, as iniVation's own library reads them; skips where it is not installed."""
    dv = pytest.importorskip("dv_processing")
    other = dv.io.MonoCameraRecording(str(path))
    batches, images = [], []
    while (batch := other.getNextEventBatch()) is not None:
        batches.append(batch.numpy())
    while (image := other.getNextFrame()) is not None:
        images.append(image)
    found = np.concatenate(batches)
    return make_events(*(found[name] for name in ("timestamp", "x", "y", "polarity"))), images


def check_seeking(source: readers.Source, times) -> None:
    """Require what is read since each of the times to be the events from then on, and not all that are before."""
    whole = all_events(source)
    assert isinstance(source.events, SeekableEvents)
    shortest = len(whole)
    for t in times:
        since = np.concatenate([whole[:0], *source.events.since(t)])
        assert np.array_equal(since, whole[len(whole) - len(since) :])
        assert (whole["t"][: len(whole) - len(since)] < t).all()
        shortest = min(shortest, len(since))
    assert shortest < len(whole) / 2
