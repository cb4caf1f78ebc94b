"""kalux's own HDF5 layout, described in ``docs/formats.md``: everything a `Source` can hold but triggers."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux import memory
from kalux.compiled import event_words, loop
from kalux.errors import FormatError, InputError
from kalux.events import EVENT_DTYPE, EventArray, checked_thresholds
from kalux.frames import MOSAICS, Frame, GroundTruth, Mosaic
from kalux.layouts import HDF5_COLUMNS, HDF5_MAJOR_VERSION
from kalux.readers.hdf5_layout import DAMAGE, SIGNATURE, check_dataset, common_length, library, opened
from kalux.readers.source import (
    CHUNK_EVENTS,
    EXPOSURE_UNKNOWN,
    NO_EVENTS,
    NO_FRAMES,
    SeekableEvents,
    Source,
    begins_with,
    checked_inverse_covariance,
)

_EVENT_COLUMNS: Final = tuple(f"events/{name}" for name in HDF5_COLUMNS)
_EXPOSURES: Final = ("frames/exposure_start", "frames/exposure_end")
_GAINS: Final = "frames/gain"
_TIMES: Final = ("events/t", *_EXPOSURES)


def recognises(path: Path) -> bool:
    """Whether it is an HDF5 file that says it is kalux's, or one too damaged to say."""
    if not begins_with(path, SIGNATURE):
        return False
    try:
        with library().File(path, "r") as file:
            return _text(file.attrs.get("format", "")) == "kalux"
    except (OSError, *DAMAGE):
        return True


def read(path: Path) -> Source:
    """Open a kalux HDF5 file.

    Raises
    ------
    FormatError
        If it is cut short or damaged, or was written by a newer, incompatible kalux.
    InputError
        If it cannot be read.
    """
    with opened(path) as file:
        _check_version(path, _text(file.attrs.get("version", "")))
        event_count = common_length(path, file, _EVENT_COLUMNS)
        gains = (_GAINS,) if _GAINS in file else ()
        frame_count = common_length(path, file, ("frames/image", *_EXPOSURES, *gains))
        for column in (*_EVENT_COLUMNS, *_EXPOSURES):
            _check_column(path, column, file[column].dtype)
        _check_masks(path, file, frame_count)
        exposure_known = bool(file["frames"].attrs["exposure_known"])
        sensor_size = _sensor_size(path, file.attrs["sensor_size"])
        mosaic = _mosaic(path, file["frames"].attrs.get("mosaic"))
        inverse_covariance = (
            checked_inverse_covariance(path, "inverse_covariance", file["inverse_covariance"][...])
            if "inverse_covariance" in file
            else None
        )
        has_ground_truth = "ground_truth" in file
        response = _text(file["frames"].attrs["response"]) if "response" in file["frames"].attrs else None
        contrast_threshold = _thresholds(path, file.attrs.get("contrast_threshold"))
    missing: tuple[str, ...] = ()
    if not event_count:
        missing += (NO_EVENTS,)
    if not frame_count:
        missing += (NO_FRAMES,)
    elif not exposure_known:
        missing += (EXPOSURE_UNKNOWN,)
    return Source(
        path=path,
        format="kalux",
        sensor_size=sensor_size,
        events=SeekableEvents(lambda: _events(path), lambda t: _events(path, t)),
        frames=lambda: _frames(path),
        count_events=lambda: event_count,
        count_frames=lambda: frame_count,
        exposure_known=exposure_known,
        contrast_threshold=contrast_threshold,
        inverse_covariance=inverse_covariance,
        ground_truth=(lambda: _ground_truth(path)) if has_ground_truth else None,
        response=response,
        missing=missing,
        mosaic=mosaic,
    )


def _sensor_size(path: Path, value: Any) -> tuple[int, int]:
    sides = np.ravel(value).tolist()
    if len(sides) != 2 or not all(
        isinstance(side, (int, float)) and float(side).is_integer() for side in sides
    ):
        raise FormatError(
            f"{path}: states the sensor size {sides}; whole numbers, height and width, are needed"
        )
    return int(sides[0]), int(sides[1])


def _thresholds(path: Path, value: Any) -> tuple[float, float] | None:
    try:
        return checked_thresholds(value)
    except InputError as error:
        raise FormatError(f"{path}: {error}") from error


def _check_column(path: Path, column: str, found: np.dtype[Any]) -> None:
    """What other programs write may be of any type of integers; `_as_stated` then looks at the values."""
    wanted = EVENT_DTYPE["t" if column in _TIMES else column[-1]]
    if found.kind not in ("biu" if wanted.kind == "b" else "iu"):
        unit = ", in whole microseconds" if column in _TIMES else ""
        raise FormatError(f"{path}: {column} is {found}; {wanted} is needed{unit}")


def _as_stated(path: Path, name: str, values: NDArray[Any]) -> NDArray[Any]:
    """A column of events in the type of the layout."""
    wanted = EVENT_DTYPE[name]
    if values.dtype == wanted:
        return values
    if name == "p":
        if values.dtype.kind != "b" and len(values) and not -1 <= int(values.min()) <= int(values.max()) <= 1:
            raise FormatError(
                f"{path}: events/p has values from {values.min()} to {values.max()}; 0 and 1, or -1 and 1, are needed"
            )
        return values > 0
    limits = np.iinfo(wanted)
    if len(values) and not limits.min <= int(values.min()) <= int(values.max()) <= limits.max:
        raise FormatError(
            f"{path}: events/{name} has values from {values.min()} to {values.max()}; {wanted} is needed"
        )
    return values.astype(wanted)


