"""Exposures from hardware triggers: what a frame camera tells an event camera by wire, in the event camera's clock.

A camera's exposure output is high while it exposes: its rising edge is the start, its falling edge the end.
Where one edge only is recorded (a pulse, a strobe), the exposure time is given.
"""

from __future__ import annotations

from collections.abc import Iterable
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
    skip_triggers: int = 0,
    skip_frames: int = 0,
) -> TriggeredExposures:
    """Which frame each exposure is of.

    Where the numbers differ by one or two, some are missing at the beginning or the end; where follows from the
    intervals between the frames' own stamps, if these vary enough.

    Parameters
    ----------
    starts, ends
        From `exposures`.
    stamps
        (count,) times of the frames in their own clock, us; None where there are none.
    count
        Number of frames.
    skip_triggers, skip_frames
        What to leave out at the beginning, where that is known.

    Raises
    ------
    ExposureError
        If the numbers do not match, or it cannot be told which belong together.
    """
    if min(skip_triggers, skip_frames) < 0:
        raise InputError("triggers: a number to skip is negative")
    starts, ends = starts[skip_triggers:], ends[skip_triggers:]
    frames = count - skip_frames
    said = f"{how_many(len(starts), 'trigger exposure')} and {how_many(frames, 'frame')}"
    if len(starts) == 0 or frames <= 0:
        raise ExposureError(f"triggers: there are {said}")
    missing = len(starts) - frames
    if missing == 0:
        return TriggeredExposures(starts, ends, skip_frames, ())
    if abs(missing) > MOST_MISSING and not (skip_triggers or skip_frames):
        raise ExposureError(
            f"triggers: there are {said}; more than {MOST_MISSING} are missing, so that frames were lost within the "
            "recording or other things were triggered. Record again, or say how many to leave out at the beginning "
            "(--skip-triggers, --skip-frames)"
        )
    if skip_triggers or skip_frames:
        shift = 0
    else:
        shift = _best_shift(starts, None if stamps is None else stamps[skip_frames:], missing, said)
    many = "exposures" if missing > 0 else "frames"
    note = f"there are {said}: {shift} {many} at the beginning and {abs(missing) - shift} at the end are left out"
    if missing > 0:
        return TriggeredExposures(
            starts[shift : shift + frames], ends[shift : shift + frames], skip_frames, (note,)
        )
    return TriggeredExposures(starts, ends, skip_frames + shift, (note,))


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
