"""A job: one method on one sequence. It is small, can be sent anywhere, and its outcome is plain values and arrays."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import kalux
from kalux.errors import InputError, KaluxError
from kalux.evaluation.baselines import frames_around
from kalux.evaluation.benchmark.sequences import EVERY, Options, Sequence, files_under
from kalux.evaluation.exposures import compared_recording, linear_frame, of_black
from kalux.evaluation.held_out import held_out_pairs, hold_out_frames
from kalux.evaluation.lpips import load_lpips
from kalux.evaluation.method import Method
from kalux.evaluation.pairs import Pair
from kalux.evaluation.scores import Scores, finite_or_none, score
from kalux.evaluation.specs import chosen_methods, relocated, spec_path
from kalux.evaluation.truth import find_truth, lies_between_frames, prepare_reference, truth_pairs
from kalux.models.camera import Camera, Response
from kalux.recording import Recording, reference_exposure
from kalux.settings import chosen_response, to_dict
from kalux.writers.settings_file import versions

MOMENTS: Final = 3
"""Times of a sequence at which pictures are kept."""

GROUPS: Final = {False: "Ground truth", True: "Held-out frames"}

_JOBS: Final = ("jobs.py", "sequences.py")
"""Modules of the benchmark that a job runs; the others plan it or show what it found."""

_LIBRARIES: Final = ("numpy", "scipy", "numba", "scikit-image", "opencv-python-headless")


@dataclass(frozen=True)
class Job:
    """One method on one sequence.

    Attributes
    ----------
    sequence
        The sequence.
    method
        Name, as `kalux.evaluation.specs.chosen_methods` takes it.
    held_out
        Whether frames are held out; else it is compared with ground truth.
    hdr_vdp
        Whether Q is computed.
    key
        Digest of all that the scores depend on, from `make_job`.
    version
        Of the kalux that made the job; another one refuses to run it.
    code
        `code_digest` of the same.
    folder
        That a file or folder in the method's name is relative to; absolute.
    lpips
        Files of weights, as of `kalux.evaluation.lpips.load_lpips`; empty: LPIPS is not computed.
    between
        Whether its ground truth lies between the frames that methods are given, as of `truth_lies_between`.
    """

    sequence: Sequence
    method: str
    held_out: bool
    hdr_vdp: bool
    key: str
    version: str
    folder: Path
    lpips: tuple[Path, ...] = ()
    between: bool = False
    code: str = ""

    @property
    def name(self) -> str:
        """Sequence and method, for messages."""
        return f"{self.sequence.name}/{self.method}"


@dataclass(frozen=True, eq=False)
class Finished:
    """The outcome of a job.

    Attributes
    ----------
    record
        Plain values for JSON; docs/benchmark.md lists them.
    pictures
        ``times`` (K,) us, ``frame``, ``reference``, ``test`` and maybe ``variance`` (K, H, W) float32.
    """

    record: dict[str, Any]
    pictures: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Failed:
    """A job that could not be done.

    Attributes
    ----------
    message
        One line.
    is_bug
        Whether the error is kalux's own.
    """

    message: str
    is_bug: bool


Outcome = Finished | Failed


@cache
def code_digest() -> str:
    """A digest of all modules of kalux that scores can depend on: results of others are not of one table.

    Of versions in development there are many of one number. The command line and the report are left out.
    """
    package = Path(kalux.__file__).parent
    benchmark, digest = package / "evaluation" / "benchmark", hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        shows = file.is_relative_to(package / "cli") or (file.parent == benchmark and file.name not in _JOBS)
        if not shows:
            digest.update(f"{file.relative_to(package).as_posix()}\n".encode())
            digest.update(file.read_bytes().replace(b"\r\n", b"\n"))  # as a checkout may have them
    return digest.hexdigest()[:16]


def uses_held_out(sequence: Sequence) -> bool:
    """Whether frames of a sequence are held out from methods: it says so, or has no ground truth.

    Raises
    ------
    KaluxError
        If the recording cannot be opened.
    """
    if sequence.options.hold_out_frames is not None:
        return True
    return sequence.truth_file() is None and sequence.open().source.ground_truth is None


def truth_lies_between(sequence: Sequence) -> bool:
    """Whether all ground truth that is compared lies between the frames, as of artificial HDR with frames held out.

    Raises
    ------
    KaluxError
        If recording or truth cannot be read, or do not fit together.
    """
    if sequence.options.ahdr is not None:  # the truth is of its frames
        return False
    recording = sequence.open()
    truth, mask = find_truth(recording, sequence.truth_file())
    if truth is None:
        return False
    return lies_between_frames(recording, prepare_reference(recording, truth, mask).times)


def make_job(
    sequence: Sequence,
    method: str,
    *,
    held_out: bool,
    hdr_vdp: bool,
    folder: Path = Path(),
    lpips: tuple[Path, ...] = (),
    between: bool = False,
) -> Job:
    """A job with its key; the rest is as in `Job`.

    The key is a digest of: path, size and time of change of every file of the sequence, of the file or folder in a
    method's name, and of the weights of LPIPS; the sequence's options; the method's name and settings; whether Q is
    computed; the version of kalux and its code.

    Raises
    ------
    KaluxError
        If there is no such method, or what it or the sequence names cannot be read.
    """
    folder = folder.absolute()
    weights = tuple(file.absolute() for file in lpips)
    chosen = _method(method, sequence, held_out or between, folder)
    named = spec_path(method_text(method, sequence.name, folder))
    parts = {
        "kalux": kalux.__version__,
        "code": code_digest(),
        "files": [_identity(path) for path in sequence.files()],
        "options": {k: str(v) for k, v in dataclasses.asdict(sequence.options).items()},
        "held_out": held_out,
        "method": method,
        "method_files": []
        if named is None or not named.exists()
        else [_identity(path) for path in files_under(named)],
        "settings": None if chosen.settings is None else to_dict(chosen.settings),
        "hdr_vdp": hdr_vdp,
        "lpips": [_identity(path) for path in weights],
    }
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
    return Job(
        sequence,
        method,
        held_out,
        hdr_vdp,
        digest,
        kalux.__version__,
        folder,
        weights,
        between,
        code_digest(),
    )


def _identity(path: Path) -> tuple[str, int, int]:
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    return str(path.absolute()), status.st_size, status.st_mtime_ns


def _method(name: str, sequence: Sequence, between: bool, folder: Path) -> Method:
    text = method_text(name, sequence.name, folder)
    return chosen_methods(
        [text], response=sequence.response, held_out=between, calibration=sequence.calibration
    )[0]


def method_text(name: str, sequence: str, folder: Path) -> str:
    """A method's name, ``{sequence}`` replaced by that of the sequence, and its file or folder made absolute."""
    return relocated(name.replace("{sequence}", sequence), folder)


