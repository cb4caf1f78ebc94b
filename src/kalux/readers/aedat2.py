"""AEDAT 2.0, the format of jAER, of the DAVIS sensors: header lines, then pairs of address and time.

Both are 32 bits, big-endian; times are us and wrap around. The file is described at
https://docs.inivation.com/software/software-advanced-usage/file-formats/aedat-2.0.html, and how words become events and
samples by jAER (https://github.com/SensorsINI/jaer: ``DavisChip``, ``DavisBaseCamera.DavisEventExtractor``):

======  =====================================================================================
bit     meaning
======  =====================================================================================
31      0: event; 1: sample of the frame, or of the inertial unit
30-22   row, from the bottom
21-12   column: of events from the right, of samples from the left
11      of events: polarity
10      of events: 1 = not of a pixel, but of the external input (bits 2-0: 2 falling, 3 rising)
11-10   of samples: 0 reset read, 1 signal read, 3 inertial unit
9-0     of samples: value of the converter
======  =====================================================================================

A pixel of a frame is its reset read less its signal read. No word marks the exposure: it is taken from the times of
the reads, as jAER does. Other programs write all reads of a frame with one time, which says nothing of the exposure.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from kalux.errors import FormatError
from kalux.events import EventArray
from kalux.frames import Frame, Mosaic
from kalux.readers import evt
from kalux.readers.evt import BACKWARDS_US, ERROR, HIGH, NOW, ROOM, STARTED, place, put_trigger
from kalux.readers.source import EXPOSURE_UNKNOWN, SIZE_NOT_STATED, Source, TriggerArray, begins_with, reading

_MAGIC: Final = b"#!AER-DAT2."
_WORD: Final = np.dtype(">u8")  # address and time
_BLOCK_WORDS: Final = 1 << 16
_LONGEST_LINE: Final = 1 << 16
_LARGEST_HEADER: Final = 1 << 24
WHITE: Final = 1023
"""White of a DAVIS, whose converter has 10 bits."""

# Names of sensors of jAER with a Bayer mosaic, after "davis" and the size, and the mosaic seen from above: jAER's lists
# go from the lower left pixel to the right and round, and rows are counted from the bottom.
_MOSAICS: Final[dict[str, Mosaic]] = {
    "128color": "GRBG",
    "346bcolor": "RGGB",
    "346redcolor": "RGGB",
    "640color": "RGGB",
}
_SIZES: Final = {"128": (128, 128), "240": (180, 240), "346": (260, 346), "640": (480, 640)}

_EIGHT_BITS: Final = 255
_PERHAPS_OF_8_BITS: Final = (
    f"No pixel of the frames is above {{}}, and {WHITE} is taken for white; if they were made of frames of 8 bits, "
    f"give --white {_EIGHT_BITS} (white={_EIGHT_BITS})."
)
_V2E: Final = "AEDat2Output in v2e"  # in the header
_SIZE_OF_V2E: Final = (
    SIZE_NOT_STATED
    + "of the two that v2e writes, that of the DAVIS240 is taken, unless an event needs the DAVIS346."
)
_NO_FRAMES: Final = "The file has no complete frames."
_ROLLING: Final = (
    "The frames have a rolling shutter; their exposure is that of the first pixel that was read, "
    "others are exposed later by up to the time of the readout."
)
_SHUTTER_UNKNOWN: Final = (
    "The file does not say whether the shutter is global or rolling; "
    "the exposure is that of a global shutter."
)


@dataclass(frozen=True)
class _Header:
    """What the header says, and where it ends, bytes. ``rolling`` is None where it does not say."""

    chip: str
    rolling: bool | None
    end: int
    by_v2e: bool


@dataclass(frozen=True)
class _Survey:
    """What a file holds."""

    events: int
    frames: int
    incomplete_frames: int
    interleaved: bool
    global_exposure: bool  # whether time goes by between resets and signals, in any frame
    rolling_exposure: bool  # ... between the first reset and the signals
    largest: int  # value of a pixel


def recognises(path: Path) -> bool:
    """Whether the file begins like AEDAT 2."""
    return begins_with(path, _MAGIC)


def read(path: Path) -> Source:
    """Open an AEDAT 2.0 file of a DAVIS with 128x128, 240x180, 346x260 or 640x480 pixels, grey or of a Bayer mosaic.

    It is read through once. Frames are uint16, white is 1023.

    Raises
    ------
    FormatError
        If the sensor is another one or not named, the file ends within a word, or its clock goes back.
    InputError
        If it cannot be read.
    """
    with reading(path):
        header = _header(path)
        stated = None if header.by_v2e and not header.chip else _sensor_size(path, header.chip)
        excess = (path.stat().st_size - header.end) % _WORD.itemsize
    if excess:
        raise FormatError(
            f"{path}: cut short: it ends {excess} bytes into an event of {_WORD.itemsize}; copy or download it again"
        )
    size = stated or _needed_size(path, header.end)
    words = _Words(path, header.end, size)
    survey = words.survey()
    rolling = survey.interleaved or bool(header.rolling)
    exposed = survey.rolling_exposure if rolling else survey.global_exposure
    return Source(
        path=path,
        format="aedat2",
        sensor_size=size,
        events=words.events,
        frames=partial(words.frames, rolling),
        count_events=lambda: survey.events,
        count_frames=lambda: survey.frames,
        exposure_known=exposed or not survey.frames,
        triggers=words.triggers,
        missing=_missing(survey, header, rolling, exposed) + (() if stated else (_SIZE_OF_V2E,)),
        mosaic=mosaic_of(header.chip),
    )


def _missing(survey: _Survey, header: _Header, rolling: bool, exposed: bool) -> tuple[str, ...]:
    lost = survey.incomplete_frames
    missing: tuple[str, ...] = ()
    if lost:
        missing += (f"{lost} incomplete frame{'s are' if lost > 1 else ' is'} left out.",)
    if not survey.frames:
        return (*missing, _NO_FRAMES)
    if 0 < survey.largest <= _EIGHT_BITS:
        missing += (_PERHAPS_OF_8_BITS.format(survey.largest),)
    if not exposed:
        return (*missing, EXPOSURE_UNKNOWN)
    if rolling:
        return (*missing, _ROLLING)
    return (*missing, _SHUTTER_UNKNOWN) if header.rolling is None else missing


@dataclass(frozen=True)
class _Words:
    """The words of a file: where they begin, and of which sensor they are."""

    path: Path
    start: int
    size: tuple[int, int]

    def blocks(self) -> Iterator[NDArray[np.uint64]]:
        with self.path.open("rb") as file:
            file.seek(self.start)
            while len(words := np.fromfile(file, _WORD, _BLOCK_WORDS)):
                yield words.astype(np.uint64)

    def events(self) -> Iterator[EventArray]:
        with reading(self.path, evt.ClockError):
            yield from evt.decode_events(_DAVIS, self.blocks(), self.size)

    def triggers(self) -> Iterator[TriggerArray]:
        with reading(self.path, evt.ClockError):
            yield from evt.decode_triggers(_DAVIS, self.blocks(), self.size)

    def frames(self, rolling: bool) -> Iterator[Frame]:
        with reading(self.path, evt.ClockError):
            for image, state in decode_frames(self.blocks(), self.size):
                start = state[_FIRST_RESET if rolling else _LAST_RESET]
                yield Frame(image, int(start), int(state[_FIRST_SIGNAL]), WHITE)

    def survey(self) -> _Survey:
        frames, largest = 0, 0
        interleaved = of_global = of_rolling = False
        state = new_frame_state()
        with reading(self.path, evt.ClockError):
            for image, _ in decode_frames(self.blocks(), self.size, state):
                frames += 1
                interleaved |= bool(state[_INTERLEAVED])
                of_global |= bool(state[_LAST_RESET] < state[_FIRST_SIGNAL])
                of_rolling |= bool(state[_FIRST_RESET] < state[_FIRST_SIGNAL])
                largest = max(largest, int(image.max()))
        return _Survey(
            int(state[_EVENTS]), frames, int(state[_INCOMPLETE]), interleaved, of_global, of_rolling, largest
        )


# The header


def _header(path: Path) -> _Header:
    """The lines at the beginning that are text and begin with ``#``."""
    chip, by_v2e = "", False
    shutters: dict[str, bool] = {}
    end = 0
    with path.open("rb") as file:
        while end < _LARGEST_HEADER:
            line = file.readline(_LONGEST_LINE)
            # Events may begin with the byte of a '#', too, but are not text.
            line_text = _text(line)
            if not line.startswith(b"#") or not line.endswith(b"\n") or line_text is None:
                break
            end += len(line)
            text = line_text.strip("# ")
            if text.lower().startswith("aechip:"):
                chip = text.partition(":")[2].strip().rpartition(".")[2]
            elif shutter := re.search(
                r'key="([^"]*globalshutter)" value="(true|false)"', text, re.IGNORECASE
            ):
                shutters[shutter[1]] = shutter[2].lower() == "false"
            elif text.lower() == "end of ascii header":
                break
            by_v2e |= _V2E in text
    return _Header(chip, _rolling(chip, shutters), end, by_v2e)


