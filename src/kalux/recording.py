"""A recording: sensor size, events and frames as bounded, time-ordered, checked streams."""

from __future__ import annotations

import copy
import dataclasses
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from itertools import islice
from numbers import Real
from pathlib import Path
from typing import Any, Final, Generic, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from kalux import readers
from kalux.compiled import event_column, event_row, event_words, loop
from kalux.errors import ExposureError, FormatError, FrameError, InputError, require_type
from kalux.event_slices import (
    counted,
    events_until,
    in_order,
    joined_events,
    whole_row_delays,
    with_delay_of_rows,
)
from kalux.events import (
    EVENT_DTYPE,
    LARGEST_SIDE,
    LATEST,
    EventArray,
    as_events,
    check_events,
    checked_size,
    checked_thresholds,
)
from kalux.frames import (
    GROUND_TRUTH_NEEDED,
    MOSAICS,
    Frame,
    GroundTruth,
    Mosaic,
    Stamp,
    check_colours,
    check_frame,
    exposure_doubt,
    is_white,
    median_exposure,
    place_exposure,
    repeats,
    require_frame,
    with_black_level,
)
from kalux.models.colour import sample_mosaic
from kalux.models.frame_pixels import without_stuck
from kalux.readers import CHUNK_EVENTS, Source, joined
from kalux.readers.source import SeekableEvents, changed, events_since
from kalux.settings import CameraSettings
from kalux.white import WhiteCheck, white_of_bits

T = TypeVar("T")

_LEAST_SHARE: Final = 0.1
"""Share of the events between the first frame and the last below which the clocks are doubted: a camera that records
both starts and stops them together."""

_WHITE_FRAMES: Final = 80
"""Frames, some 3 s of them, that tell the white value where it is not stated."""


class Stream(Generic[T]):
    """The events of a recording, in chunks of `EVENT_DTYPE`, or its frames; ``len()`` is the number of either."""

    def __init__(self, items: Callable[[], Iterator[T]], count: Callable[[], int]) -> None:
        self._items, self._count = items, count

    def __iter__(self) -> Iterator[T]:
        return self._items()

    def __len__(self) -> int:
        return self._count()


class _CachedStart(Generic[T]):
    """Makes iterators over the same items, the first of which stay in memory from the first pass on.

    Parameters
    ----------
    make
        A new iterator over all items.
    size
        Size of an item, in the unit of ``room``.
    room
        Items are kept as long as their sizes together are no more.
    """

    def __init__(self, make: Callable[[], Iterator[T]], size: Callable[[T], int], room: int) -> None:
        self._make, self._size, self._room = make, size, room
        self._kept: list[T] = []
        self._all = False  # whether no item follows the kept ones

    def __call__(self) -> Iterator[T]:
        given = 0
        for item in self._kept:
            given += 1
            yield item
        if self._all:
            return
        for item in islice(self._make(), given, None):
            if given == len(self._kept) and self._size(item) <= self._room:
                self._room -= self._size(item)
                self._kept.append(item)
            given += 1
            yield item
        self._all = given == len(self._kept)


def with_cached_start(recording: Recording, events: int, frame_bytes: int) -> Recording:
    """The same recording, whose beginning is read only once however often one iterates over it.

    Chunks of the first ``events`` events, and the first ``frame_bytes`` bytes of frames, stay in memory as long as the
    returned recording does. They must not be changed.
    """
    cached, whole = copy.copy(recording), recording.source.events
    start = _CachedStart(whole, len, events)
    cached.source = dataclasses.replace(
        recording.source,
        events=SeekableEvents(start, whole.since) if isinstance(whole, SeekableEvents) else start,
        frames=_CachedStart(recording.source.frames, lambda frame: frame.image.nbytes, frame_bytes),
    )
    return cached


def without_events_of(recording: Recording, pixels: NDArray[np.bool_]) -> Recording:
    """The same recording without the events of ``pixels``, (H, W); how many events there are is not counted again."""

    def without(chunks: Iterator[EventArray]) -> Iterator[EventArray]:
        return (chunk[~pixels[chunk["y"], chunk["x"]]] for chunk in chunks)

    made = copy.copy(recording)
    made.source = dataclasses.replace(recording.source, events=changed(recording.source.events, without))
    return made


