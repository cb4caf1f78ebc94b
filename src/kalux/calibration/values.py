"""What calibrations find, as one kind of value: settings with standard errors, other quantities, maps of pixels.

In a file a calibration is a small TOML text, which `kalux.settings.load` takes as well, and beside it an ``.npz`` with
the maps, named with its checksum (docs/calibration.md).
"""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.errors import FormatError, SettingsError
from kalux.models.pixels import PixelCalibration
from kalux.recording import Recording
from kalux.settings import Settings, from_dict, preset, read_toml

VERSION: Final = 1
"""Of the file format."""

_MAPS: Final = ("threshold_on", "threshold_off", "threshold_on_variance", "threshold_off_variance")
_FACTORS: Final = {"threshold_on": 1.0, "threshold_off": 1.0}

UNITS: Final[Mapping[str, str]] = {
    "threshold_on": "log intensity",
    "threshold_off": "log intensity",
    "row_time": "us",
    "threshold_spread": "relative standard deviation between pixels",
    "spread_on": "relative standard deviation between pixels",
    "spread_off": "relative standard deviation between pixels",
    "correlation": "of a pixel's ON and OFF thresholds, -1 to 1",
    "delay": "us",
    "apparent_delay": "us",
    "trailing_delay": "us, how late events were taken to be",
    "step_variance": "threshold^2 per event",
    "dark_steps": "threshold^2 more per event, in six octaves below 0.32 of white",
    "lag_variance": "threshold^2 at 0.02 of white",
    "noise_rate": "Hz per pixel",
    "frame_noise": "standard deviation in the dark, white = 1",
    "noise_at_half": "standard deviation at half of white, white = 1",
    "shot_noise": "variance per intensity, white = 1",
    "fixed_pattern": "standard deviation between pixels, white = 1",
    "saturation": "of white, 0 to 1",
    "black_level": "of white, 0 to 1: what pixels read in the dark",
    "dark_level": "of white, 0 to 1: below, pixels pile up",
    "white_level": "of white, 0 to 1: above, pixels pile up",
    "quiet_share": "of the sensor's time",
    "log_offset": "intensity, white = 1",
    "response": "camera response function",
    "trailing": "log intensity by which events are behind the light, about half a threshold",
    "residual": "log intensity, of frames' changes that events do not explain",
    "shortest_interval": "us, between two events of a pixel",
    "refractory_period": "us",
    "refractory_spread": "relative, of the refractory period",
    "refractory_at_most": "us",
    "residual_full_scale": "root mean square of images predicted from the merged radiance, share of full scale",
    "left_out_full_scale": "root mean square of images predicted from the others, share of full scale",
    "exposures": "s",
}
"""Units of every quantity that a calibration may hold; numbers of things have none."""

_OF_WHITE: Final = ("saturation", "black_level", "frame_noise", "shot_noise", "fixed_pattern", "log_offset")
"""Settings that are wrong where white was."""

_WHITE: Final = ("white", "white_is_doubtful")
"""What the provenance says of the frames' white value."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Measured values.

    Attributes
    ----------
    settings
        Settings by group and name, as in TOML, e.g. ``{"events": {"threshold_on": 0.21}}``.
    errors
        Standard errors, by name of a setting or of a measured quantity.
    measured
        Quantities that no setting takes, by name; units in `UNITS`.
    maps
        By name: (H, W) arrays. ``threshold_on``, ``threshold_off`` (factors of the settings') with
        ``threshold_on_variance``, ``threshold_off_variance``; ``hot``, ``dead`` (bool); ``noise_rate`` (Hz).
    provenance
        What it was made from, and how. ``white`` is what was taken for the value of a saturated pixel, and
        ``white_is_doubtful`` whether the frames made that doubtful.

    Raises
    ------
    SettingsError
        If a setting is unknown or out of its range.
    """

    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    errors: Mapping[str, float] = field(default_factory=dict)
    measured: Mapping[str, Any] = field(default_factory=dict)
    maps: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        from_dict(self.settings, preset("default"))

    def apply(self, settings: Settings) -> Settings:
        """The settings with what was measured in place of theirs."""
        return from_dict(self.settings, settings)

    @property
    def pixels(self) -> PixelCalibration | None:
        """`pixels_of` the spread that was measured, else the usual one."""
        return self.pixels_of(self.apply(preset("default")).events.mismatch)

    def pixels_of(self, spread: float) -> PixelCalibration | None:
        """What is known of single pixels; None without maps of thresholds or hot pixels.

        Where thresholds are not mapped they are the nominal ones, from which pixels differ by the relative ``spread``.
        """
        known = [name for name in (*_MAPS, "hot") if name in self.maps]
        if not known:
            return None
        shape = self.maps[known[0]].shape
        filled = {
            name: np.asarray(
                self.maps.get(name, np.full(shape, _FACTORS.get(name, spread**2))), dtype=np.float64
            )
            for name in _MAPS
        }
        hot = np.asarray(self.maps.get("hot", np.zeros(shape)), dtype=np.bool_)
        on, off, on_variance, off_variance = (filled[name] for name in _MAPS)
        return PixelCalibration(on, off, on_variance, off_variance, hot)

    def merged(self, other: Calibration) -> Calibration:
        """Both; where both know something, the other wins, and its standard error, if any, with it."""
        groups = {*self.settings, *other.settings}
        replaced = {name for values in (*other.settings.values(), other.measured) for name in values}
        doubted = self.provenance.get("white_is_doubtful") and not replaced >= {*self.shares_of_white}
        of_white = self if doubted or not other.shares_of_white else other
        provenance = {**self.provenance, **other.provenance}
        white = {name: of_white.provenance[name] for name in _WHITE if name in of_white.provenance}
        return Calibration(
            {g: {**self.settings.get(g, {}), **other.settings.get(g, {})} for g in sorted(groups)},
            {**{n: e for n, e in self.errors.items() if n not in replaced}, **other.errors},
            {**self.measured, **other.measured},
            {**self.maps, **other.maps},
            {**{n: v for n, v in provenance.items() if n not in _WHITE}, **white},
        )

    @property
    def shares_of_white(self) -> tuple[str, ...]:
        """Names of its settings that are shares of the frames' white value."""
        return tuple(name for name in _OF_WHITE if name in self.settings.get("camera", {}))


