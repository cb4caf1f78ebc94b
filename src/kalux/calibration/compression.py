"""Whether frames were stored as JPEG once, or in a video, and by how much pixels are off by it.

JPEG rounds the cosine transforms of blocks of 8 x 8 pixels to multiples of its steps, most of those of fine detail to
0. In blocks that lie as those of the file did many coefficients are 0 for that, in blocks that lie across them fewer;
of frames that were never compressed they are as many wherever blocks lie. The smallest ones that are not 0 tell the
steps. It shows whatever the frames were stored as later, as long as no pixel has been moved. Of videos, whose pictures
are mostly told by others, it does not show; readers say that.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn

from kalux.frames import Frame
from kalux.recording import Recording

Array = NDArray[np.float32]

_LUMA: Final = np.array([0.299, 0.587, 0.114])
_BLOCK: Final = 8
_FRAMES: Final = 8
_FIRST: Final = 3
"""Frames that are looked at, and those that are enough where they show nothing at all: it takes 0.07 s."""

_PER_FRAME: Final = 200  # blocks of each place, spread evenly

_FINE: Final = 6
"""Least sum of a coefficient's indices that counts as fine detail."""

_ZERO: Final = 0.9
"""Levels below which a coefficient is 0: rounding pixels to levels scatters it by 0.29."""

_NOT_ZERO: Final = 1.5
_TEXTURED: Final = 40.0
"""Levels, least sum of a block's coefficients: all are 0 where there is nothing to see."""

_INSIDE: Final = (2, 250)  # levels: what is clipped was another block before

_GAIN: Final = 0.1
"""Least difference of the shares of zeros. Of 60 recordings that were never compressed none has more than 0.02; of 17
at qualities of 97 to 30 none less than 0.17."""

_LEAST_BLOCKS: Final = 30
_ENOUGH_BLOCKS: Final = 60
_LEAST_COEFFICIENTS: Final = 10
_SMALLEST: Final = 0.1  # quantile of those that are not 0, which is about the step

OF_VIDEO: Final = 0.018
"""`Compression.error` of a video. Pictures of eight scenes in H.264 (x264, crf 18 and 23) are off by 1.6 to 5.1 levels
of 255, 0.65 of this are 3; with 0.014 and 0.022 MSE is as good but for a tenth (docs/calibration.md)."""


class Compression(NamedTuple):
    """What JPEG, or a video, did to frames.

    Attributes
    ----------
    error
        Standard deviation of a pixel of which every coefficient is off by up to half a step, as beside clipped ones; a
        share of the response.
    zeros, elsewhere
        Shares of fine coefficients that are 0, in blocks that lie as those of the file, and at most in those that lie
        across them both ways; 0 of a video.
    """

    error: float
    zeros: float = 0.0
    elsewhere: float = 0.0

    @property
    def of_video(self) -> bool:
        """Whether nothing but that the frames are of a video tells."""
        return self.zeros == 0.0


def find_compression(recording: Recording) -> Compression | None:
    """What a codec did to the frames of a recording; None where neither they nor their reader say so."""
    shown = _jpeg(recording)
    return Compression(OF_VIDEO) if shown is None and recording.source.of_lossy_video else shown


def _jpeg(recording: Recording) -> Compression | None:
    """What JPEG did to frames; None where they do not show it, or have not 8 bits."""
    frames = [*islice(_of_levels(recording.frames()), _FRAMES)]
    if not frames or min(frames[0].shape) < 2 * _BLOCK:
        return None
    first = _zeros(frames[:_FIRST])
    if first.blocks >= _ENOUGH_BLOCKS and first.gain < _GAIN / 2:
        return None
    found = _zeros(frames)
    if found.blocks < _LEAST_BLOCKS or found.gain < _GAIN:
        return None
    return Compression(_error(found.coefficients), found.most, found.elsewhere)


class _Zeros(NamedTuple):
    """Shares of fine coefficients that are 0: where they are most, and at most across. (N, 64) coefficients there.

    ``blocks`` have been looked at, wherever they begin.
    """

    most: float
    elsewhere: float
    coefficients: Array
    blocks: int

    @property
    def gain(self) -> float:
        return self.most - self.elsewhere


def _zeros(frames: Sequence[Array]) -> _Zeros:
    places = [(row, column) for row in range(_BLOCK) for column in range(_BLOCK)]
    found = [np.concatenate([_coefficients(frame, *place) for frame in frames]) for place in places]
    fine = _is_fine()
    shares = np.array([np.mean(np.abs(each[:, fine]) < _ZERO) if len(each) else 0.0 for each in found])
    best = int(np.argmax(shares))
    across = [all(a != b for a, b in zip(place, places[best], strict=True)) for place in places]
    blocks = min(len(each) for each in found)
    return _Zeros(float(shares[best]), float(shares[across].max()), found[best], blocks)


def _of_levels(frames: Iterable[Frame]) -> Iterator[Array]:
    """(H, W) luma of frames of 8 bits, in levels; of RGB as JPEG weighs it."""
    for frame in frames:
        if frame.image.dtype != np.uint8:
            return
        image = frame.image
        yield np.asarray(image if image.ndim == 2 else image @ _LUMA, np.float32)


def _coefficients(image: Array, row: int, column: int) -> Array:
    """(N, 64) cosine transforms of textured ones of some blocks, the first of which begins at a row and column."""
    down, across = ((size - first) // _BLOCK for size, first in zip(image.shape, (row, column), strict=True))
    part = image[row : row + down * _BLOCK, column : column + across * _BLOCK]
    chosen = np.unique(np.linspace(0, down * across - 1, _PER_FRAME).astype(np.int64))
    blocks = part.reshape(down, _BLOCK, across, _BLOCK)[chosen // across, :, chosen % across]
    low, high = _INSIDE
    blocks = blocks[(blocks.min(axis=(1, 2)) > low) & (blocks.max(axis=(1, 2)) < high)]
    transformed = np.asarray(dctn(blocks, axes=(1, 2), norm="ortho")).reshape(-1, _BLOCK**2)
    return np.asarray(transformed[np.abs(transformed[:, 1:]).sum(axis=1) > _TEXTURED])


def _is_fine() -> NDArray[np.bool_]:
    """(64,) which coefficients are of fine detail."""
    return np.asarray(np.add.outer(np.arange(_BLOCK), np.arange(_BLOCK)).ravel() >= _FINE)


def _error(coefficients: Array) -> float:
    """That of a `Compression`, by the steps that coefficients which are not 0 tell."""
    steps = list[float]()
    for values in np.abs(coefficients[:, 1:]).T:
        seen = values[values > _NOT_ZERO]
        if len(seen) >= _LEAST_COEFFICIENTS:
            steps.append(float(np.quantile(seen, _SMALLEST)))
    return float(np.sqrt(np.mean(np.square(steps)) / 12)) / 255 if steps else 0.0