def _text(line: bytes) -> str | None:
    """A line as text; None if it is none.

    Java writes the names of users and files in the computer's own encoding. Their letters mean nothing here, but what
    is around them is text, which no event of so many bytes is likely to be.
    """
    try:
        text = line.decode("utf-8")
    except UnicodeDecodeError:
        if not line.startswith(b"# ") or len(line) <= _WORD.itemsize:
            return None
        text = line.decode("ascii", "replace")
    text = text.strip("\r\n").replace("\t", " ")
    return text if text.isprintable() else None


def _rolling(chip: str, shutters: dict[str, bool]) -> bool | None:
    """Whether the preferences of a chip, as ``CHIP.APS.GlobalShutter`` or older names, all say so."""
    own = [key for key in shutters if key.lower().startswith(f"{chip.lower()}.")]
    newest = [key for key in own if ".aps" in key.lower()] or own
    said = {shutters[key] for key in newest}
    return said.pop() if len(said) == 1 else None


def mosaic_of(chip: str) -> Mosaic | None:
    """The Bayer mosaic of a sensor of jAER, seen from above, by its name there; None if it is grey or not known."""
    return _MOSAICS.get(chip.lower().removeprefix("davis"))


def _sensor_size(path: Path, chip: str) -> tuple[int, int]:
    if not chip:
        raise FormatError(
            f"{path}: does not say which sensor it is from; its header needs a line such as "
            "'# AEChip: eu.seebetter.ini.chips.davis.DAVIS240C'"
        )
    name = chip.lower()
    if mosaic_of(chip) is None and re.search(r"colou?r|rgb|cdavis", name):
        raise FormatError(
            f"{path}: the sensor {chip[:40]} has colour pixels in no known Bayer mosaic; kalux does not read them"
        )
    model = re.match(r"davis?(\d{3})", name)
    if model is None or model[1] not in _SIZES:
        raise FormatError(
            f"{path}: words of the sensor {chip[:40]} cannot be read; known are DAVIS128, DAVIS240, DAVIS346 "
            "and DAVIS640"
        )
    return _SIZES[model[1]]


