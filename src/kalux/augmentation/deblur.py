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

from kalux import memory
from kalux.compiled import (
    AHEAD,
    FUSED,
    ONE,
    UNWEIGHED,
    apart,
    empty,
    event_column,
    event_is_on,
    event_row,
    event_weight,
    event_words,
    exponential,
    logarithm,
    loop,
    pack,
    prefetch,
    smaller,
    unpack,
    weight_unit,
)
from kalux.event_slices import all_between
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
"""State of a pixel within an exposure: 32 bytes, half a cache line, fetched and stored at once."""

EXPOSURE_FIELDS: Final = len(EXPOSURE_PIXEL.names or ())
_LEVEL, _INTEGRAL, _SINCE, _PEAK, _AT_MIDDLE, _EVENTS, _UP, _DOWN = range(EXPOSURE_FIELDS)

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
        Sum of the weights of the events within the exposure (`kalux.augmentation.refractory`).
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
    exposure = expose(chunks, start, end, (step_on, step_off), (1.0, 1.0), weighed=False)
    integrals = apart(5, step_on.shape)
    _finish_exposure(*exposure, end - start, *(plane.reshape(-1) for plane in integrals))
    return ExposureIntegrals(*integrals)


class Exposure(NamedTuple):
    """Levels of the pixels during an exposure, and their integrals.

    Attributes
    ----------
    pixels
        (H W) of `EXPOSURE_PIXEL`, row after row; filled only where ``touched``.
    touched
        (H W / `EXPOSED`, rounded up) bool: of blocks of pixels that follow each other, whether one has had an event.
        Elsewhere nothing has moved: the level is 1 throughout.
    """

    pixels: NDArray[np.void]
    touched: NDArray[np.bool_]


EXPOSED: Final = 64
"""Pixels of a block: few enough that fields stay in the nearest cache, and that parts where nothing moves are found."""


