"""The offset between the clocks of frames and events that have the same pixels, of a recording that is mended.

Events tell what a recording is mended by only in the clock of the frames, and the offset is that of the mended
recording: where there is anything to mend, the offset is estimated once more.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from itertools import product
from typing import Final

from kalux.calibration.event_layout import LayoutFit
from kalux.calibration.offset import (
    RANGE,
    Correlation,
    OffsetEstimate,
    correlate,
    estimate_offset,
    frame_changes,
)
from kalux.calibration.registration import Registration
from kalux.errors import InputError
from kalux.events import EventArray
from kalux.frames import Frame
from kalux.planning.mending import Mends, mend
from kalux.recording import (
    AS_STORED,
    EventLayout,
    Recording,
    less_black,
    with_event_layout,
    with_frames,
)
from kalux.settings import CameraSettings, Settings, altered, chosen_response

_CERTAIN: Final = 0.4
_TIMES: Final = 1.5
"""Correlation, and how many times that of the events as stored, from which another layout is the right one: of right
ones it is 0.46 to 0.78 on five simulated scenes and three recordings, of wrong ones 0.25 at most."""

OnEvents = Callable[[int], None]


def offset_of_recording(
    recording: Recording,
    settings: Settings,
    *,
    centre: float = 0.0,
    reach: int = RANGE,
    on_events: OnEvents = lambda count: None,
) -> tuple[OffsetEstimate, Mends]:
    """The offset of the frames' clock where frames and events have the same pixels.

    A black level that is left in makes the dark change too little, and moves the offset by up to 0.8 ms
    (docs/calibration.md).

    Parameters
    ----------
    recording
        With frames; of unknown exposures nothing but the events' layout is mended.
    settings
        Response, I_0, black level, and what may be mended.
    centre, reach
        us: where to look.
    on_events
        Called with the number of events of every chunk that is read.

    Returns
    -------
    The offset, and what the recording was mended by.

    Raises
    ------
    InputError
        If frames or events are too few, or do not go together.
    """
    same = Registration.same_pixels(recording.sensor_size)
    settings = altered(
        settings, "camera", response=chosen_response(settings.camera.response, recording.response)
    )

    def estimated(source: Recording) -> OffsetEstimate:
        return estimate_offset(
            source.stamped_frames,
            lambda: _counted(source.events(), on_events),
            same,
            camera=settings.camera,
            centre=centre,
            reach=reach,
        )

    def other_layout() -> LayoutFit | None:
        asked = settings.events.mend_layout
        return _other_layout(recording, same, settings.camera, centre, reach) if asked else None

    recording, layout = less_black(recording, settings.camera.black_level), None
    try:
        found = estimated(recording)
        if not found.coarse.sure:
            layout = other_layout()
    except InputError:  # events do not explain the frames: those that lie the wrong way round do not
        layout = other_layout()
        if layout is None:
            raise
    if layout is not None:
        recording = with_event_layout(recording, layout.found)
        found = estimated(recording)
    if not recording.exposure_known:
        return found, Mends(layout=layout)
    shift = round(found.apparent)
    mended = mend(_later(recording, shift), altered(settings, "events", delay=0))
    if mended.mends.changes:
        found = estimated(_later(mended.recording, -shift))
    return found, mended.mends if layout is None else mended.mends._replace(layout=layout)


def _other_layout(
    recording: Recording, same: Registration, camera: CameraSettings, centre: float, reach: int
) -> LayoutFit | None:
    """A layout in which events follow the frames at some offset, where they do not as they are; None: there is none."""
    changes = frame_changes(recording.stamped_frames(), same, camera)
    found: dict[EventLayout, Correlation] = {}
    for layout in (EventLayout(*flipped) for flipped in product((False, True), repeat=3)):
        events = with_event_layout(recording, layout).events()
        found[layout] = correlate(changes, events, recording.sensor_size, centre=centre, reach=reach)
    best = max(found, key=lambda layout: found[layout].peak)
    certain = found[best].sure and found[best].peak >= max(_CERTAIN, _TIMES * found[AS_STORED].peak)
    return LayoutFit(best, found[best].peak) if certain and best != AS_STORED else None


def _counted(chunks: Iterable[EventArray], on_events: OnEvents) -> Iterator[EventArray]:
    for chunk in chunks:
        on_events(len(chunk))
        yield chunk


def _later(recording: Recording, offset: int) -> Recording:
    """The recording with ``offset``, us, added to the times of its frames."""

    def frames() -> Iterator[Frame]:
        for frame in recording.frames():
            start, end = frame.exposure_start + offset, frame.exposure_end + offset
            yield dataclasses.replace(frame, exposure_start=start, exposure_end=end)

    return with_frames(recording, frames)
