"""Radiance from files: photographs, and sequences of images in a folder or a video.

HDR files (Radiance `.hdr`, OpenEXR) hold linear radiance and are taken as they are; 8 and 16 bit images and videos
are decoded as sRGB, 1.0 = their white, above which they know nothing. Colour becomes luminance (ITU-R BT.709).
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.datasets.exr import exr_channels, exr_image, is_exr
from kalux.datasets.motion import Motion
from kalux.datasets.scenes import Image, Scene, blurred, camera_matrix, check_scale, sample
from kalux.errors import FormatError, InputError
from kalux.models.camera import Response
from kalux.models.colour import LUMINANCE
from kalux.readers.images import IMAGES, RADIANCE, decoded, images_in
from kalux.readers.source import reading
from kalux.readers.videos import opened_video
from kalux.wording import how_many

_KEPT: Final = 4  # images of an interpolation
_MOMENTS: Final = 16  # of a scene, by which white is chosen
_DARKEST: Final = 1e-4
"""Added before the logarithm of interpolation, as part of white: black pixels have one, too."""

_VIDEO_BYTES: Final = 1 << 28
"""Of a video's pictures that are kept: 32 of 1920x1080. A simulation goes back by up to 4 ms again and again, which are
five pictures at 1000 Hz, and by the rows of a rolling shutter."""

_VIDEO_LEAST: Final = 8  # pictures, if they are so large that fewer fill that

_LEAST_WHITE: Final = 1e-30
_LARGEST_WHITE: Final = 1e30


class Photograph(NamedTuple):
    """An image file.

    Attributes
    ----------
    radiance
        (H, W) float32, linear, not negative: a luminance below 0, as of colours outside of the gamut and of dark noise,
        is taken as black.
    alpha
        (H, W) float32, 0 to 1; None where the file has none.
    is_hdr
        Whether it was stored as linear radiance. Otherwise it was decoded from sRGB, and 1.0 is its white.
    doubt
        How many pixels were negative, a sentence; None if none was.
    premultiplied
        Whether the radiance is already times alpha, as OpenEXR has it.
    """

    radiance: Image
    alpha: Image | None
    is_hdr: bool
    doubt: str | None = None
    premultiplied: bool = False


class ImageSequence(NamedTuple):
    """Images evenly spaced in time.

    Attributes
    ----------
    path
        Of the folder or video.
    length
        Number of images.
    size
        (height, width) of each, pixels.
    image
        Called with an index, returns the radiance (H, W) float32.
    is_hdr
        As of `Photograph`.
    rate_hz
        What a video says of its rate; None for a folder.
    """

    path: Path
    length: int
    size: tuple[int, int]
    image: Callable[[int], Image]
    is_hdr: bool
    rate_hz: float | None


def read_photograph(path: Path) -> Photograph:
    """Read an image as radiance.

    Raises
    ------
    InputError
        If the file cannot be read.
    FormatError
        If it is no image that can be decoded, has whole numbers with a sign or of more than 16 bits, values that are
        not finite, or is negative in half of its pixels or more.
    """
    with reading(path):
        data = path.read_bytes()
    colour: NDArray[Any]
    if is_exr(data):
        channels = exr_channels(path, data)
        colour, alpha = exr_image(path, channels), channels.get("A")
    else:
        pixels = decoded(data, path)
        if pixels is None:
            raise FormatError(f"{path}: not an image, or damaged; .hdr, .exr, .png, .jpg or .tif is needed")
        colour, alpha = _split_alpha(pixels)
    is_hdr = colour.dtype.kind == "f"
    if not is_hdr and colour.dtype not in (np.uint8, np.uint16):
        raise FormatError(
            f"{path}: its values are {colour.dtype}; whole numbers of 8 or 16 bits without a sign, or floats are needed"
        )
    linear = colour.astype(np.float32) if is_hdr else _from_srgb(colour)
    radiance = linear if linear.ndim == 2 else np.asarray(linear @ LUMINANCE, np.float32)
    if min(radiance.shape) < 2:
        raise FormatError(f"{path}: {radiance.shape[1]}x{radiance.shape[0]} pixels; at least 2x2 are needed")
    unknown, negative = ~np.isfinite(radiance), radiance < 0
    if unknown.any():
        raise FormatError(f"{path}: {_part(unknown)} not finite (NaN or infinite); linear radiance is needed")
    if 2 * negative.sum() >= negative.size:
        raise FormatError(f"{path}: {_part(negative)} negative; linear radiance is needed")
    doubt = None
    if negative.any():
        doubt = f"{path}: {_part(negative)} negative, down to {radiance.min():.2g}, and taken as black"
        radiance = np.maximum(radiance, np.float32(0))
    return Photograph(np.ascontiguousarray(radiance), alpha, is_hdr, doubt, premultiplied=is_exr(data))


def _part(which: NDArray[np.bool_]) -> str:
    """``12 of 3,400 pixels (0.35 %) are``."""
    count, verb = int(which.sum()), "is" if which.sum() == 1 else "are"
    return f"{count:,} of {how_many(which.size, 'pixel')} ({100 * count / which.size:.2g} %) {verb}"


def _split_alpha(pixels: NDArray[Any]) -> tuple[NDArray[Any], Image | None]:
    """(H, W) grey or (H, W, 3) RGB, and alpha, from OpenCV's order."""
    if pixels.ndim == 2:
        return pixels, None
    top = 1.0 if pixels.dtype.kind == "f" else float(np.iinfo(pixels.dtype).max)
    alpha = np.asarray(pixels[..., 3] / top, np.float32) if pixels.shape[2] == 4 else None
    return pixels[..., 2::-1], alpha


