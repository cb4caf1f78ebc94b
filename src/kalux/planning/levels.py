"""Which values of frames are black, and from which on pixels are clipped."""

from __future__ import annotations

from kalux.calibration.black_level import BlackLevel, with_known_black
from kalux.calibration.levels import Ceiling, exact_end, find_ceiling
from kalux.planning.event_steps import with_event_steps
from kalux.recording import Recording, less_black
from kalux.settings import Settings, altered


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


def with_saturation(recording: Recording, settings: Settings) -> tuple[Settings, Ceiling | None]:
    """Fill in the saturation: from the settings, else the level at which all frames end while events go on, else usual.

    Frames also end where the scene has nothing brighter. Events tell which it is: pixels at that level are clipped if
    events go on there, by thresholds that are estimated as if it were the saturation.

    Returns
    -------
    The settings, and the level at which frames are clipped, if that was found.
    """
    camera = settings.camera
    usual = altered(settings, "camera", saturation=camera.clipped_from)
    if camera.saturation is not None or not settings.filter.joins_frames:
        return usual, None
    end = exact_end(recording, camera.usual_saturation)
    if end is None:
        return usual, None
    clipped = altered(settings, "camera", saturation=camera.usual_saturation * end)
    known = with_event_steps(recording, clipped).settings
    found = find_ceiling(recording, known.camera, known.events)
    return (clipped, found) if found is not None and found.is_at(end) else (usual, None)
