"""What all writers share: the image they take, the checks, and how they end."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from types import TracebackType
from typing import NoReturn, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from kalux.compiled import INFINITE_BITS, magnitude_bits
from kalux.display import colour_of
from kalux.errors import InputError, InternalError, KaluxError, OutputError
from kalux.writers.files import uninterrupted


class ImageLike(Protocol):
    """An image that can be written; in colour where it has a ``colour``, (height, width, 3) linear RGB."""

    @property
    def t(self) -> int:
        """Time, us."""

    @property
    def intensity(self) -> NDArray[np.float32]:
        """(height, width), linear, 1.0 = a saturated frame pixel, more in highlights."""

    @property
    def variance(self) -> NDArray[np.float32]:
        """(height, width), variance of the log intensity; infinite where nothing is known."""


class Writer(ABC):
    """Writes images one by one; a context manager.

    Leaving the ``with`` block normally is `close`, leaving it by an exception, KeyboardInterrupt included, is
    `stop`. A signal that would interrupt a single write or the closing is handled right after it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._times: tuple[int, int] | None = None
        self._images = 0
        self._taken = 0
        self._shape: tuple[int, ...] | None = None
        self._in_colour: bool | None = None
        self._failed = False
        self._closed = False

    @property
    def images(self) -> int:
        """The number of images written."""
        return self._images

    def write(self, image: ImageLike) -> None:
        """Write the next image.

        Raises
        ------
        InputError
            The image is not float32 (height, width), or of another size than those before it; in a video,
            also where it is not later than the one before it or does not fit the rate.
        OutputError
            It cannot be written (full disk, no permission), or the writer is closed or has failed before.
        InternalError
            The image has an intensity that is not finite or a variance that is NaN: such an image is never
            written.
        """
        if self._closed or self._failed:
            state = "closed" if self._closed else "unusable after an error"
            raise OutputError(f"{self.path}: cannot write an image, the writer is {state}")
        try:
            check_image(image, self._taken, self._shape, self._in_colour)
            with uninterrupted():
                self._write(image)
                self._shape = image.intensity.shape
                self._in_colour = colour_of(image) is not None
                self._taken += 1
        except BaseException:
            # An interrupt is raised here only before the image or after all of it.
            self._failed = True
            raise

    def close(self) -> None:
        """Finish the output and mark it complete (incomplete if a write has failed). Twice is once.

        Raises
        ------
        OutputError
            The output cannot be finished; or a video has no images.
        """
        self._end(complete=not self._failed)

    def stop(self) -> None:
        """Finish the output with the images so far and mark it incomplete.

        Raises
        ------
        OutputError
            The output cannot be finished.
        """
        self._end(complete=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
            return
        try:
            self.stop()
        except KaluxError as second:
            error.add_note(str(second))

    def _end(self, *, complete: bool) -> None:
        if self._closed:
            return
        self._closed = True
        with uninterrupted():
            self._finish(complete)

    @abstractmethod
    def _write(self, image: ImageLike) -> None:
        """Write a checked image, all of it or nothing; then, or later, `_count` it."""

    def _count(self, t: int) -> None:
        """An image, of the time ``t`` (us), is written."""
        self._times = self._times[0] if self._times else int(t), int(t)
        self._images += 1

    @abstractmethod
    def _finish(self, complete: bool) -> None:
        """Finish the files. Called once."""


def check_image(
    image: ImageLike, index: int, shape: tuple[int, ...] | None, in_colour: bool | None = None
) -> None:
    """Check type, size and values of an image; ``shape`` and ``in_colour`` are those of the images before it.

    Raises
    ------
    InputError
        Wrong dtype or size, or grey among colours.
    InternalError
        An intensity or a colour is not finite, or a variance is NaN.
    """
    colour = colour_of(image)
    if in_colour is not None and in_colour != (colour is not None):
        raise InputError(f"image {index}: is {'grey' if in_colour else 'in colour'}, those before it are not")
    if colour is not None and (colour.dtype != np.float32 or colour.shape != (*image.intensity.shape, 3)):
        raise InputError(
            f"image {index}: the colour is {colour.dtype} of shape {colour.shape}; "
            f"float32 of shape {(*image.intensity.shape, 3)} is needed"
        )
    for name, values in (("intensity", image.intensity), ("variance", image.variance)):
        if values.dtype != np.float32 or values.ndim != 2 or values.size == 0:
            raise InputError(
                f"image {index}: the {name} is {values.dtype} of shape {values.shape}; "
                "float32 of shape (height, width) is needed"
            )
        if values.shape != (shape or image.intensity.shape):
            wanted = " x ".join(str(n) for n in shape or image.intensity.shape)
            found = " x ".join(str(n) for n in values.shape)
            raise InputError(f"image {index}: the {name} is {found} (height x width), {wanted} is needed")
    if magnitude_bits(image.intensity) >= INFINITE_BITS:
        _refuse(~np.isfinite(image.intensity), "intensity", "not finite", image.t, index)
    if colour is not None and magnitude_bits(colour) >= INFINITE_BITS:
        _refuse(~np.isfinite(colour), "colour", "not finite", image.t, index)
    if magnitude_bits(image.variance) > INFINITE_BITS:
        _refuse(np.isnan(image.variance), "variance", "NaN", image.t, index)


def _refuse(bad: NDArray[np.bool_], name: str, what: str, t: int, index: int) -> NoReturn:
    y, x = (int(i[0]) for i in np.nonzero(bad)[:2])
    raise InternalError(
        f"image {index} at {t} us: the {name} at x={x}, y={y} is {what}, so it is not written; "
        "this is an error in kalux, please report it"
    )