def _from_srgb(pixels: NDArray[Any]) -> Image:
    top = int(np.iinfo(pixels.dtype).max)
    table = Response.srgb().inverse(np.arange(top + 1) / top).astype(np.float32)
    return np.asarray(table[pixels])


# --- sequences --------------------------------------------------------------------------------------------


def open_sequence(path: Path, warn: Callable[[str], None] = lambda doubt: None) -> ImageSequence:
    """A folder of images, in the order of the numbers in their names, or a video.

    ``warn`` is called with the `Photograph.doubt` of the first image that has one.

    Raises
    ------
    InputError
        If there is no such file or folder.
    FormatError
        If it holds fewer than two images, images of different sizes or kinds, or cannot be decoded.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    return _folder(path, warn) if path.is_dir() else _video(path)


def _folder(path: Path, warn: Callable[[str], None]) -> ImageSequence:
    files = images_in(path, IMAGES | RADIANCE)
    if len(files) < 2:
        raise FormatError(f"{path}: has {how_many(len(files), 'image')}; a sequence needs two or more")
    kinds = {file.suffix.lower() in RADIANCE for file in files}
    if len(kinds) > 1:
        raise FormatError(f"{path}: has HDR and ordinary images; keep one kind of them")
    doubts: list[str] = []

    def photograph(index: int) -> Photograph:
        found = read_photograph(files[index])
        if found.doubt is not None and not doubts:
            doubts.append(found.doubt)
            warn(f"{found.doubt}; of other images of the folder this is not said again")
        return found

    first = photograph(0)

    def image(index: int) -> Image:
        found = photograph(index).radiance
        if found.shape != first.radiance.shape:
            raise FormatError(
                f"{files[index]}: {found.shape[1]}x{found.shape[0]} pixels, the first image of the folder has "
                f"{first.radiance.shape[1]}x{first.radiance.shape[0]}"
            )
        return found

    return ImageSequence(path, len(files), first.radiance.shape, image, first.is_hdr, None)


def _video(path: Path) -> ImageSequence:
    with opened_video(path) as container:
        if not container.streams.video:
            raise FormatError(f"{path}: neither an image nor a video that can be decoded")
        stream = container.streams.video[0]
        rate = None if stream.average_rate is None else float(stream.average_rate)
        size, count = None, 0
        for picture in container.decode(stream):
            size, count = (picture.height, picture.width), count + 1
    if size is None or count < 2:
        raise FormatError(f"{path}: has {count} pictures; a sequence needs two or more")
    return ImageSequence(path, count, size, _VideoPictures(path, size), False, rate)


class _VideoPictures:
    """Pictures of a video by index: decoded onwards from the last one.

    The last 256 MiB of pictures (8 at least) are kept. To go further back is to decode from the start again.
    """

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        self._path = path
        self._pictures: Iterator[Image] = iter(())
        self._next = 0
        picture = size[0] * size[1] * np.dtype(np.float32).itemsize
        self._kept: deque[Image] = deque(maxlen=max(_VIDEO_BYTES // picture, _VIDEO_LEAST))

    def __call__(self, index: int) -> Image:
        if index < self._next - len(self._kept) or self._next == 0:
            self._pictures, self._next = _decoded_video(self._path), 0
            self._kept.clear()
        while self._next <= index:
            image = next(self._pictures, None)
            if image is None:
                raise FormatError(f"{self._path}: picture {index} cannot be decoded; copy it again")
            self._kept.append(image)
            self._next += 1
        return self._kept[index - self._next]


def _decoded_video(path: Path) -> Iterator[Image]:
    with opened_video(path) as container:
        for picture in container.decode(container.streams.video[0]):
            deep = picture.format.components[0].bits > 8
            colour = picture.to_ndarray(format="rgb48le" if deep else "rgb24")
            yield np.asarray(_from_srgb(colour) @ LUMINANCE, np.float32)


def interpolated(sequence: ImageSequence, rate_hz: float) -> Callable[[float], Image]:
    """Radiance of a sequence at any time, us after its first image.

    Between two images, the logarithm of the radiance (plus 1e-4) changes linearly: each pixel brightens or darkens at
    a constant rate of events. What moves by more than a pixel from one image to the next fades instead of moving.
    """
    kept: OrderedDict[int, Image] = OrderedDict()

    def log_image(index: int) -> Image:
        if index not in kept:
            kept[index] = np.log(sequence.image(index) + np.float32(_DARKEST))
            if len(kept) > _KEPT:
                kept.popitem(last=False)
        kept.move_to_end(index)
        return kept[index]

    def radiance(t: float) -> Image:
        position = min(max(t * 1e-6 * rate_hz, 0.0), sequence.length - 1.0)
        index = min(int(position), sequence.length - 2)
        before = log_image(index)
        share = np.float32(position - index)
        level = before + share * (log_image(index + 1) - before)
        return np.maximum(np.exp(level) - np.float32(_DARKEST), np.float32(0.0))

    return radiance


def sequence_scene(
    sequence: ImageSequence,
    motion: Motion,
    *,
    sensor_size: tuple[int, int],
    rate_hz: float,
    duration: int | None = None,
    scale: float | None = None,
    white: float = 1.0,
    blur: float = 0.5,
) -> Scene:
    """A camera that looks at a sequence of images, and may move over them.

    Parameters
    ----------
    sequence
        From `open_sequence`.
    motion
        Of the camera, as of `kalux.datasets.photograph_scene`.
    sensor_size
        (height, width), pixels.
    rate_hz
        Images per second.
    duration
        us. Default: to the last image.
    scale
        Image pixels per sensor pixel. Default: the largest view that fits into the image.
    white
        Radiance of frame white.
    blur
        Sigma of the Gaussian that stands for lens and pixel aperture, sensor pixels.

    Raises
    ------
    InputError
        If the rate is not 1 uHz to 1 MHz, or the sequence is shorter than the duration; or as of `check_scale`.
    """
    if not 1e-6 <= rate_hz < 1e6:  # also refuses NaN
        raise InputError(
            f"{sequence.path}: the rate is {rate_hz} Hz; it must be 0.000001 Hz or more, less than 1 MHz"
        )
    lasts = int((sequence.length - 1) / rate_hz * 1e6)
    if duration is not None and duration > lasts:
        raise InputError(
            f"{sequence.path}: {sequence.length} images at {rate_hz:g} Hz last {lasts * 1e-6:g} s, "
            f"{duration * 1e-6:g} s are wanted; give a shorter duration or a lower rate"
        )
    step = fitting_scale(sequence.size, sensor_size) if scale is None else scale
    check_scale(str(sequence.path), step, sequence.size)
    center = ((sequence.size[1] - 1) / 2, (sequence.size[0] - 1) / 2)
    source = interpolated(sequence, rate_hz)

    def radiance(t: float) -> Image:
        out = np.empty(sensor_size, np.float32)
        canvas = blurred(np.ascontiguousarray(source(t)), blur * step if step > 1 else 0.0)
        sample(canvas, camera_matrix(motion(t), sensor_size, step, center), out)
        return out / np.float32(white)

    return Scene(radiance, sensor_size, 0, lasts if duration is None else duration, str(sequence.path))


def fitting_scale(image_size: tuple[int, int], sensor_size: tuple[int, int], part: float = 1.0) -> float:
    """Image pixels per sensor pixel with which the sensor sees at most ``part`` of the image's height and width."""
    return part * min((image_size[0] - 1) / (sensor_size[0] - 1), (image_size[1] - 1) / (sensor_size[1] - 1))


