"""Times between two frames in which events are missing, and what the light may have done meanwhile (K18).

A sensor whose events come faster than they can be read, or a computer that is late to fetch them, loses all of some
milliseconds. To the filter that is a scene that stands still, and the frame after it blames thresholds and single
events for what it shows. What is lost is known by the time for which nothing comes though events are many before and
after; how much, by what the events around tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.bridge import UNMEASURED, Latent
from kalux.augmentation.subthreshold import mean_around
from kalux.compiled import event_words, loop
from kalux.event_slices import long_waits
from kalux.events import EventArray

Array = NDArray[np.floating[Any]]

_MOST_WAITS: Final = 20
"""How many of the least waits that count are the time between two frames: with less missing, events still tell nearly
all of the change."""

_LEAST_REST: Final = 0.1
"""Of that time that must be left for events to tell what is missing: the events of a flash come within a moment, and
none are missing before and after."""

_FAR: Final = 4.0, 2.0
"""Standard deviations of the frames' noise, and thresholds, beyond which a pixel has changed without events that would
have come from a sensor that is heard."""

_LEAST_FAR: Final = 0.005
_LEAST_FAR_PIXELS: Final = 20
"""Share of the measured pixels, and number, that must have: fewer may be broken ones."""

_MISSING: Final = 100.0
"""Events that a wait must be short of, at the rate of the rest of the time between the frames: at random, as many come
once in exp(100) times."""

_BUNCHES: Final = 4.0
"""Times as long as most other waits (`_MOST`) that one must be: events of some simulators and readers are stamped in
bunches, some milliseconds apart."""

_MOST: Final = 0.9

_NONE_AROUND: Final = 0.5 / 81  # of the pixels around, 9 x 9


class Loss(NamedTuple):
    """Whether events are missing between two frames, as far as these events alone tell.

    Attributes
    ----------
    time
        us in which they are missing; 0 where none are, or too few come to tell.
    unheard
        Whether none come, or all within a tenth of the time, so that frames have to tell (`unheard_change`).
    """

    time: int
    unheard: bool


_NONE: Final = Loss(0, False)


def lost_time(chunks: Sequence[EventArray], start: int, end: int) -> int:
    """us from ``start`` to ``end`` in which events are missing (`loss_between`)."""
    return loss_between(chunks, start, end).time


def loss_between(chunks: Sequence[EventArray], start: int, end: int) -> Loss:
    """Whether events are missing from ``start`` to ``end``, us.

    Parameters
    ----------
    chunks
        The events with start < t <= end, in one array or several.

    A wait from one event of the sensor to the next counts if a hundred events are missing in it at the rate of the rest
    of the time, a tenth at least, if it takes a twentieth of the time, and if it is four times as long as nine of ten
    others: stamps that come in bunches are no loss.
    """
    least = max(-(-(end - start) // _MOST_WAITS), 1)
    before, events, waits = start, 0, list[tuple[int, int]]()
    for chunk in filter(len, chunks):
        waits += long_waits(chunk, before, least)
        before, events = int(chunk["t"][-1]), events + len(chunk)
    if end - before >= least:
        waits.append((before, end))
    if not waits:
        return _NONE
    longest = np.diff(np.array(waits, np.int64).reshape(-1, 2)).ravel()
    rest = end - start - int(longest.sum())
    if events == 0 or rest < _LEAST_REST * (end - start):
        return Loss(0, unheard=True)
    lost = longest[longest * (events / rest) >= _MISSING]
    if len(lost) == 0:
        return _NONE
    return Loss(int(lost[lost >= _BUNCHES * _usual_wait(chunks, start)].sum()), unheard=False)


def lost_change(told: Array, lost: int, duration: int) -> Array:
    """What events that are missing between two frames would have told (docs/equations.md, K18).

    Parameters
    ----------
    told
        (H, W) float32 change of log intensity by those that are there.
    lost
        us without events, of `lost_time`.
    duration
        us from one frame to the next; longer than ``lost``.

    Returns
    -------
    (H, W) float32 variance of the change of log intensity that is not told.
    """
    variance = mean_around(np.square(told))
    variance *= np.float32(lost / (duration - lost))
    return variance


def unheard_change(first: Latent, second: Latent, told: Array, threshold2: float) -> Array | None:
    """The same where hardly an event comes, by what the frames show (docs/equations.md, K18).

    Parameters
    ----------
    first, second
        The frames before and after.
    told
        (H, W) float32 change of log intensity by the events that come.
    threshold2
        c^2.

    Returns
    -------
    (H, W) float32 variance of the change that is not told: the mean of its squares around each pixel, less the noise
    of the frames; of all of the image where no pixel around is measured. None where nothing moved.
    """
    noise = first.variance + second.variance
    measured = np.maximum(first.variance, second.variance) < UNMEASURED
    beyond = np.where(measured, np.square(second.value - first.value - told), 0)
    far = measured & (beyond > np.maximum(_FAR[0] ** 2 * noise, _FAR[1] ** 2 * threshold2))
    seen = np.count_nonzero(measured)
    if np.count_nonzero(far) < max(_LEAST_FAR * seen, _LEAST_FAR_PIXELS):
        return None
    beyond = np.where(measured, beyond - noise, 0).astype(np.float32)
    share = mean_around(measured.astype(np.float32))
    whole = float(beyond.sum(dtype=np.float64)) / seen
    around = np.where(share > _NONE_AROUND, mean_around(beyond) / np.maximum(share, _NONE_AROUND), whole)
    return np.maximum(around, 0).astype(np.float32)


def add_lost_change(grown: Array, first: Latent, second: Latent, untold: Array, lost: Array) -> None:
    """Add to ``grown``, (H, W), the part of changes in a time without events that the bridge does not follow. In place.

    As of silent pixels (K11): its slope follows the share untold / V of the mismatch where both frames measure the
    pixel. Where one does not, nothing follows what is lost.

    Parameters
    ----------
    first, second
        The frames before and after.
    untold
        (H, W) variance of what no event has told.
    lost
        (H, W) that of what lost ones would have.
    """
    noise = first.variance + second.variance
    missed = noise / (noise + untold)
    measured = np.maximum(first.variance, second.variance) < UNMEASURED
    grown += np.where(measured, untold * missed * missed, lost)


_POWERS: Final = 64


def _usual_wait(chunks: Sequence[EventArray], start: int) -> int:
    """us, a power of two: that which `_MOST` of the waits between events of different times do not reach."""
    numbers = np.zeros(_POWERS, np.int64)
    before = start
    for chunk in chunks:
        before = _count_waits(event_words(chunk), before, numbers)
    below = np.cumsum(numbers)
    return 1 << int(np.searchsorted(below, _MOST * below[-1]))


@loop
def _count_waits(words, before, numbers):  # type: ignore[no-untyped-def]
    """Count waits by how many binary digits they have; the time of the last event."""
    for i in range(len(words)):
        wait, digits = words[i, 0] - before, 0
        before = words[i, 0]
        while wait > 0:
            wait >>= 1
            digits += 1
        if digits > 0:
            numbers[digits] += 1
    return before
