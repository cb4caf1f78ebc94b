"""Tone mapping: from linear intensity or colour, far above 1 in highlights, to a picture in 0 to 1.

For looking only. Nothing here feeds a metric, a float output (EXR, npy) or the reconstruction.

A mapping is done in two steps. `measure` takes the statistics of one image that the curve needs (limits, the
log average, local histograms) as a small array of numbers; `apply` maps an image with given statistics.
`tone_map` does both for one image. For a video, where fresh statistics in every image would flicker,
`tone_map_next` carries them on in a `ToneState`, smoothed over time.

Of an image in colour the luminance is mapped, exactly as if it were a grey image; the picture has its chromaticity
on an sRGB display, and goes towards white where the display has no such colour as bright.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NamedTuple, Protocol

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kalux.compiled import FUSED, INFINITE_BITS, ONE, exponential, logarithm, magnitude_bits
from kalux.errors import InputError, SettingsError
from kalux.models.colour import luminance

Float32 = NDArray[np.float32]
Statistics = NDArray[np.float64]
Encoding = Literal["curve", "none", "srgb", "gamma"]

MID_GREY = 0.18
"""The reflectance that photography takes for the middle of a scene."""

SMALLEST = 1e-3
"""Added before a logarithm, about a quarter of a level of an 8-bit frame: black pixels stay finite."""

LARGEST = 1e30
"""Larger intensities count as this, so that no formula overflows."""

_NO_SHOULDER: Final = 1.0 + 1e-3
"""An image whose bright end is no brighter needs none."""

BINS = 256
SAMPLES = 1 << 16

_COARSE_BITS: Final = 20
"""The exponent and four bits more are what is left of a positive float32 without its last ones: in the order of the
numbers themselves, and 4096 at most."""


_LARGEST_BITS: Final = np.float32(LARGEST).view(np.int32)


class TimedImage(Protocol):
    """What `tone_map_next` needs of an image."""

    @property
    def t(self) -> int:
        """Time, us."""

    @property
    def intensity(self) -> Float32:
        """(height, width), linear, 1.0 = a saturated frame pixel."""


@dataclass(frozen=True)
class Auto:
    """The camera frame where that shows the scene, rolled off or lifted where it does not.

    Up to ``knee`` the intensity is shown as it is. Above, a logarithmic shoulder, continuous with its slope,
    takes ``knee`` to the bright end of the image into ``knee`` to 1, so that highlights keep their detail and
    every stop of them gets about the same room; an image with nothing above 1 has no shoulder. Where the
    median intensity is below 0.18, a power with an exponent of at least 1 / ``lift`` raises it towards 0.18.

    Attributes
    ----------
    knee
        Where the shoulder begins, 0 to 1.
    high
        Percentile of the intensity that is shown white, if it is above 1.
    lift
        The strongest power that lifts a dark image; 1 never lifts.
    """

    knee: float = 0.5
    high: float = 99.5
    lift: float = 2.2

    def __post_init__(self) -> None:
        _require(0 < self.knee < 1, "knee", self.knee, "above 0 and below 1")
        _require_percentile("high", self.high)
        _require(1 <= self.lift <= 10, "lift", self.lift, "1 to 10")


@dataclass(frozen=True)
class Linear:
    """A straight line between two fixed limits, clipped; it needs no statistics.

    With the default limits this is the camera frame: 1.0, a saturated frame pixel, is white.

    Attributes
    ----------
    black, white
        Intensities shown as 0 and 1.
    """

    black: float = 0.0
    white: float = 1.0

    def __post_init__(self) -> None:
        usable = abs(self.black) < 1e30 and abs(self.white) < 1e30
        _require(usable and self.white > self.black, "white", self.white, f"above black ({self.black})")


@dataclass(frozen=True)
class Percentile:
    """A straight line between two percentiles of the image, clipped.

    Attributes
    ----------
    low, high
        Percentiles of the intensity shown as 0 and 1.
    """

    low: float = 1.0
    high: float = 99.0

    def __post_init__(self) -> None:
        _require_percentile("low", self.low)
        _require_percentile("high", self.high)
        _require(self.low < self.high, "high", self.high, f"above low ({self.low})")


@dataclass(frozen=True)
class Reinhard:
    """The global operator of Reinhard et al., "Photographic Tone Reproduction for Digital Images", 2002.

    Attributes
    ----------
    key
        The paper's a: what the log-average intensity is mapped to, 0.18 for a normal scene, 0.09 for a dark
        one, up to 0.72 for a bright one.
    white
        The paper's L_white as an intensity: the smallest that is shown white. Default: the percentile
        ``high`` of the image.
    high
        Percentile used where ``white`` is not given.
    """

    key: float = MID_GREY
    white: float | None = None
    high: float = 99.5

    def __post_init__(self) -> None:
        _require(0 < self.key <= 10, "key", self.key, "above 0 and at most 10")
        if self.white is not None:
            _require(0 < self.white < math.inf, "white", self.white, "above 0")
        _require_percentile("high", self.high)


@dataclass(frozen=True)
class Drago:
    """Drago et al., "Adaptive Logarithmic Mapping for Displaying High Contrast Scenes", 2003.

    Attributes
    ----------
    bias
        The paper's b, 0.7 to 0.99: smaller is brighter in the shadows, with less contrast in highlights.
    high
        Percentile of the intensity that stands for the paper's L_wmax, so that one hot pixel does not set it.
    """

    bias: float = 0.85
    high: float = 99.9

    def __post_init__(self) -> None:
        _require(0.7 <= self.bias <= 0.99, "bias", self.bias, "0.7 to 0.99")
        _require_percentile("high", self.high)


@dataclass(frozen=True)
class Clahe:
    """Contrast-limited adaptive histogram equalisation of the log intensity (Zuiderveld 1994).

    It shows the most detail and says the least about brightness: equal intensities in different places of
    the image do not get equal greys.

    Attributes
    ----------
    clip
        Contrast limit: the largest count of a histogram bin, in units of the mean count. 1 is no
        equalisation.
    tiles
        The image is divided into tiles x tiles histograms, between which is interpolated.
    """

    clip: float = 3.0
    tiles: int = 8

    def __post_init__(self) -> None:
        _require(1 <= self.clip <= BINS, "clip", self.clip, f"1 to {BINS}")
        _require(1 <= self.tiles <= 64, "tiles", self.tiles, "1 to 64")


Curve = Auto | Linear | Percentile | Reinhard | Drago | Clahe

CURVES: dict[str, type[Curve]] = {
    "auto": Auto,
    "linear": Linear,
    "percentile": Percentile,
    "reinhard": Reinhard,
    "drago": Drago,
    "clahe": Clahe,
}


@dataclass(frozen=True)
class DisplaySettings:
    """How intensities become a picture.

    Attributes
    ----------
    curve
        One of `CURVES`, with its parameters.
    encoding
        What is done to the mapped values at the end. ``none``: nothing, as a raw DAVIS frame is commonly
        shown. ``srgb``: the sRGB transfer function. ``gamma``: the power 1 / ``gamma``. ``curve``, the
        default: ``srgb`` for Reinhard and Drago, whose papers compute the luminance of the display, and
        ``none`` for the others, so that a well exposed scene looks like the camera frame.
    gamma
        For the encoding ``gamma``.
    smoothing
        Time constant, in seconds, of the moving average of the statistics over a video; 0 for none. Applies
        to `tone_map_next` only.
    """

    curve: Curve = field(default_factory=Auto)
    encoding: Encoding = "curve"
    gamma: float = 2.2
    smoothing: float = 0.5

    def __post_init__(self) -> None:
        if not isinstance(self.curve, tuple(CURVES.values())):
            raise SettingsError(
                f"display: curve is {self.curve!r}; it must be an instance of one of "
                f"{', '.join(c.__name__ for c in CURVES.values())} from kalux.display"
            )
        if self.encoding not in ("curve", "none", "srgb", "gamma"):
            raise SettingsError(
                f"display: encoding is {self.encoding!r}; it must be curve, none, srgb or gamma"
            )
        _require(0 < self.gamma <= 10, "gamma", self.gamma, "above 0 and at most 10")
        _require(0 <= self.smoothing < math.inf, "smoothing", self.smoothing, "0 or more seconds")


@dataclass(frozen=True, eq=False)
class ToneState:
    """What `tone_map_next` hands from one image to the next.

    Attributes
    ----------
    t
        Time of the image, us.
    statistics
        As of `measure`, smoothed over time.
    """

    t: int
    statistics: Statistics


def curve_from_name(name: str, **parameters: Any) -> Curve:
    """A curve from its name in `CURVES` and its parameters.

    Raises
    ------
    SettingsError
        The name or a parameter is unknown, or a parameter is out of its range.
    """
    if name not in CURVES:
        raise SettingsError(f"display: there is no curve {name!r}; choose one of {', '.join(CURVES)}")
    kind = CURVES[name]
    known = tuple(kind.__dataclass_fields__)
    unknown = [p for p in parameters if p not in known]
    if unknown:
        raise SettingsError(
            f"display: the curve {name} has no parameter {unknown[0]!r}; it has {', '.join(known)}"
        )
    return kind(**parameters)


def settings_table(settings: DisplaySettings) -> dict[str, Any]:
    """The settings as a flat dict for a settings file: the name of the curve, its parameters, the rest."""
    name = next(n for n, kind in CURVES.items() if isinstance(settings.curve, kind))
    curve = {p: getattr(settings.curve, p) for p in settings.curve.__dataclass_fields__}
    encoding = {"encoding": settings.encoding, "gamma": settings.gamma, "smoothing": settings.smoothing}
    return {"curve": name, name: curve, **encoding}


def colour_of(image: object) -> Float32 | None:
    """The attribute ``colour`` of an image, (height, width, 3) linear RGB, or None where it has none."""
    colour: Float32 | None = getattr(image, "colour", None)
    return colour


def tone_map(intensity: NDArray[Any], settings: DisplaySettings | None = None) -> Float32:
    """Map one image by its own statistics.

    Parameters
    ----------
    intensity
        (height, width), or (height, width, 3) RGB, linear, 1.0 = a saturated frame pixel. Values below 0 count as 0,
        above 1e30 as 1e30.
    settings
        Default: ``DisplaySettings()``.

    Returns
    -------
    ndarray
        float32 of the same shape, 0 to 1.

    Raises
    ------
    InputError
        The intensity is of another shape, is empty, or is not finite.
    """
    settings = settings or DisplaySettings()
    checked = _checked(intensity)
    return _apply(checked, settings, _measure(checked, settings.curve))


def tone_map_next(
    image: TimedImage, settings: DisplaySettings | None = None, state: ToneState | None = None
) -> tuple[Float32, ToneState]:
    """Map the next image of a video, without flicker.

    The statistics are a moving average, s <- s + (1 - exp(-dt / smoothing)) (s_image - s), with dt the time
    since the previous image: of the logarithms of intensities, except for the limits of `Percentile`. An
    image no later than the state leaves it as it is.

    Parameters
    ----------
    image
        With ``t``, us, and ``intensity``, (height, width), linear; or with ``colour``, (height, width, 3), which is
        then shown.
    settings
        Default: ``DisplaySettings()``.
    state
        Of the previous image; None for the first, which is mapped by its own statistics.

    Returns
    -------
    mapped : ndarray
        (height, width) or (height, width, 3) float32, 0 to 1.
    state : ToneState
        For the next image.

    Raises
    ------
    InputError
        The intensity is not two-dimensional, is empty, or is not finite; or the state is of other settings.
    """
    settings = settings or DisplaySettings()
    intensity = _checked(_shown(image))
    following = _next_state(intensity, image.t, settings, state)
    return _apply(intensity, settings, following.statistics), following


def next_state(
    image: TimedImage,
    settings: DisplaySettings | None = None,
    state: ToneState | None = None,
    *,
    checked: bool = False,
) -> ToneState:
    """The part of `tone_map_next` that must go from image to image: its state. `apply` with its statistics is the rest.

    What is ``checked``, float32, finite and of a shape that can be shown, is not looked through again.

    Raises
    ------
    InputError
        As of `tone_map_next`.
    """
    shown = _shown(image)
    return _next_state(shown if checked else _checked(shown), image.t, settings or DisplaySettings(), state)


def measure(intensity: NDArray[Any], curve: Curve) -> Statistics:
    """The statistics of an image that a curve needs, as a float64 vector (empty for `Linear`).

    Images of more than 65536 pixels are sampled on a regular grid (all pixels for `Clahe`).

    Raises
    ------
    InputError
        The intensity is not two-dimensional, is empty, or is not finite.
    """
    return _measure(_checked(intensity), curve)


def apply(
    intensity: NDArray[Any], settings: DisplaySettings, statistics: Statistics, *, checked: bool = False
) -> Float32:
    """Map an image by given statistics, for instance those of one image for a whole video.

    Parameters
    ----------
    intensity
        (height, width), or (height, width, 3) RGB, linear.
    settings
        Of which ``smoothing`` is not used.
    statistics
        From `measure` with the same curve.
    checked
        As of `next_state`.

    Returns
    -------
    ndarray
        float32 of the same shape, 0 to 1.

    Raises
    ------
    InputError
        The intensity is of another shape, is empty, or is not finite; or the statistics are of another curve.
    """
    return _apply(intensity if checked else _checked(intensity), settings, statistics)


def fill_levels(
    intensity: Float32,
    settings: DisplaySettings,
    statistics: Statistics,
    levels: tuple[float, float],
    plane: NDArray[np.uint8],
) -> None:
    """Map an image as `apply` does, and fill a plane with the ``levels`` from 0 to 1, rounded.

    Parameters
    ----------
    intensity
        (height, width) float32, finite: it is not checked.
    settings, statistics
        As of `apply`.
    levels
        Of black and of white.
    plane
        (rows, columns), no smaller; where it is larger, the last row and column are repeated.
    """
    offset, factor = np.float32(levels[0] + 0.5), np.float32(levels[1] - levels[0])  # cut off after the point
    if isinstance(settings.curve, Auto) and _encoding(settings) == "none":
        _check_statistics(settings.curve, statistics)
        _show_levels(intensity, *_auto_tone(settings.curve, *_exp(statistics)), offset, factor, plane)
    else:
        _fill(_apply(intensity, settings, statistics), offset, factor, plane)


def fill(values: Float32, zero: float, scale: float, plane: NDArray[np.uint8]) -> None:
    """Fill a plane with ``zero + scale * values``, rounded; as of `fill_levels`."""
    _fill(np.ascontiguousarray(values, np.float32), np.float32(zero + 0.5), np.float32(scale), plane)


def to_uint8(mapped: NDArray[Any]) -> NDArray[np.uint8]:
    """Values 0 to 1 as uint8, 0 to 255, rounded to nearest; outside is clipped."""
    return _to_integer(mapped, np.empty(np.shape(mapped), np.uint8), 255)


def to_uint16(mapped: NDArray[Any]) -> NDArray[np.uint16]:
    """Values 0 to 1 as uint16, 0 to 65535, rounded to nearest; outside is clipped."""
    return _to_integer(mapped, np.empty(np.shape(mapped), np.uint16), 65535)


def encode_srgb(linear: Float32) -> Float32:
    """The sRGB transfer function (IEC 61966-2-1) of values 0 to 1."""
    curved = 1.055 * np.power(linear, np.float32(1 / 2.4)) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curved).astype(np.float32)


def decode_srgb(encoded: Float32) -> Float32:
    """The inverse of `encode_srgb`."""
    curved = np.power((encoded + np.float32(0.055)) / np.float32(1.055), np.float32(2.4))
    return np.where(encoded <= 0.04045, encoded / np.float32(12.92), curved).astype(np.float32)


def _in_colour(colour: Float32, y: Float32, grey: Float32) -> Float32:
    """The picture that has the luminance of ``grey`` on an sRGB display, and the chromaticity of ``colour``.

    Where a channel would exceed 1, all are drawn towards grey of that luminance, which at its brightest is white.
    """
    light = decode_srgb(grey)
    ratio = light / np.maximum(y, np.float32(1e-12))
    wanted = colour * ratio[..., None]
    # Black has no chromaticity, but may be mapped to something brighter.
    wanted = np.where((y > 1e-12)[..., None], wanted, light[..., None])
    excess = wanted.max(axis=-1) - light
    saturation = np.minimum(np.float32(1), (1 - light) / np.maximum(excess, np.float32(1e-12)))
    shown = light[..., None] + saturation[..., None] * (wanted - light[..., None])
    return encode_srgb(np.clip(shown, 0, 1))


def _to_integer(mapped: NDArray[Any], integers: NDArray[Any], top: int) -> NDArray[Any]:
    values = np.ascontiguousarray(mapped, np.float32)
    _quantise(values.reshape(-1), np.float32(top), integers.reshape(-1))
    return integers


@nb.njit(cache=True, nogil=True)
def _quantise(values, top, integers):  # type: ignore[no-untyped-def]
    rounding = np.float32(
        1.5 * 2**23
    )  # added and taken away again, it rounds to a whole number, halves to even ones
    for i in range(len(values)):
        value = values[i]
        value = value if value > np.float32(0.0) else np.float32(0.0)
        value = value if value < ONE else ONE
        integers[i] = np.int32((value * top + rounding) - rounding)


def _require(good: bool, name: str, value: float, rule: str) -> None:
    if not good:
        raise SettingsError(f"display: {name} is {value}; it must be {rule}")


def _require_percentile(name: str, value: float) -> None:
    _require(0 <= value <= 100, name, value, "a percentile, 0 to 100")


def _checked(intensity: NDArray[Any]) -> Float32:
    """The intensity as it can be worked with, but for values that `_bounded` or the curve has to limit."""
    checked = np.ascontiguousarray(intensity, np.float32)
    if (checked.ndim != 2 and checked.shape[2:] != (3,)) or checked.size == 0:
        raise InputError(
            f"display: the intensity has shape {checked.shape}; (height, width) or (height, width, 3) is needed"
        )
    if magnitude_bits(checked) >= INFINITE_BITS:
        y, x = (int(i[0]) for i in np.nonzero(~np.isfinite(checked))[:2])
        raise InputError(f"display: the intensity at x={x}, y={y} is not finite (NaN or infinite)")
    return checked


def _bounded(values: Float32) -> Float32:
    """A copy with values from 0 to `LARGEST`."""
    return np.clip(values, np.float32(0.0), np.float32(LARGEST))


def _smoothed(state: ToneState, statistics: Statistics, t: int, smoothing: float) -> Statistics:
    if state.statistics.shape != statistics.shape:
        raise InputError("display: the state is of another curve; start a video without one")
    if smoothing == 0:
        return statistics
    seconds = max(0, int(t) - state.t) * 1e-6
    return state.statistics - math.expm1(-seconds / smoothing) * (statistics - state.statistics)


def _next_state(intensity: Float32, t: int, settings: DisplaySettings, state: ToneState | None) -> ToneState:
    statistics = _measure(intensity, settings.curve)
    if state is not None:
        statistics = _smoothed(state, statistics, t, settings.smoothing)
    return ToneState(int(t), statistics)


def _shown(image: TimedImage) -> Float32:
    colour = colour_of(image)
    return image.intensity if colour is None else colour


def _sampled(intensity: Float32) -> Float32:
    step = max(1, math.isqrt(intensity.shape[0] * intensity.shape[1] // SAMPLES))
    return intensity[::step, ::step]


def _percentiles(values: Float32, percents: list[float]) -> Statistics:
    """Percentiles of values, linear between the two nearest of them; those below 0 count as 0."""
    return _percentiles_of_sample(values.reshape(1, -1), percents)


def _percentiles_of_sample(values: Float32, percents: list[float]) -> Statistics:
    """The same of values in rows, wherever they lie; finite, and limited to `LARGEST`."""
    bits = np.empty(values.size + 1, np.int32)
    # Numbers of Python: NumPy takes longer for a few than the loops for all of the sample.
    positions = [percent / 100 * (values.size - 1) for percent in percents]
    ranks = [rank for position in positions for rank in (math.floor(position), math.ceil(position))]
    # Few numbers are left to be put in order: those that share their first bits with one that is looked for.
    places, count = _narrowed(values.view(np.int32), np.array(ranks), bits)
    ordered = np.partition(bits[:count], places)[places].view(np.float32).tolist()
    found = [
        low + (position - math.floor(position)) * (high - low)
        for position, low, high in zip(positions, ordered[::2], ordered[1::2], strict=True)
    ]
    return np.array(found)


@nb.njit(cache=True, nogil=True)
def _narrowed(rows, ranks, bits):  # type: ignore[no-untyped-def]
    """The numbers among which those of some ranks are, in ``bits``, with room for one more; their places, and how many.

    Numbers are compared by their bits: as float32 that are not negative, they are in the same order.
    """
    counts = np.zeros((4, 1 << (31 - _COARSE_BITS)), np.int32)  # four, so that equal neighbours need not wait
    height, width = rows.shape
    at = np.uint64(0)
    for row in range(height):
        for column in range(width):
            value = rows[row, column]
            value = value if value > np.int32(0) else np.int32(0)
            value = value if value < _LARGEST_BITS else _LARGEST_BITS
            bits[at] = value
            counts[at & np.uint64(3), np.uint64(value) >> np.uint64(_COARSE_BITS)] += 1
            at += np.uint64(1)
    total = counts[0] + counts[1] + counts[2] + counts[3]
    wanted = np.zeros(len(total), np.uint8)
    places = np.empty(len(ranks), np.int64)
    # From the lowest rank to the highest.
    order = np.argsort(ranks)
    below, kept, part = np.int64(0), np.int64(0), 0
    for k in order:
        while below + total[part] <= ranks[k]:
            below += total[part]
            kept += total[part] * np.int64(wanted[part])
            part += 1
        wanted[part] = 1
        places[k] = kept + ranks[k] - below
    found = np.uint64(0)
    for i in range(np.uint64(at)):
        value = bits[i]
        bits[found] = value  # never behind what is still to be read
        found += np.uint64(wanted[np.uint64(value) >> np.uint64(_COARSE_BITS)])
    return places, found


def _measure(intensity: Float32, curve: Curve) -> Statistics:
    if isinstance(curve, Linear):
        return np.empty(0)
    if isinstance(curve, Auto) and intensity.ndim == 2:
        return _log(_percentiles_of_sample(_sampled(intensity), [50, curve.high]))
    values = _bounded(intensity if isinstance(curve, Clahe) else _sampled(intensity))
    if values.ndim == 3:
        values = luminance(values)
    match curve:
        case Percentile():
            return _percentiles(values, [curve.low, curve.high])
        case Auto():
            return _log(_percentiles(values, [50, curve.high]))
        case Reinhard() | Drago():
            bright = _log(_percentiles(values, [curve.high]))
            return np.append(_log(values).mean(), bright)
        case Clahe():
            return _measure_clahe(values, curve)


def _apply(intensity: Float32, settings: DisplaySettings, statistics: Statistics) -> Float32:
    if intensity.ndim == 3:
        bounded = _bounded(intensity)
        y = luminance(bounded)
        return _in_colour(bounded, y, _apply(y, settings, statistics))
    if isinstance(settings.curve, Auto):  # limits its values itself
        return _encoded(_curved(intensity, settings.curve, statistics), settings)
    mapped = _curved(_bounded(intensity), settings.curve, statistics)
    return _encoded(np.clip(mapped, 0, 1, out=mapped), settings)


def _curved(intensity: Float32, curve: Curve, statistics: Statistics) -> Float32:
    _check_statistics(curve, statistics)
    match curve:
        case Linear():
            return _stretched(intensity, curve.black, curve.white)
        case Percentile():
            return _stretched(intensity, float(statistics[0]), float(statistics[1]))
        case Auto():
            return _auto(intensity, curve, *_exp(statistics))
        case Reinhard():
            average, bright = _exp(statistics)
            return _reinhard(intensity, curve.key, average, curve.white or bright)
        case Drago():
            return _drago(intensity, curve.bias, *_exp(statistics))
        case Clahe():
            return _clahe(intensity, curve, statistics)


def _check_statistics(curve: Curve, statistics: Statistics) -> None:
    expected = {Linear: 0, Clahe: 2 + getattr(curve, "tiles", 0) ** 2 * (BINS + 1)}.get(type(curve), 2)
    if statistics.shape != (expected,):
        raise InputError("display: the statistics are of another curve than that of the settings")


def _encoding(settings: DisplaySettings) -> Encoding:
    if settings.encoding == "curve":
        return "srgb" if isinstance(settings.curve, Reinhard | Drago) else "none"
    return settings.encoding


def _encoded(mapped: Float32, settings: DisplaySettings) -> Float32:
    encoding = _encoding(settings)
    if encoding == "srgb":
        return encode_srgb(mapped)
    if encoding == "gamma":
        return np.power(mapped, np.float32(1 / settings.gamma))
    return mapped


def _log(intensity: NDArray[Any]) -> Statistics:
    return np.log(np.asarray(intensity, np.float64) + SMALLEST)


def _exp(statistics: Statistics) -> tuple[float, float]:
    first, second = np.maximum(np.exp(statistics) - SMALLEST, 0)
    return float(first), float(second)


def _stretched(intensity: Float32, black: float, white: float) -> Float32:
    # An image of one value has no range: it is shown black, not as its amplified rounding errors.
    width = max(white - black, 1e-6 * abs(white), 1e-30)
    stretched = np.clip(intensity, np.float32(black), np.float32(max(white, black)))
    return ((stretched - np.float32(black)) / np.float32(width)).astype(np.float32)


def _auto(intensity: Float32, curve: Auto, median: float, white: float) -> Float32:
    shown = np.empty(intensity.shape, np.float32)
    values = np.ascontiguousarray(intensity).reshape(-1)
    _show(values, *_auto_tone(curve, median, white), shown.reshape(-1))
    return shown


def _auto_tone(curve: Auto, median: float, white: float) -> tuple[_Shoulder, bool, np.float32]:
    """The shoulder, whether there is one, and the power."""
    shoulder = _shoulder(curve.knee, white)
    middle = max(float(_rolled(np.float32(median), shoulder)), SMALLEST)
    power = min(max(math.log(min(middle, 0.99)) / math.log(MID_GREY), 1.0), curve.lift)
    return shoulder, white > _NO_SHOULDER, np.float32(1 / power)


class _Shoulder(NamedTuple):
    """float32: where it begins, how far it goes, and a (gain) and scale of scale log(1 + a x)."""

    knee: np.float32
    room: np.float32
    gain: np.float32
    scale: np.float32


def _shoulder(knee: float, white: float) -> _Shoulder:
    """That of an image with nothing above 1 is none: it begins beyond every intensity."""
    if white <= _NO_SHOULDER:
        return _Shoulder(np.float32(2 * LARGEST), np.float32(0), np.float32(0), np.float32(0))
    gain = _shoulder_gain(1 - knee, white - knee)
    scale = (1 - knee) / math.log1p(gain * (white - knee))
    return _Shoulder(np.float32(knee), np.float32(white - knee), np.float32(gain), np.float32(scale))


@nb.njit(cache=True, inline="always")
def _rolled(intensity, shoulder):  # type: ignore[no-untyped-def]
    """The shoulder: the intensity up to the knee, then a logarithm up to 1."""
    knee, room, gain, scale = shoulder
    above = intensity - knee
    above = above if above > np.float32(0.0) else np.float32(0.0)
    above = above if above < room else room
    low = intensity if intensity < knee else knee
    return low + scale * logarithm(ONE + gain * above)


@nb.njit(cache=True, nogil=True, fastmath=FUSED)
def _show(values, shoulder, rolled, power, shown):  # type: ignore[no-untyped-def]
    """Shoulder and power, each where there is one, limited to 0 to 1."""
    zero, largest = np.float32(0.0), np.float32(LARGEST)
    for i in range(len(values)):
        value = values[i]
        value = value if value > zero else zero
        value = value if value < largest else largest
        value = _rolled(value, shoulder) if rolled else value
        shown[i] = value if value < ONE else ONE
    if power != ONE:
        for i in range(len(values)):
            value = shown[i]
            lifted = exponential(power * logarithm(value))
            lifted = lifted if lifted < ONE else ONE
            shown[i] = lifted if value > zero else zero


@nb.njit(cache=True, nogil=True, fastmath=FUSED)
def _show_levels(values, shoulder, rolled, power, offset, factor, plane):  # type: ignore[no-untyped-def]
    """`_show` and `_fill`, a row at a time."""
    height, width = values.shape
    shown = np.empty((1, width), np.float32)
    for row in range(len(plane)):
        if row < height:
            _show(values[row], shoulder, rolled, power, shown[0])
        _fill_row(shown[0], offset, factor, plane[row])


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _fill(values, offset, factor, plane):  # type: ignore[no-untyped-def]
    for row in range(len(plane)):
        _fill_row(values[min(row, len(values) - 1)], offset, factor, plane[row])


@nb.njit(cache=True, inline="always", error_model="numpy")
def _fill_row(values, offset, factor, levels):  # type: ignore[no-untyped-def]
    for column in range(len(values)):
        levels[column] = np.uint8(np.int32(offset + factor * values[column]))
    for column in range(len(values), len(levels)):
        levels[column] = levels[len(values) - 1]


def _shoulder_gain(height: float, width: float) -> float:
    """The a > 0 with slope 1 at the knee: a height = log(1 + a width), for width > height > 0."""
    # Newton from the right of the root of a convex function: every step lands right of it.
    a = 4 * math.log(1 + width / height) / height + 1
    for _ in range(60):
        step = (a * height - math.log1p(a * width)) / (height - width / (1 + a * width))
        a -= step
        if abs(step) <= 1e-12 * a:
            break
    return a


def _reinhard(intensity: Float32, key: float, average: float, white: float) -> Float32:
    """L_d = L (1 + L / L_white^2) / (1 + L), equation (4), of L = a L_w / average, equation (2)."""
    scale = key / max(average, SMALLEST)
    white = max(white * scale, 1e-3)
    scaled = np.minimum(intensity, np.float32(white / scale)) * np.float32(scale)
    mapped = scaled * (1 + scaled / np.float32(white) / np.float32(white)) / (1 + scaled)
    return mapped.astype(np.float32, copy=False)


def _drago(intensity: Float32, bias: float, average: float, bright: float) -> Float32:
    """L_d = log(L + 1) / (log10(L_max + 1) log(2 + 8 (L / L_max)^(log b / log 0.5))), equation (4).

    With L the intensity over its log average. L_max is bounded: beyond exp(1 / (0.38 log b / log 0.5)) the
    equation as printed is no longer monotone, the denominator grows faster than the logarithm.
    """
    exponent = math.log(bias) / math.log(0.5)
    average = max(average, SMALLEST)
    bound = math.expm1(1 / (0.38 * exponent))
    largest = min(max(bright / average, 1e-3), bound)
    relative = np.minimum(intensity, np.float32(average * largest)) / np.float32(average)
    ratio = relative / np.float32(largest)
    below = np.log(2 + 8 * np.power(ratio, np.float32(exponent)))
    mapped: Float32 = np.log1p(relative) / below / np.float32(math.log10(largest + 1))
    return mapped


def _measure_clahe(intensity: Float32, curve: Clahe) -> Statistics:
    """Log limits of the image, then tiles x tiles distributions at BINS + 1 edges, in one vector."""
    limits = _log(_percentiles(_sampled(intensity), [0.1, 99.9]))
    position = _log_position(intensity, limits)
    bins = np.minimum(position.astype(np.int64), BINS - 1)
    rows = np.arange(intensity.shape[0]) * curve.tiles // intensity.shape[0]
    columns = np.arange(intensity.shape[1]) * curve.tiles // intensity.shape[1]
    tile = rows[:, None] * curve.tiles + columns[None, :]
    counts = np.bincount((tile * BINS + bins).ravel(), minlength=curve.tiles**2 * BINS)
    distributions = _limited_distributions(counts.reshape(-1, BINS).astype(np.float64), curve.clip)
    return np.concatenate([limits, distributions.ravel()])


def _limited_distributions(counts: Statistics, clip: float) -> Statistics:
    """Cumulative distributions, 0 to 1, of histograms (n, BINS) clipped at ``clip`` times the mean."""
    total = counts.sum(axis=1, keepdims=True)
    shares = np.where(total > 0, counts / np.maximum(total, 1), 1 / BINS)
    # What is cut off is spread over all bins. The cut lies so far below the limit that none then exceeds it.
    low, high = np.zeros((len(counts), 1)), np.full((len(counts), 1), clip / BINS)
    for _ in range(24):
        cut = (low + high) / 2
        too_low = np.minimum(shares, cut).sum(axis=1, keepdims=True) + clip - BINS * cut > 1
        low, high = np.where(too_low, cut, low), np.where(too_low, high, cut)
    clipped = np.minimum(shares, high)
    clipped += (1 - clipped.sum(axis=1, keepdims=True)) / BINS
    return np.concatenate([np.zeros((len(counts), 1)), np.cumsum(clipped, axis=1)], axis=1)


def _log_position(intensity: Float32, limits: Statistics) -> Float32:
    """The log intensity between its limits, 0 to BINS."""
    low, high = float(limits[0]), float(limits[1])
    scale = BINS / max(high - low, 1e-3)
    position: Float32 = (np.log(intensity + np.float32(SMALLEST)) - np.float32(low)) * np.float32(scale)
    return np.clip(position, np.float32(0), np.float32(BINS), out=position)


def _clahe(intensity: Float32, curve: Clahe, statistics: Statistics) -> Float32:
    tiles = curve.tiles
    distributions = statistics[2:].astype(np.float32).reshape(tiles, tiles, BINS + 1)
    position = _log_position(intensity, statistics[:2])
    below = np.minimum(position.astype(np.int32), BINS - 1)
    part = position - below
    row, row_part = _tile_position(intensity.shape[0], tiles)
    column, column_part = _tile_position(intensity.shape[1], tiles)
    flat = distributions.ravel()
    mapped = np.zeros(intensity.shape, np.float32)
    for down in (0, 1):
        weight_row = row_part if down else 1 - row_part
        tile_row = np.minimum(row + down, tiles - 1)
        for right in (0, 1):
            weight = weight_row[:, None] * (column_part if right else 1 - column_part)[None, :]
            tile = tile_row[:, None] * tiles + np.minimum(column + right, tiles - 1)[None, :]
            index = tile * (BINS + 1) + below
            low = flat[index]
            mapped += weight * (low + part * (flat[index + 1] - low))
    return mapped


def _tile_position(size: int, tiles: int) -> tuple[NDArray[np.int32], Float32]:
    """For every pixel of an axis: the tile whose centre lies before it, and how far on it is to the next."""
    centred = np.clip((np.arange(size) + 0.5) * tiles / size - 0.5, 0, tiles - 1)
    before = centred.astype(np.int32)
    return before, (centred - before).astype(np.float32)