def run_job(job: Job) -> Outcome:
    """Do a job. Whatever goes wrong is an outcome, too."""
    try:
        if job.version != kalux.__version__:
            raise InputError(
                f"the job is for kalux {job.version}, this is {kalux.__version__}; install the same"
            )
        if job.code != code_digest():
            raise InputError(
                f"the job is for other code of kalux {job.version} than there is here; install the same"
            )
        return _run(job)
    except KaluxError as error:
        return Failed(" ".join(str(error).split()), is_bug=False)
    except Exception as error:
        text = " ".join(f"{type(error).__name__} inside kalux: {error}".split())
        return Failed(text, is_bug=not isinstance(error, (MemoryError, OSError)))


def _run(job: Job) -> Finished:
    started = time.perf_counter()
    recording = job.sequence.open()
    method = _method(job.method, job.sequence, job.held_out or job.between, job.folder)
    comparison = _comparison(job, recording)
    pictures = Pictures(moments(comparison.images))
    clock = Clock()

    def watched() -> Iterator[Pair]:
        for i, pair in enumerate(clock.timed(comparison.pairs(method))):
            pictures.add(i, pair)
            yield pair

    scores = score(
        watched(),
        method=method.label,
        protocol=comparison.described,
        data_range=comparison.data_range,
        scale=comparison.scale,
        notes=method.notes,
        hdr_vdp=job.hdr_vdp,
        lpips=load_lpips(*job.lpips) if job.lpips else None,
    )
    record = {
        "key": job.key,
        "code": job.code,
        "sequence": described(job),
        "method": {
            "name": job.method,
            "label": method.label,
            "settings": None if method.settings is None else to_dict(method.settings),
        },
        "scores": _scored(scores),
        "calibration": scores.calibration,
        "camera": camera_curves(recording, method),
        "seconds": {"images": clock.seconds, "all": time.perf_counter() - started},
        "versions": {"kalux": kalux.__version__, **versions(_LIBRARIES)},
    }
    inputs = comparison.given
    return Finished(
        finite_or_none(record),
        pictures.arrays(
            inputs, reference_exposure(inputs), chosen_response(job.sequence.response, inputs.response)
        ),
    )


