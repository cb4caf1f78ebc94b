"""From an events-only recording and the frames of another camera to one recording: where, when, and in which pixels."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from kalux import readers
from kalux.calibration import triggers
from kalux.calibration.alignment import Alignment, align
from kalux.calibration.features import Matched, match_cameras
from kalux.calibration.offset import RANGE, SURE, Correlation, aligned_stretch, correlate, frame_changes
from kalux.calibration.registration import Registration, require_overlap
from kalux.calibration.rig import Lens, Rig
from kalux.errors import InputError
from kalux.events import EventArray
from kalux.frames import Frame, Stamp
from kalux.models.camera import Camera
from kalux.readers import READERS, Source, joined
from kalux.readers.source import size_needed
from kalux.recording import Recording
from kalux.settings import CameraSettings

Homography = Literal["rig", "refine", "auto"]


class Registered(NamedTuple):
    """How the frames of one camera become those of another.

    Attributes
    ----------
    registration
        In space.
    offset, standard_error
        In time, us: to be added to the frames' times; 0 error where it was given.
    coarse
        The search for the offset; None where it was given.
    matched
        The features found; None where a rig was given and used.
    alignment
        The fit; None where nothing was left to fit.
    camera
        Response of the frames.
    """

    registration: Registration
    offset: float
    standard_error: float
    coarse: Correlation | None
    matched: Matched | None
    alignment: Alignment | None
    camera: Camera

    def frames(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The frames in the events' clock and pixels, with the mask of those that are measured."""
        shift = round(self.offset)
        for index, frame in enumerate(frames):
            warped = self.registration.frame(frame, index=index, camera=self.camera)
            yield dataclasses.replace(
                warped,
                exposure_start=warped.exposure_start + shift,
                exposure_end=warped.exposure_end + shift,
            )


def open_frames(
    path: Path,
    *,
    start: int | None = None,
    rate_hz: float | None = None,
    exposure: int | None = None,
    stamp: Stamp = "start",
) -> Recording:
    """The frames of a second camera, of any size: image folder, video, or any recording with frames.

    Arguments are those of `kalux.open` (``start`` and ``rate_hz`` as its ``frames_start`` and ``frames_rate``).

    Raises
    ------
    InputError, FormatError
        If there are none, or they cannot be read.
    """
    known = path.exists() and any(reader.recognises(path) for reader in READERS)
    source: Source = readers.read(path) if known else joined.open_frames(path, start=start, rate_hz=rate_hz)
    if known and (start is not None or rate_hz is not None):
        raise InputError(f"{path}: has its own times; a start and a rate are for videos")
    if not source.count_frames():
        raise InputError(f"{path}: has no frames")
    return Recording(source, exposure=exposure, stamp=stamp)


def events_size(events: Recording, rig: Rig | None) -> tuple[int, int]:
    """(height, width) of the event camera: what the recording states, else what the rig does, if that holds all events.

    Raises
    ------
    InputError
        If the recording has events outside the rig's event camera.
    """
    source = events.source
    if rig is None or source.sensor_size_known:
        return events.sensor_size
    size = rig.events.sensor_size
    least = size_needed(source, size)
    if least is not None:
        raise InputError(
            f"{source.path}: has events of a sensor of {least[1]}x{least[0]} pixels at least, the rig's event camera "
            f"has {size[1]}x{size[0]}; is the rig file that of this camera?"
        )
    return size


def triggered(
    events: Recording,
    frames: Recording,
    *,
    edge: triggers.Edge = "both",
    exposure: int | None = None,
    input_id: int | None = None,
    skip_triggers: int | None = None,
    skip_frames: int | None = None,
) -> tuple[Callable[[], Iterator[Frame]], tuple[str, ...]]:
    """Frames with the exposures that the event camera's trigger input saw, and what was assumed.

    Raises
    ------
    ExposureError
        If the triggers do not give one exposure per frame; see `kalux.calibration.triggers`.
    InputError
        If the format of the events has no triggers.
    """
    source = events.source
    if source.triggers is None:
        raise InputError(f"{source.path}: its format ({source.format}) has no trigger events")
    starts, ends, notes = triggers.exposures(
        source.triggers(), edge=edge, exposure=exposure, input_id=input_id
    )
    stamps = [frame.exposure_start for frame in frames.stamped_frames()]
    # Times that are the same for all frames are none.
    known = len(set(stamps)) > 1
    matched = triggers.match(
        starts,
        ends,
        np.array(stamps, np.int64) if known else None,
        len(stamps),
        skip_triggers=skip_triggers,
        skip_frames=skip_frames,
    )

    def again() -> Iterator[Frame]:
        for index, frame in enumerate(frames.stamped_frames()):
            k = index - matched.first_frame
            if 0 <= k < len(matched.starts):
                yield dataclasses.replace(
                    frame, exposure_start=int(matched.starts[k]), exposure_end=int(matched.ends[k])
                )

    return again, notes + matched.notes


