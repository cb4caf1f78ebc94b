"""Settings: frozen dataclasses with units and reasons, presets, TOML in and out."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from kalux.errors import InputError, KaluxError, SettingsError

FilterName = Literal["akf", "cf"]
AugmentationName = Literal["bridge", "paper"]
AUTO: Final = "auto"
"""Stands in files for None: found out from the recording."""

SolutionName = Literal["exact", "printed"]

UNKNOWN_LOG_OFFSET: Final = 0.03
"""I_0 where it is not known: what real recordings of DAVIS sensors agree with best (docs/tuning.md)."""

UNKNOWN_STEP_VARIANCE: Final = 0.2
"""Variance of an event's step, c^2, where it is not known: the same recordings."""


def chosen_response(setting: str, stated: str | None) -> str:
    """The camera's response that a setting names, or, where that is ``"auto"``, the recording states."""
    return (stated or "linear") if setting == AUTO else setting


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """The frame camera, equations (3)-(9).

    Attributes
    ----------
    response
        ``"linear"`` (raw sensor values: DAVIS, machine vision), ``"srgb"``, ``"gamma:EXPONENT"``, ``"s-curve:BLACK"``,
        or a measured ``"curve:0 0.0012 ... 1"``: the irradiance at equally spaced response levels
        (`kalux calibrate response`). Three with ";" between them are those of red, green and blue. ``"auto"``: what
        the recording states, else linear.
    log_offset
        I_0 of equation (8); white = 1. Events are steps of log I, so it must be small; below the dark current
        of the event pixels it only magnifies noise. None: an estimate from the recording
        (`kalux.calibration.event_model`), 0.03 where it cannot be told. The paper's code: 1.
    frame_noise, shot_noise
        sigma_im of equation (6) for one frame: standard deviation in the dark, and variance per intensity; white = 1.
        None: an estimate from the recording (`kalux.calibration.frame_noise`); a shot noise beside a given frame noise
        is 0.
    usual_frame_noise
        The frame noise where the recording does not tell it, without shot noise. 0.006 is what the paper's 7e5 1/s
        amounts to at 40 frames/s.
    confidence
        1 / sigma_im^2 of equation (6) as the paper uses it, a rate in 1/s: 7e5 (DAVIS), 7e7 (FLIR). For
        augmentation "paper" only.
    weight_floor
        Smallest f^w, which caps R_bar. 0.09 is the released code's; for augmentation "paper" only, since
        the other gives clipped pixels no weight at all.
    saturation
        Response, 0 to 1, from which a pixel counts as clipped. 0.98: a few levels below 255, for sensors with
        fixed pattern noise at the top.
    reference_exposure
        Exposure time, us, at which a saturated pixel has intensity 1; None: the recording's median.
    white_balance
        Of recordings in colour: ``"as-recorded"``, ``"grey-world"`` (gains that make the mean of well exposed pixels
        grey; one set for a recording), or gains of red, green and blue, ``"1.8;1;1.4"``. As recorded: what is grey is
        not in the recording, and RGB frames are balanced already.
    """

    response: str = AUTO
    log_offset: float | None = None
    frame_noise: float | None = None
    shot_noise: float | None = None
    usual_frame_noise: float = 0.006
    confidence: float = 7e5
    weight_floor: float = 0.09
    saturation: float = 0.98
    reference_exposure: int | None = None
    white_balance: str = "as-recorded"

    @property
    def offset(self) -> float:
        """I_0, also where nobody has said or estimated it."""
        return UNKNOWN_LOG_OFFSET if self.log_offset is None else self.log_offset

    @property
    def noise(self) -> tuple[float, float]:
        """Frame noise and shot noise, also where nobody has said or estimated them."""
        read = self.usual_frame_noise if self.frame_noise is None else self.frame_noise
        return read, self.shot_noise or 0.0