def require_white(calibration: Calibration, recording: Recording) -> None:
    """Check that levels of a calibration are not shares of a white value that was wrong.

    Raises
    ------
    SettingsError
        If its frames made their white doubtful, and the recording has another.
    """
    names, white = calibration.shares_of_white, calibration.provenance.get("white")
    if not names or white is None or not calibration.provenance.get("white_is_doubtful"):
        return
    first = next(iter(recording.stamped_frames()), None)
    if first is None or first.white_value == white:
        return
    raise SettingsError(
        f"calibration: its {' and '.join(names)} {'is a share' if len(names) == 1 else 'are shares'} of {white:g} as "
        f"white, which its recording hardly has, and {recording.source.path} has {first.white_value:g}; calibrate "
        f"again with --white {first.white_value:g}"
    )


# --- files ----------------------------------------------------------------------------------------------------


def load_calibration(path: str | Path, *more: str | Path) -> Calibration:
    """Read a calibration, or several that complete one another; of what several know the last is taken.

    Parameters
    ----------
    path, more
        Of the TOML files. Their maps lie beside them.

    Raises
    ------
    InputError
        If a file cannot be read.
    FormatError
        If it is no calibration, of a later version, or its maps are missing or others than it was written with.
    SettingsError
        If it holds a setting that is unknown or out of its range.
    """
    merged = Calibration()
    for each in (path, *more):
        merged = merged.merged(_load(Path(each)))
    return merged


def _load(path: Path) -> Calibration:
    body = read_toml(path, damaged=FormatError)
    version = body.get("kalux_calibration")
    for kind in ("rig", "offset"):
        if f"kalux_{kind}" in body:
            raise FormatError(f"{path}: of two cameras, not of a sensor; it is for kalux register --{kind}")
    if not isinstance(version, int):
        raise FormatError(
            f"{path}: not a calibration; kalux calibrate contrast, noise and response make them"
        )
    if version > VERSION:
        raise FormatError(
            f"{path}: a calibration of version {version}, this kalux reads up to {VERSION}; update kalux"
        )
    tables = {
        name: body.get(name, {}) for name in ("settings", "standard_errors", "measured", "provenance", "maps")
    }
    for name, table in tables.items():
        if not isinstance(table, Mapping):
            raise FormatError(f"{path}: {name} is not a table")
    try:
        return Calibration(
            tables["settings"],
            tables["standard_errors"],
            tables["measured"],
            _maps(path, tables["maps"]) if tables["maps"] else {},
            tables["provenance"],
        )
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from None


def _maps(path: Path, entry: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    name = entry.get("file")
    if not isinstance(name, str) or name in ("", "..") or "\0" in name or Path(name).name != name:
        raise FormatError(f"{path}: maps.file is {name!r}; the name of a file beside it is needed")
    beside = path.with_name(name)
    try:
        data = beside.read_bytes()
    except OSError as error:
        raise FormatError(f"{path}: its maps {name} cannot be read: {error.strerror or error}") from error
    if hashlib.sha256(data).hexdigest() != entry.get("sha256"):
        raise FormatError(
            f"{beside}: not the maps that {path.name} was written with (checksum); calibrate again"
        )
    try:
        with np.load(BytesIO(data), allow_pickle=False) as archive:
            maps = {key: archive[key] for key in archive.files}
    except (ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise FormatError(f"{beside}: no maps as kalux writes them; calibrate again") from error
    shapes = {values.shape for values in maps.values()}
    if len(shapes) > 1:
        raise FormatError(f"{beside}: maps of different sizes: {sorted(shapes)}")
    for key, values in maps.items():
        if values.dtype.kind not in "biuf":
            raise FormatError(f"{beside}: map {key} is {values.dtype}; numbers are needed, calibrate again")
    return maps


# --- text -----------------------------------------------------------------------------------------------------


def describe_calibration(calibration: Calibration) -> list[tuple[str, str]]:
    """Names and values with units and standard errors, for people."""
    rows = []
    values = [item for group in calibration.settings.values() for item in group.items()]
    for name, value in [*values, *calibration.measured.items()]:
        error = calibration.errors.get(name)
        text = _number(value) + ("" if error is None else f" +- {_number(error)}")
        unit = UNITS.get(name, "")
        rows.append((name, f"{text}  ({unit})" if unit else text))
    for name in sorted(calibration.maps):
        rows.append((f"map {name}", _map_text(calibration.maps[name])))
    return rows


def _number(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, str) and len(value) > 40:
        return value[:37] + "..."
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(_number(part) for part in value)
    return str(value)


def _map_text(values: NDArray[Any]) -> str:
    size = "x".join(str(n) for n in values.shape[::-1])
    if values.dtype.kind == "b":
        return f"{size}: {np.count_nonzero(values):,} pixels"
    low, middle, high = (_number(part) for part in np.quantile(values, [0.05, 0.5, 0.95]).tolist())
    return f"{size}: median {middle}, 5 to 95 % from {low} to {high}"
