"""A simulation written to a file while it is made: memory does not grow with its length."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from kalux.datasets.event_stream import event_chunks
from kalux.datasets.exposure import frame_stream, plan_exposures
from kalux.datasets.scenes import Scene
from kalux.datasets.sensors import Sampling, SensorSettings
from kalux.datasets.simulate import check_seed, truth_images, truth_times
from kalux.errors import InputError
from kalux.events import EventArray
from kalux.writers import hdf5


class Recorded(NamedTuple):
    """What was written.

    Attributes
    ----------
    events, on_events, frames, truth
        Numbers of events, of ON events among them, of frames, and of images of ground truth.
    exposures
        (shortest, longest), us.
    """

    events: int
    on_events: int
    frames: int
    truth: int
    exposures: tuple[int, int]


def record(
    path: str | Path,
    scene: Scene,
    settings: SensorSettings | None = None,
    *,
    seed: int = 0,
    exposures: Sequence[int] | None = None,
    sampling: Sampling | None = None,
    truth_rate: float | None = None,
    on_time: Callable[[float], None] = lambda t: None,
) -> Recorded:
    """Simulate, as `kalux.datasets.simulate` does, into a kalux HDF5 file with ground truth.

    Parameters
    ----------
    path
        Replaced if it exists. The file appears when it is complete.
    scene, settings, seed, exposures, sampling
        As of `simulate`, with the same result.
    truth_rate
        Images of ground truth per second. Default: in the middle of the frames and halfway between, see
        `kalux.datasets.simulate.truth_times`.
    on_time
        Told up to which time, us, the events are simulated.

    Raises
    ------
    InputError
        As of `simulate`; and if the scene is too short for one frame.
    OutputError
        If the file cannot be written.
    """
    settings = settings if settings is not None else SensorSettings()
    sampling = sampling if sampling is not None else Sampling()
    check_seed(seed)
    plan = plan_exposures(scene, settings, exposures)
    if not len(plan.intervals):
        raise InputError(
            f"{scene.name}: {scene.duration * 1e-6:g} s are too short for one frame at {settings.frame_rate:g} frames "
            "per second; make it longer"
        )
    times = truth_times(plan, truth_rate)
    counts = [0, 0]

    def counted() -> Iterator[EventArray]:
        for chunk in event_chunks(scene, settings, seed=seed, sampling=sampling, on_time=on_time):
            counts[0] += len(chunk)
            counts[1] += int(chunk["p"].sum())
            yield chunk

    hdf5.write(
        path,
        sensor_size=scene.sensor_size,
        events=counted(),
        frames=frame_stream(scene, settings, plan, seed=seed, sampling=sampling),
        contrast_threshold=(settings.threshold_on, settings.threshold_off),
        ground_truth=hdf5.TruthStream(times, truth_images(scene, plan, times)),
        response=settings.stated_response,
    )
    lengths = plan.lengths
    return Recorded(counts[0], counts[1], len(lengths), len(times), (int(lengths.min()), int(lengths.max())))
