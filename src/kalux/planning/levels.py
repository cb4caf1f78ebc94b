"""Which values of frames are black, and from which on pixels are clipped."""

from __future__ import annotations

from typing import Final, NamedTuple

from kalux.calibration.black_level import BlackLevel, with_known_black
from kalux.calibration.compression import Compression, find_compression
from kalux.calibration.levels import LAST_LEVEL, Ceiling, find_ceiling, frames_end
from kalux.planning.event_steps import with_event_steps
from kalux.recording import Recording, less_black
from kalux.settings import CameraSettings, Settings, altered

_DEVIATIONS: Final = 4
"""Of what a codec is off by beside clipped pixels: so far below the usual saturation pixels count as clipped."""


def without_black(recording: Recording, settings: Settings) -> tuple[Recording, Settings, BlackLevel | None]:
    """Take the black level off, and fill it in where the frames begin above 0 and events say that this is black.

    The paper's filters take off what is given and look for nothing.

    Returns
    -------
    The recording less its black level, the settings, and what was looked for, if anything was.
    """
    if not settings.filter.joins_frames:
        return less_black(recording, settings.camera.black_level), settings, None
    recording, found = with_known_black(recording, settings.camera, settings.events)
    if found is not None and found.level:
        settings = altered(settings, "camera", black_level=found.level)
    return recording, settings, found


def usual_saturation(camera: CameraSettings, compression: Compression | None) -> float:
    """The response from which on pixels count as clipped where the recording does not tell it."""
    return camera.usual_saturation - (0.0 if compression is None else _DEVIATIONS * compression.error)


class Saturation(NamedTuple):
    """Settings with the saturation, and what it goes by.

    Attributes
    ----------
    settings
        With the saturation filled in.
    ceiling
        The level at which frames are clipped below the usual saturation, if that was found.
    compression
        What JPEG or a video did to the frames, if that is known, and was asked for.
    is_clean_end
        Whether the saturation is just below the level at which all that is clipped is.
    """

    settings: Settings
    ceiling: Ceiling | None = None
    compression: Compression | None = None
    is_clean_end: bool = False


def with_saturation(recording: Recording, settings: Settings) -> Saturation:
    """Fill in the saturation: from the settings, else just below the level at which all frames end, else usual.

    Frames also end where the scene has nothing brighter. Below the usual saturation events tell which it is: pixels at
    that level are clipped if events go on there, by thresholds that are estimated as if it were the saturation. Where
    all clipped pixels are at the end, those below it are measured (`kalux.calibration.levels.frames_end`), but for
    frames that JPEG has compressed: it leaves pixels below the end which were clipped, so that some more count as such.
    """
    camera = settings.camera
    if camera.saturation is not None or not settings.filter.joins_frames:
        return Saturation(altered(settings, "camera", saturation=camera.clipped_from))
    compression = find_compression(recording)
    level = usual_saturation(camera, compression)
    usual = Saturation(altered(settings, "camera", saturation=level), None, compression)
    end = frames_end(recording)
    if end is None:
        return usual
    is_clean = end.is_clean and compression is None
    clipped = altered(settings, "camera", saturation=(LAST_LEVEL if is_clean else level) * end.level)
    if end.level >= camera.usual_saturation:
        return Saturation(clipped, None, compression, is_clean) if is_clean else usual
    known = with_event_steps(recording, clipped).settings
    found = find_ceiling(recording, known.camera, known.events)
    is_there = found is not None and found.is_at(end.level)
    return Saturation(clipped, found, compression, is_clean) if is_there else usual