def with_counted_events(recording: Recording, on_events: Callable[[int], None]) -> Recording:
    """The same recording; ``on_events`` is told the number of events of every chunk that is read, however often."""
    watched = changed(recording.source.events, lambda chunks: counted(chunks, on_events))
    made = copy.copy(recording)
    made.source = dataclasses.replace(recording.source, events=watched)
    return made


class EventLayout(NamedTuple):
    """How stored events lie to the frames.

    Attributes
    ----------
    mirrored_x, mirrored_y
        Whether their columns, or rows, count from the other side.
    swapped
        Whether polarity 1 is darker.
    """

    mirrored_x: bool = False
    mirrored_y: bool = False
    swapped: bool = False


AS_STORED: Final = EventLayout()


def with_event_layout(recording: Recording, layout: EventLayout) -> Recording:
    """The same recording, whose events are put as the frames are, from a ``layout`` in which they are not."""
    if layout == AS_STORED:
        return recording
    made = copy.copy(recording)
    height, width = recording.sensor_size

    def turned(chunk: EventArray) -> EventArray:
        check_events(chunk, recording.sensor_size, where=str(recording.source.path))
        events = chunk.copy()
        if layout.mirrored_x:
            events["x"] = width - 1 - chunk["x"]
        if layout.mirrored_y:
            events["y"] = height - 1 - chunk["y"]
        if layout.swapped:
            events["p"] = ~chunk["p"]
        return events

    events = changed(recording.source.events, lambda chunks: map(turned, chunks))
    made.source = dataclasses.replace(recording.source, events=events)
    return made


def with_rows_at_once(recording: Recording, row_time: float) -> Recording:
    """The same recording, the events of each row earlier by as much as its exposure is late (K19).

    To its frames, of a rolling shutter with ``row_time`` us from row to row, events are then as if all rows were
    exposed at once.
    """
    delays = whole_row_delays(recording.sensor_size[0], row_time)
    reach = int(np.abs(delays).max())
    whole, made = recording.source.events, copy.copy(recording)

    def moved() -> Iterator[EventArray]:
        waiting = np.empty(0, EVENT_DTYPE)
        for chunk in whole():
            check_events(chunk, recording.sensor_size, where=str(recording.source.path))
            waiting = in_order(joined_events([waiting, with_delay_of_rows(chunk, delays)]))
            ready = events_until(waiting, int(chunk["t"][-1]) - reach - 1)
            if ready:
                yield waiting[:ready]
            waiting = waiting[ready:]
        if len(waiting):
            yield waiting

    made.source = dataclasses.replace(recording.source, events=moved)
    return made


def less_black(recording: Recording, level: float | None) -> Recording:
    """The same recording, the frames of which have black at ``level``, a share of white; None: as before."""
    if level is None:
        return recording
    made = copy.copy(recording)
    made._black_level = level
    return made


def with_white_from(recording: Recording, level: float) -> Recording:
    """The same recording, each pixel of whose frames is white from a ``level`` of the response on."""
    black = recording.black_level or 0.0
    stored = black + level * (1.0 - black)
    whole, made = recording.source.frames, copy.copy(recording)

    def whitened() -> Iterator[Frame]:
        for frame in whole():
            image = np.where(frame.normalised() < stored, frame.image, frame.white_value).astype(
                frame.image.dtype
            )
            yield dataclasses.replace(frame, image=image)

    made.source = dataclasses.replace(recording.source, frames=whitened)
    return made


def with_frames(recording: Recording, frames: Callable[[], Iterator[Frame]]) -> Recording:
    """The recording with some of its own frames, or with others; their exposures are known, it has no ground truth."""

    def whole() -> Iterator[EventArray]:
        return iter(recording.events())

    chosen = Recording(
        dataclasses.replace(
            recording.source,
            events=SeekableEvents(whole, recording.events_since) if recording.is_seekable else whole,
            frames=frames,
            count_frames=lambda: sum(1 for _ in frames()),
            exposure_known=True,
            ground_truth=None,
            mosaic=recording.mosaic,
        )
    )
    return less_black(chosen, recording.black_level)


