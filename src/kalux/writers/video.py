"""A video: H.264 in MP4."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple

import av
import numpy as np
from av.container import OutputContainer
from av.video.stream import VideoStream
from numpy.typing import NDArray

from kalux.display import (
    DisplaySettings,
    Float32,
    Statistics,
    ToneState,
    apply,
    fill,
    fill_levels,
    next_state,
    shown_of,
)
from kalux.errors import InputError, MissingDependencyError, OutputError, SettingsError
from kalux.models.colour import LUMINANCE, luminance
from kalux.threads import InOrder
from kalux.wording import how_many
from kalux.writers.base import ImageLike, Writer
from kalux.writers.files import Claim, check_length, output_errors
from kalux.writers.settings_file import SettingsFile, require_ours

PRESETS = (
    "ultrafast",
    "superfast",
    "veryfast",
    "faster",
    "fast",
    "medium",
    "slow",
    "slower",
    "veryslow",
)
_FAST: Final = PRESETS[:3]
_THREADS: Final = 4
"""Of x264 with slower presets. A fixed number, because the bits of the video depend on it. The fast ones keep up with
one, which needs less processor time than several."""

_LARGEST: Final = 2**31 - 1
"""Of whole numbers in FFmpeg's fractions, and of units of time from image to image in MP4."""

_LEAST_SCALE: Final = 10_000
"""Units of time per second in MP4, at least: FFmpeg doubles them until there are so many."""

_BT709 = 1
MICROSECOND = Fraction(1, 1_000_000)


@dataclass(frozen=True)
class VideoSettings:
    """How a video is compressed.

    Attributes
    ----------
    crf
        Constant rate factor of x264, 0 to 51: less is better and larger; 18 looks like the original.
    preset
        Of x264, ``ultrafast`` to ``veryslow``: slower is smaller. The default takes a third of the time of
        ``veryfast``; at the same ``crf`` its pictures are nearer to the original, its files 2.5 to 6 times as large.
    slow_motion
        Times are stretched by this factor: 10 shows 300 images per second at 30.
    """

    crf: float = 18.0
    preset: str = "ultrafast"
    slow_motion: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.crf <= 51:
            raise SettingsError(f"video: crf is {self.crf}; it must be 0 to 51")
        if self.preset not in PRESETS:
            raise SettingsError(f"video: preset is {self.preset!r}; it must be one of {', '.join(PRESETS)}")
        if not 1e-3 <= self.slow_motion <= 1e6:
            raise SettingsError(f"video: slow_motion is {self.slow_motion}; it must be 0.001 to 1000000")


@dataclass(frozen=True)
class Ticks:
    """The clock of a video.

    Attributes
    ----------
    rate
        Images per second of the recording, or None to count microseconds.
    slow_motion
        Factor by which a tick lasts longer in the video than in the recording.
    """

    rate: Fraction | None
    slow_motion: Fraction

    @cached_property
    def time_base(self) -> Fraction:
        """Length of a tick in the video, seconds; to 1e-9 of it where FFmpeg has no such fraction."""
        exact = (1 / self.rate if self.rate else MICROSECOND) * self.slow_motion
        return exact.limit_denominator(max(int(_LARGEST / max(exact, Fraction(1))), 1))

    @cached_property
    def most(self) -> int:
        """Ticks from image to image, at most; 0: not even one fits into MP4."""
        scale = self.time_base.denominator
        while scale < _LEAST_SCALE:
            scale *= 2
        return int(_LARGEST / (self.time_base * scale))

    def count(self, microseconds: int) -> int:
        """The ticks in a time since the first image.

        Raises
        ------
        InputError
            The time is not a multiple of 1 / rate, by more than a tenth or a microsecond.
        """
        if self.rate is None:
            return microseconds
        # In whole numbers, as fractions take ten times as long.
        share, whole = self.rate.numerator, self.rate.denominator * MICROSECOND.denominator
        ticks = (2 * microseconds * share + whole) // (2 * whole)
        if 10 * abs(microseconds * share - ticks * whole) > max(whole, 10 * share):
            raise InputError(
                f"video: an image {microseconds} us after the first does not fit {float(self.rate):g} images "
                "per second; leave the rate out to keep the time stamps as they are"
            )
        return ticks


class Picture(NamedTuple):
    """A frame that is ready for the encoder, and the time of its image, us."""

    t: int
    frame: av.VideoFrame


