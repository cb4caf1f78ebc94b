"""Frames, an image with the start and end of its exposure; and reference images."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Real
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from kalux.errors import ExposureError, FrameError
from kalux.events import LATEST

Stamp = Literal["start", "middle", "end"]
"""Which moment of the exposure a frame's single time stamp marks."""

Mosaic = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
"""A Bayer pattern: the colours of the upper left 2x2 pixels, by rows."""

_LARGEST: Final = 1e12
"""Times white: no scene is brighter, and the squares of such values are still numbers. A damaged float may be 1e300."""

MOSAICS: Final[tuple[Mosaic, ...]] = get_args(Mosaic)


@dataclass(frozen=True, eq=False)
class Frame:
    """One image and its exposure.

    Attributes
    ----------
    image
        The raw camera response I^F, uint8, uint16, float32 or float64: (height, width), grey or a Bayer mosaic; or
        (height, width, 3), red, green, blue of a camera whose events see all colours. Values below 0, as of frames less
        a dark one, count as 0.
    exposure_start, exposure_end
        First and last moment of the exposure, whole microseconds of any type (kept as int), in the clock of the events.
        Equal where a recording stores only one stamp per frame (see `Recording.exposure_known`).
    white
        The value of a saturated pixel. Default: 255 for uint8, 65535 for uint16, 1.0 for floats. Sensors
        of 10 or 12 bits stored in uint16 need it (1023, 4095).
    mosaic
        Of a Bayer sensor, whose pixels each see one colour in frames and events alike: its pattern. None: no mosaic.
    valid
        (height, width) bool: False where the frame says nothing, e.g. outside the view of a second camera. The
        value of such a pixel is no measurement, not even of brightness beyond white; it should be a guess,
        because the first frame's is where the filter starts, and the last one's where it starts backward in time
        (``smooth=True``). None: all pixels are measured.
    black
        The value of a pixel in the dark, in the unit of the image: what every pixel reads on top of its light.
        ``camera.black_level`` of the settings goes before it.
    gain
        How many times brighter the same light is in this frame than its exposure time alone makes it: amplification,
        or an exposure that is not as stated.
    """

    image: NDArray[Any]
    exposure_start: int
    exposure_end: int
    white: float | None = None
    mosaic: Mosaic | None = None
    valid: NDArray[np.bool_] | None = None
    black: float = 0.0
    gain: float = 1.0

    def __post_init__(self) -> None:
        # Times of NumPy's types would wrap round (`uint64`), or be written as something else than whole numbers.
        for name in ("exposure_start", "exposure_end"):
            time = getattr(self, name)
            if _is_whole(time):
                object.__setattr__(self, name, int(time))
        # So would products with those of these, or they would be less exact (`float32`).
        for name in ("white", "black", "gain"):
            value = getattr(self, name)
            if isinstance(value, np.generic) and isinstance(value, Real):
                object.__setattr__(self, name, float(value))

    def __repr__(self) -> str:
        image = self.image
        kind = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        return f"<kalux.Frame {kind}, {self.colours}, exposed from {self.exposure_start} to {self.exposure_end} us>"

    @property
    def colours(self) -> str:
        """``"grey"``, ``"RGB"``, or the pattern of the mosaic."""
        return self.mosaic or ("RGB" if getattr(self.image, "ndim", 2) == 3 else "grey")

    @property
    def exposure(self) -> int:
        """Length of the exposure, us."""
        return self.exposure_end - self.exposure_start

    @property
    def amplified_exposure(self) -> float:
        """Length of the exposure times the gain, us: what the same light's value is proportional to."""
        return self.exposure * self.gain

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

    @property
    def full_scale(self) -> float:
        """From black to white, in the unit of the image."""
        return self.white_value - self.black

    def normalised(self) -> NDArray[np.float64]:
        """The camera response as float64, 0 = black to 1 = saturated (a float image may exceed 1)."""
        value = self.image.astype(np.float64)
        if self.black != 0:
            value -= self.black
        response = value / self.full_scale
        return np.maximum(response, 0.0) if self.image.dtype.kind == "f" or self.black > 0 else response


