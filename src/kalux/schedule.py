"""The times of the images that a reconstruction makes."""

from __future__ import annotations

from numbers import Real
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.errors import InputError
from kalux.recording import Recording
from kalux.settings import FilterSettings

MOST_IMAGES: Final = 100_000_000
"""Times of one rate: 0.8 GB. An hour at 10 kHz has a third of them; of more, a time in the recording is wrong."""


def begin_time(first: NDArray[np.int64], filtered: FilterSettings, lookahead: bool) -> int:
    """The first time that can be read, us, given the ``first`` exposure; the same as `Reconstructor.begin_time`."""
    start, end = (int(t) for t in first)
    if not lookahead:
        return end
    return start + (end - start) // 2 if filtered.kind == "cf" else start


def image_times(
    recording: Recording,
    exposures: NDArray[np.int64],
    begin: int,
    *,
    rate_hz: float | None = None,
    times: Any = None,
    at: str | None = None,
) -> NDArray[np.int64]:
    """The times to read, checked against the recording.

    Parameters
    ----------
    recording
        Asked for its last event where ``times`` go on beyond the last exposure.
    exposures
        (K, 2) starts and ends of the frames' exposures, us.
    begin
        The first time that can be read, us.
    rate_hz, times, at
        One of them, as of `kalux.reconstruct`.

    Returns
    -------
    ndarray
        (N,) int64 us; none before the one before it.

    Raises
    ------
    InputError
        If they are not times, go back, or lie outside the recording; or the rate is out of range.
    """
    if at is not None:
        if at != "frames":
            raise InputError(f"reconstruct: at is {at!r}; only 'frames' is known")
        middles: NDArray[np.int64] = exposures.sum(axis=1) // 2
        return middles[middles >= begin]
    end = int(exposures[-1, 1])
    if rate_hz is not None:
        return _grid(begin, end, rate_hz)
    wanted = checked_times(times, "reconstruct: times")
    if wanted[0] < begin:
        raise InputError(
            f"reconstruct: {wanted[0]} us lies before {begin} us, the earliest time the recording's frames allow"
        )
    if wanted[-1] > end:
        last = max((int(chunk["t"][-1]) for chunk in recording.events()), default=end)
        if wanted[-1] > max(last, end):
            raise InputError(
                f"reconstruct: {wanted[-1]} us lies after the recording's end at {max(last, end)} us"
            )
    return wanted


def _grid(begin: int, end: int, rate_hz: float) -> NDArray[np.int64]:
    """From ``begin`` to ``end`` at most, without drift."""
    if not (isinstance(rate_hz, Real) and 1e-6 <= rate_hz <= 1e6):
        raise InputError(
            f"reconstruct: the image rate is {rate_hz!r} Hz; at least 1e-6 and at most 1e6 is possible"
        )
    count = int(np.floor((end - begin) * 1e-6 * rate_hz + 1e-9)) + 1
    if count > MOST_IMAGES:
        raise InputError(
            f"reconstruct: {rate_hz:g} Hz over the {(end - begin) * 1e-6:,.0f} s that the frames cover makes {count:,} "
            f"images; {MOST_IMAGES:,} at most are possible. Are the frames' times right? kalux info says them"
        )
    grid: NDArray[np.int64] = np.rint(np.arange(count) * (1e6 / rate_hz)).astype(np.int64)
    return begin + grid


def checked_times(times: Any, name: str) -> NDArray[np.int64]:
    """The times of images as integers; one may repeat. Fractions are refused, not rounded: they may be seconds.

    Parameters
    ----------
    times
        (N,) numbers, us.
    name
        What they are called in messages.

    Raises
    ------
    InputError
        If they are no numbers, none at all, not whole, out of range, or go back.
    """
    given = np.asarray(times)
    if given.ndim != 1 or len(given) == 0 or given.dtype.kind not in "iuf":
        raise InputError(f"{name} must be a list of whole microseconds, with at least one entry")
    wrong = np.flatnonzero(~(np.abs(given.astype(np.float64)) < 2.0**62) | (given != np.rint(given)))
    if len(wrong):
        index = int(wrong[0])
        raise InputError(
            f"{name}[{index}] is {given[index]}; whole microseconds are needed, such as np.rint gives"
        )
    whole: NDArray[np.int64] = given.astype(np.int64)
    backward = np.flatnonzero(np.diff(whole) < 0)
    if len(backward):
        index = int(backward[0]) + 1
        raise InputError(
            f"{name}[{index}] is {whole[index]} us, before {whole[index - 1]} us, the one before it; "
            "times must not go back"
        )
    return whole