def expose(
    chunks: Sequence[EventArray],
    start: int,
    end: int,
    thresholds: tuple[Floats, Floats],
    nominal: tuple[float, float],
    *,
    weighed: bool,
) -> Exposure:
    """Integrate the pixels' levels over an exposure, from ``start`` to ``end`` (us).

    Parameters
    ----------
    chunks
        Time-ordered events; those outside (start, end] are ignored.
    thresholds, nominal
        (H, W) thresholds of an event of either polarity in units of the nominal ones, and these, log intensity.
    weighed
        Whether the events carry weights (`kalux.augmentation.refractory`).
    """
    height, width = thresholds[0].shape
    pixels = memory.empty((height * width,), EXPOSURE_PIXEL)
    touched = np.zeros(-(-len(pixels) // EXPOSED), np.bool_)
    inside = [event_words(events) for events in all_between(chunks, start, end)]
    for words in inside:
        _touch(words, np.uint64(width), touched)
    units = (np.float32(step) for step in nominal)
    _begin_exposure(pixels, touched, *(plane.reshape(-1) for plane in thresholds), *units)
    for words in inside:
        _integrate(words, pixels, np.uint64(width), start, (start + end) // 2, weight_unit(weighed))
    return Exposure(pixels, touched)


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
    """The largest L^D within the exposure: whether a pixel was brighter than white for a part of it."""
    return latent_start(log_frame, integrals) + integrals.peak


# Elementary functions go over a block of pixels at a time, in arrays of their own: vector code would pick the fields
# of the packed pixels one by one, which is slower than plain code. `pack` and `unpack` take its place.


@loop
def _touch(words, width, touched):  # type: ignore[no-untyped-def]
    for i in range(len(words)):
        word = words[i, 1]
        touched[(event_row(word) * width + event_column(word)) // np.uint64(EXPOSED)] = True


@loop
def _begin_exposure(pixels, touched, on, off, unit_on, unit_off):  # type: ignore[no-untyped-def]
    fields = empty((EXPOSURE_FIELDS, EXPOSED), np.float32)
    fields[_LEVEL] = fields[_PEAK] = fields[_AT_MIDDLE] = ONE
    fields[_INTEGRAL] = fields[_SINCE] = fields[_EVENTS] = np.float32(0.0)
    up, down = fields[_UP], fields[_DOWN]
    for block in range(np.uint64(len(touched))):
        first = block * np.uint64(EXPOSED)
        if touched[block]:
            count = smaller(np.uint64(len(pixels)) - first, np.uint64(EXPOSED))
            for i in range(count):
                up[i] = exponential(unit_on * np.float32(on[first + i]))
            for i in range(count):
                down[i] = exponential(-(unit_off * np.float32(off[first + i])))
            pack(fields, pixels, np.int64(first), np.int64(count))


@loop(fastmath=FUSED)
def _integrate(words, pixels, width, start, middle, unit):  # type: ignore[no-untyped-def]
    # A level beyond float32 (88 in log intensity: a broken pixel) becomes infinite or 0; `logarithm` is finite there.
    last = len(words) - 1
    for i in range(len(words)):
        ahead = words[smaller(i + AHEAD, last), 1]
        prefetch(pixels, event_row(ahead) * width + event_column(ahead))
        word = words[i, 1]
        pixel = pixels[event_row(word) * width + event_column(word)]
        now = np.float32(words[i, 0] - start)
        level, up, down = pixel.level, pixel.up, pixel.down
        pixel.integral += level * (now - pixel.since)
        pixel.since = now
        factor = up if event_is_on(word) else down
        weight = ONE
        if word & ~UNWEIGHED and unit > np.float32(0.0):  # before anything is made of it: most events weigh 1
            weight = event_weight(word, unit)
            factor = exponential(weight * logarithm(factor))
        level *= factor
        peak = pixel.peak
        pixel.level = level
        pixel.peak = level if level > peak else peak
        pixel.events += weight
        if words[i, 0] <= middle:
            pixel.at_middle = level


@nb.njit(cache=True, inline="always", error_model="numpy")
def mean_level(level, integral, since, duration):  # type: ignore[no-untyped-def]
    """Mean of the level of an `EXPOSURE_PIXEL` over its exposure of ``duration`` us; finite also of a broken pixel."""
    mean = (integral + level * (duration - since)) / duration
    return mean if mean < _LARGEST else _LARGEST


@nb.njit(cache=True, inline="always", error_model="numpy")
def relative_levels(exposure, block, duration, fields, middle, events):  # type: ignore[no-untyped-def]
    """Of a block of an `Exposure`: the logarithm of the level at the middle over the mean of the exposure, which lasts
    ``duration`` us, and the sums of the events' weights. ``fields`` is scratch memory."""
    if not exposure.touched[block]:
        middle[:] = events[:] = np.float32(0.0)
        return
    first = block * np.uint64(EXPOSED)
    count = smaller(np.uint64(len(exposure.pixels)) - first, np.uint64(EXPOSED))
    unpack(exposure.pixels, np.int64(first), np.int64(count), fields)
    level, integral, since = fields[_LEVEL], fields[_INTEGRAL], fields[_SINCE]
    at_middle, count_of = fields[_AT_MIDDLE], fields[_EVENTS]
    for i in range(count):  # a loop each: each is vector code then
        events[i] = mean_level(level[i], integral[i], since[i], duration)
    for i in range(count):
        middle[i] = logarithm(at_middle[i] / events[i])
    for i in range(count):
        events[i] = count_of[i]


# Not FUSED: the paper's (12) divides small differences of these, which would bring another rounding out a hundredfold.
@loop
def _finish_exposure(  # type: ignore[no-untyped-def]
    pixels, touched, exposure, log_mean, to_middle, to_end, largest, count_of
):
    """Fill the planes of `ExposureIntegrals`: 0 where nothing has moved."""
    duration = np.float32(exposure)
    fields = empty((EXPOSURE_FIELDS, EXPOSED), np.float32)
    level, integral, since = fields[_LEVEL], fields[_INTEGRAL], fields[_SINCE]
    at_middle, peak, events = fields[_AT_MIDDLE], fields[_PEAK], fields[_EVENTS]
    for block in range(np.uint64(len(touched))):
        first = block * np.uint64(EXPOSED)
        count = smaller(np.uint64(len(pixels)) - first, np.uint64(EXPOSED))
        if not touched[block]:
            for plane in (log_mean, to_middle, to_end, largest, count_of):
                plane[first : first + count] = np.float32(0.0)
        else:
            unpack(pixels, np.int64(first), np.int64(count), fields)
            for i in range(count):  # a loop each: each is vector code then
                log_mean[first + i] = logarithm(mean_level(level[i], integral[i], since[i], duration))
            for i in range(count):
                to_middle[first + i] = logarithm(at_middle[i])
            for i in range(count):
                to_end[first + i] = logarithm(level[i])
            for i in range(count):
                largest[first + i] = logarithm(peak[i])
            for i in range(count):
                count_of[first + i] = events[i]
