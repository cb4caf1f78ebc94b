"""What readers do with streams: decompress, join small packets of events, put late frames in order."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np
import zstandard

from kalux.events import EVENT_DTYPE, EventArray
from kalux.frames import Frame
from kalux.readers.source import CHUNK_EVENTS

_REORDERED_FRAMES: Final = 8  # frames held back to put late ones in order


def rechunk(packets: Iterable[EventArray]) -> Iterator[EventArray]:
    """Join packets, a few thousand events each, to chunks that are worth a loop."""
    held: list[EventArray] = []
    count = 0
    for packet in packets:
        if count + len(packet) > CHUNK_EVENTS and held:
            yield _join(held)
            held, count = [], 0
        while len(packet) > CHUNK_EVENTS:
            yield packet[:CHUNK_EVENTS]
            packet = packet[CHUNK_EVENTS:]
        held.append(packet)
        count += len(packet)
    if count:
        yield _join(held)


def _join(packets: list[EventArray]) -> EventArray:
    # As plain numbers: NumPy joins structured arrays field by field, five times slower.
    return np.concatenate([packet.view(np.uint64) for packet in packets]).view(EVENT_DTYPE)


def unzstd(data: bytes) -> bytes:
    """Decompress a Zstandard frame, whatever size it claims.

    Raises
    ------
    EOFError
        If it is incomplete.
    zstandard.ZstdError
        If it is damaged.
    """
    decompressor = zstandard.ZstdDecompressor().decompressobj()
    out = decompressor.decompress(data)
    if not decompressor.eof:
        raise EOFError("compressed data are incomplete")
    return out


def in_order(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Frames by exposure start, if none is more than a few places late."""
    held: list[tuple[int, int, Frame]] = []
    for index, frame in enumerate(frames):
        heapq.heappush(held, (frame.exposure_start, index, frame))
        if len(held) > _REORDERED_FRAMES:
            yield heapq.heappop(held)[-1]
    while held:
        yield heapq.heappop(held)[-1]
