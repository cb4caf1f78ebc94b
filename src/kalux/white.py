"""The value of a saturated pixel, where nobody states it: what the levels of frames say of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.frames import Frame

_LARGE_FLOAT: Final = 16.0
"""Of frames in floats: more than a camera's highlights in units of white can be expected to have."""

_SMALL_FLOAT: Final = 0.01
"""Of frames in floats that state white: less than any camera's brightest pixels have, in all frames."""

_BITS: Final = (8, 10, 12, 14)
"""Of cameras whose frames may be stored in 16."""

BRIGHTEST: Final = 1e-3
"""Share of pixels that are at the brightest level where frames end there: fewer are broken ones, or glints."""


def sharp_end(images: Iterable[tuple[NDArray[Any], float] | None], below: float = np.inf) -> float | None:
    """The level that a thousandth of all pixels have and none exceeds: where a sensor may clip, or a scene ends.

    Parameters
    ----------
    images
        Pixels of any shape, and what they are divided by; None: an image that cannot be compared.
    below
        The level has to be less; default: it may be any.

    Returns
    -------
    None where there is no such level, or an image cannot be compared.
    """
    end, at_end, pixels = 0.0, 0, 0
    for given in images:
        if given is None:
            return None
        image, scale = given
        brightest = image.max(initial=0)
        level = float(brightest) / scale
        if level >= below:
            return None
        if level >= end:
            at_end = (at_end if level == end else 0) + int(np.count_nonzero(image == brightest))
            end = level
        pixels += image.size
    return end if end > 0 and at_end >= max(BRIGHTEST * pixels, 1) else None


def white_of_bits(frames: Iterable[Frame]) -> int | None:
    """The largest value of 8, 10, 12 or 14 bits, where 16-bit frames whose white is not stated end exactly there.

    A scene does not end so, only a converter does.
    """
    comparable = (
        (frame.image, 1.0) if frame.white is None and frame.image.dtype == np.uint16 else None
        for frame in frames
    )
    end = sharp_end(comparable, 1 << _BITS[-1])
    return int(end) if end is not None and end + 1 in [1 << bits for bits in _BITS] else None


class CheckedWhite(NamedTuple):
    """The white value of frames, and whether they make it doubtful."""

    value: float
    is_doubtful: bool


class WhiteCheck:
    """Watches frames go by, and tells whether the white value that they state, or that their type has, can be right."""

    def __init__(self) -> None:
        self._white: float | None = None
        self._frame: Frame | None = None
        self._largest = 0.0
        self._stated: float | None = None  # white of frames in floats

    def watched(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The same frames."""
        for frame in frames:
            self.see(frame)
            yield frame

    def see(self, frame: Frame) -> None:
        """Look at the next frame."""
        self._white = float(frame.white_value)
        floats = frame.image.dtype.kind == "f"
        if floats or (frame.white is None and frame.image.dtype != np.uint8):
            self._frame, self._stated = frame, frame.white
            self._largest = max(self._largest, float(frame.image.max()))

    def found(self) -> CheckedWhite | None:
        """The white value of the last frame; None if there was none."""
        return None if self._white is None else CheckedWhite(self._white, self.doubt() is not None)

    def doubt(self) -> str | None:
        """What makes the white value doubtful, in one line; None if nothing does."""
        if self._frame is None or not self._largest > 0:
            return None
        if self._stated is not None:
            return self._doubt_of_stated(self._stated)
        if self._frame.image.dtype.kind == "f":
            return self._doubt_of_floats()
        bits = next((bits for bits in _BITS if self._largest < 1 << bits), None)
        if bits is None:
            return None
        white = (1 << bits) - 1
        return (
            f"no pixel of the 16-bit frames is above {self._largest:.0f}, and 65535 is taken for white; if the camera "
            f"has {bits} bits, give --white {white} (white={white})"
        )

    def _doubt_of_stated(self, white: float) -> str | None:
        if self._largest > _SMALL_FLOAT * white:
            return None
        return (
            f"no pixel of the frames, floats, is above {self._largest:.3g}, and {white:g} is taken for white; if "
            "they are in units of white, give --white 1 (white=1)"
        )

    def _doubt_of_floats(self) -> str | None:
        if self._largest < _LARGE_FLOAT:
            return None
        return (
            f"pixels of the frames, which are floats, go up to {self._largest:g}, and 1 is taken for white; if they "
            "are not in units of white, give the value of a saturated pixel, --white 255 (white=255)"
        )
