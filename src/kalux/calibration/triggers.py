"""Exposures from hardware triggers: what a frame camera tells an event camera by wire, in the event camera's clock.

A camera's exposure output is high while it exposes: its rising edge is the start, its falling edge the end.
Where one edge only is recorded (a pulse, a strobe), the exposure time is given.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import permutations
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.errors import ExposureError, InputError
from kalux.readers.source import TRIGGER_DTYPE, TriggerArray
from kalux.wording import how_many

Times = NDArray[np.int64]
Edge = Literal["both", "rising", "falling"]

MOST_MISSING: Final = 2
"""Triggers or frames that may be missing at the ends: the one under way when a recording begins, and when it ends."""

_CLEARER: Final = 2.0  # how much better the best matching must fit than the next

_SURER: Final = 4.0
"""How much better than in order another matching of equal numbers must fit: by chance none did in 16,000 trains of 14
triggers and frames, the fewest that are judged, with stamps that jitter by 0 to 1 ms."""

_LEAST_PART: Final = 4  # intervals before and after a loss: fewer fit something by chance
_UNLIKE: Final = 1.2
"""Times by which intervals vary: they differ by more from the triggers' that are not theirs, 1.4 if unrelated."""

_IRREGULAR: Final = 0.01  # of an interval; stamps that vary less are as good as even, and tell nothing


class TriggeredExposures(NamedTuple):
    """Exposures, and which frames they are those of.

    Attributes
    ----------
    starts, ends
        (N,) us, in the clock of the events.
    first_frame
        Number of the frame that the first exposure is of, from 0; the others follow.
    notes
        What was assumed, a sentence each, for the user.
    """

    starts: Times
    ends: Times
    first_frame: int
    notes: tuple[str, ...]


def exposures(
    chunks: Iterable[TriggerArray],
    *,
    edge: Edge = "both",
    exposure: int | None = None,
    input_id: int | None = None,
) -> tuple[Times, Times, tuple[str, ...]]:
    """Exposures (starts, ends, notes), us, from edges.

    Parameters
    ----------
    chunks
        Of `TRIGGER_DTYPE`, in time order.
    edge
        ``"both"``: from each rising edge to the falling one after it. Otherwise the one at which exposures start.
    exposure
        us, needed where one edge counts.
    input_id
        Of the trigger input; needed where several have edges.

    Raises
    ------
    ExposureError
        If there are no such edges, or they cannot be paired.
    """
    edges = _edges_of(chunks, input_id)
    rising, times = edges["rising"], edges["t"].astype(np.int64)
    if edge == "both":
        if exposure is not None:
            raise ExposureError("triggers: both edges tell the exposure; give an exposure with one edge only")
        return _paired(rising, times)
    if exposure is None or exposure <= 0:
        raise ExposureError("triggers: with one edge per frame the exposure time is needed, in us")
    starts = times[rising == (edge == "rising")]
    if not len(starts):
        raise ExposureError(f"triggers: there are no {edge} edges; use the other one, or both")
    return starts, starts + exposure, ()


def _edges_of(chunks: Iterable[TriggerArray], input_id: int | None) -> TriggerArray:
    """The edges of one input; of the only one that has any, if it is not said which."""
    held = [chunk for chunk in chunks if len(chunk)]
    edges: TriggerArray = np.concatenate(held) if held else np.empty(0, TRIGGER_DTYPE)
    ids = np.unique(edges["id"])
    if input_id is not None:
        edges = edges[edges["id"] == input_id]
    elif len(ids) > 1:
        raise ExposureError(
            f"triggers: inputs {', '.join(map(str, ids))} have edges; say which is the frame camera's (--trigger-input)"
        )
    if not len(edges):
        where = (
            "its trigger inputs"
            if input_id is None
            else f"input {input_id} (there are some on {ids.tolist()})"
        )
        raise ExposureError(
            f"triggers: the recording has no edges on {where}; is the wire connected, and the input enabled when "
            "recording?"
        )
    return edges


def _paired(rising: NDArray[np.bool_], times: Times) -> tuple[Times, Times, tuple[str, ...]]:
    """Exposures from each rising edge to the falling one after it, and what was assumed."""
    if rising.all() or not rising.any():
        only = "rising" if rising.all() else "falling"
        raise ExposureError(
            f"triggers: all {len(times)} edges are {only}; say so (--trigger-edge {only}) and give the exposure time"
        )
    notes = []
    if not rising[0]:
        notes.append("the first edge is a falling one: the exposure that it ends began before the recording")
        rising, times = rising[1:], times[1:]
    if len(rising) % 2:
        notes.append("the last edge is a rising one: the exposure that it starts ends after the recording")
        rising, times = rising[:-1], times[:-1]
    wrong = np.flatnonzero(rising != (np.arange(len(rising)) % 2 == 0))
    if len(wrong):
        raise ExposureError(
            f"triggers: at {times[wrong[0]]} us two edges of one kind follow each other, and cannot be paired; "
            "is an edge lost, or the input noisy? One edge (--trigger-edge rising) and an exposure time may do"
        )
    return times[::2], times[1::2], tuple(notes)


