"""Deblurring by the event double integral (EDI; Pan et al. 2019, the paper's reference [32]).

A frame is the mean of the intensity over its exposure, and events tell how the intensity moved meanwhile:

    B + I_0 = 1/T int_s^e exp(L(t)) dt = exp(L(s)) 1/T int_s^e exp(E(s, t)) dt

with E(s, t) the sum of the events' steps from the start s of the exposure. So the latent (sharp) image is
L^D(t) = log(B + I_0) - log(mean of exp E(s, .)) + E(s, t). Each interval between two events is weighted by the
level that holds during it, and the mean runs over the whole exposure.

The level exp E is kept as a product: an event multiplies it by e^c or e^-c of its pixel, so that there is one
exponential per pixel and none per event.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.compiled import (
    AHEAD,
    FUSED,
    ONE,
    WEIGHT_UNIT,
    event_column,
    event_is_on,
    event_row,
    event_weight,
    event_words,
    exponential,
    logarithm,
    prefetch,
)
from kalux.events import EventArray

Array = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]
FloatArray = NDArray[np.float32]

EXPOSURE_PIXEL: Final = np.dtype(
    [
        ("level", "f4"),  # exp E(s, t) after the pixel's latest event
        ("integral", "f4"),  # of the level until then, us
        ("since", "f4"),  # time of that event, us after s
        ("peak", "f4"),  # largest level
        ("at_middle", "f4"),  # level at the middle
        ("events", "f4"),  # sum of their weights
        ("up", "f4"),  # e^c of an on event, e^-c of an off event
        ("down", "f4"),
    ],
    align=True,
)
"""What a pixel remembers within an exposure: 32 bytes, half a cache line, fetched and stored at once."""

_LARGEST: Final = np.float32(1e37)


class ExposureIntegrals(NamedTuple):
    """What the events of one exposure say, per pixel; all (H, W) float32, log intensity.

    Attributes
    ----------
    log_mean
        log of the mean over the exposure of exp(E(s, t)).
    to_middle, to_end
        E(s, tau) and E(s, e).
    peak
        Largest E(s, t) within the exposure, at least 0.
    events
        Number of events within the exposure.
    """

    log_mean: FloatArray
    to_middle: FloatArray
    to_end: FloatArray
    peak: FloatArray
    events: FloatArray


def integrate_exposure(
    events: EventArray | Sequence[EventArray],
    start: int,
    end: int,
    step_on: Floats,
    step_off: Floats,
) -> ExposureIntegrals:
    """The double integral over one exposure.

    Parameters
    ----------
    events
        Time-ordered, in one array or several; those outside (start, end] are ignored.
    start, end
        The exposure, us.
    step_on, step_off
        (H, W) positive log-intensity steps of an event of either polarity.
    """
    chunks = [events] if isinstance(events, np.ndarray) else events
    pixels = expose(chunks, start, end, step_on, step_off, weighed=False)
    integrals = ExposureIntegrals(*np.empty((5, *step_on.shape), np.float32))
    _finish_exposure(pixels.reshape(-1), end - start, *integrals)
    return integrals


def expose(
    chunks: Sequence[EventArray], start: int, end: int, step_on: Floats, step_off: Floats, *, weighed: bool
) -> NDArray[np.void]:
    """What every pixel remembers of an exposure, (H, W) of `EXPOSURE_PIXEL`. Parameters of `integrate_exposure`.

    ``weighed`` says that the events carry weights (`kalux.augmentation.refractory`).
    """
    height, width = step_on.shape
    pixels = np.empty(height * width, EXPOSURE_PIXEL)
    _begin_exposure(pixels, step_on, step_off)
    for chunk in chunks:
        inside = between(chunk, start, end)
        _integrate(event_words(inside), pixels, np.uint64(width), start, (start + end) // 2, _unit(weighed))
    return pixels.reshape(height, width)


def _unit(weighed: bool) -> np.float32:
    """Of the events' weights: 0 makes all of them 1."""
    return WEIGHT_UNIT if weighed else np.float32(0.0)


def still_exposure(shape: tuple[int, int]) -> ExposureIntegrals:
    """The integrals of an exposure in which nothing is taken to move (deblurring off)."""
    return ExposureIntegrals(*(np.zeros(shape, np.float32) for _ in range(5)))


def latent_start(log_frame: Array, integrals: ExposureIntegrals) -> Array:
    """L^D at the start of the exposure, from log(B + I_0)."""
    return log_frame - integrals.log_mean


def latent_middle(log_frame: Array, integrals: ExposureIntegrals) -> Array:
    """L^D at the middle of the exposure."""
    return latent_start(log_frame, integrals) + integrals.to_middle


