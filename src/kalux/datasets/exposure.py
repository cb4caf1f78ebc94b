"""Frames of a scene: which exposures, what light falls into each, and what the camera makes of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.datasets.event_stream import CAMERA, FIXED
from kalux.datasets.scenes import Scene
from kalux.datasets.sensors import FloatArray, Sampling, SensorSettings
from kalux.errors import ExposureError
from kalux.event_slices import row_delays
from kalux.frames import Frame

_LEAST_SAMPLES: Final = 8
"""Samples of an exposure, at least."""

_BRIGHTEST: Final = 1e6
"""Irradiance, white = 1, up to which photons are counted."""

_LONGEST: Final = 0.95
"""Longest automatic exposure, of the frame interval: a sensor needs time to read out."""

_SPEED: Final = 0.5
"""Of the error of log exposure, what automatic exposure corrects by the next frame: quick, without overshoot."""


class Exposures(NamedTuple):
    """When frames are exposed.

    Attributes
    ----------
    intervals
        (K, 2) int64: start and end of each exposure, us; with a rolling shutter, of the middle row.
    reference
        The exposure, us, at which radiance 1 is white.
    """

    intervals: NDArray[np.int64]
    reference: float

    @property
    def lengths(self) -> NDArray[np.int64]:
        """(K,) exposure times, us."""
        return self.intervals[:, 1] - self.intervals[:, 0]

    @property
    def white(self) -> float:
        """The radiance of white at the median exposure, in which ground truth is expressed."""
        return self.reference / round(float(np.median(self.lengths))) if len(self.intervals) else 1.0


def plan_exposures(
    scene: Scene, settings: SensorSettings, exposures: Sequence[int] | None = None
) -> Exposures:
    """The exposures of a scene's frames.

    Parameters
    ----------
    scene, settings
        What is seen by what.
    exposures
        us, one per frame. Default: automatic, or ``settings.exposure`` for all, as the settings say.

    Raises
    ------
    ExposureError
        If they overlap, do not fit into the scene, or are not one per frame.
    """
    period = 1e6 / settings.frame_rate
    count = int(np.floor(scene.duration / period + 1e-9))
    middles: FloatArray = scene.start + (np.arange(count, dtype=np.float64) + 0.5) * period
    lengths = np.full(count, settings.exposure, np.int64)
    reference: float | None = settings.reference_exposure
    if exposures is not None:
        lengths = np.asarray(exposures, np.int64)
    elif settings.auto_exposure:
        reference = reference or settings.exposure
        lengths = auto_exposures(scene, settings, middles, reference)
    if lengths.shape != (count,):
        raise ExposureError(
            f"simulate: {len(lengths)} exposures for {count} frames "
            f"({scene.duration} us at {settings.frame_rate} frames per second)"
        )
    if count and lengths.min() <= 0:
        raise ExposureError(f"simulate: an exposure is {lengths.min()} us; it must be positive")
    starts = np.rint(middles - lengths / 2).astype(np.int64)
    ends = starts + lengths
    rows = row_delays(scene.sensor_size[0], settings.row_time)
    early, late = scene.start - rows[0], scene.end - rows[-1]
    if count and (starts[0] < early or ends[-1] > late or (starts[1:] < ends[:-1]).any()):
        rolling = f" with rows {settings.row_time:g} us apart" if settings.row_time else ""
        raise ExposureError(
            f"simulate: exposures up to {lengths.max()} us{rolling} do not fit into frames {period:.0f} us apart"
        )
    if reference is None:
        reference = float(np.median(lengths)) if count else 1.0
    return Exposures(np.stack([starts, ends], axis=1), float(reference))


def auto_exposures(
    scene: Scene, settings: SensorSettings, middles: FloatArray, reference: float
) -> NDArray[np.int64]:
    """Exposures steered to a mean response, each from what the frame before it shows; (K,) int64 us.

    Exposure k + 1 is exposure k times ``sqrt(wanted / mean response of frame k)``, without blur and noise, at
    most 0.95 of the frame interval (less where that would not fit a rolling shutter into the scene).
    """
    respond_to = settings.response_function()
    longest = (
        _LONGEST * 1e6 / settings.frame_rate - 2 * row_delays(scene.sensor_size[0], settings.row_time)[-1]
    )
    exposure, found = float(settings.exposure), []
    for middle in middles:
        exposure = min(max(exposure, 1.0), max(longest, 1.0))
        found.append(round(exposure))
        irradiance = np.asarray(scene.at(float(middle)), np.float64) * (exposure / reference)
        seen = float(respond_to(np.minimum(irradiance, 1.0)).mean())
        exposure *= (settings.auto_exposure / max(seen, 1e-6)) ** _SPEED
    return np.array(found, np.int64)


def frame_stream(
    scene: Scene, settings: SensorSettings, exposures: Exposures, *, seed: int, sampling: Sampling
) -> Iterator[Frame]:
    """All frames of a scene; arguments as of `kalux.datasets.simulate`."""
    rng = np.random.default_rng([seed, CAMERA])
    camera = _camera(scene.sensor_size, settings, seed)
    white = None if settings.bits in (8, 16) else float((1 << settings.bits) - 1)
    for start, end in exposures.intervals.tolist():
        if settings.row_time:
            radiance = rolling_radiance(scene, start, end, settings.row_time, sampling.exposure_step)
        else:
            radiance = mean_radiance(scene, start, end, sampling.exposure_step)
        irradiance = radiance * ((end - start) / exposures.reference)
        yield Frame(quantise(respond(irradiance, camera, rng), settings.bits), start, end, white)


def mean_radiance(scene: Scene, start: int, end: int, step: float) -> FloatArray:
    """Radiance averaged over an exposure (times and step in us): (height, width) float64.

    The midpoint rule: exact where radiance changes linearly.
    """
    count = max(_LEAST_SAMPLES, int(np.ceil((end - start) / step)))
    total = np.zeros(scene.sensor_size)
    for k in range(count):
        total += scene.at(start + (k + 0.5) / count * (end - start))
    return total / count


def rolling_radiance(scene: Scene, start: int, end: int, row_time: float, step: float) -> FloatArray:
    """Radiance averaged over each row's own exposure: (height, width) float64.

    ``start`` and ``end`` are those of the middle row; ``row_time`` from a row to the next; all in us. The radiance
    is taken as linear between samples: exact where it changes linearly.
    """
    delays = row_delays(scene.sensor_size[0], row_time)
    first, last = start + delays[0], end + delays[-1]
    spacing = min(step, (end - start) / _LEAST_SAMPLES)
    times = np.linspace(first, last, int(np.ceil((last - first) / spacing)) + 1)
    spacing = float(times[1] - times[0])
    total = np.zeros(scene.sensor_size)
    for t in times:
        until_start = _hat_integral((start + delays - t) / spacing)
        until_end = _hat_integral((end + delays - t) / spacing)
        weight = (until_end - until_start) * spacing / (end - start)
        if weight.any():
            total += weight[:, None] * scene.at(float(t))
    return total


def _hat_integral(z: FloatArray) -> FloatArray:
    """Integral of the hat function max(1 - abs(z), 0) from minus infinity to z."""
    z = np.clip(z, -1.0, 1.0)
    return np.where(z < 0, (1.0 + z) ** 2 / 2, 0.5 + z - z**2 / 2)


class Camera(NamedTuple):
    """A frame camera with its fixed pattern: (height, width) gain and offset, or 1 and 0."""

    settings: SensorSettings
    response: Callable[[FloatArray], FloatArray]
    gain: FloatArray | float
    offset: FloatArray | float


def _camera(sensor_size: tuple[int, int], settings: SensorSettings, seed: int) -> Camera:
    gain, offset = np.random.default_rng([seed, FIXED]).standard_normal((2, *sensor_size))
    return Camera(
        settings,
        settings.response_function(),
        np.maximum(1.0 + settings.fixed_gain * gain, 0.0) if settings.fixed_gain else 1.0,
        settings.fixed_offset * offset if settings.fixed_offset else 0.0,
    )


def respond(irradiance: FloatArray, camera: Camera, rng: np.random.Generator) -> FloatArray:
    """Irradiance (1 = white, more where saturated) to camera response, noisy and clipped to 0 to 1."""
    settings = camera.settings
    irradiance = irradiance * camera.gain
    if settings.full_well is not None:
        # What is far beyond white is clipped below, and numbers of electrons have to fit into int64.
        expected = np.minimum(irradiance, _BRIGHTEST) * settings.full_well
        irradiance = rng.poisson(expected) / settings.full_well
    response = camera.response(np.minimum(irradiance, 1.0))
    # What exceeds white is kept until the noise is in, or noise would lift half of the saturated pixels
    # out of saturation.
    response = response + np.maximum(irradiance - 1.0, 0.0) + camera.offset
    if settings.read_noise > 0:
        response = response + settings.read_noise * rng.standard_normal(response.shape)
    return np.clip(response, 0.0, 1.0)


def quantise(response: FloatArray, bits: int) -> NDArray[Any]:
    """Response 0 to 1 to the nearest integer of ``bits`` bits, uint8 or uint16."""
    return np.rint(response * ((1 << bits) - 1)).astype(np.uint8 if bits <= 8 else np.uint16)