def match(
    starts: Times,
    ends: Times,
    stamps: Times | None,
    count: int,
    *,
    skip_triggers: int | None = None,
    skip_frames: int | None = None,
) -> TriggeredExposures:
    """Which frame each exposure is of.

    Where the numbers differ by one or two, some are missing at the beginning or the end; where follows from the
    intervals between the frames' own stamps, if these vary enough. Where the numbers are the same, the intervals may
    still tell that one is missing at the beginning and another at the end.

    Parameters
    ----------
    starts, ends
        From `exposures`.
    stamps
        (count,) times of the frames in their own clock, us; None where there are none.
    count
        Number of frames.
    skip_triggers, skip_frames
        What to leave out at the beginning, where that is known: 0 of the one that is not given. None: it is found.

    Raises
    ------
    ExposureError
        If the numbers do not match, it cannot be told which belong together, or some were lost within the recording.
    """
    known = not (skip_triggers is None and skip_frames is None)
    skip_triggers, skip_frames = skip_triggers or 0, skip_frames or 0
    if min(skip_triggers, skip_frames) < 0:
        raise InputError("triggers: a number to skip is negative")
    starts, ends = starts[skip_triggers:], ends[skip_triggers:]
    frames = count - skip_frames
    said = f"{how_many(len(starts), 'trigger exposure')} and {how_many(frames, 'frame')}"
    if len(starts) == 0 or frames <= 0:
        raise ExposureError(f"triggers: there are {said}")
    missing = len(starts) - frames
    if missing == 0:
        shift, notes = (0, ()) if known else _shift_of_equal(starts, stamps, said)
        kept = slice(max(shift, 0), frames + min(shift, 0))
        return TriggeredExposures(starts[kept], ends[kept], skip_frames + max(-shift, 0), notes)
    if abs(missing) > MOST_MISSING and not known:
        raise ExposureError(
            f"triggers: there are {said}; more than {MOST_MISSING} are missing, so that frames were lost within the "
            "recording or other things were triggered. Record again, or say how many to leave out at the beginning "
            "(--skip-triggers, --skip-frames)"
        )
    shift = 0 if known else _best_shift(starts, stamps, missing, said)
    many = "exposures" if missing > 0 else "frames"
    note = f"there are {said}: {shift} {many} at the beginning and {abs(missing) - shift} at the end are left out"
    if missing > 0:
        return TriggeredExposures(
            starts[shift : shift + frames], ends[shift : shift + frames], skip_frames, (note,)
        )
    return TriggeredExposures(starts, ends, skip_frames + shift, (note,))


def _shift_of_equal(starts: Times, stamps: Times | None, said: str) -> tuple[int, tuple[str, ...]]:
    """Number of the trigger that belongs to the first frame, and what to say of it; negative: so many frames have none.

    Every shift is judged by the same intervals between stamps, so that an odd one at an end speaks for none of them.
    """
    if stamps is None or len(stamps) < 2 * (MOST_MISSING + _LEAST_PART + 1):
        return 0, ()
    inner = np.diff(stamps[MOST_MISSING:-MOST_MISSING])
    shifts = range(-MOST_MISSING, MOST_MISSING + 1)
    least, count = MOST_MISSING, len(inner)
    squares = {s: (np.diff(starts)[least + s : least + s + count] - inner) ** 2.0 for s in shifts}
    varies = float(np.std(inner))
    in_order = _root_mean(squares[0])
    best = min(shifts, key=lambda s: _root_mean(squares[s]))
    if _clearly(_root_mean(squares[best]), in_order, varies):
        first, last = ("frame", "exposure") if best < 0 else ("exposure", "frame")
        return best, (
            f"there are {said}, but their intervals agree if the first {how_many(abs(best), first)} and the last "
            f"{how_many(abs(best), last)} are left out, as they are here; --skip-frames 0 keeps them",
        )
    lost, broken, whole = _broken(squares)
    if _clearly(broken, whole, varies):
        raise ExposureError(
            f"triggers: there are {said}, but their intervals agree with one shift before frame {MOST_MISSING + lost} "
            "and with another after it: some were lost within the recording. Record again"
        )
    if varies > _IRREGULAR * float(np.median(inner)) and in_order > _UNLIKE * varies:
        return 0, (
            f"there are {said}, and the intervals between the frames' own times are not those of the triggers: were "
            "frames or triggers lost?",
        )
    return 0, ()


def _clearly(error: float, other: float, varies: float) -> bool:
    """Whether a matching with this error explains how the stamps' intervals vary, and another one does not."""
    return min(other, varies) >= _SURER * error + 1


def _root_mean(squares: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(squares)))


def _broken(squares: dict[int, NDArray[np.float64]]) -> tuple[int, float, float]:
    """Where one shift best gives way to another: the interval, left out, the error then, and that of one shift alone.

    One shift alone may leave out its worst interval, too.
    """
    count = len(next(iter(squares.values())))
    sums = {shift: np.append(0.0, np.cumsum(each)) for shift, each in squares.items()}
    lost = np.arange(_LEAST_PART, count - _LEAST_PART)
    ways = [
        sums[before][lost] + sums[after][-1] - sums[after][lost + 1]
        for before, after in permutations(squares, 2)
    ]
    least = np.maximum(np.min(ways, axis=0), 0.0)
    whole = min(max(sums[shift][-1] - each.max(), 0.0) for shift, each in squares.items())
    at = int(np.argmin(least))
    return int(lost[at]), float(np.sqrt(least[at] / (count - 1))), float(np.sqrt(whole / (count - 1)))


def _best_shift(starts: Times, stamps: Times | None, missing: int, said: str) -> int:
    """How many of the longer sequence to leave out at the beginning."""
    unsure = ExposureError(
        f"triggers: there are {said}, and the frames' own times do not tell whether the first or the last is missing; "
        "say it with --skip-triggers N or --skip-frames N (0 or more; the rest is missing at the end)"
    )
    if stamps is None or min(len(starts), len(stamps)) < 4:
        raise unsure
    long, short = (starts, stamps) if missing > 0 else (stamps, starts)
    errors = []
    for shift in range(abs(missing) + 1):
        difference = long[shift : shift + len(short)] - short
        errors.append(float(np.std(difference - np.linspace(difference[0], difference[-1], len(short)))))
    order = np.argsort(errors)
    if errors[order[1]] < _CLEARER * errors[order[0]] + 1:
        raise unsure
    return int(order[0])