@dataclass(frozen=True, kw_only=True)
class EventSettings:
    """Event noise, equations (1)-(2), and the calibration of the contrast threshold, (12).

    Attributes
    ----------
    threshold_on, threshold_off
        Contrast thresholds c, log intensity; None: what the recording states, else an estimate from it.
    delay
        How much later than the frames' clock events are stamped, us, e.g. by the latency of their pixels; None: an
        estimate from the recording (0 for a live stream).
    threshold_spread
        Relative standard deviation of the threshold between pixels, prior of its calibration. 0.1: data
        sheets and the literature give 2 to 10 % (Lichtsteiner 2008: 2.1 % of contrast at c = 0.2), real
        recordings more.
    step_variance
        Variance of one event's step in units of c^2. None: an estimate from the recording
        (`kalux.calibration.event_model`), 0.2 where it cannot be told (docs/tuning.md).
    quantisation_variance
        Variance, in c^2, of the change that events have not yet told at both ends of a frame interval: two
        uniform distributions one threshold wide, 2/12.
    deblur_variance
        Variance, in c^2, that each event of an exposure adds to the deblurred frame. 0.05 (docs/tuning.md).
    noise_rate
        Background noise, Hz per pixel, that makes isolated events doubtful. 3: typical of a DAVIS at its
        default biases in room light.
    extrapolation_spread
        Standard deviation of the log of the scale of what events say of highlights beyond white, where no
        frame can check it, when the threshold is only an estimate. 0.15: how well large steps between well
        exposed frames agree with estimated thresholds, on three real and eleven simulated recordings.
    sigma_proc2, sigma_iso2, sigma_ref2, refractory_bound
        The paper's event noise: 0.0005 1/s, 0.03 1/s, 0.01, and 10 ms (released code), in s. For
        augmentation "paper" only.
    """

    threshold_on: float | None = None
    threshold_off: float | None = None
    delay: int | None = None
    threshold_spread: float = 0.1
    step_variance: float | None = None
    quantisation_variance: float = 1 / 6
    deblur_variance: float = 0.05
    noise_rate: float = 3.0
    extrapolation_spread: float = 0.15
    sigma_proc2: float = 0.0005
    sigma_iso2: float = 0.03
    sigma_ref2: float = 0.01
    refractory_bound: float = 0.01

    @property
    def step_noise(self) -> float:
        """Variance of one event's step in units of c^2, also where nobody has said or estimated it."""
        return UNKNOWN_STEP_VARIANCE if self.step_variance is None else self.step_variance


