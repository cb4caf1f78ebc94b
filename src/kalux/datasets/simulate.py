"""An event camera with frames, simulated.

Events follow ``log(radiance + log_offset)``, sampled adaptively and taken as linear between samples; every
threshold crossing gets its own interpolated time, and each pixel keeps an exact account of the level it last
reported. The approach is that of ESIM [1]_: rendering as often as the scene changes, rather than at a fixed
rate; per-pixel thresholds, leak and noise events and the pixel's bandwidth are as in v2e [2]_, its reset as in the
original DVS [3]_.

The order of things::

    scene -> log intensity -> segments (adaptive, linear) -> low pass -> crossings (thresholds, refractory) -> events
                                                              leak, background noise --------^
    scene -> exposure (mean radiance) -> shot noise -> response -> read noise -> clip, quantise -> frames

`event_stream` and `pixels` make the events, `exposure` the frames, `record` writes both to a file in bounded memory.

References
----------
.. [1] H. Rebecq, D. Gehrig, D. Scaramuzza, "ESIM: an Open Event Camera Simulator", CoRL 2018.
.. [2] Y. Hu, S.-C. Liu, T. Delbruck, "v2e: From Video Frames to Realistic DVS Events", CVPRW 2021.
.. [3] P. Lichtsteiner, C. Posch, T. Delbruck, "A 128x128 120 dB 15 us Latency Asynchronous Temporal Contrast
   Vision Sensor", IEEE J. Solid-State Circuits 43(2), 2008.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kalux.datasets.event_stream import all_events, draw_thresholds, event_chunks
from kalux.datasets.exposure import Exposures, frame_stream, plan_exposures
from kalux.datasets.scenes import Scene
from kalux.datasets.sensors import FloatArray, Sampling, SensorSettings
from kalux.errors import InputError, SettingsError
from kalux.events import EventArray
from kalux.frames import Frame, GroundTruth
from kalux.recording import Recording


@dataclass(frozen=True, eq=False)
class Simulation:
    """What `simulate` made, and from what.

    Attributes
    ----------
    scene, settings, seed
        As given.
    events
        `EVENT_DTYPE`, sorted by t, then y, then x.
    frames
        In time order.
    threshold_on, threshold_off
        (height, width) float64: the thresholds of each pixel.
    exposures
        Of the frames.
    """

    scene: Scene
    settings: SensorSettings
    seed: int
    events: EventArray
    frames: list[Frame] = field(repr=False)
    threshold_on: FloatArray = field(repr=False)
    threshold_off: FloatArray = field(repr=False)
    exposures: Exposures = field(repr=False)

    def truth_times(self) -> NDArray[np.int64]:
        """As of `truth_times`."""
        return truth_times(self.exposures)

    def truth(self, times: ArrayLike | None = None) -> GroundTruth:
        """True radiance, without blur, noise or saturation.

        Parameters
        ----------
        times
            (T,) int us, within the scene. Default: `truth_times`.
        """
        at = self.truth_times() if times is None else np.asarray(times, np.int64)
        images = np.empty((len(at), *self.scene.sensor_size), np.float32)
        for i, image in enumerate(truth_images(self.scene, self.exposures, at)):
            images[i] = image
        return GroundTruth(at, images)

    def recording(self, times: ArrayLike | None = None) -> Recording:
        """The events and frames as a recording, with the ground truth at ``times`` (as in `truth`)."""
        return Recording.from_arrays(
            self.events,
            self.frames,
            sensor_size=self.scene.sensor_size,
            contrast_threshold=(self.settings.threshold_on, self.settings.threshold_off),
            ground_truth=self.truth(times),
            response=self.settings.stated_response,
            name=self.scene.name,
        )


def simulate(
    scene: Scene,
    settings: SensorSettings | None = None,
    *,
    seed: int = 0,
    exposures: Sequence[int] | None = None,
    sampling: Sampling | None = None,
) -> Simulation:
    """Look at a scene with an event camera that also takes frames.

    Parameters
    ----------
    scene
        What there is to see.
    settings
        The sensor. Default: an ideal one.
    seed
        Not negative. The same arguments give the same bits.
    exposures
        us, one per frame, instead of those that the settings say. The number of frames is the scene's duration
        times the frame rate, rounded down.
    sampling
        Accuracy.

    Returns
    -------
    Simulation
        Events, frames and access to the truth.

    Raises
    ------
    SettingsError
        If the seed is negative.
    ExposureError
        If exposures overlap, or are not one per frame.
    InputError
        If the scene returns an image of the wrong size, negative or not finite.
    """
    settings = settings if settings is not None else SensorSettings()
    sampling = sampling if sampling is not None else Sampling()
    check_seed(seed)
    plan = plan_exposures(scene, settings, exposures)
    threshold_on, threshold_off = draw_thresholds(scene.sensor_size, settings, seed)
    events = all_events(event_chunks(scene, settings, seed=seed, sampling=sampling))
    frames = list(frame_stream(scene, settings, plan, seed=seed, sampling=sampling))
    return Simulation(scene, settings, seed, events, frames, threshold_on, threshold_off, plan)


def check_seed(seed: int) -> None:
    """Refuse negative seeds.

    Raises
    ------
    SettingsError
        If it is negative.
    """
    if seed < 0:
        raise SettingsError(f"simulate: seed is {seed}; it must not be negative")


def truth_times(exposures: Exposures, rate_hz: float | None = None) -> NDArray[np.int64]:
    """Times of ground truth, (T,) int64 us.

    Parameters
    ----------
    exposures
        Of the frames.
    rate_hz
        Images per second, from the middle of the first exposure to the end of the last. Default: the middles of the
        frames and halfway between them, second frame to last but one; of fewer than four frames, all.

    Raises
    ------
    InputError
        If the rate is not 1 uHz to 1 MHz.
    """
    middles: NDArray[np.int64] = exposures.intervals[:, 0] + exposures.lengths // 2
    if rate_hz is None:
        inner = middles[1:-1] if len(middles) > 3 else middles
        return np.sort(np.concatenate([inner, (inner[1:] + inner[:-1]) // 2]))
    if not 1e-6 <= rate_hz <= 1e6:
        raise InputError(f"simulate: {rate_hz} images of truth per second; it must be 0.000001 to 1000000")
    if not len(middles):
        return np.empty(0, np.int64)
    count = int((exposures.intervals[-1, 1] - middles[0]) * rate_hz / 1e6 + 1e-9) + 1
    after: NDArray[np.int64] = np.rint(np.arange(count) * (1e6 / rate_hz)).astype(np.int64)
    times: NDArray[np.int64] = middles[0] + after
    return times


def truth_images(scene: Scene, exposures: Exposures, times: NDArray[np.int64]) -> Iterator[NDArray[Any]]:
    """True radiance at each time, float32 (height, width): 1.0 = white at the median exposure."""
    white = np.float32(exposures.white)
    for t in times.tolist():
        yield np.asarray(scene.at(float(t)), np.float32) / white
