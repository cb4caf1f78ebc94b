"""What evaluations compare: a method, which makes images of a recording at given times.

It is given a recording and ascending times, us, and yields one image per time: (H, W) float32, linear, 1 = a saturated
frame pixel at the recording's median exposure.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from kalux.errors import InputError, require_type
from kalux.recording import Recording
from kalux.settings import Settings

T = TypeVar("T")

Image = NDArray[np.float32]
Times = NDArray[np.int64]


class Estimated(NamedTuple):
    """An image, and how sure a method is of it.

    Attributes
    ----------
    intensity
        (H, W), linear.
    variance
        (H, W), of log(intensity + log_offset); None: the method does not say.
    log_offset
        I_0.
    fixed_pattern
        Standard deviation of the sensor's fixed pattern that the variance counts, in units of the intensity: a number,
        or (H, W).
    """

    intensity: Image
    variance: Image | None
    log_offset: float = 0.0
    fixed_pattern: float | Image = 0.0

    @property
    def variance_of_frames(self) -> Image | None:
        """The variance of what separates the image from frames of the same sensor: they share its fixed pattern."""
        if self.variance is None or not np.any(self.fixed_pattern):
            return self.variance
        shared = np.square(self.fixed_pattern / (self.intensity + self.log_offset))
        return np.asarray(np.maximum(self.variance - shared, 0.0), self.variance.dtype)


METHOD_NEEDED: Final = "a Method is needed, e.g. kalux.evaluation.baselines.methods()['default']"
"""Where a `Method` comes from, for messages."""


@dataclass(frozen=True)
class Method:
    """A way to make images.

    Attributes
    ----------
    label
        For tables.
    images
        From a recording and ascending times (N,) int64, us, to N images.
    needs_held_out
        Whether it looks at the frames before and after, which is no comparison where one of them is of the very moment.
    estimates
        As ``images``, with the variance of every image; None: the method has none.
    settings
        Of `kalux.reconstruct`, where that makes the images.
    notes
        What a reader of its scores has to know.
    """

    label: str
    images: Callable[[Recording, Times], Iterable[Image]]
    needs_held_out: bool = False
    estimates: Callable[[Recording, Times], Iterable[Estimated]] | None = None
    settings: Settings | None = None
    notes: tuple[str, ...] = ()

    def estimated(self, recording: Recording, times: Times) -> Iterator[Estimated]:
        """The images at ascending times (us), with their variances where the method has them.

        Raises
        ------
        InputError
            If the method yields anything but one array of the sensor's size per time.
        """
        if self.estimates is not None:
            made = self._all(self.estimates(recording, times))
        else:
            made = (Estimated(image, None) for image in self._all(self.images(recording, times)))
        count = 0
        for count, one in enumerate(made, 1):
            if count > len(times):
                raise InputError(f"{self.label}: more images than the {len(times)} times it was given")
            where = f"{self.label}: image {count - 1}"
            require_type(where, one, Estimated, "of estimates an Estimated is needed")
            _check_array(where, one.intensity, recording.sensor_size)
            if one.variance is not None:
                _check_array(f"{where}: its variance", one.variance, recording.sensor_size)
            yield one
        if count < len(times):
            raise InputError(f"{self.label}: {count} images for {len(times)} times; one for each is needed")

    def _all(self, made: Iterable[T]) -> Iterable[T]:
        require_type(f"{self.label}: what it makes", made, Iterable, "an image for every time is needed")
        return made


def _check_array(where: str, image: Any, size: tuple[int, int]) -> None:
    if not isinstance(image, np.ndarray):
        raise InputError(f"{where} is of type {type(image).__name__}; a NumPy array is needed")
    if image.dtype.kind not in "fiub" or image.shape != size:
        raise InputError(
            f"{where} is {image.dtype} {image.shape}; real numbers, {size} as the sensor, are needed"
        )
