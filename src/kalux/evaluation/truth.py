"""Against ground truth: images at the times of the reference images, nothing scaled and nothing clipped."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError, InputError, require_type
from kalux.evaluation.exposures import compared_recording, of_black
from kalux.evaluation.lpips import LpipsWeights
from kalux.evaluation.method import METHOD_NEEDED, Method
from kalux.evaluation.pairs import Pair, check_intensity
from kalux.evaluation.scores import Scores, score
from kalux.filters.shots import take_shot
from kalux.frames import GROUND_TRUTH_NEEDED, GroundTruth
from kalux.models.camera import Camera, log_covariance, noise_variance
from kalux.readers.numpy_files import DAMAGE
from kalux.recording import RECORDING_NEEDED, Recording, no_frames
from kalux.settings import AUTO, CameraSettings, chosen_response
from kalux.wording import how_many


@dataclass(frozen=True, eq=False)
class Reference:
    """Reference images that a recording's reconstruction can be compared with.

    Attributes
    ----------
    times
        (T,) int64 us, ascending.
    images
        (T, H, W), linear, 1 = a saturated pixel at the recording's median exposure.
    masks
        (T, H, W) bool, True = compared; None: all.
    left_out
        How many images lie outside the time from the middle of the first exposure to the end of the last.
    data_range
        The largest compared value: the data range of PSNR and SSIM.
    noise
        As of `kalux.frames.GroundTruth`.
    masked
        How many images of those within that time are left out because no pixel of theirs is compared.
    """

    times: NDArray[np.int64]
    images: NDArray[np.float32]
    masks: NDArray[np.bool_] | None
    left_out: int
    data_range: float
    noise: tuple[float, float] | None = None
    masked: int = 0

    def described(self, origin: str = "") -> str:
        """The protocol in words; ``origin``, such as " of FILE", says whose truth it is."""
        said = f"ground truth{origin}: {how_many(len(self.times), 'image')}"
        if self.masks is not None:
            said += ", masked pixels and those that no frame sees not compared"
        if self.masked:
            said += f"; {self.masked} more {'is' if self.masked == 1 else 'are'} masked altogether"
        if self.left_out:
            lie = "lies" if self.left_out == 1 else "lie"
            said += f"; {self.left_out} more {lie} before the first or after the last frame"
        return said


def prepare_reference(
    recording: Recording, truth: GroundTruth, mask: NDArray[np.bool_] | None = None
) -> Reference:
    """Check reference images, put them in order, and leave out those before the first and after the last frame.

    Those of which no pixel is compared are left out, too.

    Parameters
    ----------
    recording
        With known exposures.
    truth
        Reference images, in any order.
    mask
        (T, H, W) or (H, W) bool, True = compared; where it is False an image may hold anything, NaN included.
        Default: that of the truth. Pixels that no frame sees (`Frame.valid`) are not compared either.

    Raises
    ------
    InputError
        If the truth is not a `GroundTruth`; if images, times, mask and sensor do not fit together, a compared value is
        not finite or negative, or no image lies within the frames.
    FrameError
        If the recording has no frames.
    """
    require_type("prepare_reference: recording", recording, Recording, RECORDING_NEEDED)
    require_type("prepare_reference: truth", truth, GroundTruth, GROUND_TRUTH_NEEDED)
    times, images = np.asarray(truth.times), np.asarray(truth.images)
    if images.ndim != 3 or images.shape[1:] != recording.sensor_size or times.shape != images.shape[:1]:
        raise InputError(
            f"ground truth: images {images.shape} at {len(times)} times for a sensor of {recording.sensor_size}; "
            "(T, height, width) at T times is needed"
        )
    given = truth.masks if mask is None else mask
    masks = None if given is None else _masks(given, images.shape)
    first, last, seen = _frames_span(recording)
    if not seen.all():
        masks = np.broadcast_to(seen, images.shape) if masks is None else masks & seen
    order = np.argsort(times, kind="stable")
    chosen = order[(times[order] >= first) & (times[order] <= last)]
    if len(chosen) == 0:
        raise InputError(
            f"ground truth: none of {len(times)} images lies within the frames, {first} to {last} us; "
            "is its clock that of the recording?"
        )
    within = len(chosen)
    if masks is not None:
        chosen = chosen[masks[chosen].any(axis=(1, 2))]
    images = images[chosen]
    masks = None if masks is None else masks[chosen]
    compared = images if masks is None else images[masks]
    bad = int(np.count_nonzero(~((compared >= 0) & (compared <= _LARGEST))))
    if bad:
        raise InputError(
            f"ground truth: {bad} of {compared.size} values are negative, beyond {_LARGEST:g} times white or not "
            "finite; mend or mask them"
        )
    if compared.size == 0 or not compared.max() > 0:
        raise InputError("ground truth: nothing to compare, all of it is black or masked")
    return Reference(
        times[chosen].astype(np.int64),
        images,
        masks,
        len(times) - within,
        float(compared.max()),
        truth.noise,
        within - len(chosen),
    )


def lies_between_frames(recording: Recording, times: NDArray[np.int64]) -> bool:
    """Whether no frame of the recording sees the scene at any of ``times`` (us), as of frames that are held out.

    The frames around an image are then a fair comparison with it.
    """
    ordered = np.sort(times)
    for frame in recording.frames():
        first, last = np.searchsorted(ordered, (frame.exposure_start, frame.exposure_end + 1))
        if last > first:
            return False
    return True


_LARGEST: Final = 1e12
"""Times white, as of frames: squares of such values are still numbers."""


def evaluate_truth(
    recording: Recording,
    reference: Reference,
    method: Method,
    *,
    hdr_vdp: bool = False,
    lpips: LpipsWeights | None = None,
    on_image: Callable[[], None] = lambda: None,
) -> Scores:
    """Compare a method's images with the truth.

    Parameters
    ----------
    recording
        With known exposures. Every method is given it less its black level, known or found: truth has none.
    reference
        From `prepare_reference`.
    method
        From `kalux.evaluation.baselines`, or one's own.
    hdr_vdp
        Whether Q is computed, which takes most of the time.
    lpips
        Weights, if LPIPS is to be computed.
    on_image
        Called after every image.

    Raises
    ------
    InputError
        If the reference is not one of `prepare_reference`, or the method no `Method`.
    KaluxError
        Whatever the method or the metrics say.
    """
    require_type(
        "evaluate_truth: reference", reference, Reference, "a Reference is needed, from prepare_reference"
    )
    require_type("evaluate_truth: method", method, Method, METHOD_NEEDED)
    recording = compared_recording(recording, AUTO)
    return score(
        truth_pairs(recording, reference, method),
        method=method.label,
        notes=method.notes,
        protocol=reference.described() + of_black(recording),
        data_range=reference.data_range,
        hdr_vdp=hdr_vdp,
        lpips=lpips,
        on_image=on_image,
    )


def truth_pairs(recording: Recording, reference: Reference, method: Method) -> Iterator[Pair]:
    """A method's images with the reference images, and with its variances where it has them.

    Images of a camera have noise, which counts as an error of theirs, and the recording's fixed pattern. Where a frame
    of the recording has the same middle, it is that frame as the camera saw it (`kalux.datasets.ahdr`): pixels that
    this frame measures are the reference itself, of which a variance says nothing.
    """
    given = _given(recording, reference)
    for i, made in enumerate(method.estimated(recording, reference.times)):
        mask = None if reference.masks is None else reference.masks[i]
        yield Pair(
            int(reference.times[i]),
            made.intensity,
            reference.images[i],
            mask,
            made.variance if reference.noise is None else made.variance_of_frames,
            log_offset=made.log_offset,
            noise=None
            if reference.noise is None or made.variance is None
            else _noise(reference.images[i], reference.noise, made.log_offset),
            given=next(given),
        )


def _noise(image: NDArray[np.float32], noise: tuple[float, float], log_offset: float) -> NDArray[np.float64]:
    """Variance of log(I + I_0) of an image, of its read and shot noise."""
    intensity = np.asarray(image, np.float64)
    return log_covariance(intensity, noise_variance(intensity, noise, 1.0), log_offset)


def _given(recording: Recording, reference: Reference) -> Iterator[NDArray[np.bool_] | None]:
    """Of every reference image, where a frame of the same moment measures it; None: there is none."""
    if reference.noise is None:
        yield from itertools.repeat(None)
        return
    camera = Camera.named(chosen_response(AUTO, recording.response), CameraSettings.usual_saturation)
    frames = iter(recording.frames())
    frame = next(frames)
    for t in reference.times:
        while frame.middle < t and (following := next(frames, None)) is not None:
            frame = following
        if frame.middle == t:
            shot = take_shot(frame, camera, frame.exposure)
            yield ~(shot.clipped | np.isfinite(shot.level_ceiling)[shot.levels])
        else:
            yield None


TRUTH_SUFFIX: Final = "_gt.npz"
"""Reference images beside a recording: ``X_gt.npz`` beside ``X.mat`` or the folder ``X``."""


def with_name_of_its_own(path: Path) -> Path:
    """The same place; where the path ends in ``.`` or ``..``, as its folder is called."""
    return path.resolve() if path.name in ("", "..") else path


def truth_beside(path: Path) -> Path:
    """Where the ground truth of a recording lies, if it has any."""
    path = with_name_of_its_own(path)
    name = path.name if path.is_dir() else path.stem
    return path.with_name(f"{name}{TRUTH_SUFFIX}")


def truth_file(path: Path, named: Path | None = None) -> Path | None:
    """The file of reference images that is named, or else lies beside the recording at ``path``; None: neither."""
    if named is not None:
        return named
    beside = truth_beside(path)
    return beside if beside.is_file() else None


def find_truth(
    recording: Recording, file: Path | None
) -> tuple[GroundTruth | None, NDArray[np.bool_] | None]:
    """Reference images and a mask of ``file`` (from `truth_file`), or else those that the recording holds.

    A file comes first: somebody has made it for this recording, e.g. with `kalux hdr-reference`, and can take it away.

    Raises
    ------
    InputError, FormatError
        As of `load_truth`, or as of `Recording.ground_truth`.
    """
    return (recording.ground_truth(), None) if file is None else load_truth(file)


def load_truth(path: Path) -> tuple[GroundTruth, NDArray[np.bool_] | None]:
    """Reference images from a ``.npz``: ``times_us`` or ``times`` (T, us), ``gt`` or ``images`` (T, H, W).

    Returns
    -------
    The images, and the ``mask`` where there is one: (T, H, W) or (H, W) bool, True = compared.

    Raises
    ------
    InputError
        If the file cannot be read.
    FormatError
        If it is no ``.npz``, or an array is missing or of the wrong type.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files if name in _KEYS}
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or 'not an .npz file'}") from error
    except (AttributeError, *DAMAGE) as error:
        raise FormatError(f"{path}: not an .npz file of plain arrays, or damaged") from error
    times, images = _array(path, arrays, "times_us", "times"), _array(path, arrays, "gt", "images")
    if times.ndim != 1 or times.dtype.kind not in "iu":
        raise FormatError(f"{path}: the times are {times.dtype} {times.shape}; whole us, (T,), are needed")
    if images.ndim != 3 or images.dtype.kind not in "fiu":
        raise FormatError(f"{path}: the images are {images.dtype} {images.shape}; (T, H, W) is needed")
    check_intensity(path, images)
    with np.errstate(over="ignore"):  # what is too large becomes infinite, and is refused unless it is masked
        linear = images.astype(np.float32)
    return GroundTruth(times.astype(np.int64), linear), arrays.get("mask")


_KEYS: Final = ("times_us", "times", "gt", "images", "mask")


def _array(path: Path, arrays: dict[str, NDArray[Any]], *names: str) -> NDArray[Any]:
    for name in names:
        if name in arrays:
            return arrays[name]
    raise FormatError(f"{path}: has no array {' or '.join(names)}")


def _masks(mask: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    given = np.asarray(mask)
    if given.dtype != bool or given.shape not in (shape, shape[1:]):
        raise InputError(
            f"ground truth: the mask is {given.dtype} {given.shape}; bool {shape} or {shape[1:]} is needed"
        )
    return np.broadcast_to(given, shape)


def _frames_span(recording: Recording) -> tuple[int, int, NDArray[np.bool_]]:
    """Middle of the first exposure, where every method can begin, and end of the last, us; which pixels frames see."""
    seen = np.zeros(recording.sensor_size, bool)
    spans = []
    for frame in recording.frames():
        spans.append((frame.middle, frame.exposure_end))
        seen |= True if frame.valid is None else frame.valid
    if not spans:
        raise no_frames(recording)
    return spans[0][0], spans[-1][1], seen