def latent_end(log_frame: Array, integrals: ExposureIntegrals) -> Array:
    """L^D at the end of the exposure."""
    return latent_start(log_frame, integrals) + integrals.to_end


def latent_peak(log_frame: Array, integrals: ExposureIntegrals) -> Array:
    """The largest L^D within the exposure: tells a pixel that clipped for a part of it."""
    return latent_start(log_frame, integrals) + integrals.peak


def between(events: EventArray, start: int, end: int) -> EventArray:
    """The events with start < t <= end."""
    return events[events_until(events, start) : events_until(events, end)]


def all_between(chunks: Sequence[EventArray], start: int, end: int) -> list[EventArray]:
    """The same of events in several arrays."""
    inside = (between(chunk, start, end) for chunk in chunks)
    return [events for events in inside if len(events)]


def events_until(events: EventArray, t: int) -> int:
    """Number of events up to and at ``t`` (us). NumPy's search would copy the whole column first."""
    return int(_events_until(event_words(events), t))


@nb.njit(cache=True, nogil=True)
def _events_until(words, t):  # type: ignore[no-untyped-def]
    first, last = 0, len(words)
    while first < last:
        middle = (first + last) // 2
        if words[middle, 0] <= t:
            first = middle + 1
        else:
            last = middle
    return first


# Elementary functions go over a row of the image at a time, in arrays of their own: vector code would pick the fields
# of the packed pixels one by one, which is slower than plain code. `prefetch` keeps the compiler from it.


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _begin_exposure(pixels, step_on, step_off):  # type: ignore[no-untyped-def]
    height, width = step_on.shape
    up, down = np.empty(width, np.float32), np.empty(width, np.float32)
    for row in range(height):
        for column in range(width):
            up[column] = exponential(np.float32(step_on[row, column]))
            down[column] = exponential(-np.float32(step_off[row, column]))
        for column in range(width):
            i = row * width + column
            prefetch(pixels, i)
            pixel = pixels[i]
            pixel.level = pixel.peak = pixel.at_middle = ONE
            pixel.integral = pixel.since = pixel.events = np.float32(0.0)
            pixel.up, pixel.down = up[column], down[column]


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath=FUSED)
def _integrate(words, pixels, width, start, middle, unit):  # type: ignore[no-untyped-def]
    # A level beyond float32 (88 in log intensity: a broken pixel) becomes infinite or 0; `logarithm` is finite there.
    last = len(words) - 1
    for i in range(len(words)):
        ahead = words[min(i + AHEAD, last), 1]
        prefetch(pixels, event_row(ahead) * width + event_column(ahead))
        word = words[i, 1]
        pixel = pixels[event_row(word) * width + event_column(word)]
        now = np.float32(words[i, 0] - start)
        level, up, down = pixel.level, pixel.up, pixel.down
        pixel.integral += level * (now - pixel.since)
        pixel.since = now
        factor = up if event_is_on(word) else down
        weight = event_weight(word, unit)
        level *= factor if weight == ONE else exponential(weight * logarithm(factor))
        peak = pixel.peak
        pixel.level = level
        pixel.peak = level if level > peak else peak
        pixel.events += weight
        if words[i, 0] <= middle:
            pixel.at_middle = level


@nb.njit(cache=True, inline="always", error_model="numpy")
def mean_level(pixel, duration):  # type: ignore[no-untyped-def]
    """Mean of the level of an `EXPOSURE_PIXEL` over its exposure of ``duration`` us; finite also of a broken pixel."""
    mean = (pixel.integral + pixel.level * (duration - pixel.since)) / duration
    return mean if mean < _LARGEST else _LARGEST


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _finish_exposure(pixels, exposure, log_mean, to_middle, to_end, peak, events):  # type: ignore[no-untyped-def]
    height, width = events.shape
    duration = np.float32(exposure)
    for row in range(height):
        for column in range(width):
            i = row * width + column
            prefetch(pixels, min(i + AHEAD, len(pixels) - 1))
            pixel = pixels[i]
            log_mean[row, column] = mean_level(pixel, duration)
            to_middle[row, column] = pixel.at_middle
            to_end[row, column] = pixel.level
            peak[row, column] = pixel.peak
            events[row, column] = pixel.events
        for column in range(width):
            log_mean[row, column] = logarithm(log_mean[row, column])
        for plane in (to_middle, to_end, peak):
            for column in range(width):
                plane[row, column] = logarithm(plane[row, column])


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
        _count(event_words(chunk), counts, np.uint64(width), _unit(weighed))
    return counts[1].reshape(shape), counts[0].reshape(shape)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _count(words, counts, width, unit):  # type: ignore[no-untyped-def]
    for i in range(len(words)):
        word = words[i, 1]
        at = event_row(word) * width + event_column(word)
        counts[np.uint64(event_is_on(word)), at] += event_weight(word, unit)
