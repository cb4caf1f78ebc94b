"""kalux's own HDF5 layout, described in ``docs/formats.md``; the counterpart of `kalux.readers.hdf5`."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypeVar

import h5py
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

from kalux.errors import FrameError
from kalux.events import EVENT_DTYPE, EventArray
from kalux.frames import Frame, GroundTruth, Mosaic
from kalux.interrupts import interrupts_held
from kalux.layouts import HDF5_COLUMNS, HDF5_VERSION
from kalux.writers.files import output_errors, replacing

T = TypeVar("T")

_EVENTS_PER_CHUNK: Final = 1 << 17


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

    The file appears under its name only when it is complete. An interrupt (Ctrl-C) waits while HDF5 is at work, which
    it would crash: at most for the chunk, frame or image that is being written.

    Parameters
    ----------
    path
        Replaced if it exists.
    sensor_size
        (height, width), pixels.
    events
        Chunks of `EVENT_DTYPE` in time order, of any length.
    frames
        In time order, of one dtype, shape, white and black value.
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
        If frames differ in dtype, size, white or black value.
    OutputError
        If the file cannot be written.
    """
    path = Path(path)
    with (
        interrupts_held(done=f"{path} was finished, and is whole") as allowed,
        output_errors(path),
        replacing(path) as temporary,
        _Sink(temporary, allowed) as sink,
    ):
        # Of all layouts of HDF5, this one has a checksum on every piece of metadata, except on strings of
        # variable length: damage is then reported, where HDF5 otherwise may crash or never return.
        with h5py.File(sink, "w", libver=("v110", "v110")) as file:
            file.attrs["format"] = np.bytes_("kalux")
            file.attrs["version"] = np.bytes_(HDF5_VERSION)
            file.attrs["sensor_size"] = sensor_size
            if contrast_threshold is not None:
                file.attrs["contrast_threshold"] = contrast_threshold
            if inverse_covariance is not None:
                file["inverse_covariance"] = np.asarray(inverse_covariance, np.float64)
            if ground_truth is not None:
                images = sink.checked(ground_truth.images)
                _write_ground_truth(file.create_group("ground_truth"), ground_truth, images, sensor_size)
            _write_events(file.create_group("events"), sink.checked(events))
            group = file.create_group("frames")
            if response is not None:
                group.attrs["response"] = np.bytes_(response)
            _write_frames(group, sink.checked(frames), sensor_size, exposure_known, mosaic)
        sink.check()
        with allowed():
            pass


class _Sink(io.FileIO):
    """A file whose failures are reported by `check`, not to HDF5: it crashes when a disk is full.

    ``allowed`` is of `interrupts_held`: an interrupt in `write` would crash HDF5, too, or leave a file with a hole.
    """

    def __init__(self, path: Path, allowed: Callable[[], AbstractContextManager[None]]) -> None:
        super().__init__(path, "w+")
        self._allowed = allowed
        self._error: OSError | None = None
        self._not_made: BaseException | None = None

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
        if self._not_made is not None:
            raise self._not_made

    def checked(self, items: Iterable[T]) -> Iterator[T]:
        """The same items, as long as they can be made and the file takes them; interrupts are allowed in their making.

        Ends early rather than raise: an error on its way through an open h5py file disturbs its closing.
        """
        iterator = iter(items)
        while self._error is None and self._not_made is None:
            try:
                with self._allowed():
                    item = next(iterator)
            except StopIteration:
                return
            except BaseException as error:
                self._not_made = error
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
        for name in HDF5_COLUMNS
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
    gains: list[float] = []
    for index, frame in enumerate(frames):
        if images is None:
            images = _create_images(group, frame.image.shape, frame.image.dtype)
            first = frame
            if frame.white is not None:
                group.attrs["white"] = frame.white
            if frame.black:
                group.attrs["black"] = float(frame.black)
            mosaic = mosaic or frame.mosaic
        if _kind(frame) != _kind(first):
            raise FrameError(
                f"frame {index} has another size, dtype, mosaic, white or black value than frame 0; the file holds one "
                "of each"
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
        gains.append(float(frame.gain))
    if images is None:
        _create_images(group, sensor_size, np.dtype(np.uint8))
    if mosaic is not None:
        group.attrs["mosaic"] = np.bytes_(mosaic)
    if masks is not None:
        masks.resize(len(starts), axis=0)
    group["exposure_start"] = np.array(starts, np.int64)
    group["exposure_end"] = np.array(ends, np.int64)
    if any(gain != 1.0 for gain in gains):
        group["gain"] = np.array(gains)


def _kind(frame: Frame) -> tuple[Any, ...]:
    return frame.image.shape, frame.image.dtype, frame.white, frame.black, frame.mosaic


def _create_images(
    group: Any,
    size: tuple[int, ...],
    dtype: np.dtype[Any],
    name: str = "image",
    *,
    count: int = 0,
    fill: bool = False,
) -> Any:
    return group.create_dataset(
        name, (count, *size), dtype, maxshape=(None, *size), chunks=(1, *size), fillvalue=fill, **_packing()
    )


def _write_ground_truth(
    group: Any,
    truth: GroundTruth | TruthStream,
    images: Iterable[NDArray[np.float32]],
    sensor_size: tuple[int, int],
) -> None:
    """Times, masks and noise of ``truth``; its ``images`` one by one."""
    group["times"] = np.asarray(truth.times, np.int64)
    stored = _create_images(group, sensor_size, np.dtype(np.float32), "images", count=len(truth.times))
    for index, image in enumerate(images):
        stored[index] = image
    if isinstance(truth, TruthStream):
        return
    if truth.masks is not None:
        masks = _create_images(group, sensor_size, np.dtype(bool), "masks", count=len(truth.masks))
        masks[:] = truth.masks
    if truth.noise is not None:
        group.attrs["noise"] = truth.noise