def with_black_level(frame: Frame, level: float | None) -> Frame:
    """The frame with black at ``level``, a share of its white value; None: as it is."""
    return frame if level is None else dataclasses.replace(frame, black=level * frame.white_value)


GROUND_TRUTH_NEEDED: Final = (
    "a kalux.frames.GroundTruth is needed, from GroundTruth(times, images) or Recording.ground_truth()"
)
"""Where a `GroundTruth` comes from, for messages."""


@dataclass(frozen=True)
class GroundTruth:
    """Reference images that came with a recording.

    Attributes
    ----------
    times
        (T,) int64, us.
    images
        (T, height, width) float32, linear, 1.0 = a saturated frame pixel.
    masks
        (T, height, width) bool, True where an image is the truth, if that is not everywhere.
    noise
        (read, shot) of images that a camera made: the variance of I is read^2 + shot I, in their unit. None: they have
        none, or none that is known.
    """

    times: NDArray[np.int64]
    images: NDArray[np.float32]
    masks: NDArray[np.bool_] | None = None
    noise: tuple[float, float] | None = None


def median_exposure(exposures: Iterable[int]) -> int:
    """us: the exposure at which a saturated pixel is 1, where nothing else is said, of one or more exposures."""
    return round(float(np.median([*exposures])))


_UNITS: Final = 1000
"""Of a unit of time to the next smaller one. Exposures so much shorter than the frames' interval are rare: 30 us."""

_SLOWEST: Final = 1_000_000
"""us from frame to frame beyond which it is no video, and exposures may be as short."""


def exposure_doubt(exposures: NDArray[np.int64]) -> str | None:
    """A warning if exposures are far too short, or the last one ends later than it can be expected to, else None.

    Every other exposure has to end before the next one begins (`check_frame`). Nothing follows the last one: it is
    doubted where it is longer than the longest interval between two frames.

    Parameters
    ----------
    exposures
        (K, 2) starts and ends, us, in time order.
    """
    if len(exposures) < 2:
        return None
    start, end = (int(t) for t in exposures[-1])
    intervals = np.diff(exposures[:, 0])
    usual, exposure = (int(np.median(lengths)) for lengths in (intervals, exposures[:, 1] - exposures[:, 0]))
    if 0 < _UNITS * exposure < usual <= _SLOWEST:
        return (
            f"frames follow each other every {usual:,} us and are exposed for {exposure:,} us; if that was meant in "
            f"ms, it is {_UNITS * exposure:,} us"
        )
    interval = int(intervals.max())
    if end - start <= interval:
        return None
    return (
        f"the last frame is exposed for {end - start:,} us, from {start} to {end} us, though frames follow each other "
        f"within {interval:,} us; is the end of its exposure right?"
    )


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
    return dataclasses.replace(frame, exposure_start=start, exposure_end=start + exposure)


def repeats(frame: Frame, before: Frame | None) -> bool:
    """Whether the image is that of the frame before, to the bit."""
    return before is not None and np.array_equal(frame.image, before.image)


def require_frame(frame: Any, *, where: str = "frames", index: int = 0) -> None:
    """Require a `Frame` with an array.

    Raises
    ------
    FrameError
        If it is something else.
    """
    if not isinstance(frame, Frame) or not _is_plain(frame.image):
        got = type(frame.image if isinstance(frame, Frame) else frame).__name__
        raise FrameError(f"{where}: frame {index} is a {got}; a kalux.Frame with a NumPy array is needed")


def _is_plain(array: Any) -> bool:
    """Whether it is an array whose functions are those of NumPy arrays."""
    return isinstance(array, np.ndarray) and not isinstance(array, (np.ma.MaskedArray, np.matrix))