def described(job: Job) -> dict[str, Any]:
    """The sequence of a job, as plain values."""
    sequence = job.sequence
    options = {
        **dataclasses.asdict(sequence.options),
        "truth": None if sequence.options.truth is None else str(sequence.options.truth),
        "calibration": [str(file) for file in sequence.options.calibration],
    }
    return {
        "name": sequence.name,
        "title": sequence.title,
        "group": sequence.group or GROUPS[job.held_out],
        "path": str(sequence.path),
        "files": [str(path) for path in sequence.files()]
        if len(sequence.files()) < 10
        else [str(sequence.path)],
        "held_out": job.held_out,
        **options,
    }


def _scored(scores: Scores) -> dict[str, Any]:
    return {
        "protocol": scores.protocol,
        "adjustments": scores.adjustments(),
        "data_range": scores.data_range,
        "scale": scores.scale,
        "negative": scores.negative,
        "pixels": scores.pixels,
        "means": scores.means(),
        "per_image": [dataclasses.asdict(image) for image in scores.images],
    }


# What is compared with what.


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Images with their references: of `kalux.evaluation.truth` or `kalux.evaluation.held_out`.

    Attributes
    ----------
    given
        The recording as methods see it.
    images
        How many are compared.
    """

    described: str
    given: Recording
    images: int
    data_range: float
    scale: float
    pairs: Callable[[Method], Iterator[Pair]]


def _comparison(job: Job, recording: Recording) -> _Comparison:
    options = job.sequence.options
    if job.held_out and options.ahdr is None:
        held = hold_out_frames(
            recording,
            EVERY if options.hold_out_frames is None else options.hold_out_frames,
            response=job.sequence.response,
            black_level=job.sequence.black_level,
        )
        return _Comparison(
            held.described(),
            held.kept,
            len(held.compared),
            1.0,
            held.scale,
            lambda m: held_out_pairs(held, m),
        )
    truth, mask = find_truth(recording, job.sequence.truth_file())
    if truth is None:
        raise InputError(f"{recording.source.path}: its ground truth has gone; start again")
    reference = prepare_reference(recording, truth, mask)
    recording = compared_recording(recording, job.sequence.response, job.sequence.black_level)
    said = reference.described("" if options.ahdr is None else _artificial_described(options))
    return _Comparison(
        said + of_black(recording),
        recording,
        len(reference.times),
        reference.data_range,
        1.0,
        lambda m: truth_pairs(recording, reference, m),
    )


def _artificial_described(options: Options) -> str:
    """What the truth of an artificial recording is, as the end of a sentence."""
    assert options.ahdr is not None
    frames = "original frames"
    if options.hold_out_frames is not None:
        frames = f"original frames held out, one of {options.hold_out_frames}"
    return f" of artificial HDR, black up to {options.ahdr.low:g} and white from {options.ahdr.high:g} of 255, {frames}"


class Clock:
    """Times an iterator, not what is done between its items."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def timed(self, pairs: Iterator[Pair]) -> Iterator[Pair]:
        """The same items."""
        while True:
            start = time.perf_counter()
            pair = next(pairs, None)
            self.seconds += time.perf_counter() - start
            if pair is None:
                return
            yield pair