class VideoWriter(Writer):
    """Encodes into a temporary file beside the output, which gets its name when it is finished.

    With several ``makers``, that many pictures are made at a time, in threads of their own. They are encoded in order,
    each after up to as many calls of `write`: so late, too, is the error of one that cannot be.
    """

    def __init__(
        self,
        path: Path,
        display: DisplaySettings,
        video: VideoSettings,
        ticks: Ticks,
        settings: SettingsFile,
        *,
        overwrite: bool,
        makers: int = 1,
    ) -> None:
        super().__init__(path)
        self._pending: InOrder[Picture] = InOrder(makers, "pictures")
        self._display = display
        self._video = video
        self._ticks = ticks
        self._settings = settings
        self._state: ToneState | None = None
        self._open: tuple[OutputContainer, VideoStream] | None = None
        self._first: int | None = None
        self._last = -1
        self._whole = True
        with output_errors(path, "the video cannot be written"):
            check_replaceable(path, settings.path, overwrite=overwrite)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._claim = Claim(path)
        self._temporary = self._claim.temporary

    def _write(self, image: ImageLike) -> None:
        t = int(image.t)
        self._first = t if self._first is None else self._first
        pts = self._ticks.count(t - self._first)
        if pts <= self._last:
            raise InputError(
                f"video: the image at {t} us is not later than the one before it; "
                "the images of a video must be in time order"
            )
        if self._last >= 0 and pts - self._last > self._ticks.most:
            tick = float(self._ticks.time_base)
            raise InputError(
                f"video: the image at {t} us would be shown {(pts - self._last) * tick:g} s after the one before it, "
                f"and MP4 holds {self._ticks.most * tick:g} s; make it less slow"
            )
        self._state = following = next_state(image, self._display, self._state, checked=True)
        self._last = pts
        shown = shown_of(image)

        def picture() -> Picture:
            frame = video_frame(shown, self._display, following.statistics)
            frame.pts, frame.time_base = pts, self._ticks.time_base
            return Picture(t, frame)

        self._pending.give(picture, self._encode)

    def _encode(self, picture: Picture) -> None:
        frame = picture.frame
        if self._open is None:
            with encoder_errors(self.path, "the video cannot be written"):
                self._open = open_container(
                    self._temporary, frame.width, frame.height, self._ticks, self._video
                )
        container, stream = self._open
        self._whole = False
        with encoder_errors(
            self.path, f"the video failed after {how_many(self._images, 'image')} and is removed"
        ):
            container.mux(stream.encode(frame))
        self._whole = True
        self._count(picture.t)

    def _finish(self, complete: bool) -> None:
        try:
            self._pending.finish(self._encode)
        except BaseException:
            with contextlib.suppress(OutputError):  # the error that comes first is told
                self._end_video(complete=False)
            raise
        self._end_video(complete=complete)

    def _end_video(self, *, complete: bool) -> None:
        try:
            if self._open is None and complete:
                raise OutputError(f"{self.path}: not written, there was no image")
            if self._open is not None and self._whole:  # that the encoder has failed is told already
                self._finish_container(*self._open)
                self._publish(complete)
        finally:
            self._pending.end()
            if self._open is not None:
                with contextlib.suppress(OSError, av.FFmpegError):
                    self._open[0].close()
            self._claim.release()

    def _finish_container(self, container: OutputContainer, stream: VideoStream) -> None:
        with encoder_errors(self.path, "the video cannot be finished and is removed"):
            container.mux(stream.encode(None))
            container.close()
            finished = frames_of(self._temporary)
        if finished != self._images:
            raise OutputError(
                f"{self.path}: {finished} of {self._images} images are in the video, so it is removed"
            )

    def _publish(self, complete: bool) -> None:
        with output_errors(self.path, "the video cannot get its name and is removed"):
            # The settings of a former video must not stand beside the new one, not even for a moment.
            self._settings.path.unlink(missing_ok=True)
            os.replace(self._temporary, self.path)
        with output_errors(self._settings.path, f"the video {self.path} is whole, its settings are missing"):
            self._settings.write(complete=complete, images=self._images, times=self._times)


@contextlib.contextmanager
def encoder_errors(path: Path, consequence: str) -> Iterator[None]:
    """Turn errors of the system and of FFmpeg into an OutputError."""
    with output_errors(path, consequence):
        try:
            yield
        except av.FFmpegError as error:
            if isinstance(error, OSError):
                raise
            raise OutputError(f"{path}: {error}; {consequence}") from error


def make_ticks(rate_hz: float | None, video: VideoSettings) -> Ticks:
    """The clock for a rate, or for time stamps as they are.

    Raises
    ------
    SettingsError
        The rate is not positive, or above 1 MHz; or images would be further apart than MP4 can say.
    """
    if rate_hz is not None and not (math.isfinite(rate_hz) and 1e-3 <= rate_hz <= 1e6):
        raise SettingsError(f"rate: {rate_hz} images per second; it must be 0.001 to 1000000")
    rate = None if rate_hz is None else Fraction(rate_hz).limit_denominator(100_000)
    ticks = Ticks(rate, Fraction(video.slow_motion).limit_denominator(1000))
    if rate_hz is not None and ticks.most == 0:
        raise SettingsError(
            f"video: {rate_hz:g} images per second, {video.slow_motion:g} times slower, are "
            f"{float(ticks.time_base):g} s apart, more than MP4 can say; choose a higher rate, or less slow motion"
        )
    return ticks