def _needed_size(path: Path, start: int) -> tuple[int, int]:
    """The smaller of the sensors for which v2e writes files that has all events."""
    small, large = _SIZES["240"], _SIZES["346"]
    # Rows and columns are counted from the other side there.
    first_row, first_column = large[0] - small[0], large[1] - small[1]
    for chunk in _Words(path, start, large).events():
        if (
            chunk["y"].min(initial=first_row) < first_row
            or chunk["x"].min(initial=first_column) < first_column
        ):
            return large
    return small


# The words


def new_frame_state() -> NDArray[np.int64]:
    """What `decode_frames` remembers, before the first word."""
    return np.zeros(_STATE_SIZE, np.int64)


def decode_frames(
    blocks: Iterator[NDArray[np.uint64]],
    sensor_size: tuple[int, int],
    state: NDArray[np.int64] | None = None,
) -> Iterator[tuple[NDArray[np.uint16], NDArray[np.int64]]]:
    """The complete frames among the words, each with the state right after it.

    A frame begins at the first reset read, and again at the reset read of a pixel that was read before. It is complete
    when the signals of all pixels are read.

    Parameters
    ----------
    blocks
        Consecutive words, of any lengths: the address in the upper half, the time in the lower.
    sensor_size
        (height, width), pixels.
    state
        Changed in place, also by the words after the last frame.

    Raises
    ------
    ClockError
        Where the time goes back.
    """
    state = new_frame_state() if state is None else state
    resets = np.zeros(sensor_size, np.int16)
    marks = np.zeros(sensor_size, np.uint8)
    image = np.zeros(sensor_size, np.uint16)
    position = 0
    for words in blocks:
        while len(words):
            used = _decode_samples(words, state, resets, marks, image)
            if state[_BACK]:
                raise evt.ClockError(
                    f"the sensor's clock goes back from {state[_LATEST]} to {state[_CLOCK]} us "
                    f"at word {position + used}"
                )
            position += used
            words = words[used:]
            if state[_DONE]:
                yield image.copy(), state
    state[_INCOMPLETE] += state[_ACTIVE]