@dataclass(frozen=True, kw_only=True)
class FilterSettings:
    """The filter, equations (14)-(21).

    Attributes
    ----------
    kind
        ``"akf"``, the asynchronous Kalman filter, or ``"cf"``, the complementary filter.
    augmentation
        ``"bridge"``: frames joined by events weighted by their uncertainties; ``"paper"``: (10)-(13).
    solution
        Of (16) and (19): ``"exact"`` for a moving L^A and a varying R, or ``"printed"``, (17) and (20).
        Augmentation "bridge" is always exact.
    deblur
        Remove motion blur with the events of the exposure (EDI).
    initial_variance
        P at the start where the first frame is clipped, and everywhere with augmentation "paper" (0.09 in
        the released code). 1.0: a clipped pixel is white or up to a few times brighter.
    highlight_scale
        Standard deviation, in log intensity, of how far scenes go beyond white: what is not known of a
        highlight is drawn towards white by it. 0 turns it off. 1.5 (docs/tuning.md).
    highlight_tail
        The same where thresholds are only an estimate, as a multiple of the scale of the frames' bright tail
        (`kalux.models.camera.BrightTail`), but no more than highlight_scale: scenes of which little saturates do
        not go far beyond white. 0.75 (docs/tuning.md).
    bright_tail
        That scale; None: from the recording's frames, in a live stream from the first.
    neighbours
        Standard deviation, in log intensity, by which neighbouring pixels of a surface differ: moving pixels are
        given what their eight neighbours know (docs/equations.md, K12). 0 turns it off. 0.3 (docs/tuning.md).
    cutoff
        Of the complementary filter, Hz. 1.0 (Scheerlinck 2018 uses 2 pi rad/s).
    """

    kind: FilterName = "akf"
    augmentation: AugmentationName = "bridge"
    solution: SolutionName = "exact"
    deblur: bool = True
    initial_variance: float = 1.0
    highlight_scale: float = 1.5
    highlight_tail: float = 0.75
    bright_tail: float | None = None
    neighbours: float = 0.3
    cutoff: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings of a reconstruction. Start from `preset` and change with `dataclasses.replace`."""

    camera: CameraSettings = field(default_factory=CameraSettings)
    events: EventSettings = field(default_factory=EventSettings)
    filter: FilterSettings = field(default_factory=FilterSettings)

    def __post_init__(self) -> None:
        _check(self)


def preset(name: str) -> Settings:
    """The settings of a preset.

    Raises
    ------
    SettingsError
        If there is no such preset.
    """
    try:
        return PRESETS[name]
    except KeyError:
        raise SettingsError(f"preset: unknown preset {name!r}; known are {', '.join(PRESETS)}") from None


def to_dict(settings: Settings) -> dict[str, dict[str, Any]]:
    """As nested plain values, for TOML; None, which TOML has not, is ``"auto"``."""
    return {
        group: {name: AUTO if value is None else value for name, value in values.items()}
        for group, values in dataclasses.asdict(settings).items()
    }


def from_dict(values: Mapping[str, Any], base: Settings) -> Settings:
    """Change ``base`` by nested plain values.

    Raises
    ------
    SettingsError
        If a group or a setting is unknown, or a value has the wrong type or range.
    """
    groups = {}
    for group, entries in values.items():
        if group not in ("camera", "events", "filter"):
            raise SettingsError(f"settings: unknown group [{group}]; known are camera, events, filter")
        current = getattr(base, group)
        known = {entry.name for entry in dataclasses.fields(current)}
        if not isinstance(entries, Mapping):
            raise SettingsError(f"settings: {group} is not a table of settings")
        for name in entries:
            if name not in known:
                raise SettingsError(
                    f"settings: unknown setting {group}.{name}; known are {', '.join(sorted(known))}"
                )
        optional = {entry.name for entry in dataclasses.fields(current) if entry.default is None}
        chosen = {
            name: None if name in optional and value == AUTO else value for name, value in entries.items()
        }
        groups[group] = dataclasses.replace(current, **chosen)
    return dataclasses.replace(base, **groups)


def read_toml(
    path: Path, *, unreadable: type[KaluxError] = InputError, damaged: type[KaluxError] = InputError
) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises
    ------
    KaluxError
        ``unreadable`` if the file cannot be read, ``damaged`` if it is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise unreadable(f"{path}: cannot be read: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise damaged(f"{path}: not valid TOML: {error}") from error


def load(path: str | Path, base: Settings) -> Settings:
    """Change ``base`` by a TOML file: tables ``[camera]``, ``[events]``, ``[filter]``, as in ``kalux.toml``.

    An output's ``kalux.toml`` can be given as it is: its ``[settings.*]`` tables are used.

    Raises
    ------
    SettingsError
        If the file cannot be read, is not TOML, or holds an unknown setting.
    """
    values = read_toml(Path(path), unreadable=SettingsError, damaged=SettingsError)
    chosen = values.get("settings", values)
    if not isinstance(chosen, Mapping):
        raise SettingsError(f"{path}: settings is not a table of settings")
    try:
        return from_dict(chosen, base)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from None


_POSITIVE: Final = {
    "log_offset",
    "frame_noise",
    "usual_frame_noise",
    "confidence",
    "weight_floor",
    "saturation",
    "reference_exposure",
    "threshold_on",
    "threshold_off",
    "bright_tail",
    "initial_variance",
    "cutoff",
}
_WHOLE: Final = {"delay", "reference_exposure"}
_SIGNED: Final = {"delay"}
_CHOICES: Final = {
    "kind": ("akf", "cf"),
    "augmentation": ("bridge", "paper"),
    "solution": ("exact", "printed"),
}


def _check(settings: Settings) -> None:
    for group in ("camera", "events", "filter"):
        values = getattr(settings, group)
        for entry in dataclasses.fields(values):
            _check_value(f"{group}.{entry.name}", entry.name, getattr(values, entry.name), entry.default)
    if settings.camera.saturation > 1 or settings.camera.weight_floor > 1:
        raise SettingsError("settings: camera.saturation and camera.weight_floor must be at most 1")


def _check_value(label: str, name: str, value: Any, default: Any) -> None:
    if name in _CHOICES:
        if value not in _CHOICES[name]:
            raise SettingsError(
                f"settings: {label} is {value!r}; it must be one of {', '.join(_CHOICES[name])}"
            )
    elif isinstance(default, (bool, str)):
        if not isinstance(value, type(default)):
            raise SettingsError(f"settings: {label} is {value!r}; {type(default).__name__} is needed")
    elif value is None:
        if default is not None:
            raise SettingsError(f"settings: {label} needs a number")
    elif name in _WHOLE and not (isinstance(value, int) and not isinstance(value, bool)):
        raise SettingsError(f"settings: {label} is {value!r}; whole microseconds are needed")
    elif isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise SettingsError(f"settings: {label} is {value!r}; a finite number is needed")
    elif (value < 0 and name not in _SIGNED) or (name in _POSITIVE and value == 0):
        raise SettingsError(
            f"settings: {label} is {value}; it must be {'positive' if name in _POSITIVE else '0 or more'}"
        )


_PAPER: Final = Settings(
    camera=CameraSettings(log_offset=1.0),
    events=EventSettings(delay=0),
    filter=FilterSettings(
        augmentation="paper",
        solution="printed",
        initial_variance=0.09,
        highlight_scale=0.0,
        neighbours=0.0,
    ),
)

PRESETS: Final[Mapping[str, Settings]] = {
    "default": Settings(),
    "iccv2021": _PAPER,
    "iccv2021-flir": dataclasses.replace(_PAPER, camera=dataclasses.replace(_PAPER.camera, confidence=7e7)),
    "cf": Settings(filter=FilterSettings(kind="cf", deblur=False, highlight_scale=0.0, neighbours=0.0)),
}
"""``default``: best on ground truth. ``iccv2021``: the paper to the letter with the confidence of its DAVIS,
``iccv2021-flir`` of its FLIR. ``cf``: the complementary filter."""
