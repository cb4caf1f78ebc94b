"""Frames from elsewhere, joined to the events of a recording: an image folder with times, or a video.

Times are in the clock of the events. A folder has a list of them (`kalux.readers.image_lists`); a video has a start and
a rate, which the user gives, because the times that a video states are rarely those of a camera.
"""

from __future__ import annotations

import csv
import dataclasses
import re
from collections.abc import Iterator
from functools import cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError, FrameError, InputError
from kalux.frames import Frame
from kalux.readers.image_lists import (
    WANTED,
    Listed,
    are_stamps,
    read_csv,
    read_ijrr,
    read_images_with_stamps,
    read_listed,
)
from kalux.readers.images import files_in_colour, load_image
from kalux.readers.source import EXPOSURE_UNKNOWN, SIZE_NOT_STATED, Source, on_sensor, reading, size_needed
from kalux.readers.videos import opened_video
from kalux.wording import how_many

if TYPE_CHECKING:
    from av.container import InputContainer

_LISTS: Final = ("frames.csv", "timestamps.csv", "images.txt", "timestamps.txt", "timestamp.txt")
_LARGEST_LIST: Final = 1 << 27  # bytes; it is read as a whole
_FIRST_PICTURES: Final = 10  # of a video, which tell whether it is in colour
_GREY_ROUNDING: Final = 0.03
_TRANSFERS: Final = {
    1: "bt709",
    4: "gamma:2.2",
    5: "gamma:2.8",
    6: "bt709",
    8: "linear",
    13: "srgb",
    14: "bt709",
    15: "bt709",
}
"""Responses by the number of a video's transfer characteristics (ITU-T H.273, table 3); 6, 14 and 15, of BT.601 and
BT.2020, are the curve of BT.709."""
_TRANSFER_NOT_STATED: Final = 2
_ABOUT_FRAMES: Final = re.compile(r"\b(frames?|images?)\b")


def join(source: Source, frames: Path, *, start: int | None, rate_hz: float | None, replace: bool) -> Source:
    """A recording with frames from elsewhere.

    Parameters
    ----------
    source
        The recording; its events stay as they are.
    frames
        A folder of images with `frames.csv`, `timestamps.csv`, `images.txt` or `timestamps.txt` (or that file itself);
        or a video.
    start, rate_hz
        For a video: the time of the first frame, us, in the clock of the events, and frames per second.
    replace
        Whether frames that the recording has itself are replaced; otherwise they are an error.

    Raises
    ------
    InputError
        If the recording has frames of its own, or start and rate are missing or have no use.
    FormatError
        If the frames cannot be read.
    FrameError
        If they have not the size of the sensor.
    """
    if not frames.exists():
        raise InputError(f"{frames}: no such file or folder")
    if not replace and source.count_frames():
        raise InputError(
            f"{source.path}: has {how_many(source.count_frames(), 'frame')} of its own; leave --frames out, "
            "or replace them with --replace-frames (replace_frames=True)"
        )
    joined = open_frames(frames, start=start, rate_hz=rate_hz)
    size = _joint_size(source, frames, joined)
    kept = (text for text in source.missing if not _ABOUT_FRAMES.search(text))
    adopted = not source.sensor_size_known
    placed = on_sensor(source, size) if adopted else source
    return dataclasses.replace(
        joined,
        path=source.path,
        format=f"{source.format} + {joined.format}",
        sensor_size=size,
        events=placed.events,
        count_events=source.count_events,
        contrast_threshold=source.contrast_threshold,
        ground_truth=source.ground_truth,
        triggers=source.triggers,
        lost=source.lost,
        missing=(
            *(text for text in kept if not (adopted and text.startswith(SIZE_NOT_STATED))),
            *joined.missing,
        ),
    )


def open_frames(frames: Path, *, start: int | None, rate_hz: float | None) -> Source:
    """Frames alone, of any size, as a recording without events; arguments and errors as of `join`."""
    if not frames.exists():
        raise InputError(f"{frames}: no such file or folder")
    return _images(frames, start, rate_hz) if _is_list(frames) else _video(frames, start, rate_hz)


def _joint_size(source: Source, frames: Path, joined: Source) -> tuple[int, int]:
    """The size of the frames, which must be that of the sensor; or hold all events, if that is not known."""
    height, width = source.sensor_size
    size = joined.sensor_size
    if size == (height, width):
        return size
    if not source.sensor_size_known:
        least = size_needed(source, size)
        if least is None:
            return size
        height, width = least
    needed = "is" if source.sensor_size_known else "is at least"
    raise FrameError(
        f"{frames}: its frames have {size[1]}x{size[0]} pixels, but the sensor of {source.path} {needed} "
        f"{width}x{height}; resize, crop or warp them to the events' pixels first"
    )


def _frames_only(place: Path, format: str, **found: Any) -> Source:
    """A source without events, which `join` takes from the recording."""
    return Source(path=place, format=format, events=lambda: iter(()), count_events=lambda: 0, **found)


# Images


def _is_list(frames: Path) -> bool:
    return frames.is_dir() or frames.suffix.lower() in (".csv", ".txt")