def without_repeats(recording: Recording) -> Recording:
    """The same recording, without frames whose image is that of the frame before, to the bit.

    If something moved between the two, events since the second do not tell what changed since the first, which both
    show.
    """
    whole, made = recording.source.frames, copy.copy(recording)

    def distinct() -> Iterator[Frame]:
        before: Frame | None = None
        for frame in whole():
            if not repeats(frame, before):
                yield frame
            before = frame

    made.source = dataclasses.replace(
        recording.source, frames=distinct, count_frames=lambda: sum(1 for _ in distinct())
    )
    return made


def with_frames_of(recording: Recording, other: Recording) -> Recording:
    """The recording with all frames of another, of which it is a part."""
    made = copy.copy(recording)
    made.source = dataclasses.replace(
        recording.source, frames=other.source.frames, count_frames=other.source.count_frames
    )
    return made


class FrameCorrections(NamedTuple):
    """What is to be done with the frames of a recording before they are used (`kalux.calibration.frame_faults`).

    Attributes
    ----------
    left_out
        Indices of frames that show nothing new, in order.
    empty
        As many frames at the beginning show nothing, but are needed, as images are wanted there.
    gains
        (K,) `Frame.gain` of every frame of the recording; None: as they state.
    stuck
        (H, W) pixels that show nothing, instead of which their neighbours are taken; None: none.
    """

    left_out: tuple[int, ...] = ()
    empty: int = 0
    gains: NDArray[np.float64] | None = None
    stuck: NDArray[np.bool_] | None = None

    def __bool__(self) -> bool:
        """Whether there is anything to do."""
        return bool(self.left_out or self.empty or self.gains is not None or self.stuck is not None)


UNCHANGED: Final = FrameCorrections()
"""Frames as they are."""


def with_corrected_frames(recording: Recording, corrections: FrameCorrections) -> Recording:
    """The same recording, with its frames corrected."""
    if not corrections:
        return recording
    whole, count, made = recording.source.frames, recording.source.count_frames, copy.copy(recording)
    made.source = dataclasses.replace(
        recording.source,
        frames=lambda: _corrected(whole(), corrections, 1 if recording.mosaic is None else 2),
        count_frames=lambda: count() - len(corrections.left_out),
    )
    return made


def _corrected(frames: Iterator[Frame], corrections: FrameCorrections, pitch: int) -> Iterator[Frame]:
    """The frames that are left. Where the first are empty, the next one's image is where the filter starts.

    Nothing of it counts as measured there, but what is clipped: to take that for white would cost more.
    """
    left_out, waiting = {*corrections.left_out}, list[Frame]()
    for index, frame in enumerate(frames):
        if index in left_out:
            continue
        if corrections.gains is not None:
            frame = dataclasses.replace(frame, gain=frame.gain * float(corrections.gains[index]))
        if index < corrections.empty:
            waiting.append(frame)
            continue
        if corrections.stuck is not None:
            frame = dataclasses.replace(frame, image=without_stuck(frame.image, corrections.stuck, pitch))
        for empty in waiting:
            response = frame.normalised()
            least = response if response.ndim == 2 else response.min(axis=-1)
            clipped = np.asarray(least >= CameraSettings.usual_saturation, np.bool_)
            valid = clipped if frame.valid is None else clipped & frame.valid
            yield dataclasses.replace(empty, image=frame.image, gain=frame.gain, valid=valid)
        waiting = []
        yield frame


def with_shifted_frames(recording: Recording, shifts: NDArray[np.int64] | None) -> Recording:
    """The same recording with (K,) us added to the exposures of its frames; None: as before."""
    if shifts is None:
        return recording

    def shifted() -> Iterator[Frame]:
        for frame, shift in zip(whole(), shifts.tolist(), strict=True):
            start, end = frame.exposure_start + shift, frame.exposure_end + shift
            yield dataclasses.replace(frame, exposure_start=start, exposure_end=end)

    whole, made = recording.source.frames, copy.copy(recording)
    made.source = dataclasses.replace(recording.source, frames=shifted)
    return made


def no_frames(recording: Recording) -> FrameError:
    """What to raise where a recording without frames cannot be used."""
    return FrameError(
        f"{recording.source.path}: no frames; kalux needs frames as well as events; join images or a video with "
        "--frames (frames=)"
    )


