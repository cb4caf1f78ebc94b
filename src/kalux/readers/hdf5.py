"""kalux's own HDF5 layout, described in ``docs/formats.md``: everything a `Source` can hold."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypeVar

import h5py
import hdf5plugin
import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux import memory
from kalux.compiled import event_words
from kalux.errors import FormatError, FrameError, OutputError
from kalux.events import EVENT_DTYPE, EventArray
from kalux.frames import MOSAICS, Frame, Mosaic
from kalux.readers.hdf5_layout import DAMAGE, SIGNATURE
from kalux.readers.source import CHUNK_EVENTS, GroundTruth, Source, begins_with, one_line, reading

T = TypeVar("T")
MAJOR_VERSION: Final = 1
"""Files with a greater major version are refused; a minor version only adds."""

_VERSION: Final = f"{MAJOR_VERSION}.1"
_EVENTS_PER_CHUNK: Final = 1 << 17
_COLUMNS: Final = ("t", "x", "y", "p")


def recognises(path: Path) -> bool:
    """Whether it is an HDF5 file that says it is kalux's, or one too damaged to say."""
    if not begins_with(path, SIGNATURE):
        return False
    try:
        with h5py.File(path, "r") as file:
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
    with reading(path, *DAMAGE), h5py.File(path, "r") as file:
        _check_version(path, _text(file.attrs.get("version", "")))
        event_count = _common_length(path, file, "events", _COLUMNS)
        frame_count = _common_length(path, file, "frames", _frame_columns(file))
        exposure_known = bool(file["frames"].attrs["exposure_known"])
        height, width = (int(n) for n in file.attrs["sensor_size"])
        mosaic = _mosaic(path, file["frames"].attrs.get("mosaic"))
        threshold = file.attrs.get("contrast_threshold")
        inverse_covariance = file["inverse_covariance"][...] if "inverse_covariance" in file else None
        has_ground_truth = "ground_truth" in file
        response = _text(file["frames"].attrs["response"]) if "response" in file["frames"].attrs else None
        contrast_threshold = None if threshold is None else (float(threshold[0]), float(threshold[1]))
    missing: tuple[str, ...] = ()
    if not event_count:
        missing += ("The file has no events.",)
    if not frame_count:
        missing += ("The file has no frames.",)
    elif not exposure_known:
        missing += ("The exposure times of the frames are not recorded.",)
    return Source(
        path=path,
        format="kalux",
        sensor_size=(height, width),
        events=lambda: _events(path),
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


def _mosaic(path: Path, value: Any) -> Mosaic | None:
    name = None if value is None else _text(value)
    if name is None or name in MOSAICS:
        return name
    raise FormatError(
        f"{path}: states the mosaic {name[:20]!r}; known are {', '.join(MOSAICS)}; write it again"
    )


def _frame_columns(file: Any) -> tuple[str, ...]:
    columns = ("image", "exposure_start", "exposure_end")
    return (*columns, "valid") if "valid" in file["frames"] else columns


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _check_version(path: Path, version: str) -> None:
    major = version.split(".")[0]
    if not major.isdigit():
        raise FormatError(f"{path}: states no version of the kalux layout ({version!r}); write it again")
    if int(major) > MAJOR_VERSION:
        raise FormatError(
            f"{path}: has version {version} of the kalux layout, this kalux reads up to {MAJOR_VERSION}.x; "
            "update kalux"
        )


def _common_length(path: Path, file: Any, group: str, names: tuple[str, ...]) -> int:
    lengths = {name: len(file[group][name]) for name in names}
    if len(set(lengths.values())) != 1:
        found = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise FormatError(
            f"{path}: {group} have columns of different lengths ({found}); write the file again"
        )
    return next(iter(lengths.values()))


def _events(path: Path) -> Iterator[EventArray]:
    with reading(path, *DAMAGE), h5py.File(path, "r") as file:
        columns = [file["events"][name] for name in _COLUMNS]
        # Whole chunks of the file: reading across their borders decompresses each twice.
        stored = (columns[0].chunks or (CHUNK_EVENTS,))[0]
        step = max(CHUNK_EVENTS // stored, 1) * stored
        buffers = [np.empty(min(stored, len(column)), column.dtype) for column in columns]
        spaces = [column.id.get_space() for column in columns]
        kinds = [column.id.get_type() for column in columns]
        for start in range(0, len(columns[0]), step):
            events: EventArray = memory.empty((min(step, len(columns[0]) - start),), EVENT_DTYPE)
            # One by one: other threads that read HDF5 wait meanwhile.
            for first in range(0, len(events), stored):
                part = events[first : first + stored]
                here = h5py.h5s.create_simple((len(part),))
                for column, space, kind, buffer in zip(columns, spaces, kinds, buffers, strict=True):
                    space.select_hyperslab((start + first,), (len(part),))
                    column.id.read(here, space, buffer, kind)
                t, x, y, p = (
                    buffer.astype(EVENT_DTYPE[name], copy=False)
                    for name, buffer in zip(_COLUMNS, buffers, strict=True)
                )
                _join(t, x, y, p, event_words(part))
            yield events


@nb.njit(cache=True, nogil=True)
def _join(t, x, y, p, words):  # type: ignore[no-untyped-def]
    """Events of columns that are at least as long. NumPy would go over their memory once for every column."""
    for i in range(len(words)):
        words[i, 0] = t[i]
        words[i, 1] = np.int64(x[i]) | np.int64(y[i]) << 16 | np.int64(p[i]) << 32


def _frames(path: Path) -> Iterator[Frame]:
    with reading(path, *DAMAGE), h5py.File(path, "r") as file:
        group = file["frames"]
        white = float(group.attrs["white"]) if "white" in group.attrs else None
        starts, ends = group["exposure_start"][...], group["exposure_end"][...]
        images, masks = group["image"], group.get("valid")
        for index, (start, end) in enumerate(zip(starts, ends, strict=True)):
            valid = None if masks is None else masks[index].astype(bool)
            yield Frame(images[index], int(start), int(end), white, valid=valid)


def _ground_truth(path: Path) -> GroundTruth:
    with reading(path, *DAMAGE), h5py.File(path, "r") as file:
        group = file["ground_truth"]
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


class TruthStream(NamedTuple):
    """Reference images that are made while they are written, for memory that does not grow with their number.

    Attributes
    ----------
    times
        (T,) int64 us.
    images
        As many images (height, width) float32, as of `GroundTruth`.
    """

    times: NDArray[np.int64]
    images: Iterable[NDArray[np.float32]]


def write(
    path: str | Path,
    *,
    sensor_size: tuple[int, int],
    events: Iterable[EventArray],
    frames: Iterable[Frame],
    exposure_known: bool = True,
    contrast_threshold: tuple[float, float] | None = None,
    inverse_covariance: NDArray[np.float64] | None = None,
    ground_truth: GroundTruth | TruthStream | None = None,
    mosaic: Mosaic | None = None,
    response: str | None = None,
) -> None:
    """Write a recording, chunk by chunk, in bounded memory.

    The file appears under its name only when it is complete.

    Parameters
    ----------
    path
        Replaced if it exists.
    sensor_size
        (height, width), pixels.
    events
        Chunks of `EVENT_DTYPE` in time order, of any length.
    frames
        In time order, of one dtype, shape and white value.
    exposure_known
        Whether the frames carry their exposure, or only a stamp (start and end equal).
    contrast_threshold
        (on, off), log intensity.
    inverse_covariance
        (256,) 1 / R_bar per 8-bit value, 1/s.
    ground_truth
        Reference images, or a stream of them.
    mosaic
        The sensor's Bayer pattern. Default: that of the frames.
    response
        Of the frame camera, named as in `kalux.settings.CameraSettings`.

    Raises
    ------
    FrameError
        If frames differ in dtype, size or white value.
    OutputError
        If the file cannot be written.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with _Sink(partial) as sink:
            # Of all layouts of HDF5, this one has a checksum on every piece of metadata, except on strings of
            # variable length: damage is then reported, where HDF5 otherwise may crash or never return.
            with h5py.File(sink, "w", libver=("v110", "v110")) as file:
                file.attrs["format"] = np.bytes_("kalux")
                file.attrs["version"] = np.bytes_(_VERSION)
                file.attrs["sensor_size"] = sensor_size
                if contrast_threshold is not None:
                    file.attrs["contrast_threshold"] = contrast_threshold
                if inverse_covariance is not None:
                    file["inverse_covariance"] = np.asarray(inverse_covariance, np.float64)
                if ground_truth is not None:
                    images = sink.checked(iter(ground_truth.images))
                    group = file.create_group("ground_truth")
                    _write_ground_truth(group, ground_truth.times, images, sensor_size)
                    if isinstance(ground_truth, GroundTruth):
                        if ground_truth.masks is not None:
                            _write_masks(group, ground_truth.masks)
                        if ground_truth.noise is not None:
                            group.attrs["noise"] = ground_truth.noise
                _write_events(file.create_group("events"), sink.checked(events))
                if response is not None:
                    file.create_group("frames").attrs["response"] = np.bytes_(response)
                _write_frames(
                    file.require_group("frames"), sink.checked(frames), sensor_size, exposure_known, mosaic
                )
            sink.check()
        os.replace(partial, path)
    except OSError as error:
        reason = one_line(error) if error.errno is None else os.strerror(error.errno)
        raise OutputError(f"{path}: cannot be written: {reason}") from error
    finally:
        with contextlib.suppress(OSError):  # also of a name that is too long
            partial.unlink(missing_ok=True)


class _Sink(io.FileIO):
    """A file whose failures are reported by `check`, not to HDF5: it crashes when a disk is full."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self._error: OSError | None = None

    def write(self, data: Any, /) -> int:
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view) and self._error is None:
            try:
                done += super().write(view[done:])
            except OSError as error:
                self._error = error
        return len(view)

    def readinto(self, buffer: Any, /) -> int:
        view = memoryview(buffer).cast("B")
        got = super().readinto(view) or 0
        view[got:] = bytes(len(view) - got)
        return len(view)

    def truncate(self, size: int | None = None, /) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self._error = self._error or error
            return self.tell() if size is None else size

    def flush(self) -> None:
        """Nothing is buffered. h5py calls this while it handles other errors, and then finds no inherited method."""

    def check(self) -> None:
        if self._error is not None:
            raise self._error

    def checked(self, items: Iterable[T]) -> Iterator[T]:
        """The same items, as long as the file takes them.

        Ends early rather than raise: an error on its way through an open h5py file disturbs its closing.
        """
        for item in items:
            if self._error is not None:
                return
            yield item


def _packing(
    codec: Literal["zstd", "lz4", "lz4hc"] = "zstd", level: int = 3, *, bits: bool = False
) -> dict[str, Any]:
    """Compression of bytes or ``bits`` of one significance together; with a checksum, which Blosc lacks."""
    shuffle = hdf5plugin.Blosc.BITSHUFFLE if bits else hdf5plugin.Blosc.SHUFFLE
    return {"fletcher32": True, **hdf5plugin.Blosc(cname=codec, clevel=level, shuffle=shuffle)}


def _event_packing(column: str) -> dict[str, Any]:
    """As small as zstd packs them (3 % more or less), and faster: a third in reading, a tenth to a half in writing."""
    return _packing("lz4hc", 5) if column == "t" else _packing("lz4", 9, bits=True)


def _write_events(group: Any, chunks: Iterable[EventArray]) -> None:
    columns = {
        name: group.create_dataset(
            name,
            (0,),
            EVENT_DTYPE[name],
            maxshape=(None,),
            chunks=(_EVENTS_PER_CHUNK,),
            **_event_packing(name),
        )
        for name in _COLUMNS
    }
    count = 0
    for events in _aligned(chunks):
        for name, column in columns.items():
            column.resize((count + len(events),))
            column[count:] = events[name]
        count += len(events)


def _aligned(chunks: Iterable[EventArray]) -> Iterator[EventArray]:
    """The same events in whole chunks of the file, so that each is compressed once."""
    held: list[EventArray] = []
    count = 0
    for chunk in chunks:
        held.append(chunk)
        count += len(chunk)
        if count >= _EVENTS_PER_CHUNK:
            joined = np.concatenate(held)
            whole = count - count % _EVENTS_PER_CHUNK
            yield joined[:whole]
            held, count = [joined[whole:].copy()], count - whole
    if count:
        yield np.concatenate(held)


def _write_frames(
    group: Any,
    frames: Iterable[Frame],
    sensor_size: tuple[int, int],
    exposure_known: bool,
    mosaic: Mosaic | None,
) -> None:
    group.attrs["exposure_known"] = exposure_known
    images = masks = None
    starts: list[int] = []
    ends: list[int] = []
    for index, frame in enumerate(frames):
        if images is None:
            images = _create_images(group, frame.image.shape, frame.image.dtype)
            first = frame
            if frame.white is not None:
                group.attrs["white"] = frame.white
            mosaic = mosaic or frame.mosaic
        if _kind(frame) != _kind(first):
            raise FrameError(
                f"frame {index} has another size, dtype, mosaic or white value than frame 0; the file holds one of each"
            )
        images.resize(index + 1, axis=0)
        images[index] = frame.image
        if frame.valid is not None:
            if masks is None:  # of frames without a mask all pixels are valid
                masks = _create_images(group, frame.valid.shape, np.dtype(bool), "valid", fill=True)
            masks.resize(index + 1, axis=0)
            masks[index] = frame.valid
        starts.append(frame.exposure_start)
        ends.append(frame.exposure_end)
    if images is None:
        _create_images(group, sensor_size, np.dtype(np.uint8))
    if mosaic is not None:
        group.attrs["mosaic"] = np.bytes_(mosaic)
    if masks is not None:
        masks.resize(len(starts), axis=0)
    group["exposure_start"] = np.array(starts, np.int64)
    group["exposure_end"] = np.array(ends, np.int64)


def _kind(frame: Frame) -> tuple[Any, ...]:
    return frame.image.shape, frame.image.dtype, frame.white, frame.mosaic


def _create_images(
    group: Any, size: tuple[int, ...], dtype: np.dtype[Any], name: str = "image", *, fill: bool = False
) -> Any:
    return group.create_dataset(
        name, (0, *size), dtype, maxshape=(None, *size), chunks=(1, *size), fillvalue=fill, **_packing()
    )


def _write_ground_truth(
    group: Any, times: NDArray[np.int64], images: Iterable[NDArray[Any]], sensor_size: tuple[int, int]
) -> None:
    group["times"] = np.asarray(times, np.int64)
    stored = group.create_dataset(
        "images",
        (len(times), *sensor_size),
        np.float32,
        maxshape=(None, *sensor_size),
        chunks=(1, *sensor_size),
        **_packing(),
    )
    for index, image in enumerate(images):
        stored[index] = image


def _write_masks(group: Any, masks: NDArray[np.bool_]) -> None:
    group.create_dataset(
        "masks", data=masks, maxshape=(None, *masks.shape[1:]), chunks=(1, *masks.shape[1:]), **_packing()
    )