def check_replaceable(path: Path, settings: Path, *, overwrite: bool) -> None:
    """Check that a video and its settings file are not there, or may be replaced.

    Raises
    ------
    OutputError
        One is there and ``overwrite`` is False, or it is not a file, or the settings are not of kalux.
    OSError
        The name of one is too long.
    """
    if os.path.lexists(path) and not path.is_file():
        raise OutputError(f"{path}: not a file; choose another name for the video")
    for existing in (path, settings):
        if os.path.lexists(existing) and not overwrite:
            raise OutputError(f"{existing}: there already; choose another name, or allow overwriting")
    require_ours(settings)
    check_length(settings)


def open_container(
    path: Path, width: int, height: int, ticks: Ticks, video: VideoSettings
) -> tuple[OutputContainer, VideoStream]:
    """A new MP4 file and its stream, for frames of even width and height.

    Raises
    ------
    MissingDependencyError
        PyAV was built without x264.
    OSError
        The file cannot be opened.
    """
    rate = 1 / ticks.time_base if ticks.rate else Fraction(30)
    container = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})
    try:
        stream = container.add_stream("libx264", rate=rate)
    except (av.codec.codec.UnknownCodecError, ValueError) as error:
        raise MissingDependencyError(
            "video: this build of PyAV has no H.264 encoder (libx264); install the wheel: pip install av"
        ) from error
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    stream.time_base = ticks.time_base
    stream.codec_context.time_base = ticks.time_base
    _tag_colours(stream.codec_context)
    stream.options = {"crf": f"{video.crf:g}", "preset": video.preset}
    stream.codec_context.thread_count = 1 if video.preset in _FAST else _THREADS
    return container, stream


def _tag_colours(target: Any) -> None:
    """Say what the numbers mean: BT.709 in the limited range, 16 to 235, which every player takes."""
    target.color_range = 1
    target.color_primaries = target.color_trc = target.colorspace = _BT709


def video_frame(shown: Float32, display: DisplaySettings, statistics: Statistics) -> av.VideoFrame:
    """A frame, yuv420p of BT.709 in the limited range, of an image as `kalux.display.apply` maps it.

    Parameters
    ----------
    shown
        (height, width) or (height, width, 3), float32 and finite. Where a size is odd, the last row or column is
        repeated.
    display, statistics
        As of `kalux.display.apply`.
    """
    height, width = shown.shape[:2]
    frame = av.VideoFrame(width + width % 2, height + height % 2, "yuv420p")
    planes = [_plane(plane) for plane in frame.planes]
    if shown.ndim == 2:
        fill_levels(shown, display, statistics, (16.0, 235.0), planes[0])
        for plane in planes[1:]:
            plane[...] = 128
    else:
        mapped = apply(shown, display, statistics, checked=True)
        padding = [(0, height % 2), (0, width % 2), (0, 0)]
        padded = np.pad(mapped, padding, mode="edge")
        luma = luminance(padded)
        for values, plane, zero, scale in zip(
            [luma, *chroma(padded, luma)], planes, (16.0, 128.0, 128.0), (219.0, 224.0, 224.0), strict=True
        ):
            fill(values, zero, scale, plane)
    frame.color_range = 1
    frame.colorspace = _BT709
    return frame


def _plane(plane: Any) -> NDArray[np.uint8]:
    """A plane's memory, (rows, bytes of a row)."""
    return np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)


def chroma(picture: Float32, luma: Float32) -> list[Float32]:
    """Cb and Cr of BT.709, -0.5 to 0.5, at half the size of an RGB picture of even size.

    Samples lie on even columns, between two rows, as H.264 has them by default: weights 1 2 1 along rows.
    """
    planes = []
    for channel in (2, 0):
        largest = 2 * (1 - LUMINANCE[channel])
        difference = (picture[..., channel] - luma) / np.float32(largest)
        rows = (difference[::2] + difference[1::2]) / 2
        before = np.concatenate([rows[:, :1], rows[:, 1:-1:2]], axis=1)
        planes.append(np.asarray((before + 2 * rows[:, ::2] + rows[:, 1::2]) / 4, np.float32))
    return planes


def frames_of(path: Path) -> int:
    """The number of frames that a video's header counts, without decoding it."""
    with av.open(str(path)) as container:
        return container.streams.video[0].frames