def reference_exposure(recording: Recording) -> int:
    """The exposure, us, at which a saturated pixel is 1 where nothing else is said: the median of all frames.

    Raises
    ------
    FrameError
        If the recording has no frames.
    """
    exposures = [frame.exposure for frame in recording.frames()]
    if not exposures:
        raise no_frames(recording)
    return median_exposure(exposures)


RECORDING_NEEDED: Final = "a kalux.Recording is needed, from kalux.open or Recording.from_arrays"


def clock_doubt(frames: int, events: int, between: int, enough: int = LATEST) -> str | None:
    """A warning if events and frames hardly have the same clock, else None.

    Parameters
    ----------
    frames, events
        Their numbers. Of one frame the exposure alone lies between the first and the last.
    between
        How many of the events lie from the first frame to the last.
    enough
        With so many between the frames the clocks are believed, whatever the share.
    """
    if frames < 2 or between >= min(_LEAST_SHARE * events, enough):
        return None
    if between == 0:
        return (
            f"none of the {events:,} events lies between the first and the last frame; do events and frames have the "
            "same clock?"
        )
    return (
        f"only {between:,} of the {events:,} events lie between the first and the last frame; are times of events and "
        "frames in the same unit and clock?"
    )


def check_stated(exposure: int | None, stamp: str, white: float | None) -> None:
    """Require what is stated of frames to be possible; as of `open`.

    Raises
    ------
    ExposureError, InputError
        If it is not.
    """
    if exposure is not None and not (
        isinstance(exposure, Real) and exposure > 0 and float(exposure).is_integer()
    ):
        raise ExposureError(f"exposure is {exposure} us; it must be positive and whole")
    if white is not None and not is_white(white):
        raise InputError(f"white is {white!r}; the value of a saturated pixel is needed")
    if stamp not in ("start", "middle", "end"):
        raise InputError(f"stamp is {stamp!r}; it must be 'start', 'middle' or 'end'")


class _Opening(NamedTuple):
    """The source that `open` has made, and of what: another process can do the same."""

    source: Source
    path: Path
    options: dict[str, Any]