# --- exposure level ---------------------------------------------------------------------------------------


def exposed(scene: Scene, white: float) -> Scene:
    """The same scene with its radiance divided by ``white``, which then saturates a frame.

    Raises
    ------
    InputError
        If white is not 1e-30 to 1e30: single precision holds no more.
    """
    if not _LEAST_WHITE <= white <= _LARGEST_WHITE:
        raise InputError(
            f"{scene.name}: white is a radiance of {white}; it must be positive, {_LEAST_WHITE:g} to "
            f"{_LARGEST_WHITE:g}"
        )
    scale = np.float32(1.0 / white)
    return Scene(lambda t: scene.radiance(t) * scale, scene.sensor_size, scene.start, scene.end, scene.name)


def white_for(scene: Scene, saturated: float) -> float:
    """The radiance above which a fraction ``saturated`` of a scene's pixels lies, over evenly spaced moments.

    Raises
    ------
    InputError
        If the fraction is not between 0 and 1, or that part of the scene is black.
    """
    if not 0 < saturated < 1:
        raise InputError(
            f"{scene.name}: a fraction of {saturated} saturated pixels; it must be between 0 and 1"
        )
    times = scene.start + (np.arange(_MOMENTS) + 0.5) / _MOMENTS * scene.duration
    seen = np.concatenate([np.asarray(scene.at(float(t)), np.float32).ravel() for t in times])
    white = float(np.quantile(seen, 1.0 - saturated))
    if not white > 0:
        raise InputError(
            f"{scene.name}: {saturated:.0%} of its pixels cannot saturate, so much of it is black; give white itself"
        )
    return white