def _images(frames: Path, start: int | None, rate_hz: float | None) -> Source:
    if start is not None or rate_hz is not None:
        raise InputError(
            f"{frames}: --frames-start and --frames-rate are for a video; images have their own times"
        )
    path = _list_file(frames) if frames.is_dir() else frames
    with reading(path, UnicodeError, csv.Error):
        if path.stat().st_size > _LARGEST_LIST:
            raise FormatError(f"{path}: is too large for a list of images; {WANTED} is needed")
        text = path.read_text("utf-8-sig")
        missing: tuple[str, ...] = ()
        if are_stamps(text):
            listed, unit = read_images_with_stamps(path, text)
            missing = (unit,)
            exposure_known = False
        elif path.suffix.lower() == ".txt":
            images = read_ijrr(path, text, lambda name: (path.parent / name).is_file())
            listed = [Listed(path.parent / name, stamp, stamp) for stamp, name in images]
            exposure_known = False
        else:
            listed, exposure_known = read_csv(path, text)
    if not listed:
        raise FormatError(f"{path}: lists no images; {WANTED} is needed")
    absent = [image.file for image in listed if not image.file.is_file()]
    if absent:
        raise FormatError(
            f"{path}: {len(absent)} of {len(listed)} images are missing, the first is {absent[0]}"
        )
    colour = files_in_colour(frames, [image.file for image in listed])
    first = load_image(frames, listed[0].file, colour=colour)
    return _frames_only(
        frames,
        "images",
        sensor_size=first.shape[:2],
        frames=lambda: read_listed(frames, listed, colour=colour),
        count_frames=lambda: len(listed),
        exposure_known=exposure_known,
        missing=missing if exposure_known else (EXPOSURE_UNKNOWN, *missing),
    )


def _list_file(folder: Path) -> Path:
    with reading(folder):
        named = next((folder / name for name in _LISTS if (folder / name).is_file()), None)
        others = sorted(folder.glob("*.csv"))
    if named is not None:
        return named
    if len(others) != 1:
        found = f"{len(others)} CSV files" if others else "no list of times"
        raise FormatError(f"{folder}: has {found}; {WANTED} is needed")
    return others[0]


# Video


def _video(path: Path, start: int | None, rate_hz: float | None) -> Source:
    if start is None or rate_hz is None:
        raise InputError(
            f"{path}: a video needs the time of its first frame and its rate in the clock of the events; give "
            "--frames-start US and --frames-rate HZ (frames_start, frames_rate)"
        )
    if not 0 < rate_hz < 1e6:  # also refuses NaN
        raise InputError(f"{path}: the rate of the frames is {rate_hz} Hz; it must be between 0 and 1 MHz")
    if not float(start).is_integer():
        raise InputError(f"{path}: the first frame is at {start} us; whole microseconds are needed")
    start, rate_hz = int(start), float(rate_hz)  # NumPy's would wrap around, or be less exact
    beginning = list(islice(_pictures(path, colour=True), _FIRST_PICTURES))
    colour = any(map(_has_colour, beginning))
    first = next(iter(beginning), None)
    if first is None:
        raise FormatError(f"{path}: has no picture that can be decoded; copy or download it again")
    transfer, lossy = _coding(path)

    @cache
    def count_frames() -> int:
        return sum(1 for _ in _pictures(path, colour=False))

    def read_frames() -> Iterator[Frame]:
        for index, image in enumerate(_pictures(path, colour=colour)):
            stamp = start + round(index * 1e6 / rate_hz)
            yield Frame(image, stamp, stamp)

    return _frames_only(
        path,
        "video",
        sensor_size=first.shape[:2],
        frames=read_frames,
        count_frames=count_frames,
        exposure_known=False,
        response=_TRANSFERS.get(transfer),
        missing=(
            EXPOSURE_UNKNOWN,
            f"The frames are the {'colours' if colour else 'luma'} of a video, with whatever its encoder did to them.",
            *(() if transfer in _TRANSFERS else (_no_response(transfer),)),
        ),
        of_lossy_video=lossy,
    )


def _coding(path: Path) -> tuple[int, bool]:
    """How a video's pictures follow the light, as a number of ITU-T H.273, and whether its codec changes them.

    A codec that can do without, too, is taken to have changed them.
    """
    with opened_video(path) as container:
        context = container.streams.video[0].codec_context
        return int(context.color_trc), bool(context.codec.lossy)


def _no_response(transfer: int) -> str:
    if transfer == _TRANSFER_NOT_STATED:
        stated = "The video does not state how its pictures follow the light"
    else:
        stated = (
            f"The video states transfer characteristics {transfer} of ITU-T H.273, which kalux does not know"
        )
    return f"{stated}: they count as linear (--camera.response bt709 if a camera or an encoder gave them a tone curve)."


def _has_colour(picture: NDArray[Any]) -> bool:
    """Whether channels differ by more than the rounding of a grey picture in YUV."""
    if picture.ndim == 2:
        return False
    apart = picture.max(axis=-1).astype(np.int64) - picture.min(axis=-1)
    return bool(apart.max() > np.iinfo(picture.dtype).max * _GREY_ROUNDING)


def _pictures(path: Path, *, colour: bool) -> Iterator[NDArray[Any]]:
    """Each picture, uint8, or uint16 where it has more than 8 bits: red, green, blue if it has colours, or the luma."""
    with opened_video(path) as container:
        if not container.streams.video:
            raise FormatError(f"{path}: neither an image folder nor a video; {WANTED}, or a video is needed")
        stream = container.streams.video[0]
        count = 0
        for picture in container.decode(stream):
            deep = picture.format.components[0].bits > 8
            if colour and len(picture.format.components) >= 3:
                wanted = "rgb48le" if deep else "rgb24"
            else:
                wanted = "gray16le" if deep else "gray"
            yield np.ascontiguousarray(picture.to_ndarray(format=wanted))
            count += 1
        stated = _stated_count(container)
        if count < stated:
            raise FormatError(f"{path}: holds {count} of {stated} pictures; copy it again, or encode it anew")


def _stated_count(container: InputContainer) -> int:
    """How many pictures a video says that it shows; 0: it does not say.

    MP4 and MOV that were trimmed without encoding anew hold more than their edit list shows.
    """
    stream = container.streams.video[0]
    if stream.frames and "mp4" in container.format.name.split(","):
        return sum(not entry.is_discard for entry in stream.index_entries)
    return stream.frames
