"""What a recording is mended by before anything of its sensor is measured.

Events are put as the frames are, and those of hot pixels left out; the black level is taken off, and where frames are
clipped is found out; frames that are copies or empty are left out, steps of their gain evened out, and stuck pixels
taken from their neighbours. In this order: each needs what comes before.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.black_level import BlackLevel
from kalux.calibration.clock_rate import ClockRate
from kalux.calibration.compression import Compression
from kalux.calibration.event_layout import LayoutFit, find_layout
from kalux.calibration.frame_faults import FrameFaults
from kalux.calibration.frame_times import FrameTimes
from kalux.calibration.hot_pixels import find_hot_pixels
from kalux.calibration.levels import Ceiling
from kalux.planning.levels import with_saturation, without_black
from kalux.planning.survey import survey
from kalux.recording import (
    AS_STORED,
    UNCHANGED,
    FrameCorrections,
    Recording,
    with_corrected_frames,
    with_event_layout,
    with_frames_of,
    without_events_of,
    without_repeats,
)
from kalux.settings import Settings


class Moved(NamedTuple):
    """By what the times of frames are corrected.

    Attributes
    ----------
    clock
        That of the frames, where it is fast or slow; None: it is not, or not looked for.
    times
        Of single frames, where their stamps are off; None: they are right, or not looked for.
    """

    clock: ClockRate | None = None
    times: FrameTimes | None = None

    @property
    def shifts(self) -> NDArray[np.int64] | None:
        """(K,) us, what is added to the times of each frame; None: they stay."""
        found = [part.shifts for part in self if part is not None]
        return np.sum(found, axis=0) if found else None


class Mends(NamedTuple):
    """What was found to be wrong with a recording, and what is done about it.

    Attributes
    ----------
    layout
        How events lie to the frames, where that is looked for and can be told.
    hot
        (H, W) bool: pixels whose events are left out, as they are hot; None: not looked for.
    black
        What was looked for where the frames begin above 0: whether that is black.
    ceiling
        Where the frames end at one level below the usual saturation while events go on.
    compression
        What JPEG or a video did to the frames, if that is known.
    is_clean_end
        Whether frames end at a level at which all that is clipped is, so that what is just below it is measured.
    faults
        Frames that are left out, or whose gain is not that of others, and stuck pixels; None: none.
    corrections
        What is done about these.
    moved
        By what the times of frames are corrected.
    """

    layout: LayoutFit | None = None
    hot: NDArray[np.bool_] | None = None
    black: BlackLevel | None = None
    ceiling: Ceiling | None = None
    compression: Compression | None = None
    is_clean_end: bool = False
    faults: FrameFaults | None = None
    corrections: FrameCorrections = UNCHANGED
    moved: Moved = Moved()

    @property
    def moves_events(self) -> bool:
        """Whether events are not where, or of the sign that, the recording says."""
        return self.layout is not None and self.layout.found != AS_STORED

    @property
    def changes(self) -> bool:
        """Whether frames or events are others than as recorded."""
        less_black = self.black is not None and self.black.level > 0
        frames = bool(self.corrections) or self.moved.shifts is not None
        return self.moves_events or self.hot_pixels > 0 or less_black or frames

    @property
    def hot_pixels(self) -> int:
        """How many pixels were found to be hot."""
        return 0 if self.hot is None else int(np.count_nonzero(self.hot))


class Mended(NamedTuple):
    """A recording that is mended, the settings with its black level and saturation, and what was wrong."""

    recording: Recording
    settings: Settings
    mends: Mends

    def with_frames(self, faults: FrameFaults | None, *, with_first: bool = False) -> Mended:
        """Mended of the ``faults`` of its frames, too; whether empty ones at the beginning are needed."""
        if faults is None:
            return self
        corrections = faults.corrections(with_first=with_first)
        return self._replace(
            recording=with_corrected_frames(self.recording, corrections),
            mends=self.mends._replace(faults=faults, corrections=corrections),
        )


def mend_events_and_levels(recording: Recording, settings: Settings) -> Mended:
    """Put events right, take the black level off, and find out where frames are clipped, as far as the settings ask.

    Copies are still among the frames, since only events that are put right tell them from a scene that stands still:
    they are passed over.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    whole, recording = recording, without_repeats(recording)
    events, joins_frames = settings.events, settings.filter.joins_frames
    layout = find_layout(recording, settings.camera) if joins_frames and events.mend_layout else None
    if layout is not None:
        recording = with_event_layout(recording, layout.found)
    hot = find_hot_pixels(recording) if joins_frames and events.leave_out_hot else None
    if hot is not None and hot.any():
        recording = without_events_of(recording, hot)
    recording, settings, black = without_black(recording, settings)
    levels = with_saturation(recording, settings)
    found = Mends(layout, hot, black, levels.ceiling, levels.compression, levels.is_clean_end)
    return Mended(with_frames_of(recording, whole), levels.settings, found)


def mend(recording: Recording, settings: Settings) -> Mended:
    """Mend all of a recording, as far as the settings ask, as a plan does where no image is made in an empty frame.

    A recording without frames is mended of its hot pixels alone.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    found = mend_events_and_levels(recording, settings)
    if not recording.source.count_frames():
        return found
    return found.with_frames(survey(found.recording, found.settings).faults)
