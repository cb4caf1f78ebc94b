"""The curves and their parameters, and how they are named in files and on the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

from kalux.errors import SettingsError

MID_GREY = 0.18
"""The reflectance that photography takes for the middle of a scene."""

BINS = 256
"""Of the histograms of `Clahe`."""

Encoding = Literal["curve", "none", "srgb", "gamma"]


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
        _require(
            usable and self.white > self.black, "white", self.white, f"above black ({self.black}), below 1e30"
        )


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
        _require(1e-6 <= self.key <= 10, "key", self.key, "1e-6 to 10")  # so far float32 is exact enough
        if self.white is not None:
            _require(0 < self.white < 1e30, "white", self.white, "above 0 and below 1e30")
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


def encoding_of(settings: DisplaySettings) -> Encoding:
    """What ``curve`` stands for, or what was chosen."""
    if settings.encoding == "curve":
        return "srgb" if isinstance(settings.curve, Reinhard | Drago) else "none"
    return settings.encoding


def _require(good: bool, name: str, value: float, rule: str) -> None:
    if not good:
        raise SettingsError(f"display: {name} is {value}; it must be {rule}")


def _require_percentile(name: str, value: float) -> None:
    _require(0 <= value <= 100, name, value, "a percentile, 0 to 100")