def is_white(value: Any) -> bool:
    """Whether a value can be that of a saturated pixel, in any unit."""
    return isinstance(value, Real) and 1e-12 <= float(value) <= 1e12


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
        Wrong size, colours or dtype, not finite, beyond 1e12 times white, or out of order.
    ExposureError
        An exposure that is empty, or that begins before the previous one has ended.
    """
    require_frame(frame, where=where, index=index)
    image = frame.image
    _check_times(frame, where, index)
    if image.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise FrameError(
            f"{where}: frame {index} has dtype {image.dtype}; uint8, uint16, float32 or float64 in this "
            "machine's order of bytes is needed"
        )
    if not (isinstance(frame.gain, Real) and 1e-6 <= float(frame.gain) <= 1e6):
        raise FrameError(
            f"{where}: frame {index} has a gain of {frame.gain!r}; 0.000001 to 1000000 is possible"
        )
    if frame.white is not None and not is_white(frame.white):
        raise FrameError(
            f"{where}: frame {index} has the white value {frame.white!r}; the value of a saturated pixel is needed"
        )
    if not (isinstance(frame.black, Real) and 0 <= float(frame.black) < frame.white_value):
        raise FrameError(
            f"{where}: frame {index} has the black value {frame.black!r}; 0 to less than white, {frame.white_value:g}, "
            "is possible"
        )
    if image.shape not in (sensor_size, (*sensor_size, 3)):
        size = "x".join(str(n) for n in (*image.shape[:2][::-1], *image.shape[2:]))
        raise FrameError(
            f"{where}: frame {index} is {size} pixels, the sensor is {sensor_size[1]}x{sensor_size[0]}; "
            "frames must be grey or RGB and have the size of the sensor"
        )
    check_colours(frame, where, index, previous)
    if image.dtype.kind == "u" and frame.white is not None and frame.white > np.iinfo(image.dtype).max:
        raise FrameError(
            f"{where}: frame {index} has the white value {frame.white:g}, but no pixel of {image.dtype} is above "
            f"{np.iinfo(image.dtype).max}; the value of a saturated pixel is needed"
        )
    if image.dtype.kind == "f" and not np.isfinite(image).all():
        y, x = (int(i[0]) for i in np.nonzero(~np.isfinite(image))[:2])
        raise FrameError(f"{where}: frame {index} is not finite (NaN or infinite) at x={x}, y={y}")
    if image.dtype.kind == "f" and np.abs(image).max(initial=0) > _LARGEST * frame.white_value:
        raise FrameError(
            f"{where}: frame {index} has values up to {np.abs(image).max():g}, white is {frame.white_value:g}; at most "
            f"{_LARGEST:g} times white is possible"
        )
    valid = frame.valid
    if valid is not None and not (_is_plain(valid) and valid.shape == sensor_size and valid.dtype == bool):
        got = f"{valid.dtype} {valid.shape}" if _is_plain(valid) else type(valid).__name__
        raise FrameError(
            f"{where}: frame {index} has a mask of valid pixels of {got}; an array of bool {sensor_size} is needed"
        )
    if exposure_known and frame.exposure <= 0:
        raise ExposureError(
            f"{where}: frame {index} has an exposure of {frame.exposure} us; give the real exposure time, "
            "in us (--exposure, or exposure= of a recording; exposure_end of a frame that is pushed)"
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


def _is_whole(time: object) -> bool:
    if isinstance(time, (float, np.floating)):
        return float(time).is_integer()
    return isinstance(time, (int, np.integer))


def _check_times(frame: Frame, where: str, index: int) -> None:
    for time in (frame.exposure_start, frame.exposure_end):
        if not _is_whole(time) or not -LATEST <= time <= LATEST:
            raise FrameError(
                f"{where}: frame {index} has an exposure from {frame.exposure_start} to {frame.exposure_end}; whole "
                "microseconds, at most 10^18, are needed"
            )


def check_colours(frame: Frame, where: str, index: int, previous: Frame | None) -> None:
    """Check that a frame's mosaic is known and fits its image, and is that of the ``previous`` one (None: the first).

    Raises
    ------
    FrameError
        If not.
    """
    if frame.mosaic is not None:
        if frame.mosaic not in MOSAICS:
            raise FrameError(
                f"{where}: frame {index} has the mosaic {frame.mosaic!r}; known are {', '.join(MOSAICS)}"
            )
        if frame.image.ndim != 2 or min(frame.image.shape) < 2:
            raise FrameError(
                f"{where}: frame {index} has the shape {frame.image.shape}; a mosaic is (height, width), at least 2x2"
            )
    if previous is not None and frame.colours != previous.colours:
        raise FrameError(
            f"{where}: frame {index} is {frame.colours}, those before it are {previous.colours}; all must be alike"
        )