# What is remembered of frames from word to word, int64. Times are in us, without wrap-around.
_BEGUN, _CLOCK, _LATEST, _BACK = range(4)
_ACTIVE, _SIGNALS, _FIRST_RESET, _LAST_RESET, _FIRST_SIGNAL, _INTERLEAVED, _DONE = range(4, 11)
_EVENTS, _INCOMPLETE = range(11, 13)
_STATE_SIZE: Final = 13


@njit(cache=True, nogil=True, inline="always")
def _tick(clock, stamp):  # type: ignore[no-untyped-def]
    """The time nearest to the clock, us, that is meant by its lowest 32 bits."""
    step = (stamp - clock) & 0xFFFFFFFF
    return clock + step - (step >> 31 << 32)


@njit(cache=True, nogil=True, inline="always")
def _read_word(word, begun, clock, now):  # type: ignore[no-untyped-def]
    """Address; clock and time, us, of which the latter never decreases; whether the clock goes back too far."""
    clock = _tick(clock, np.int64(word & np.uint64(0xFFFFFFFF)))
    last = now if begun else clock
    return np.int64(word >> np.uint64(32)), clock, max(last, clock), clock + BACKWARDS_US < last


@njit(cache=True, nogil=True)
def _decode_events(words, state, events, triggers, height, width):  # type: ignore[no-untyped-def]
    started, clock, now = state[STARTED], state[HIGH], state[NOW]
    capacity, trigger_capacity = len(events) - ROOM, len(triggers)
    count, count_triggers, i = 0, 0, 0
    while i < len(words) and count < capacity and count_triggers < trigger_capacity:
        address, clock, now, back = _read_word(words[i], started, clock, now)
        started = 1
        if back:
            state[ERROR] = 1
            break
        i += 1
        if address & 0x80000400 == 0:
            x = address >> 12 & 0x3FF
            y = address >> 22 & 0x1FF
            # One that lies outside stays there.
            x = width - 1 - x if x < width else x
            y = height - 1 - y if y < height else y
            events[count, 0] = now
            events[count, 1] = place(x, y, address >> 11 & 1)
            count += 1
        elif address & 0x80000C06 == 0x402:
            count_triggers = put_trigger(triggers, count_triggers, now, 0, address & 1)
    state[STARTED], state[HIGH], state[NOW] = started, clock, now
    return i, count, count_triggers


@njit(cache=True, nogil=True)
def _decode_samples(words, state, resets, marks, image):  # type: ignore[no-untyped-def]
    """Use words up to the end of a frame, or all; how many."""
    begun, clock, now, events = state[_BEGUN], state[_CLOCK], state[_LATEST], state[_EVENTS]
    height, width = image.shape
    state[_DONE] = 0
    i = 0
    while i < len(words):
        address, clock, now, back = _read_word(words[i], begun, clock, now)
        begun = 1
        if back:
            state[_BACK] = 1
            break
        i += 1
        if address & 0x80000000 == 0:
            events += address >> 10 & 1 ^ 1
            continue
        if address & 0x800:  # of the inertial unit, or of an old way of reading frames
            continue
        x = address >> 12 & 0x3FF
        y = height - 1 - (address >> 22 & 0x1FF)
        if y < 0 or x >= width:
            continue  # its frame will be incomplete
        if address & 0x400 == 0:  # reset read
            if not state[_ACTIVE] or marks[y, x]:
                state[_INCOMPLETE] += state[_ACTIVE]
                state[_ACTIVE], state[_SIGNALS], state[_INTERLEAVED] = 1, 0, 0
                state[_FIRST_RESET] = state[_FIRST_SIGNAL] = now
                marks[:] = 0
            state[_INTERLEAVED] |= np.int64(state[_SIGNALS] > 0)
            state[_LAST_RESET] = now
            resets[y, x] = address & 0x3FF
            marks[y, x] = 1
        elif state[_ACTIVE]:  # signal read
            if marks[y, x] == 1:
                if state[_SIGNALS] == 0:
                    state[_FIRST_SIGNAL] = now
                state[_SIGNALS] += 1
                image[y, x] = max(resets[y, x] - (address & 0x3FF), 0)
            marks[y, x] = 2
            if state[_SIGNALS] == height * width:
                state[_DONE], state[_ACTIVE] = 1, 0
                break
    state[_BEGUN], state[_CLOCK], state[_LATEST], state[_EVENTS] = begun, clock, now, events
    return i


_DAVIS: Final[Any] = evt.Encoding("AEDAT 2.0", _WORD, _decode_events)
