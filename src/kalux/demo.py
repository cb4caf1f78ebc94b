"""The demonstration: simulate a scene, reconstruct it, set the results beside the truth."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.datasets import DEMO_SENSOR, Scene, Simulation, demo_scene, simulate
from kalux.display import DisplaySettings, Reinhard, apply, measure, to_uint8
from kalux.errors import InputError, OutputError
from kalux.frames import Frame
from kalux.images import Image
from kalux.pipeline import reconstruct
from kalux.recording import Recording
from kalux.writers import Panel, VideoSettings, colour_map, contact_sheet, hdf5, open_writer, variance_limits
from kalux.writers.files import output_errors, write_whole

Float32 = NDArray[np.float32]

PICTURE, VIDEO, RECORDING = "demo.png", "demo.mp4", "demo.h5"
RATE_HZ: Final = 100.0

MOMENT: Final = 780_000
"""us: the middle of an exposure, when the camera has moved long enough to see what is behind the window."""

LOG_OFFSET: Final = 0.03
"""Of the log-MSE, white = 1: errors of much darker pixels do not count."""

_DISPLAY: Final = DisplaySettings(Reinhard())
_SLOW_MOTION: Final = 5.0


class Score(NamedTuple):
    """How far the images of a method are from the truth.

    Attributes
    ----------
    method
        Its name.
    mse
        Mean squared error of the intensity, white = 1.
    log_mse
        Mean squared error of log(intensity + 0.03).
    ssim
        Structural similarity of the tone-mapped images; None where scikit-image is not installed.
    """

    method: str
    mse: float
    log_mse: float
    ssim: float | None


@dataclass(frozen=True, eq=False)
class Comparison:
    """Images of all methods at the same times.

    Attributes
    ----------
    times
        (N,) int64 us.
    held
        The last frame that was finished at each time.
    cf, akf
        Images of the complementary filter, and of the asynchronous Kalman filter.
    pictured
        That of either at the time of the picture.
    """

    simulation: Simulation
    times: NDArray[np.int64]
    held: list[Float32]
    cf: list[Image]
    akf: list[Image]
    pictured: tuple[Image, Image]


def run_demo(
    out: Path,
    *,
    scene: Scene | None = None,
    moment: int | None = None,
    overwrite: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> list[Score]:
    """Simulate, reconstruct, write a picture, a video and the recording.

    Parameters
    ----------
    out
        Folder for `demo.png`, `demo.mp4` and `demo.h5`; created.
    scene
        What to simulate. Default: `kalux.datasets.demo_scene`.
    moment
        Time of the picture, us. Default: `MOMENT`.
    overwrite
        Replace these three files in a folder that is not empty.
    say
        Told what is being done.

    Returns
    -------
    list of Score
        Of the last frame held, the complementary filter and the asynchronous Kalman filter.

    Raises
    ------
    InputError
        The moment is not within the frames.
    OutputError
        The folder is not empty, or cannot be written.
    """
    moment = MOMENT if moment is None else moment
    prepare(out, overwrite=overwrite)
    say("simulating a dim room with a bright window, seen by a moving event camera ...")
    simulation = simulate(scene or demo_scene(), DEMO_SENSOR)
    recording = simulation.recording()
    if not simulation.frames[0].exposure_end <= moment <= simulation.frames[-1].exposure_end:
        raise InputError(f"demo: the moment {moment} us is not within the frames")
    say(
        f"reconstructing it at {RATE_HZ:g} Hz from {len(simulation.events):,} events and "
        f"{len(simulation.frames)} frames ..."
    )
    compared = compare(simulation, recording, moment)
    say(f"writing {out} ...")
    write_recording(out / RECORDING, recording)
    write_picture(out / PICTURE, compared)
    write_video(out / VIDEO, compared, overwrite=overwrite)
    return scores(compared)


def prepare(out: Path, *, overwrite: bool) -> None:
    """Make the folder, or check that it may be used.

    Raises
    ------
    OutputError
        It is not empty and ``overwrite`` is False, or cannot be made.
    """
    with output_errors(out, "the demo writes to a folder"):
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()) and not overwrite:
            raise OutputError(
                f"{out}: the folder is not empty; choose another one with -o, or add --overwrite"
            )


def compare(simulation: Simulation, recording: Recording, moment: int) -> Comparison:
    """Reconstruct with both filters, at times that both can tell, and at that of the picture (us)."""
    begin, end = simulation.frames[0].exposure_end, simulation.frames[-1].exposure_end
    times = np.arange(begin, end + 1, round(1e6 / RATE_HZ), dtype=np.int64)
    # All at once: planning takes longer than the images.
    cf, akf = (
        {image.t: image for image in reconstruct(recording, times=np.union1d(times, moment), preset=preset)}
        for preset in ("cf", "default")
    )
    return Comparison(
        simulation,
        times,
        [held_frame(simulation.frames, int(t)) for t in times],
        [cf[int(t)] for t in times],
        [akf[int(t)] for t in times],
        (cf[moment], akf[moment]),
    )


def held_frame(frames: Sequence[Frame], t: int) -> Float32:
    """The intensity of the last frame finished at ``t``: what a camera without events shows."""
    last = [frame for frame in frames if frame.exposure_end <= t][-1]
    return last.normalised().astype(np.float32)


# What is written.


def write_recording(path: Path, recording: Recording) -> None:
    """The recording with its truth, for ``kalux reconstruct``."""
    hdf5.write(
        path,
        sensor_size=recording.sensor_size,
        events=recording.events(),
        frames=recording.frames(),
        contrast_threshold=recording.contrast_threshold,
        ground_truth=recording.ground_truth(),
    )


def write_picture(path: Path, compared: Comparison) -> None:
    """One moment by all methods, all through the truth's tone curve."""
    simulation, moment = compared.simulation, compared.pictured[0].t
    frame = min(simulation.frames, key=lambda frame: abs(frame.middle - moment))
    data = encoded(picture(frame, *compared.pictured, simulation.scene.at(float(moment))))
    with output_errors(path):
        write_whole(path, data)