class Recording:
    """A hybrid recording, opened with `kalux.open` or made with `Recording.from_arrays`.

    One that was opened can be pickled, as processes need it that share work: its files are opened again there.

    Iterating the same recording twice gives the same chunks and frames twice. Every chunk and frame is
    checked on the way (order, sensor bounds, sizes, exposure times); what is wrong is raised with its index.

    Attributes
    ----------
    source
        What the reader found: path, format, thresholds, ground truth.
    sensor_size
        (height, width), pixels.
    exposure_known
        Whether every frame has an exposure interval, from the file or from ``exposure``.
    mosaic
        The Bayer pattern of the sensor, from the file or as given; None: it has none, or none is known.
    white
        The value of a saturated pixel as given; None: what the frames say themselves, or `found_white`.
    """

    def __init__(
        self,
        source: Source,
        *,
        exposure: int | None = None,
        stamp: Stamp = "start",
        mosaic: Mosaic | Literal["none"] | None = None,
        white: float | None = None,
    ) -> None:
        check_stated(exposure, stamp, white)
        if mosaic not in (None, "none", *MOSAICS):
            raise InputError(f"mosaic is {mosaic!r}; it must be one of {', '.join(MOSAICS)}, or 'none'")
        if not all(0 < n <= LARGEST_SIDE for n in source.sensor_size):
            height, width = source.sensor_size
            raise FormatError(
                f"{source.path}: states a sensor of {width}x{height} pixels; 1 to {LARGEST_SIDE} a side are possible"
            )
        self.source = source
        self.mosaic: Mosaic | None = source.mosaic if mosaic is None else None if mosaic == "none" else mosaic
        self.sensor_size = source.sensor_size
        self.exposure_known = source.exposure_known or exposure is not None
        self.white = white
        self._exposure = None if exposure is None else int(exposure)  # NumPy's integers would wrap around
        self._stamp: Stamp = stamp
        self._longest: int | None = None
        self._black_level: float | None = None
        self._opening: _Opening | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """How to open it again elsewhere.

        Raises
        ------
        InputError
            If it was made in memory, or its events or frames are others than those of the file.
        """
        if self._opening is None or self._opening.source is not self.source:
            raise InputError(
                f"{self.source.path}: only a recording as kalux.open has given it can be sent to another process; open "
                "or make it there"
            )
        _, path, options = self._opening
        state = {name: value for name, value in vars(self).items() if name not in ("source", "_opening")}
        return _opened_again, (path, options, state)

    def __copy__(self) -> Recording:
        """The same, of the same source."""
        made = object.__new__(type(self))
        vars(made).update(vars(self))
        return made

    def __deepcopy__(self, memo: dict[int, Any]) -> Recording:
        """As a copy: reading changes nothing."""
        return copy.copy(self)

    @classmethod
    def from_arrays(
        cls,
        events: Any,
        frames: Iterable[Frame],
        *,
        sensor_size: tuple[int, int],
        columns: str | None = None,
        time_unit: str | None = None,
        exposure: int | None = None,
        stamp: Stamp = "start",
        contrast_threshold: float | tuple[float, float] | None = None,
        inverse_covariance: NDArray[np.float64] | None = None,
        ground_truth: GroundTruth | None = None,
        response: str | None = None,
        name: str = "arrays",
    ) -> Recording:
        """A recording in memory.

        Parameters
        ----------
        events
            Any container that `as_events` accepts, with its ``columns`` and ``time_unit``.
        frames
            `Frame` objects in time order.
        sensor_size
            (height, width), pixels.
        exposure, stamp
            Of frames that have one time stamp each, which is then their ``exposure_start``: as of `kalux.open`.
        contrast_threshold
            Log-intensity step of an event, or (on, off), if known.
        inverse_covariance
            (256,) 1 / R_bar per 8-bit value (the released ``f_Q``), if known.
        ground_truth
            Reference images, if any.
        response
            Of the frame camera, named as in `kalux.settings.CameraSettings`, if known.
        name
            Stands for the path in messages.

        Raises
        ------
        EventError, FrameError, ExposureError, InputError
            At once, not only when iterated.

        Warns
        -----
        UserWarning
            If what is taken for white can hardly be right, or the last exposure is longer than frames are apart, or
            events and frames hardly have the same clock.
        """
        size = checked_size(sensor_size)
        if ground_truth is not None:
            require_type(f"{name}: ground_truth", ground_truth, GroundTruth, GROUND_TRUTH_NEEDED)
        array = as_events(events, columns=columns, time_unit=time_unit)
        frame_list = list(frames)
        for index, frame in enumerate(frame_list):
            require_frame(frame, where=name, index=index)

        def chunks(first: int = 0) -> Iterator[EventArray]:
            for start in range(first, len(array), CHUNK_EVENTS):
                yield array[start : start + CHUNK_EVENTS]

        def since(t: int) -> Iterator[EventArray]:
            return chunks(int(np.searchsorted(array["t"], t)))

        recording = cls(
            Source(
                path=Path(name),
                format="arrays",
                sensor_size=size,
                events=SeekableEvents(chunks, since),
                frames=lambda: iter(frame_list),
                count_events=lambda: len(array),
                count_frames=lambda: len(frame_list),
                contrast_threshold=checked_thresholds(contrast_threshold),
                inverse_covariance=inverse_covariance,
                ground_truth=None if ground_truth is None else lambda: ground_truth,
                mosaic=frame_list[0].mosaic if frame_list else None,
                response=response,
            ),
            exposure=exposure,
            stamp=stamp,
        )
        for _ in recording.events():
            pass
        check = WhiteCheck()
        spans = [(frame.exposure_start, frame.exposure_end) for frame in check.watched(recording.frames())]
        exposures = np.array(spans, np.int64).reshape(-1, 2)
        doubts = [check.doubt(), exposure_doubt(exposures)]
        if len(exposures):
            first, last = np.searchsorted(array["t"], (exposures[0, 0], exposures[-1, 1] + 1))
            doubts.append(clock_doubt(len(exposures), len(array), int(last - first)))
        for doubt in filter(None, doubts):
            warnings.warn(f"{name}: {doubt}", stacklevel=2)
        return recording

    def __repr__(self) -> str:
        height, width = self.sensor_size
        return f"<kalux.Recording {str(self.source.path)!r}: {self.source.format}, {width} x {height} pixels>"

    @property
    def black_level(self) -> float | None:
        """What pixels read in the dark, a share of white, where that is known from elsewhere (`less_black`).

        None: not so; frames may state where their black is (`Frame.black`).
        """
        return self._black_level

    @property
    def contrast_threshold(self) -> tuple[float, float] | None:
        """(on, off) thresholds in log intensity that the recording states, or None."""
        return self.source.contrast_threshold

    @property
    def response(self) -> str | None:
        """The frame camera's response that the recording states, as in `kalux.settings.CameraSettings`, or None."""
        return self.source.response

    @cached_property
    def found_white(self) -> int | None:
        """The value of a saturated pixel that 16-bit frames show, where it is not stated (`kalux.white.white_of_bits`).

        None: it is stated, or the frames do not show another one than that of their type. Looks at the first 80 frames.
        """
        return white_of_bits(islice(self.source.frames(), _WHITE_FRAMES)) if self.white is None else None

    @property
    def longest_exposure(self) -> int:
        """The longest exposure, us; 0 without frames. Reads all frames, unless one iteration has come to their end."""
        if self._longest is None:
            for _ in self.frames():
                pass
        return self._longest or 0

    def ground_truth(self) -> GroundTruth | None:
        """Reference images that came with the recording, or None."""
        return None if self.source.ground_truth is None else self.source.ground_truth()

    def events(self) -> Stream[EventArray]:
        """The events, as checked, time-ordered chunks of bounded size."""
        return Stream(self._checked_events, self.source.count_events)

    @property
    def is_seekable(self) -> bool:
        """Whether later events can be read without those before them."""
        return isinstance(self.source.events, SeekableEvents)

    def events_since(self, t: int) -> Iterator[EventArray]:
        """As `events`, but of all events not before ``t``, us; some before it may come first."""
        return self._checked(events_since(self.source.events, t), of_all=False)

    def frames(self) -> Stream[Frame]:
        """The frames, checked, in time order, with their exposures.

        Raises
        ------
        ExposureError
            If the recording has no exposure times and none was given.
        """
        if not self.exposure_known:
            raise ExposureError(
                f"{self.source.path}: no exposure times are recorded; give the exposure time in us "
                "(--exposure 10000 or exposure=10000; a guess will do) and what the frame stamp marks (--stamp start, "
                "middle or end)"
            )
        return self.stamped_frames()

    def stamped_frames(self) -> Stream[Frame]:
        """The frames even where their exposure is unknown: start and end then both hold the stamp."""
        return Stream(self._checked_frames, self.source.count_frames)

    def stored_frames(self) -> Stream[Frame]:
        """As `stamped_frames`, but RGB that was made of a mosaic stays RGB: for a copy without loss."""
        return Stream(lambda: self._checked_frames(as_stored=True), self.source.count_frames)

    def _checked_events(self) -> Iterator[EventArray]:
        return self._checked(self.source.events(), of_all=True)

    def _checked(self, chunks: Iterator[EventArray], *, of_all: bool) -> Iterator[EventArray]:
        """The chunks, checked; without those before the first one where they are not ``of_all`` events."""
        count, previous_t = 0, None
        height, width = self.sensor_size
        for chunk in chunks:
            if len(chunk) == 0:
                continue
            earliest, latest = -LATEST if previous_t is None else previous_t, int(chunk["t"][-1])
            valid = _are_valid(event_words(chunk), earliest, np.uint64(height), np.uint64(width))
            if not valid or latest > LATEST:  # `check_events` is slower, and says what is wrong
                where = str(self.source.path)
                if not of_all:
                    for _ in self.events():  # tells the index of the event, too
                        pass
                check_events(chunk, self.sensor_size, where=where, first_index=count, previous_t=previous_t)
            count += len(chunk)
            previous_t = latest
            yield chunk

    def _checked_frames(self, *, as_stored: bool = False) -> Iterator[Frame]:
        previous, stored, longest = None, None, 0
        white = self.white
        for index, frame in enumerate(self.source.frames()):
            check_colours(frame, str(self.source.path), index, stored)  # before all have one mosaic
            stored = frame
            if index == 0 and frame.image.dtype == np.uint16 and white is None:
                white = self.found_white
            if white is not None:
                frame = dataclasses.replace(frame, white=white)
            if self._exposure is not None:
                frame = place_exposure(frame, self._exposure, self._stamp)
            frame = with_black_level(frame, self._black_level)
            if not as_stored:
                frame = _with_mosaic(frame, self.mosaic)
            check_frame(
                frame,
                self.sensor_size,
                where=str(self.source.path),
                index=index,
                previous=previous,
                exposure_known=self.exposure_known,
            )
            previous, longest = frame, max(frame.exposure, longest)
            yield frame
        self._longest = longest