def register(
    frames: Callable[[], Iterable[Frame]],
    events: Callable[[], Iterable[EventArray]],
    *,
    events_size: tuple[int, int],
    frames_size: tuple[int, int],
    rig: Rig | None = None,
    distance: float | None = None,
    homography: Homography | None = None,
    offset: float | None = None,
    centre: float = 0.0,
    reach: int = RANGE,
    camera: CameraSettings | None = None,
) -> Registered:
    """Find where in the event camera's image, and when in its clock, frames were taken.

    Parameters
    ----------
    frames, events
        Called for fresh iterators.
    events_size, frames_size
        (height, width) of both cameras.
    rig, distance
        Calibration, and how far the scene is away, m (None: infinitely far).
    homography
        ``"rig"``: as calibrated. ``"refine"``: from there to where frames and events agree best (the default with a
        rig). ``"auto"``: from features, then the same (the default without one; with one, only its lenses are used).
    offset
        us, to be added to the frames' times, where it is known (0 with triggers). None: estimated.
    centre, reach
        us: where the offset is looked for.
    camera
        Response and I_0 of the frames.

    Raises
    ------
    InputError
        If cameras and rig do not fit together, or no registration or offset can be told from the recording.
    EventError
        If an event that is looked at lies outside the event camera.
    """
    camera = camera if camera is not None else CameraSettings()
    model = Camera.named(camera.response, camera.clipped_from)
    if rig is None and (homography in ("rig", "refine") or distance is not None):
        raise InputError("register: without a rig file there is no pose and no use for a distance")
    chosen = homography or ("auto" if rig is None else "refine")
    lenses = Lens.pinhole(events_size), Lens.pinhole(frames_size)
    first: Registration | None = None
    if rig is not None:
        lenses = rig.events, rig.frames
        _check_size(rig.events, events_size, "event")
        _check_size(rig.frames, frames_size, "frame")
        if chosen != "auto":
            first = Registration.of_rig(rig, distance)
            require_overlap(first)
    if chosen == "rig" and offset is not None:
        assert first is not None
        return Registered(first, offset, 0.0, None, None, None, model)
    changes = frame_changes(frames(), first, camera)
    coarse = None
    if offset is None:
        coarse = correlate(changes, events(), events_size, centre=centre, reach=reach)
        _require_sure(coarse)
    begin = offset if coarse is None else coarse.offset
    assert begin is not None
    shots, inside = aligned_stretch(frames, events, changes, events_size, begin, camera)
    matched = match_cameras(shots, inside, *lenses, begin) if first is None else None
    guess = first if matched is None else matched.registration
    assert guess is not None
    found = align(
        shots,
        inside,
        guess,
        offset=begin,
        free_homography=chosen != "rig",
        free_offset=offset is None,
    )
    require_overlap(found.registration)
    return Registered(found.registration, found.offset, found.standard_error, coarse, matched, found, model)


def _check_size(lens: Lens, size: tuple[int, int], name: str) -> None:
    if lens.sensor_size != size:
        raise InputError(
            f"register: the rig's {name} camera has {lens.sensor_size[1]}x{lens.sensor_size[0]} pixels, the "
            f"recording's {size[1]}x{size[0]}"
        )


def _require_sure(found: Correlation) -> None:
    if not found.sure:
        raise InputError(
            "register: the frames' clock cannot be told from the recording: the correlation is "
            f"{found.peak:.2f} at {found.offset * 1e-3:.1f} ms, {found.ratio:.2f} times the next "
            f"peak ({SURE} is needed); shake the rig unevenly, narrow the search (--range), or give --offset"
        )