def picture(frame: Frame, cf: Image, akf: Image, truth: Float32) -> NDArray[np.uint8]:
    """The contact sheet, uint8 RGB."""
    assert akf.variance is not None
    statistics = measure(truth, _DISPLAY.curve)

    def shown(intensity: Float32) -> NDArray[np.uint8]:
        return to_uint8(apply(intensity, _DISPLAY, statistics))

    limits = variance_limits(akf.variance)
    error = squared_log_error(akf.intensity, truth)
    return contact_sheet(
        [
            ("camera frame: window clipped", shown(frame.normalised().astype(np.float32))),
            ("kalux (AKF): HDR", shown(akf.intensity)),
            ("truth", shown(truth)),
            ("complementary filter (CF)", shown(cf.intensity)),
            Panel("AKF's uncertainty", colour_map(akf.variance, limits), limits),
            Panel("AKF's true error", colour_map(error, limits), limits),
        ],
        columns=3,
    )


def encoded(rgb: NDArray[np.uint8]) -> bytes:
    """A PNG."""
    _, data = cv2.imencode(".png", rgb[..., ::-1])
    return bytes(data)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two images side by side, for the video."""

    t: int
    intensity: Float32
    variance: Float32


def write_video(path: Path, compared: Comparison, *, overwrite: bool) -> None:
    """The held frame beside the AKF, in slow motion."""
    writer = open_writer(
        path,
        display=_DISPLAY,
        rate_hz=RATE_HZ,
        overwrite=overwrite,
        metadata={"demo": {"left": "last camera frame", "right": "AKF"}},
        video=VideoSettings(slow_motion=_SLOW_MOTION),
    )
    with writer:
        for held, image in zip(compared.held, compared.akf, strict=True):
            pair = np.concatenate([held, image.intensity], axis=1).repeat(2, axis=0).repeat(2, axis=1)
            writer.write(_Pair(image.t, pair, np.zeros_like(pair)))


# What is measured.


def scores(compared: Comparison) -> list[Score]:
    """The errors of all methods, over all times."""
    truth = [compared.simulation.scene.at(float(t)) for t in compared.times]
    methods = {
        "last frame, held": compared.held,
        "complementary filter (CF)": [image.intensity for image in compared.cf],
        "kalux (AKF)": [image.intensity for image in compared.akf],
    }
    return [score(name, images, truth) for name, images in methods.items()]


def score(method: str, images: Sequence[Float32], truth: Sequence[Float32]) -> Score:
    """The mean errors of some images."""
    pairs = list(zip(images, truth, strict=True))
    return Score(
        method,
        float(np.mean([np.mean((image - true) ** 2) for image, true in pairs])),
        float(np.mean([squared_log_error(image, true).mean() for image, true in pairs])),
        float(np.mean(list(_similarities(pairs)))) if importlib.util.find_spec("skimage") else None,
    )


def squared_log_error(intensity: Float32, truth: Float32) -> Float32:
    """(log(intensity + 0.03) - log(truth + 0.03))^2."""
    offset = np.float32(LOG_OFFSET)
    error: Float32 = np.square(np.log(intensity + offset) - np.log(truth + offset))
    return error


def _similarities(pairs: Sequence[tuple[Float32, Float32]]) -> Iterator[float]:
    from skimage.metrics import structural_similarity

    for image, true in pairs:
        statistics = measure(true, _DISPLAY.curve)
        shown = [apply(intensity, _DISPLAY, statistics) for intensity in (image, true)]
        yield float(structural_similarity(*shown, data_range=1.0))  # type: ignore[no-untyped-call]
