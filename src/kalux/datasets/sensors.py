"""The sensor's settings, and presets for real ones, each number with its source.

References
----------
.. [1] Y. Hu, S.-C. Liu, T. Delbruck, "v2e: From Video Frames to Realistic DVS Events", CVPRW 2021, and its code,
   github.com/SensorsINI/v2e (``v2e_args.py``, ``emulator.py``, ``emulator_utils.py``).
.. [2] P. Lichtsteiner, C. Posch, T. Delbruck, "A 128x128 120 dB 15 us Latency Asynchronous Temporal Contrast
   Vision Sensor", IEEE J. Solid-State Circuits 43(2), 2008.
.. [3] C. Brandli et al., "A 240x180 130 dB 3 us Latency Global Shutter Spatiotemporal Vision Sensor", IEEE J.
   Solid-State Circuits 49(10), 2014.
.. [4] Y. Nozaki, T. Delbruck, "Temperature and Parasitic Photocurrent Effects in Dynamic Vision Sensors", IEEE Trans.
   Electron Devices 64(8), 2017.
.. [5] G. Gallego et al., "Event-based Vision: A Survey", IEEE TPAMI 44(1), 2022, Table 1.
.. [6] Z. Wang, Y. Ng, C. Scheerlinck, R. Mahony, "An Asynchronous Kalman Filter for Hybrid Event Cameras", ICCV 2021.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.datasets.scenes import LOG_OFFSET
from kalux.errors import SettingsError, did_you_mean
from kalux.models.camera import Response

FloatArray = NDArray[np.float64]
CameraResponse = str | Callable[[FloatArray], FloatArray]
"""Name of a response, as in settings: linear, srgb, gamma:2.2; or a function of irradiance 0 to 1 (1 = white) to
response 0 to 1, monotonic, element-wise."""


@dataclass(frozen=True, kw_only=True)
class SensorSettings:
    """The sensor. The defaults are an ideal one: every imperfection is asked for.

    Attributes
    ----------
    threshold_on, threshold_off
        Mean step of (natural) log intensity that makes an event, positive. 0.2 is v2e's default [1]_.
    threshold_mismatch
        Relative standard deviation of each pixel's thresholds; Gaussian, drawn for on and off separately, and
        never below 0.2 of the mean. 0: all alike. v2e's default is 0.15 (0.03 of 0.2) [1]_.
    log_offset
        Radiance added before the logarithm, in units of white. See `kalux.datasets.scenes.LOG_OFFSET`.
    cutoff
        Hz: the pixel follows log intensity through a first-order low pass, whose 3 dB cutoff is ``cutoff`` times the
        (radiance + log_offset) of the moment, as the photoreceptor's bandwidth is proportional to its photocurrent
        [1]_ [2]_. A change of a dark pixel is so reported late, and smaller. 0: no low pass.
    latency
        us from a crossing to its time stamp, the same in any light.
    refractory
        us that a pixel is held in reset after each of its events [2]_: it ignores all changes, and then takes
        the intensity of that moment as its new reference, so that what happened meanwhile is lost. 0: none;
        the reference then moves by exactly one threshold per event.
    leak_rate
        Hz: the reference of each pixel falls by this many ON thresholds a second, through the leakage of the reset
        switch [4]_; a still pixel then has ON events at this rate.
    noise_rate
        Background (shot noise) events per pixel and second in darkness, both polarities together, equally likely,
        Poisson.
    noise_at_white
        Noise at white and above as a part of ``noise_rate``; between them it changes linearly with the radiance.
        1: the same in any light. v2e has 0.25 [1]_.
    noise_spread
        Standard deviation, in decades, of the leak and noise rates between pixels (log-normal, median as given). v2e
        has 0.1 [1]_.
    noise_resets
        False: noise events are added to the stream and change nothing else. True: a noise event is an event
        of the pixel like any other: it resets the reference to the present intensity, starts the refractory
        period, and is lost within one, as in the circuit.
    hot_pixels
        Fraction of the pixels that have ``hot_rate`` as their leak rate: reset switches with a high dark current.
    hot_rate
        Leak rate of hot pixels, Hz.
    settled
        False: at the start, each pixel's reference is its log intensity. True: the sensor has been running before, the
        references are anywhere between the thresholds, and the pixels' leak events are not in step.
    timestamp_resolution
        us; times are rounded to multiples of it.
    frame_rate
        Frames per second. The middle of frame k is at (k + 1/2) / rate after the scene's start.
    exposure
        us, of every frame, unless `simulate` is given others; with auto_exposure, of the first.
    auto_exposure
        Mean response of a frame, 0 to 1, that the exposures are steered to, one frame later than it is seen; see
        `kalux.datasets.exposure.auto_exposures`. 0: all frames have the same exposure.
    reference_exposure
        The exposure, us, at which radiance 1.0 is white. None: the median of the exposures, as in
        reconstructions; with auto_exposure, that of the first frame.
    row_time
        us from the start of a row's exposure to that of the next, top row first: rolling shutter. A frame's exposure is
        that of its middle. 0: all rows expose at once (global shutter).
    response
        Camera response: linear, srgb or gamma:EXPONENT; in Python also a function.
    read_noise
        Standard deviation, in units of the response (1 = white).
    full_well
        Electrons at white: photon (shot) noise is Poisson with their number. None: no shot noise.
    fixed_offset
        Standard deviation of an offset of each pixel's response, the same in all frames (1 = white).
    fixed_gain
        Relative standard deviation of each pixel's sensitivity, the same in all frames.
    bits
        Bits of a frame's pixel, 1 to 16: uint8 up to 8 bits, uint16 above.

    Raises
    ------
    SettingsError
        If a value is out of its range.
    """

    threshold_on: float = 0.2
    threshold_off: float = 0.2
    threshold_mismatch: float = 0.0
    log_offset: float = LOG_OFFSET
    cutoff: float = 0.0
    latency: float = 0.0
    refractory: float = 0.0
    leak_rate: float = 0.0
    noise_rate: float = 0.0
    noise_at_white: float = 1.0
    noise_spread: float = 0.0
    noise_resets: bool = False
    hot_pixels: float = 0.0
    hot_rate: float = 20.0
    settled: bool = False
    timestamp_resolution: int = 1
    frame_rate: float = 24.0
    exposure: int = 10_000
    auto_exposure: float = 0.0
    reference_exposure: int | None = None
    row_time: float = 0.0
    response: CameraResponse = "linear"
    read_noise: float = 0.0
    full_well: float | None = None
    fixed_offset: float = 0.0
    fixed_gain: float = 0.0
    bits: int = 8

    def __post_init__(self) -> None:
        for name, (least, most, unit) in _RANGES.items():
            value = getattr(self, name)
            inside = isinstance(value, (int, float, np.integer, np.floating)) and least <= value <= most
            absent = (value is None and name in _NONE) or (value == 0 and name in _ZERO)
            require(self, name, bool(inside or absent), f"must be {least:g} to {most:g}{unit}")
        self.response_function()

    def response_function(self) -> Callable[[FloatArray], FloatArray]:
        """The camera response as a function.

        Raises
        ------
        SettingsError
            If its name is unknown.
        """
        return Response.named(self.response) if isinstance(self.response, str) else self.response

    @property
    def stated_response(self) -> str | None:
        """The response that a recording states: its name; None of a function, and of ``linear``, which is the usual."""
        return self.response if isinstance(self.response, str) and self.response != "linear" else None


_RANGES: Final[Mapping[str, tuple[float, float, str]]] = {
    # Below a thousandth a pixel would have events without end; no scene changes by a factor of exp(100).
    "threshold_on": (1e-3, 100, ", log intensity"),
    "threshold_off": (1e-3, 100, ", log intensity"),
    "threshold_mismatch": (0, 10, ", relative"),
    # The logarithm of black is then within 28 of white's; beside a larger one single precision loses white.
    "log_offset": (1e-12, 1e6, ", white = 1"),
    "cutoff": (1e-6, 1e9, " Hz, or 0"),
    # The longest times are those of hours of recording, in us; the highest rates give an event in each us.
    "latency": (0, 1e10, " us"),
    "refractory": (0, 1e10, " us"),
    "leak_rate": (0, 1e6, " Hz"),
    "noise_rate": (0, 1e6, " Hz"),
    "hot_rate": (0, 1e6, " Hz"),
    "noise_at_white": (0, 1e3, ", relative"),
    # One pixel of a million is five deviations off: a hundred thousand times the rate.
    "noise_spread": (0, 1, " decades"),
    "hot_pixels": (0, 0.999, ", a part of all"),
    "timestamp_resolution": (1, 1e6, " us"),
    # Exposures are whole us, so that a frame cannot be shorter.
    "frame_rate": (1e-6, 1e6, " Hz"),
    "exposure": (1, 1e10, " us"),
    "reference_exposure": (1, 1e10, " us, or None"),
    "auto_exposure": (0, 0.999, " of white"),
    "row_time": (0, 1e6, " us"),
    # With ten times white nothing is left of the image.
    "read_noise": (0, 10, ", white = 1"),
    "fixed_offset": (0, 10, ", white = 1"),
    "fixed_gain": (0, 10, ", relative"),
    # Pixels hold thousands to millions of electrons.
    "full_well": (1e-3, 1e9, " electrons, or None"),
    "bits": (1, 16, ""),
}
"""Of every number: the least and the largest that can be meant, and in what unit."""

_ZERO: Final = ("cutoff",)
_NONE: Final = ("reference_exposure", "full_well")


def require(settings: Any, name: str, good: bool, what: str) -> None:
    """Refuse a setting that is not ``good``, with ``what`` it must be.

    Raises
    ------
    SettingsError
        That names the setting and its value.
    """
    if not good:
        raise SettingsError(f"{type(settings).__name__}: {name} is {getattr(settings, name)}; it {what}")


DEMO_SENSOR: Final = SensorSettings(
    threshold_on=0.2,
    threshold_off=0.24,
    threshold_mismatch=0.05,
    refractory=200.0,
    noise_rate=0.5,
    frame_rate=25.0,
    exposure=12_000,
    read_noise=0.006,
)
"""The sensor for `kalux.datasets.demo_scene`: an ordinary one, a little noisy, with unequal thresholds
and exposures long enough to blur."""


class SensorPreset(NamedTuple):
    """A real sensor.

    Attributes
    ----------
    description
        In a few words.
    sensor_size
        (height, width), pixels.
    settings
        Its behaviour.
    sources
        Where each setting comes from that is not that of an ideal sensor, by its name.
    """

    description: str
    sensor_size: tuple[int, int]
    settings: SensorSettings
    sources: Mapping[str, str]


_V2E_NOISE: Final = {
    "noise_at_white": "v2e's code: SHOT_NOISE_INTEN_FACTOR [1]",
    "noise_spread": "v2e's default noise_rate_cov_decades [1]",
    "noise_resets": "as in the circuit [2]: every event resets its pixel",
    "settled": "a real sensor runs before it is recorded",
    "refractory": "v2e's default, 0.5 ms [1]; on real sensors a bias",
}
_RESPONSE_NOISE: Final = (
    "with it, a well exposed pixel has the variance 1/(7e5 1/s) at 40 Hz that [6] gives DAVIS frames"
)

PRESETS: Final[Mapping[str, SensorPreset]] = {
    "ideal": SensorPreset(
        "no noise, no delay, all pixels alike; threshold 0.2", (260, 346), SensorSettings(), {}
    ),
    "davis240c": SensorPreset(
        "DAVIS240C: events and global-shutter frames from the same pixels",
        (180, 240),
        SensorSettings(
            threshold_mismatch=0.175,
            cutoff=1500.0,
            latency=12.0,
            refractory=500.0,
            leak_rate=0.1,
            noise_rate=1.0,
            noise_at_white=0.25,
            noise_spread=0.1,
            noise_resets=True,
            settled=True,
            frame_rate=25.0,
            read_noise=0.0028,
            full_well=25_000.0,
            fixed_offset=0.005,
        ),
        {
            **_V2E_NOISE,
            "threshold_mismatch": "3.5 % contrast matching [3], of the threshold 0.2",
            "cutoff": "3 kHz at 1 klux [2], in proportion for a white surface in a bright room, 500 lux",
            "latency": "12 us at 1 klux [5]; in less light the low pass adds its own",
            "leak_rate": "about 0.1 Hz at room temperature [4], and v2e's preset noisy [1]",
            "noise_rate": "between the stationary noise of 0.1 Hz at 25 C in the light [5] and v2e's noisy, 5 Hz [1]",
            "frame_rate": "of the IJRR recordings, about 24 Hz",
            "read_noise": "51 dB dynamic range of the frames [3]",
            "full_well": _RESPONSE_NOISE,
            "fixed_offset": "0.5 % fixed pattern noise [3]",
        },
    ),
    "davis346": SensorPreset(
        "DAVIS346: events and global-shutter frames from the same pixels",
        (260, 346),
        SensorSettings(
            threshold_on=0.3,
            threshold_off=0.35,
            threshold_mismatch=0.1,
            cutoff=1500.0,
            latency=20.0,
            refractory=500.0,
            leak_rate=0.01,
            noise_rate=1.0,
            noise_at_white=0.25,
            noise_spread=0.1,
            noise_resets=True,
            settled=True,
            frame_rate=25.0,
            read_noise=0.0018,
            full_well=25_000.0,
            fixed_offset=0.005,
        ),
        {
            **_V2E_NOISE,
            "threshold_on": "kalux's estimates from two recordings of a DAVIS346: 0.33 and 0.29",
            "threshold_off": "as threshold_on: 0.38 and 0.33",
            "threshold_mismatch": "3.5 % contrast matching of the DAVIS240C [3], of the threshold 0.35",
            "cutoff": "3 kHz at 1 klux [2], in proportion for a white surface in a bright room, 500 lux; a recording "
            "in dim light, frames at 0.02 of white, shows 6 ms delay: 1.3 kHz at white",
            "latency": "20 us [5]; in less light the low pass adds its own",
            "leak_rate": "v2e's default [1]; still pixels of a recording in the sun have 0.005 Hz of ON events",
            "noise_rate": "still pixels of a DAVIS346 in dim light: 2 Hz below 0.02 of white, 0.4 Hz at 0.15; in the "
            "sun 0.05 Hz and less",
            "frame_rate": "of those recordings",
            "read_noise": "55 dB dynamic range of the frames, iniVation's data sheet",
            "full_well": _RESPONSE_NOISE,
            "fixed_offset": "0.5 % fixed pattern noise of the DAVIS240C [3]",
        },
    ),
    "prophesee-vga": SensorPreset(
        "Prophesee Gen3 VGA with a machine-vision camera, registered, as in the paper's rig",
        (480, 640),
        SensorSettings(
            threshold_on=0.15,
            threshold_off=0.15,
            threshold_mismatch=0.1,
            cutoff=1000.0,
            latency=40.0,
            refractory=500.0,
            leak_rate=0.1,
            noise_rate=0.4,
            noise_at_white=0.25,
            noise_spread=0.1,
            noise_resets=True,
            settled=True,
            frame_rate=30.0,
            exposure=8_000,
            read_noise=0.00022,
            full_well=10_400.0,
        ),
        {
            **_V2E_NOISE,
            "threshold_on": "12 % contrast sensitivity [5]; biases are set a little above the most sensitive",
            "threshold_off": "as threshold_on",
            "threshold_mismatch": "as of the DAVIS sensors; not published",
            "cutoff": "latency of 40 to 200 us [5]: 160 us as the time constant at white",
            "latency": "the lower end of 40 to 200 us [5]",
            "leak_rate": "0.1 Hz at room temperature [4]",
            "noise_rate": "0.1 Hz of stationary noise at 25 C in the light [5]",
            "frame_rate": "the paper's frame camera [6] gives up to 55 Hz; half of it is usual",
            "exposure": "indoors",
            "read_noise": "IMX265 of that camera: 2.3 electrons of 10,400 (EMVA 1288)",
            "full_well": "IMX265: 10,400 electrons (EMVA 1288)",
        },
    ),
}
"""Sensors by name. None has hot pixels or a rolling shutter; they are asked for."""


def sensor_preset(name: str) -> SensorPreset:
    """A preset by its name.

    Raises
    ------
    SettingsError
        If there is no such preset.
    """
    try:
        return PRESETS[name]
    except KeyError:
        raise SettingsError(
            f"sensor: there is no preset {name!r}{did_you_mean(name, PRESETS)}; known are {', '.join(PRESETS)}"
        ) from None


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How finely the scene is looked at: accuracy against time. Nothing of the sensor.

    Attributes
    ----------
    threshold_fraction
        A step is halved while a pixel changes by more than this fraction of the smaller mean threshold.
    min_step, max_step
        us. No step is halved to less than ``min_step``: a highlight's edge crosses many thresholds in
        hundredths of a pixel, and following it further buys accuracy below a real sensor's jitter. Changes
        that come and go within ``max_step`` may be missed.
    exposure_step
        us between the samples of an exposure (midpoint rule, at least 8 samples).

    Raises
    ------
    SettingsError
        If a value is out of its range.
    """

    threshold_fraction: float = 0.5
    min_step: float = 125.0
    max_step: float = 4000.0
    exposure_step: float = 500.0

    def __post_init__(self) -> None:
        for name in ("threshold_fraction", "min_step", "exposure_step"):
            require(self, name, getattr(self, name) > 0, "must be positive")
        require(self, "max_step", self.max_step >= self.min_step, "must not be less than min_step")