@loop
def _are_valid(words, earliest, height, width):  # type: ignore[no-untyped-def]
    """Whether `check_events` would find nothing, in one pass over the memory."""
    wrong = False
    for i in range(len(words)):
        t, word = words[i, 0], words[i, 1]
        wrong |= (t < earliest) | (event_column(word) >= width) | (event_row(word) >= height)
        earliest = t
    return not wrong


def _with_mosaic(frame: Frame, mosaic: Mosaic | None) -> Frame:
    """The frame with another mosaic, or none; from RGB every pixel keeps the channel of its own filter."""
    if mosaic == frame.mosaic:
        return frame
    image = frame.image
    if mosaic is not None and image.ndim == 3:
        image = sample_mosaic(image, mosaic)
    return dataclasses.replace(frame, image=image, mosaic=mosaic)


def open(
    path: str | Path,
    *,
    exposure: int | None = None,
    stamp: Stamp = "start",
    frames: str | Path | None = None,
    frames_start: int | None = None,
    frames_rate: float | None = None,
    replace_frames: bool = False,
    mosaic: Mosaic | Literal["none"] | None = None,
    white: float | None = None,
) -> Recording:
    """Open a recording of any known format, recognised by its content.

    Parameters
    ----------
    path
        File or folder, of any format in ``docs/formats.md``.
    exposure
        Exposure time of all frames, us, for recordings that do not store it. Given explicitly, it
        replaces stored exposure times.
    stamp
        With ``exposure``: whether a frame's time stamp (or stored exposure start) is the start, the middle or
        the end of its exposure.
    frames
        Frames from elsewhere: a folder of images with their times, or a video; see ``docs/formats.md``.
    frames_start, frames_rate
        For a video: time of its first frame, us, in the clock of the events; frames per second.
    replace_frames
        Whether ``frames`` may replace frames that the recording has itself.
    mosaic
        The Bayer pattern of the sensor, ``"RGGB"``, ``"BGGR"``, ``"GRBG"`` or ``"GBRG"``, where the recording does not
        state it or is wrong; ``"none"``: it has none. Frames in RGB then give every pixel its own channel back.
    white
        The value of a saturated pixel of the frames, where the recording does not state it: 4095 of 12 bits that are
        stored in 16. Default: what the recording states, else the largest value of the type, 1 of floats.

    Raises
    ------
    InputError, FormatError
        If a file is missing, unknown or damaged, or an argument does not fit it.
    ExposureError
        If ``exposure`` is not positive and whole.
    FrameError
        If ``frames`` have not the size of the sensor.
    MissingDependencyError
        If the format needs a library that is not installed.
    """
    options: dict[str, Any] = {
        "exposure": exposure,
        "stamp": stamp,
        "frames": None if frames is None else Path(frames).absolute(),
        "frames_start": frames_start,
        "frames_rate": frames_rate,
        "replace_frames": replace_frames,
        "mosaic": mosaic,
        "white": white,
    }
    source = readers.read(path)
    if frames is not None:
        source = joined.join(
            source, Path(frames), start=frames_start, rate_hz=frames_rate, replace=replace_frames
        )
    elif frames_start is not None or frames_rate is not None or replace_frames:
        raise InputError(
            "frames_start, frames_rate and replace_frames say what to do with frames; give frames"
        )
    recording = Recording(source, exposure=exposure, stamp=stamp, mosaic=mosaic, white=white)
    recording._opening = _Opening(source, Path(path).absolute(), options)
    return recording


def _opened_again(path: Path, options: dict[str, Any], state: dict[str, Any]) -> Recording:
    """A recording that was pickled, with what was known of it."""
    recording = open(path, **options)
    vars(recording).update(state)
    return recording