def _mosaic(path: Path, value: Any) -> Mosaic | None:
    name = None if value is None else _text(value)
    if name is None or name in MOSAICS:
        return name
    raise FormatError(
        f"{path}: states the mosaic {name[:20]!r}; known are {', '.join(MOSAICS)}; write it again"
    )


def _check_masks(path: Path, file: Any, frame_count: int) -> None:
    """Masks need not be stored in full: of frames without one all pixels are valid, which is what fills them."""
    if "frames/valid" in file and len(file["frames/valid"]) != frame_count:
        raise FormatError(
            f"{path}: there are {len(file['frames/valid'])} masks of valid pixels for {frame_count} frames; write it "
            "again"
        )


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _check_version(path: Path, version: str) -> None:
    major = version.split(".")[0]
    if not major.isdigit():
        raise FormatError(f"{path}: states no version of the kalux layout ({version!r}); write it again")
    if int(major) > HDF5_MAJOR_VERSION:
        raise FormatError(
            f"{path}: has version {version} of the kalux layout, this kalux reads up to {HDF5_MAJOR_VERSION}.x; "
            "update kalux"
        )


def _events(path: Path, since: int | None = None) -> Iterator[EventArray]:
    """All events, or those of the file's chunks that hold all ``since`` a time, us."""
    with opened(path) as file:
        columns = [file["events"][name] for name in HDF5_COLUMNS]
        # Whole chunks of the file: reading across their borders decompresses each twice.
        stored = (columns[0].chunks or (CHUNK_EVENTS,))[0]
        step = max(CHUNK_EVENTS // stored, 1) * stored
        buffers = [np.empty(min(stored, len(column)), column.dtype) for column in columns]
        spaces = [column.id.get_space() for column in columns]
        kinds = [column.id.get_type() for column in columns]
        first = 0 if since is None else _chunk_of(columns[0], stored, since) * stored
        for start in range(first, len(columns[0]), step):
            events: EventArray = memory.empty((min(step, len(columns[0]) - start),), EVENT_DTYPE)
            # One by one: other threads that read HDF5 wait meanwhile.
            for place in range(0, len(events), stored):
                part = events[place : place + stored]
                here = library().h5s.create_simple((len(part),))
                for column, space, kind, buffer in zip(columns, spaces, kinds, buffers, strict=True):
                    space.select_hyperslab((start + place,), (len(part),))
                    column.id.read(here, space, buffer, kind)
                t, x, y, p = (
                    _as_stated(path, name, buffer[: len(part)])
                    for name, buffer in zip(HDF5_COLUMNS, buffers, strict=True)
                )
                _join(t, x, y, p, event_words(part))
            yield events


def _chunk_of(times: Any, stored: int, t: int) -> int:
    """The chunk of the file, of ``stored`` events each, that holds the first one not before ``t``."""
    chunks = range(-(-len(times) // stored))
    return max(bisect_left(chunks, t, key=lambda chunk: int(times[chunk * stored])) - 1, 0)


@loop
def _join(t, x, y, p, words):  # type: ignore[no-untyped-def]
    """Events of columns that are at least as long. NumPy would go over their memory once for every column."""
    for i in range(len(words)):
        words[i, 0] = t[i]
        words[i, 1] = np.int64(x[i]) | np.int64(y[i]) << 16 | np.int64(p[i]) << 32


def _frames(path: Path) -> Iterator[Frame]:
    with opened(path) as file:
        group = file["frames"]
        white = float(group.attrs["white"]) if "white" in group.attrs else None
        black = float(group.attrs.get("black", 0.0))
        starts, ends = group["exposure_start"][...], group["exposure_end"][...]
        images, masks = group["image"], group.get("valid")
        gains = file[_GAINS][...] if _GAINS in file else np.ones(len(starts))
        for index, (start, end, gain) in enumerate(zip(starts, ends, gains, strict=True)):
            valid = None if masks is None else masks[index].astype(bool)
            yield Frame(images[index], start, end, white, valid=valid, black=black, gain=float(gain))


def _ground_truth(path: Path) -> GroundTruth:
    with opened(path) as file:
        group = file["ground_truth"]
        check_dataset(path, group["images"])
        times, images = group["times"][...].astype(np.int64), group["images"][...].astype(np.float32)
        masks = group["masks"][...].astype(bool) if "masks" in group else None
        noise = [float(value) for value in np.ravel(group.attrs.get("noise", ()))]
    if images.ndim != 3 or len(times) != len(images):
        raise FormatError(
            f"{path}: ground truth has {len(times)} times for {images.shape} images; write it again"
        )
    if masks is not None and masks.shape != images.shape:
        raise FormatError(
            f"{path}: ground truth has {masks.shape} masks for {images.shape} images; write it again"
        )
    if len(noise) not in (0, 2):
        raise FormatError(f"{path}: ground truth has a noise of {len(noise)} numbers, not 2; write it again")
    return GroundTruth(times, images, masks, (noise[0], noise[1]) if noise else None)
