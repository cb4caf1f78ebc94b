"""Parts of an event stream: slices by time, also by that of rows, and the numbers of events of every pixel."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from kalux import memory
from kalux.compiled import event_column, event_is_on, event_row, event_weight, event_words, loop, weight_unit
from kalux.events import EVENT_DTYPE, LARGEST_SIDE, EventArray

Array = NDArray[np.float64]
FloatArray = NDArray[np.float32]


def between(events: EventArray, start: int, end: int) -> EventArray:
    """The events with start < t <= end."""
    words = event_words(events)
    return events[words_until(words, start) : words_until(words, end)]


def all_between(chunks: Sequence[EventArray], start: int, end: int) -> list[EventArray]:
    """The same of events in several arrays."""
    inside = (between(chunk, start, end) for chunk in chunks)
    return [events for events in inside if len(events)]


def counted(chunks: Iterable[EventArray], on_events: Callable[[int], None]) -> Iterator[EventArray]:
    """The same chunks; ``on_events`` is told the number of events of each when it has been used."""
    for chunk in chunks:
        yield chunk
        on_events(len(chunk))


def first_events(chunks: Iterable[EventArray], most: int | None) -> Iterator[EventArray]:
    """The first ``most`` events, None for all, in their chunks, none of which is empty; no further chunk is read."""
    left = most
    for chunk in chunks:
        part = chunk if left is None else chunk[:left]
        if len(part):
            yield part
        if left is not None:
            left -= len(part)
            if left <= 0:
                return


def events_until(events: EventArray, t: int) -> int:
    """Number of events up to and at ``t`` (us). NumPy's search would copy the whole column first."""
    return int(words_until(event_words(events), t))


@loop
def words_until(words, t):  # type: ignore[no-untyped-def]
    """The same of events as machine words (`kalux.compiled.event_words`)."""
    first, last = 0, len(words)
    while first < last:
        middle = (first + last) // 2
        if words[middle, 0] <= t:
            first = middle + 1
        else:
            last = middle
    return first


def long_waits(events: EventArray, before: int, least: int) -> Iterator[tuple[int, int]]:
    """Times of ``least`` us and more up to each event, (start, end) us, in which none comes; one came at ``before``."""
    words = event_words(events)
    place = _next_wait(words, 0, before, least)
    while place < len(words):
        yield int(words[place - 1, 0]) if place else before, int(words[place, 0])
        place = _next_wait(words, place + 1, words[place, 0], least)


@loop
def _next_wait(words, start, before, least):  # type: ignore[no-untyped-def]
    """Place of the first event from ``start`` on that comes ``least`` us after the one before it; none: their number.

    ``before`` is the time of the event before ``start``.
    """
    for i in range(start, len(words)):
        if words[i, 0] - before >= least:
            return i
        before = words[i, 0]
    return len(words)


def row_delays(height: int, row_time: float) -> Array:
    """(H,) us: how much later than the middle of the frame each row is exposed, given the time from row to row."""
    return (np.arange(height, dtype=np.float64) - (height - 1) / 2) * row_time


def whole_row_delays(height: int, row_time: float) -> NDArray[np.int64]:
    """The same in whole us, as events are stamped."""
    delays: NDArray[np.int64] = np.rint(row_delays(height, row_time)).astype(np.int64)
    return delays


def with_delay_of_rows(events: EventArray, delays: NDArray[np.int64]) -> EventArray:
    """The events, earlier by the delay of their row: no longer in time order."""
    words = event_words(events).copy()
    words[:, 0] -= delays[events["y"]]
    return words.reshape(-1).view(EVENT_DTYPE)


def joined_events(chunks: list[EventArray]) -> EventArray:
    """Events one after the other. NumPy would copy them field by field, in ten times the time."""
    if len(chunks) == 1:
        return chunks[0]
    words = [np.empty((0, 2), np.int64), *map(event_words, chunks)]
    joined: EventArray = memory.empty((sum(map(len, words)),), EVENT_DTYPE)
    np.concatenate(words, out=event_words(joined))
    return joined


def in_order(events: EventArray) -> EventArray:
    """The events in time order; those of one time as they were."""
    words = event_words(events)
    sorted_words = words[np.argsort(words[:, 0], kind="stable")]
    return sorted_words.reshape(-1).view(EVENT_DTYPE)


def count_events(events: EventArray, shape: tuple[int, int], *, weighed: bool = False) -> tuple[Array, Array]:
    """Number of on and off events of every pixel, two (H, W) float64; the sums of their weights if they carry such."""
    on, off = count_chunks([events], shape, weighed=weighed)
    return on.astype(np.float64), off.astype(np.float64)


def count_chunks(
    chunks: Sequence[EventArray], shape: tuple[int, int], *, weighed: bool
) -> tuple[FloatArray, FloatArray]:
    """The same of events in several arrays, two (H, W) float32; sums of weights where the events carry such."""
    height, width = shape
    counts = np.zeros((2, height * width), np.float32)
    for chunk in chunks:
        _count(event_words(chunk), counts, np.uint64(width), weight_unit(weighed))
    return counts[1].reshape(shape), counts[0].reshape(shape)


def thinned(events: EventArray, step: int) -> EventArray:
    """Events of every ``step``-th column of every ``step``-th row, as of a sensor that has these pixels alone."""
    left: EventArray = np.empty(len(events), EVENT_DTYPE)  # most of it is never touched
    return left[: _thinned(event_words(events), _thinned_places(step), event_words(left))]


@functools.lru_cache
def _thinned_places(step: int) -> NDArray[np.int64]:
    """Of every possible row or column which one of those left it is, or -1: looked up faster than divided."""
    places = np.arange(LARGEST_SIDE, dtype=np.int64)
    return np.where(places % step == 0, places // step, -1)


@loop
def _thinned(words, places, left):  # type: ignore[no-untyped-def]
    count = np.uint64(0)
    for i in range(len(words)):
        word = words[i, 1]
        row, column = places[event_row(word)], places[event_column(word)]
        left[count, 0] = words[i, 0]
        left[count, 1] = (word >> 32) << 32 | row << 16 | column
        count += np.uint64(row | column >= 0)  # what is not left is written over
    return count


@loop
def _count(words, counts, width, unit):  # type: ignore[no-untyped-def]
    for i in range(len(words)):
        word = words[i, 1]
        at = event_row(word) * width + event_column(word)
        counts[np.uint64(event_is_on(word)), at] += event_weight(word, unit)
