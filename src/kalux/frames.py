"""Frames: an image with the start and end of its exposure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from kalux.errors import ExposureError, FrameError

Stamp = Literal["start", "middle", "end"]
"""Which moment of the exposure a frame's single time stamp marks."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One grey image and its exposure.

    Attributes
    ----------
    image
        (height, width), uint8, uint16, float32 or float64: the raw camera response I^F.
    exposure_start, exposure_end
        First and last moment of the exposure, int microseconds, in the clock of the events. Equal where a
        recording stores only one stamp per frame (see `Recording.exposure_known`).
    white
        The value of a saturated pixel. Default: 255 for uint8, 65535 for uint16, 1.0 for floats. Sensors
        of 10 or 12 bits stored in uint16 need it (1023, 4095).
    valid
        (height, width) bool: False where the frame says nothing, e.g. outside the view of a second camera. The
        value of such a pixel is no measurement, not even of brightness beyond white; it should be a guess,
        because the first frame's is where the filter starts. None: all pixels are measured.
    """

    image: NDArray[Any]
    exposure_start: int
    exposure_end: int
    white: float | None = None
    valid: NDArray[np.bool_] | None = None

    @property
    def exposure(self) -> int:
        """Length of the exposure, us."""
        return self.exposure_end - self.exposure_start

    @property
    def middle(self) -> int:
        """The paper's tau^k, the middle of the exposure, us."""
        return self.exposure_start + self.exposure // 2

    @property
    def white_value(self) -> float:
        """The value of a saturated pixel: `white`, or the default of the image's dtype."""
        if self.white is not None:
            return float(self.white)
        if self.image.dtype.kind == "f":
            return 1.0
        return float(np.iinfo(self.image.dtype).max)

    def normalised(self) -> NDArray[np.float64]:
        """The camera response as float64, 0 to 1 = saturated (a float image may exceed 1)."""
        return self.image.astype(np.float64) / self.white_value


def place_exposure(frame: Frame, exposure: int, stamp: Stamp) -> Frame:
    """Give a frame that has only a stamp its exposure interval.

    Parameters
    ----------
    frame
        With ``exposure_start`` as the stamp, us.
    exposure
        Exposure time, us, positive.
    stamp
        Whether the stamp is the start, the middle or the end of the exposure.
    """
    before = {"start": 0, "middle": exposure // 2, "end": exposure}[stamp]
    start = frame.exposure_start - before
    return replace(frame, exposure_start=start, exposure_end=start + exposure)


def check_frame(
    frame: Frame,
    sensor_size: tuple[int, int],
    *,
    where: str = "frames",
    index: int = 0,
    previous: Frame | None = None,
    exposure_known: bool = True,
) -> None:
    """Check one frame of a sequence: size, type, finite, exposure positive and after the previous one.

    Raises
    ------
    FrameError
        Wrong size or dtype, not finite, or out of order.
    ExposureError
        An exposure that is empty, or that begins before the previous one has ended.
    """
    image = frame.image
    if image.shape != sensor_size:
        size = "x".join(str(n) for n in image.shape[::-1])
        raise FrameError(
            f"{where}: frame {index} is {size} pixels, the sensor is {sensor_size[1]}x{sensor_size[0]}; "
            "frames must be grey and have the size of the sensor"
        )
    if image.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise FrameError(
            f"{where}: frame {index} has dtype {image.dtype}; uint8, uint16, float32 or float64 is needed"
        )
    if image.dtype.kind == "f" and not np.isfinite(image).all():
        y, x = (int(i[0]) for i in np.nonzero(~np.isfinite(image)))
        raise FrameError(f"{where}: frame {index} is not finite (NaN or infinite) at x={x}, y={y}")
    valid = frame.valid
    if valid is not None and (valid.shape != sensor_size or valid.dtype != bool):
        raise FrameError(
            f"{where}: frame {index} has a mask of valid pixels of {valid.dtype} {valid.shape}; "
            f"bool {sensor_size} is needed"
        )
    if exposure_known and frame.exposure <= 0:
        raise ExposureError(
            f"{where}: frame {index} has an exposure of {frame.exposure} us; give the real exposure time "
            "(--exposure, in us)"
        )
    if previous is not None and frame.exposure_start < previous.exposure_end:
        if frame.exposure_start <= previous.exposure_start:
            raise FrameError(
                f"{where}: frame {index} starts at {frame.exposure_start} us, not after the frame before it "
                f"({previous.exposure_start} us); frames must be in time order"
            )
        raise ExposureError(
            f"{where}: the exposure of frame {index} starts at {frame.exposure_start} us, before that of the "
            f"previous frame has ended ({previous.exposure_end} us); is the exposure time too long?"
        )