# Pictures.


def moments(images: int) -> list[int]:
    """Numbers of the images that are shown: the middles of equal parts of the sequence."""
    return sorted({images * (2 * k + 1) // (2 * MOMENTS) for k in range(MOMENTS)})


class Pictures:
    """Keeps some of the pairs for the report.

    Parameters
    ----------
    chosen
        Their numbers.
    """

    def __init__(self, chosen: list[int]) -> None:
        self._chosen = {*chosen}
        self._kept: list[Pair] = []

    def add(self, number: int, pair: Pair) -> None:
        """Keep the pair if it is one of the chosen."""
        if number in self._chosen:
            # Copied: a method may write the next image into the same array.
            variance = None if pair.variance is None else np.array(pair.variance)
            self._kept.append(pair._replace(test=np.array(pair.test), variance=variance))

    def arrays(self, given: Recording, reference: int, response: str) -> dict[str, NDArray[Any]]:
        """As in `Finished.pictures`; ``frame`` is the last frame that the method was given."""
        times = np.array([pair.t for pair in self._kept], np.int64)
        frames = [before or after for before, after, _ in frames_around(given.frames(), times)]
        found = {
            "frame": [linear_frame(f, reference, response) for f in frames if f is not None],
            "reference": [_masked(pair.reference, pair) for pair in self._kept],
            "test": [pair.test for pair in self._kept],
        }
        if all(pair.variance is not None for pair in self._kept):
            found["variance"] = [np.asarray(pair.variance) for pair in self._kept]
        return {"times": times, **{name: np.stack(a).astype(np.float32) for name, a in found.items()}}


def _masked(image: NDArray[Any], pair: Pair) -> NDArray[Any]:
    """The image with NaN where nothing is compared."""
    return np.asarray(image, np.float64) if pair.mask is None else np.where(pair.mask, image, np.nan)


# The camera model, for Figure 2.


def _short(responses: list[str]) -> str:
    """A response's name, without the values of a measured one."""
    kind, _, values = responses[len(responses) // 2].partition(":")
    return "as calibrated" if kind == "curve" else f"{kind}:{values}" if values else kind


def camera_curves(recording: Recording, method: Method) -> dict[str, Any] | None:
    """f^w (5) and R_bar (6) for sigma_im^2 = 1 over the camera's response, as the method uses them.

    Returns
    -------
    ``source`` (the response's name, or that it is the recording's own table), ``response``, ``weight`` and
    ``covariance``, lists of equal length, with None where a pixel counts as clipped and has no weight at all. None for
    a method without a model of the camera's noise.
    """
    settings = method.settings
    if settings is None or settings.filter.kind == "cf":
        return None
    camera_settings = settings.camera
    named = chosen_response(camera_settings.response, recording.response).split(";")
    response = Response.named(named[len(named) // 2])  # of three the green
    table = recording.source.inverse_covariance
    saturation = camera_settings.clipped_from
    camera = (
        Camera(response, None, saturation)
        if table is None
        else Camera.from_inverse_covariance(table, response, saturation)
    )
    levels = np.linspace(0.0, 1.0, 256)
    if settings.filter.augmentation == "paper":
        weight = camera.weight(levels)
        usable, floor = np.ones(len(levels), bool), camera_settings.weight_floor
    else:
        weight = camera.measured_weight(levels)
        usable, floor = levels < saturation, 1e-6
    r_bar = np.maximum(weight, floor) ** -1
    return {
        "source": f"response {_short(named)}" if table is None else "table of the recording (f_Q)",
        "response": levels.round(5).tolist(),
        "weight": [float(w) if u else 0.0 for w, u in zip(weight, usable, strict=True)],
        "covariance": [float(r) if u else None for r, u in zip(r_bar, usable, strict=True)],
    }
